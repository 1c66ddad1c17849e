# SPDX-License-Identifier: Apache-2.0
"""Voxels: keys and neighbours by brute force, eigenvectors against LAPACK, spacing, planes beside edges."""

from __future__ import annotations

import time

import numpy as np
import pytest
from checks import SEEDS, overlaps
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes.images import QVGA, at_depths
from scenes.surfaces import cube_corner, directions, patch
from scenes.tables import boxes_on_a_table
from scipy.spatial import cKDTree

import pcgraph
from pcgraph.parallel import in_blocks
from pcgraph.voxels.cells import bounding_box, sorted_keys
from pcgraph.voxels.eigen import least_root, plane_normal, symmetric_eigen
from pcgraph.voxels.grid import voxel_grid, with_means
from pcgraph.voxels.spacing import median_spacing
from pcgraph.voxels.surface import local_planes
from pcgraph.voxels.warp import CameraWarp, RangeWarp, Warp, warped_normal


def six(matrix):
    """xx, yy, zz, xy, xz, yz of a symmetric matrix."""
    return np.array([matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[0, 1], matrix[0, 2], matrix[1, 2]])


RUNG = 2.0 ** (1 / 32) - 1.0  # by which sizes from the spacing are rounded, at most


@settings(max_examples=200, deadline=None)
@given(seed=SEEDS, spread=st.floats(-8.0, 0.0), scale=st.floats(-12.0, 12.0))
def test_closed_form_normal_is_lapacks_or_declined(seed, spread, scale):
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    values = np.sort(10.0 ** np.array([spread + rng.uniform(-8, 0), spread, 0.0])) * 10.0**scale
    matrix = axes @ np.diag(values) @ axes.T
    matrix = (matrix + matrix.T) / 2.0
    normal = np.empty(3)
    least = plane_normal(six(matrix), normal)
    if least < 0.0:
        assert values[1] - values[0] < 1e-3 * values.sum()  # too close to a line or a ball for the closed form
        return
    exact_values, exact = np.linalg.eigh(matrix)
    assert least == pytest.approx(exact_values[0], abs=1e-11 * values.sum())
    assert abs(normal @ exact[:, 0]) == pytest.approx(1.0, abs=1e-8)
    assert normal @ normal == pytest.approx(1.0, abs=1e-12)


def test_the_least_root_is_that_of_the_cosine_formula():
    """In extended precision where there is one: the formula's own rounding in doubles is twice the polynomial's."""
    near_ends = np.logspace(-17, -2, 500)
    ratios = np.concatenate((np.linspace(-1.0, 1.0, 100_001), 1.0 - near_ends, near_ends - 1.0))
    wide = np.longdouble(1.0)
    exact = np.cos((np.arccos(wide * ratios) + 4.0 * np.arcsin(wide)) / 3.0)
    found = np.array([least_root(ratio) for ratio in ratios])
    assert np.abs(found - exact).max() < 3e-16 + 4.0 * np.finfo(np.longdouble).eps
    assert least_root(1.0 + 1e-9) == least_root(1.0) == pytest.approx(-0.5, abs=3e-16)
    assert least_root(-1.0 - 1e-9) == least_root(-1.0) == pytest.approx(-1.0, abs=3e-16)


@settings(max_examples=200, deadline=None)
@given(seed=SEEDS, rank=st.integers(0, 3))
def test_rotations_give_lapacks_eigenvalues(seed, rank):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(3, rank)) * 10.0 ** rng.uniform(-6, 0, rank)
    matrix = factor @ factor.T
    diagonal, vectors = matrix.copy(), np.empty((3, 3))
    symmetric_eigen(diagonal, vectors)
    scale = max(np.trace(matrix), 1e-300)
    assert np.sort(np.diag(diagonal)) == pytest.approx(np.linalg.eigvalsh(matrix), abs=1e-13 * scale)
    assert vectors.T @ vectors == pytest.approx(np.eye(3), abs=1e-12)
    assert vectors @ np.diag(np.diag(diagonal)) @ vectors.T == pytest.approx(matrix, abs=1e-12 * scale)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, n=st.integers(1, 300), levels=st.integers(1, 9))
