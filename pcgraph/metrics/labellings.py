# SPDX-License-Identifier: Apache-2.0
"""Metrics of two labellings of the same points, from their contingency table.

In the formulas S is a segment, G a true segment, N the number of points. The checks of labels at the end are used by
all metrics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array

from pcgraph.plumbing.short_repr import ShortRepr


def contingency(labels: ArrayLike, truth: ArrayLike) -> coo_array:
    """Contingency table: number of points in each pair of a segment and a true segment, sparse (s, g) int64.

    Rows are segments, columns are true segments, both in ascending order of their labels.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.

    Raises
    ------
    ValueError
        The shapes differ, labels are not whole numbers, or no point is left.
    """
    found, true = labelled(labels, truth)
    row, n_rows = relabel_sequential(found)
    column, n_columns = relabel_sequential(true)
    return count_pairs(row, column, (n_rows, n_columns))


def count_pairs(row: NDArray[np.int64], column: NDArray[np.int64], shape: tuple[int, int]) -> coo_array:
    """Number of occurrences of each pair of row and column, sparse int64, sorted by row, then column."""
    table = coo_array((np.ones(len(row), np.int64), (row, column)), shape=shape).tocsr()
    table.sum_duplicates()
    return table.tocoo()


def segment_sizes(table: coo_array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points per segment (s,) and per true segment (g,), int64."""
    rows, columns = table.shape
    found = np.bincount(table.row, table.data, rows)
    return found.astype(np.int64), np.bincount(table.col, table.data, columns).astype(np.int64)


def intersections_over_union(table: coo_array) -> NDArray[np.float64]:
    """Intersection over union of each pair in the table, (nnz,), 0..1."""
    found, true = segment_sizes(table)
    return table.data / (found[table.row] + true[table.col] - table.data)


def largest_of_groups(values: NDArray[np.number], groups: NDArray[np.integer], n_groups: int) -> NDArray[np.float64]:
    """Largest value of each group, (n_groups,) float64, of values >= 0; 0 for groups without any."""
    best = np.zeros(n_groups)
    np.maximum.at(best, groups, values)
    return best


def segmentation_covering(
    labels: ArrayLike, truth: ArrayLike, *, matching: Literal["max", "one_to_one"] = "max"
) -> float:
    """Segmentation covering SC, 0..1: mean over the points of the IoU of their true segment and its match.

    Arbelaez et al. 2011; elsewhere called weighted overlap, WOv.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.
    matching : {"max", "one_to_one"}
        "max": each true segment matches the segment of largest IoU.
        "one_to_one": no segment matches twice; the assignment is the one with the largest sum.

    Raises
    ------
    ValueError
        As `contingency`; or the matching is unknown.
    """
    if matching not in ("max", "one_to_one"):
        raise ValueError(f"expected matching 'max' or 'one_to_one', got {matching!r}")
    table = contingency(labels, truth)
    _, true = segment_sizes(table)
    if matching == "one_to_one":
        return _best_assignment(table, intersections_over_union(table) * true[table.col]) / float(true.sum())
    return float(largest_of_groups(intersections_over_union(table), table.col, len(true)) @ true / true.sum())


weighted_overlap = segmentation_covering
"""Another name of `segmentation_covering`."""


def _best_assignment(table: coo_array, gains: NDArray[np.float64]) -> float:
    """Largest sum of the gains of pairs in which no row and no column occurs twice."""
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    rows, columns = table.shape
    # Each column (true segment) also has a partner of its own that gains nothing, so that a full matching exists. Gains
    # are raised by one, which favours no pair, because SciPy takes a zero for a pair that does not exist.
    unmatched = np.arange(columns)
    scale = gains.max()
    weights = np.concatenate([1 + gains / scale, np.ones(columns)])
    partners = np.concatenate([table.row, rows + unmatched])
    graph = coo_array((weights, (np.concatenate([table.col, unmatched]), partners)), shape=(columns, rows + columns))
    row, column = min_weight_full_bipartite_matching(graph.tocsr(), maximize=True)
    return float((graph.tocsr()[row, column] - 1).sum() * scale)


