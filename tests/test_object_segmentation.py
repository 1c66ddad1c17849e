# SPDX-License-Identifier: Apache-2.0
"""What a segmentation makes of the true objects, on images of 6 x 6 pixels drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest

from rangesim.evaluation.object_segmentation import ObjectOutcome, ObjectSegmentation, Outcome, object_segmentation
from rangesim.signals import GroundTruth

SCENE = """
    . . . . . .
    . a a . b b
    . a a . b b
    . a a . b b
    . a a . . .
    . . . . . .
"""
"""Object a of 8 pixels and object b of 6, before a wall."""
IDEAL = """
    0 0 0 0 0 0
    0 1 1 0 2 2
    0 1 1 0 2 2
    0 1 1 0 2 2
    0 1 1 0 0 0
    0 0 0 0 0 0
"""


def drawn(text: str) -> np.ndarray:
    """(6, 6) str, the characters of a drawing."""
    return np.array([row.split() for row in text.split("\n") if row.strip()])


def truth(text: str = SCENE) -> GroundTruth:
    letters = drawn(text)
    index = np.searchsorted([".", "a", "b"], letters).astype(np.int32)
    blank = np.zeros(index.shape, dtype=np.float32)
    return GroundTruth(
        z=blank + 1, range_m=blank + 1, normal=np.zeros((*index.shape, 3), np.float32), instance=index,
        material=index * 0, projector_uv=np.zeros((*index.shape, 2), np.float32), projector_visible=blank == 0,
        instance_names=("wall", "a", "b"), material_names=("matte",), instance_objects=("", "a", "b"),
    )  # fmt: skip


def labels(text: str) -> np.ndarray:
    return np.where(drawn(text) == "-", "-1", drawn(text)).astype(np.int64)


def outcomes(text: str, wrong: str | None = None, ideal: str | None = None) -> tuple[ObjectOutcome, ObjectOutcome, int]:
    marked = None if wrong is None else drawn(wrong) == "x"
    result = object_segmentation(labels(text), truth(), marked, None if ideal is None else labels(ideal))
    a, b = result.objects
    return a, b, result.invented


def test_a_perfect_segmentation_finds_all() -> None:
    a, b, invented = outcomes(IDEAL)
    assert a == ObjectOutcome("a", 8, 1.0, 1.0, Outcome.FOUND)
    assert b == ObjectOutcome("b", 6, 1.0, 1.0, Outcome.FOUND)
    assert invented == 0
    assert object_segmentation(labels(IDEAL), truth()).panoptic_quality == 1.0


def test_missing_readings_lower_covering_until_the_object_is_missed() -> None:
    few = """
        0 0 0 0 0 0
        0 1 1 0 2 2
        0 1 1 0 2 -
        0 1 - 0 - -
        0 - - 0 0 0
        0 0 0 0 0 0
    """
    a, b, _ = outcomes(few)
    assert (a.outcome, a.covering, a.overlap) == (Outcome.FOUND, 5 / 8, 5 / 8)
    assert (b.outcome, b.covering, b.overlap) == (Outcome.MISSED, 3 / 6, 3 / 6)  # not more than half
    nothing, _, _ = outcomes(few.replace("1", "-"))
    assert (nothing.outcome, nothing.covering, nothing.overlap) == (Outcome.MISSED, 0.0, 0.0)


def test_an_object_in_the_segment_of_the_wall_is_merged_with_it() -> None:
    a, b, invented = outcomes(IDEAL.replace("1", "0"))
    assert (a.outcome, a.covering, a.merged_with) == (Outcome.MERGED, 1.0, ("wall",))
    assert a.overlap == 8 / 30  # of the wall's 22 pixels and its own
    assert (b.outcome, b.merged_with, invented) == (Outcome.FOUND, (), 0)


def test_two_objects_in_one_segment_are_merged_with_each_other_and_the_larger_may_still_match() -> None:
    both = IDEAL.replace("2", "1")
    a, b, _ = outcomes(both)
    assert (a.outcome, a.overlap) == (Outcome.FOUND, 8 / 14)
    assert (b.outcome, b.merged_with) == (Outcome.MERGED, ("a",))
    with_wall = both.replace("0 1 1 0 0 0", "1 1 1 1 1 1")
    a, b, _ = outcomes(with_wall)
    assert a.merged_with == ("b", "wall")
    assert b.merged_with == ("a", "wall")


def test_an_object_in_several_segments_of_its_own_is_split() -> None:
    a, b, _ = outcomes(
        """
        0 0 0 0 0 0
        0 1 1 0 2 2
        0 1 3 0 2 2
        0 3 3 0 2 2
        0 4 4 0 0 0
        0 0 0 0 0 0
        """
    )
    assert (a.outcome, a.covering) == (Outcome.SPLIT, 3 / 8)
    assert b.outcome == Outcome.FOUND


def test_a_found_object_with_wrong_readings_is_displaced_and_not_invented() -> None:
    a, b, invented = outcomes(IDEAL, wrong=SCENE.replace("a a . b b", "x x . b b").replace("a", "x"))
    assert (a.outcome, a.displaced) == (Outcome.FOUND, True)
    assert (b.displaced, invented) == (False, 0)


PHANTOM = """
    0 0 0 5 5 5
    0 1 1 0 2 2
    0 1 1 0 2 2
    0 1 1 0 2 2
    0 1 1 0 6 6
    0 0 0 0 0 0
