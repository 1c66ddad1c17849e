# SPDX-License-Identifier: Apache-2.0
"""Where the views of a scan were taken from, when nobody knows: pairs of views, and a pose graph over all of them.

0. Planes that hold more than half of a view's readings (a table, a wall) are set aside: they slide on themselves.
1. Each view is registered to the one before without a first guess (`rangesim.geometry.register`), or, where that fails,
   to one of the three before: a chain.
2. Every other pair that overlaps by the chain is refined by `rangesim.geometry.icp`: loops.
   A pair that moves off far from the chain has found another surface, and is left out.
3. The pose graph takes the poses that fit all pairs best (Choi, Zhou, Koltun: "Robust reconstruction of indoor scenes",
   CVPR 2015; Open3D's `global_optimization`), each pair with its information matrix:

       minimise  sum over pairs (i, j)  r_ij^T Lambda_ij r_ij,     r_ij = log(T_ij^-1 T_j^-1 T_i)

4. All readings are fitted at once (`joint_registration`).
5. The result is checked: no pair of the chain may disagree with the graph, loops that do are left out, and no view may
have surface where another sees through.

Degenerate cases, each a ValueError that names the views: what slides on itself (a vase, a ball, a plane), what fits in
two ways (symmetric things), too little overlap. A constant scale error of the sensor cannot be seen.
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

from rangesim.errors import AlignmentWarning
from rangesim.fusion.joint_registration import refine_jointly
from rangesim.fusion.scan import Scan
from rangesim.fusion.sdf import signed_distance
from rangesim.geometry import icp, register
from rangesim.rig import Array
from rangesim.settings.bounds import check_number
from rangesim.settings.bounds import whole as whole_number
from rangesim.settings.config import ShortRepr, shown

POINTS = 4000
"""Of each view, about, that are registered, if no spacing is given."""
LEAST_POINTS = 200
"""Of a view."""
DOMINANT = 0.5
"""Fraction of a view's readings from which a plane is set aside."""
MAX_PLANES = 3
BACK = 3
"""Views before, that a view is registered to."""
MIN_OVERLAP = 0.3
"""Fraction of the smaller view's points that the other shows, for a pair to be registered."""
NEAR = 6.0
"""Spacings within which points of two views, placed by the chain, are of one surface."""
LOOP_OVERLAP = 0.5
"""The same for a loop: pairs with less pull each other's borders together, and add little."""
CONSISTENT = 2.0
"""Spacings by which a pair may disagree with the graph, root mean square over its points."""
THROUGH = 4.0
"""Spacings in front of another view's surface from which a point contradicts it, besides 1 % of the depth."""
MAX_CONTRADICTION = 0.15
"""Fraction of the points of a view that another may see through: edges and ghosts, not a wrong pose."""
EARLY_SPACINGS = (1.0, 0.8, 1.25)
"""Spacings at which the first two views of a scan are tried, over their own: those of a whole scan differ by less."""

ORDER = "Views are expected in the order of a walk, each overlapping the one before by a third or more."
REMEDY = f"add views between, or scan something that looks different from all sides. {ORDER}"


class PairFit(NamedTuple):
    """Two views that were registered.

    source, target : numbers of the views. T_target_source : (4, 4). overlap : fraction of the source's points on the
    target. disagreement_m : root mean square distance of the source's points under the pair's pose and the graph's.
    is_loop : whether it closes a loop, beside the chain.
    """

    source: int
    target: int
    T_target_source: Array
    overlap: float
    disagreement_m: float
    is_loop: bool


@dataclass(frozen=True, eq=False, repr=False)
class Alignment(ShortRepr):
    """Poses that were found.

    scan : the views with them; the first keeps the pose it had, which is the world. pairs : what they were found from.
    spacing_m : between the points that were registered. unchecked : numbers of views that no loop holds, so that
    nothing confirms their pose but the registration of one pair.
    """

    scan: Scan
    pairs: tuple[PairFit, ...]
    spacing_m: float
    unchecked: tuple[int, ...]

    @property
    def poses(self) -> Array:
        """(n, 4, 4) float64, T_world_camera."""
        return self.scan.poses


