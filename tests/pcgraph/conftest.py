# SPDX-License-Identifier: Apache-2.0
"""Fixtures: one segmented scene, and the real clouds if they are here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenes.rooms import view_of_a_room
from scenes.tables import two_boxes_on_a_plane

import pcgraph
from pcgraph.detection import find_planes

# Modules that are run before the others: first those whose tests take seconds, lest a worker comes to one when the
# other has nothing left to do, then those with scikit-learn, which takes a second to import and which one worker
# imports for all if they are neighbours.
FIRST = (
    *("test_kernels", "test_real", "test_surface", "test_learning_classifier", "test_learning_transfer"),
    *("test_linkage_learned", "test_plain_files", "test_metrics_peers", "test_docs", "test_short_repr"),
    *("test_detection_objects", "test_detection_planes", "test_plausibility", "test_files"),
    *("test_properties",),
)
HERE = Path(__file__).parent
REAL_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the modules of `FIRST` before all others, each with its tests in their order."""
    rank = {name: number for number, name in enumerate(FIRST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)) if item.path.parent == HERE else len(rank))


@pytest.fixture(scope="session")
def boxes():
    """Points, truth and segmentation of two boxes on a plane."""
    points, truth, viewpoint = two_boxes_on_a_plane()
    return points, truth, pcgraph.segment(points, viewpoint=viewpoint)


@pytest.fixture(scope="session")
def rooms():
    """Four simulated rooms with their segmentations and planes."""
    views = [view_of_a_room(seed) for seed in range(4)]
    results = [pcgraph.segment(r.points, r.colors) for r in views]
    return [(r, s, find_planes(s, up=r.up)) for r, s in zip(views, results, strict=True)]


@pytest.fixture(scope="session")
def real_clouds() -> list[Path]:
    """Paths of the labelled real clouds."""
    paths = sorted((REAL_DATA / "mosd").glob("*.pcd"))
    if not paths:
        pytest.skip(f"the real clouds are not here: {REAL_DATA / 'mosd'}")
    return paths


@pytest.fixture(scope="session")
def real_sweep() -> np.ndarray:
    """Points (n, 3) that a 64-beam LiDAR on a car sees ahead of it, the scanner at 0."""
    path = REAL_DATA / "lidar" / "kitti_000008.bin"
    if not path.exists():
        pytest.skip(f"the real sweep is not here: {path}")
    return np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
