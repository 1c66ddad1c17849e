# SPDX-License-Identifier: Apache-2.0
"""Bridges lead from specks to what is around them: coarser cuts lose these first, and no object takes them in."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.surfaces import directions, tile
from scenes.tables import two_boxes_on_a_plane
from scipy.spatial.distance import cdist

import pcgraph
from pcgraph.disjoint_sets import connected_components

SETTINGS = {"voxel_size": 0.05, "viewpoint": (0.0, 0.0, 30.0), "range_growth": 0.0}


def sheet(width: float, depth: float, corner: tuple[float, float, float]) -> np.ndarray:
    """A level sheet, four points per voxel."""
    return tile(corner, (width, 0.0, 0.0), (0.0, depth, 0.0), 0.025)


def balls(n: int, seed: int) -> np.ndarray:
    """So many balls at random, of all sizes, with some specks near to each other."""
    rng = np.random.default_rng(seed)
    clouds = []
    for _ in range(n):
        ball = directions(int(rng.integers(5, 800)), rng)
        clouds.append(rng.uniform(0.0, 8.0, 3) + rng.uniform(0.01, 0.4) * ball)
    return np.concatenate(clouds)


@pytest.mark.filterwarnings("ignore:expected far fewer objects")
@pytest.mark.parametrize(("n", "seed"), [(60, 3), (120, 5), (200, 4)])
def test_bridges_lead_from_each_speck_to_components_around_it(n, seed):
    result = pcgraph.segment(balls(n, seed), **SETTINGS)
    graph, found = result.graph, result.graph.bridges
    component = connected_components(graph.joined, graph.n_nodes)
    sizes = np.bincount(component, result.leaves.counts)
    ends = component[found.edges]
    small = sizes < result.leaves.counts.mean()
    assert 1 < small.sum() < len(sizes)
    assert small[ends].any(axis=1).all()
    assert set(np.flatnonzero(small)) <= set(ends.ravel())
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


def test_a_cloud_without_specks_has_no_bridges():
    for cloud in (sheet(1.0, 1.0, (0, 0, 0)), np.concatenate([sheet(1.0, 1.0, (2 * i, 0, 0)) for i in range(3)])):
        result = pcgraph.segment(cloud, **SETTINGS)
        assert result.graph.bridges.edges.shape == (0, 2)
        assert result.graph.bridges.widths.shape == (0,)


def test_a_speck_that_nearly_touches_is_no_part_of_the_object():
    """Two and a half voxels above the inside of a plate, where no gap is sought: it stays an object of its own."""
    speck = np.random.default_rng(0).uniform((1.0, 1.0, 0.13), (1.02, 1.02, 0.15), (8, 3))
    result = pcgraph.segment(np.concatenate((sheet(2.0, 2.0, (0.0, 0.0, 0.0)), speck)), **SETTINGS)
    assert (result.graph.bridges.widths < 3.0).all()
    assert result.labels.max() == result.groups.max() == 1
    assert result.cut(altitude=result.object_altitude * 1.001).max() == 0


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


@pytest.mark.parametrize("distance", [2.5, 20.0])
def test_things_apart_stay_whole_in_a_cut_into_as_many(distance):
    """Tables of one height, top and legs: their tops lie on one plane, but that is no reason to be one thing."""
    rng = np.random.default_rng(0)
    legs = [(x, y, 0.0) for x in (0.0, 1.15) for y in (0.0, 0.75)]
    table = [sheet(1.2, 0.8, (0.0, 0.0, 0.75))]
    table += [rng.uniform(foot, np.add(foot, (0.05, 0.05, 0.75)), (800, 3)) for foot in legs]
    one = np.concatenate(table)
    tables = np.concatenate([np.add(one, (distance * i, 0.0, 0.0)) for i in range(6)])
    result = pcgraph.segment(tables, **SETTINGS)
    truth = np.repeat(np.arange(6), len(one))
    assert pcgraph.metrics.weighted_overlap(result.cut(n=6), truth) == 1.0
    assert np.count_nonzero(np.isinf(result.tree.altitudes)) == 5


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("times", [5.0, 10.0, 20.0])
def test_a_surface_sampled_too_thinly_for_the_voxels_is_no_dust(times, seed):
    """Each of its points was an object of its own: thousands, of a house that was seen from a window."""
    rng = np.random.default_rng(seed)
    floor, block = sheet(3.0, 3.0, (0.0, 0.0, 0.0)), sheet(0.6, 0.6, (1.0, 1.0, 0.5))
    n = 1500
    side = times * 0.025 * np.sqrt(n)
    wall = np.stack((rng.uniform(0.0, side, n), np.full(n, 15.0), rng.uniform(0.0, side, n)), axis=1)
    result = pcgraph.segment(np.concatenate((floor, block, wall)), **SETTINGS)
    is_wall = np.arange(len(floor) + len(block) + n) >= len(floor) + len(block)
    assert len(np.unique(result.labels[~is_wall])) == 2
    counts = np.bincount(result.labels[is_wall & (result.labels >= 0)])
    assert np.count_nonzero(counts) < 0.05 * n
