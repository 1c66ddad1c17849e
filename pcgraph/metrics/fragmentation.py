# SPDX-License-Identifier: Apache-2.0
"""Fragmentation curve: the least error that any cut of a tree into r regions has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pcgraph.metrics.hierarchy import children
from pcgraph.metrics.node_table import NodeTable
from pcgraph.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class FragmentationCurve(ShortRepr):
    """Least error against the number of regions of optimal cuts.

    Attributes
    ----------
    regions : (r,) int64, ascending from 1
        Numbers of regions that some cut has; all from 1 on in a binary tree.
    errors : (r,) float64
        Least error of a cut, horizontal or not, into exactly so many regions, 0..1.
    """

    regions: NDArray[np.int64]
    errors: NDArray[np.float64]


def fragmentation_curve(
    parents: ArrayLike,
    leaves: ArrayLike,
    truth: ArrayLike,
    *,
    measure: Literal["consistency", "hamming", "covering"] = "consistency",
    max_regions: int = 200,
) -> FragmentationCurve:
    """Least error of the cuts into 1, 2, ... regions, found exactly (Perret et al. 2018; as in Higra).

    Parameters
    ----------
    parents : (k,) int
        As `SegmentationTree.parents`: larger than the node's number, leaves first, the root its own parent.
    leaves, truth : same shape, int
        Leaf and true label of each point; points negative in either are left out.
    measure : {"consistency", "hamming", "covering"}
        Error is 1 less the sum over regions S, over N, of: sum over G of n min(n / |S|, n / |G|) with n =
        |S and G| (bidirectional consistency); max over G of n (directional Hamming); or |S| max over G of
        IoU(S, G) (directional covering, of the regions by the truth).
    max_regions : int, >= 1

    Raises
    ------
    ValueError
        The tree is not one, max_regions or the measure is out of range, or as `contingency`.
    """
    if isinstance(max_regions, bool) or not isinstance(max_regions, (int, np.integer)) or max_regions < 1:
        raise ValueError(f"expected max_regions as a whole number of at least 1, got {max_regions!r}")
    table = NodeTable.of(parents, leaves, truth)
    best = _optimal_cuts(_scores(table, measure), *children(table.parents), table.n_leaves, int(max_regions))
    regions = np.flatnonzero(np.isfinite(best))
    errors = 1 - best[regions] / table.true_sizes.sum()
    return FragmentationCurve(regions + 1, np.maximum(errors, 0.0))


def _scores(table: NodeTable, measure: str) -> NDArray[np.float64]:
    """What each node adds to the measure as a region, (k,)."""
    if measure == "hamming":
        return table.largest_of_node(table.counts.astype(np.float64))
    if measure == "covering":
        return table.node_sizes * table.largest_of_node(table.overlaps)
    if measure == "consistency":
        larger = np.maximum(table.node_sizes[table.nodes], table.true_sizes[table.segments])
        return table.of_node(table.counts.astype(np.float64) ** 2 / larger)
    raise ValueError(f"expected measure 'consistency', 'hamming' or 'covering', got {measure!r}")


@njit(cache=True)
def _optimal_cuts(
    scores: NDArray[np.float64],
    child_starts: NDArray[np.int64],
    child_row: NDArray[np.int64],
    n_leaves: int,
    limit: int,
) -> NDArray[np.float64]:
    """Largest sum of scores of a cut into 1, 2, ... regions, (at most limit,); -inf where there is none.

    A node with l leaves has at most l regions, so the results of all nodes at one time fit into n_leaves places:
    those of a node begin at the first of its leaves in depth-first order.
    """
    k = len(scores)
    lengths = np.ones(k, np.int64)
    for node in range(n_leaves, k):
        lengths[node] = 0
        for child in child_row[child_starts[node] : child_starts[node + 1]]:
            lengths[node] += lengths[child]
    begins = np.zeros(k, np.int64)
    for node in range(k - 1, n_leaves - 1, -1):
        begin = begins[node]
        for child in child_row[child_starts[node] : child_starts[node + 1]]:
            begins[child] = begin
            begin += lengths[child]
    best = np.full(n_leaves, -np.inf)
    for node in range(k):
        begin, done = begins[node], 0
        for child in child_row[child_starts[node] : child_starts[node + 1]]:
            more = min(lengths[child], limit)
            if done > 0:
                left, right = best[begin : begin + done].copy(), best[begins[child] : begins[child] + more].copy()
                done = min(done + more, limit)
                _combine(left, right, best[begin : begin + done])
            else:
                done = more
        best[begin] = scores[node]
    return best[: min(n_leaves, limit)]


@njit(cache=True)
def _combine(left: NDArray[np.float64], right: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Best sums of a cut of one part with a cut of the other, by the number of regions of both."""
    out[:] = -np.inf
    for i in range(len(left)):
        for j in range(min(len(right), len(out) - 1 - i)):
            out[i + j + 1] = max(out[i + j + 1], left[i] + right[j])
