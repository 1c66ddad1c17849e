# SPDX-License-Identifier: Apache-2.0
"""Registration of two point clouds: iterative closest points (ICP), and registration without a first guess, by Open3D.

A failed registration looks like a successful one. So every case that could be a failure raises ValueError: too few
points have a partner; the surfaces can slide on each other (a plane, a sphere, a cylinder); two poses fit equally well
(a symmetric part, or too small an overlap); or the surfaces lie across each other (another part, another scale).

A "spacing" below is the median distance of a point of the target from its nearest neighbour.

Used by: rangesim.fusion.multiway_registration; rangesim.multiview.bundle_adjustment (`nearest_similarity`).
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

MIN_POINTS = 20
"""Least number of different points of a cloud. It is equal to `NORMAL_NEIGHBOURS`, so that every normal has all its
neighbours."""

PARTNER_SPACINGS = 3.0
"""Distance, in spacings, within which a point has a partner when a pose is judged. Chosen so that few points have no
partner by chance: on a randomly sampled surface their fraction is 0.5^(d^2) at d spacings, 0.2 % at 3. A larger value
finds partners on other surfaces."""

FINAL_SPACINGS = 1.5
"""Distance of partners, in spacings, in the last steps of ICP. The smaller it is, the weaker is the pull of points
beyond the border of the other cloud. On a randomly sampled surface 21 % of the points have no partner at 1.5 spacings,
and half of them at 1."""

START_SPACINGS = 12.0
"""Distance of partners, in spacings, in the first steps of `icp` by default: the first guess may be off by about this
distance. Chosen as three halvings above `FINAL_SPACINGS`; a larger value reaches farther, but pulls clouds that overlap
only in part over each other."""

NORMAL_NEIGHBOURS = 20
"""Number of neighbours from which the normal of a point is estimated. With more neighbours, more noise is averaged, but
edges are rounded off, as in any estimate of normals. Either half of a cloud uses half as many neighbours, which reach
as far."""

MIN_CONSTRAINT = 3e-3
"""Ratio of the smallest to the largest eigenvalue of the normal equations, below which the surfaces can slide.
Measured: at most 0.0019 for planes, spheres, cylinders, cones and roofs of 600 and 2500 points with noise up to their
spacing; 0.0008 to 0.012 for tables with things on them, 0.2 for a box."""

FEATURE_SPACINGS = 5.0
"""Edge of the voxels for features and for the samples of RANSAC, in spacings. A voxel then holds about 25 points of a
regularly sampled surface, 5 of a random one, so that noise averages; larger voxels lose small shapes."""

MIN_FEATURE_FRACTION = 0.02
"""Least edge of these voxels, as a fraction of the extent of the target. So there are at most a few thousand voxels,
which are enough and take little time."""

ATTEMPTS = 4
"""Number of times that RANSAC runs, each time with its own seed, because one run can miss the pose. The time grows with
it."""

COMPARED_POINTS = 3000
"""Largest number of points of the source with which poses are compared in `register`. With more, `icp` from each of the
starts takes longer; the chosen pose is refined with all points in any case."""

MIN_AGREEMENT = 0.45
"""Least mean of 1 - (d / s)^2, a ratio, over the points with a partner; d is their distance along the normal, s the
spacing, or the roughness of a cloud if that is larger. Measured: 0.47 to 0.96 for correct poses, but 0.37 for a scan
ten times as dense as the target with noise above the target's spacing; -0.1 to 0.44 for corrugated plates that lie
askew and for parts 5 or 10 % off in scale."""

FAR_EXTENTS = 5.0
"""Distance of a cloud from the origin, as a ratio to its extent, beyond which the cloud is moved to the origin before
the registration. At 5 extents a turn of 0.2 rad about the origin moves a cloud by its whole extent, so steps of ICP are
neither small nor exact. Nearer clouds are not moved, so that their results stay the same to the last digit."""

SLIDE_SPACINGS = 6.0
"""Step, in spacings, by which a result of `icp` is slid along the surface to look for other poses. ICP then starts
there with the same reach, so that the reaches of neighbouring starts overlap. Steps of more than twice the reach would
leave gaps; shorter steps take more runs of ICP."""

MAX_SLIDES = 6
"""Largest number of such steps to either side, because each takes one run of ICP. If these steps do not cover the
reach, they become longer."""

SLID_POINTS = 800
"""Number of points of the source that are slid. With 800 instead of 3000 points `icp` takes 1.5 times the time that it
takes without this test, and the same poses are found (measured)."""

NEARLY_BEST = 0.95
"""Smallest ratio of an agreement to the best one at which another pose fits as well. Nobody measured the value: a
larger ratio misses symmetric shapes whose noise makes one pose better by chance; a smaller one refuses sound
results."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The pose of a source cloud in a target cloud, with measures of its quality.

    Attributes
    ----------
    T_target_source : (4, 4) float64, maps source coordinates to target coordinates, metres.
    fitness : fraction of the source points that have a target point within 3 spacings.
    target_fitness : fraction of the target points that have a source point within 3 spacings. Both together say how far
        the clouds overlap.
    rms_m : root mean square distance of the source points from their partners, along the normals of the target, metres.
    constraint : ratio of the smallest to the largest eigenvalue of the normal equations, with turns in units of the
        size of the cloud. A small ratio means that the surfaces can slide on each other.
    agreement : mean over all source points of 1 - (d / spacing)^2, but at least -1, where d is the distance from the
        partner along its normal; a point without a partner counts 0. So a pose that puts two surfaces beside each
        other has a smaller agreement than one that leaves them apart. The best pose is the one with the largest value.

    Examples
    --------
    `icp` and `register` return one; here it is made by hand:

    >>> import numpy as np
    >>> found = Registration(np.eye(4), 0.9, 0.8, rms_m=1e-4, constraint=0.2, agreement=0.85)
    >>> found.fitness
    0.9
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
    """The pose of the source in the target, refined from a first guess by iterative closest points (ICP).

    ICP is Open3D's, point to plane (Chen, Medioni 1992): it minimises the distances of source points from the tangent
    planes of their nearest target points, within a distance that is halved from `max_distance_m` down to 1.5 spacings
    of the target. It runs again from half of `max_distance_m`, from a quarter and so on, and the result with the best
    agreement counts: a large distance reaches far, but pulls clouds that overlap only in part over each other. The
    result is then slid along the surface. If it fits as well there, as with one rib of many, it is refused.

    The clouds may lie far from the origin, as map coordinates do. The function then works with the origin in their
    middles.

    Parameters
    ----------
    source, target : (n, 3) and (m, 3) points, metres, each in its own coordinates.
    T_target_source : (4, 4) first guess, maps source coordinates to target coordinates; None means the identity.
    max_distance_m : largest distance between partners in the first steps, metres; None means 12 spacings of the target.
    min_fitness : least fraction of the source points with a partner at the end.

    Raises
    ------
    ValueError
        A cloud has fewer than 20 different points, fewer points than `min_fitness` have a partner, the surfaces slide
        on each other or lie across each other, or another pose fits nearly as well.

    Examples
    --------
    >>> import numpy as np
    >>> def corner(seed):  # points on three faces of a box, metres
    ...     points = np.random.default_rng(seed).uniform(0, 1, (300, 3))
    ...     points[np.arange(300), np.arange(300) % 3] = 0
    ...     return points * [0.3, 0.2, 0.1]
    >>> icp(corner(0), corner(1) + [0.02, 0.01, 0]).T_target_source[:3, 3].round(2) + 0.0
    array([0.02, 0.01, 0.  ])
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
    """The pose of the source in the target without a first guess, by RANSAC over point features and then ICP.

    The features are fast point feature histograms (FPFH: Rusu, Blodow, Beetz 2009) of both clouds at voxels of 5
    spacings, or of a fiftieth of the target's extent if that is larger. Three matches make a pose (Open3D's
    `registration_ransac_based_on_feature_matching`). The results of four runs, and the best one turned by 90, 180 and
    270 degrees about the target's principal axes, are refined by ICP. The one with the best agreement counts. The same
    seed gives the same result, up to the rounding of Open3D's parallel sums.

    Parameters
    ----------
    source, target : (n, 3) and (m, 3) points, metres, each in its own coordinates.
    min_fitness : least fraction of the source points with a partner at the end.
    seed : state of the random numbers of RANSAC.

    Raises
    ------
    ValueError
        `icp` would refuse the result; or another pose fits nearly as well, because the shape is symmetric or has too
        little detail to distinguish its sides.

    Examples
    --------
    >>> import numpy as np
    >>> def corner(seed):  # points on three faces of a box, metres
    ...     points = np.random.default_rng(seed).uniform(0, 1, (300, 3))
    ...     points[np.arange(300), np.arange(300) % 3] = 0
    ...     return points * [0.3, 0.2, 0.1]
    >>> register(corner(0), corner(1) + [0.5, 1, 0]).T_target_source[:3, 3].round(2) + 0.0
    array([0.5, 1. , 0. ])
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
    """(4, 4) float64 T_target_source: the scale, rotation and translation that bring points nearest to their partners.

    It minimises the sum of squared distances in closed form (Umeyama, PAMI 1991).

    Parameters
    ----------
    source, target : (n, 3) points in one unit; rows correspond.
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    T = np.eye(4)
    T[:3, :3] = (values * signs).sum() / max((a**2).sum(), 1e-300) * (u * signs) @ vt
    T[:3, 3] = target.mean(axis=0) - T[:3, :3] @ source.mean(axis=0)
    return T


class _Middles(NamedTuple):
    """The points (3,) of the source and of the target, metres, that become the origin before the clouds are solved.

    The point is 0 for a cloud that is near the origin already. A turn about a far origin moves a cloud by metres, so
    that the steps of ICP would be neither small nor exact.
    """

    source: Array
    target: Array

    def to_middles(self, T: Array) -> Array:
        """T_target_source (4, 4) between the moved clouds, from T between the clouds as given."""
        result = T.copy()
        result[:3, 3] = T[:3, :3] @ self.source + T[:3, 3] - self.target
        return result

    def from_middles(self, T: Array) -> Array:
        """T_target_source (4, 4) between the clouds as given, from T between the moved clouds."""
        result = T.copy()
        result[:3, 3] = T[:3, 3] + self.target - T[:3, :3] @ self.source
        return result


class _Surface(NamedTuple):
    """A target cloud prepared for registration.

    Attributes
    ----------
    points : (m, 3) metres.
    cloud : the points with normals, as Open3D's point cloud.
    tree : search tree of the points.
    spacing : median distance of a point from its nearest neighbour, metres.
    halves : search tree and normals (m / 2, 3) of each random half of the points. The errors of both estimates of the
        normals are independent.
    """

    points: Array
    cloud: Any
    tree: Any
    spacing: float
    halves: tuple[tuple[Any, Array], tuple[Any, Array]]

    @classmethod
    def of(cls, points: Array) -> _Surface:
        """The prepared target of points (m, 3), metres."""
        import open3d as o3d

        tree = cKDTree(points)
        cloud = _cloud(points)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
        spacing = float(np.median(tree.query(points, k=2)[0][:, 1]))
        order = np.random.default_rng(0).permutation(len(points))
        first, second = (_tree_and_normals(points[order[k::2]]) for k in (0, 1))
        return cls(points, cloud, tree, spacing, (first, second))

    def halved(self, distance_m: float | None) -> list[float]:
        """Distances in metres from `distance_m`, halved down to 1.5 spacings; None stands for 12 spacings."""
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
    """The agreement of a registration, as a key for `max`."""
    return found.agreement


def _turned(T: Array, source: Array, target: Array) -> list[Array]:
    """Nine poses (4, 4): T followed by turns of 90, 180 and 270 degrees about each principal axis of the target.

    The axes go through the middle of the moved source.
    """
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
    """The clouds (n, 3) and (m, 3), moved if they lie far from the origin, and how they were moved."""
    clouds = checked_array("source", source, None, 3), checked_array("target", target, None, 3)
    for name, points in zip(("source", "target"), clouds, strict=True):
        if points.ndim != 2:
            raise ValueError(f"expected {name} of shape (n, 3), got {points.shape}.")
        check_distinct(name, points, MIN_POINTS, "a registration")
    middles = _Middles(*(_middle(points) for points in clouds))
    return clouds[0] - middles.source, clouds[1] - middles.target, middles


def _middle(points: Array) -> Array:
    """(3,) mean of the points (n, 3), metres; 0 if they are near the origin, because they need not be moved then."""
    middle, extent = points.mean(axis=0), np.linalg.norm(np.ptp(points, axis=0))
    return np.asarray(middle if np.linalg.norm(middle) > FAR_EXTENTS * extent else np.zeros(3))


def _check_fraction(min_fitness: float) -> None:
    """Raise ValueError unless the fraction is above 0 and at most 1."""
    if not 0 < min_fitness <= 1:
        raise ValueError(f"expected min_fitness as a fraction, above 0 and at most 1, got {min_fitness!r}.")


def _refuse_failure(found: Registration, min_fitness: float, hint: str) -> None:
    """Raise ValueError if too few source points have a partner, or if the surfaces can slide on each other."""
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
    """Raise ValueError if partners lie farther from each other than the noise of the clouds explains."""
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
    """Raise ValueError if the source fits as well after it was slid along the surface.

    It is slid in the two directions in which the surface constrains it least, by up to twice the reach, because a guess
    that is off by one rib of many ends at a neighbour of the correct one. A pose farther than the reach from the guess
    counts only if it fits better.

    Parameters
    ----------
    found : result of `icp`, with the clouds `source` (n, 3) and `surface`.
    guess : (4, 4) first guess T_target_source.
    reach : largest distance in metres by which the guess may be off.
    """
    T = found.T_target_source
    few = source[np.random.default_rng(0).permutation(len(source))[:SLID_POINTS]]
    best = _judged(few, surface, T)
    if best.agreement <= 0:  # with noise above the spacing, a point without a partner agrees better than one with it
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
            if other.fitness >= NEARLY_BEST * best.fitness
            and (other.agreement > best.agreement / NEARLY_BEST or _distance(given, other, few) <= reach)
        ],
        few,
        surface,
    )


def _roughness(points: Array, spacing: float) -> float:
    """Typical distance in metres of neighbours from each other along their normals, from noise or curvature.

    The cloud (n, 3) is thinned to a spacing in metres first. The distance is the standard deviation of Gaussian noise
    with the same median absolute distance.
    """
    import open3d as o3d

    points = np.random.default_rng(0).permutation(points)
    while len(points) >= 2 * MIN_POINTS and np.median(cKDTree(points).query(points, k=2)[0][:, 1]) < spacing:
        points = points[: len(points) // 2]
    cloud = _cloud(points)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    partner = cKDTree(points).query(points, k=NORMAL_NEIGHBOURS)[1][:, 1:]
    off = ((points[partner] - points[:, None]) * np.asarray(cloud.normals)[:, None]).sum(axis=-1)
    return sigma_from_median(off)


def _refuse_others(best: Registration, tried: list[Registration], source: Array, surface: _Surface) -> None:
    """Raise ValueError if one of the tried poses is far from the best one and agrees nearly as well."""
    for other in tried:
        far = _distance(best, other, source) > 2 * PARTNER_SPACINGS * surface.spacing
        if far and other.agreement >= NEARLY_BEST * best.agreement:
            relative = _relative(best, other)
            angle = np.degrees(Rotation.from_matrix(relative[:3, :3]).magnitude())
            raise ValueError(
                f"expected clouds that fit in one way, got two poses {angle:.0f} degrees and "
                f"{_distance(best, other, source):.3g} m apart that both fit (agreement {best.agreement:.3f} and "
                f"{other.agreement:.3f}): what both clouds show is symmetric, or too little; scan with more overlap, "
                "or give icp a nearer guess and a smaller max_distance_m."
            )


def _cloud(points: Array) -> Any:
    """Points (n, 3) as Open3D's point cloud."""
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def _refined(source: Array, surface: _Surface, start: Array, distance_m: float) -> Registration:
    """The result of ICP from one start, judged but not refused; the distance is halved down to 1.5 spacings."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    method = registration.TransformationEstimationPointToPlane()
    criteria = registration.ICPConvergenceCriteria(1e-9, 1e-9, 60)
    cloud, T = _cloud(source), np.array(start)
    for distance in surface.halved(distance_m):
        T = registration.registration_icp(cloud, surface.cloud, distance, T, method, criteria).transformation
    return _judged(source, surface, np.array(T))


def _judged(source: Array, surface: _Surface, T: Array) -> Registration:
    """The quality of the pose T (4, 4) of the source (n, 3) on the target."""
    moved, reach = source @ T[:3, :3].T + T[:3, 3], PARTNER_SPACINGS * surface.spacing
    distance, partner = surface.tree.query(moved, distance_upper_bound=reach)
    has = np.isfinite(distance)
    other = np.isfinite(cKDTree(moved).query(surface.points, distance_upper_bound=reach)[0])
    if has.sum() < 3:  # too few partners to constrain a pose, or to give a size in which turns are measured
        return Registration(T, 0.0, float(other.mean()), float("nan"), 0.0, 0.0)
    n = np.asarray(surface.cloud.normals)[partner[has]]
    off = ((moved[has] - surface.points[partner[has]]) * n).sum(axis=-1)
    # Constraint by Gelfand, Ikemoto, Rusinkiewicz, Levoy: "Geometrically stable sampling for the ICP algorithm", 2003,
    # but as the product of two independent estimates of the normals: with one estimate alone, its errors would look
    # like a constraint on surfaces that slide
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
    """Poses (4, 4) that RANSAC finds from matches of features, one from each run that has a result."""
    import open3d as o3d

    extent = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    voxel = max(FEATURE_SPACINGS * surface.spacing, MIN_FEATURE_FRACTION * extent)
    few, features = [], []
    for points in (source, surface.points):
        cloud = _cloud(points).voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        cloud.orient_normals_towards_camera_location(cloud.get_center())  # which does not depend on the pose
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
    """(4, 4) motion of the source from the first pose to the second, in source coordinates."""
    return np.asarray(np.linalg.inv(first.T_target_source) @ second.T_target_source)


def _distance(first: Registration, second: Registration, source: Array) -> float:
    """Root mean square distance in metres between the source points (n, 3) under two poses."""
    T = _relative(first, second)
    return float(np.sqrt(((source @ T[:3, :3].T + T[:3, 3] - source) ** 2).sum(axis=-1).mean()))
