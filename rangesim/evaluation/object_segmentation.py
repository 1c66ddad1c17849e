# SPDX-License-Identifier: Apache-2.0
"""True objects as a segmentation shows them: found, merged, split or missed; and which segments are invented.

The kinds are those of Hoover et al. (1996) for range images, who call them correct detection, under-segmentation,
over-segmentation, missed and noise. They match by a tolerance on both overlaps; here an object and a segment match as
in panoptic quality (Kirillov et al. 2019): the intersection over union (IoU) of their pixels is above one half, so
that no object and no segment has two matches.

References
----------
Hoover et al.: "An experimental comparison of range image segmentation algorithms", IEEE PAMI 18(7), 1996.
Kirillov, He, Girshick, Rother, Dollár: "Panoptic segmentation", CVPR 2019.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array

from rangesim.settings.config import ShortRepr
from rangesim.signals import GroundTruth

HALF = 0.5
"""Fraction that an overlap must exceed: the only one from which on a match is unique (Kirillov et al. 2019)."""
MIN_PARTNER = 0.1
"""Fraction of a segment, at least, that another surface fills for an object to be merged with it. Less is the seam at
the outline of the object: in the segments that match an object of three scenes, it was at most 0.05."""


class Outcome(StrEnum):
    """Outcome of an object in a segmentation.

    FOUND : a segment matches it.
    MERGED : one segment holds more than half of it, and so much else that they do not match.
    SPLIT : several segments, each with more than half of its pixels on the object, hold more than half of it.
    MISSED : none of these.
    """

    FOUND = "found"
    MERGED = "merged"
    SPLIT = "split"
    MISSED = "missed"


@dataclass(frozen=True)
class ObjectOutcome:
    """One true object in the segmentation of a sensor's cloud.

    Parameters
    ----------
    name : str, name of the object.
    pixels : int, number of pixels that see it.
    covering : float, 0..1, largest fraction of these pixels that one segment holds. Pixels without a reading count.
    overlap : float, 0..1, intersection over union of the object and that segment.
    outcome : Outcome.
    displaced : bool, whether the object is found, but more than half of its pixels in the segment have wrong readings.
    merged_with : names of the objects and of the background surfaces in the same segment, the largest first; empty
        unless the object is merged.
    separable : bool, whether the segmentation finds the object in the true depth. If not, the sensor is not to blame.
    """

    name: str
    pixels: int
    covering: float
    overlap: float
    outcome: Outcome
    displaced: bool = False
    merged_with: tuple[str, ...] = ()
    separable: bool = True


@dataclass(frozen=True, eq=False, repr=False)
class ObjectSegmentation(ShortRepr):
    """All objects that a camera sees in the segmentation of its sensor's cloud.

    objects : tuple of ObjectOutcome, in the order of `GroundTruth.object_names`.
    invented : int, number of segments that could pass for an object and are none.
    """

    objects: tuple[ObjectOutcome, ...]
    invented: int

    def names(self, outcome: Outcome) -> list[str]:
        """Names of the objects of this outcome."""
        return [o.name for o in self.objects if o.outcome == outcome]

    @property
    def panoptic_quality(self) -> float:
        """Panoptic quality PQ of the objects, 0..1; NaN if there are neither objects nor invented ones."""
        found = [o.overlap for o in self.objects if o.outcome == Outcome.FOUND]
        total = len(found) + 0.5 * (len(self.objects) - len(found) + self.invented)
        return float(sum(found) / total) if total else float("nan")


def object_segmentation(
    labels: np.ndarray,
    truth: GroundTruth,
    wrong: np.ndarray | None = None,
    true_labels: np.ndarray | None = None,
) -> ObjectSegmentation:
    """Outcomes of the true objects in a segmentation, and the number of objects that it invents.

    A segment is *invented* if more than half of its readings are wrong, if it matches neither a true surface nor a
    segment of the true depth, and if it could pass for an object by its size: it has at least half as many pixels as
    the smallest object in view that is separable, and at most twice as many as the largest. Smaller and larger ones can
    be left out by their size without losing an object.

    Parameters
    ----------
    labels : (h, w) int, segment of each pixel; negative: no reading, or in no segment.
    truth : GroundTruth, whose `object_index` tells the objects.
    wrong : (h, w) bool, readings with an error above the tolerance, and readings of no surface. None: none is wrong.
    true_labels : (h, w) int, the same segmentation of the true depth. None: every object is taken as separable.

    Raises
    ------
    ValueError
        The images differ in size.

    Examples
    --------
    A bottle (0) before a wall (1). The sensor reads the wall through two thirds of the bottle:

    >>> import numpy as np
    >>> from dataclasses import replace
    >>> from rangesim.evaluation.object_segmentation import object_segmentation
    >>> instance = np.array([[1, 0, 1, 1], [1, 0, 1, 1], [1, 0, 1, 1]], dtype=np.int32)
    >>> names = {"instance_names": ("bottle", "wall"), "instance_objects": ("bottle", "")}
    >>> truth = replace(signals.truth, instance=instance, **names)
    >>> labels = np.array([[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    >>> bottle = object_segmentation(labels, truth).objects[0]
    >>> str(bottle.outcome), bottle.merged_with, round(bottle.covering, 2)
    ('merged', ('wall',), 0.67)
    """
    shape = truth.instance.shape
    wrong = np.zeros(shape, dtype=bool) if wrong is None else wrong
    for name, image in (("labels", labels), ("wrong", wrong), ("true_labels", true_labels)):
        if image is not None and image.shape != shape:
            raise ValueError(f"expected {name} of shape {shape} as the ground truth, got {image.shape}.")
    surfaces = _Surfaces.of(truth)
    pairs = _Pairs.of(labels, surfaces.index, len(surfaces.names))
    in_wrong = _Pairs.of(np.where(wrong, labels, -1), surfaces.index, len(surfaces.names), pairs.common.shape[0])
    alone = None if true_labels is None else _Pairs.of(true_labels, surfaces.index, len(surfaces.names))
    outcomes = []
    for index in range(surfaces.objects):
        if pairs.of_surface[index]:
            separable = alone is None or alone.outcome(index)[0] == Outcome.FOUND
            outcomes.append(_outcome(index, surfaces, pairs, in_wrong, separable))
    matched = pairs.matched()
    if true_labels is not None:
        matched |= _Pairs.of(labels, true_labels, int(true_labels.max(initial=-1)) + 1).matched()
    doubtful = (in_wrong.of_segment > HALF * pairs.of_segment) & ~matched
    sizes = [o.pixels for o in outcomes if o.separable]
    low, high = (HALF * min(sizes), max(sizes) / HALF) if sizes else (np.inf, 0.0)
    passing = (pairs.of_segment >= low) & (pairs.of_segment <= high)
    return ObjectSegmentation(tuple(outcomes), int((doubtful & passing).sum()))


def _outcome(index: int, surfaces: _Surfaces, pairs: _Pairs, in_wrong: _Pairs, separable: bool) -> ObjectOutcome:
    """The outcome of the object `index`; `in_wrong` counts the pixels whose readings are wrong."""
    outcome, segment, covering, overlap = pairs.outcome(index)
    displaced, partners = False, []
    if outcome == Outcome.FOUND:
        displaced = in_wrong.in_both(segment, index) > HALF * pairs.in_both(segment, index)
    elif outcome == Outcome.MERGED:
        inside = pairs.inside(segment)
        inside[index] = 0
        order = np.argsort(-inside, kind="stable")
        enough = max(1, min(MIN_PARTNER * pairs.of_segment[segment], inside.max()))
        partners = [surfaces.names[other] for other in order if inside[other] >= enough]
    return ObjectOutcome(
        surfaces.names[index], int(pairs.of_surface[index]), covering, overlap, outcome, bool(displaced),
        tuple(partners), separable,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """The true surfaces: the objects, and then the instances of the background.

    index : (h, w) int, the surface behind each pixel; -1 for none. names : name of each surface.
    objects : number of objects.
    """

    index: np.ndarray
    names: tuple[str, ...]
    objects: int

    @classmethod
    def of(cls, truth: GroundTruth) -> _Surfaces:
        index, objects = truth.object_index, len(truth.object_names)
        behind = np.where((truth.instance >= 0) & (index < 0), objects + truth.instance, index)
        return cls(behind, truth.object_names + truth.instance_names, objects)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Numbers of pixels in each pair of a segment and a surface.

    common : (segments, surfaces) int64, sparse, pixels in both.
    of_segment, of_surface : (segments,) and (surfaces,) int64, pixels of each segment, and of each surface.
    """

    common: csc_array
    of_segment: np.ndarray
    of_surface: np.ndarray

    @classmethod
    def of(cls, labels: np.ndarray, index: np.ndarray, surfaces: int, segments: int | None = None) -> _Pairs:
        """The pairs of labels (h, w) and surfaces (h, w); negative in either is none of them."""
        segments = int(labels.max(initial=-1)) + 1 if segments is None else segments
        both = (labels >= 0) & (index >= 0)
        ones = np.ones(int(both.sum()), dtype=np.int64)
        common = csc_array((ones, (labels[both], index[both])), shape=(segments, surfaces))
        of_segment = np.bincount(labels[labels >= 0], minlength=segments)
        return cls(common, of_segment, np.bincount(index[index >= 0], minlength=surfaces))

    def _holding(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The segments (k,) that hold some of a surface, in ascending order, and how many of its pixels each holds."""
        column = slice(*self.common.indptr[index : index + 2])
        return self.common.indices[column], self.common.data[column]

    def in_both(self, segment: int, index: int) -> int:
        """Number of pixels that a segment and a surface have in common."""
        segments, held = self._holding(index)
        return int(held[segments == segment].sum())

    def inside(self, segment: int) -> np.ndarray:
        """(surfaces,) int64, number of pixels of each surface in a segment."""
        row = slice(*self._by_segment.indptr[segment : segment + 2])
        result = np.zeros(len(self.of_surface), dtype=np.int64)
        result[self._by_segment.indices[row]] = self._by_segment.data[row]
        return result

    @cached_property
    def _by_segment(self) -> csr_array:
        """`common`, stored by segments."""
        return self.common.tocsr()

    def outcome(self, index: int) -> tuple[Outcome, int, float, float]:
        """Fate of a surface: the outcome, the segment that holds most of it, its covering and its overlap."""
        segments, held = self._holding(index)
        if not held.any():
            return Outcome.MISSED, -1, 0.0, 0.0
        most, size = held.max(), self.of_surface[index]
        segment = int(segments[held.argmax()])
        covering, overlap = most / size, most / (size + self.of_segment[segment] - most)
        if overlap > HALF:
            outcome = Outcome.FOUND
        elif covering > HALF:
            outcome = Outcome.MERGED
        else:
            own = held > HALF * self.of_segment[segments]
            outcome = Outcome.SPLIT if held[own].sum() > HALF * size else Outcome.MISSED
        return outcome, segment, float(covering), float(overlap)

    def matched(self) -> np.ndarray:
        """(segments,) bool, whether each segment matches a surface."""
        pairs = self.common.tocoo()
        union = self.of_segment[pairs.row] + self.of_surface[pairs.col] - pairs.data
        result = np.zeros(len(self.of_segment), dtype=bool)
        result[pairs.row[pairs.data > HALF * union]] = True
        return result