def test_voxels_and_neighbours_are_those_of_brute_force(seed, n, levels):
    rng = np.random.default_rng(seed)
    points = rng.integers(-levels, levels, (n, 3)) + rng.uniform(0.1, 0.9, (n, 3))
    grid = with_means(voxel_grid(points, 1.0, Warp()), points * 0.0 + 0.25)
    cells, inverse = np.unique(np.floor(points), axis=0, return_inverse=True)
    assert np.array_equal(grid.cells, cells)
    assert np.array_equal(grid.voxel_of_point, inverse.ravel())
    assert np.array_equal(grid.counts, np.bincount(inverse.ravel()))
    for voxel, cell in enumerate(cells):
        near = np.flatnonzero(np.abs(cells - cell).max(axis=1) == 1)
        assert np.array_equal(grid.neighbours[grid.indptr[voxel] : grid.indptr[voxel + 1]], near)
        assert np.abs(grid.centroids[voxel] - points[inverse.ravel() == voxel].mean(axis=0)).max() <= 1e-6
    assert grid.colors == pytest.approx(0.25, abs=1e-5)


def test_spacing_of_a_large_lattice_is_its_step():
    x, y = np.meshgrid(np.arange(700) * 0.01, np.arange(400) * 0.013)
    points = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))
    assert median_spacing(points) == pytest.approx(0.01, rel=1e-9)
    order = np.random.default_rng(0).permutation(len(points))
    assert median_spacing(points[order]) == median_spacing(points)


def _spacing_by_tree(points: NDArray[np.float64]) -> float:
    """Median distance to the nearest point, or an eighth of that to the eighth, over all points."""
    distances = cKDTree(points).query(points, min(9, len(points)))[0]
    eighth = np.median(distances[:, 8]) / 8.0 if len(points) > 8 else 0.0
    return float(max(np.median(distances[:, 1]), eighth))


@pytest.mark.parametrize(
    "kind",
    ["plane", "volume", "line", "lattice", "seven", "two", "heavy tails", "tiny", "huge", "far away", "clusters"],
)
def test_spacing_is_that_of_a_tree_over_all_points(kind: str) -> None:
    rng = np.random.default_rng(5)
    points = {
        "plane": np.c_[rng.random((4000, 2)), np.zeros(4000)],
        "volume": rng.random((4000, 3)),
        "line": np.c_[np.linspace(0.0, 1.0, 3000), np.zeros((3000, 2))],
        "lattice": np.stack(np.meshgrid(*[np.arange(15.0)] * 3), axis=-1).reshape(-1, 3),
        "seven": rng.random((7, 3)),
        "two": np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]),
        "heavy tails": rng.standard_cauchy((4000, 3)),
        "tiny": 1e-120 * rng.random((4000, 3)),
        "huge": 1e140 * rng.random((4000, 3)),
        "far away": 1e6 + rng.random((4000, 3)),
        "clusters": np.repeat(rng.random((40, 3)), 100, axis=0) + rng.normal(0.0, 1e-3, (4000, 3)),
    }[kind]
    tolerance = 0.05 if kind == "heavy tails" else 1e-9  # where points are too many in some cells, too few in others
    assert median_spacing(points) == pytest.approx(_spacing_by_tree(points), rel=tolerance)
    assert median_spacing(points[rng.permutation(len(points))]) == median_spacing(points)


def test_a_far_point_leaves_the_spacing_as_it_was() -> None:
    points = np.random.default_rng(2).random((4000, 3))
    assert median_spacing(np.vstack((points, [[1e9, -1e9, 1e9]]))) == pytest.approx(median_spacing(points), rel=0.02)


def test_far_points_leave_the_spacing_as_it_was() -> None:
    rng = np.random.default_rng(0)
    points = rng.random((10_000, 3)) * (0.1, 0.1, 0.0)
    with_far = np.concatenate((points, 1e3 * rng.random((100, 3))))
    assert median_spacing(with_far) == pytest.approx(median_spacing(points), rel=0.05)


