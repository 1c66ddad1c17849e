# SPDX-License-Identifier: Apache-2.0
"""What `pcgraph.segment` promises for every cloud."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from checks import SEEDS, assert_covered_and_connected, refines, same_partition
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.surfaces import DEGENERATE, SPACING, patch
from scenes.tables import two_boxes_on_a_plane

import pcgraph


def test_every_point_is_covered_and_every_supervoxel_connected(boxes):
    points, _, result = boxes
    assert_covered_and_connected(points, result)


def test_two_boxes_on_a_plane_are_three_objects(boxes):
    _, truth, result = boxes
    assert result.labels.max() + 1 == 3
    assert pcgraph.metrics.weighted_overlap(result.labels, truth) > 0.93
    assert pcgraph.metrics.undersegmentation_error(result.supervoxels, truth) < 0.05  # a box is 9 voxels wide


def test_same_input_same_result(boxes):
    points, _, first = boxes
    second = pcgraph.segment(points, viewpoint=first.viewpoint)
    assert np.array_equal(first.supervoxels, second.supervoxels)
    assert np.array_equal(first.labels, second.labels)
    assert np.array_equal(first.tree.altitudes, second.tree.altitudes)


def test_order_of_points_does_not_matter(boxes):
    points, _, first = boxes
    order = np.random.default_rng(5).permutation(len(points))
    second = pcgraph.segment(points[order], viewpoint=first.viewpoint)
    assert second.voxel_size == first.voxel_size
    assert np.array_equal(first.supervoxels[order], second.supervoxels)
    assert same_partition(first.labels[order], second.labels)
    assert np.array_equal(first.tree.parents, second.tree.parents)


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e9])
def test_any_unit_works(unit):
    points, truth, viewpoint = two_boxes_on_a_plane()
    result = pcgraph.segment(points * unit, viewpoint=np.array(viewpoint) * unit)
    assert pcgraph.metrics.weighted_overlap(result.labels, truth) > 0.93


def test_far_outliers_and_far_origins_do_no_harm():
    points, truth, viewpoint = two_boxes_on_a_plane()
    far = np.array([[1e12, -1e14, 1e13], [5e6, 4e6, 3e6]])
    result = pcgraph.segment(np.vstack([points, far]), viewpoint=viewpoint)
    assert_covered_and_connected(np.vstack([points, far]), result)
    assert pcgraph.metrics.weighted_overlap(result.labels[:-2], truth) > 0.93
    shift = np.array([5e5, 5.2e6, 300.0])
    shifted = pcgraph.segment(points + shift, viewpoint=viewpoint + shift)
    assert pcgraph.metrics.weighted_overlap(shifted.labels, truth) > 0.93


def test_organised_clouds_keep_their_shape_and_nan():
    rows, columns = np.mgrid[0:60, 0:80]
    depth = np.where((abs(rows - 30) < 12) & (abs(columns - 40) < 15), 0.8, 1.0)
    points = np.stack(((columns - 40) / 80 * depth, (rows - 30) / 80 * depth, depth), axis=-1)
    points[5:8, 10:20] = np.nan
    points[0, 0, 1] = np.inf
    result = pcgraph.segment(points.astype(np.float32))
    assert result.camera
    assert_covered_and_connected(points.astype(np.float32), result)
    assert result.labels[30, 40] != result.labels[2, 40]
    assert result.cut(n=2).shape == (60, 80)
    assert np.array_equal(result.cut(n=2) < 0, result.labels < 0)


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_clouds_work(name):
    points = DEGENERATE[name]
    result = pcgraph.segment(points)
    assert_covered_and_connected(points, result)
    features = result.tree.features()
    assert np.allclose(np.linalg.norm(features.normal, axis=1), 1.0)
    for n in {1, result.graph.n_nodes}:
        assert result.cut(n=n).max() + 1 == n
    assert not np.isnan(result.tree.altitudes).any()


def test_flat_square_is_one_object():
    assert pcgraph.segment(DEGENERATE["a flat square"]).labels.max() == 0


@settings(max_examples=25, deadline=None)
@given(
    seed=SEEDS,
    n=st.integers(1, 120),
    levels=st.integers(1, 12),
    holes=st.booleans(),
    voxel=st.sampled_from([None, 0.05, 1.0, 7.0]),
)
def test_any_cloud_is_covered_connected_and_nested(seed, n, levels, holes, voxel):
    rng = np.random.default_rng(seed)
    points = rng.integers(0, levels, (n, 3)) * 0.1
    if holes:
        points[rng.random(n) < 0.3] = np.nan
        points[0] = 0.0
    result = pcgraph.segment(points, rng.random((n, 3)), voxel_size=voxel)
    assert_covered_and_connected(points, result)
    cuts = [result.cut(n=k) for k in range(1, result.graph.n_nodes + 1)]
    assert all(refines(fine, coarse) for coarse, fine in pairwise(cuts))


def test_seed_size_sets_the_number_of_supervoxels():
    points = patch((0, 0, 1), (1, 0, 0), (0, 1, 0))
    counts = [pcgraph.segment(points, voxel_size=2 * SPACING, seed_size=size).graph.n_nodes for size in (0.1, 0.2)]
    assert 60 <= counts[0] <= 140
    assert 16 <= counts[1] <= 40
