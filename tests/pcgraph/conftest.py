# SPDX-License-Identifier: Apache-2.0
"""Fixtures: one segmented scene, and the real clouds if they are here."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from clouds import two_boxes_on_a_plane
from simulated_rooms import room

import pcgraph
from pcgraph.detection import find_planes

REAL_CLOUDS = Path(__file__).resolve().parents[3] / "shared" / "data" / "mosd"


@pytest.fixture(scope="session")
def boxes():
    """Points, truth and segmentation of two boxes on a plane."""
    points, truth, viewpoint = two_boxes_on_a_plane()
    return points, truth, pcgraph.segment(points, viewpoint=viewpoint)


@pytest.fixture(scope="session")
def rooms():
    """Four simulated rooms with their segmentations and planes."""
    views = [room(seed) for seed in range(4)]
    results = [pcgraph.segment(r.points, r.colors) for r in views]
    return [(r, s, find_planes(s, up=r.up)) for r, s in zip(views, results, strict=True)]


@pytest.fixture(scope="session")
def real_clouds() -> list[Path]:
    """Paths of the labelled real clouds."""
    paths = sorted(REAL_CLOUDS.glob("*.pcd"))
    if not paths:
        pytest.skip(f"the real clouds are not here: {REAL_CLOUDS}")
    return paths
