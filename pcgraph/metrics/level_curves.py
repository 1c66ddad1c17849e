# SPDX-License-Identifier: Apache-2.0
"""Scores and boundaries of all horizontal cuts of a tree, in one pass; best scales of several clouds, ODS and OIS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.hierarchy import ChildLists, lowest_common_ancestors, num_leaves
from pcgraph.metrics.boundary_metrics import NeighbourGraph, check_nearness
from pcgraph.metrics.labellings import adjusted_rand_from_pairs, count_point_pairs
from pcgraph.metrics.node_table import Cells, NodeTable, TreeLike, parents_and_altitudes
from pcgraph.parallel import kernel
from pcgraph.plumbing.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class LevelCurve(ShortRepr):
    """One score of every distinct horizontal cut of a tree, from the leaves to the root.

    Attributes
    ----------
    score : str
        Name of the score.
    larger_is_better : bool
        False for errors.
    altitudes : (l,) float64, ascending
        Altitude of each cut: all merges up to it are done. -inf for the leaves alone.
    regions : (l,) int64
        Number of segments of each cut, also of those without labelled points.
    values : (l,) float64
        Score of each cut.
    """

    score: str
    larger_is_better: bool
    altitudes: NDArray[np.float64]
    regions: NDArray[np.int64]
    values: NDArray[np.float64]

    def at(self, altitudes: ArrayLike) -> NDArray[np.float64]:
        """Score of the cuts at these altitudes, in their shape."""
        return self.values[np.searchsorted(self.altitudes, np.asarray(altitudes, np.float64), side="right") - 1]


def level_curve(
    tree: TreeLike, leaves: ArrayLike, truth: ArrayLike, *, score: str = "segmentation_covering"
) -> LevelCurve:
    """One score of every distinct horizontal cut, by one pass up the tree.

    Parameters
    ----------
    tree : SegmentationTree, or pair (parents, altitudes)
        parents (k,) int: larger than the node's number, leaves first, the root its own parent. altitudes (k,) float:
        not below those of the children; may be infinite. Altitudes of leaves do not count.
    leaves, truth : same shape, int
        Leaf and true label of each point; points negative in either are left out.
    score : str
        "segmentation_covering", "achievable_segmentation_accuracy", "undersegmentation_error", "adjusted_rand_index"
        or "variation_of_information": the metric of that name, with its defaults. Or one of your own (`level_score`).

    Raises
    ------
    ValueError
        The tree is not one, altitudes decrease or are NaN, the score is unknown, or as `contingency`.
    """
    if score not in LEVEL_SCORES:
        raise ValueError(f"expected a score of {', '.join(sorted(LEVEL_SCORES))}; got {score!r}")
    chosen = LEVEL_SCORES[score]
    table = NodeTable.of(tree, leaves, truth)
    cuts = HorizontalCuts.of(tree)
    values = chosen.after_merges(table, cuts.order)[cuts.n_merges]
    return LevelCurve(chosen.name, chosen.larger_is_better, cuts.altitudes, cuts.regions, values)


@dataclass(frozen=True, eq=False)
class HorizontalCuts:
    """All distinct horizontal cuts of a tree, from the leaves alone to the root.

    Attributes
    ----------
    order : (t,) int64
        Nodes other than leaves, in the order of merging: by altitude, then by number.
    n_merges : (l,) int64
        Number of these merges that are done in each cut, from 0.
    altitudes : (l,) float64, ascending
        Altitude of each cut, up to the next; the first is -inf.
    regions : (l,) int64
        Number of segments of each cut.
    """

    order: NDArray[np.int64]
    n_merges: NDArray[np.int64]
    altitudes: NDArray[np.float64]
    regions: NDArray[np.int64]

    @classmethod
    def of(cls, tree: TreeLike) -> HorizontalCuts:
        """The cuts of a tree.

        Raises
        ------
        ValueError
            The tree is not one, there is not one altitude per node, one is NaN, or they decrease from child to parent.
        """
        parents, altitudes = parents_and_altitudes(tree)
        heights = np.asarray(altitudes, np.float64)
        if heights.shape != parents.shape:
            raise ValueError(f"expected one altitude per node, {parents.shape}, got {heights.shape}")
        n_leaves = num_leaves(parents)
        inner = heights[n_leaves:]
        if np.isnan(inner).any() or (heights[parents[n_leaves:]] < inner).any():
            raise ValueError("expected altitudes that are numbers and do not decrease from child to parent")
        order = n_leaves + np.argsort(inner, kind="stable")
        levels, first = np.unique(heights[order], return_index=True)
        n_merges = np.append(first, len(order))
        fewer = np.bincount(parents[:-1], minlength=len(parents))[order] - 1
        regions = n_leaves - np.concatenate([[0], np.cumsum(fewer)])[n_merges].astype(np.int64)
        return cls(order, n_merges, np.concatenate([[-np.inf], levels]), regions)


# Scores of levels -----------------------------------------------------------------------------------------------------

AfterMerges = Callable[[NodeTable, NDArray[np.int64]], NDArray[np.float64]]
"""Function of a table and the nodes in order of merging, (t,): the score before any merge and after each, (t + 1,)."""


class LevelScore(NamedTuple):
    """A score that `level_curve` can compute."""

    name: str
    larger_is_better: bool
    after_merges: AfterMerges


LEVEL_SCORES: dict[str, LevelScore] = {}
"""Scores by their names; `level_score` adds scores."""


def level_score(name: str, *, larger_is_better: bool, alias: str | None = None) -> Callable[[AfterMerges], AfterMerges]:
    """Decorator that adds a function to the scores of `level_curve`, under a name and perhaps an alias.

    The function takes a `NodeTable`, and the nodes other than leaves in the order of merging, (t,) int64. It returns
    the score of the leaves alone and after each merge, (t + 1,) float64. A score that is a sum over segments is one
    line: ``return table.sums_over_cuts(order, values)``, with the values of all nodes, (k,).
    """

    def add(after_merges: AfterMerges) -> AfterMerges:
        for key in (name, alias or name):
            taken = LEVEL_SCORES.get(key)
            if taken is not None and taken.after_merges.__module__ != after_merges.__module__:
                raise ValueError(f"expected a name of its own for a score, got {key!r}, which is taken")
            LEVEL_SCORES[key] = LevelScore(name, larger_is_better, after_merges)
        return after_merges

    return add


@level_score("achievable_segmentation_accuracy", larger_is_better=True, alias="achievable_accuracy")
def _achievable_accuracy_of_cuts(table: NodeTable, order: NDArray[np.int64]) -> NDArray[np.float64]:
    """ASA: a segment adds its points in the true segment that it overlaps most."""
    return table.sums_over_cuts(order, table.largest_of_nodes(table.cells.counts)) / table.n_points


@level_score("undersegmentation_error", larger_is_better=False)
def _undersegmentation_of_cuts(table: NodeTable, order: NDArray[np.int64]) -> NDArray[np.float64]:
    """UE of Neubert and Protzel: a segment adds min(n, |S| - n) for each true segment."""
    outside = table.node_sizes[table.nodes] - table.cells.counts
    return table.sums_over_cuts(order, table.sum_of_nodes(np.minimum(table.cells.counts, outside))) / table.n_points


@level_score("adjusted_rand_index", larger_is_better=True)
def _rand_index_of_cuts(table: NodeTable, order: NDArray[np.int64]) -> NDArray[np.float64]:
    """ARI: a segment adds its pairs of points, and those of them that are in one true segment."""
    together = table.sums_over_cuts(order, table.sum_of_nodes(count_point_pairs(table.cells.counts)))
    found = table.sums_over_cuts(order, count_point_pairs(table.node_sizes))
    true = float(count_point_pairs(table.true_sizes).sum())
    return adjusted_rand_from_pairs(together, found, true, table.n_points)


@level_score("variation_of_information", larger_is_better=False)
def _information_of_cuts(table: NodeTable, order: NDArray[np.int64]) -> NDArray[np.float64]:
    """VI in bits: a segment adds n (log2 |S| / n + log2 |G| / n) for each true segment."""
    counts = table.cells.counts
    of_node, of_truth = table.node_sizes[table.nodes], table.true_sizes[table.cells.segments]
    entropies = np.log2(of_node / counts) + np.log2(of_truth / counts)
    return table.sums_over_cuts(order, table.sum_of_nodes(counts * entropies)) / table.n_points


@level_score("segmentation_covering", larger_is_better=True, alias="weighted_overlap")
def _covering_of_cuts(table: NodeTable, order: NDArray[np.int64]) -> NDArray[np.float64]:
    """SC: a sum over true segments of their largest IoU, for which each true segment has a segment tree."""
    leaf_cells = table.cells.segments[: table.cells.starts[table.n_leaves]]
    places = np.empty(len(leaf_cells), np.int64)
    places[np.argsort(leaf_cells, kind="stable")] = np.arange(len(leaf_cells))
    begins = np.searchsorted(np.sort(leaf_cells), np.arange(len(table.true_sizes) + 1))
    trees = SegmentTrees(np.zeros(2 * len(leaf_cells)), begins)
    sums = _sums_of_best_overlaps(order, table.children, table.cells, table.overlaps, table.true_sizes, places, trees)
    return sums / table.true_sizes.sum()


class SegmentTrees(NamedTuple):
    """Segment trees (range maximum): one for each true segment, over its overlaps with the nodes of a cut.

    Attributes
    ----------
    maxima : (2 q,) float64
        Tree i begins at 2 begins[i] with an unused place and the maximum of all of its values. Maxima of halves,
        quarters and so on follow, and at the end the values. q is the number of values of all trees.
    begins : (g + 1,) int64
        Tree i has begins[i + 1] - begins[i] values.
    """

    maxima: NDArray[np.float64]
    begins: NDArray[np.int64]


@kernel
def _sums_of_best_overlaps(
    order: NDArray[np.int64],
    children: ChildLists,
    cells: Cells,
    overlaps: NDArray[np.float64],
    true_sizes: NDArray[np.int64],
    leaf_places: NDArray[np.int64],
    trees: SegmentTrees,
) -> NDArray[np.float64]:
    """Sum of size times best overlap over the true segments, before any merge and after each, (t + 1,).

    Each cell of the cut's nodes has a place in the tree of its true segment. The places of leaves are given. A merged
    cell takes the place of one of the cells of which it is made.
    """
    places = np.full(len(cells.above), -1)
    places[: len(leaf_places)] = leaf_places
    total = 0.0
    for cell in range(len(leaf_places)):
        segment = cells.segments[cell]
        total += _update(trees, segment, places[cell], overlaps[cell]) * true_sizes[segment]
    sums = np.empty(len(order) + 1)
    sums[0] = total
    for i, node in enumerate(order):
        for child in children.nodes[children.starts[node] : children.starts[node + 1]]:
            for cell in range(cells.starts[child], cells.starts[child + 1]):
                if places[cells.above[cell]] < 0:
                    places[cells.above[cell]] = places[cell]
                else:
                    segment = cells.segments[cell]
                    total += _update(trees, segment, places[cell], 0.0) * true_sizes[segment]
        for cell in range(cells.starts[node], cells.starts[node + 1]):
            segment = cells.segments[cell]
            total += _update(trees, segment, places[cell], overlaps[cell]) * true_sizes[segment]
        sums[i + 1] = total
    return sums


@kernel
def _update(trees: SegmentTrees, segment: int, place: int, value: float) -> float:
    """Set a value of a segment tree, and return the change of the tree's maximum."""
    n = trees.begins[segment + 1] - trees.begins[segment]
    base = 2 * trees.begins[segment]
    at = n + place - trees.begins[segment]
    before = trees.maxima[base + 1]
    trees.maxima[base + at] = value
    while at > 1:
        at //= 2
        trees.maxima[base + at] = max(trees.maxima[base + 2 * at], trees.maxima[base + 2 * at + 1])
    return trees.maxima[base + 1] - before


