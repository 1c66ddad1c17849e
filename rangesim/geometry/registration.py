# SPDX-License-Identifier: Apache-2.0
"""Where one point cloud lies in another: iterative closest points, and registration without a first guess, by Open3D.

A failed registration looks like a result, so what could be one raises ValueError: too few points with a partner,
surfaces that slide on each other (a plane, a sphere, a cylinder), and two poses that fit alike (a symmetric part, or
too small an overlap), surfaces that lie across each other (another part, another scale).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rangesim.geometry.correspondences import Array, check_distinct, checked_array
from rangesim.rig import pose
from rangesim.robust_scale import sigma_from_median

LEAST_POINTS = 20
PARTNER_SPACINGS = 3.0
"""Spacings of the target's points within which a point has a partner at the end."""
FINAL_SPACINGS = 1.5
"""The same that the last steps are taken with: what is beyond the other cloud's border pulls the less."""
START_SPACINGS = 12.0
"""The same at the start: how far, about, the first guess of `icp` may be off."""
NORMAL_NEIGHBOURS = 20
MIN_CONSTRAINT = 3e-3
"""Least ratio of the smallest eigenvalue of the normal equations to the largest: below, the surfaces slide. Measured:
at most 0.0019 for planes, spheres, cylinders, cones and roofs of 600 and 2500 points with noise up to their spacing;
0.0008 to 0.012 for tables with things on them, 0.2 for a box."""
FEATURE_SPACINGS = 5.0
"""Voxel for features, and for the samples of the global registration, in spacings."""
MIN_FEATURE_FRACTION = 0.02
"""The same as a fraction of the extent of the target: a few thousand voxels are enough, and quick."""
ATTEMPTS = 4
"""Runs of RANSAC, with seeds of their own."""
COMPARED_POINTS = 3000
"""Of the source, by which poses are compared."""
MIN_AGREEMENT = 0.45
"""Least mean of 1 - (d / s)^2 over the points with a partner, s the spacing, or the roughness of a cloud if larger.
Measured: 0.47 to 0.96 for right poses, but 0.37 for a scan ten times as dense as the target with noise above the
target's spacing; -0.1 to 0.44 for corrugated plates that lie askew and for parts 5 or 10 % off in scale."""
FAR_EXTENTS = 5.0
"""Clouds further than this from the origin, in units of their extent, are moved there before they are solved."""
SLIDE_SPACINGS = 6.0
"""Step, in spacings of the target, by which a result of `icp` is slid along the surface to look for other poses."""
MAX_SLIDES = 6
"""Largest number of such steps to either side."""
SLID_POINTS = 800
"""Number of points of the source that are slid: a pose that fits as well does so by few points, too."""
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
    that is halved from `max_distance_m` to 1.5 spacings of the target; then again from half of it, a quarter and so
    on. The result that agrees best counts: a large distance reaches far, but pulls clouds that overlap in part over
    each other. It is slid along the surface, then, to see whether it fits there as well: by one rib of many.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) metres.
    T_target_source : (4, 4) first guess; None: the identity.
    max_distance_m : how far points may be from their partners at first; None: 12 spacings of the target.
    min_fitness : least fraction of the source with a partner at the end.

    The clouds may lie far from the origin, as at map coordinates: they are solved about their middles then.

    Raises
    ------
    ValueError
        Fewer than 20 different points, fewer partners than `min_fitness`, surfaces that slide on each other or lie
        across each other, or two poses that fit nearly alike.
    """
    moving, fixed, middles = _checked(source, target)
    given = np.eye(4) if T_target_source is None else pose(T_target_source, "T_target_source")
    _check_fraction(min_fitness)
    if max_distance_m is not None and not max_distance_m > 0:
        raise ValueError(f"expected max_distance_m to be positive, got {max_distance_m!r}.")
    surface = _Surface.of(fixed)
    start = middles.to_middles(given)
    results = [_refined(moving, surface, start, d) for d in surface.halved(max_distance_m)]
    found = max(results, key=_agreement)
    _refuse_failure(found, min_fitness, "start nearer to the right pose, with a larger max_distance_m, or by register")
    _refuse_disagreement(found, moving, surface)
    _refuse_others(found, results, moving, surface)
    _refuse_slid(found, start, moving, surface, surface.halved(max_distance_m)[0])
    return replace(found, T_target_source=middles.from_middles(found.T_target_source))


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
    moving, fixed, middles = _checked(source, target)
    _check_fraction(min_fitness)
    surface = _Surface.of(fixed)
    few = moving[np.random.default_rng(seed).permutation(len(moving))[:COMPARED_POINTS]]
    start_m = START_SPACINGS * surface.spacing
    tried = [_refined(few, surface, start, start_m) for start in _feature_poses(moving, surface, seed)]
    if not tried:
        raise ValueError("expected clouds with features in common, got none; give icp a first guess instead.")
    turned = _turned(max(tried, key=_agreement).T_target_source, moving, fixed)
    tried += [_refined(few, surface, start, start_m) for start in turned]
    best = max(tried, key=_agreement)
    found = _refined(moving, surface, best.T_target_source, PARTNER_SPACINGS * surface.spacing)
    _refuse_failure(found, min_fitness, "scan with more overlap, or give icp a first guess")
    _refuse_disagreement(found, moving, surface)
    _refuse_others(best, tried, few, surface)
    return replace(found, T_target_source=middles.from_middles(found.T_target_source))


def nearest_similarity(source: Array, target: Array) -> Array:
    """(4, 4) T_target_source: the scale, rotation and translation that bring points (n, 3) nearest to their partners.

    Source: Umeyama, PAMI 1991.
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    T = np.eye(4)
    T[:3, :3] = (values * signs).sum() / max((a**2).sum(), 1e-300) * (u * signs) @ vt
    T[:3, 3] = target.mean(axis=0) - T[:3, :3] @ source.mean(axis=0)
    return T


