# SPDX-License-Identifier: Apache-2.0
"""Scores of all horizontal cuts of a tree at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.metrics.hierarchy import Cuts
from pcgraph.metrics.node_table import NodeTable
from pcgraph.metrics.rand_index import rand_from_pairs
from pcgraph.metrics.tournament import overlap_of_cuts
from pcgraph.short_repr import ShortRepr

Score = Literal[
    "weighted_overlap",
    "achievable_accuracy",
    "undersegmentation_error",
    "adjusted_rand_index",
    "variation_of_information",
]


@dataclass(frozen=True, eq=False)
class LevelCurve(ShortRepr):
    """One score of every distinct cut of a tree, from the leaves to the root.

    Attributes
    ----------
    score : str
        Which score.
    altitudes : (l,) float64, ascending
        The cut from this altitude on, up to the next: all merges up to it are done. -inf for the leaves alone.
    regions : (l,) int64
        Number of segments, those without labelled points counted.
    values : (l,) float64
        The score.
    """

    score: str
    altitudes: NDArray[np.float64]
    regions: NDArray[np.int64]
    values: NDArray[np.float64]

    def at(self, altitudes: ArrayLike) -> NDArray[np.float64]:
        """The score of the cuts at these altitudes, in their shape."""
        return self.values[np.searchsorted(self.altitudes, np.asarray(altitudes, np.float64), side="right") - 1]


def level_curve(
    parents: ArrayLike,
    altitudes: ArrayLike,
    leaves: ArrayLike,
    truth: ArrayLike,
    *,
    score: Score = "weighted_overlap",
) -> LevelCurve:
    """One score of every distinct horizontal cut, from one pass up the tree.

    Parameters
    ----------
    parents : (k,) int
        As `SegmentationTree.parents`: larger than the node's number, leaves first, the root its own parent.
    altitudes : (k,) float
        Not below those of the children; may be infinite. Those of the leaves do not matter.
    leaves, truth : same shape, int
        Leaf and true label of each point; points negative in either are left out.
    score : str
        A metric of this package by its name, each with its defaults.

    Raises
    ------
    ValueError
        The tree is not one, altitudes decrease or are NaN, the score is unknown, or as `contingency`.
    """
    if score not in get_args(Score):
        raise ValueError(f"expected a score of {', '.join(get_args(Score))}; got {score!r}")
    table = NodeTable.of(parents, leaves, truth)
    cuts = Cuts.of(table.parents, altitudes)
    values = overlap_of_cuts(table, cuts.order) if score == "weighted_overlap" else _additive(table, cuts.order, score)
    return LevelCurve(score, cuts.altitudes, cuts.regions, values[cuts.done])


def _additive(table: NodeTable, order: NDArray[np.int64], score: str) -> NDArray[np.float64]:
    """A score made of sums over segments, for no merge done, one, two, ... in the given order."""
    n = float(table.true_sizes.sum())
    counts, whole = table.counts.astype(np.float64), table.node_sizes[table.nodes].astype(np.float64)
    if score == "achievable_accuracy":
        return _running(table, order, table.largest_of_node(counts)) / n
    if score == "undersegmentation_error":
        return _running(table, order, table.of_node(np.minimum(counts, whole - counts))) / n
    if score == "adjusted_rand_index":
        together = _running(table, order, table.of_node(counts * (counts - 1) / 2))
        found = _running(table, order, table.node_sizes * (table.node_sizes - 1.0) / 2)
        return rand_from_pairs(together, found, float((table.true_sizes * (table.true_sizes - 1.0) / 2).sum()), n)
    true = table.true_sizes[table.segments]
    both_halves = np.log2(whole / counts) + np.log2(true / counts)
    return _running(table, order, table.of_node(counts * both_halves)) / n


def _running(table: NodeTable, order: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of the nodes' values over the cut after each merge, (t + 1,)."""
    below = np.bincount(table.parents[:-1], values[:-1], len(values))
    steps = values[order] - below[order]
    return np.concatenate([[0.0], np.cumsum(steps)]) + values[: table.n_leaves].sum()
