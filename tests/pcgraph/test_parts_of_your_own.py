# SPDX-License-Identifier: Apache-2.0
"""Linkages, methods and scores from outside the package: what they return wrongly is refused in one sentence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import pcgraph
from pcgraph import metrics
from pcgraph.tree.linkage import Merges


@dataclass(frozen=True)
class Method(pcgraph.SupervoxelMethod):
    """SurfaceGrowth, whose result is spoilt."""

    how: str

    def planes(self, grid: Any, viewpoints: Any) -> Any:
        return pcgraph.SurfaceGrowth().planes(grid, viewpoints)

    def supervoxels(self, grid: Any, normals: Any, seed_size: float, initial: Any) -> Any:
        found = pcgraph.SurfaceGrowth().supervoxels(grid, normals, seed_size, initial)
        spoilt = {
            "fine": found,
            "as whole numbers of 64 bits": found.astype(np.int64),
            "none": None,
            "nothing labelled": np.full(grid.n_voxels, -1, np.int32),
            "one not labelled": np.where(np.arange(grid.n_voxels) == 3, -1, found),
            "gaps": 2 * found,
            "too short": found[:-1],
            "decimals": found.astype(float),
            "too large": found + 10**8,
        }
        return spoilt[self.how]


@dataclass(frozen=True)
class Spoilt(pcgraph.Linkage):
    """Convexity, whose merges are spoilt."""

    how: str
    default_object_altitude = 0.5
    default_part_altitude = 0.1

    def merges(self, graph: Any, leaves: Any) -> Any:
        found = pcgraph.ConvexityLinkage().merges(graph, leaves)
        pairs, altitudes = found.pairs, found.altitudes
        again = np.concatenate((pairs[:1], pairs[:-1]))
        spoilt: dict[str, Any] = {
            "fine": found,
            "none": None,
            "three of them": Merges(np.zeros((len(pairs), 3), np.int32), altitudes),
            "decimals": Merges(pairs.astype(float), altitudes),
            "too few altitudes": Merges(pairs, altitudes[:-1]),
            "a node that is not there": Merges(pairs + np.int32(10**6), altitudes),
            "a node below 0": Merges(pairs - np.int32(1), altitudes),
            "a node twice": Merges(again, altitudes),
            "not there yet": Merges(pairs[::-1].copy(), altitudes),
            "NaN": Merges(pairs, np.where(np.arange(len(altitudes)) == 2, np.nan, altitudes)),
            "negative": Merges(pairs, altitudes - 1.0),
            "descending": Merges(pairs, altitudes[::-1].copy()),
        }
        return spoilt[self.how]


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    """Two planes that meet in an edge."""
    x, y = np.meshgrid(np.linspace(0, 0.4, 60), np.linspace(0, 0.4, 60))
    return np.stack((x, y, 1.0 + np.abs(x - 0.2)), axis=-1)


def test_a_method_that_keeps_to_its_word_is_taken(cloud: np.ndarray) -> None:
    found, wide = (pcgraph.segment(cloud, method=Method(how)) for how in ("fine", "as whole numbers of 64 bits"))
    assert found.graph.n_nodes == pcgraph.segment(cloud).graph.n_nodes > 10
    assert wide.surface.supervoxels.dtype == np.int32
    np.testing.assert_array_equal(wide.supervoxels, found.supervoxels)


@pytest.mark.parametrize(
    "how", ["none", "nothing labelled", "one not labelled", "gaps", "too short", "decimals", "too large"]
)
def test_supervoxels_that_are_none_are_refused(cloud: np.ndarray, how: str) -> None:
    with pytest.raises(ValueError, match=r"^expected Method.supervoxels to "):
        pcgraph.segment(cloud, method=Method(how))


def test_a_linkage_that_keeps_to_its_word_is_taken(cloud: np.ndarray) -> None:
    plain = pcgraph.segment(cloud)
    np.testing.assert_array_equal(pcgraph.segment(cloud, linkage=Spoilt("fine")).labels, plain.labels)


@pytest.mark.parametrize(
    "how",
    [
        *("none", "three of them", "decimals", "too few altitudes", "a node that is not there", "a node below 0"),
        *("a node twice", "not there yet", "NaN", "negative", "descending"),
    ],
)
def test_merges_that_are_none_are_refused(cloud: np.ndarray, how: str) -> None:
    with pytest.raises(ValueError, match=r"^expected Spoilt.merges to "):
        pcgraph.segment(cloud, linkage=Spoilt(how))


def test_a_score_does_not_take_the_name_of_another() -> None:
    with pytest.raises(ValueError, match="expected a name of its own for a score, got 'segmentation_covering'"):
        metrics.level_score("segmentation_covering", larger_is_better=True)(lambda table, order: np.zeros(1))
