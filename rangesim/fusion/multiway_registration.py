# SPDX-License-Identifier: Apache-2.0
"""Multiway registration: finds the poses of a scan's views, from pairs of views and a pose graph over all of them.

1. Planes that contain more than half of a view's readings (a table, a wall) are removed, because a plane can
   slide on itself, so that it fits in many poses.
2. Chain: each view is registered to the view before it, without a first guess (`rangesim.geometry.register`). If that
   fails, the two views before that one are tried.
3. Loops: every other pair of views that overlaps according to the chain is refined by `rangesim.geometry.icp`. If
   the pose of a pair ends far from the chain, the pair fits a wrong surface and is left out.
4. Pose graph: the poses that fit all pairs best, each weighted with its information matrix (Choi, Zhou, Koltun: "Robust
   reconstruction of indoor scenes", CVPR 2015; Open3D's `global_optimization`):

       minimise  sum over pairs (i, j)  r_ij^T Lambda_ij r_ij,     r_ij = log(T_ij^-1 T_j^-1 T_i)

   Loops that disagree with the graph are left out. A pair of the chain that disagrees is an error.
5. Joint fit of all readings (`rangesim.fusion.joint_registration`).
6. Check: a view that looks through a surface which another view measured is an error.

Degenerate cases raise a ValueError that names the views: surfaces that slide on themselves (a vase, a ball, a plane),
objects that fit in two ways (symmetric ones), and too little overlap. A constant scale error of the sensor cannot be
detected.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rangesim.decoding.range_image import RangeImage
from rangesim.errors import AlignmentWarning
from rangesim.fusion.joint_registration import refine_jointly
from rangesim.fusion.posed_images import Scan
from rangesim.fusion.sdf import signed_distance
from rangesim.fusion.virtual_cameras import local_views, pinhole_views
from rangesim.geometry import icp, register
from rangesim.rig import Array
from rangesim.settings.bounds import check_number
from rangesim.settings.bounds import whole as whole_number
from rangesim.settings.config import ShortRepr, shown

POINTS_PER_VIEW = 4000
"""Approximate number of points of each view that are registered, if no spacing is given. More points take longer; with
fewer, the small features that determine a pose are lost."""
MIN_POINTS = 200
"""Smallest number of points of a view, because fewer rarely show enough of a shape to find its pose."""
DOMINANT_FRACTION = 0.5
"""A plane is removed if it has at least this fraction of a view's points. It has to be the majority: a smaller plane
does not prevent the registration of the rest."""
MAX_PLANES = 3
"""Largest number of planes that are removed from a view: a corner of a room has three. A view with more dominant planes
than that has no object left."""
MAX_STEPS_BACK = 3
"""Number of views before a view to which this view may be registered. More could bridge a longer gap, but each failed
registration takes seconds (docs/fusion.md)."""
MIN_OVERLAP = 0.3
"""Smallest fraction of the smaller view's points that lie on the other view, for a pair in the chain. It is a little
below the third that `align` asks for, so that views taken as asked are not refused."""
NEAR_SPACINGS = 6.0
"""Distance, in spacings of the points, within which points of two views belong to one surface when the chain places the
views. It is large because errors add up along the chain."""
MIN_LOOP_OVERLAP = 0.5
"""Smallest overlap of a loop, as a fraction like `MIN_OVERLAP`. Pairs with less overlap pull each other's borders
together, and add little, because the chain already links the views."""
MAX_DISAGREEMENT_SPACINGS = 2.0
"""Largest disagreement of a pair with the pose graph, in spacings of the points, root mean square over the pair's
points. A larger limit keeps wrong loops; a smaller one leaves out good ones, because ICP is exact to a fraction of the
spacing only."""
THROUGH_SPACINGS = 4.0
"""Distance, in spacings of the points, by which a point has to be in front of another view's surface to contradict it.
To this, 1 % of the depth is added. It is large because readings are noisy and poses have errors."""
MAX_CONTRADICTION = 0.15
"""Largest fraction of a view's points that another view may look through. It is not zero because edges and ghosts are
looked through, too; a wrong pose makes it large."""
EARLY_SPACINGS = (1.0, 0.8, 1.25)
"""Spacings at which `check_first_pair` tries the first two views, as multiples of the spacing of these two. The spacing
of a whole scan differs from it by less."""

ORDER = "Views are expected in the order of a walk, each overlapping the one before by a third or more."
"""Advice about the order of views, in error messages."""
REMEDY = f"add views between, or scan something that looks different from all sides. {ORDER}"
"""Advice for views that do not fit, in error messages."""


class PairFit(NamedTuple):
    """Pair of views that was registered.

    source, target : numbers of the views.
    T_target_source : (4, 4) float64, metres, pose of the source in the target's camera coordinates.
    overlap : fraction of the source's points that lie on the target.
    disagreement_m : metres, root mean square distance between the source's points placed by this pair and placed by the
        pose graph.
    is_loop : True for a loop, False for a pair of the chain.
    """

    source: int
    target: int
    T_target_source: Array
    overlap: float
    disagreement_m: float
    is_loop: bool


@dataclass(frozen=True, eq=False, repr=False)
class Alignment(ShortRepr):
    """Result of `align`: the views of a scan with their poses.

    scan : the views with the poses that were found. The first view keeps its pose, which defines the world.
    pairs : the pairs of views from which the poses follow.
    spacing_m : metres, distance between the points that were registered.
    unchecked : numbers of the views that are in no loop: their pose follows from a single pair, which nothing confirms.
    """

    scan: Scan
    pairs: tuple[PairFit, ...]
    spacing_m: float
    unchecked: tuple[int, ...]

    @property
    def poses(self) -> Array:
        """Poses of all views, T_world_camera: (n, 4, 4) float64, metres."""
        return self.scan.poses


def align(scan: Scan, spacing_m: float | None = None, *, seed: int = 0) -> Alignment:
    """Alignment of a scan: the poses of its views, found from their readings alone.

    The docstring of this module lists the steps. `align` uses no pose of the images, except the first one. Views must
    come in the order of a walk, each overlapping the view before by a third or more. If the object turns, everything
    that does not turn with it (a table) must be removed from the images.

    Parameters
    ----------
    scan : the views in order.
    spacing_m : metres, distance between the points that are registered; None: a view has about 4000 points.
    seed : seed of the random samples; the same seed gives the same poses, up to the rounding of Open3D's parallel sums.

    Raises
    ------
    ValueError
        Fewer than two views, a view with fewer than 200 points, a view that fits none of the three before, pairs that
        contradict each other, or poses in which a view looks through a surface that another measured.

    Warns
    -----
    AlignmentWarning
        A view is in no loop. With two views this is always so.

    Examples
    --------
    >>> from rangesim.fusion import align, fuse
    >>> aligned = align(scan)  # doctest: +SKIP
    >>> fused = fuse(aligned.scan.images, voxel_m=0.002)  # doctest: +SKIP
    """
    if len(scan) < 2:
        raise ValueError(f"expected two views or more to align, got {len(scan)}.")
    check_number("seed", seed, whole_number(0))
    clouds, spacing = _registered_points(scan, spacing_m, seed)
    chain = _chain(clouds, seed)
    placed = _placed(chain, len(clouds))
    edges = chain + _loops(clouds, placed, spacing, {(e.source, e.target) for e in chain})
    while True:
        placed = _optimised(clouds, placed, edges, spacing)
        pairs = tuple(e._replace(disagreement_m=_disagreement(e, placed, clouds)) for e in edges)
        wrong = max((e for e in pairs if e.is_loop), key=lambda e: e.disagreement_m, default=None)
        if wrong is None or wrong.disagreement_m <= MAX_DISAGREEMENT_SPACINGS * spacing:
            break
        edges = [e for e in edges if (e.source, e.target) != (wrong.source, wrong.target)]
    _refuse_disagreement(pairs, spacing)
    world = np.asarray(scan.images[0].T_world_camera) @ np.linalg.inv(placed[0])
    first = scan.poses[0]
    aligned = scan.with_poses(np.stack([first, *(_rigid(world @ T) for T in placed[1:])]))
    aligned = scan.with_poses(
        np.stack(
            [_rigid(T) for T in refine_jointly(scan.images, aligned.poses, MAX_DISAGREEMENT_SPACINGS * spacing, seed)]
        )
    )
    _refuse_contradiction(aligned, clouds, spacing)
    unchecked = _unchecked(pairs, len(clouds))
    if unchecked:  # always with two views: nothing confirms their only pair
        views = ", ".join(map(str, unchecked))
        warnings.warn(AlignmentWarning(f"no loop confirms the pose of view {views}; add views between."), stacklevel=2)
    return Alignment(aligned, pairs, spacing, unchecked)


def check_first_pair(first_two: Scan, *, seed: int = 0) -> None:
    """Raise the ValueError that `align` of the whole scan would raise, if the second view does not fit on the first.

    The spacing of the whole scan is not known yet. So the spacing of the two views is tried, and then two others near
    it.
    """
    clouds, spacing = _registered_points(first_two, None, seed)
    problems = []
    for scale in EARLY_SPACINGS:
        try:
            _chain(clouds if scale == 1 else _registered_points(first_two, scale * spacing, seed)[0], seed)
            return
        except ValueError as error:
            problems.append(error)
    raise problems[0]


class PoseErrors(NamedTuple):
    """Errors of poses after the frames of found and true poses were aligned.

    angle_deg : (n,) float64, degrees, angle of the remaining rotation.
    centre_m : (n,) float64, metres, distance between the camera centres.
    """

    angle_deg: Array
    centre_m: Array


def pose_errors(poses: ArrayLike, true_poses: ArrayLike) -> PoseErrors:
    """Errors of poses against the true poses. The two may have different world coordinates.

    The two frames are aligned by the mean rotation of T_true T^-1 (Moakher 2002: the polar factor of the sum), and by
    the mean difference of the camera centres.

    Parameters
    ----------
    poses, true_poses : (n, 4, 4), T_world_camera, metres.

    Raises
    ------
    ValueError
        Shapes other than (n, 4, 4), or different numbers of poses.

    Examples
    --------
    A shift of the whole world is no error, but one camera of two that is 2 mm off is:

    >>> import numpy as np
    >>> from rangesim.fusion import pose_errors
    >>> true = np.stack([np.eye(4), np.eye(4)])
    >>> found = true.copy()
    >>> found[:, 0, 3] = 5.0, 5.002
    >>> pose_errors(found, true).centre_m.round(6).tolist()
    [0.001, 0.001]
    """
    found, true = np.asarray(poses, dtype=np.float64), np.asarray(true_poses, dtype=np.float64)
    if found.shape != true.shape or found.shape[1:] != (4, 4) or not len(found):
        raise ValueError(f"expected as many poses as true ones, (n, 4, 4), got {found.shape} and {true.shape}.")
    U, _, Vt = np.linalg.svd((true[:, :3, :3] @ np.swapaxes(found[:, :3, :3], 1, 2)).sum(axis=0))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    centres = found[:, :3, 3] @ R.T
    centres += (true[:, :3, 3] - centres).mean(axis=0)
    turn = np.swapaxes(true[:, :3, :3], 1, 2) @ R @ found[:, :3, :3]
    return PoseErrors(
        np.degrees(Rotation.from_matrix(turn).magnitude()), np.linalg.norm(centres - true[:, :3, 3], axis=-1)
    )


# ---- Steps ---------------------------------------------------------------------------------------------------------


def _registered_points(scan: Scan, spacing_m: float | None, seed: int) -> tuple[list[Array], float]:
    """Points of each view that are registered, and their spacing in metres.

    Dominant planes are removed, and one point is left in each cube of the spacing. Points are in camera coordinates.
    """
    if spacing_m is not None and not 0 < spacing_m < np.inf:
        raise ValueError(f"expected a positive spacing_m in metres, got {shown(spacing_m)}.")
    views = [local_views(image) for image in scan.images]
    every = [np.concatenate([np.zeros((0, 3)), *(_points(v) for v in parts)]) for parts in views]
    for number, cloud in enumerate(every):
        if len(cloud) < MIN_POINTS:
            raise ValueError(
                f"expected {MIN_POINTS} readings or more in each view to align, got {len(cloud)} in view {number}."
            )
    # The area of a surface is the number of its readings times the footprint of a pixel
    pixels = [
        float(np.median(np.concatenate([v.z[v.valid] for v in parts]))) ** 2
        / (parts[0].pinhole.fx * parts[0].pinhole.fy)
        for parts in views
    ]
    coarse = float(np.sqrt(np.median([a * len(c) for a, c in zip(pixels, every, strict=True)]) / POINTS_PER_VIEW))
    clouds = [_without_planes(cloud, spacing_m or coarse, seed) for cloud in every]
    if spacing_m is None:
        spacing_m = float(
            np.sqrt(np.median([a * len(c) for a, c in zip(pixels, clouds, strict=True)]) / POINTS_PER_VIEW)
        )
    thinned = []
    for number, cloud in enumerate(clouds):
        thinned.append(_one_in_each(cloud, spacing_m))
        if len(thinned[-1]) < MIN_POINTS:
            raise ValueError(
                f"expected a spacing_m that leaves {MIN_POINTS} points or more of each view, got {spacing_m:g} m, "
                f"which leaves {len(thinned[-1])} of view {number}."
            )
    return thinned, spacing_m


def _points(image: RangeImage) -> Array:
    """Readings of an image (n, 3), metres, in the coordinates in which its pose is."""
    points = image.to_point_cloud("world").points.reshape(-1, 3).astype(np.float64)
    return points[np.isfinite(points).all(axis=1)]


def _without_planes(cloud: Array, spacing_m: float, seed: int) -> Array:
    """Points (n, 3) that are on no dominant plane; all points, if too few would be left."""
    import open3d as o3d

    left = cloud
    for _ in range(MAX_PLANES):
        few = _one_in_each(left, spacing_m)
        if len(few) < MIN_POINTS:
            return cloud
        o3d.utility.random.seed(seed)
        packed = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(few))
        (*normal, offset), on_it = packed.segment_plane(0.5 * spacing_m, 3, 500)
        if len(on_it) < DOMINANT_FRACTION * len(few):
            return left
        beside = left[np.abs(left @ np.array(normal) + offset) > 1.5 * spacing_m]
        if len(beside) < MIN_POINTS:
            return cloud
        left = beside
    return left


def _one_in_each(cloud: Array, spacing_m: float) -> Array:
    """Mean of the points in each cube of the spacing: (m, 3) float64, metres."""
    import open3d as o3d

    packed = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud))
    return np.asarray(packed.voxel_down_sample(spacing_m).points)


def _chain(clouds: list[Array], seed: int) -> list[PairFit]:
    """Pairs of the chain: each view registered to one of the views before it."""
    found = []
    for source in range(1, len(clouds)):
        reasons: dict[int, str] = {}
        for target in range(source - 1, max(-1, source - 1 - MAX_STEPS_BACK), -1):
            try:
                fit = register(clouds[source], clouds[target], min_fitness=MIN_OVERLAP, seed=seed)
            except ValueError as error:
                reasons[target] = str(error)
                continue
            found.append(PairFit(source, target, np.asarray(fit.T_target_source), fit.fitness, np.nan, False))
            break
        else:
            raise ValueError(f"view {source} cannot be aligned; {_why(reasons)} {ORDER}")
    return found


def _why(reasons: dict[int, str]) -> str:
    """Message that a view fits none of the views before it, with the reason for the nearest of them.

    reasons : message of the failed registration by number of the view, the nearest view first. The advice after a
    message's semicolon is left out, because it only holds for a single pair of clouds.
    """
    (nearest, reason), *others = reasons.items()
    what = reason.partition("; ")[0].rstrip(".")
    return f"on view {nearest}: {what}" + "".join(f", nor on {target}" for target, _ in others) + "."


def _placed(chain: list[PairFit], n: int) -> list[Array]:
    """Pose (4, 4) of each view in the coordinates of the first, from the pairs of the chain."""
    poses = [np.eye(4)] * n
    for edge in chain:
        poses[edge.source] = poses[edge.target] @ edge.T_target_source
    return poses


def _loops(clouds: list[Array], poses: list[Array], spacing: float, known: set[tuple[int, int]]) -> list[PairFit]:
    """Loops: pairs outside the chain that overlap when the chain places them, refined by ICP."""
    found = []
    trees = [cKDTree(c) for c in clouds]
    for target, source in combinations(range(len(clouds)), 2):
        if (source, target) in known:
            continue
        T = np.linalg.inv(poses[target]) @ poses[source]
        moved = clouds[source] @ T[:3, :3].T + T[:3, 3]
        near = np.isfinite(trees[target].query(moved, distance_upper_bound=NEAR_SPACINGS * spacing)[0]).sum()
        if near < MIN_LOOP_OVERLAP * min(len(clouds[source]), len(clouds[target])):
            continue
        try:
            fit = icp(
                clouds[source], clouds[target], T, max_distance_m=NEAR_SPACINGS * spacing, min_fitness=MIN_OVERLAP
            )
        except ValueError:
            continue  # the pair overlaps too little; `align` warns of views that are in no loop
        pair = PairFit(source, target, np.asarray(fit.T_target_source), fit.fitness, np.nan, True)
        if _disagreement(pair, poses, clouds) <= 2 * NEAR_SPACINGS * spacing:
            found.append(pair)
    return found


def _optimised(clouds: list[Array], poses: list[Array], edges: list[PairFit], spacing: float) -> list[Array]:
    """Poses (4, 4) of all views that fit all pairs best: the optimum of the pose graph."""
    import open3d as o3d

    r, reach = o3d.pipelines.registration, MAX_DISAGREEMENT_SPACINGS * spacing
    packed: list[Any] = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(c)) for c in clouds]
    graph = r.PoseGraph()
    for T in poses:
        graph.nodes.append(r.PoseGraphNode(T))
    for e in edges:
        information = r.get_information_matrix_from_point_clouds(
            packed[e.source], packed[e.target], reach, e.T_target_source
        )
        graph.edges.append(r.PoseGraphEdge(e.source, e.target, e.T_target_source, information, uncertain=False))
    r.global_optimization(
        graph,
        r.GlobalOptimizationLevenbergMarquardt(),
        r.GlobalOptimizationConvergenceCriteria(),
        r.GlobalOptimizationOption(max_correspondence_distance=reach, edge_prune_threshold=0.0, reference_node=0),
    )
    return [np.array(node.pose) for node in graph.nodes]


def _disagreement(edge: PairFit, poses: list[Array], clouds: list[Array]) -> float:
    """Root mean square distance in metres between the source's points placed by a pair and placed by poses."""
    by_graph = np.linalg.inv(poses[edge.target]) @ poses[edge.source]
    off = by_graph - edge.T_target_source
    return float(np.sqrt(((clouds[edge.source] @ off[:3, :3].T + off[:3, 3]) ** 2).sum(axis=-1).mean()))


