# SPDX-License-Identifier: Apache-2.0
"""Bridges join what neither contacts nor gaps do, at a price that tells an object from its neighbour."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from clouds import two_boxes_on_a_plane
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

import pcgraph
from pcgraph.disjoint_sets import connected_components
from pcgraph.graph.bridges import bridges

SETTINGS = {"voxel_size": 0.05, "viewpoint": (0.0, 0.0, 30.0), "range_growth": 0.0}


def sheet(width: float, depth: float, corner: tuple[float, float, float]) -> np.ndarray:
    """A level sheet, four points per voxel."""
    x, y = np.meshgrid(np.arange(0.0125, width, 0.025), np.arange(0.0125, depth, 0.025))
    return np.stack((x.ravel(), y.ravel(), np.zeros(x.size)), axis=1) + corner


def balls(n: int, seed: int) -> np.ndarray:
    """So many balls at random, of all sizes, with some specks near to each other."""
    rng = np.random.default_rng(seed)
    clouds = []
    for _ in range(n):
        directions = rng.normal(size=(int(rng.integers(5, 800)), 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        clouds.append(rng.uniform(0.0, 8.0, 3) + rng.uniform(0.01, 0.4) * directions)
    return np.concatenate(clouds)


@pytest.mark.filterwarnings("ignore:expected far fewer objects")
@pytest.mark.parametrize(("n", "seed"), [(2, 0), (3, 1), (17, 2), (60, 3)])
def test_bridges_join_all_and_lead_from_each_component_to_another(n, seed):
    result = pcgraph.segment(balls(n, seed), **SETTINGS)
    graph, component = result.graph, result.graph.components
    found = graph.bridges
    assert component.max() > 0
    assert not connected_components(np.concatenate((graph.joined, found.edges)), graph.n_nodes).any()
    ends = component[found.edges]
    assert (ends[:, 0] != ends[:, 1]).all()
    assert len({tuple(sorted(pair)) for pair in ends.tolist()}) == len(ends)
    assert (found.edges[:, 0] < found.edges[:, 1]).all()
    assert [tuple(pair) for pair in found.edges.tolist()] == sorted(map(tuple, found.edges.tolist()))
    grid, supervoxels = result.surface.grid, result.surface.supervoxels
    exact = [
        cdist(grid.warped[supervoxels == a], grid.warped[supervoxels == b]).min() / grid.size for a, b in found.edges
    ]
    assert (found.widths >= np.array(exact) - 1e-9).all()
    assert np.median(found.widths / exact) == pytest.approx(1.0)
    assert (found.widths / exact).max() < 1.3


def test_far_components_are_bridged_where_they_are_nearest():
    """Two squares of each some hundred supervoxels: of none of them is one of the other among the nearest eight."""
    points = np.concatenate(
        (sheet(3.0, 3.0, (0.0, 0.0, 0.0)), sheet(3.0, 3.0, (7.0, 1.0, 2.0)), sheet(1, 1, (4, 0, 9)))
    )
    result = pcgraph.segment(points, **SETTINGS)
    component, found = result.graph.components, result.graph.bridges
    assert component.max() == 2
    grid, supervoxels = result.surface.grid, result.surface.supervoxels
    means = np.stack([np.bincount(supervoxels, x) for x in grid.warped.T], axis=1) / np.bincount(supervoxels)[:, None]
    between = {}
    for pair in combinations(range(3), 2):
        a, b = (means[component == name] for name in pair)
        between[pair] = cdist(a, b).min() / grid.size
    ways = {tuple(sorted(component[edge].tolist())): means[edge] for edge in found.edges}
    assert set(ways) == set(sorted(between, key=between.__getitem__)[:2])  # the third, the longest, is needed by none
    for pair, (a, b) in ways.items():
        assert np.linalg.norm(a - b) / grid.size == pytest.approx(between[pair])


def test_a_connected_cloud_has_no_bridges():
    result = pcgraph.segment(sheet(1.0, 1.0, (0.0, 0.0, 0.0)), **SETTINGS)
    assert result.graph.bridges.edges.shape == (0, 2)
    assert result.graph.bridges.widths.shape == (0,)


def test_widths_are_found_of_supervoxels_of_any_size():
    points = np.concatenate((sheet(4.0, 4.0, (0.0, 0.0, 0.0)), sheet(4.0, 4.0, (4.5, 0.0, 0.0))))
    result = pcgraph.segment(points, seed_size=20.0, **SETTINGS)
    assert result.graph.n_nodes == 2
    assert result.graph.bridges.widths == pytest.approx([11.0])
    grid = result.surface.grid
    assert bridges(grid, result.surface.supervoxels, result.graph.joined).widths == pytest.approx([11.0])


def test_a_cut_into_few_segments_spends_none_on_specks():
    """Forty specks in the air: joined last, they were all that a cut into few segments showed of three things."""
    points, truth, viewpoint = two_boxes_on_a_plane()
    rng = np.random.default_rng(0)
    places = rng.uniform((0.0, 0.0, 0.45), (1.6, 1.2, 0.9), (40, 1, 3))
    specks = (places + rng.uniform(0.0, 0.004, (40, 8, 3))).reshape(-1, 3)
    result = pcgraph.segment(np.concatenate((points, specks)), viewpoint=viewpoint)
    assert result.groups.max() == 40
    cut = result.cut(n=6)[: len(points)]
    assert pcgraph.metrics.weighted_overlap(cut, truth) > 0.99


def test_what_stands_apart_is_never_one_object_but_above_it():
    """Tables of one height are four, whatever they have in common; cuts above the objects' altitude weigh that."""
    tables = np.concatenate([sheet(1.2, 0.8, (1.5 * i, 0.0, 0.75)) for i in range(4)])
    result = pcgraph.segment(tables, **SETTINGS)
    truth = np.repeat(np.arange(4), len(tables) // 4)
    assert pcgraph.metrics.weighted_overlap(result.labels, truth) == 1.0
    assert np.array_equal(result.groups, result.labels)
    assert np.isfinite(result.tree.altitudes).all()
    assert result.cut(altitude=result.object_altitude * 1.001).max() == 0
    higher = pcgraph.segment(tables, object_altitude=0.5, **SETTINGS)
    assert higher.labels.max() == higher.groups.max() == 0
    apart = cKDTree(tables[truth == 0]).query(tables[truth == 1])[0].min() / result.voxel_size
    assert result.graph.bridges.widths == pytest.approx(apart, abs=1.0)