class _Middles(NamedTuple):
    """(3,) of the source and of the target, metres: where the origins of the solved clouds lie; 0 of a cloud near its.

    Far from the origin a turn about it moves the clouds by metres: the steps of ICP are then neither small nor exact.
    """

    source: Array
    target: Array

    def to_middles(self, T: Array) -> Array:
        """T_target_source (4, 4) between the clouds moved to their middles."""
        result = T.copy()
        result[:3, 3] = T[:3, :3] @ self.source + T[:3, 3] - self.target
        return result

    def from_middles(self, T: Array) -> Array:
        """T_target_source (4, 4) between the clouds as given."""
        result = T.copy()
        result[:3, 3] = T[:3, 3] + self.target - T[:3, :3] @ self.source
        return result


class _Surface(NamedTuple):
    """A target: its points (m, 3), with normals as Open3D's cloud, their search tree and median spacing in metres.

    halves : the search tree and the normals (m / 2, 3) of either half of the points, whose errors are independent.
    """

    points: Array
    cloud: Any
    tree: Any
    spacing: float
    halves: tuple[tuple[Any, Array], tuple[Any, Array]]

    @classmethod
    def of(cls, points: Array) -> _Surface:
        import open3d as o3d

        tree = cKDTree(points)
        cloud = _cloud(points)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
        spacing = float(np.median(tree.query(points, k=2)[0][:, 1]))
        order = np.random.default_rng(0).permutation(len(points))
        first, second = (_tree_and_normals(points[order[k::2]]) for k in (0, 1))
        return cls(points, cloud, tree, spacing, (first, second))

    def halved(self, distance_m: float | None) -> list[float]:
        """Distances from `distance_m`, None being 12 spacings, halved down to 1.5 spacings."""
        last = FINAL_SPACINGS * self.spacing
        distances = [max(last, START_SPACINGS * self.spacing if distance_m is None else distance_m)]
        while distances[-1] > last:
            distances.append(max(last, distances[-1] / 2))
        return distances


def _tree_and_normals(points: Array) -> tuple[Any, Array]:
    """The search tree of points (m, 3), and their normals (m, 3)."""
    import open3d as o3d

    cloud = _cloud(points)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS // 2))
    return cKDTree(points), np.asarray(cloud.normals)


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


