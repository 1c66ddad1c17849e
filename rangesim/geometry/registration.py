# SPDX-License-Identifier: Apache-2.0
"""Where one point cloud lies in another: iterative closest points, and registration without a first guess, by Open3D.

A failed registration looks like a result, so what could be one raises ValueError: too few points with a partner,
surfaces that slide on each other (a plane, a sphere, a cylinder), and, without a first guess, two poses that fit
alike (a symmetric part).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rangesim.geometry.correspondences import Array, check_distinct, checked_array
from rangesim.rig import pose

LEAST_POINTS = 20
PARTNER_SPACINGS = 3.0
"""Spacings of the target's points within which a point has a partner at the end."""
START_SPACINGS = 12.0
"""The same at the start: how far, about, the first guess of `icp` may be off."""
NORMAL_NEIGHBOURS = 20
MIN_CONSTRAINT = 5e-3
"""Least eigenvalue of the normal equations over the largest: below, the surfaces slide. 0.0002 to 0.001 of planes,
spheres and cylinders with noise, 0.2 of a box (measured)."""
FEATURE_SPACINGS = 5.0
"""Voxel for features, and for the samples of the global registration, in spacings."""
MIN_FEATURE_FRACTION = 0.02
"""The same as a fraction of the extent of the target: a few thousand voxels are enough, and quick."""
ATTEMPTS = 4
"""Runs of RANSAC, with seeds of their own."""
COMPARED_POINTS = 3000
"""Of the source, by which poses are compared."""
AS_GOOD = 0.95
"""Fraction of the best agreement at which another pose fits alike."""


@dataclass(frozen=True, eq=False)
class Registration:
    """Where the source lies in the target.

    T_target_source : (4, 4), maps source coordinates to target coordinates, metres. fitness : fraction of the source
    points with a target point within 3 spacings. target_fitness : the same of the target's points: the overlap of
    either. rms_m : root mean square distance of these partners along the target's normals, metres. constraint : least
    over largest eigenvalue of the normal equations, in units of the cloud's size: how firmly the surfaces hold each
    other. agreement : mean over the source of 1 - (d / spacing)^2, but at least -1, d the distance of partners along
    the normal, and 0 without a partner: a pose that puts surfaces beside each other counts less than one that leaves
    them apart. By it poses are compared.
    """

    T_target_source: Array
    fitness: float
    target_fitness: float
    rms_m: float
    constraint: float
    agreement: float


def icp(
    source: ArrayLike,
    target: ArrayLike,
    T_target_source: ArrayLike | None = None,
    *,
    max_distance_m: float | None = None,
    min_fitness: float = 0.3,
) -> Registration:
    """Refines a first guess: iterative closest points, point to plane (Chen, Medioni 1992), by Open3D.

    Minimises the distances of source points to the tangent planes of their nearest target points, within a distance
    that is halved from `max_distance_m` to 3 spacings of the target.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) metres.
    T_target_source : (4, 4) first guess; None: the identity.
    max_distance_m : how far points may be from their partners at first; None: 12 spacings of the target.
    min_fitness : least fraction of the source with a partner at the end.

    Raises
    ------
    ValueError
        Fewer than 20 different points, fewer partners than `min_fitness`, or surfaces that slide on each other.
    """
    clouds = _checked(source, target)
    start = np.eye(4) if T_target_source is None else pose(T_target_source, "T_target_source")
    _check_fraction(min_fitness)
    if max_distance_m is not None and not max_distance_m > 0:
        raise ValueError(f"expected max_distance_m to be positive, got {max_distance_m!r}.")
    found = _refined(*clouds, _with_normals(clouds[1]), start, max_distance_m)
    _refuse_failure(found, min_fitness, "start nearer to the right pose, with a larger max_distance_m, or by register")
    return found


