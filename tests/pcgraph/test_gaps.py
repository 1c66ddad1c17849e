# SPDX-License-Identifier: Apache-2.0
"""Gaps: which supervoxels nearly touch, and merges across them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes.streets import cartons
from scenes.surfaces import tile
from tiers import draws

import pcgraph
from pcgraph.acquisition.kinds import Scanner, Told, UnknownAcquisition
from pcgraph.graph.gaps import gaps, seen_between
from pcgraph.voxels.grid import voxel_grid
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.warp import Warp

VOXEL = 0.05


def sheet(start: float, stop: float, z: float = 0.0) -> np.ndarray:
    """Points of a level sheet over x in start..stop and y in 0..1, one per voxel of VOXEL at its centre."""
    return tile((start, 0.0, z), (stop - start, 0.0, 0.0), (0.0, 1.0, 0.0), VOXEL)


def two_sheets(empty: int, **settings) -> pcgraph.Segmentation:
    """Two sheets in one plane with so many empty voxels between them."""
    points = np.concatenate((sheet(0.0, 1.0), sheet(1.0 + empty * VOXEL, 2.0 + empty * VOXEL)))
    settings |= {"voxel_size": VOXEL, "seed_size": 6 * VOXEL, "viewpoint": (1.0, 0.5, 5.0), "range_growth": 0.0}
    return pcgraph.segment(points, **settings)


@pytest.mark.parametrize(("empty", "joined"), [(0, True), (1, True), (2, True), (3, False), (6, False)])
def test_what_lies_in_one_plane_merges_across_gaps_of_up_to_three_voxel_edges(empty, joined):
    result = two_sheets(empty)
    assert result.labels.max() + 1 == (1 if joined else 2)
    assert bool(len(result.graph.gaps.edges)) == (0 < empty < 3)


def test_rows_of_a_scan_from_one_place_merge_across_wider_gaps():
    rings = [np.arange(0, 2 * np.pi, 0.04 / r)[:, None] * (1.0, 0.0) + (0.0, r) for r in np.arange(4.0, 6.0, 0.35)]
    angle, radius = np.concatenate(rings).T
    ground = np.stack((radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), -1.8)), axis=1)
    settings = {"voxel_size": 0.08, "viewpoint": (0.0, 0.0, 0.0)}
    assert pcgraph.segment(ground, range_growth=0.5, **settings).labels.max() == 0
    assert pcgraph.segment(ground, range_growth=0.0, **settings).labels.max() + 1 == len(rings)


def test_rows_on_borders_between_cells_merge():
    """Each row lies in two by two cells: with up to eleven voxels around one, yet at the end of a surface."""
    rng = np.random.default_rng(0)
    along, row = np.meshgrid(np.arange(0.0, 2.0, VOXEL / 32), np.arange(12) * 3 * VOXEL)
    ground = np.stack((along.ravel(), row.ravel(), np.zeros(row.size)), axis=1)
    ground[:, 1:] += rng.normal(0.0, VOXEL / 12, (len(ground), 2))
    ground[0, 1:] = -0.618 * VOXEL  # cells start 0.382 edges before the first points
    settings = {"voxel_size": VOXEL, "viewpoint": (1.0, 1.0, 5.0), "range_growth": 0.0}
    result = pcgraph.segment(ground, **settings)
    assert np.median(np.diff(result.surface.grid.indptr)) > 8
    assert len(np.unique(result.graph.gaps.edges)) == result.tree.n_leaves
    assert result.labels.max() == 0


def test_a_gap_costs_more_in_one_scan():
    points = np.concatenate((sheet(0.0, 1.0), sheet(1.0 + VOXEL, 2.0, VOXEL)))
    settings = {"voxel_size": VOXEL, "seed_size": 6 * VOXEL, "viewpoint": (1.0, 0.5, 5.0)}
    several = pcgraph.segment(points, range_growth=0.0, **settings)
    one = dataclasses.replace(several.graph, acquisition=Scanner(Told(), np.zeros(3), 0.5))
    assert not several.acquisition.is_one_scan
    altitudes = [
        pcgraph.RegionLinkage(gap=gap).merges(graph, several.leaves).altitudes.max()
        for graph, gap in ((several.graph, 0.15), (one, 0.15), (several.graph, 0.45))
    ]
    assert altitudes[0] < altitudes[1] == pytest.approx(altitudes[2], abs=1e-5)
    assert pcgraph.segment(points, range_growth=0.5, **settings).acquisition.is_one_scan


def test_a_linkage_of_contacts_alone_merges_across_no_gap():
    assert two_sheets(1, linkage=pcgraph.ConvexityLinkage()).labels.max() + 1 == 2


def test_gaps_are_those_of_a_search_of_all_pairs():
    rng = np.random.default_rng(2)
    points = np.concatenate((sheet(0.0, 1.0), sheet(1.1, 1.6), sheet(0.3, 0.9, 0.12), rng.uniform(0, 1.5, (40, 3))))
    result = pcgraph.segment(points, voxel_size=VOXEL, viewpoint=(1.0, 0.5, 5.0), range_growth=0.0)
    grid, labels = result.surface.grid, result.surface.supervoxels
    found = gaps(result.surface, result.graph.node_features, result.graph.edges, UnknownAcquisition(Told()))
    touching = {tuple(pair) for pair in result.graph.edges.tolist()}
    degree = np.diff(grid.indptr)
    a, b = np.tril_indices(grid.n_voxels, -1)
    widths = np.linalg.norm(grid.warped[a] - grid.warped[b], axis=1) / grid.size
    near = (widths <= 3.0 + 1e-9) & (labels[a] != labels[b]) & (np.maximum(degree[a], degree[b]) < 8)
    expected: dict[tuple[int, int], float] = {}
    for i, j, width in zip(labels[a[near]].tolist(), labels[b[near]].tolist(), widths[near].tolist(), strict=True):
        pair = min(i, j), max(i, j)
        if pair not in touching:
            expected[pair] = min(width, expected.get(pair, np.inf))
    assert [tuple(pair) for pair in found.edges.tolist()] == sorted(expected)
    assert found.widths == pytest.approx([expected[pair] for pair in sorted(expected)])
    assert len(expected) > 5
    assert (found.weights > 0.0).all()


def test_a_cloud_of_one_voxel_has_no_gaps():
    result = pcgraph.segment(np.zeros((5, 3)), voxel_size=1.0)
    assert result.graph.gaps is not None
    assert result.graph.gaps.edges.shape == (0, 2)


@pytest.mark.parametrize("behind", [True, False])
def test_a_gap_through_which_something_is_seen_is_none(behind):
    """Two tables in one plane, three voxels apart, over a floor, or over nothing: what is missing may be one table."""
    settings = {"voxel_size": VOXEL, "seed_size": 6 * VOXEL, "viewpoint": (1.0, 0.5, 5.0), "range_growth": 0.5}
    tables = np.concatenate((sheet(0.0, 1.0), sheet(1.0 + 2.0 * VOXEL, 2.0 + 2.0 * VOXEL)))
    floor = sheet(-1.0, 3.1, -0.8)
    result = pcgraph.segment(np.concatenate((tables, floor)) if behind else tables, **settings)
    left, right = (np.bincount(result.labels[: len(tables)][some]).argmax() for some in halves_of(tables))
    assert (left == right) != behind


def halves_of(tables):
    """Which points lie left and right of the middle."""
    return tables[:, 0] < 1.0 + VOXEL, tables[:, 0] > 1.0 + VOXEL


def test_between_two_voxels_is_seen_what_lies_farther_off_near_the_middle():
    """Voxels of 5 cm that face the origin."""

    def seen(places, source, target, normals=None, place=(0.0, 0.0, 0.0)):
        facing = np.tile([0.0, 0.0, -1.0], (len(places), 1)) if normals is None else normals
        grid = voxel_grid(places, 0.05, Warp())
        assert grid.n_voxels == len(places)
        rows = grid.voxel_of_point
        surface = Surface(grid, facing[grid.order], rows)
        return seen_between(surface, np.array(place), np.stack((rows[source], rows[target]), axis=1)).tolist()

    places = np.array(
        [[-0.1, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 1.0, 1.0], [0.2, 1.0, 1.0], [0.2, 1.0, 3.0]]
    )
    source, target = np.array([0, 0, 3]), np.array([1, 4, 4])
    assert seen(places, source, target) == [True, False, False]  # the last is farther off, but not in the middle
    no_farther = places[:3] * [[1.0], [1.0], [0.53]]  # than by an edge and a half
    assert seen(no_farther, source[:1], target[:1]) == [False]
    farther = places[:3] * [[1.0], [1.0], [0.6]]
    assert seen(farther, source[:1], target[:1]) == [True]
    edge_on = np.tile([0.0, 1.0, 0.0], (3, 1))  # a plane that goes on there
    assert seen(farther, source[:1], target[:1], edge_on) == [False]
    one = np.zeros(1, np.int64)
    assert seen(places[:1], one, one, place=places[0]) == [False]


@pytest.mark.parametrize("seed", draws(14, 4))
def test_equal_cartons_in_a_row_are_objects(seed):
    """Their tops lie in one plane, and merged across 15 cm at any price: all six were one object."""
    points, truth = cartons(seed, 0.15)
    labels = pcgraph.segment(points).labels
    assert len(np.unique([np.bincount(labels[truth == k]).argmax() for k in range(6)])) >= 5
