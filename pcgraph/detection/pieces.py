# SPDX-License-Identifier: Apache-2.0
"""From supervoxels above a support to those of each thing on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from pcgraph.detection.boxes import plane_basis, standing_box
from pcgraph.detection.flat_leaves import voxel_edges
from pcgraph.detection.fragments import joined_fragments
from pcgraph.detection.hulls import inside_outline, outline
from pcgraph.detection.planes import Planes
from pcgraph.segmentation import Segmentation

LEAST_CLEARANCE = 0.5  # voxel edges between the support and the centroid of a supervoxel above it
GAP = 8.0  # voxel edges, across which the inside of a cup may belong to its outside
NARROW = 0.5  # the same, in lengths of the larger one's footprint
LEVEL = 2.0  # voxel edges by which their tops may differ


def supervoxels_above(
    segmentation: Segmentation, planes: Planes, index: int, up: NDArray[np.float64], bottom: float, margin: float
) -> NDArray[np.bool_]:
    """Which supervoxels lie above the plane within its outline, without being part of it."""
    basis = plane_basis(up)
    edges = voxel_edges(segmentation)
    centroids = segmentation.graph.node_features.centroid
    inside = inside_outline(centroids @ basis.T, outline(planes.outlines[index] @ basis.T), margin)
    clear = centroids @ up - bottom > LEAST_CLEARANCE * edges
    return inside & clear & (planes.plane_of_supervoxel != index)


def connected_pieces(segmentation: Segmentation, above: NDArray[np.bool_]) -> list[NDArray[np.int32]]:
    """Connected parts of segments among the chosen supervoxels, most points first."""
    n, segment = segmentation.tree.n_leaves, segmentation.objects
    i, j = segmentation.graph.edges.T
    kept = above[i] & above[j] & (segment[i] == segment[j])
    links = csr_array((np.ones(int(kept.sum()), np.int8), (i[kept], j[kept])), shape=(n, n))
    _, part = connected_components(links, directed=False)
    leaves = np.flatnonzero(above).astype(np.int32)
    parts = [leaves[part[leaves] == p] for p in np.unique(part[leaves])]
    sizes = segmentation.graph.node_features.size
    return sorted(parts, key=lambda part: (-int(sizes[part].sum()), int(part[0])))


def gathered(
    segmentation: Segmentation,
    planes: Planes,
    index: int,
    pieces: list[NDArray[np.int32]],
    up: NDArray[np.float64],
    bottom: float,
    edge: float,
) -> list[NDArray[np.int32]]:
    """Supervoxels of objects, from those of their pieces."""
    if not pieces:
        return []
    surface, (i, j) = segmentation.surface, segmentation.graph.edges.T
    support = planes.plane_of_supervoxel == index
    at_support = np.zeros(segmentation.tree.n_leaves, bool)
    at_support[i[support[j]]] = at_support[j[support[i]]] = True
    members = [np.isin(surface.supervoxels, leaves) for leaves in pieces]
    places, normals = [surface.grid.centroids[m] for m in members], [surface.normals[m] for m in members]
    boxes = [standing_box(place, up, bottom) for place in places]
    inside = np.array([[box.contains(place, edge).mean() for place in places] for box in boxes])
    floating = np.array([not at_support[leaves].any() for leaves in pieces])
    reach = np.minimum(GAP * edge, NARROW * np.array([box.size[0] for box in boxes]))
    part = joined_fragments(places, normals, [place @ up for place in places], floating, inside, reach, LEVEL * edge)
    return [
        np.sort(np.concatenate([leaves for leaves, its in zip(pieces, part, strict=True) if its == p]))
        for p in range(int(part.max()) + 1)
    ]
