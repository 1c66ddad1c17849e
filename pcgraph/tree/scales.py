# SPDX-License-Identifier: Apache-2.0
"""Observation scales: Felzenszwalb and Huttenlocher's predicate as a hierarchy."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.tree.single import single_linkage

_NONE = -1


def scale_linkage(
    n_nodes: int, edges: NDArray[np.int32], weights: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Binary merges of nodes at observation scales, until every connected component is one node.

    Parameters
    ----------
    n_nodes : int
    edges : (m, 2) int32
    weights : (m,) float64, >= 0
        Dissimilarity over each edge.

    Returns
    -------
    pairs : (t, 2) int32
        Merge i joins these two into the new node n_nodes + i.
    altitudes : (t,) float64
        Scale k, in units of the weights times nodes; not decreasing.

    Notes
    -----
    Source: Guimaraes et al. 2017. Felzenszwalb and Huttenlocher 2004 merge X and Y over an edge of weight w if
    w <= Int(X) + k / \\|X\\| and the same for Y, that is if k >= D = max((w - Int(X)) \\|X\\|, (w - Int(Y)) \\|Y\\|),
    where Int is the largest weight of a region's minimum spanning tree and \\|X\\| its number of nodes. Edges of
    the minimum spanning forest are taken in ascending order of weight; each gets the least k for which D between
    the regions at its two ends, in the hierarchy made so far and cut at that k, is at most k. The result is
    single linkage over the forest with these k. Time: nodes times the depth of the tree.
    """
    _, _, forest = single_linkage(n_nodes, edges, weights)
    scales = _scales(n_nodes, edges[forest], weights[forest])
    pairs, altitudes, _ = single_linkage(n_nodes, edges[forest], scales)
    return pairs, altitudes


@njit(cache=True)
def _scales(n_nodes: int, edges: NDArray[np.int32], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale of each edge of a forest; the edges come in ascending order of weight.

    Node n_nodes + e is the region that edge e closes. `levels` are the scales at which regions come to be; on
    the way to a root they do not decrease.
    """
    k = n_nodes + len(edges)
    up, levels = np.full(k, _NONE), np.zeros(k)
    sizes, inner = np.ones(k, np.int64), np.zeros(k)
    for e in range(len(edges)):
        a, b, weight = int(edges[e, 0]), int(edges[e, 1]), weights[e]
        while True:  # a and b: the regions at this scale; climb where a region ends before the two may merge
            scale = max((weight - inner[a]) * sizes[a], (weight - inner[b]) * sizes[b], levels[a], levels[b])
            end_a = levels[up[a]] if up[a] != _NONE else np.inf
            end_b = levels[up[b]] if up[b] != _NONE else np.inf
            if scale < min(end_a, end_b):
                break
            if end_a <= end_b:
                a = up[a]
            else:
                b = up[b]
        _join(n_nodes + e, a, b, scale, weight, up, levels, sizes, inner)
    return levels[n_nodes:].copy()


@njit(cache=True)
def _join(node, a, b, scale, weight, up, levels, sizes, inner):  # type: ignore[no-untyped-def]
    """Close a new region over two, and thread the regions above both into one path, each with both sides in it."""
    above_a, above_b = up[a], up[b]
    size_a, size_b = sizes[a], sizes[b]
    up[a] = up[b] = node
    levels[node] = scale
    sizes[node], inner[node] = size_a + size_b, weight
    while above_a != _NONE or above_b != _NONE:
        if above_b == _NONE or (above_a != _NONE and levels[above_a] <= levels[above_b]):
            following, size_a = above_a, sizes[above_a]
            above_a = up[above_a]
        else:
            following, size_b = above_b, sizes[above_b]
            above_b = up[above_b]
        up[node] = following
        node = following
        sizes[node], inner[node] = size_a + size_b, weight