@given(st.lists(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3), min_size=1, max_size=30))
def test_a_bounding_box_is_numpys_or_nan(points: list[tuple[float, float, float]]) -> None:
    array = np.array(points)
    expected = array.min(axis=0), array.max(axis=0)
    if np.isnan(array).any():
        expected = np.full((2, 3), np.nan)
    np.testing.assert_array_equal(bounding_box(array), expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_bounding_box_of_many_points_is_that_of_all_blocks(value: float) -> None:
    points = np.random.default_rng(0).normal(size=(300_001, 3))
    np.testing.assert_array_equal(bounding_box(points), (points.min(axis=0), points.max(axis=0)))
    points[-1, 1] = value
    expected = np.full((2, 3), np.nan) if np.isnan(value) else (points.min(axis=0), points.max(axis=0))
    np.testing.assert_array_equal(bounding_box(points), expected)


@given(st.lists(st.integers(0, 1 << 62), min_size=1, max_size=200))
def test_keys_are_sorted_by_their_digits_as_by_numpy(keys: list[int]) -> None:
    array = np.array(keys, np.int64)
    ordered, order = sorted_keys(array.copy())
    np.testing.assert_array_equal(order, np.argsort(array, kind="stable"))
    np.testing.assert_array_equal(ordered, array[order])


@pytest.mark.parametrize("shape", [(120, 160), (480, 640)])
def test_the_spacing_of_an_image_is_that_of_its_pixels_at_the_median_depth(shape: tuple[int, int]) -> None:
    """Ground from 1 m to 20 m: near pixels, close together, are no denser on the image than far ones."""
    height, width = shape
    pitch = 1.0 / width
    u, v = np.meshgrid(pitch * (np.arange(width) - width / 2), np.linspace(0.05, 1.0, height))
    points = np.stack((u, v, np.ones_like(u)), axis=-1) / v[..., None]  # 1 m below the camera
    warp = CameraWarp.about(points.reshape(-1, 3), np.zeros(3))
    expected = pitch * float(np.median(points[..., 2]))
    assert median_spacing(points.reshape(-1, 3), warp) == pytest.approx(expected, rel=1e-6)
    assert pcgraph.segment(points).surface.grid.size == pytest.approx(3.5 * expected, rel=RUNG)


@pytest.mark.parametrize(("noise", "is_smaller"), [(0.0, True), (0.1, True), (0.5, True), (1.0, False)])
def test_voxels_are_smaller_where_points_lie_evenly_on_smooth_surfaces(noise: float, is_smaller: bool) -> None:
    points = cube_corner(noise)
    result, usual = pcgraph.segment(points), 3.5 * median_spacing(points)
    voxel = result.voxel_size
    assert result.labels.max() == 2
    assert voxel < 0.8 * usual if is_smaller else voxel == pytest.approx(usual, rel=RUNG)
    assert pcgraph.segment(points, viewpoint=(-2.0, -2.0, -2.0)).voxel_size == voxel
    assert pcgraph.segment(points, voxel_size=0.05).voxel_size == 0.05


@pytest.mark.parametrize(("n", "least"), [(1500, 0.65), (3000, 0.72)])
@pytest.mark.parametrize("seed", range(2))
def test_few_points_are_enough_for_many_things(n: int, least: float, seed: int) -> None:
    """By 1500, some 55 on each box of 10 to 16 cm, none was found: IoU 0.04, by 3000 0.68 and 0.69."""
    points, truth = boxes_on_a_table(n, seed)
    assert overlaps(pcgraph.segment(points).labels, truth)[1:].mean() > least


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
def test_the_sizes_of_a_result_give_its_voxels_again(noise: float) -> None:
    """Cells were counted from a corner that kept a margin of the size before it was made to fit."""
    points = cube_corner(noise)
    found = pcgraph.segment(points)
    again = pcgraph.segment(points, voxel_size=found.voxel_size, seed_size=found.seed_size)
    assert np.array_equal(found.supervoxels, again.supervoxels)


@pytest.mark.filterwarnings("ignore:expected far fewer objects")
def test_voxels_of_an_image_do_not_depend_on_what_flies_before_it() -> None:
    """Small pieces all over the depth, as seen through glass, are joined to nothing at any size."""
    z = np.where(np.arange(240)[:, None] < 100, 1.5, np.full(QVGA, 1.2))
    random = np.random.default_rng(0)
    flying = np.where(random.random((60, 80)) < 0.05, random.uniform(0.6, 1.6, (60, 80)), 1.0)
    depths = z, z * np.kron(flying, np.ones((4, 4)))
    clean, seen = (pcgraph.segment(at_depths(QVGA, 300.0, depth)).voxel_size for depth in depths)
    assert seen == pytest.approx(clean, rel=0.1)


@pytest.mark.parametrize(("noise", "edges"), [(0.0, 3.0), (0.1, 3.0), (0.35, 3.24), (0.4, 4.37)])
def test_supervoxels_are_smaller_on_smooth_surfaces(noise: float, edges: float) -> None:
    """As many as 800 on rough ones, and as many as lie between where they are neither."""
    result = pcgraph.segment(cube_corner(noise))
    assert result.seed_size / result.voxel_size == pytest.approx(edges, rel=0.05)


@pytest.mark.parametrize("about", [lambda *_: Warp(), CameraWarp.about, lambda *a: RangeWarp.about(*a, 0.7)])
def test_a_warped_normal_tells_how_far_a_step_in_the_warped_space_leaves_the_plane(about):
    random = np.random.default_rng(0)
    points, normals, steps = random.uniform(1.0, 6.0, (50, 3)), *random.standard_normal((2, 50, 3))
    warp = about(points, np.array([0.1, 0.3, -2.0]))
    step = warp.forward(points + 1e-5 * steps) - warp.forward(points - 1e-5 * steps)
    warped = [warped_normal.py_func(warp.slant, *x, *n) for x, n in zip(warp.forward(points), normals, strict=True)]
    off = warp.scale(points) * np.einsum("ij,ij->i", warped, step)
    np.testing.assert_allclose(off, 2e-5 * np.einsum("ij,ij->i", normals, steps), rtol=1e-6, atol=1e-11)


def test_spacing_of_many_random_points_is_that_of_a_tree_over_all():
    rng = np.random.default_rng(1)
    points = rng.random((300_000, 3)) * (4.0, 3.0, 0.0)
    expected = np.sqrt(np.log(2.0) / (np.pi * 300_000 / 12.0))  # median nearest distance of a Poisson process
    assert median_spacing(points) == pytest.approx(expected, rel=0.05)
    with_outliers = np.vstack([points, [[1e9, -1e12, 3.0]]])
    assert median_spacing(with_outliers) == pytest.approx(expected, rel=0.05)


@pytest.fixture(scope="module")
def crease():
    """Voxels of a floor that meets a wall at a right angle, noise 1 mm, with the true normals and the distance."""
    floor, wall = patch((0, 0, 0), (1, 0, 0), (0, 0.6, 0)), patch((0, 0.6, 0), (1, 0, 0), (0, 0, 0.6))
    points = np.vstack([floor, wall]) + np.random.default_rng(2).normal(0, 0.001, (len(floor) + len(wall), 3))
    grid = voxel_grid(points, 0.03, Warp())
    above, before = grid.centroids[:, 2], 0.6 - grid.centroids[:, 1]
    truth = np.where((above < before)[:, None], (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    return grid, truth, np.maximum(above, before)


def angles(grid, truth, reach):
    return angles_to(local_planes(grid, np.array([0.5, -3.0, 3.0]), reach).normals, truth)


def angles_to(normals, truth):
    """Angles between rows, degrees."""
    return np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normals, truth), -1.0, 1.0)))


