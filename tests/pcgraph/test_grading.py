# SPDX-License-Identifier: Apache-2.0
"""Voxels of several sizes: which touch and lie near, by brute force, and scenes whose points lie apart in places."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from checks import SEEDS, assert_covered_and_connected
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes.rooms import flat_ground, two_densities

import pcgraph
from pcgraph.acquisition.kinds import Scanner, Told, UnknownAcquisition
from pcgraph.metrics import segmentation_covering
from pcgraph.voxelisation.adapted_size import adapted_grading
from pcgraph.voxels.grading import BLOCK, Grading
from pcgraph.voxels.grid import VoxelGrid, at_ends, grid_union, grid_without, voxel_grid, voxels_within
from pcgraph.voxels.outliers import far_from
from pcgraph.voxels.warp import RangeWarp, Warp


def graded(rng: np.random.Generator, n: int, far: float = 0.0) -> tuple[NDArray[np.float64], Grading]:
    """Points along the borders of blocks of random levels, in units of a cell, so many blocks from the origin."""
    points = (rng.choice([-1, 0, 1, 2], (n, 3)) + far) * float(BLOCK) + rng.uniform(-5.0, 5.0, (n, 3))
    blocks = np.unique(np.floor(points / BLOCK), axis=0)
    blocks = blocks[rng.random(len(blocks)) < 0.8]
    return points, Grading(blocks, rng.integers(1, 5, len(blocks)).astype(np.int8))


def corners(grid: VoxelGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    edges = grid.warped_edges[:, None]
    return grid.cells * edges, (grid.cells + 1.0) * edges


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, n=st.integers(1, 400), far=st.sampled_from([0.0, 7e6, -3e6]))
def test_voxels_that_touch_are_cubes_that_share_a_point(seed: int, n: int, far: float) -> None:
    points, grading = graded(np.random.default_rng(seed), n, far)
    grid = voxel_grid(points, 1.0, Warp(), grading)
    low, high = corners(grid)
    assert np.all((points >= low[grid.voxel_of_point]) & (points < high[grid.voxel_of_point]))
    assert np.array_equal(grid.edge_lengths, grid.warped_edges)
    levels = {tuple(block): level for block, level in zip(grading.blocks, grading.levels, strict=True)}
    own = [levels.get(tuple(block), 0) for block in np.floor(points / BLOCK)]
    assert np.array_equal(np.zeros(grid.n_voxels) if grid.levels is None else grid.levels, _first(grid, own))
    for v in range(grid.n_voxels):
        touches = np.all((low <= high[v]) & (high >= low[v]), axis=1)
        touches[v] = False
        assert np.array_equal(grid.neighbours[grid.indptr[v] : grid.indptr[v + 1]], np.flatnonzero(touches))
        members = points[grid.order[grid.starts[v] : grid.starts[v + 1]]]
        assert grid.centroids[v] == pytest.approx(members.mean(axis=0), abs=1e-4)


def _first(grid: VoxelGrid, of_point: list[int]) -> NDArray[np.int64]:
    """What the points of each voxel have, all of them the same."""
    values = np.array(of_point)
    first = values[grid.order[grid.starts[:-1]]]
    assert np.array_equal(values, first[grid.voxel_of_point])
    return first


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS, n=st.integers(1, 300), later=st.booleans(), reach=st.sampled_from([1.0, 3.0, 6.0]))
def test_voxels_near_others_are_those_within_edges_of_the_larger_one(seed, n, later, reach):
    rng = np.random.default_rng(seed)
    points, grading = graded(rng, n)
    grid = voxel_grid(points, 1.0, Warp(), grading)
    some, among = (np.flatnonzero(rng.random(grid.n_voxels) < 0.7) for _ in range(2))
    found = voxels_within(grid, some, reach, among, later=later)
    larger = np.maximum(grid.warped_edges[:, None], grid.warped_edges)
    distances = np.linalg.norm(grid.warped[:, None] - grid.warped, axis=2)
    near = (distances <= reach * larger) & ~np.eye(grid.n_voxels, dtype=bool)
    near[:, ~np.isin(np.arange(grid.n_voxels), among)] = False
    for row, v in enumerate(some):
        expected = np.flatnonzero(near[v])
        expected = expected[expected > v] if later else expected
        assert np.array_equal(found.neighbours[found.indptr[row] : found.indptr[row + 1]], expected)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, n=st.integers(2, 300))
def test_a_union_is_the_grid_of_all_points_and_levels_are_grids_of_their_own(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points, grading = graded(rng, n)
    whole = voxel_grid(points, 1.0, Warp(), grading)
    a, b = (voxel_grid(part, 1.0, Warp(), grading) for part in (points[: n // 2], points[n // 2 :]))
    union = grid_union(a, b).grid
    for name in ("cells", "levels", "indptr", "neighbours", "counts", "edge_lengths"):
        assert np.array_equal(getattr(union, name), getattr(whole, name))
    assert union.warped == pytest.approx(whole.warped, abs=1e-4)
    for of_level, level in whole.of_levels():
        places = points[of_level[whole.voxel_of_point]]
        alone = voxel_grid(places, level.size, Warp())
        for name in ("cells", "indptr", "neighbours", "counts", "voxel_of_point", "order", "edge_lengths"):
            assert np.array_equal(getattr(level, name), getattr(alone, name))
    gone = rng.random(whole.n_voxels) < 0.5
    gone[0] = False
    left = grid_without(union, gone)
    for v, members in enumerate(np.split(left.order, left.starts[1:-1])):
        assert np.array_equal(members, np.flatnonzero(left.voxel_of_point == v))
    left = grid_without(whole, gone)
    again = voxel_grid(points[~gone[whole.voxel_of_point]], 1.0, Warp(), grading)
    assert np.array_equal(left.neighbours, again.neighbours)
    assert np.array_equal(left.levels, again.levels)
    assert at_ends(left, np.arange(left.n_voxels), np.zeros(left.n_voxels, np.int64)).dtype == np.bool_


# --- where voxels are larger ---


@pytest.mark.parametrize("thinner", [8.0, 20.0, 40.0])
def test_half_of_a_scene_may_be_thinned(thinner: float) -> None:
    """The thin half was dust, and to a good part outliers."""
    points, truth = two_densities(thinner)
    result = pcgraph.segment(points)
    grid = result.surface.grid
    assert result.outliers.mean() < 0.003
    assert segmentation_covering(result.labels, truth) > 0.95
    larger = grid.levels > 0
    assert np.mean(larger[grid.centroids[:, 0] > 4.5]) > (0.95 if thinner < 40.0 else 0.9)
    assert not larger[grid.centroids[:, 0] < 3.0].any()
    assert np.mean(np.diff(grid.indptr) >= 5) > 0.9
    assert_covered_and_connected(points, result)


def test_a_scene_of_several_densities_may_lie_in_a_map() -> None:
    """Keys of all levels together spanned the way from the map's origin to the scene."""
    points, truth = two_densities(20.0)
    result = pcgraph.segment(points + np.array([456_789.0, 5_212_345.0, 300.0]))
    assert result.surface.grid.levels.max() > 0
    assert segmentation_covering(result.labels, truth) > 0.95


