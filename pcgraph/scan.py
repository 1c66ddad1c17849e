# SPDX-License-Identifier: Apache-2.0
"""Segmentation of a cloud: the whole algorithm on a page.

`supervoxel_clustering` decides who took the cloud, makes voxels and finds outward normals; `cluster_scan` goes on to
supervoxels and their graph, `merge_supervoxels` to tree and objects. `pcgraph.stream` adds later scans.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.acquisition.kinds import Acquisition, OrientedPlanes, acquisition_of
from pcgraph.acquisition.pixels import with_pixels
from pcgraph.features.moments import Moments, joined_moments, moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.bridges import bridges
from pcgraph.graph.contacts import contacts, edge_features
from pcgraph.graph.continuations import continuations, faces_of
from pcgraph.graph.gaps import gaps
from pcgraph.history import History
from pcgraph.inputs import CleanCloud, Features, Points, as_arrays, clean_cloud, whole_number
from pcgraph.parallel import side_by_side
from pcgraph.plausibility import (
    warn_of_duplicates,
    warn_of_oversegmentation,
    warn_of_rounding,
    warn_of_size,
    warn_of_viewpoint,
    warn_of_volume,
)
from pcgraph.segmentation import Segmentation, Settings, Supervoxels
from pcgraph.supervoxels.method import SupervoxelMethod, seed_size_for, supervoxels_by
from pcgraph.tree.linkage import Linkage, checked_merges
from pcgraph.tree.tree import segmentation_tree
from pcgraph.voxelisation.adapted_size import seed_spacing
from pcgraph.voxelisation.voxelised import Sizes, Voxelisation, Voxelised, voxelise, without_flying_pixels
from pcgraph.voxels.column_evidence import color_evidence
from pcgraph.voxels.grid import VoxelGrid, voxel_means
from pcgraph.voxels.surface import Surface

_FLIP_COSINE = 0.5
"""A small voxel is flipped if the cosine between its normal and that of larger voxels is below minus this: chosen by
eye. With no flip, 23 of 24 closed bottles of few points are inside out."""


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

    What is not given is found from the points. `Segmentation.acquisition` says what was found of the sensor.

    Parameters
    ----------
    points : (n, 3) or (h, w, 3) float or integer, metres, any frame; or a Cloud, or the name of a file
        Or any other source that `pcgraph.as_cloud` takes: arrays with further columns, ROS messages, Open3D's clouds.
        Colours, normals and viewpoint of a `Cloud` or file are used where none are given beside it. Points that are
        NaN, infinite, masked, or (0, 0, 0) as drivers write holes, are labelled -1, and so are outliers.
    colors : same shape, uint8 0..255 or float 0..1, optional
    normals : same shape, float, optional
        Outward normals. They are estimated where they are zero or NaN.
    viewpoint : (3,) or points' shape float, metres, the points' frame, optional
        Where the sensor stood, for all points or for each. Estimated normals point to its side, and convexity depends
        on that. Default: the place that the pixels of an image tell, or the spacing of the points. If neither tells
        one, the outside of a surface is the side that is visible from free places.
    features : points' leading shape, or that + (d,), numbers; or names of columns of the Cloud or file, optional
        More that is known of each point, such as intensity, in any unit. Each column counts in spreads from its median
        (`pcgraph.columns.RobustScaling`), 4 at most. NaN counts as the median.
    voxel_size : float, metres, optional
        Edge of a voxel (R_voxel of Papon et al. 2013, PCL's voxel_resolution), at the median depth or range where
        voxels grow. Default: 3.5 times the median distance between nearest points; more where surfaces would fall
        apart, and down to half of it where they stay whole.
    seed_size : float, metres, optional
        Spacing of supervoxels (R_seed of Papon et al. 2013, PCL's seed_resolution), at least `voxel_size`. Default: 5
        times `voxel_size`; down to 3 times where that would leave fewer than some 800 supervoxels, or 6000 on smooth
        surfaces.
    n_supervoxels : int, optional
        Number of supervoxels, in place of `seed_size`. From some dozens on it is met within a few per cent. There is at
        least one for each piece that touches nothing else, and at most one for each voxel.
    camera : bool, optional
        Whether a camera took the points, so that voxels grow in proportion to depth. Default: whether the points are
        pixels of a pinhole camera, organised or not, in any frame. True without a viewpoint: the camera is at the
        origin, and looks along +z unless the pixels tell another axis.
    range_growth : float, 0..1, without 1
        Power of the range from the viewpoint with which voxels grow. 0: voxels have one size. Default: 0.5 where the
        spacing of the points grows with range from one place, and no camera took them.
    method : SupervoxelMethod, optional
        How voxels become supervoxels. Default: `SurfaceGrowth()`.
    linkage : Linkage, optional
        How the graph becomes a tree. Default: `RegionLinkage()`, whose altitudes are radians of concavity.
    object_altitude : float, the linkage's unit, optional
        Altitude of the cut that gives `labels`. Parts that join above it are two objects. Default: the linkage's.

    Returns
    -------
    Segmentation
        Every finite point but outliers has a supervoxel. The voxels that hold points of a supervoxel are connected
        (26-neighbourhood). The order of the points and the number of threads change nothing. A shift or another unit
        changes ties at most, unless the origin passed for the sensor's place.

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
    settings = Settings.of(method, linkage, object_altitude)
    supervoxels = supervoxel_clustering(
        points,
        colors,
        normals,
        viewpoint,
        features=features,
        voxel_size=voxel_size,
        seed_size=seed_size,
        n_supervoxels=n_supervoxels,
        camera=camera,
        range_growth=range_growth,
        method=settings.method,
    )
    result = merge_supervoxels(supervoxels, None, settings)
    warn_of_oversegmentation(len(np.unique(result.objects)), result.tree.n_leaves, result.voxel_size)
    return result


def supervoxel_clustering(
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
) -> Supervoxels:
    """Supervoxels of a point cloud and their adjacency graph, without a tree: the first half of `segment`.

    Parameters
    ----------
    points, colors, normals, viewpoint, features, voxel_size, seed_size, n_supervoxels, camera, range_growth, method
        As for `pcgraph.segment`, which makes the same supervoxels.

    Returns
    -------
    Supervoxels
        `labels` are the supervoxels of the points, in the input's shape; -1 where a point has none.

    Raises
    ------
    ValueError, CloudReadError
        As for `pcgraph.segment`.

    Notes
    -----
    Source: Papon et al. 2013 (VCCS, PCL's SupervoxelClustering).

    Examples
    --------
    >>> y, x = np.mgrid[0:1:0.02, 0:1:0.02]
    >>> step = np.stack((x, y, np.where(x < 0.5, 0.0, 0.3)), axis=-1)
    >>> found = supervoxel_clustering(step, viewpoint=(0.5, 0.5, 5.0), seed_size=0.2)
    >>> found.labels.shape, found.graph.n_nodes == len(found.moments)
    ((50, 50), True)
    """
    points, colors, normals, viewpoint, features = as_arrays(points, colors, normals, viewpoint, features)
    if n_supervoxels is not None:
        n_supervoxels = whole_number("n_supervoxels", n_supervoxels)
        if seed_size is not None:
            raise ValueError("expected seed_size or n_supervoxels, got both")
    method = Settings.of(method, None, None).method
    cloud = with_pixels(clean_cloud(points, colors, normals, features))
    n_supervoxels = None if n_supervoxels is None else min(n_supervoxels, len(cloud.points))
    sizes = Sizes.of(voxel_size, seed_size, n_supervoxels)
    assumed = acquisition_of(cloud, viewpoint, camera, range_growth)
    voxelisation = voxelise(without_flying_pixels(cloud, assumed.told.image), assumed, sizes)
    voxelised, acquisition, spacing = voxelisation.voxelised, voxelisation.acquisition, voxelisation.spacing
    cloud, grid = voxelised.cloud, voxelised.grid
    warn_of_rounding(points, cloud, spacing)  # type: ignore[arg-type]
    if spacing is not None:
        warn_of_duplicates(cloud, spacing)
    warn_of_size("voxel_size", voxel_size, cloud)
    warn_of_size("seed_size", seed_size, cloud)
    warn_of_volume(grid)
    if viewpoint is not None and acquisition.one_viewpoint is not None:
        warn_of_viewpoint(acquisition.one_viewpoint, grid)
    oriented = _oriented(voxelisation, method)
    if n_supervoxels is not None:
        seed_size = seed_size_for(n_supervoxels, grid, _normals(cloud, oriented, grid), method)
    scan = Scan(
        voxelised,
        acquisition,
        oriented,
        initial_labels=np.full(grid.n_voxels, -1, np.int32),
        seed_size=seed_spacing(grid, acquisition) if seed_size is None else float(seed_size),
    )
    return cluster_scan(scan, None, method)


@dataclass(frozen=True, eq=False)
class Scan:
    """Points to be segmented, their voxels and local planes.

    Attributes
    ----------
    voxelised : Voxelised of n points and v voxels
        The voxels are those of all scans so far; their `voxel_of_point` is of these points.
    acquisition : Acquisition
        That of all scans so far.
    oriented : OrientedPlanes of v voxels
    initial_labels : (v,) int32
        Supervoxels of earlier scans, -1 elsewhere.
    seed_size : float, metres
    """

    voxelised: Voxelised
    acquisition: Acquisition
    oriented: OrientedPlanes
    initial_labels: NDArray[np.int32]
    seed_size: float


def segment_scan(scan: Scan, earlier: History | None, settings: Settings) -> Segmentation:
    """Segmentation of a scan together with the history of earlier ones: the algorithm from voxels on."""
    return merge_supervoxels(cluster_scan(scan, earlier, settings.method), earlier, settings)


def cluster_scan(scan: Scan, earlier: History | None, method: SupervoxelMethod) -> Supervoxels:
    """Supervoxels of a scan and their graph: the algorithm from voxels to the graph."""
    cloud, grid, planes = scan.voxelised.cloud, scan.voxelised.grid, scan.oriented.planes
    normals = _normals(cloud, scan.oriented, grid)
    if earlier is not None:
        normals = normals.copy()  # the planes keep their own
        normals[scan.initial_labels >= 0] = earlier.surface.normals
    supervoxels = supervoxels_by(method, grid, normals, scan.seed_size, scan.initial_labels)
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
    near, hidden = side_by_side(
        lambda: gaps(surface, nodes, touching.edges, scan.acquisition),
        lambda: continuations(surface, nodes, faces, scan.acquisition, scan.oriented.places),
    )
    hidden = hidden.without_coplanar(touching.edges).without_coplanar(near.edges)
    graph = AdjacencyGraph(
        touching.edges, features, nodes, near, hidden, color_evidence=evidence, acquisition=scan.acquisition
    )
    graph = replace(graph, bridges=bridges(surface, leaves.counts, graph.joined))
    viewpoint = scan.acquisition.viewpoint_of(cloud)
    return Supervoxels(
        labels=cloud.in_input_shape(leaf_of_point),
        outliers=cloud.is_outlier,
        moments=leaves,
        graph=graph,
        surface=surface,
        seed_size=scan.seed_size,
        method=method,
        viewpoint=scan.oriented.places[0] if viewpoint is None else viewpoint,
        feature_scaling=cloud.scaling,
    )


def merge_supervoxels(found: Supervoxels, earlier: History | None, settings: Settings) -> Segmentation:
    """Segmentation of supervoxels: the algorithm from the graph to tree and objects."""
    linkage, leaves = settings.linkage, found.moments
    tree = segmentation_tree(checked_merges(linkage.merges(found.graph, leaves), len(leaves), linkage), leaves)
    objects = tree.cut(altitude=settings.object_altitude)
    if earlier is not None:
        objects = _renumbered(objects, earlier, leaves.counts)
    return Segmentation(
        labels=np.append(objects, np.int32(-1))[found.labels],
        outliers=found.outliers,
        supervoxels=found.labels,
        objects=objects,
        graph=found.graph,
        tree=tree,
        surface=found.surface,
        seed_size=found.seed_size,
        viewpoint=found.viewpoint,
        ages=_ages(found.labels[found.labels >= 0], len(leaves), earlier),
        supervoxel_of_earlier=np.empty(0, np.int32) if earlier is None else earlier.numbers,
        feature_scaling=found.feature_scaling,
        next_object=max(int(objects.max()) + 1, 0 if earlier is None else earlier.next_object),
        **vars(settings),
    )


def _oriented(voxelisation: Voxelisation, method: SupervoxelMethod) -> OrientedPlanes:
    """Planes of the voxels with outward normals.

    Where few small voxels are joined, viewpoints see through the gaps into closed bodies. So where nothing tells the
    viewpoint, small voxels are flipped whose normals clearly point the other way than those of larger voxels.
    """
    voxelised, acquisition = voxelisation.voxelised, voxelisation.acquisition
    cloud, grid = voxelised.cloud, voxelised.grid
    oriented = acquisition.oriented(cloud, grid, method.planes)
    if grid.size >= voxelisation.orienting_size or acquisition.viewpoint is not None:
        return oriented
    larger = voxelised.resized(voxelisation.orienting_size).grid
    of_larger = acquisition.oriented(cloud, larger, method.planes).planes.normals
    normals, planes = voxel_means(of_larger[larger.voxel_of_point], grid), oriented.planes
    is_other = np.einsum("ij,ij->i", normals, planes.normals) < -_FLIP_COSINE
    flipped = np.where(is_other[:, None], -planes.normals, planes.normals)
    return oriented._replace(planes=replace(planes, normals=flipped))


def _leaves(cloud: CleanCloud, surface: Surface, leaf_of_point: NDArray[np.int32], earlier: History | None) -> Moments:
    """Moments of the supervoxels' points, with those of earlier scans."""
    n_leaves = int(surface.supervoxels.max()) + 1
    if earlier is None:
        leaves = moments_of_groups(cloud.points, cloud.colors, leaf_of_point, n_leaves, cloud.features)
    else:
        is_seen = np.bincount(leaf_of_point, minlength=n_leaves) > 0
        found, group = np.flatnonzero(is_seen), (np.cumsum(is_seen) - 1).astype(np.int32)[leaf_of_point]
        gained = moments_of_groups(cloud.points, cloud.colors, group, len(found), cloud.features)
        leaves = joined_moments(earlier.leaves, gained, found, n_leaves)
    return replace(leaves, normals=surface.mean_normals(n_leaves))


def _ages(leaf_of_point: NDArray[np.int32], n_leaves: int, earlier: History | None) -> NDArray[np.int32]:
    """Number of scans since a scan last saw each supervoxel, (n_leaves,) int32."""
    ages = np.zeros(n_leaves, np.int32)
    if earlier is not None:
        ages[: len(earlier.ages)] = earlier.ages + 1
        ages[leaf_of_point] = 0
    return ages


def _renumbered(objects: NDArray[np.int32], earlier: History, weights: NDArray[np.int64]) -> NDArray[np.int32]:
    """Objects of k supervoxels, (k,), with the numbers that they had when the first of these supervoxels were all.

    An object keeps the number of that with which it shares most points, if no other object shares more with that. The
    other objects get numbers that were not used before.
    """
    before, n_before = earlier.objects, earlier.next_object
    overlap = weights[: len(before)]
    shared, pair = np.unique(objects[: len(before)].astype(np.int64) * n_before + before, return_inverse=True)
    new, old = np.divmod(shared[np.argsort(-np.bincount(pair, overlap), kind="stable")], n_before)
    numbers = np.full(int(objects.max()) + 1, -1, np.int32)
    first_of_new, first_of_old = (np.unique(column, return_index=True)[1] for column in (new, old))
    for row in np.intersect1d(first_of_new, first_of_old):
        numbers[new[row]] = old[row]
    fresh = np.flatnonzero(numbers < 0)
    numbers[fresh] = n_before + np.arange(len(fresh))
    return numbers[objects]


def _normals(cloud: CleanCloud, oriented: OrientedPlanes, grid: VoxelGrid) -> NDArray[np.float64]:
    """Mean of the given normals of each voxel's points, (v, 3); that of its plane where none is given."""
    of_planes = oriented.planes.normals
    if cloud.normals is None:
        return of_planes
    means = voxel_means(cloud.normals, grid)
    length = np.linalg.norm(means, axis=1, keepdims=True)
    usable = length > 1e-6
    return np.where(usable, means / np.where(usable, length, 1.0), of_planes)