def align(scan: Scan, spacing_m: float | None = None, *, seed: int = 0) -> Alignment:
    """Finds the poses of a scan's views from their readings alone; the head of this module says how.

    The poses that the images have are not looked at, but for the first one's. Views come in the order of a walk:
    neighbours overlap by a third or more. What is beside the thing (a table that does not turn with it) must not be in
    the images.

    Parameters
    ----------
    spacing_m : metres between the points that are registered; None: so that a view has about 4000.
    seed : of the random samples; the same seed gives the same poses, to the rounding of Open3D's parallel sums.

    Raises
    ------
    ValueError
        Fewer than two views, a view with fewer than 200 points, one that fits none of the three before, pairs that
        contradict each other, or poses in which a view has surface where another looks through.

    Warns
    -----
    AlignmentWarning
        Views that no loop holds; of two views always one.
    """
    if len(scan) < 2:
        raise ValueError(f"expected two views or more to align, got {len(scan)}.")
    check_number("seed", seed, whole_number(0))
    clouds, spacing = _thinned(scan, spacing_m, seed)
    chain = _chain(clouds, seed)
    placed = _placed(chain, len(clouds))
    edges = chain + _loops(clouds, placed, spacing, {(e.source, e.target) for e in chain})
    while True:
        placed = _optimised(clouds, placed, edges, spacing)
        pairs = tuple(e._replace(disagreement_m=_disagreement(e, placed, clouds)) for e in edges)
        wrong = max((e for e in pairs if e.is_loop), key=lambda e: e.disagreement_m, default=None)
        if wrong is None or wrong.disagreement_m <= CONSISTENT * spacing:
            break
        edges = [e for e in edges if (e.source, e.target) != (wrong.source, wrong.target)]
    _refuse_disagreement(pairs, spacing)
    world = np.asarray(scan.images[0].T_world_camera) @ np.linalg.inv(placed[0])
    first = scan.poses[0]
    aligned = scan.with_poses(np.stack([first, *(_rigid(world @ T) for T in placed[1:])]))
    aligned = scan.with_poses(
        np.stack([_rigid(T) for T in refine_jointly(scan.images, aligned.poses, CONSISTENT * spacing, seed)])
    )
    _refuse_contradiction(aligned, clouds, spacing)
    unchecked = _unchecked(pairs, len(clouds))
    if unchecked:  # of two views always: their one pair may fit wrongly, and nobody would know
        views = ", ".join(map(str, unchecked))
        warnings.warn(AlignmentWarning(f"no loop confirms the pose of view {views}; add views between."), stacklevel=2)
    return Alignment(aligned, pairs, spacing, unchecked)


def check_first_pair(first_two: Scan, *, seed: int = 0) -> None:
    """Raise ValueError if the second view of a scan fits nowhere on the first, as `align` of the whole scan would.

    The spacing of the whole scan is not known yet, so that of two views is tried, then others near it.
    """
    clouds, spacing = _thinned(first_two, None, seed)
    problems = []
    for scale in EARLY_SPACINGS:
        try:
            _chain(clouds if scale == 1 else _thinned(first_two, scale * spacing, seed)[0], seed)
            return
        except ValueError as error:
            problems.append(error)
    raise problems[0]


class PoseErrors(NamedTuple):
    """How far poses are from the truth, once the frames of both are laid over each other: (n,) float64 each.

    angle_deg : degrees. centre_m : metres, of the camera centres.
    """

    angle_deg: Array
    centre_m: Array


