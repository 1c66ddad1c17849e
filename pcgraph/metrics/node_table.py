# SPDX-License-Identifier: Apache-2.0
"""The sparse contingency table of all nodes of a segmentation tree, built in one pass up the tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pcgraph.metrics.hierarchy import checked_parents, children, count_leaves
from pcgraph.metrics.table import count_pairs, labelled, ranked


@dataclass(frozen=True, eq=False)
class NodeTable:
    """Points that each node of a tree shares with each true segment it meets: p cells, in the nodes' order.

    The cells grow with the number of true segments per node: at most k times g, for balanced trees far fewer.

    Attributes
    ----------
    parents : (k,) int64
        Parent of each node; the first `n_leaves` nodes are leaves, the root is its own parent.
    n_leaves : int
    starts : (k + 1,) int64
        Node i has the cells starts[i] .. starts[i + 1] - 1.
    segments : (p,) int32
        True segment of a cell, 0..g-1 in ascending order of the true labels.
    counts : (p,) int64
        Points of the node in that segment.
    above : (p,) int64
        Cell of the parent that contains this one; -1 at the root.
    node_sizes : (k,) int64
        Points per node.
    true_sizes : (g,) int64
        Points per true segment.
    """

    parents: NDArray[np.int64]
    n_leaves: int
    starts: NDArray[np.int64]
    segments: NDArray[np.int32]
    counts: NDArray[np.int64]
    above: NDArray[np.int64]
    node_sizes: NDArray[np.int64]
    true_sizes: NDArray[np.int64]

    @classmethod
    def of(cls, parents: ArrayLike, leaves: ArrayLike, truth: ArrayLike) -> NodeTable:
        """The table of a tree.

        Parameters
        ----------
        parents : (k,) int
            Parent of each node, larger than the node's own number; the root, last, is its own parent. Nodes that
            are nobody's parent are leaves and come first.
        leaves, truth : same shape, int
            Leaf and true label of each point; points negative in either are left out.

        Raises
        ------
        ValueError
            The parents are not such a tree, a leaf is not in it, or as `contingency`.
        """
        up = checked_parents(parents)
        n_leaves = count_leaves(up)
        leaf, true = labelled(leaves, truth)
        if leaf.max() >= n_leaves:
            raise ValueError(f"expected leaves 0..{n_leaves - 1} of the tree, got {leaf.max()}")
        column, n_true = ranked(true)
        table = count_pairs(leaf, column, (n_leaves, n_true))
        first = np.searchsorted(table.row, np.arange(n_leaves + 1))
        starts, segments, counts, above = _climb(
            up, *children(up), first, table.col.astype(np.int32), table.data, n_true
        )
        true_sizes = np.bincount(column, minlength=n_true)
        owner = np.repeat(np.arange(len(up)), np.diff(starts))
        node_sizes = np.bincount(owner, counts, len(up)).astype(np.int64)
        return cls(up, n_leaves, starts, segments, counts, above, node_sizes, true_sizes)

    @property
    def nodes(self) -> NDArray[np.int64]:
        """Node of each cell, (p,)."""
        return np.repeat(np.arange(len(self.parents)), np.diff(self.starts))

    @property
    def overlaps(self) -> NDArray[np.float64]:
        """Intersection over union of each cell's node with its true segment, (p,), 0..1."""
        return self.counts / (self.node_sizes[self.nodes] + self.true_sizes[self.segments] - self.counts)

    def of_node(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of the cells' values over each node, (k,)."""
        return np.bincount(self.nodes, values, len(self.parents)).astype(np.float64)

    def largest_of_node(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Largest of the cells' values (>= 0) of each node, (k,); 0 for nodes without points."""
        best = np.zeros(len(self.parents))
        np.maximum.at(best, self.nodes, values)
        return best


@njit(cache=True)
def _climb(
    parents: NDArray[np.int64],
    child_starts: NDArray[np.int64],
    child_row: NDArray[np.int64],
    first: NDArray[np.int64],
    leaf_segments: NDArray[np.int32],
    leaf_counts: NDArray[np.int64],
    n_true: int,
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]:
    """Cells of all nodes: starts, segments, counts, above; those of the leaves are given."""
    k, n_leaves, end = len(parents), len(first) - 1, len(leaf_counts)
    starts = np.empty(k + 1, np.int64)
    starts[: n_leaves + 1] = first
    capacity = 4 * end + n_true
    segments, counts = np.empty(capacity, np.int32), np.empty(capacity, np.int64)
    above = np.full(capacity, -1)
    segments[:end], counts[:end] = leaf_segments, leaf_counts
    cell_of = np.full(n_true, -1)  # cell of the node at hand for each true segment; older ones lie before its start
    for node in range(n_leaves, k):
        start = end
        if end + n_true > capacity:
            capacity = 2 * capacity + n_true
            segments, counts = _longer(segments, capacity, 0), _longer(counts, capacity, 0)
            above = _longer(above, capacity, -1)
        for child in child_row[child_starts[node] : child_starts[node + 1]]:
            for cell in range(starts[child], starts[child + 1]):
                segment = segments[cell]
                if cell_of[segment] < start:
                    cell_of[segment] = end
                    segments[end], counts[end] = segment, 0
                    end += 1
                above[cell] = cell_of[segment]
                counts[cell_of[segment]] += counts[cell]
        starts[node + 1] = end
    return starts, segments[:end].copy(), counts[:end].copy(), above[:end].copy()


@njit(cache=True)
def _longer(array: NDArray[np.int64], length: int, filler: int) -> NDArray[np.int64]:
    longer = np.full(length, filler, array.dtype)
    longer[: len(array)] = array
    return longer