def achievable_segmentation_accuracy(labels: ArrayLike, truth: ArrayLike) -> float:
    """Achievable segmentation accuracy ASA, 0..1 (Liu et al. 2011).

    It is the fraction of points that are right if every segment is assigned to the true segment that it overlaps most.
    1 - ASA is the undersegmentation error of Stutz et al. 2018. Errors are those of `contingency`.
    """
    table = contingency(labels, truth)
    return float(largest_of_groups(table.data, table.row, table.shape[0]).sum() / table.data.sum())


achievable_accuracy = achievable_segmentation_accuracy
"""Another name of `achievable_segmentation_accuracy`."""


def oversegmentation_rate(labels: ArrayLike, truth: ArrayLike) -> float:
    """Oversegmentation rate Fos, 0..1: fraction of points outside the segment that overlaps their true segment most.

    Source: Richtsfeld et al. 2012. Errors are those of `contingency`.
    """
    table = contingency(labels, truth)
    return float(1 - largest_of_groups(table.data, table.col, table.shape[1]).sum() / table.data.sum())


def undersegmentation_rate(labels: ArrayLike, truth: ArrayLike) -> float:
    """Undersegmentation rate Fus, >= 0 (Richtsfeld et al. 2012).

    For each true segment, the points outside of it count in the segment that overlaps it most; of segments that overlap
    equally, in the smallest. Fus is the sum of these counts over the number of all points. It can exceed 1: one segment
    of all points counts once per true segment. Errors are those of `contingency`.
    """
    table = contingency(labels, truth)
    found, true = segment_sizes(table)
    outside = found[table.row] - table.data
    order = np.lexsort((outside, -table.data, table.col))
    _, first = np.unique(table.col[order], return_index=True)
    return float(outside[order[first]].sum() / true.sum())


def undersegmentation_error(
    labels: ArrayLike,
    truth: ArrayLike,
    *,
    definition: Literal["neubert_protzel", "levinshtein", "papon"] = "neubert_protzel",
) -> float:
    """Undersegmentation error UE, 0 at best, in one of three definitions.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.
    definition : str
        "neubert_protzel" (2012), 0..1: sum over pairs of min(|S and G|, |S without G|), over N.
        "papon" (VCCS, 2013), >= 0: sum over G of the sizes of all S that meet G, less N, over N.
        "levinshtein" (2009), >= 0: mean over G of (sizes of all S that meet G, less |G|) / |G|.

    Raises
    ------
    ValueError
        As `contingency`; or the definition is unknown.
    """
    table = contingency(labels, truth)
    found, true = segment_sizes(table)
    met = found[table.row]  # the whole of each segment, once for each true segment that it meets
    if definition == "neubert_protzel":
        return float(np.minimum(table.data, met - table.data).sum() / true.sum())
    if definition == "papon":
        return float((met.sum() - true.sum()) / true.sum())
    if definition == "levinshtein":
        return float((np.bincount(table.col, met, len(true)) / true - 1).mean())
    raise ValueError(f"expected definition 'neubert_protzel', 'papon' or 'levinshtein', got {definition!r}")


def adjusted_rand_index(labels: ArrayLike, truth: ArrayLike) -> float:
    """Adjusted Rand index ARI, -0.5..1 (Hubert and Arabie 1985).

    It is the agreement on which pairs of points are in one segment, corrected for chance: 0 on average for random
    labels. Points negative in either are left out. Errors are those of `contingency`.
    """
    table = contingency(labels, truth)
    found, true = segment_sizes(table)
    together, of_found, of_true = (count_point_pairs(counts).sum() for counts in (table.data, found, true))
    return float(adjusted_rand_from_pairs(np.array(together), of_found, of_true, float(true.sum())))


