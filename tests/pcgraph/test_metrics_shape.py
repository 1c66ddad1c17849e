# SPDX-License-Identifier: Apache-2.0
"""Compactness of shapes whose second moments are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pcgraph.metrics import NeighbourGraph, compactness

SIDE = 80
U, V = (axis.ravel() for axis in np.meshgrid(np.arange(SIDE) - 39.5, np.arange(SIDE) - 39.5))
# A plane turned in space, in millimetres rather than grid steps.
GRID = 1e-3 * (np.outer(U, [1, 2, 2]) + np.outer(V, [2, 1, -2])) / 3 + [0.3, -0.2, 1.5]


def only(inside: NDArray[np.bool_], points: NDArray[np.float64] = GRID) -> float:
    """Compactness of one shape, with the neighbours that it has in its surroundings."""
    whole = NeighbourGraph.of(points, k=24)
    # Outside, each point is a segment of its own, and perfect.
    scattered = np.where(inside, 0, 1 + np.arange(len(points)))
    fraction = inside.mean()
    return (compactness(whole, scattered) - (1 - fraction)) / fraction


@pytest.mark.parametrize("k", [8, 24])
def test_areas_are_exact_on_a_grid(k: int):
    areas = NeighbourGraph.of(GRID, k=k).areas().reshape(SIDE, SIDE)
    assert areas[2:-2, 2:-2] == pytest.approx(1e-6)


def test_slant_and_noise_across_change_areas_little():
    rng = np.random.default_rng(2)
    slanted = np.stack([U, 1.4 * V, 2 * V], axis=1) + 0.2 * rng.normal(size=(len(U), 1)) * [0, 2, -1.4]
    areas = NeighbourGraph.of(slanted, k=24).areas().reshape(SIDE, SIDE)
    assert np.median(areas[5:-5, 5:-5]) == pytest.approx(np.hypot(1.4, 2), rel=0.05)


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        (U**2 + V**2 < 30**2, 1.0),
        ((abs(U) < 20) & (abs(V) < 20), 3 / np.pi),
        ((abs(U) < 32) & (abs(V) < 8), 24 / 17 / np.pi),
        ((U**2 + V**2 < 30**2) & (U**2 + V**2 > 20**2), (30**2 - 20**2) / (30**2 + 20**2)),
    ],
    ids=["disc", "square", "4 to 1", "ring"],
)
def test_compactness_of_known_shapes(inside: NDArray[np.bool_], expected: float):
    assert only(inside) == pytest.approx(expected, abs=0.01)


def test_pieces_and_salt_are_not_compact():
    pieces = ((abs(U) - 25) ** 2 + V**2) < 8**2
    salt = np.random.default_rng(0).random(len(U)) < 0.5
    assert only(pieces) < 0.2
    assert only(salt) < 0.6


def test_random_points_are_some_percent_low():
    flat = np.zeros((8000, 3))
    flat[:, :2] = np.random.default_rng(1).random((8000, 2)) - 0.5
    assert only((flat**2).sum(axis=1) < 0.4**2, flat) == pytest.approx(0.93, abs=0.03)


def test_lines_have_no_area():
    line = np.outer(np.arange(50.0), [1, 2, 3])
    assert compactness(line, np.repeat([0, 1], 25)) == pytest.approx(0, abs=1e-6)
    assert compactness(line, np.arange(50)) == 1


def test_single_points_and_duplicates_are_discs():
    assert compactness(GRID[:200], np.arange(200)) == pytest.approx(1)
    assert compactness(np.zeros((30, 3)), np.zeros(30, int)) == 1
    assert compactness(np.zeros((1, 3)), np.zeros(1, int)) == 1


def test_graph_or_points():
    labels = (U > 0).astype(int)
    assert compactness(GRID, labels, k=8) == compactness(NeighbourGraph.of(GRID), labels)
    organised = compactness(GRID.reshape(SIDE, SIDE, 3), labels.reshape(SIDE, SIDE))
    assert organised == compactness(GRID, labels)
    holes = np.where(V > 30, -1, labels)
    assert compactness(GRID, holes) == compactness(GRID[holes >= 0], holes[holes >= 0])
