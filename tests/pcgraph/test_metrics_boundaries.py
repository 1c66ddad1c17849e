# SPDX-License-Identifier: Apache-2.0
"""Boundary recall and precision on rows of points whose boundaries can be counted."""

from __future__ import annotations

import numpy as np
import pytest
from checks import SEEDS
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pcgraph.metrics import NeighbourGraph, boundary_precision, boundary_recall

# Steps grow a little, so that no two neighbours are equally far.
ROW = np.zeros((12, 3))
ROW[:, 0] = np.cumsum(1 + 1e-3 * np.arange(12))
TRUTH = np.repeat([0, 1], 6)


def cut_at(i: int) -> NDArray[np.int64]:
    return np.repeat([0, 1], [i, 12 - i])


def test_a_boundary_point_has_another_label_among_its_nearest():
    graph = NeighbourGraph.of(ROW, k=2)
    assert np.flatnonzero(graph.boundary(TRUTH)).tolist() == [5, 6]
    wider = NeighbourGraph.of(ROW, k=4)
    assert np.flatnonzero(wider.boundary(TRUTH)).tolist() == [4, 5, 6, 7]


@pytest.mark.parametrize(
    ("shift", "hops", "fraction"), [(0, 0, 1), (1, 0, 0.5), (1, 1, 1), (2, 0, 0), (2, 1, 0.5), (3, 2, 0.5)]
)
def test_recall_counts_hops(shift: int, hops: int, fraction: float):
    # Boundary points of the truth: 5, 6; of the labels: 5 + shift, 6 + shift.
    found = cut_at(6 + shift)
    assert boundary_recall(ROW, found, TRUTH, hops=hops, k=2) == fraction
    assert boundary_precision(ROW, TRUTH, found, hops=hops, k=2) == fraction


def test_tolerance_is_a_distance_and_includes_its_end():
    found = cut_at(8)  # boundary points 7 and 8; from 6 to 7 it is a step, from 5 to 7 it is two
    near, far = ROW[7, 0] - ROW[6, 0], ROW[7, 0] - ROW[5, 0]
    assert boundary_recall(ROW, found, TRUTH, k=2, tolerance=0.99 * near) == 0
    assert boundary_recall(ROW, found, TRUTH, k=2, tolerance=near) == 0.5
    assert boundary_recall(ROW, found, TRUTH, k=2, tolerance=far) == 1


def test_negative_points_take_no_part():
    points = np.insert(ROW, 6, (ROW[5] + ROW[6]) / 2, axis=0)
    found, truth = np.insert(cut_at(6), 6, 9), np.insert(TRUTH, 6, -1)
    assert boundary_recall(points, found, truth, k=2, hops=0) == 1
    assert boundary_precision(points, found, truth, k=2, hops=0) == 1
    points[6] = np.nan
    assert boundary_recall(points, found, truth, k=2, hops=0) == 1


def test_organised_clouds_are_lists_of_points():
    points, found = ROW.reshape(3, 4, 3), cut_at(7)
    flat = boundary_recall(ROW, found, TRUTH, k=2, hops=0)
    assert boundary_recall(points, found.reshape(3, 4), TRUTH.reshape(3, 4), k=2, hops=0) == flat == 0.5
    assert NeighbourGraph.of(points, k=2).boundary(found.reshape(3, 4)).shape == (3, 4)


def test_nothing_to_find_is_all_found():
    one = np.zeros(12, int)
    assert boundary_recall(ROW, TRUTH, one) == 1
    assert boundary_recall(ROW, one, TRUTH) == 0
    assert boundary_recall(ROW, one, TRUTH, tolerance=100.0) == 0
    assert boundary_precision(ROW, one, TRUTH) == 1
    assert boundary_recall(ROW[:1], one[:1], TRUTH[:1]) == 1


def test_duplicates_are_neighbours_of_each_other():
    points = np.zeros((30, 3))
    labels = np.arange(30) % 2
    graph = NeighbourGraph.of(points, k=8)
    assert (graph.neighbours != np.arange(30)[:, None]).all()
    assert all(len(set(row)) == 8 for row in graph.neighbours.tolist())
    assert boundary_recall(points, labels, labels) == 1


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(0, 2))
def test_laws(seed: int, hops: int):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(60, 3))
    truth, coarse = rng.integers(0, 3, 60), rng.integers(0, 4, 60)
    fine = coarse * 3 + rng.integers(0, 3, 60)
    graph = NeighbourGraph.of(points)
    assert graph.recall(truth, truth, hops=hops) == graph.precision(truth, truth, hops=hops) == 1
    assert graph.recall(fine, truth, hops=hops) >= graph.recall(coarse, truth, hops=hops)
    assert graph.recall(coarse, truth, hops=hops + 1) >= graph.recall(coarse, truth, hops=hops)
    assert graph.recall(coarse, truth, hops=hops) == graph.precision(truth, coarse, hops=hops)
    assert graph.recall(np.array([7, 3, 9, 0])[coarse], truth, hops=hops) == graph.recall(coarse, truth, hops=hops)
    assert graph.recall(coarse, truth, hops=hops) == boundary_recall(points, coarse, truth, hops=hops)


def test_bad_arguments():
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        NeighbourGraph.of(np.zeros((4, 2)))
    with pytest.raises(ValueError, match="one shape"):
        boundary_recall(ROW, TRUTH[:3], TRUTH)
    with pytest.raises(ValueError, match="one value of valid"):
        boundary_recall(ROW[:3], TRUTH, TRUTH)
    with pytest.raises(ValueError, match="at least one point"):
        boundary_recall(ROW, TRUTH - 5, TRUTH)
    with pytest.raises(ValueError, match="finite points"):
        boundary_recall(np.full((12, 3), np.nan), TRUTH, TRUTH)
    with pytest.raises(ValueError, match="at least 1 neighbour"):
        boundary_recall(ROW, TRUTH, TRUTH, k=0)
    with pytest.raises(ValueError, match="whole number of at least 0"):
        boundary_recall(ROW, TRUTH, TRUTH, hops=-1)
    with pytest.raises(ValueError, match="tolerance of at least 0"):
        boundary_recall(ROW, TRUTH, TRUTH, tolerance=float("nan"))
    with pytest.raises(ValueError, match="labels >= 0"):
        NeighbourGraph.of(ROW).boundary(TRUTH - 1)
    with pytest.raises(ValueError, match="points' shape"):
        NeighbourGraph.of(ROW).boundary(TRUTH[:3])
