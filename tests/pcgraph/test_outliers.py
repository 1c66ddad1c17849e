# SPDX-License-Identifier: Apache-2.0
"""Outliers: noise through the whole volume has a label of its own, and what is thin keeps its own."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.rooms import twenty_boxes
from scenes.tables import two_boxes_on_a_plane
from tiers import to_validate

import pcgraph
from pcgraph.voxels.grid import grid_without, voxel_grid, with_means
from pcgraph.voxels.outliers import detached_voxels, fill_the_volume, outlier_voxels
from pcgraph.voxels.warp import Warp


@pytest.fixture(scope="module")
def clean():
    """Two boxes on a plane, their truth, viewpoint, and the segmentation."""
    points, truth, viewpoint = two_boxes_on_a_plane()
    return points, truth, viewpoint, pcgraph.segment(points, viewpoint=viewpoint)


@pytest.mark.parametrize(("number", "reach"), [(30, 150.0), (60, 60.0), (300, 30.0)])
def test_a_few_points_far_off_do_not_say_how_large_voxels_are(clean, number, reach):
    """Cells of a handful of strays were most of all cells, and their spacing that of the cloud: voxels of 40 m."""
    points, truth, _, before = clean
    rng = np.random.default_rng(number)
    ways = rng.normal(size=(number, 3))
    ways *= reach * rng.uniform(0.3, 1.0, (number, 1)) / np.linalg.norm(ways, axis=1, keepdims=True)
    result = pcgraph.segment(np.concatenate((points, points.mean(axis=0) + ways)))
    assert result.voxel_size == pytest.approx(before.voxel_size, rel=0.1)
    assert result.outliers[len(points) :].all()
    covering = pcgraph.metrics.segmentation_covering(result.labels[: len(points)], truth)
    assert covering > pcgraph.metrics.segmentation_covering(before.labels, truth) - 0.02


@pytest.mark.parametrize("fraction", [0.1, 0.5])
def test_noise_through_the_volume_is_no_object(clean, fraction):
    points, truth, viewpoint, before = clean
    rng = np.random.default_rng(3)
    low, high = points.min(axis=0), points.max(axis=0) + np.array((0.0, 0.0, 0.5))
    noise = rng.uniform(low, high, (int(fraction * len(points)), 3))
    result = pcgraph.segment(np.concatenate((points, noise)), viewpoint=viewpoint)
    outliers = result.outliers
    assert outliers[len(points) :].mean() > 0.75  # the rest lies on or beside the surfaces
    assert outliers[: len(points)].mean() < 0.001
    n = len(points)
    covering = pcgraph.metrics.segmentation_covering(result.labels[:n], truth)
    assert covering > pcgraph.metrics.segmentation_covering(before.labels, truth) - 0.02
    assert (result.supervoxels[outliers] == -1).all()
    assert (result.cut(n=2)[outliers] == -1).all()
    assert np.isnan(result.on_points(np.zeros(result.tree.n_leaves))[outliers]).all()
    assert f"{outliers.sum()} outliers" in repr(result)


@pytest.mark.parametrize(("step", "fraction"), [(0.05, 0.2), *to_validate((0.03, 0.8), (0.05, 0.5), (0.05, 0.7))])
def test_noise_makes_voxels_no_larger_than_surfaces_need(step, fraction):
    """What large voxels kept of it beside surfaces forbade smaller ones, and so dense that it was no sparser than the
    surfaces it stayed as a whole: coverings of 0.81, 0.93, 0.17 and 0.17, with up to 111 objects for 25.
    """
    points, truth = twenty_boxes(step)
    noise = np.random.default_rng(9).uniform((0, 0, 0), (6.0, 5.0, 3.0), (int(fraction * len(points)), 3))
    before, result = pcgraph.segment(points), pcgraph.segment(np.concatenate((points, noise)))
    assert result.voxel_size == pytest.approx(before.voxel_size, rel=0.1)
    assert result.outliers[: len(points)].mean() < 0.001
    assert result.outliers[len(points) :].mean() > 0.75
    n_objects = len(np.unique(result.labels[: len(points)]))
    assert n_objects < len(np.unique(before.labels)) + 15
    covering = pcgraph.metrics.segmentation_covering(result.labels[: len(points)], truth)
    assert covering > pcgraph.metrics.segmentation_covering(before.labels, truth) - 0.035


@pytest.mark.parametrize(("high", "fills"), [(3.0, True), (1.5, False), (0.0, False)])
def test_what_is_sparse_in_a_part_of_the_box_is_no_noise_through_the_volume(high, fills):
    """As the crowns of trees are, or a plane."""
    rng = np.random.default_rng(0)
    floor, sparse = (
        rng.uniform((0, 0, 0), (6.0, 5.0, 0.0), (5000, 3)),
        rng.uniform((0, 0, 0), (6.0, 5.0, high), (2000, 3)),
    )
    top = [(0.0, 0.0, 3.0)] if high else []
    left = np.concatenate((floor, np.reshape(top, (-1, 3))))
    assert fill_the_volume(np.concatenate((left, sparse)), left) == fills


def test_surfaces_alone_have_no_outliers(clean):
    assert not clean[3].outliers.any()
    assert "outliers" not in repr(clean[3])


def test_few_points_are_never_outliers():
    points = np.random.default_rng(0).uniform(0, 1, (999, 3))
    assert not outlier_voxels(voxel_grid(points, 0.02, Warp())).any()


@pytest.mark.filterwarnings("ignore:expected points on surfaces")
def test_a_cloud_without_any_surface_is_not_all_outliers():
    points = np.random.default_rng(0).uniform(0, 1, (5000, 3))
    assert (pcgraph.segment(points).labels >= 0).mean() > 1 / 3


def plane(spacing, size=2.0, height=0.0):
    x, y = np.meshgrid(np.arange(0.5 * spacing, size, spacing), np.arange(0.5 * spacing, size, spacing))
    return np.stack((x, y, np.full_like(x, height)), axis=-1).reshape(-1, 3)


def test_a_coarse_scan_beside_a_fine_one_is_no_outlier():
    fine, coarse = plane(0.004, 0.6, 0.8), plane(0.06, 6.0)
    result = pcgraph.segment(np.concatenate((fine, coarse)))
    assert not result.outliers.any()
    assert result.labels.max() < 20


@pytest.mark.parametrize(("n", "gap", "is_object"), [(4, 0.5, False), (5, 0.5, True), (4, 0.1, True)])
def test_a_piece_of_few_points_away_from_all_else_is_no_object(n, gap, is_object):
    piece = np.array([[1.0, 1.0, 0.0]]) + np.outer(np.arange(n), [0.01, 0.01, 0.0]) + [0.0, 0.0, gap]
    result = pcgraph.segment(np.concatenate((plane(0.02), piece)), viewpoint=(1, 1, 9), voxel_size=0.07)
    assert not result.outliers[:-n].any()
    assert (result.labels[-n:] >= 0).tolist() == [is_object] * n


def test_a_scan_so_coarse_that_its_points_lie_apart_is_not_lost():
    fine, coarse = plane(0.004, 1.0, 0.8), plane(0.06, 3.0)
    result = pcgraph.segment(np.concatenate((fine, coarse)), voxel_size=0.014)
    assert result.outliers.mean() < 0.001
    assert result.objects.max() < 10  # nor is each of its points an object


def test_dust_alone_is_not_all_outliers():
    points = np.random.default_rng(0).uniform(0, 1, (2000, 3))
    assert not detached_voxels(voxel_grid(points, 1e-5, Warp())).any()


def test_a_grid_without_some_voxels_is_that_of_the_other_points():
    rng = np.random.default_rng(1)
    points, colors = rng.uniform(0, 1, (3000, 3)), rng.uniform(0, 1, (3000, 3))
    grid = with_means(voxel_grid(points, 0.11, Warp()), colors)
    gone = rng.random(grid.n_voxels) < 0.3
    left = ~gone[grid.voxel_of_point]
    thinned, expected = grid_without(grid, gone), with_means(voxel_grid(points[left], 0.11, Warp()), colors[left])
    for name in ("cells", "voxel_of_point", "order", "starts", "counts", "warped", "colors", "indptr", "neighbours"):
        assert np.array_equal(getattr(thinned, name), getattr(expected, name)), name


def test_files_keep_outliers(clean, tmp_path):
    points, _, viewpoint, _ = clean
    far = np.array([[3.0, 3.0, 9.0]])
    cloud = pcgraph.Cloud(np.concatenate((points, far)))
    result = pcgraph.segment(cloud, viewpoint=viewpoint)
    assert result.outliers[-1]
    assert result.labels[-1] == -1
    pcgraph.write_segmentation(tmp_path / "a.ply", cloud, result)
    read = pcgraph.read_cloud(tmp_path / "a.ply")
    assert len(read.points) == len(points) + 1
    assert read.columns["object"][-1] == -1


def test_an_update_keeps_single_points_beside_what_was_seen(clean):
    points, _, viewpoint, before = clean
    rng = np.random.default_rng(5)
    some = points[rng.permutation(len(points))[:1500]] + [0.0, 0.0, 1e-4]
    noise = rng.uniform(points.min(axis=0) + np.array((0.0, 0.0, 0.4)), points.max(axis=0) + 2.0, (60, 3))
    after = pcgraph.update(before, np.concatenate((some, noise)), viewpoint=viewpoint)
    assert not after.outliers[:1500].any()
    assert after.outliers[1500:].mean() > 0.8
