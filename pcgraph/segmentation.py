# SPDX-License-Identifier: Apache-2.0
"""One call from points to supervoxels, graph, tree and objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.moments import moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.contacts import contacts
from pcgraph.graph.relations import edge_features
from pcgraph.inputs import CleanCloud, clean_cloud, clean_viewpoint, non_negative, positive
from pcgraph.supervoxels.method import SupervoxelMethod, SurfaceGrowth
from pcgraph.tree.growth import segmentation_tree
from pcgraph.tree.linkage import ConvexityLinkage, Linkage
from pcgraph.tree.tree import SegmentationTree
from pcgraph.voxels.grid import VoxelGrid, voxel_grid, voxel_means
from pcgraph.voxels.spacing import median_spacing
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.warp import choose_warp

VOXELS_PER_SPACING = 3.5
SEEDS_PER_VOXEL = 6.0


@dataclass(frozen=True)
class Segmentation:
    """A cloud from fine to coarse.

    Attributes
    ----------
    labels : (n,) or (h, w) int32
        Object of each point, the default cut of the tree; -1 where the point is not finite.
    supervoxels : (n,) or (h, w) int32
        Supervoxel of each point, that is leaf of the tree and node of the graph; -1 where the point is not
        finite.
    graph : AdjacencyGraph
    tree : SegmentationTree
    surface : Surface
        The voxels behind the points.
    voxel_size, seed_size : float, metres
        What was used, given or derived.
    viewpoint : (3,) float64, metres, the points' frame
        What was used, given or derived.
    camera : bool
        Whether voxels grew with depth.
    """

    labels: NDArray[np.int32]
    supervoxels: NDArray[np.int32]
    graph: AdjacencyGraph
    tree: SegmentationTree
    surface: Surface
    voxel_size: float
    seed_size: float
    viewpoint: NDArray[np.float64]
    camera: bool

    def cut(self, n: int | None = None, altitude: float | None = None) -> NDArray[np.int32]:
        """Segment of each point in the input's shape, -1 where not finite; see `SegmentationTree.cut`."""
        return self.on_points(self.tree.cut(n, altitude))

    def on_points(self, values: NDArray[np.int32], missing: int = -1) -> NDArray[np.int32]:
        """Values of supervoxels, (k,) int32, on the points; `missing` where a point is not finite."""
        return np.append(values, values.dtype.type(missing))[self.supervoxels]