def _refuse_disagreement(pairs: tuple[PairFit, ...], spacing: float) -> None:
    """Raise ValueError if a pair disagrees with the pose graph."""
    worst = max(pairs, key=lambda e: e.disagreement_m)
    if not worst.disagreement_m <= MAX_DISAGREEMENT_SPACINGS * spacing:
        raise ValueError(
            f"expected pairs of views that agree, but the pair {worst.target}, {worst.source} differs by "
            f"{1e3 * worst.disagreement_m:.2g} mm from the poses of all pairs (spacing {1e3 * spacing:.2g} mm): "
            f"one pair fits wrongly; {REMEDY}"
        )


def _refuse_contradiction(scan: Scan, clouds: list[Array], spacing: float) -> None:
    """Raise ValueError if a view looks through a surface that another view measured."""
    worst, pair = 0.0, (0, 0)
    views = [pinhole_views(image) for image in scan.images]
    for i, T in enumerate(scan.poses):
        world = clouds[i] @ T[:3, :3].T + T[:3, 3]
        for j, parts in enumerate(views):
            if i == j:
                continue
            typical_m = float(np.nanmedian(np.concatenate([v.z.ravel() for v in parts])))
            tolerance = THROUGH_SPACINGS * spacing + 0.01 * typical_m
            # Each point is seen by one part of a view
            through = sum(float((signed_distance(world, v) < -tolerance).mean()) for v in parts)  # False with NaN
            if through > worst:
                worst, pair = through, (i, j)
    if worst > MAX_CONTRADICTION:
        raise ValueError(
            f"expected poses in which no view sees through what another measured, but view {pair[1]} looks through "
            f"{worst:.0%} of view {pair[0]}: they fit wrongly; {REMEDY}"
        )


def _unchecked(pairs: tuple[PairFit, ...], n: int) -> tuple[int, ...]:
    """Numbers of the views that a single pair connects to the rest."""
    import networkx as nx

    graph = nx.Graph((e.source, e.target) for e in pairs)
    found: set[int] = set()
    for a, b in nx.bridges(graph):
        graph.remove_edge(a, b)
        found |= min(nx.node_connected_component(graph, a), nx.node_connected_component(graph, b), key=len)
        graph.add_edge(a, b)
    return tuple(sorted(found))


def _rigid(T: Array) -> Array:
    """Rigid transform nearest to a matrix (4, 4), which removes the rounding of products."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    result = np.array(T)
    result[:3, :3], result[3] = U @ Vt, (0, 0, 0, 1)
    return result