def pose_errors(poses: ArrayLike, true_poses: ArrayLike) -> PoseErrors:
    """Differences of poses (n, 4, 4) T_world_camera from the true ones, but for where the world has its axes.

    The frames are laid over each other by the mean rotation (Moakher 2002: the polar factor of the sum) and the mean
    translation of T_true T^-1, taken at the middle of the cameras.

    Raises
    ------
    ValueError
        Shapes other than (n, 4, 4), or different numbers of poses.
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


def _thinned(scan: Scan, spacing_m: float | None, seed: int) -> tuple[list[Array], float]:
    """Points of each view without dominant planes, one in each cube of the spacing, in its camera's coordinates."""
    if spacing_m is not None and not 0 < spacing_m < np.inf:
        raise ValueError(f"expected a positive spacing_m in metres, got {shown(spacing_m)}.")
    every = scan.points()
    for number, cloud in enumerate(every):
        if len(cloud) < LEAST_POINTS:
            raise ValueError(
                f"expected {LEAST_POINTS} readings or more in each view to align, got {len(cloud)} in view {number}."
            )
    # The area that readings stand for is their number times that of a pixel's footprint
    pixels = [
        float(np.median(i.z[i.valid])) ** 2 / (i.camera.fx * i.camera.fy) for i in scan.images if i.camera is not None
    ]
    coarse = float(np.sqrt(np.median([a * len(c) for a, c in zip(pixels, every, strict=True)]) / POINTS))
    clouds = [_without_planes(cloud, spacing_m or coarse, seed) for cloud in every]
    if spacing_m is None:
        spacing_m = float(np.sqrt(np.median([a * len(c) for a, c in zip(pixels, clouds, strict=True)]) / POINTS))
    thinned = []
    for number, cloud in enumerate(clouds):
        thinned.append(_one_in_each(cloud, spacing_m))
        if len(thinned[-1]) < LEAST_POINTS:
            raise ValueError(
                f"expected a spacing_m that leaves {LEAST_POINTS} points or more of each view, got {spacing_m:g} m, "
                f"which leaves {len(thinned[-1])} of view {number}."
            )
    return thinned, spacing_m


def _without_planes(cloud: Array, spacing_m: float, seed: int) -> Array:
    """The points (n, 3) that lie on no plane that holds most of them; all, if too few would be left."""
    import open3d as o3d

    left = cloud
    for _ in range(MAX_PLANES):
        few = _one_in_each(left, spacing_m)
        if len(few) < LEAST_POINTS:
            return cloud
        o3d.utility.random.seed(seed)
        packed = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(few))
        (*normal, offset), on_it = packed.segment_plane(0.5 * spacing_m, 3, 500)
        if len(on_it) < DOMINANT * len(few):
            return left
        beside = left[np.abs(left @ np.array(normal) + offset) > 1.5 * spacing_m]
        if len(beside) < LEAST_POINTS:
            return cloud
        left = beside
    return left


def _one_in_each(cloud: Array, spacing_m: float) -> Array:
    """(m, 3) the middle of the points in each cube of the spacing."""
    import open3d as o3d

    packed = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud))
    return np.asarray(packed.voxel_down_sample(spacing_m).points)


def _chain(clouds: list[Array], seed: int) -> list[PairFit]:
    """Each view registered to one before."""
    found = []
    for source in range(1, len(clouds)):
        reasons: dict[int, str] = {}
        for target in range(source - 1, max(-1, source - 1 - BACK), -1):
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
    """Why a view fits none of those before, by the nearest one: reasons of all, the nearest one's first.

    What a reason advises, after its semicolon, is for two clouds alone; of three, a message would be too long to read.
    """
    (nearest, reason), *others = reasons.items()
    what = reason.partition("; ")[0].rstrip(".")
    return f"on view {nearest}: {what}" + "".join(f", nor on {target}" for target, _ in others) + "."


def _placed(chain: list[PairFit], n: int) -> list[Array]:
    """(4, 4) pose of each view in the first one's frame, along the chain."""
    poses = [np.eye(4)] * n
    for edge in chain:
        poses[edge.source] = poses[edge.target] @ edge.T_target_source
    return poses