def segment(
    points: ArrayLike,
    colors: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    *,
    voxel_size: float | None = None,
    seed_size: float | None = None,
    camera: bool | None = None,
    method: SupervoxelMethod | None = None,
    linkage: Linkage | None = None,
    object_altitude: float | None = None,
) -> Segmentation:
    """Segmentation of a point cloud: supervoxels, their adjacency graph, and the tree on it.

    Parameters
    ----------
    points : (n, 3) or (h, w, 3) float or integer, metres, any frame
        NaN and infinite points are left out and labelled -1. Organised points (h, w, 3) are taken for a
        camera's image in the camera's frame (z forward) unless `viewpoint` or `camera` say otherwise.
    colors : same shape, uint8 0..255 or float 0..1, optional
    normals : same shape, float, optional
        Outward normals; kept in their direction. Where zero or NaN, and without them, they are estimated.
    viewpoint : (3,) float, metres, the points' frame, optional
        Where the sensor stood; estimated normals point to its side, and convexity depends on that. Default:
        the origin for organised clouds and for clouds whose bounding box leaves the origin out; otherwise a
        place high above (+z) the box.
    voxel_size : float, metres, optional
        Their r. Default: 3.5 times the median distance between nearest points, whatever the unit.
    seed_size : float, metres, optional
        Their R_seed, spacing of supervoxels, at least `voxel_size`. Default: 6 times `voxel_size`.
    camera : bool, optional
        Whether voxels grow in proportion to depth z from the viewpoint, being `voxel_size` at the median
        depth, as a camera's pixels do. Default: organised clouds that lie in front of the viewpoint.
    method : SupervoxelMethod, optional
        How voxels become supervoxels; default `SurfaceGrowth()`.
    linkage : Linkage, optional
        How the graph becomes a tree; default `ConvexityLinkage()`, whose altitudes are radians of concavity.
    object_altitude : float, the linkage's unit, optional
        Altitude above which two parts are two objects: the cut that gives `labels`. Default: the linkage's.

    Returns
    -------
    Segmentation
        Every finite point has a supervoxel, every supervoxel is connected (26-neighbourhood of occupied
        voxels), the same points give the same result in any order (up to the rounding of sums) and at any
        number of threads.

    Raises
    ------
    ValueError
        A shape, dtype or value is not as above, or no point is finite.

    Notes
    -----
    Supervoxels: Papon et al. 2013 (VCCS). Convexity: Stein et al. 2014 (LCCP).
    """
    cloud = clean_cloud(points, colors, normals)
    position = clean_viewpoint(viewpoint, cloud.points, len(cloud.shape) == 2)
    voxel_size, seed_size = _sizes(cloud, voxel_size, seed_size)
    method = SurfaceGrowth() if method is None else method
    linkage = ConvexityLinkage() if linkage is None else linkage
    altitude = linkage.object_altitude if object_altitude is None else object_altitude
    altitude = non_negative("object_altitude", altitude)
    camera = _is_camera(cloud, position) if camera is None else bool(camera)
    grid = voxel_grid(cloud.points, cloud.colors, voxel_size, choose_warp(cloud.points, position, camera))
    planes = method.planes(grid, position)
    facing = planes.normals if cloud.normals is None else _given_normals(grid, cloud.normals, planes.normals)
    leaf_of_voxel = method.supervoxels(grid, facing, seed_size)
    leaf_of_point = method.supervoxel_of_point(cloud.points, grid, planes, leaf_of_voxel)
    leaves = moments_of_groups(cloud.points, cloud.colors, leaf_of_point, int(leaf_of_voxel.max()) + 1)
    nodes = node_features(leaves, position)
    touching = contacts(grid, facing, leaf_of_voxel)
    edges = edge_features(nodes, touching)
    graph = AdjacencyGraph(touching.edges, edges, nodes)
    tree = segmentation_tree(linkage.merges(graph, leaves), leaves, position)
    supervoxels = cloud.spread(leaf_of_point)
    labels = cloud.spread(tree.cut(altitude=altitude)[leaf_of_point])
    surface = Surface(grid, facing, leaf_of_voxel)
    return Segmentation(labels, supervoxels, graph, tree, surface, voxel_size, seed_size, position, camera)


def _sizes(cloud: CleanCloud, voxel_size: float | None, seed_size: float | None) -> tuple[float, float]:
    if voxel_size is None:
        spacing = VOXELS_PER_SPACING * median_spacing(cloud.points)
        voxel_size = spacing if seed_size is None else min(spacing, positive("seed_size", seed_size))
    voxel = positive("voxel_size", voxel_size)
    seed = SEEDS_PER_VOXEL * voxel if seed_size is None else positive("seed_size", seed_size)
    if seed < voxel:
        raise ValueError(f"expected seed_size of at least voxel_size, got {seed:g} m < {voxel:g} m")
    return voxel, seed


def _is_camera(cloud: CleanCloud, viewpoint: NDArray[np.float64]) -> bool:
    return len(cloud.shape) == 2 and bool((cloud.points[:, 2] > viewpoint[2]).all())


def _given_normals(grid: VoxelGrid, given: NDArray[np.float64], estimated: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the given normals of each voxel's points; the estimate where there is none."""
    means = voxel_means(given, grid)
    length = np.linalg.norm(means, axis=1, keepdims=True)
    usable = length > 1e-6
    return np.where(usable, means / np.where(usable, length, 1.0), estimated)
