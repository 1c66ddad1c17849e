# SPDX-License-Identifier: Apache-2.0
"""Supervoxels of points that were not there when the cloud was segmented."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.surfaces import patch

import pcgraph
from pcgraph.learning import propagation, supervoxels_at


@pytest.fixture(scope="module")
def valley():
    """Points of two planes that meet in a right angle along the y axis, and their segmentation."""
    floor = patch((0.01, 0, 0), (0.4, 0, 0), (0, 0.4, 0))
    wall = patch((0, 0, 0.01), (0, 0.4, 0), (0, 0, 0.4))
    points = np.vstack((floor, wall))
    return points, np.repeat([0, 1], len(floor)), pcgraph.segment(points, viewpoint=(1, 0.2, 1), voxel_size=0.03)


def test_the_points_themselves_get_what_they_have(valley):
    points, _, result = valley
    assert np.mean(supervoxels_at(result, points) == result.supervoxels) > 0.9


def test_beside_a_crease_the_right_side_is_taken(valley):
    _, side, result = valley
    votes = np.bincount(result.supervoxels, side) / np.bincount(result.supervoxels)
    rng = np.random.default_rng(0)
    along, away = rng.uniform(0.02, 0.38, 500), rng.uniform(0.012, 0.06, 500)
    on_floor = supervoxels_at(result, np.column_stack((away, along, np.zeros(500))))
    on_wall = supervoxels_at(result, np.column_stack((np.zeros(500), along, away)))
    assert np.mean(votes[on_floor] < 0.5) > 0.95
    assert np.mean(votes[on_wall] > 0.5) > 0.95


def test_far_and_missing_points_belong_to_nothing(valley):
    _, _, result = valley
    probe = np.array([[0.2, 0.2, 0.01], [0.2, 0.2, 0.2], [np.nan, 0, 0], [np.inf, 0, 0]])
    assert (supervoxels_at(result, probe) >= 0).tolist() == [True, False, False, False]
    assert (supervoxels_at(result, probe, max_distance=1.0) >= 0).tolist() == [True, True, False, False]
    assert (supervoxels_at(result, probe, max_distance=1e-6) >= 0).any() == np.False_


def test_shape_is_kept_and_empty_is_empty(valley):
    _, _, result = valley
    assert supervoxels_at(result, np.zeros((4, 5, 3))).shape == (4, 5)
    empty = supervoxels_at(result, np.empty((0, 3)))
    assert (empty.shape, empty.dtype) == ((0,), np.int32)
    assert supervoxels_at(pcgraph.segment([[0.0, 0, 1]]), [[0.0, 0, 1]]).tolist() == [0]


def test_blocks_change_nothing(valley, monkeypatch):
    points, _, result = valley
    at_once = supervoxels_at(result, points)
    monkeypatch.setattr(propagation, "BLOCK", 100)
    assert np.array_equal(supervoxels_at(result, points), at_once)


def test_wrong_input_is_refused(valley):
    _, _, result = valley
    with pytest.raises(ValueError, match="shape"):
        supervoxels_at(result, np.zeros(3))
    with pytest.raises(ValueError, match="max_distance"):
        supervoxels_at(result, np.zeros((1, 3)), max_distance=0.0)