def _loops(clouds: list[Array], poses: list[Array], spacing: float, known: set[tuple[int, int]]) -> list[PairFit]:
    """Pairs beside the chain that overlap by it, refined."""
    found = []
    trees = [cKDTree(c) for c in clouds]
    for target, source in combinations(range(len(clouds)), 2):
        if (source, target) in known:
            continue
        T = np.linalg.inv(poses[target]) @ poses[source]
        moved = clouds[source] @ T[:3, :3].T + T[:3, 3]
        near = np.isfinite(trees[target].query(moved, distance_upper_bound=NEAR * spacing)[0]).sum()
        if near < LOOP_OVERLAP * min(len(clouds[source]), len(clouds[target])):
            continue
        try:
            fit = icp(clouds[source], clouds[target], T, max_distance_m=NEAR * spacing, min_fitness=MIN_OVERLAP)
        except ValueError:
            continue  # a pair that overlaps in too little; views that no pair holds are told
        pair = PairFit(source, target, np.asarray(fit.T_target_source), fit.fitness, np.nan, True)
        if _disagreement(pair, poses, clouds) <= 2 * NEAR * spacing:
            found.append(pair)
    return found


def _optimised(clouds: list[Array], poses: list[Array], edges: list[PairFit], spacing: float) -> list[Array]:
    """Poses that fit all pairs best."""
    import open3d as o3d

    r, reach = o3d.pipelines.registration, CONSISTENT * spacing
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
    by_graph = np.linalg.inv(poses[edge.target]) @ poses[edge.source]
    off = by_graph - edge.T_target_source
    return float(np.sqrt(((clouds[edge.source] @ off[:3, :3].T + off[:3, 3]) ** 2).sum(axis=-1).mean()))


def _refuse_disagreement(pairs: tuple[PairFit, ...], spacing: float) -> None:
    worst = max(pairs, key=lambda e: e.disagreement_m)
    if not worst.disagreement_m <= CONSISTENT * spacing:
        raise ValueError(
            f"expected pairs of views that agree, but views {worst.target} and {worst.source} are "
            f"{1e3 * worst.disagreement_m:.2g} mm off what the others say (spacing {1e3 * spacing:.2g} mm): some pair "
            f"fits wrongly; {REMEDY}"
        )


def _refuse_contradiction(scan: Scan, clouds: list[Array], spacing: float) -> None:
    worst, views = 0.0, (0, 0)
    for i, T in enumerate(scan.poses):
        world = clouds[i] @ T[:3, :3].T + T[:3, 3]
        for j, image in enumerate(scan.images):
            if i == j:
                continue
            distance = signed_distance(world, image)
            tolerance = THROUGH * spacing + 0.01 * float(np.nanmedian(image.z))
            through = float((distance < -tolerance).mean())  # False with NaN
            if through > worst:
                worst, views = through, (i, j)
    if worst > MAX_CONTRADICTION:
        raise ValueError(
            f"expected poses in which no view sees through what another measured, but view {views[1]} looks through "
            f"{worst:.0%} of view {views[0]}: they fit wrongly; {REMEDY}"
        )


def _unchecked(pairs: tuple[PairFit, ...], n: int) -> tuple[int, ...]:
    """Views that hang on the rest by a single pair."""
    import networkx as nx

    graph = nx.Graph((e.source, e.target) for e in pairs)
    found: set[int] = set()
    for a, b in nx.bridges(graph):
        graph.remove_edge(a, b)
        found |= min(nx.node_connected_component(graph, a), nx.node_connected_component(graph, b), key=len)
        graph.add_edge(a, b)
    return tuple(sorted(found))


def _rigid(T: Array) -> Array:
    """The nearest rigid transform: products leave rounding."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    result = np.array(T)
    result[:3, :3], result[3] = U @ Vt, (0, 0, 0, 1)
    return result
