# SPDX-License-Identifier: Apache-2.0
"""Felzenszwalb and Huttenlocher's segmentation as a tree over its scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph, EdgeFeatures
from pcgraph.hierarchy import NONE
from pcgraph.parallel import kernel, routine
from pcgraph.tree.linkage import Linkage, Merges
from pcgraph.tree.single_linkage import minimum_spanning_forest, single_linkage


@dataclass(frozen=True)
class FelzenszwalbLinkage(Linkage):
    """Felzenszwalb and Huttenlocher 2004 over all scales at once; altitudes are their k.

    Notes
    -----
    The hierarchy is that of Guimaraes et al. 2017 (see `scale_linkage`). The edge weight is ScanNet's: 1 - n . n' of
    the supervoxels' normals, squared if convex (Dai et al. 2017). A region's size is its number of supervoxels.
    """

    default_object_altitude = 20.0  # k, edge weight times supervoxels; chosen on 12 clouds of tables (docs/tree.md)
    default_part_altitude = 0.5  # the same; the seven faces of two synthetic boxes on a plane are the parts

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the smallest scale first."""
        return scale_linkage(graph.n_nodes, graph.edges, normal_contrast(graph.edge_features))


def normal_contrast(features: EdgeFeatures) -> NDArray[np.float64]:
    """ScanNet's edge weight, (m,) float64, 0..4: 1 less the cosine between normals, squared if convex.

    Parameters
    ----------
    features : EdgeFeatures of m edges
    """
    contrast = 1.0 - np.cos(features.normal_angle)
    return np.where(features.convexity > 0.0, contrast**2, contrast)


def scale_linkage(n_nodes: int, edges: NDArray[np.int32], weights: NDArray[np.float64]) -> Merges:
    """Merges of nodes at the observation scales of Felzenszwalb and Huttenlocher's predicate.

    Parameters
    ----------
    n_nodes : int
    edges : (m, 2) int32
    weights : (m,) float64, >= 0
        Dissimilarity over each edge.

    Returns
    -------
    Merges
        Altitudes are scales k, in units of the weights times nodes.

    Notes
    -----
    Source: Guimaraes et al. 2017. Felzenszwalb and Huttenlocher 2004 merge X and Y over an edge of weight w if
    w <= Int(X) + k / \\|X\\| and the same for Y, that is if k >= D = max((w - Int(X)) \\|X\\|, (w - Int(Y)) \\|Y\\|),
    where Int is the largest weight of a region's minimum spanning tree and \\|X\\| its number of nodes. Edges of
    the minimum spanning forest are taken in ascending order of weight. Each gets the least k for which D is at most k,
    where X and Y are the regions at its two ends in the hierarchy made so far, cut at that k. The result is single
    linkage over the forest with these k. Time: nodes times the depth of the tree.
    """
    _, forest = minimum_spanning_forest(n_nodes, edges, weights)
    return single_linkage(n_nodes, edges[forest], _scales(n_nodes, edges[forest], weights[forest]))


class _Regions(NamedTuple):
    """Regions of the hierarchy made so far, k of them.

    Attributes
    ----------
    up : (k,) int64
        Region above each, or -1; on the way to a root, `levels` do not decrease.
    levels : (k,) float64
        Scale at which each region comes to be.
    sizes : (k,) int64
        Number of its nodes.
    inner : (k,) float64
        Largest weight of its minimum spanning tree: their Int.
    """

    up: NDArray[np.int64]
    levels: NDArray[np.float64]
    sizes: NDArray[np.int64]
    inner: NDArray[np.float64]


@kernel
def _scales(n_nodes: int, edges: NDArray[np.int32], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale of each edge of a forest, the edges in ascending order of weight; edge e closes region n_nodes + e."""
    k = n_nodes + len(edges)
    regions = _Regions(np.full(k, NONE), np.zeros(k), np.ones(k, np.int64), np.zeros(k))
    up, levels, sizes, inner = regions
    for e in range(len(edges)):
        a, b, weight = int(edges[e, 0]), int(edges[e, 1]), weights[e]
        while True:  # climb from a, or b, as long as that region ends at a scale where the two may not yet merge
            scale = max((weight - inner[a]) * sizes[a], (weight - inner[b]) * sizes[b], levels[a], levels[b])
            end_a = levels[up[a]] if up[a] != NONE else np.inf
            end_b = levels[up[b]] if up[b] != NONE else np.inf
            if scale < min(end_a, end_b):
                break
            if end_a <= end_b:
                a = up[a]
            else:
                b = up[b]
        levels[n_nodes + e] = scale
        _join(regions, n_nodes + e, a, b, weight)
    return levels[n_nodes:].copy()


@routine
def _join(regions: _Regions, node: int, a: int, b: int, weight: float) -> None:
    """Close a new region over two, and merge the paths above both into one, whose regions then hold both."""
    up, levels, sizes, inner = regions
    above_a, above_b = up[a], up[b]
    size_a, size_b = sizes[a], sizes[b]
    up[a] = up[b] = node
    sizes[node], inner[node] = size_a + size_b, weight
    while above_a != NONE or above_b != NONE:
        if above_b == NONE or (above_a != NONE and levels[above_a] <= levels[above_b]):
            following, size_a = above_a, sizes[above_a]
            above_a = up[above_a]
        else:
            following, size_b = above_b, sizes[above_b]
            above_b = up[above_b]
        up[node] = following
        node = following
        sizes[node], inner[node] = size_a + size_b, weight
