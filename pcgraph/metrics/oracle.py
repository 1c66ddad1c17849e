# SPDX-License-Identifier: Apache-2.0
"""What the nodes of a tree could give at best, and how pure they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.metrics.node_table import NodeTable
from pcgraph.metrics.table import largest


def tree_oracle(parents: ArrayLike, leaves: ArrayLike, truth: ArrayLike) -> float:
    """Weighted overlap, 0..1, if each true segment might take the best node of the whole tree.

    No cut does better, horizontal or not ("Best" of Arbelaez et al. 2011).

    Parameters
    ----------
    parents : (k,) int
        As `SegmentationTree.parents`: larger than the node's number, leaves first, the root its own parent.
    leaves, truth : same shape, int
        Leaf and true label of each point; points negative in either are left out.

    Raises
    ------
    ValueError
        The tree is not one, or as `contingency`.
    """
    table = NodeTable.of(parents, leaves, truth)
    best = largest(table.overlaps, table.segments, len(table.true_sizes))
    return float(best @ table.true_sizes / table.true_sizes.sum())


def dendrogram_purity(parents: ArrayLike, leaves: ArrayLike, truth: ArrayLike) -> float:
    """Dendrogram purity, 0..1, its exact expectation (Heller and Ghahramani 2005).

    Mean over all pairs of points of one true segment of the share of that segment in the smallest node that holds
    both. Points of one leaf meet in the leaf. 1 if there is no such pair. Parameters and errors as `tree_oracle`.
    """
    table = NodeTable.of(parents, leaves, truth)
    pairs = table.counts * (table.counts - 1.0) / 2
    below = table.above >= 0
    met = np.bincount(table.above[below], pairs[below], len(pairs))
    everything = float((table.true_sizes * (table.true_sizes - 1.0) / 2).sum())
    if everything == 0:
        return 1.0
    return float((pairs - met) @ (table.counts / table.node_sizes[table.nodes]) / everything)
