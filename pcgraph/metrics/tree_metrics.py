# SPDX-License-Identifier: Apache-2.0
"""Metrics of whole trees: the best nodes, the best cuts of any kind, and the purity of the nodes.

Metrics of horizontal cuts are in `level_curves`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.hierarchy import ChildLists, accumulate_sequential
from pcgraph.metrics.labellings import count_point_pairs, largest_of_groups
from pcgraph.metrics.node_table import NodeTable, TreeLike
from pcgraph.parallel import kernel
from pcgraph.plumbing.short_repr import ShortRepr


def tree_oracle(tree: TreeLike, leaves: ArrayLike, truth: ArrayLike) -> float:
    """Segmentation covering, 0..1, if each true segment takes the node of largest IoU in the whole tree.

    No cut has a higher covering, horizontal or not ("Best" of Arbelaez et al. 2011).

    Parameters
    ----------
    tree : SegmentationTree, or pair (parents, altitudes)
        parents (k,) int: larger than the node's number, leaves first, the root its own parent. Altitudes do not count.
    leaves, truth : same shape, int
        Leaf and true label of each point; points negative in either are left out.

    Raises
    ------
    ValueError
        The tree is not one, or as `contingency`.
    """
    table = NodeTable.of(tree, leaves, truth)
    best = largest_of_groups(table.overlaps, table.cells.segments, len(table.true_sizes))
    return float(best @ table.true_sizes / table.true_sizes.sum())


def dendrogram_purity(tree: TreeLike, leaves: ArrayLike, truth: ArrayLike) -> float:
    """Dendrogram purity, 0..1 (Heller and Ghahramani 2005), exactly, without sampling of pairs.

    For each pair of points of one true segment, take the fraction of that segment in the lowest common ancestor of the
    two points, which is the leaf for points of one leaf. The purity is the mean over all such pairs, or 1 if there are
    none. Parameters and errors are those of `tree_oracle`.
    """
    table = NodeTable.of(tree, leaves, truth)
    cells = table.cells
    pairs = count_point_pairs(cells.counts)
    below = cells.above >= 0
    of_children = np.bincount(cells.above[below], pairs[below], len(pairs))
    total = float(count_point_pairs(table.true_sizes).sum())
    if total == 0:
        return 1.0
    return float((pairs - of_children) @ (cells.counts / table.node_sizes[table.nodes]) / total)


@dataclass(frozen=True, eq=False)
class FragmentationCurve(ShortRepr):
    """Least error against the number of regions of optimal cuts.

    Attributes
    ----------
    regions : (r,) int64, ascending from 1
        Numbers of regions that some cut has; in a binary tree all from 1 on.
    errors : (r,) float64
        Least error of a cut, horizontal or not, into exactly so many regions, 0..1.
    """

    regions: NDArray[np.int64]
    errors: NDArray[np.float64]


def fragmentation_curve(
    tree: TreeLike,
    leaves: ArrayLike,
    truth: ArrayLike,
    *,
    measure: Literal["consistency", "hamming", "covering"] = "consistency",
    max_regions: int = 200,
) -> FragmentationCurve:
    """Least error of any cut into 1, 2, ... regions, found exactly (Perret et al. 2018; as in Higra).

    Parameters
    ----------
    tree, leaves, truth
        As for `tree_oracle`.
    measure : {"consistency", "hamming", "covering"}
        The error is 1 less the sum of the terms of all regions S, over N. With n = |S and G|, the term is the sum over
        G of n min(n / |S|, n / |G|) (bidirectional consistency), the maximum over G of n (directional Hamming), or |S|
        times the maximum over G of IoU(S, G) (directional covering, of the regions by the truth).
    max_regions : int, >= 1

    Raises
    ------
    ValueError
        The tree is not one, max_regions or the measure is out of range, or as `contingency`.
    """
    if isinstance(max_regions, bool) or not isinstance(max_regions, (int, np.integer)) or max_regions < 1:
        raise ValueError(f"expected max_regions as a whole number of at least 1, got {max_regions!r}")
    table = NodeTable.of(tree, leaves, truth)
    leaf_counts = accumulate_sequential(table.parents, np.ones(table.n_leaves, np.int64))
    best = _optimal_cuts(_scores_of_nodes(table, measure), table.children, leaf_counts, int(max_regions))
    regions = np.flatnonzero(np.isfinite(best))
    errors = 1 - best[regions] / table.true_sizes.sum()
    return FragmentationCurve(regions + 1, np.maximum(errors, 0.0))


def _scores_of_nodes(table: NodeTable, measure: str) -> NDArray[np.float64]:
    """Term of each node in the measure, as a region, (k,)."""
    counts = table.cells.counts.astype(np.float64)
    if measure == "hamming":
        return table.largest_of_nodes(counts)
    if measure == "covering":
        return table.node_sizes * table.largest_of_nodes(table.overlaps)
    if measure == "consistency":
        larger = np.maximum(table.node_sizes[table.nodes], table.true_sizes[table.cells.segments])
        return table.sum_of_nodes(counts**2 / larger)
    raise ValueError(f"expected measure 'consistency', 'hamming' or 'covering', got {measure!r}")


@kernel
def _optimal_cuts(
    scores: NDArray[np.float64], children: ChildLists, leaf_counts: NDArray[np.int64], limit: int
) -> NDArray[np.float64]:
    """Largest sum of scores of a cut into 1, 2, ... regions, (at most limit,); -inf where there is no such cut.

    A node with l leaves has at most l regions, so the results of all nodes in progress fit into n_leaves places. Those
    of a node begin at the place of its first leaf in depth-first order.
    """
    k, n_leaves = len(scores), leaf_counts[-1]
    begins = np.zeros(k, np.int64)
    for node in range(k - 1, n_leaves - 1, -1):
        begin = begins[node]
        for child in children.nodes[children.starts[node] : children.starts[node + 1]]:
            begins[child] = begin
            begin += leaf_counts[child]
    best = np.full(n_leaves, -np.inf)
    for node in range(k):
        begin, done = begins[node], 0
        for child in children.nodes[children.starts[node] : children.starts[node + 1]]:
            more = min(leaf_counts[child], limit)
            if done > 0:
                left, right = best[begin : begin + done].copy(), best[begins[child] : begins[child] + more].copy()
                done = min(done + more, limit)
                _combine(left, right, best[begin : begin + done])
            else:
                done = more
        best[begin] = scores[node]
    return best[: min(n_leaves, limit)]


@kernel
def _combine(left: NDArray[np.float64], right: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Set `out` to the best sums of a cut of one part and a cut of the other, by the number of regions of both."""
    out[:] = -np.inf
    for i in range(len(left)):
        for j in range(min(len(right), len(out) - 1 - i)):
            out[i + j + 1] = max(out[i + j + 1], left[i] + right[j])