def _checked(source: ArrayLike, target: ArrayLike) -> tuple[Array, Array, _Middles]:
    """The clouds moved to their middles, and these."""
    clouds = checked_array("source", source, None, 3), checked_array("target", target, None, 3)
    for name, points in zip(("source", "target"), clouds, strict=True):
        if points.ndim != 2:
            raise ValueError(f"expected {name} of shape (n, 3), got {points.shape}.")
        check_distinct(name, points, LEAST_POINTS, "a registration")
    middles = _Middles(*(_middle(points) for points in clouds))
    return clouds[0] - middles.source, clouds[1] - middles.target, middles


def _middle(points: Array) -> Array:
    """(3,) of the points; 0 where they are near the origin, as they are then solved as well as they stand."""
    middle, extent = points.mean(axis=0), np.linalg.norm(np.ptp(points, axis=0))
    return np.asarray(middle if np.linalg.norm(middle) > FAR_EXTENTS * extent else np.zeros(3))


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
            "plane, a sphere, a cylinder; add points of another shape to the clouds, such as what they stand on."
        )


def _refuse_disagreement(found: Registration, source: Array, surface: _Surface) -> None:
    """Raise ValueError where the partners lie further from each other than the noise of the clouds."""
    if found.agreement >= MIN_AGREEMENT * found.fitness:
        return
    # noise above the spacing, as of a scan on a dense model, lowers the agreement of the right pose too
    scale = max(surface.spacing, *(_roughness(points, surface.spacing) for points in (source, surface.points)))
    T = found.T_target_source
    moved = source @ T[:3, :3].T + T[:3, 3]
    distance, partner = surface.tree.query(moved, distance_upper_bound=PARTNER_SPACINGS * surface.spacing)
    has = np.isfinite(distance)
    n = np.asarray(surface.cloud.normals)[partner[has]]
    off = ((moved[has] - surface.points[partner[has]]) * n).sum(axis=-1)
    agreement = float(np.maximum(-1, 1 - (off / scale) ** 2).mean())
    if agreement < MIN_AGREEMENT:
        raise ValueError(
            f"expected surfaces that lie on each other, got partners {found.rms_m:.3g} m apart along the normals, an "
            f"agreement of {agreement:.2f}, below {MIN_AGREEMENT:g}: a wrong pose, another shape or scale, or noise "
            "far above the spacing; start nearer, check the scale, or thin the clouds."
        )


def _refuse_slid(found: Registration, guess: Array, source: Array, surface: _Surface, reach: float) -> None:
    """Raise ValueError where the source, slid along the surface, comes to lie as well, or better beyond the reach.

    It is slid in the two directions in which the surface holds it least, by up to twice the reach: a guess that is off
    by one rib of many ends at a neighbour of the right one.
    """
    T = found.T_target_source
    few = source[np.random.default_rng(0).permutation(len(source))[:SLID_POINTS]]
    best = _judged(few, surface, T)
    if best.agreement <= 0:  # noise above the spacing: without a partner a point agrees better
        return
    moved = few @ T[:3, :3].T + T[:3, 3]
    distance, partner = surface.tree.query(moved, distance_upper_bound=PARTNER_SPACINGS * surface.spacing)
    n = np.asarray(surface.cloud.normals)[partner[np.isfinite(distance)]]
    steps = min(MAX_SLIDES, int(np.ceil(2 * reach / (SLIDE_SPACINGS * surface.spacing))))
    others = []
    for axis in np.linalg.eigh(n.T @ n)[1].T[:2]:
        for part in np.arange(-steps, steps + 1) / steps:
            slid = T.copy()
            slid[:3, 3] += 2 * part * reach * axis
            if part:
                others.append(_refined(few, surface, slid, SLIDE_SPACINGS * surface.spacing))
    given = _judged(few, surface, guess)
    _refuse_others(
        best,
        [
            other
            for other in others
            if other.fitness >= AS_GOOD * best.fitness
            and (other.agreement > best.agreement / AS_GOOD or _distance(given, other, few) <= reach)
        ],
        few,
        surface,
    )