def test_normals_do_not_round_off_a_crease(crease):
    grid, truth, away = crease
    beside = (away > 0.03) & (away < 0.06)
    assert np.median(angles(grid, truth, 0)[beside]) > 10.0  # a window across the crease
    assert np.median(angles(grid, truth, 3)[beside]) < 1.5


def test_normals_on_plain_ground_average_noise(crease):
    grid, truth, away = crease
    plain = away > 0.15
    assert np.median(angles(grid, truth, 3)[plain]) < 1.3 * np.median(angles(grid, truth, 0)[plain])


def test_planes_go_through_their_surface(crease):
    grid, _, away = crease
    planes = local_planes(grid, np.array([0.5, -3.0, 3.0]), 3)
    offset = np.abs(np.einsum("ij,ij->i", planes.normals, grid.centroids - planes.origins))
    assert np.percentile(offset[away > 0.03], 99) < 0.003


def test_normals_on_a_ball_turn_smoothly():
    rng = np.random.default_rng(3)
    truth = directions(30_000, rng)
    points = truth * (0.5 + rng.normal(0, 0.0005, (len(truth), 1)))
    grid = voxel_grid(points, 0.03, Warp())
    outward = grid.centroids / np.linalg.norm(grid.centroids, axis=1, keepdims=True)
    plain, sharp = (
        np.percentile(angles_to(local_planes(grid, outward * 10.0, reach).normals, outward), 95) for reach in (0, 3)
    )
    assert sharp < 1.3 * plain  # facets as wide as the reach would be off three times as much


def test_a_million_points_in_one_place_cost_next_to_nothing():
    rng = np.random.default_rng(1)
    cloud = rng.random((20_000, 3)) * (1.0, 1.0, 0.0) + (0.0, 0.0, 1.0)
    start = time.process_time()
    with_zeros = median_spacing(np.vstack([cloud, np.zeros((1_000_000, 3))]))
    assert time.process_time() - start < 2.0
    assert with_zeros == pytest.approx(median_spacing(cloud), rel=0.05)
    assert median_spacing(np.zeros((200_000, 3))) == 0.01


def test_an_error_in_any_block_reaches_the_caller():
    def kernel(start, stop, failing):
        if start <= failing < stop:
            raise MemoryError("no room")

    for failing in (0, 99_999):
        with pytest.raises(MemoryError, match="no room"):
            in_blocks(kernel, 100_000, failing)