# Boundaries of levels -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BoundaryCurve(ShortRepr):
    """Boundary recall and precision of every distinct cut of a tree, from the leaves to the root.

    Attributes
    ----------
    altitudes : (l,) float64, ascending
        Altitude of each cut, as in `LevelCurve`.
    regions : (l,) int64
        Number of segments of each cut.
    recall, precision : (l,) float64
        `boundary_recall` and `boundary_precision` of each cut, 0..1.
    """

    altitudes: NDArray[np.float64]
    regions: NDArray[np.int64]
    recall: NDArray[np.float64]
    precision: NDArray[np.float64]

    @property
    def f_measure(self) -> LevelCurve:
        """Harmonic mean of both, 0..1, as a curve for `best_scales`: ODS and OIS."""
        sums = self.recall + self.precision
        values = 2 * self.recall * self.precision / np.where(sums > 0, sums, 1.0)
        return LevelCurve(
            "boundary_f_measure", larger_is_better=True, altitudes=self.altitudes, regions=self.regions, values=values
        )


def boundary_curve(
    graph: NeighbourGraph, tree: TreeLike, leaves: ArrayLike, truth: ArrayLike, *, hops: int = 1
) -> BoundaryCurve:
    """Boundary recall and precision of every distinct horizontal cut.

    A point is a boundary point of all cuts below its saliency, which is the altitude at which the last of its
    neighbours merges with it. So one number per point is enough for all cuts.

    Parameters
    ----------
    graph : NeighbourGraph
        Graph of the points that have a leaf and a true label.
    tree : SegmentationTree, or pair (parents, altitudes)
        As for `level_curve`.
    leaves, truth : (n,) or (h, w) int
        Leaf and true label of each point, >= 0 for those in the graph.
    hops : int, >= 0
        Points are near within so many steps from neighbour to neighbour.

    Raises
    ------
    ValueError
        As `level_curve` and `NeighbourGraph.boundary`; or hops is not a whole number of at least 0.
    """
    check_nearness(hops)
    cuts = HorizontalCuts.of(tree)
    parents, altitudes = parents_and_altitudes(tree)
    leaf = graph.of_members(leaves)
    if leaf.max() >= num_leaves(parents):
        raise ValueError(f"expected leaves 0..{num_leaves(parents) - 1} of the tree, got {leaf.max()}")
    saliency = _saliency(graph.neighbours, leaf, parents, np.asarray(altitudes, np.float64))
    true = graph.boundary_of_members(truth)
    near_saliency = saliency
    for _ in range(hops):
        near_saliency = np.maximum(near_saliency, near_saliency[graph.neighbours].max(axis=1, initial=-np.inf))
    found = _count_above(saliency, cuts.altitudes)
    right = _count_above(saliency[graph.within_hops(true, hops)], cuts.altitudes)
    hit = _count_above(near_saliency[true], cuts.altitudes)
    recall = hit / true.sum() if true.any() else np.ones(len(hit))
    return BoundaryCurve(cuts.altitudes, cuts.regions, recall, np.where(found > 0, right / np.maximum(found, 1), 1.0))


