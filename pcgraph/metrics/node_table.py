# SPDX-License-Identifier: Apache-2.0
"""The contingency table of all nodes of a segmentation tree, from which the metrics of trees are computed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.hierarchy import ChildLists, checked_parents, child_lists, num_leaves
from pcgraph.metrics.labellings import count_pairs, labelled, largest_of_groups, relabel_sequential
from pcgraph.parallel import kernel


class HasParentsAndAltitudes(Protocol):
    """A tree such as `SegmentationTree`."""

    @property
    def parents(self) -> ArrayLike: ...

    @property
    def altitudes(self) -> ArrayLike: ...


TreeLike = HasParentsAndAltitudes | tuple[ArrayLike, ArrayLike]
"""A tree, as metrics take it: a `SegmentationTree`, or the pair (parents, altitudes).

parents : (k,) int
    Parent of each node, larger than the node's own number; the root, last, is its own parent. Leaves come first.
altitudes : (k,) float
    Not below those of the children; may be infinite. Altitudes of leaves do not count. Metrics of nodes, in place of
    cuts, use no altitudes.
"""


def parents_and_altitudes(tree: TreeLike) -> tuple[NDArray[np.int32], ArrayLike]:
    """Parents of a tree, (k,) int32, checked, and its altitudes, unchecked.

    Raises
    ------
    ValueError
        It is neither a tree nor a pair, or the parents are not those of a hierarchy.
    """
    if isinstance(tree, tuple) and len(tree) == 2:
        parents, altitudes = tree
        return checked_parents(parents), altitudes
    try:
        parents, altitudes = tree.parents, tree.altitudes  # type: ignore[union-attr]
    except AttributeError:
        kind = type(tree).__name__
        raise ValueError(f"expected a SegmentationTree or a pair (parents, altitudes), got {kind}") from None
    return checked_parents(parents), altitudes


class Cells(NamedTuple):
    """Cells of a sparse contingency table of nodes and true segments: p cells, in the order of the nodes.

    Attributes
    ----------
    starts : (k + 1,) int64
        Node i has the cells starts[i] .. starts[i + 1] - 1.
    segments : (p,) int32
        True segment of each cell, 0..g-1 in ascending order of the true labels.
    counts : (p,) int64
        Number of points of the node in that segment, > 0.
    above : (p,) int64
        Cell of the parent that contains each cell; -1 at the root.
    """

    starts: NDArray[np.int64]
    segments: NDArray[np.int32]
    counts: NDArray[np.int64]
    above: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class NodeTable:
    """Number of points in each pair of a tree's node and a true segment, for all pairs that have points.

    There are at most k times g cells; balanced trees have far fewer.

    Attributes
    ----------
    parents : (k,) int32
        Parent of each node; the first `n_leaves` nodes are leaves, the root is its own parent.
    children : ChildLists
    cells : Cells
    node_sizes : (k,) int64
        Number of points of each node.
    true_sizes : (g,) int64
        Number of points of each true segment.
    """

    parents: NDArray[np.int32]
    children: ChildLists
    cells: Cells
    node_sizes: NDArray[np.int64]
    true_sizes: NDArray[np.int64]

    @classmethod
    def of(cls, tree: TreeLike, leaves: ArrayLike, truth: ArrayLike) -> NodeTable:
        """The table of a tree.

        Parameters
        ----------
        tree : SegmentationTree, or pair (parents, altitudes)
        leaves, truth : same shape, int
            Leaf and true label of each point; points negative in either are left out.

        Raises
        ------
        ValueError
            The tree is not one, a leaf is not in it, or as `contingency`.
        """
        parents, _ = parents_and_altitudes(tree)
        n_leaves = num_leaves(parents)
        leaf, true = labelled(leaves, truth)
        if leaf.max() >= n_leaves:
            raise ValueError(f"expected leaves 0..{n_leaves - 1} of the tree, got {leaf.max()}")
        column, n_true = relabel_sequential(true)
        table = count_pairs(leaf, column, (n_leaves, n_true))
        starts = np.searchsorted(table.row, np.arange(n_leaves + 1))
        children = child_lists(parents)
        cells = Cells(*_accumulate_cells(children, starts, table.col.astype(np.int32), table.data, n_true))
        node = np.repeat(np.arange(len(parents)), np.diff(cells.starts))
        node_sizes = np.bincount(node, cells.counts, len(parents)).astype(np.int64)
        return cls(parents, children, cells, node_sizes, np.bincount(column, minlength=n_true))

    @property
    def n_leaves(self) -> int:
        """Number of leaves."""
        return num_leaves(self.parents)

    @property
    def n_points(self) -> float:
        """Number of points."""
        return float(self.true_sizes.sum())

    @cached_property
    def nodes(self) -> NDArray[np.int64]:
        """Node of each cell, (p,)."""
        return np.repeat(np.arange(len(self.parents)), np.diff(self.cells.starts))

    @cached_property
    def overlaps(self) -> NDArray[np.float64]:
        """Intersection over union of each cell's node and true segment, (p,), 0..1."""
        counts = self.cells.counts
        return counts / (self.node_sizes[self.nodes] + self.true_sizes[self.cells.segments] - counts)

    def sum_of_nodes(self, values: NDArray[np.number]) -> NDArray[np.float64]:
        """Sum of the cells' values (p,) of each node, (k,)."""
        return np.bincount(self.nodes, values, len(self.parents)).astype(np.float64)

    def largest_of_nodes(self, values: NDArray[np.number]) -> NDArray[np.float64]:
        """Largest of the cells' values (p,), >= 0, of each node, (k,); 0 for nodes without points."""
        return largest_of_groups(values, self.nodes, len(self.parents))

    def sums_over_cuts(self, order: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of the nodes' values (k,) over the segments of each cut: the leaves, and after each merge, (t + 1,).

        Parameters
        ----------
        order : (t,) int64
            Nodes other than leaves in the order of merging.
        values : (k,) float64
        """
        of_children = np.bincount(self.parents[:-1], values[:-1], len(values))
        steps = values[order] - of_children[order]
        return np.concatenate([[0.0], np.cumsum(steps)]) + values[: self.n_leaves].sum()


@kernel
def _accumulate_cells(
    children: ChildLists,
    leaf_starts: NDArray[np.int64],
    leaf_segments: NDArray[np.int32],
    leaf_counts: NDArray[np.int64],
    n_true: int,
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]:
    """Fields of the `Cells` of all nodes, from those of the leaves."""
    k, n_leaves, end = len(children.starts) - 1, len(leaf_starts) - 1, len(leaf_counts)
    starts = np.empty(k + 1, np.int64)
    starts[: n_leaves + 1] = leaf_starts
    capacity = 4 * end + n_true
    segments, counts = np.empty(capacity, np.int32), np.empty(capacity, np.int64)
    above = np.full(capacity, -1)
    segments[:end], counts[:end] = leaf_segments, leaf_counts
    cell_of = np.full(n_true, -1)  # this node's cell of each true segment; numbers below `start` are of earlier nodes
    for node in range(n_leaves, k):
        start = end
        if end + n_true > capacity:
            capacity = 2 * capacity + n_true
            segments, counts = _enlarged(segments, capacity, 0), _enlarged(counts, capacity, 0)
            above = _enlarged(above, capacity, -1)
        for child in children.nodes[children.starts[node] : children.starts[node + 1]]:
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


@kernel
def _enlarged(array: NDArray[np.int64], length: int, filler: int) -> NDArray[np.int64]:
    longer = np.full(length, filler, array.dtype)
    longer[: len(array)] = array
    return longer