def register(source: ArrayLike, target: ArrayLike, *, min_fitness: float = 0.3, seed: int = 0) -> Registration:
    """Finds the pose without a first guess: RANSAC over fast point feature histograms, then `icp`.

    Features (FPFH: Rusu, Blodow, Beetz 2009) of both clouds at voxels of 5 spacings, or a fiftieth of the target's
    extent if that is larger, are matched and three matches make a pose (Open3D's
    `registration_ransac_based_on_feature_matching`). The results of four runs, and the best one turned by quarters
    and halves about the target's principal axes, go through `icp`; the one that agrees best counts. The same seed
    gives the same result, to the rounding of Open3D's parallel sums.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) metres.
    min_fitness : least fraction of the source with a partner at the end.

    Raises
    ------
    ValueError
        As `icp`; or another pose fits nearly as well: a symmetric shape, or one with too little to tell its sides
        apart.
    """
    clouds = _checked(source, target)
    _check_fraction(min_fitness)
    normals = _with_normals(clouds[1])
    some = np.random.default_rng(seed).permutation(len(clouds[0]))[:COMPARED_POINTS]
    few = clouds[0][some]
    tried = [_refined(few, clouds[1], normals, start, None) for start in _feature_poses(*clouds, seed)]
    if not tried:
        raise ValueError(
            "expected clouds with features in common, got none that match; give icp a first guess instead."
        )
    turned = _turned(max(tried, key=_agreement).T_target_source, *clouds)
    tried += [_refined(few, clouds[1], normals, start, None) for start in turned]
    best = max(tried, key=_agreement)
    found = _refined(*clouds, normals, best.T_target_source, PARTNER_SPACINGS * _spacing(clouds[1]))
    _refuse_failure(found, min_fitness, "scan with more overlap, or give icp a first guess")
    reach = PARTNER_SPACINGS * _spacing(clouds[1])
    for other in tried:
        if other.agreement >= AS_GOOD * best.agreement and _distance(best, other, few) > 2 * reach:
            angle = np.degrees(Rotation.from_matrix(_relative(best, other)[:3, :3]).magnitude())
            raise ValueError(
                f"expected clouds that fit in one way, got two poses {angle:.0f} degrees apart that fit alike "
                "(agreement "
                f"{best.agreement:.3f} and {other.agreement:.3f}): the shape is symmetric; give icp a first guess."
            )
    return found


def _agreement(found: Registration) -> float:
    return found.agreement


def _turned(T: Array, source: Array, target: Array) -> list[Array]:
    """The pose followed by turns of 90, 180 and 270 degrees about the target's principal axes, through the source's
    middle."""
    axes = np.linalg.svd(target - target.mean(axis=0), full_matrices=False)[2]
    middle = T[:3, :3] @ source.mean(axis=0) + T[:3, 3]
    result: list[Array] = []
    for axis in axes:
        for quarters in (1, 2, 3):
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(0.5 * np.pi * quarters * axis).as_matrix()
            turn[:3, 3] = middle - turn[:3, :3] @ middle
            result.append(turn @ T)
    return result


def _checked(source: ArrayLike, target: ArrayLike) -> tuple[Array, Array]:
    clouds = checked_array("source", source, None, 3), checked_array("target", target, None, 3)
    for name, points in zip(("source", "target"), clouds, strict=True):
        if points.ndim != 2:
            raise ValueError(f"expected {name} of shape (n, 3), got {points.shape}.")
        check_distinct(name, points, LEAST_POINTS, "a registration")
    return clouds


def _check_fraction(min_fitness: float) -> None:
    if not 0 < min_fitness <= 1:
        raise ValueError(f"expected min_fitness as a fraction, above 0 and at most 1, got {min_fitness!r}.")


def _refuse_failure(found: Registration, min_fitness: float, hint: str) -> None:
    if not found.fitness >= min_fitness:
        raise ValueError(
            f"expected {min_fitness:.0%} of the source on the target, got {found.fitness:.1%} within "
            f"{PARTNER_SPACINGS:g} spacings; {hint}."
        )
    if found.constraint < MIN_CONSTRAINT:
        raise ValueError(
            f"expected surfaces that hold each other, got ones that slide (constraint {found.constraint:.1e}): a "
            "plane, a sphere, a cylinder; "
            "add points of another shape to the clouds, such as what they stand on."
        )


def _spacing(points: Array) -> float:
    """Median distance of points to their nearest neighbour."""
    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))