def adjusted_rand_from_pairs(
    together: NDArray[np.float64], found: NDArray[np.float64] | float, true: float, n_points: float
) -> NDArray[np.float64]:
    """ARI from numbers of pairs of points: those in one segment of both labellings, of the labels, and of the truth."""
    everything = max(n_points * (n_points - 1) / 2, 1.0)
    chance = np.asarray(found * true / everything)
    best = np.asarray((found + true) / 2)
    trivial = best == chance  # in both all points are in one segment, or each is its own segment
    return np.where(trivial, 1.0, (together - chance) / np.where(trivial, 1.0, best - chance))


def count_point_pairs(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Number of pairs among so many points."""
    return counts * (counts - 1.0) / 2


@dataclass(frozen=True)
class VariationOfInformation:
    """Variation of information VI, as its two conditional entropies, bits, 0 at best.

    Attributes
    ----------
    split : float
        H(labels | truth): grows with oversegmentation.
    merge : float
        H(truth | labels): grows with undersegmentation.
    """

    split: float
    merge: float

    @property
    def total(self) -> float:
        """VI, bits, 0..log2 N."""
        return self.split + self.merge


def variation_of_information(labels: ArrayLike, truth: ArrayLike) -> VariationOfInformation:
    """Variation of information VI and its two conditional entropies, in bits (Meila 2007).

    Points negative in either are left out. Errors are those of `contingency`.
    """
    table = contingency(labels, truth)
    found, true = segment_sizes(table)
    n = true.sum()
    split = table.data @ np.log2(true[table.col] / table.data) / n
    merge = table.data @ np.log2(found[table.row] / table.data) / n
    return VariationOfInformation(float(split), float(merge))


@dataclass(frozen=True, eq=False)
class PanopticQuality(ShortRepr):
    """Matches of segments and true segments per class; `pq`, `sq` and `rq` are means over the classes.

    Attributes
    ----------
    classes : (c,) int64
        Classes that occur in the labels or in the truth, ascending; one class 0 if none were given.
    matches, spurious, missed : (c,) int64
        Number of pairs of one class with IoU > 0.5, of segments in no such pair, and of true segments in no such pair.
    overlap_sums : (c,) float64
        Sums of the IoU of the matches.
    """

    classes: NDArray[np.int64]
    matches: NDArray[np.int64]
    spurious: NDArray[np.int64]
    missed: NDArray[np.int64]
    overlap_sums: NDArray[np.float64]

    def __repr__(self) -> str:
        """The three means, and the number of classes."""
        return f"PanopticQuality(pq={self.pq:.3f}, sq={self.sq:.3f}, rq={self.rq:.3f}, classes={len(self.classes)})"

    @property
    def of_classes(self) -> NDArray[np.float64]:
        """PQ of each class, (c,), 0..1."""
        return self.overlap_sums / self._denominators

    @property
    def pq(self) -> float:
        """Panoptic quality PQ, 0..1; SQ x RQ for a single class."""
        return float(self.of_classes.mean())

    @property
    def sq(self) -> float:
        """Segmentation quality SQ, 0.5..1: mean IoU of the matches; 0 for classes without any."""
        return float((self.overlap_sums / np.maximum(self.matches, 1)).mean())

    @property
    def rq(self) -> float:
        """Recognition quality RQ, 0..1: the F1 score of finding segments."""
        return float((self.matches / self._denominators).mean())

    @property
    def _denominators(self) -> NDArray[np.float64]:
        return self.matches + (self.spurious + self.missed) / 2


def panoptic_quality(
    labels: ArrayLike,
    truth: ArrayLike,
    classes: ArrayLike | None = None,
    true_classes: ArrayLike | None = None,
) -> PanopticQuality:
    """Panoptic quality PQ (Kirillov et al. 2019).

    A segment and a true segment of one class match if their IoU is above 0.5; no segment can have two matches.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.
    classes, true_classes : same shape, int, optional
        Found and true class of each point, >= 0; both or neither. Points of one label but two classes are two segments.
        Without classes, all segments are of one class.

    Raises
    ------
    ValueError
        As `contingency`; or one of the two classes is missing, or negative at a labelled point.
    """
    found, true = labelled(labels, truth)
    if (classes is None) != (true_classes is None):
        raise ValueError("expected classes and true_classes, or neither; got one of them")
    if classes is None or true_classes is None:
        found_class, true_class = np.zeros_like(found), np.zeros_like(true)
    else:
        inside = (as_labels(labels) >= 0) & (as_labels(truth) >= 0)
        found_class, true_class = _checked_classes(classes, inside), _checked_classes(true_classes, inside)
    row, row_class = _segments_of_one_class(found, found_class)
    column, column_class = _segments_of_one_class(true, true_class)
    table = count_pairs(row, column, (len(row_class), len(column_class)))
    overlap = intersections_over_union(table)
    match = (overlap > 0.5) & (row_class[table.row] == column_class[table.col])
    occurring = np.unique(np.concatenate([row_class, column_class]))
    where = np.searchsorted(occurring, row_class[table.row[match]])
    matches = np.bincount(where, minlength=len(occurring))
    spurious = np.bincount(np.searchsorted(occurring, row_class), minlength=len(occurring)) - matches
    missed = np.bincount(np.searchsorted(occurring, column_class), minlength=len(occurring)) - matches
    overlap_sums = np.bincount(where, overlap[match], len(occurring)).astype(np.float64)
    return PanopticQuality(occurring, matches, spurious, missed, overlap_sums)


def _checked_classes(classes: ArrayLike, inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    given = as_labels(classes)
    if given.shape != inside.shape:
        raise ValueError(f"expected classes of the labels' shape {inside.shape}, got {given.shape}")
    chosen = given[inside]
    if (chosen < 0).any():
        raise ValueError("expected a class >= 0 for every labelled point; give the others the label -1")
    return chosen


def _segments_of_one_class(
    labels: NDArray[np.int64], classes: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Segment of each point, (m,), numbered from 0 by pairs of label and class; and the class of each segment."""
    label, _ = relabel_sequential(labels)
    class_rank, n_classes = relabel_sequential(classes)
    segment, n = relabel_sequential(label * n_classes + class_rank)
    of_segment = np.empty(n, np.int64)
    of_segment[segment] = classes
    return segment, of_segment


def labelled(labels: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Labels and true labels, (m,) int64 each, of the points that have both; errors as of `contingency`."""
    found, true = as_labels(labels), as_labels(truth)
    if found.shape != true.shape:
        raise ValueError(f"expected labels and truth of one shape, got {found.shape} and {true.shape}")
    both = (found >= 0) & (true >= 0)
    if not both.any():
        raise ValueError("expected at least one point with a label and a true label, got none")
    return found[both], true[both]


def as_labels(labels: ArrayLike) -> NDArray[np.int64]:
    """Labels as int64; -1 where they are masked.

    Raises
    ------
    ValueError
        Labels are not whole numbers, or one is 2**63 or more.
    """
    array = labels if isinstance(labels, np.ma.MaskedArray) else np.asarray(labels)
    if array.dtype.kind not in "iub":
        raise ValueError(f"expected labels that are whole numbers, got {array.dtype}; convert them first")
    if array.dtype == np.uint64 and array.size and array.max() > np.iinfo(np.int64).max:
        raise ValueError(f"expected labels below 2**63, got {array.max()}; number them from 0")
    numbers = array.astype(np.int64, copy=False)
    return np.ma.filled(numbers, -1) if isinstance(numbers, np.ma.MaskedArray) else numbers


def as_floats(values: ArrayLike) -> NDArray[np.float64]:
    """Values as float64; NaN where they are masked."""
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.float64), np.nan)
    return np.asarray(values, np.float64)


def relabel_sequential(labels: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Labels (m,) renumbered 0..s-1 in ascending order, and s."""
    if labels.max() > 4 * len(labels) + 1024:  # sort sparse labels: a count of every number would take too much memory
        values, rank = np.unique(labels, return_inverse=True)
        return rank.astype(np.int64), len(values)
    present = np.bincount(labels) > 0
    return (np.cumsum(present) - 1)[labels], int(np.count_nonzero(present))
