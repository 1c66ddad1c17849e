# SPDX-License-Identifier: Apache-2.0
"""Real Kinect clouds with true labels, at the default settings."""

from __future__ import annotations

import numpy as np
from checks import assert_covered_and_connected

import pcgraph


def test_real_clouds_fall_into_objects(real_clouds):
    overlaps, errors = [], []
    for path in real_clouds[::3]:
        cloud = pcgraph.read_cloud(path)
        assert cloud.points.shape == (480, 640, 3)
        result = pcgraph.segment(cloud.points, cloud.colors)
        assert_covered_and_connected(cloud.points, result)
        truth = np.where(cloud.labels > 0, cloud.labels // 10, -1)  # parts of the table are 1..9
        overlaps.append(pcgraph.metrics.weighted_overlap(result.labels, truth))
        errors.append(pcgraph.metrics.undersegmentation_error(result.supervoxels, truth))
    assert np.mean(overlaps) > 0.97, overlaps
    assert np.mean(errors) < 0.008, errors


def test_shuffled_real_cloud_gives_the_same_supervoxels(real_clouds):
    cloud = pcgraph.read_cloud(real_clouds[6])
    finite = np.isfinite(cloud.points).all(axis=-1)
    points, colors = cloud.points[finite], cloud.colors[finite]
    order = np.random.default_rng(0).permutation(len(points))
    first = pcgraph.segment(points, colors, camera=True)
    second = pcgraph.segment(points[order], colors[order], camera=True)
    assert np.array_equal(first.supervoxels[order], second.supervoxels)
    assert np.array_equal(first.tree.parents, second.tree.parents)
    assert np.array_equal(first.labels[order], second.labels) or (
        pcgraph.metrics.weighted_overlap(first.labels[order], second.labels) == 1.0
    )
    organised = pcgraph.segment(cloud.points, cloud.colors)
    left = ~organised.outliers[finite]  # the image tells which pixels mix two depths
    assert left.mean() > 0.999
    of_list = pcgraph.segment(points[left], colors[left], camera=True)
    assert np.array_equal(organised.supervoxels[finite][left], of_list.supervoxels)