def test_what_is_near_counts_in_edges_of_the_larger_voxel() -> None:
    everywhere = Grading(np.zeros((1, 3)), np.array([3], np.int8))
    large = voxel_grid(np.array([[1.0, 1.0, 1.0]]), 1.0, Warp(), everywhere)
    for away, near in ((15.0, True), (23.9, True), (24.1, False)):
        small = voxel_grid(np.array([[1.0 + away, 1.0, 1.0]]), 1.0, Warp(), everywhere)
        every = np.ones(1, np.bool_)
        assert far_from(small, large, every)[0] == far_from(large, small, every)[0] == (not near)


def test_where_points_lie_evenly_voxels_have_one_size() -> None:
    points, _ = two_densities(1.0)
    result = pcgraph.segment(points)
    assert result.surface.grid.levels is None
    assert pcgraph.segment(two_densities(20.0)[0], seed_size=0.3).surface.grid.levels is None
    assert pcgraph.segment(two_densities(20.0)[0], voxel_size=0.05).surface.grid.levels is None


def test_few_voxels_stay_small_where_some_of_them_are_joined() -> None:
    """Each thing has few: a sweep thinned to cubes lost a tenth of its things to larger voxels in blocks."""
    rng = np.random.default_rng(0)
    for n, is_graded in ((4_000, False), (40_000, True)):
        side = 0.05 * math.sqrt(n)
        dense, thin = (
            flat_ground(8 * n, (0.0, 0.0), (side, side), rng),
            flat_ground(n // 2, (side, 0.0), (2.0 * side, side), rng),
        )
        grid = voxel_grid(np.concatenate((dense, thin)), 0.05, Warp())
        assert 0.2 < np.mean(grid.joined[grid.centroids[:, 0] > side]) < 0.4
        assert (adapted_grading(grid, UnknownAcquisition(Told())) is not None) == is_graded


def test_voxels_of_one_scan_grow_already() -> None:
    """With the distance, and what of it lies in rows far apart is no surface at any size."""
    points, place = two_densities(20.0)[0], np.array([2.0, 2.0, 1.0])
    scanned = RangeWarp.about(points, place, 0.5)
    scanner = Scanner(Told(), place, 0.5)
    assert adapted_grading(voxel_grid(points, 0.05, scanned), scanner) is None
    assert adapted_grading(voxel_grid(points, 0.05, Warp()), UnknownAcquisition(Told())) is not None


def test_wires_and_strays_are_no_surfaces_at_any_size() -> None:
    rng = np.random.default_rng(0)
    wire = np.column_stack((rng.uniform(0.0, 40.0, 3000), np.zeros(3000), np.full(3000, 6.0)))
    strays = rng.uniform(-20.0, 20.0, (1000, 3))
    floor = flat_ground(60_000, (0.0, -3.0), (8.0, 3.0), rng)
    grid = voxel_grid(np.concatenate((floor, wire, strays)), 0.1, Warp())
    assert adapted_grading(grid, UnknownAcquisition(Told())) is None


@pytest.mark.parametrize("apart", [0.5, 0.9, 1.4])
def test_wires_that_larger_voxels_would_join_are_no_surface(apart: float) -> None:
    rng = np.random.default_rng(0)
    wires = [
        np.column_stack((rng.uniform(0.0, 40.0, 3000), np.full(3000, apart * i), np.full(3000, 6.0))) for i in range(5)
    ]
    floor = flat_ground(120_000, (0.0, -3.0), (16.0, 3.0), rng)
    points, wire = np.concatenate((floor, *wires)), np.repeat(np.arange(-1, 5), [len(floor), *map(len, wires)])
    assert adapted_grading(voxel_grid(points, 0.1, Warp()), UnknownAcquisition(Told())) is None
    supervoxels = pcgraph.segment(points).supervoxels
    pairs = np.unique(np.column_stack((supervoxels, wire))[wire >= 0], axis=0)
    assert len(pairs) == len(np.unique(pairs[:, 0]))


@pytest.mark.parametrize("method", [pcgraph.SurfaceGrowth(), pcgraph.Vccs()])
def test_neither_the_order_of_points_nor_the_unit_counts(method: pcgraph.SupervoxelMethod) -> None:
    points, truth = two_densities(20.0)
    result = pcgraph.segment(points, method=method)
    order = np.random.default_rng(1).permutation(len(points))
    assert np.array_equal(pcgraph.segment(points[order], method=method).supervoxels, result.supervoxels[order])
    in_mm = pcgraph.segment(points * 1000.0, method=method)
    assert in_mm.surface.grid.levels.max() == result.surface.grid.levels.max()
    assert segmentation_covering(in_mm.labels, truth) > 0.95


def test_a_scan_joins_one_whose_voxels_have_several_sizes() -> None:
    """What is seen again falls into the voxels that there are, and numbers stay; what is new has voxels of level 0."""
    points, truth = two_densities(20.0)
    rng = np.random.default_rng(2)
    chosen = rng.random(len(points)) < 0.5
    results = [pcgraph.segment(points[chosen])]
    beside = flat_ground(40_000, (8.0, 0.0), (12.0, 4.0), rng)
    for scan in (points[~chosen], beside):
        results.append(pcgraph.update(results[-1], scan))
        assert not results[-1].outliers.mean() > 0.002
    for earlier, later in pairwise(results):
        assert later.surface.grid.grading is earlier.surface.grid.grading
        assert later.tree.n_leaves >= earlier.tree.n_leaves
    objects = results[-1].objects
    labels = np.concatenate([objects[part.supervoxels] for part in results])
    kept = np.concatenate([part.supervoxels >= 0 for part in results])
    truth = np.concatenate((truth[chosen], truth[~chosen], np.zeros(len(beside), int)))
    assert segmentation_covering(labels[kept], truth[kept]) > 0.95
    grid = results[-1].surface.grid
    assert grid.levels[(grid.centroids[:, 0] > 5.0) & (grid.centroids[:, 0] < 7.5)].min() > 0
    assert not grid.levels[grid.centroids[:, 0] > 9.0].any()
