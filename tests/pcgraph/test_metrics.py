# SPDX-License-Identifier: Apache-2.0
"""Metrics on labellings whose values follow by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pcgraph import metrics

TRUTH = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1, 1])
FOUND = np.array([5, 5, 5, 7, 7, 7, 7, 7, 7, 7])


def test_values_by_hand():
    # IoU(0, 5) = 3/4, IoU(1, 7) = 6/7; segment 7 leaks one point.
    assert metrics.weighted_overlap(FOUND, TRUTH) == pytest.approx((4 * 3 / 4 + 6 * 6 / 7) / 10)
    assert metrics.undersegmentation_error(FOUND, TRUTH) == pytest.approx(2 / 10)
    assert metrics.achievable_accuracy(FOUND, TRUTH) == pytest.approx(9 / 10)


def test_perfect_and_unlabelled():
    assert metrics.weighted_overlap(TRUTH, TRUTH) == 1.0
    assert metrics.undersegmentation_error(TRUTH, TRUTH) == 0.0
    assert metrics.weighted_overlap(np.append(FOUND, -1), np.append(TRUTH, 3)) == metrics.weighted_overlap(FOUND, TRUTH)


def test_table_counts_every_point_once():
    table = metrics.contingency(FOUND, TRUTH)
    assert table.toarray().tolist() == [[3, 0], [1, 6]]


def test_bad_arguments():
    with pytest.raises(ValueError, match="one shape"):
        metrics.contingency(FOUND, TRUTH[:3])
    with pytest.raises(ValueError, match="at least one point"):
        metrics.contingency(np.array([-1]), np.array([0]))