"""
WRONG = PHANTOM.replace("5", "x").replace("6", "x")


def test_wrong_segments_that_could_pass_for_objects_are_invented() -> None:
    assert outcomes(PHANTOM, WRONG)[2] == 1  # segment 6 is smaller than half of the smaller object
    assert outcomes(PHANTOM)[2] == 0  # right readings
    as_with_true_depth = outcomes(PHANTOM, WRONG, ideal=PHANTOM)
    assert as_with_true_depth[2] == 0  # the segmentation parts the wall there in any case
    assert outcomes(PHANTOM, WRONG, ideal=IDEAL)[2] == 1


def test_a_wrong_wall_is_no_invented_object() -> None:
    parted = IDEAL.replace("0 0 0 0 0 0", "7 7 7 7 7 7").replace("0 1", "7 1").replace("1 0", "1 7")
    assert (labels(parted) == 7).sum() > 16  # twice as many pixels as the larger object
    assert outcomes(parted, parted.replace("7", "x"))[2] == 0


def test_an_object_that_is_merged_even_with_true_depth_is_not_separable() -> None:
    merged = IDEAL.replace("2", "0")
    a, b, _ = outcomes(merged, ideal=merged)
    assert (a.separable, b.separable, b.outcome) == (True, False, Outcome.MERGED)
    assert outcomes(merged, ideal=IDEAL)[1].separable


def test_objects_out_of_view_and_scenes_without_any_have_no_outcome() -> None:
    unseen = truth(SCENE.replace("b", "."))
    assert [o.name for o in object_segmentation(labels(IDEAL), unseen).objects] == ["a"]
    empty = truth(SCENE.replace("a", ".").replace("b", "."))
    assert object_segmentation(labels(IDEAL), empty, wrong=np.ones((6, 6), bool)).objects == ()
    assert object_segmentation(labels(IDEAL), empty, wrong=np.ones((6, 6), bool)).invented == 0


def test_panoptic_quality_counts_what_is_not_found_and_what_is_invented() -> None:
    result = object_segmentation(labels(IDEAL.replace("1", "0")), truth())
    assert result.panoptic_quality == 1 / 1.5
    assert ObjectSegmentation(result.objects, 1).panoptic_quality == 0.5
    assert np.isnan(ObjectSegmentation((), 0).panoptic_quality)


def test_images_of_other_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"expected labels of shape \(6, 6\) as the ground truth, got \(2, 2\)"):
        object_segmentation(np.zeros((2, 2), int), truth())
