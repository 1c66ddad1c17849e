# SPDX-License-Identifier: Apache-2.0
"""Panoptic quality: segments found, and how well they fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.metrics.table import count_pairs, labelled, overlaps, ranked, whole_numbers
from pcgraph.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class PanopticQuality(ShortRepr):
    """Matches of segments and true segments, per class; the numbers for all are means over the classes.

    Attributes
    ----------
    classes : (c,) int64
        Classes that occur in the labels or in the truth, ascending; one class 0 if none were given.
    matches, spurious, missed : (c,) int64
        Pairs of one class with IoU > 0.5; segments and true segments in no such pair.
    overlap_sums : (c,) float64
        Sum of the IoU of the matches.
    """

    classes: NDArray[np.int64]
    matches: NDArray[np.int64]
    spurious: NDArray[np.int64]
    missed: NDArray[np.int64]
    overlap_sums: NDArray[np.float64]

    @property
    def of_classes(self) -> NDArray[np.float64]:
        """PQ of each class, (c,), 0..1."""
        return self.overlap_sums / self._halved

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
        return float((self.matches / self._halved).mean())

    @property
    def _halved(self) -> NDArray[np.float64]:
        return self.matches + (self.spurious + self.missed) / 2


def panoptic_quality(
    labels: ArrayLike,
    truth: ArrayLike,
    classes: ArrayLike | None = None,
    true_classes: ArrayLike | None = None,
) -> PanopticQuality:
    """PQ of Kirillov et al. 2019; a pair with IoU above 0.5 is a match, and there is never a choice of two.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.
    classes, true_classes : same shape, int, optional
        Class of each point, >= 0, found and true; both or neither. Points of one label and two classes are two
        segments. Without them all segments are of one class.

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
        inside = (whole_numbers(labels) >= 0) & (whole_numbers(truth) >= 0)
        found_class, true_class = _class_of(classes, inside), _class_of(true_classes, inside)
    row, row_class = _things(found, found_class)
    column, column_class = _things(true, true_class)
    table = count_pairs(row, column, (len(row_class), len(column_class)))
    overlap = overlaps(table)
    match = (overlap > 0.5) & (row_class[table.row] == column_class[table.col])
    kinds = np.unique(np.concatenate([row_class, column_class]))
    where = np.searchsorted(kinds, row_class[table.row[match]])
    matches = np.bincount(where, minlength=len(kinds))
    spurious = np.bincount(np.searchsorted(kinds, row_class), minlength=len(kinds)) - matches
    missed = np.bincount(np.searchsorted(kinds, column_class), minlength=len(kinds)) - matches
    overlap_sums = np.bincount(where, overlap[match], len(kinds)).astype(np.float64)
    return PanopticQuality(kinds, matches, spurious, missed, overlap_sums)


def _class_of(classes: ArrayLike, inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    given = whole_numbers(classes)
    if given.shape != inside.shape:
        raise ValueError(f"expected classes of the labels' shape {inside.shape}, got {given.shape}")
    chosen = given[inside]
    if (chosen < 0).any():
        raise ValueError("expected a class >= 0 for every labelled point; give the others the label -1")
    return chosen


def _things(labels: NDArray[np.int64], classes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Segment of each point, one label and one class each, numbered from 0; and the class of each segment."""
    label, _ = ranked(labels)
    kind, n_kinds = ranked(classes)
    segment, n = ranked(label * n_kinds + kind)
    of_segment = np.empty(n, np.int64)
    of_segment[segment] = classes
    return segment, of_segment