def _cloud(points: Array) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def _with_normals(points: Array) -> Any:
    import open3d as o3d

    cloud = _cloud(points)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    return cloud


def _refined(
    source: Array, target: Array, target_cloud: Any, start: Array, max_distance_m: float | None
) -> Registration:
    """Result of ICP from one start, whatever it is worth."""
    import open3d as o3d

    spacing = _spacing(target)
    reach = PARTNER_SPACINGS * spacing
    distance = max(reach, START_SPACINGS * spacing if max_distance_m is None else max_distance_m)
    method = o3d.pipelines.registration.TransformationEstimationPointToPlane()
    criteria = o3d.pipelines.registration.ICPConvergenceCriteria(1e-9, 1e-9, 60)
    cloud, T = _cloud(source), np.array(start)
    while True:
        T = o3d.pipelines.registration.registration_icp(
            cloud, target_cloud, distance, T, method, criteria
        ).transformation
        if distance <= reach:
            break
        distance = max(reach, distance / 2)
    return _judged(source, target, np.asarray(target_cloud.normals), np.array(T), reach)


def _judged(source: Array, target: Array, normals: Array, T: Array, reach: float) -> Registration:
    moved = source @ T[:3, :3].T + T[:3, 3]
    distance, partner = cKDTree(target).query(moved, distance_upper_bound=reach)
    has = np.isfinite(distance)
    other = np.isfinite(cKDTree(moved).query(target, distance_upper_bound=reach)[0])
    if not has.any():
        return Registration(T, 0.0, float(other.mean()), float("nan"), 0.0, 0.0)
    n = normals[partner[has]]
    off = ((moved[has] - target[partner[has]]) * n).sum(axis=-1)
    arm = moved[has] - moved[has].mean(axis=0)
    size = np.sqrt((arm**2).sum(axis=-1).mean())
    rows = np.hstack(
        [np.cross(arm / size, n), n]
    )  # Gelfand, Ikemoto, Rusinkiewicz, Levoy: "Geometrically stable sampling", 2003
    values = np.linalg.eigvalsh(rows.T @ rows)
    agreement = np.maximum(-1, 1 - (off * PARTNER_SPACINGS / reach) ** 2).sum() / len(source)
    return Registration(
        T_target_source=T,
        fitness=float(has.mean()),
        target_fitness=float(other.mean()),
        rms_m=float(np.sqrt((off**2).mean())),
        constraint=float(max(values[0], 0) / values[-1]),
        agreement=float(agreement),
    )


def _feature_poses(source: Array, target: Array, seed: int) -> list[Array]:
    """(4, 4) poses that the matches of features propose, one of each run."""
    import open3d as o3d

    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    voxel = max(FEATURE_SPACINGS * _spacing(target), MIN_FEATURE_FRACTION * extent)
    few, features = [], []
    for points in (source, target):
        cloud = _cloud(points).voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        cloud.orient_normals_towards_camera_location(cloud.get_center())  # a side that does not depend on the pose
        few.append(cloud)
        search = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
        features.append(o3d.pipelines.registration.compute_fpfh_feature(cloud, search))
    checks = [
        o3d.pipelines.registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        o3d.pipelines.registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
    ]
    poses = []
    for attempt in range(ATTEMPTS):
        o3d.utility.random.seed(seed + attempt)
        found = o3d.pipelines.registration.registration_ransac_based_on_feature_matching(
            *few, *features, False, 1.5 * voxel,
            o3d.pipelines.registration.TransformationEstimationPointToPoint(False), 3, checks,
            o3d.pipelines.registration.RANSACConvergenceCriteria(100_000, 0.999),
        )  # fmt: skip
        if len(found.correspondence_set) >= 3:
            poses.append(np.array(found.transformation))
    return poses


def _relative(first: Registration, second: Registration) -> Array:
    return np.asarray(np.linalg.inv(first.T_target_source) @ second.T_target_source)


def _distance(first: Registration, second: Registration, source: Array) -> float:
    """Root mean square distance of the source's points under two poses, metres."""
    T = _relative(first, second)
    return float(np.sqrt(((source @ T[:3, :3].T + T[:3, 3] - source) ** 2).sum(axis=-1).mean()))
