# SPDX-License-Identifier: Apache-2.0
"""What becomes of a scan: the whole algorithm, from voxels to objects, on one page."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments, joined_moments, moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.contacts import contacts, edge_features
from pcgraph.inputs import CleanCloud, non_negative
from pcgraph.parallel import side_by_side
from pcgraph.segmentation import Segmentation
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.tree.growth import segmentation_tree
from pcgraph.tree.linkage import Linkage
from pcgraph.voxels.grid import VoxelGrid, voxel_means
from pcgraph.voxels.surface import Surface


@dataclass(frozen=True)
class Settings:
    """How the scan is segmented, checked."""

    method: SupervoxelMethod
    linkage: Linkage
    object_altitude: float

    @classmethod
    def of(cls, method: SupervoxelMethod, linkage: Linkage, object_altitude: float | None) -> Settings:
        if not isinstance(method, SupervoxelMethod):
            raise ValueError(f"expected a method such as pcgraph.SurfaceGrowth() or pcgraph.Vccs(), got {method!r}")
        if not isinstance(linkage, Linkage):
            raise ValueError(f"expected a linkage such as pcgraph.ConvexityLinkage(), got {linkage!r}")
        altitude = linkage.object_altitude if object_altitude is None else object_altitude
        return cls(method, linkage, non_negative("object_altitude", altitude))


@dataclass(frozen=True)
class Scan:
    """Points to be segmented, and what they lie in.

    Attributes
    ----------
    cloud : CleanCloud of n points
    viewpoint : (3,) or (n, 3) float64, metres
    grid : VoxelGrid of v voxels
        All that has been seen; its `voxel_of_point` speaks of these points.
    orientation_points : (3,) or (v, 3) float64, metres
        A place on the outer side of each voxel's surface.
    initial_labels : (v,) int32
        Supervoxels of earlier scans, -1 elsewhere.
    seed_size : float, metres
    """

    cloud: CleanCloud
    viewpoint: NDArray[np.float64]
    grid: VoxelGrid
    orientation_points: NDArray[np.float64]
    initial_labels: NDArray[np.int32]
    seed_size: float


def segmentation(scan: Scan, earlier: Segmentation | None, settings: Settings) -> Segmentation:
    """The algorithm from voxels on."""
    cloud, grid, method, linkage = scan.cloud, scan.grid, settings.method, settings.linkage
    planes = method.planes(grid, scan.orientation_points)
    normals = planes.normals if cloud.normals is None else _given_normals(grid, cloud.normals, planes.normals)
    if earlier is not None:
        normals = normals.copy()  # the planes keep their own
        normals[scan.initial_labels >= 0] = earlier.surface.normals
    supervoxels = method.supervoxels(grid, normals, scan.seed_size, scan.initial_labels)
    leaf_of_point = method.supervoxel_of_point(cloud.points, grid, planes, supervoxels)
    surface = Surface(grid, normals, supervoxels)
    leaves, touching = side_by_side(
        lambda: _leaves(cloud, surface, leaf_of_point, earlier), lambda: contacts(grid, normals, supervoxels)
    )
    nodes = node_features(leaves)
    graph = AdjacencyGraph(touching.edges, edge_features(nodes, touching), nodes)
    tree = segmentation_tree(linkage.merges(graph, leaves), leaves)
    objects = tree.cut(altitude=settings.object_altitude)
    return Segmentation(
        labels=cloud.spread(objects[leaf_of_point]),
        supervoxels=cloud.spread(leaf_of_point),
        objects=objects,
        graph=graph,
        tree=tree,
        surface=surface,
        seed_size=scan.seed_size,
        viewpoint=scan.viewpoint,
        **vars(settings),
    )


def _leaves(
    cloud: CleanCloud, surface: Surface, leaf_of_point: NDArray[np.int32], earlier: Segmentation | None
) -> Moments:
    """Moments of the supervoxels' points, with those of earlier scans."""
    n_leaves = int(surface.supervoxels.max()) + 1
    if earlier is None:
        leaves = moments_of_groups(cloud.points, cloud.colors, leaf_of_point, n_leaves)
    else:
        found, group = np.unique(leaf_of_point, return_inverse=True)
        gained = moments_of_groups(cloud.points, cloud.colors, group.astype(np.int32), len(found))
        leaves = joined_moments(replace(earlier.leaves, normals=None), gained, found, n_leaves)
    return replace(leaves, normals=surface.mean_normals(n_leaves))


def _given_normals(grid: VoxelGrid, given: NDArray[np.float64], estimated: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the given normals of each voxel's points; the estimate where there is none."""
    means = voxel_means(given, grid)
    length = np.linalg.norm(means, axis=1, keepdims=True)
    usable = length > 1e-6
    return np.where(usable, means / np.where(usable, length, 1.0), estimated)
