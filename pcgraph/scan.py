# SPDX-License-Identifier: Apache-2.0
"""Segmentation of a scan: the whole algorithm, from points to voxels, supervoxels, graph, tree and objects.

`segment` and `update` make the voxels and planes of a first scan and of a later one; `segment_scan` goes from there to
supervoxels, graph, tree and objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.depth_image import DepthImage, axis_at, image_view, is_camera_image
from pcgraph.features.moments import Moments, joined_moments, moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.bounding_planes import bounding_planes
from pcgraph.graph.bridges import bridges
from pcgraph.graph.contacts import contacts, edge_features
from pcgraph.graph.continuations import continuations, faces_of
from pcgraph.graph.gaps import gaps
from pcgraph.graph.terrain import terrain
from pcgraph.inputs import (
    CleanCloud,
    Features,
    Points,
    as_arrays,
    clean_cloud,
    clean_viewpoint,
    fraction,
    non_negative,
    positive,
    whole_number,
)
from pcgraph.parallel import side_by_side
from pcgraph.pixels import with_pixels
from pcgraph.plausibility import (
    warn_of_duplicates,
    warn_of_oversegmentation,
    warn_of_rounding,
    warn_of_size,
    warn_of_viewpoint,
    warn_of_volume,
)
from pcgraph.segmentation import Segmentation
from pcgraph.supervoxels.method import SupervoxelMethod, checked_supervoxels
from pcgraph.supervoxels.surface_growth import SurfaceGrowth
from pcgraph.tree.linkage import Linkage, checked_merges
from pcgraph.tree.region_linkage import RegionLinkage
from pcgraph.tree.tree import segmentation_tree
from pcgraph.voxels.adapted_size import (
    adapted_grading,
    adapted_voxel_size,
    seed_spacing,
    seed_spacing_for,
    voxel_size_for,
)
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.column_evidence import color_evidence
from pcgraph.voxels.grid import VoxelGrid, grid_union, grid_without, voxel_grid, voxel_means, with_means
from pcgraph.voxels.outliers import OUTLIER, detached_voxels, fill_the_volume, is_full_of_noise, is_near, outlier_voxels
from pcgraph.voxels.sampling import farthest_points
from pcgraph.voxels.spacing import VOXELS_PER_SPACING, median_spacing, spacing_and_rows
from pcgraph.voxels.spacing_law import SpacingLaw, law_on_rings, spacing_law
from pcgraph.voxels.surface import LocalPlanes, Surface
from pcgraph.voxels.virtual_viewpoints import virtual_viewpoints
from pcgraph.voxels.visibility import (
    likelier_viewpoint,
    shown_fraction,
    sides_towards,
    sides_towards_each,
    visible_sides,
)
from pcgraph.voxels.warp import Shift, Warp, choose_warp

RANGE_GROWTH = 0.5
"""Default of `range_growth` for a cloud that is one scan."""
_SIZES_PER_OCTAVE = 16  # default voxel sizes are rounded to these
_GRID_OFFSET = 0.382  # voxel edges from the grid's origin to the lowest corner: no simple fraction, so that points on a
# lattice, and walls a whole number of voxels from each other, are not on a border between cells
_FLIP_COSINE = 0.5  # a normal is flipped if its cosine with that of larger voxels is below minus this
_FEW_OUTLIERS = 0.95  # fraction of the points left from which on scale and viewpoint are not estimated again
_NOISY = 0.9  # fraction left up to which outliers are sought in voxels half as large, too
_MIN_SHOWN = 0.8  # fraction of the surface that an estimated scanner position must see
_MAX_VIEWPOINTS = 3  # from which continuations are sought, where the cloud was not seen from one
_SAMPLED_VOXELS = 64  # whose points' viewpoints are candidates for these
_MAX_TRIES, _NEAR = 8, 0.02  # spacings tried for a number of supervoxels; logarithm of what it may be off by


def segment(
    points: Points,
    colors: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    *,
    features: Features = None,
    voxel_size: float | None = None,
    seed_size: float | None = None,
    n_supervoxels: int | None = None,
    camera: bool | None = None,
    range_growth: float | None = None,
    method: SupervoxelMethod | None = None,
    linkage: Linkage | None = None,
    object_altitude: float | None = None,
) -> Segmentation:
    """Segmentation of a point cloud: supervoxels, their adjacency graph, and the tree on it.

    Parameters
    ----------
    points : (n, 3) or (h, w, 3) float or integer, metres, any frame; or a Cloud, or the name of a file
        Of a `Cloud`, and of a file that `read_cloud` reads, colours, normals and viewpoint are used too where none
        are given (not a viewpoint of zeros, which PCD files hold where none is known).
        NaN, infinite and masked points are left out and labelled -1, and so are those that are exactly (0, 0, 0), as
        drivers write holes, if there are several in an organised cloud (h, w, 3), or more than a thousand and one in a
        thousand in a list; outliers, no denser around than noise would be, -2
        (`pcgraph.voxels.outliers.outlier_voxels`). What looks like a camera's image, organised or not, is taken for
        one, in whatever frame, unless `camera` says otherwise.
    colors : same shape, uint8 0..255 or float 0..1, optional
    normals : same shape, float, optional
        Outward normals; kept in their direction. Where zero or NaN, and without them, they are estimated.
    viewpoint : (3,) or points' shape float, metres, the points' frame, optional
        Where the sensor stood, for all points or for each (which is one for all, if no two are farther apart than a
        fiftieth of the range); estimated normals point to its side, and convexity depends on that. Default: of
        organised clouds the origin, if neighbours lie side by side as seen from there, as in their sensor's frame, or
        the place of the camera that sees each point at its pixel (`pcgraph.depth_image`). So it is of lists that one
        camera took, as their points tell which pixels they are (`pcgraph.pixels`). Any other cloud whose spacing grows
        with range from one place that shows it (`pcgraph.voxels.spacing_law`) was seen from there; of all others, the
        outside is found from what is visible from free places (`pcgraph.voxels.visibility.visible_sides`).
    features : points' leading shape, or that + (d,), numbers; or names of columns of the Cloud or file, optional
        What else is known of each point, such as intensity, in any unit: each column counts in spreads from its
        median (`pcgraph.columns.RobustScaling`), to 4 at most. NaN, where unknown, counts as the median.
    voxel_size : float, metres, optional
        Edge of a voxel (R_voxel of Papon et al. 2013, PCL's voxel_resolution). Default: 3.5 times the median distance
        between nearest points, whatever the unit, rounded to one of 16 sizes per octave of the cloud's extent; of a
        camera's, as if all lay at the median depth; larger where surfaces would fall apart, and smaller, down to a
        half, where points lie so evenly that surfaces stay whole, as the vertices of a mesh do, or where voxels are
        few, so that things have too few of them.
    seed_size : float, metres, optional
        Spacing of supervoxels (R_seed of Papon et al. 2013, PCL's seed_resolution), at least `voxel_size`. Default: 5
        times `voxel_size`, or less, 3 times at least, where that would leave fewer than some 800 supervoxels, or 6000
        on smooth surfaces.
    n_supervoxels : int, optional
        About how many supervoxels there are, in place of `seed_size`: from some dozens on within a few per cent, but at
        least one for each piece that touches nothing else, and at most one for each voxel. For many, voxels are
        smaller, down to a half, as long as surfaces stay whole; not if `voxel_size` is given or some are larger.
    camera : bool, optional
        Whether voxels grow in proportion to depth from the viewpoint, being `voxel_size` at the median depth, as a
        camera's pixels do. Default: organised clouds that a camera took, unless voxels grow with range: those in front
        of the one viewpoint, with x/z and y/z in the order of columns and rows, and those of which the order of pixels
        tells place and axis of a camera; and lists whose points tell them. Otherwise the camera looks along +z.
    range_growth : float, 0..1, without 1
        Power of the range from the viewpoint with which voxels grow, being `voxel_size` at the median range; for
        scanners, whose points thin out with range. 0.5 keeps near detail and far surfaces in one piece; 0: one size.
        Default: 0.5 where the spacing grows with range from the one viewpoint, given or found, and `camera` is not in
        use.
    method : SupervoxelMethod, optional
        How voxels become supervoxels; default `SurfaceGrowth()`.
    linkage : Linkage, optional
        How the graph becomes a tree; default `RegionLinkage()`, whose altitudes are radians of concavity.
    object_altitude : float, the linkage's unit, optional
        Altitude above which two parts are two objects: the cut that gives `labels`. Default: the linkage's.

    Returns
    -------
    Segmentation
        Every finite point but outliers has a supervoxel; the voxels that hold points of a supervoxel are connected
        (26-neighbourhood). The same points give the same supervoxels in any order, and node features up to the
        rounding of sums; the number of threads changes nothing. A shift or another unit changes ties at most, unless
        the origin passed for the sensor's place.

    Raises
    ------
    ValueError
        A shape, dtype or value is not as above, or no point is finite.
    CloudReadError
        `points` names a file that cannot be read.

    Notes
    -----
    Supervoxels: Papon et al. 2013 (VCCS). Convexity: Stein et al. 2014 (LCCP).
    """
    points, colors, normals, viewpoint, features = as_arrays(points, colors, normals, viewpoint, features)
    if n_supervoxels is not None:
        n_supervoxels = whole_number("n_supervoxels", n_supervoxels)
        if seed_size is not None:
            raise ValueError("expected seed_size or n_supervoxels, got both")
    method = SurfaceGrowth() if method is None else method
    settings = Settings.of(method, RegionLinkage() if linkage is None else linkage, object_altitude)
    cloud = with_pixels(clean_cloud(points, colors, normals, features))
    n_supervoxels = None if n_supervoxels is None else min(n_supervoxels, len(cloud.points))
    is_given = viewpoint is not None
    viewpoint, axis = _viewpoint_and_axis(viewpoint, cloud, bool(camera))
    camera = _grows_with_depth(cloud, viewpoint, axis, range_growth) if camera is None else camera
    image = _depth_image(cloud, viewpoint, axis, camera)
    asked = _Asked(image, camera, range_growth, voxel_size, seed_size)
    found = _without_noise(_without_flying_pixels(cloud, image), viewpoint, asked)
    spacing = found.voxelised.grid.size / VOXELS_PER_SPACING if voxel_size is None else None
    warn_of_rounding(points, found.voxelised.cloud, spacing)  # type: ignore[arg-type]
    if spacing is not None:
        warn_of_duplicates(found.voxelised.cloud, spacing)
        found = _with_adapted_size(found, asked)
    warn_of_size("voxel_size", voxel_size, found.voxelised.cloud)
    warn_of_size("seed_size", seed_size, found.voxelised.cloud)
    cloud, grid, viewpoint = _without(found.voxelised, detached_voxels(found.voxelised.grid))
    if n_supervoxels is not None and voxel_size is None:
        grid = _fine_enough(grid, cloud, found.warp, n_supervoxels)
    found = found._replace(voxelised=Voxelised(cloud, grid, viewpoint))  # the grid before need not stay in memory
    grid = with_means(grid, cloud.colors, cloud.features)
    warn_of_volume(grid)
    if is_given and viewpoint is not None and viewpoint.ndim == 1:
        warn_of_viewpoint(viewpoint, grid)
    oriented = _oriented_planes(grid, settings.method, found.law, viewpoint)
    if grid.size < found.orienting_size and viewpoint is None:
        oriented = _oriented_as_larger(oriented, grid, cloud, found, settings.method)
    if n_supervoxels is not None:
        seed_size = _seed_size_for(n_supervoxels, cloud, grid, oriented.planes, settings.method)
    scan = Scan(
        cloud,
        grid,
        oriented,
        sides_known=oriented.viewpoint_known or cloud.normals is not None,
        initial_labels=np.full(grid.n_voxels, -1, np.int32),
        seed_size=seed_spacing(grid) if seed_size is None else float(seed_size),
    )
    result = segment_scan(scan, None, settings)
    warn_of_oversegmentation(int(result.objects.max()) + 1, result.tree.n_leaves, grid.size)
    return result


def update(
    earlier: Segmentation,
    points: Points,
    colors: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    *,
    features: Features = None,
    method: SupervoxelMethod | None = None,
    linkage: Linkage | None = None,
    object_altitude: float | None = None,
) -> Segmentation:
    """Segmentation of a scene after one more scan of it.

    Supervoxels keep their numbers and what they hold: the new points join those whose voxels they fall into, or
    beside which they lie on the same surface, or found new ones. Graph and tree are made anew, over all that has
    been seen. The points of earlier scans are not needed, and a scan costs time for its own points and for the
    voxels of the scene, not for the points seen before.

    Parameters
    ----------
    earlier : Segmentation
        Of the scans so far; its voxel size, seed size and grid are used again.
    points, colors, normals, viewpoint, features
        The new scan in the same frame; as for `pcgraph.segment`. Features are scaled as those of the first scan.
    method, linkage, object_altitude
        As for `pcgraph.segment`; default: those of the earlier scan.

    Returns
    -------
    Segmentation
        `labels` and `supervoxels` are those of the new points; `graph`, `tree` and `surface` those of the whole
        scene. Points of an earlier scan keep their supervoxels, so their objects are now
        ``result.objects[earlier.supervoxels]``.

    Raises
    ------
    ValueError
        As for `pcgraph.segment`; or the earlier scan's voxels grow with a camera's depth and a new point does not
        lie in front of that camera (segment the first scan with ``camera=False``); or one scan has colours or
        features and the other none.

    Notes
    -----
    Nothing is ever taken away: what has moved between the scans is there twice. Voxels stay as large as the first scan
    needed, also where that had points far apart and a later one has many.
    """
    if not isinstance(earlier, Segmentation):
        raise ValueError(f"expected the Segmentation of the scans so far, got {type(earlier).__name__}")
    points, colors, normals, viewpoint, features = as_arrays(points, colors, normals, viewpoint, features)
    if object_altitude is None and linkage is None:
        object_altitude = earlier.object_altitude
    method = earlier.method if method is None else method
    settings = Settings.of(method, earlier.linkage if linkage is None else linkage, object_altitude)
    cloud = with_pixels(clean_cloud(points, colors, normals, features, earlier.feature_scaling))
    is_given = viewpoint is not None
    viewpoint, axis = _viewpoint_and_axis(viewpoint, cloud, False)
    warn_of_rounding(points, cloud, None)  # type: ignore[arg-type]
    before = earlier.surface
    before.grid.warp.check(cloud.points)
    size, warp, grading = before.grid.size, before.grid.warp, before.grid.grading
    cloud = _without_flying_pixels(
        cloud, _depth_image(cloud, viewpoint, axis, _grows_with_depth(cloud, viewpoint, axis, None))
    )
    grid = voxel_grid(cloud.points, size, warp)
    cloud, grid, viewpoint = _without(
        Voxelised(cloud, grid, viewpoint), outlier_voxels(grid) & ~is_near(grid, before.grid)
    )
    if grading is not None:
        grid = voxel_grid(cloud.points, size, warp, grading)
    cloud, grid, viewpoint = _without(
        Voxelised(cloud, grid, viewpoint), detached_voxels(grid) & ~is_near(grid, before.grid)
    )
    grid = with_means(grid, cloud.colors, cloud.features)
    if is_given and viewpoint is not None and viewpoint.ndim == 1:
        warn_of_viewpoint(viewpoint, grid)
    union = grid_union(before.grid, grid)
    labels = np.full(union.grid.n_voxels, -1, np.int32)
    labels[union.first] = before.supervoxels
    oriented = _oriented_planes(grid, settings.method, None, viewpoint)
    viewpoint_of_voxel = np.empty((union.grid.n_voxels, 3))
    viewpoint_of_voxel[union.second] = _far_along(grid, oriented.planes.normals)
    viewpoint_of_voxel[union.first] = _far_along(before.grid, before.normals)
    viewpoints = oriented.viewpoints
    if earlier.viewpoint.ndim == 1:
        viewpoints = np.concatenate((viewpoints, earlier.viewpoint[None]))
    scan = Scan(
        cloud,
        union.grid,
        oriented._replace(
            viewpoints=np.unique(viewpoints, axis=0), planes=settings.method.planes(union.grid, viewpoint_of_voxel)
        ),
        sides_known=earlier.graph.sides_known and (oriented.viewpoint_known or cloud.normals is not None),
        initial_labels=labels,
        seed_size=earlier.seed_size,
    )
    result = segment_scan(scan, earlier, settings)
    warn_of_oversegmentation(int(result.objects.max()) + 1, result.tree.n_leaves, union.grid.size)
    return result


@dataclass(frozen=True, eq=False)
class Scan:
    """Points to be segmented, their voxels and local planes.

    Attributes
    ----------
    cloud : CleanCloud of n points
    grid : VoxelGrid of v voxels
        Of all scans so far; its `voxel_of_point` is of these points.
    oriented : OrientedPlanes of v voxels
    sides_known : bool
        As of `AdjacencyGraph`, for all scans so far.
    initial_labels : (v,) int32
        Supervoxels of earlier scans, -1 elsewhere.
    seed_size : float, metres
    """

    cloud: CleanCloud
    grid: VoxelGrid
    oriented: OrientedPlanes
    sides_known: bool
    initial_labels: NDArray[np.int32]
    seed_size: float


@dataclass(frozen=True)
class Settings:
    """Method, linkage and cut of a segmentation, checked."""

    method: SupervoxelMethod
    linkage: Linkage
    object_altitude: float

    @classmethod
    def of(cls, method: SupervoxelMethod, linkage: Linkage, object_altitude: float | None) -> Settings:
        """Settings; without an altitude the linkage's default."""
        if not isinstance(method, SupervoxelMethod):
            raise ValueError(_refusal("method", "SupervoxelMethod", method))
        if not isinstance(linkage, Linkage):
            raise ValueError(_refusal("linkage", "Linkage", linkage))
        altitude = linkage.default_object_altitude if object_altitude is None else object_altitude
        return cls(method, linkage, non_negative("object_altitude", altitude))


def _viewpoint_and_axis(
    viewpoint: ArrayLike | None, cloud: CleanCloud, camera: bool
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Viewpoint, (3,) or (n, 3) metres, and the camera's optical axis, (3,); None where unknown.

    The viewpoint is the given one, else what the pixels tell, else the origin of an image that `camera` calls a
    camera's.
    """
    if viewpoint is not None:
        given = clean_viewpoint(viewpoint, cloud)
        return given, axis_at(given, cloud) if given.ndim == 1 else None
    view = image_view(cloud)
    if view is None:
        return (np.zeros(3) if camera and cloud.image is not None else None), None
    return view


def _grows_with_depth(
    cloud: CleanCloud,
    viewpoint: NDArray[np.float64] | None,
    axis: NDArray[np.float64] | None,
    range_growth: float | None,
) -> bool:
    """Whether a camera at the viewpoint took the cloud and no `range_growth` above 0 was given."""
    return viewpoint is not None and not range_growth and (axis is not None or is_camera_image(cloud, viewpoint))


def _depth_image(
    cloud: CleanCloud, viewpoint: NDArray[np.float64] | None, axis: NDArray[np.float64] | None, camera: bool
) -> DepthImage | None:
    """The image that a camera took, along z or the axis that its pixels tell; None if it was no camera."""
    if viewpoint is None or viewpoint.ndim != 1 or cloud.image is None or not (camera or axis is not None):
        return None
    return DepthImage.of(cloud.points, cloud.image, viewpoint, axis)


def _refusal(argument: str, family: str, given: object) -> str:
    from pcgraph.families import refusal

    return refusal(argument, family, given)


# --- from voxels to objects -------------------------------------------------------------------------------------------


def segment_scan(scan: Scan, earlier: Segmentation | None, settings: Settings) -> Segmentation:
    """Segmentation of a scan: the algorithm from voxels on."""
    cloud, grid, planes = scan.cloud, scan.grid, scan.oriented.planes
    method, linkage = settings.method, settings.linkage
    normals = _normals(cloud, grid, planes)
    if earlier is not None:
        normals = normals.copy()  # the planes keep their own
        normals[scan.initial_labels >= 0] = earlier.surface.normals
    supervoxels = _supervoxels(method, grid, normals, scan.seed_size, scan.initial_labels)
    surface = Surface(grid, normals, supervoxels)

    def with_points() -> tuple[NDArray[np.int32], Moments]:
        leaf_of_point = method.supervoxel_of_point(cloud.points, grid, planes, supervoxels)
        return leaf_of_point, _leaves(cloud, surface, leaf_of_point, earlier)

    (leaf_of_point, leaves), (touching, evidence) = side_by_side(
        with_points, lambda: (contacts(surface), color_evidence(grid, normals))
    )
    nodes = node_features(leaves)
    features = edge_features(nodes, touching)
    faces = faces_of(touching.edges, features, len(leaves))
    # no place saw all of several scans
    seen_from = grid.warp.seen_from if earlier is None else None
    near, hidden = side_by_side(
        lambda: gaps(surface, nodes, touching.edges, seen_from),
        lambda: continuations(surface, nodes, faces, scan.oriented.viewpoints),
    )
    of_planes, of_ground = side_by_side(
        lambda: bounding_planes(surface, nodes, faces), lambda: terrain(surface, nodes, faces)
    )
    hidden = hidden.with_others(of_planes).without(touching.edges).without(near.edges).with_others(of_ground)
    graph = AdjacencyGraph(
        touching.edges, features, nodes, near, hidden, color_evidence=evidence, sides_known=scan.sides_known
    )
    graph = replace(graph, bridges=bridges(surface, leaves.counts, graph.joined))
    tree = segmentation_tree(checked_merges(linkage.merges(graph, leaves), len(leaves), linkage), leaves)
    objects = tree.cut(altitude=settings.object_altitude)
    return Segmentation(
        labels=cloud.in_input_shape(objects[leaf_of_point], OUTLIER),
        supervoxels=cloud.in_input_shape(leaf_of_point),
        objects=objects,
        graph=graph,
        tree=tree,
        surface=surface,
        seed_size=scan.seed_size,
        viewpoint=scan.oriented.viewpoint,
        feature_scaling=cloud.scaling,
        **vars(settings),
    )


def _supervoxels(
    method: SupervoxelMethod,
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    seed_size: float,
    initial: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Supervoxels by a method, (v,) int32: level by level, as many voxel edges from each other at each.

    Those of earlier scans keep their numbers.
    """
    if grid.levels is None:
        return checked_supervoxels(method.supervoxels(grid, normals, seed_size, initial), grid.n_voxels, method)
    found, n_found = np.empty(grid.n_voxels, np.int32), int(initial.max()) + 1
    for of_level, level in grid.of_levels():
        earlier, number = np.unique(initial[of_level], return_inverse=True)
        own = (number - np.count_nonzero(earlier < 0)).astype(np.int32)
        earlier = earlier[earlier >= 0]
        seed = seed_size * (level.size / grid.size)
        labels = method.supervoxels(level, normals[of_level], seed, own)
        labels = checked_supervoxels(labels, level.n_voxels, method)
        n_new = int(labels.max()) + 1 - len(earlier)
        found[of_level] = np.concatenate((earlier, n_found + np.arange(n_new)))[labels]
        n_found += n_new
    return found


def _leaves(
    cloud: CleanCloud, surface: Surface, leaf_of_point: NDArray[np.int32], earlier: Segmentation | None
) -> Moments:
    """Moments of the supervoxels' points, with those of earlier scans."""
    n_leaves = int(surface.supervoxels.max()) + 1
    if earlier is None:
        leaves = moments_of_groups(cloud.points, cloud.colors, leaf_of_point, n_leaves, cloud.features)
    else:
        found, group = np.unique(leaf_of_point, return_inverse=True)
        gained = moments_of_groups(cloud.points, cloud.colors, group.astype(np.int32), len(found), cloud.features)
        leaves = joined_moments(replace(earlier.leaves, normals=None), gained, found, n_leaves)
    return replace(leaves, normals=surface.mean_normals(n_leaves))


def _seed_size_for(
    n_supervoxels: int, cloud: CleanCloud, grid: VoxelGrid, planes: LocalPlanes, method: SupervoxelMethod
) -> float:
    """Spacing of supervoxels, metres, of which there are about so many: the best of a few that come ever nearer.

    Their number jumps where cells of seeds come to lie otherwise on walls: then the middle of the interval is next.
    """
    normals = _normals(cloud, grid, planes)
    seed, best, least_off = seed_spacing_for(n_supervoxels, grid), grid.size, math.inf
    more, fewer = grid.size, math.inf  # spacings that give more, and fewer
    for _ in range(_MAX_TRIES):
        seed = max(seed, grid.size)
        n = int(_supervoxels(method, grid, normals, seed, np.full(grid.n_voxels, -1, np.int32)).max()) + 1
        off = abs(math.log(n / n_supervoxels))
        if off < least_off:
            best, least_off = seed, off
        if off <= _NEAR or (n < n_supervoxels and seed == grid.size):
            break
        more, fewer = (max(more, seed), fewer) if n > n_supervoxels else (more, min(fewer, seed))
        seed *= math.sqrt(n / n_supervoxels)
        if fewer < math.inf and not more < seed < fewer:
            seed = math.sqrt(more * fewer)
    return best


def _normals(cloud: CleanCloud, grid: VoxelGrid, planes: LocalPlanes) -> NDArray[np.float64]:
    """Mean of the given normals of each voxel's points, (v, 3); that of its plane where none is given."""
    if cloud.normals is None:
        return planes.normals
    means = voxel_means(cloud.normals, grid)
    length = np.linalg.norm(means, axis=1, keepdims=True)
    usable = length > 1e-6
    return np.where(usable, means / np.where(usable, length, 1.0), planes.normals)


# --- voxels: their size, and what is left out -------------------------------------------------------------------------


class _Asked(NamedTuple):
    """What decides the scale beside the points: as for `segment`.

    Attributes
    ----------
    image : DepthImage or None
        The image that a camera took.
    camera : bool
        Whether voxels grow in proportion to depth.
    range_growth, voxel_size, seed_size : float or None
        As given.
    """

    image: DepthImage | None
    camera: bool
    range_growth: float | None
    voxel_size: float | None
    seed_size: float | None


class Voxelised(NamedTuple):
    """A cloud of n points, the voxels in which they lie, and their viewpoint, (3,) or (n, 3) metres, if it is known."""

    cloud: CleanCloud
    grid: VoxelGrid
    viewpoint: NDArray[np.float64] | None


class _Voxels(NamedTuple):
    """What is known of a cloud once it lies in voxels.

    Attributes
    ----------
    voxelised : Voxelised
        Without outliers.
    with_outliers : CleanCloud, and its viewpoint
    law : SpacingLaw or None
        How spacing depends on range, where viewpoint or scale ask for it.
    warp : Warp
        How voxels grow.
    is_noisy : bool
        Whether so many points were noise that it was sought in voxels half as large from the start.
    orienting_size : float, metres
        Edge of the voxels that decide which side is outside, where those of `voxelised` are smaller.
    """

    voxelised: Voxelised
    with_outliers: tuple[CleanCloud, NDArray[np.float64] | None]
    law: SpacingLaw | None
    warp: Warp
    is_noisy: bool
    orienting_size: float


def _without_noise(cloud: CleanCloud, viewpoint: NDArray[np.float64] | None, asked: _Asked) -> _Voxels:
    """The cloud in voxels of the size that its spacing asks for, without outliers.

    Where many points are outliers, spacing and viewpoint were those of noise, and are estimated again without them.
    """
    noisy, n_noisy = (cloud, viewpoint), len(cloud.points)
    for _ in range(2):
        with_outliers = cloud, viewpoint
        size, law, warp = _scale(cloud, viewpoint, asked)
        voxelised = _without_outliers(cloud, viewpoint, size, warp)
        may_look_closer = asked.voxel_size is None and not warp.of_one_scan
        if may_look_closer and is_full_of_noise(voxelised.grid):
            closer = _without_near_outliers(cloud, viewpoint, size, warp)
            if fill_the_volume(cloud.points, closer.cloud.points):
                voxelised = closer
        cloud, _, viewpoint = voxelised
        left = len(cloud.points) / n_noisy
        if left >= _FEW_OUTLIERS:
            break
    is_noisy = may_look_closer and left <= _NOISY and fill_the_volume(noisy[0].points, cloud.points)
    if is_noisy:
        voxelised = _without_near_outliers(*noisy, size, warp)
    return _Voxels(voxelised, with_outliers, law, warp, is_noisy, size)


def _with_adapted_size(found: _Voxels, asked: _Asked) -> _Voxels:
    """The same with larger voxels where surfaces fall apart, everywhere or in some blocks, or smaller ones where they
    stay whole."""
    voxelised, warp = found.voxelised, found.warp
    largest = math.inf if asked.seed_size is None else float(asked.seed_size)
    size, orienting_size = adapted_voxel_size(voxelised.cloud.points, voxelised.grid, found.law, largest)
    if size != voxelised.grid.size:
        cloud, viewpoint = voxelised.cloud, voxelised.viewpoint
        warp, is_larger = _from_corner(warp, found.with_outliers[0], size), size > voxelised.grid.size
        if is_larger:  # of such voxels, what was thin may be none
            cloud, viewpoint = found.with_outliers
        if is_larger or found.is_noisy:
            voxelised = _without_outliers(cloud, viewpoint, size, warp)
        else:
            voxelised = Voxelised(cloud, voxel_grid(cloud.points, size, warp), viewpoint)
    may_grade = asked.seed_size is None and asked.range_growth is None and size == orienting_size
    if may_grade and (grading := adapted_grading(voxelised.grid)) is not None:
        voxelised = voxelised._replace(grid=voxel_grid(voxelised.cloud.points, size, warp, grading))
    return found._replace(voxelised=voxelised, warp=warp, orienting_size=orienting_size)


def _fine_enough(grid: VoxelGrid, cloud: CleanCloud, warp: Warp, n_supervoxels: int) -> VoxelGrid:
    """The grid, or one of smaller voxels, so that so many supervoxels have some each; but not where some are larger."""
    size = grid.size if grid.levels is not None else voxel_size_for(n_supervoxels, cloud.points, grid)
    return grid if size == grid.size else voxel_grid(cloud.points, size, _from_corner(warp, cloud, size))


def _scale(
    cloud: CleanCloud, viewpoint: NDArray[np.float64] | None, asked: _Asked
) -> tuple[float, SpacingLaw | None, Warp]:
    """Voxel size, metres; the spacing law, None where neither viewpoint nor scale needs it; and the warp."""
    image, camera, range_growth, voxel_size, seed_size = asked

    def spacing(warp: Warp, of_points: float | None) -> float:
        of_points = median_spacing(cloud.points, warp) if of_points is None else of_points
        return of_points if image is None else image.spacing(of_points, warp)

    extent = float(np.ptp(cloud.bounds, axis=0).max())
    growth = 0.0 if range_growth is None else fraction("range_growth", range_growth)
    may_grow = range_growth is None and not camera
    law, even = None, None
    if not camera and (viewpoint is None or (may_grow and viewpoint.ndim == 1)):
        (even, rows), of_all = side_by_side(
            partial(spacing_and_rows, cloud.points), partial(spacing_law, cloud.points, viewpoint, cloud.sample)
        )
        law = law_on_rings(cloud.points, of_all, rows, viewpoint, cloud.sample)
        growth = RANGE_GROWTH if may_grow and law.holds else growth
    elif viewpoint is None:
        law = spacing_law(cloud.points, None, cloud.sample)
    warp = _warp(cloud, viewpoint, law, image, camera, growth)
    size = _voxel_size(voxel_size, seed_size, partial(spacing, warp, even), extent)
    return size, law, _from_corner(warp, cloud, size)


def _warp(
    cloud: CleanCloud,
    viewpoint: NDArray[np.float64] | None,
    law: SpacingLaw | None,
    image: DepthImage | None,
    camera: bool,
    growth: float,
) -> Warp:
    """How voxels grow about the viewpoint, which a law may tell, or else about the origin."""
    if not (camera or growth):
        return Warp()
    if viewpoint is None:
        viewpoint = law.viewpoint if law is not None and law.holds else np.zeros(3)
    return choose_warp(cloud.points, viewpoint, camera, growth, None if image is None else image.axis)


def _from_corner(warp: Warp, cloud: CleanCloud, size: float) -> Warp:
    """The warp itself if it is about a viewpoint; else one whose grid starts at the cloud's lowest corner, so that a
    moved cloud has the same voxels."""
    return warp if warp.of_one_scan else Shift(cloud.bounds[0] - _GRID_OFFSET * size)


def _voxel_size(
    voxel_size: float | None, seed_size: float | None, spacing: Callable[[], float], extent: float
) -> float:
    """The voxel size, given or from the spacing, no larger than the seed size; both checked.

    From the spacing it is one of 16 per octave, counted from the extent of the cloud, so that a few points more or less
    give the same voxels.
    """
    seed = math.inf if seed_size is None else positive("seed_size", seed_size)
    if voxel_size is None:
        size = VOXELS_PER_SPACING * spacing()
        if 0.0 < extent < math.inf and 0.0 < size < math.inf:
            size = extent * 2.0 ** (round(_SIZES_PER_OCTAVE * math.log2(size / extent)) / _SIZES_PER_OCTAVE)
        return positive("voxel_size", min(size, seed))
    voxel = positive("voxel_size", voxel_size)
    if seed < voxel:
        raise ValueError(f"expected seed_size of at least voxel_size, got {seed:g} m < {voxel:g} m")
    return voxel


def _without_flying_pixels(cloud: CleanCloud, image: DepthImage | None) -> CleanCloud:
    """The cloud without points whose depth is a mix of two."""
    if image is None:
        return cloud
    flying = image.flying()
    return cloud.without(flying) if flying.any() else cloud


def _without_outliers(cloud: CleanCloud, viewpoint: NDArray[np.float64] | None, size: float, warp: Warp) -> Voxelised:
    """The cloud in voxels of a size, without what these show to be outliers."""
    grid = voxel_grid(cloud.points, size, warp)
    return _without(Voxelised(cloud, grid, viewpoint), outlier_voxels(grid))


def _without_near_outliers(
    cloud: CleanCloud, viewpoint: NDArray[np.float64] | None, size: float, warp: Warp
) -> Voxelised:
    """The same, but of voxels half as large first, which tell noise beside surfaces from them.

    Larger ones keep it, and what is left of it would forbid that they become smaller.
    """
    closer = _without_outliers(cloud, viewpoint, size / 2.0, _from_corner(warp, cloud, size / 2.0))
    return _without_outliers(closer.cloud, closer.viewpoint, size, warp)


def _without(voxelised: Voxelised, voxels: NDArray[np.bool_]) -> Voxelised:
    """Cloud, grid and viewpoints without some voxels, and the points in them."""
    if not voxels.any():
        return voxelised
    cloud, grid, viewpoint = voxelised
    points = voxels[grid.voxel_of_point]
    viewpoint = viewpoint if viewpoint is None or viewpoint.ndim == 1 else viewpoint[~points]
    return Voxelised(cloud.without(points), grid_without(grid, voxels), viewpoint)


# --- planes, and on which side of them the outside is -----------------------------------------------------------------


class OrientedPlanes(NamedTuple):
    """Planes of v voxels, their normals towards the outside, and from where the cloud was seen.

    Attributes
    ----------
    viewpoint : (3,) or (n, 3) float64, metres
        Sensor position, given or estimated, of all n points or of each.
    viewpoints : (p, 3) float64, metres
        From which continuations are sought: the viewpoint, some of the points', or virtual ones that see the outside.
    viewpoint_known : bool
        Whether the viewpoint was given, or told by pixels or spacing.
    planes : LocalPlanes
    """

    viewpoint: NDArray[np.float64]
    viewpoints: NDArray[np.float64]
    viewpoint_known: bool
    planes: LocalPlanes


def _scanner_position(law: SpacingLaw, grid: VoxelGrid) -> NDArray[np.float64] | None:
    """Scanner position estimated from the spacing, (3,) metres, or its mirror image; None if too little of the cloud is
    visible from it.

    Spacing grows with range about the middle of a short way, too, along which a scanner moved while its scans were
    put together. Rings about one place are not left then, and what it passed shows sides that the middle does not see.
    """
    if not law.holds:
        return None
    if law.axis is not None:
        return law.viewpoint
    place = law.viewpoint if law.mirrored is None else likelier_viewpoint(grid, law.viewpoint, law.mirrored)
    found = (place,) if law.best_viewpoint is None else (place, law.best_viewpoint)  # an origin may lie on the ground
    return place if any(shown_fraction(grid, one) >= _MIN_SHOWN for one in found) else None


def _oriented_planes(
    grid: VoxelGrid, method: SupervoxelMethod, law: SpacingLaw | None, viewpoint: NDArray[np.float64] | None
) -> OrientedPlanes:
    """The plane of each voxel, its normal towards the outside, and from where the cloud was seen.

    A viewpoint that is known counts before one that the spacing tells. Voxels of points that were seen from several
    places take the mean of those. Of what lies alone or in a row, on no plane, the normal is the one nearest to that
    viewpoint; where there are many or none, to the vertical: what was seen from nearby has neighbours, and the ground
    far from a tripod, seen edge-on, has none.
    """
    upwards = np.array([0.0, 0.0, 1.0])
    if viewpoint is None and law is not None:
        viewpoint = _scanner_position(law, grid)
    if viewpoint is None:
        planes, virtual = side_by_side(
            lambda: method.planes(grid, _far_along(grid, upwards)), lambda: virtual_viewpoints(grid)
        )
        sides = visible_sides(grid, planes.normals, virtual)
        planes = replace(planes, normals=sides.normals)
        return OrientedPlanes(sides.places[0], sides.places[:_MAX_VIEWPOINTS], False, planes)
    if viewpoint.ndim == 1:
        planes = method.planes(grid, viewpoint)
        if law is not None and law.axis is not None:
            planes = replace(planes, normals=sides_towards(grid, planes.normals, viewpoint, law.axis))
        return OrientedPlanes(viewpoint, viewpoint[None], True, planes)
    low, high = bounding_box(viewpoint)
    middle, reach = (low + high) / 2.0, max(float((high - low).max()), np.finfo(np.float64).tiny)
    viewpoint_of_voxel = middle + reach * voxel_means((viewpoint - middle) / reach, grid)
    planes = method.planes(grid, _far_along(grid, upwards))
    planes = replace(planes, normals=sides_towards_each(grid, planes.normals, viewpoint_of_voxel))
    return OrientedPlanes(viewpoint, _some_viewpoints(viewpoint, grid), True, planes)


def _oriented_as_larger(
    oriented: OrientedPlanes, grid: VoxelGrid, cloud: CleanCloud, found: _Voxels, method: SupervoxelMethod
) -> OrientedPlanes:
    """Planes of small voxels, flipped where the normals of larger voxels clearly point the other way.

    Where few small voxels are joined, viewpoints see through the gaps into closed bodies.
    """
    size, planes = found.orienting_size, oriented.planes
    larger = voxel_grid(cloud.points, size, _from_corner(found.warp, cloud, size))
    of_larger = _oriented_planes(larger, method, found.law, None).planes.normals
    normals = voxel_means(of_larger[larger.voxel_of_point], grid)
    is_other = np.einsum("ij,ij->i", normals, planes.normals) < -_FLIP_COSINE
    flipped = np.where(is_other[:, None], -planes.normals, planes.normals)
    return oriented._replace(planes=replace(planes, normals=flipped))


def _some_viewpoints(viewpoint: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.float64]:
    """A few of the points' viewpoints, (n, 3), far from each other, whatever the points' order."""
    voxels = np.unique(np.linspace(0, grid.n_voxels - 1, _SAMPLED_VOXELS).astype(np.int64))
    of_voxels = [viewpoint[grid.order[grid.starts[v] : grid.starts[v + 1]]] for v in voxels]
    places = np.unique(np.concatenate(of_voxels), axis=0)
    return places[farthest_points(places, 0, _MAX_VIEWPOINTS)]


def _far_along(grid: VoxelGrid, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points a thousand voxel edges from each voxel along the directions, (3,) or (v, 3): far viewpoints that fix the
    sign of its normal."""
    places = directions * (1e3 * grid.edge_lengths)[:, None]
    places += grid.centroids
    return places
