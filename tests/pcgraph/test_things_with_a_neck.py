# SPDX-License-Identifier: Apache-2.0
"""Things with a neck are whole before they join what they stand on, and count as one object each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scenes.bodies import bolt, bottle, box, dumbbell, lamp, on_a_table
from tiers import to_validate

import pcgraph
from pcgraph.detection.objects import TURNED_BODY
from pcgraph.detection.revolution import revolution_axis
from pcgraph.metrics.node_table import NodeTable


def best_node_overlaps(found: pcgraph.Segmentation, things: np.ndarray) -> np.ndarray:
    """Intersection over union of each thing with the node of the tree that fits it best."""
    table = NodeTable.of(found.tree, found.supervoxels, things)
    best = np.zeros(len(table.true_sizes))
    np.maximum.at(best, table.cells.segments, table.overlaps)
    return best[1:]


@pytest.mark.parametrize(
    ("make", "number", "seed", "is_whole"),
    [
        (dumbbell, 1, 1, True),
        (bottle, 1, 0, True),
        (lamp, 1, 0, True),
        (bolt, 9, 3, True),
        (box, 9, 0, True),
        *to_validate((dumbbell, 1, 0, False), (bolt, 9, 0, False)),
    ],
)
def test_each_is_one_object_and_mostly_a_node_of_the_tree(
    make: Callable[[float], Any], number: int, seed: int, is_whole: bool
) -> None:
    """Where a part joins the table below the altitude from which merges wait, no node is the whole thing."""
    sizes = np.random.default_rng(seed + 10).uniform(0.8, 1.2, number)
    cloud = on_a_table([make(float(size)) for size in sizes], seed)
    found = pcgraph.segment(cloud.points)
    assert len(pcgraph.detection.objects_on(found)) == number
    assert not is_whole or best_node_overlaps(found, cloud.things).min() > 0.9


def test_the_axis_of_a_torus_and_of_a_sphere_beside_the_origin() -> None:
    random = np.random.default_rng(0)
    turn, tube = random.uniform(0, 2 * np.pi, (2, 500))
    normals = np.stack([np.cos(tube) * np.cos(turn), np.cos(tube) * np.sin(turn), np.sin(tube)], axis=1)
    middle = 0.3 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    axis = revolution_axis(middle + 0.1 * normals + (5.0, -2.0, 1.0), normals)
    assert abs(axis.direction[2]) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(axis.origin[:2], (5.0, -2.0), atol=1e-9)
    ball = revolution_axis(0.1 * normals + (5.0, -2.0, 1.0), normals)
    assert ball.misses.max() < 1e-9  # through the middle, in whatever direction


@pytest.mark.parametrize(("corners", "miss"), [(6, 0.27), (4, 0.43)])
def test_how_far_normals_of_prisms_miss_their_axis(corners: int, miss: float) -> None:
    """Median of a uniform distribution over half a side, and root mean square distance of a side, in closed form."""
    half, apothem = np.tan(np.pi / corners), 1.0
    along = np.linspace(-half, half, 2001)
    turn = 2 * np.pi * np.arange(corners) / corners
    normals = np.repeat(np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1), len(along), axis=0)
    across = np.cross((0.0, 0.0, 1.0), normals) * np.tile(along, corners)[:, None]
    places = apothem * normals + across + np.random.default_rng(1).uniform(-9, 9, len(normals))[:, None] * (0, 0, 1)
    axis = revolution_axis(places, normals)
    assert abs(axis.direction[2]) > 0.999
    off = np.hypot(*(places - axis.origin)[:, :2].T)
    found = np.median(axis.misses) / np.sqrt(np.mean(off**2))
    assert found == pytest.approx(half / 2 / np.sqrt(1 + half**2 / 3), rel=0.02)
    assert found == pytest.approx(miss, abs=0.01)
    assert (found < TURNED_BODY.max_miss) == (corners == 6)
