# SPDX-License-Identifier: Apache-2.0
"""Mumford and Shah's energies of a tree's nodes: the misfit of a segment's points, and the length of its outline."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.hierarchy import accumulate_sequential, lowest_common_ancestors
from pcgraph.parallel import kernel
from pcgraph.tree.optimal_cut import Energy
from pcgraph.tree.tree import SegmentationTree


def plane_energy(tree: SegmentationTree, graph: AdjacencyGraph | None = None) -> Energy:
    """Mumford-Shah energy with planes: squared distances to each segment's best plane, and outlines.

    Parameters
    ----------
    tree : SegmentationTree
    graph : AdjacencyGraph, optional
        Graph of the tree's leaves. With it, complexity is the length of contact with other segments in metres, and the
        unit of the scale is square metres x points per metre. Without it, complexity counts segments, and the unit of
        the scale is square metres x points.

    Raises
    ------
    ValueError
        The graph is not of the tree's leaves, or the tree has no moments.
    """
    return Energy(tree.sizes * tree.features().residual ** 2, _complexity(tree, graph))


def variance_energy(tree: SegmentationTree, values: ArrayLike, graph: AdjacencyGraph | None = None) -> Energy:
    """Piecewise constant Mumford-Shah energy: squared distances of leaves' values to their segment's mean.

    Parameters
    ----------
    tree : SegmentationTree
    values : (n_leaves, d) float
        For example colours or normals of the supervoxels; each leaf counts as often as it has points.
    graph : AdjacencyGraph, optional
        As for `plane_energy`.

    Raises
    ------
    ValueError
        Values are not (n_leaves, d), or not finite; or the graph is not of the tree's leaves.
    """
    rows = np.asarray(values, np.float64)
    if rows.ndim != 2 or len(rows) != tree.n_leaves or not np.isfinite(rows).all():
        raise ValueError(f"expected finite values ({tree.n_leaves}, d), got shape {rows.shape}; give one row per leaf")
    return Energy(_variances(tree.parents, tree.sizes, rows), _complexity(tree, graph))


def boundary_lengths(tree: SegmentationTree, graph: AdjacencyGraph) -> NDArray[np.float64]:
    """Length of each node's contact with everything outside it, (k,) float64, metres.

    Parameters
    ----------
    tree : SegmentationTree
    graph : AdjacencyGraph of the tree's leaves

    Raises
    ------
    ValueError
        The graph has another number of nodes than the tree has leaves.
    """
    if graph.n_nodes != tree.n_leaves:
        raise ValueError(f"expected a graph of the tree's {tree.n_leaves} leaves, got one of {graph.n_nodes} nodes")
    k, lengths = len(tree.parents), graph.edge_features.contact_length
    outlines = np.bincount(graph.edges.ravel(), np.repeat(lengths, 2), k).astype(np.float64)
    # An edge is inside the lowest common ancestor of its ends, and nodes above: both its sides leave the outline there.
    meeting = lowest_common_ancestors(tree.parents, *graph.edges.T)
    outlines -= 2.0 * np.bincount(meeting, lengths, k)
    return np.maximum(accumulate_sequential(tree.parents, outlines), 0.0)


def _complexity(tree: SegmentationTree, graph: AdjacencyGraph | None) -> NDArray[np.float64]:
    return np.ones(len(tree.parents)) if graph is None else boundary_lengths(tree, graph)


@kernel
def _variances(
    parents: NDArray[np.int32], counts: NDArray[np.int64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sums of squares about each node's mean, by the pairwise update of Chan, Golub and LeVeque 1979."""
    k, d = len(parents), values.shape[1]
    sums, means, seen = np.zeros(k), np.zeros((k, d)), np.zeros(k, np.int64)
    for node in range(k):
        if node < len(values):
            means[node] = values[node]
        up = parents[node]
        if up == node:
            continue
        total = seen[up] + counts[node]
        fraction = counts[node] / total
        for i in range(d):
            gap = means[node, i] - means[up, i]
            sums[up] += seen[up] * fraction * gap * gap
            means[up, i] += fraction * gap
        sums[up] += sums[node]
        seen[up] = total
    return sums
