# SPDX-License-Identifier: Apache-2.0
"""Boundary recall, precision and F-measure of all horizontal cuts of a tree at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.metrics.hierarchy import Cuts, checked_parents, count_leaves
from pcgraph.metrics.levels import LevelCurve
from pcgraph.metrics.meeting import lowest_common
from pcgraph.metrics.neighbours import NeighbourGraph, check_reach
from pcgraph.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class BoundaryCurve(ShortRepr):
    """Boundary recall and precision of every distinct cut of a tree, from the leaves to the root.

    Attributes
    ----------
    altitudes : (l,) float64, ascending
        As in `LevelCurve`.
    regions : (l,) int64
        Number of segments.
    recall, precision : (l,) float64
        0..1; as `boundary_recall` and `boundary_precision` of the cut.
    """

    altitudes: NDArray[np.float64]
    regions: NDArray[np.int64]
    recall: NDArray[np.float64]
    precision: NDArray[np.float64]

    @property
    def f_measure(self) -> LevelCurve:
        """Harmonic mean of both, 0..1, as a curve for `best_scales`: the classical ODS and OIS."""
        sums = self.recall + self.precision
        values = 2 * self.recall * self.precision / np.where(sums > 0, sums, 1.0)
        return LevelCurve("boundary_f_measure", self.altitudes, self.regions, values)


def boundary_curve(
    graph: NeighbourGraph,
    parents: ArrayLike,
    altitudes: ArrayLike,
    leaves: ArrayLike,
    truth: ArrayLike,
    *,
    hops: int = 1,
) -> BoundaryCurve:
    """Boundary recall and precision of every distinct horizontal cut.

    A point is on the boundary of a cut as long as the last of its neighbours has not merged with it, so one number
    per point, its saliency, answers for all cuts.

    Parameters
    ----------
    graph : NeighbourGraph
        Of the points that have a leaf and a true label.
    parents, altitudes : (k,)
        As for `level_curve`.
    leaves, truth : (n,) or (h, w) int
        Leaf and true label of each point, >= 0 for those in the graph.
    hops : int, >= 0
        Near is within as many steps from neighbour to neighbour.

    Raises
    ------
    ValueError
        As `level_curve` and `NeighbourGraph.boundary`; or hops is not a whole number of at least 0.
    """
    check_reach(hops)
    up = checked_parents(parents)
    cuts = Cuts.of(up, altitudes)
    leaf = graph.of_members(leaves)
    if leaf.max() >= count_leaves(up):
        raise ValueError(f"expected leaves 0..{count_leaves(up) - 1} of the tree, got {leaf.max()}")
    saliency = _saliency(graph.neighbours, leaf, up, np.asarray(altitudes, np.float64))
    true = graph.rim(truth)
    near_saliency = saliency
    for _ in range(hops):
        near_saliency = np.maximum(near_saliency, near_saliency[graph.neighbours].max(axis=1, initial=-np.inf))
    found = _above(saliency, cuts.altitudes)
    right = _above(saliency[graph.within_hops(true, hops)], cuts.altitudes)
    hit = _above(near_saliency[true], cuts.altitudes)
    recall = hit / true.sum() if true.any() else np.ones(len(hit))
    return BoundaryCurve(cuts.altitudes, cuts.regions, recall, np.where(found > 0, right / np.maximum(found, 1), 1.0))


def _saliency(
    neighbours: NDArray[np.int32], leaf: NDArray[np.int64], parents: NDArray[np.int64], altitudes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Altitude at which the last neighbour of each point merges with it, (m,); -inf if all are of its leaf."""
    n_leaves = count_leaves(parents)
    saliency = np.full(len(leaf), -np.inf)
    point, side = np.nonzero(leaf[neighbours] != leaf[:, None])
    pairs, which = np.unique(leaf[point] * n_leaves + leaf[neighbours[point, side]], return_inverse=True)
    meeting = lowest_common(parents, n_leaves, pairs // n_leaves, pairs % n_leaves)
    np.maximum.at(saliency, point, altitudes[meeting][which])
    return saliency


def _above(values: NDArray[np.float64], levels: NDArray[np.float64]) -> NDArray[np.int64]:
    """How many values exceed each level, (l,)."""
    return len(values) - np.searchsorted(np.sort(values), levels, side="right")
