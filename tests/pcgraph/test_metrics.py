# SPDX-License-Identifier: Apache-2.0
"""Metrics on labellings whose values follow by hand."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from pcgraph import metrics

TRUTH = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1, 1])
FOUND = np.array([5, 5, 5, 7, 7, 7, 7, 7, 7, 7])
# Pairs, points: 5 and 0, 3; 7 and 0, 1; 7 and 1, 6.


def test_overlap_by_hand():
    # IoU(0, 5) = 3/4, IoU(0, 7) = 1/10, IoU(1, 7) = 6/7.
    assert metrics.segmentation_covering(FOUND, TRUTH) == pytest.approx((4 * 3 / 4 + 6 * 6 / 7) / 10)
    assert metrics.achievable_segmentation_accuracy(FOUND, TRUTH) == pytest.approx(9 / 10)


def test_one_to_one_takes_no_segment_twice():
    whole = np.zeros(10, int)  # IoU with 0 is 4/10, with 1 it is 6/10
    assert metrics.segmentation_covering(whole, TRUTH) == pytest.approx((4 * 0.4 + 6 * 0.6) / 10)
    assert metrics.segmentation_covering(whole, TRUTH, matching="one_to_one") == pytest.approx(6 * 0.6 / 10)
    best = metrics.segmentation_covering(FOUND, TRUTH)
    assert metrics.segmentation_covering(FOUND, TRUTH, matching="one_to_one") == best


def test_one_to_one_is_the_best_assignment_not_the_greedy_one():
    truth = np.repeat([0, 1], [10, 4])
    found = np.concatenate([np.repeat([0, 1], [4, 6]), np.ones(4, int)])  # 0: 10 * 4/10 or 10 * 6/14; 1: 4 * 4/10
    greedy, best = 10 * 6 / 14, 10 * 4 / 10 + 4 * 4 / 10
    assert greedy < best
    assert metrics.segmentation_covering(found, truth, matching="one_to_one") == pytest.approx(best / 14)


def test_undersegmentation_error_by_hand():
    # Segment 7 (7 points) leaks: one point in 0, six outside of it.
    assert metrics.undersegmentation_error(FOUND, TRUTH) == pytest.approx((0 + 1 + 1) / 10)
    # Segments that meet 0: 3 + 7 points; 1: 7 points.
    assert metrics.undersegmentation_error(FOUND, TRUTH, definition="papon") == pytest.approx((10 + 7 - 10) / 10)
    levinshtein = ((10 - 4) / 4 + (7 - 6) / 6) / 2
    assert metrics.undersegmentation_error(FOUND, TRUTH, definition="levinshtein") == pytest.approx(levinshtein)


def test_over_and_undersegmentation_rates_by_hand():
    # Best for 0 is 5 with 3 points, none outside; for 1 it is 7 with 6, one outside.
    assert metrics.oversegmentation_rate(FOUND, TRUTH) == pytest.approx(1 - 9 / 10)
    assert metrics.undersegmentation_rate(FOUND, TRUTH) == pytest.approx(1 / 10)
    assert metrics.undersegmentation_rate(np.zeros(10, int), TRUTH) == pytest.approx((6 + 4) / 10)
    # For 0: equal overlaps of two points, with one point outside and with none, of which the latter counts; for 1: 2.
    assert metrics.undersegmentation_rate(np.array([0, 0, 1, 1, 0]), np.array([0, 0, 0, 0, 1])) == pytest.approx(2 / 5)


def test_adjusted_rand_index_by_hand():
    # Pairs together: in both 3 + 15, in the labels 3 + 21, in the truth 6 + 15, of 45.
    expected = 24 * 21 / 45
    assert metrics.adjusted_rand_index(FOUND, TRUTH) == pytest.approx((18 - expected) / (22.5 - expected))
    assert metrics.adjusted_rand_index(np.zeros(4, int), np.zeros(4, int)) == 1
    assert metrics.adjusted_rand_index(np.arange(4), np.arange(4)) == 1
    assert metrics.adjusted_rand_index(np.arange(4), np.zeros(4, int)) == 0
    assert metrics.adjusted_rand_index(np.zeros(1, int), np.zeros(1, int)) == 1


def test_variation_of_information_by_hand():
    halves = metrics.variation_of_information(np.array([0, 0, 1, 1]), np.array([0, 0, 0, 0]))
    assert (halves.split, halves.merge, halves.total) == (1, 0, 1)  # one bit says which half
    halves = metrics.variation_of_information(np.array([0, 0, 0, 0]), np.array([0, 1, 2, 3]))
    assert (halves.split, halves.merge) == (0, 2)


def test_explained_variation_by_hand():
    values = np.array([0.0, 2.0, 10.0, 12.0])
    # Total 4 * 25 + 4 * 1 about 6 = 16 + 36 + ... : 36 + 16 + 16 + 36; between segments 4 * 25.
    assert metrics.explained_variation(values, np.array([0, 0, 1, 1])) == pytest.approx(100 / 104)
    assert metrics.explained_variation(values, np.zeros(4, int)) == 0
    assert metrics.explained_variation(values[:, None] * [1, 2, 3], np.arange(4)) == 1
    assert metrics.explained_variation(np.full((2, 3), 7.0), np.arange(2)) == 1
    masked = metrics.explained_variation(np.array([[0, 2, 10], [12, np.nan, 5]]), np.array([[0, 0, 1], [1, -1, -1]]))
    assert masked == pytest.approx(100 / 104)


def test_panoptic_quality_by_hand():
    quality = metrics.panoptic_quality(FOUND, TRUTH)
    assert (quality.sq, quality.rq) == (pytest.approx((3 / 4 + 6 / 7) / 2), 1)
    assert quality.pq == pytest.approx(quality.sq * quality.rq)
    # IoU of exactly one half is no match.
    half = metrics.panoptic_quality(np.array([0, 0, 1, 1]), np.zeros(4, int))
    assert (half.pq, half.spurious.tolist(), half.missed.tolist()) == (0, [2], [1])


def test_panoptic_quality_of_classes_is_their_mean():
    truth_class, found_class = np.where(TRUTH == 0, 3, 8), np.where(FOUND == 5, 3, 8)
    quality = metrics.panoptic_quality(FOUND, TRUTH, found_class, truth_class)
    assert quality.classes.tolist() == [3, 8]
    assert quality.of_classes == pytest.approx([3 / 4, 6 / 7])
    wrong = metrics.panoptic_quality(FOUND, TRUTH, np.full(10, 8), truth_class)  # 5 is not of class 3 now
    assert wrong.matches.tolist() == [0, 1]
    assert wrong.spurious.tolist() == [0, 1]
    assert wrong.missed.tolist() == [1, 0]
    assert wrong.of_classes == pytest.approx([0, (6 / 7) / 1.5])
    assert wrong.pq == pytest.approx((6 / 7) / 1.5 / 2)


def test_negative_labels_take_no_part():
    longer = np.append(FOUND, -1), np.append(TRUTH, 3)
    assert metrics.segmentation_covering(*longer) == metrics.segmentation_covering(FOUND, TRUTH)
    assert metrics.panoptic_quality(*longer).pq == metrics.panoptic_quality(FOUND, TRUTH).pq
    assert metrics.contingency(*longer).toarray().tolist() == [[3, 0], [1, 6]]


def test_table_counts_every_point_once():
    table = metrics.contingency(FOUND, TRUTH)
    assert table.toarray().tolist() == [[3, 0], [1, 6]]
    far = metrics.contingency(FOUND * 10**15, TRUTH)  # labels too far apart to be counted in a table
    assert far.toarray().tolist() == [[3, 0], [1, 6]]


def test_bad_arguments():
    with pytest.raises(ValueError, match="one shape"):
        metrics.contingency(FOUND, TRUTH[:3])
    with pytest.raises(ValueError, match="at least one point"):
        metrics.contingency(np.array([-1]), np.array([0]))
    with pytest.raises(ValueError, match="whole numbers"):
        metrics.contingency(FOUND / 2, TRUTH)
    with pytest.raises(ValueError, match="definition"):
        metrics.undersegmentation_error(FOUND, TRUTH, definition="stutz")
    with pytest.raises(ValueError, match="matching"):
        metrics.segmentation_covering(FOUND, TRUTH, matching="greedy")
    with pytest.raises(ValueError, match="or neither"):
        metrics.panoptic_quality(FOUND, TRUTH, FOUND)
    with pytest.raises(ValueError, match="class >= 0"):
        metrics.panoptic_quality(FOUND, TRUTH, FOUND, TRUTH - 1)
    with pytest.raises(ValueError, match="classes of the labels' shape"):
        metrics.panoptic_quality(FOUND, TRUTH, FOUND[:2], TRUTH[:2])
    with pytest.raises(ValueError, match="values for labels"):
        metrics.explained_variation(np.zeros((9, 3)), FOUND)
    with pytest.raises(ValueError, match="finite values"):
        metrics.explained_variation(np.full(10, np.nan), FOUND)
    with pytest.raises(ValueError, match="at least one point"):
        metrics.explained_variation(np.zeros(10), -FOUND)


def test_every_public_name_resolves_and_says_what_it_is():
    for name in metrics.__all__:
        thing = getattr(metrics, name)
        assert callable(thing), f"{name} is shadowed by a module"
        assert thing.__doc__
    assert sorted(metrics.__all__) == dir(metrics)
    with pytest.raises(AttributeError, match="attribute accuracy"):
        _ = metrics.accuracy


def test_import_loads_nothing_heavy():
    code = "import pcgraph.metrics, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60).stdout
    assert not {"numpy", "scipy", "numba", "sklearn"} & set(loaded.split())