def _saliency(
    neighbours: NDArray[np.int32], leaf: NDArray[np.int64], parents: NDArray[np.int32], altitudes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Altitude at which the last neighbour of each point merges with it, (m,); -inf if all are in its leaf."""
    n_leaves = num_leaves(parents)
    saliency = np.full(len(leaf), -np.inf)
    point, side = np.nonzero(leaf[neighbours] != leaf[:, None])
    pairs, pair = np.unique(leaf[point] * n_leaves + leaf[neighbours[point, side]], return_inverse=True)
    ancestors = lowest_common_ancestors(parents, *np.divmod(pairs, n_leaves))
    np.maximum.at(saliency, point, altitudes[ancestors][pair])
    return saliency


def _count_above(values: NDArray[np.float64], levels: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number of values that exceed each level, (l,)."""
    return len(values) - np.searchsorted(np.sort(values), levels, side="right")


# Best scales ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BestScales(ShortRepr):
    """The best score with one altitude for all clouds (ODS) and with the best altitude for each (OIS).

    Attributes
    ----------
    ods, ois : float
        Means of the scores over the clouds.
    ods_altitude : float
        The common altitude; of equally good ones the lowest.
    ois_altitudes : (c,) float64
        The best altitude of each cloud; of equally good ones the lowest.
    ois_values : (c,) float64
        The score of each cloud at its best altitude.
    """

    ods: float
    ods_altitude: float
    ois: float
    ois_altitudes: NDArray[np.float64]
    ois_values: NDArray[np.float64]


def best_scales(curves: Sequence[LevelCurve]) -> BestScales:
    """Optimal dataset scale ODS and optimal image scale OIS of the curves of several clouds, over all distinct cuts.

    Source: Arbelaez et al. 2011, whose images are clouds here.

    Raises
    ------
    ValueError
        There is no curve, or they are of different scores.
    """
    if len({(curve.score, curve.larger_is_better) for curve in curves}) != 1:
        raise ValueError(f"expected curves of one score, got {sorted({curve.score for curve in curves})}")
    sign = 1.0 if curves[0].larger_is_better else -1.0
    every = np.unique(np.concatenate([curve.altitudes for curve in curves]))
    means = np.mean([curve.at(every) for curve in curves], axis=0)
    best = _first_largest(sign * means)
    tops = [_first_largest(sign * curve.values) for curve in curves]
    values = np.array([curve.values[top] for curve, top in zip(curves, tops, strict=True)])
    heights = np.array([curve.altitudes[top] for curve, top in zip(curves, tops, strict=True)])
    return BestScales(float(means[best]), float(every[best]), float(values.mean()), heights, values)


def _first_largest(values: NDArray[np.float64]) -> int:
    """Index of the first value that is the largest, up to 1e-12, which is well above the rounding of sums."""
    return int(np.argmax(values >= values.max() - 1e-12))