def _roughness(points: Array, spacing: float) -> float:
    """Distance in metres of neighbours along the normals of their cloud, thinned to a spacing: noise, or curvature."""
    import open3d as o3d

    points = np.random.default_rng(0).permutation(points)
    while len(points) >= 2 * LEAST_POINTS and np.median(cKDTree(points).query(points, k=2)[0][:, 1]) < spacing:
        points = points[: len(points) // 2]
    cloud = _cloud(points)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    partner = cKDTree(points).query(points, k=NORMAL_NEIGHBOURS)[1][:, 1:]
    off = ((points[partner] - points[:, None]) * np.asarray(cloud.normals)[:, None]).sum(axis=-1)
    return sigma_from_median(off)


def _refuse_others(best: Registration, tried: list[Registration], source: Array, surface: _Surface) -> None:
    for other in tried:
        far = _distance(best, other, source) > 2 * PARTNER_SPACINGS * surface.spacing
        if far and other.agreement >= AS_GOOD * best.agreement:
            relative = _relative(best, other)
            angle = np.degrees(Rotation.from_matrix(relative[:3, :3]).magnitude())
            raise ValueError(
                f"expected clouds that fit in one way, got two poses {angle:.0f} degrees and "
                f"{_distance(best, other, source):.3g} m apart that both fit (agreement {best.agreement:.3f} and "
                f"{other.agreement:.3f}): what both clouds show is symmetric, or too little; scan with more overlap, "
                "or give icp a nearer guess and a smaller max_distance_m."
            )


def _cloud(points: Array) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def _refined(source: Array, surface: _Surface, start: Array, distance_m: float) -> Registration:
    """Result of ICP from one start, with a distance that is halved down to 1.5 spacings; whatever it is worth."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    method = registration.TransformationEstimationPointToPlane()
    criteria = registration.ICPConvergenceCriteria(1e-9, 1e-9, 60)
    cloud, T = _cloud(source), np.array(start)
    for distance in surface.halved(distance_m):
        T = registration.registration_icp(cloud, surface.cloud, distance, T, method, criteria).transformation
    return _judged(source, surface, np.array(T))


def _judged(source: Array, surface: _Surface, T: Array) -> Registration:
    moved, reach = source @ T[:3, :3].T + T[:3, 3], PARTNER_SPACINGS * surface.spacing
    distance, partner = surface.tree.query(moved, distance_upper_bound=reach)
    has = np.isfinite(distance)
    other = np.isfinite(cKDTree(moved).query(surface.points, distance_upper_bound=reach)[0])
    if has.sum() < 3:  # nothing that holds a pose, nor a size to measure turns by
        return Registration(T, 0.0, float(other.mean()), float("nan"), 0.0, 0.0)
    n = np.asarray(surface.cloud.normals)[partner[has]]
    off = ((moved[has] - surface.points[partner[has]]) * n).sum(axis=-1)
    # Gelfand, Ikemoto, Rusinkiewicz, Levoy: "Geometrically stable sampling for the ICP algorithm", 2003; but as the
    # product of two estimates of the normals: errors of one alone would seem to hold what slides
    arm = moved[has] - moved[has].mean(axis=0)
    arm /= np.sqrt((arm**2).sum(axis=-1).mean())
    first, second = (normals[tree.query(moved[has])[1]] for tree, normals in surface.halves)
    second = np.where((first * second).sum(axis=-1, keepdims=True) < 0, -second, second)
    a, b = (np.hstack([np.cross(arm, normals), normals]) for normals in (first, second))
    values = np.linalg.eigvalsh(a.T @ b + b.T @ a)
    return Registration(
        T_target_source=T,
        fitness=float(has.mean()),
        target_fitness=float(other.mean()),
        rms_m=float(np.sqrt((off**2).mean())),
        constraint=float(max(values[0], 0) / values[-1]),
        agreement=float(np.maximum(-1, 1 - (off / surface.spacing) ** 2).sum() / len(source)),
    )


def _feature_poses(source: Array, surface: _Surface, seed: int) -> list[Array]:
    """(4, 4) poses that the matches of features propose, one of each run."""
    import open3d as o3d

    extent = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    voxel = max(FEATURE_SPACINGS * surface.spacing, MIN_FEATURE_FRACTION * extent)
    few, features = [], []
    for points in (source, surface.points):
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
