# SPDX-License-Identifier: Apache-2.0
"""Warnings about clouds that cannot be right; silence about those that can (warnings are errors in all other tests)."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.tables import two_boxes_on_a_plane

import pcgraph
from pcgraph import CloudWarning

POINTS, _, VIEWPOINT = two_boxes_on_a_plane()


@pytest.fixture(scope="module")
def one():
    """The segmentation of one scan, of which a box seen from one side alone says little about its outside."""
    return pcgraph.segment(POINTS, viewpoint=VIEWPOINT)


def test_float32_far_from_the_origin_is_noticed():
    far = (POINTS + np.array([4.5e5, 5.4e6, 300.0])).astype(np.float32)  # as of a map projection
    with pytest.warns(CloudWarning, match="float32 comes in steps of 0.5 m"):
        pcgraph.segment(far, voxel_size=1.0)
    pcgraph.segment(POINTS.astype(np.float32))
    pcgraph.segment(POINTS + np.array([4.5e5, 5.4e6, 300.0]))


@pytest.mark.parametrize("apart", [1e-9, 1e-5])
def test_a_dozen_copies_of_a_scan_are_one_scan(one, apart):
    rng = np.random.default_rng(0)
    copies = np.concatenate([POINTS + rng.normal(0.0, apart, POINTS.shape) for _ in range(12)])
    many = pcgraph.segment(copies, viewpoint=VIEWPOINT)
    assert one.voxel_size / 4 < many.voxel_size < one.voxel_size * 2
    assert many.labels.max() == one.labels.max()


def test_a_spacing_of_nearly_nothing_is_noticed():
    rng = np.random.default_rng(0)
    line = np.cumsum(rng.uniform(0.5, 1.5, 4000))[:, None] * [1e-9, 0, 0]
    with pytest.warns(CloudWarning, match="most have another within .* as copies of a scan do"):
        pcgraph.segment(np.concatenate((line, [[0.0, 0.0, 1.0]] * 3, line[-9:] + 0.5)))


@pytest.mark.parametrize("apart", [1e-6, 3e-5])
def test_two_scans_laid_on_each_other_have_the_spacing_of_one(one, apart):
    twice = np.concatenate((POINTS, POINTS + np.random.default_rng(0).normal(0.0, apart, POINTS.shape)))
    two = pcgraph.segment(twice, viewpoint=VIEWPOINT)
    assert one.voxel_size / 4 < two.voxel_size < one.voxel_size * 2
    assert two.labels.max() == one.labels.max()


def test_more_objects_than_there_can_be_are_noticed():
    dust = np.random.default_rng(1).uniform(0.0, 1.0, (900, 3))
    with pytest.warns(CloudWarning, match="expected far fewer objects than supervoxels"):
        pcgraph.segment(dust, voxel_size=0.002)


def test_a_viewpoint_that_sees_nothing_is_noticed():
    for call in (pcgraph.segment, pcgraph.supervoxel_clustering):
        with pytest.warns(CloudWarning, match="expected a viewpoint that sees the cloud") as warned:
            call(POINTS, viewpoint=(0.8, 0.6, -1e-3))  # just under the plane
        assert warned[0].filename == __file__  # the line of the caller
    pcgraph.segment(POINTS, viewpoint=VIEWPOINT)


@pytest.mark.parametrize("place", [(0.0, 0.0, 1e10), (-1e10, 0.0, 3e9), (1e8, 2e8, 1e8)])
def test_a_viewpoint_is_never_too_far_off(place):
    random = np.random.default_rng(0)
    pcgraph.segment(np.c_[random.uniform(0.0, 100.0, (20_000, 2)), 0.02 * random.normal(size=20_000)], viewpoint=place)


def test_noise_alone_is_warned_of():
    noise = np.random.default_rng(0).random((20000, 3))
    with pytest.warns(CloudWarning, match="expected points on surfaces, but they fill a volume"):
        pcgraph.segment(noise)


def test_what_cannot_be_right_of_a_further_scan_is_noticed(one):
    """`update` said nothing of what `segment` warns of."""
    with pytest.warns(CloudWarning, match="expected a viewpoint that sees the cloud"):
        pcgraph.update(one, POINTS, viewpoint=(0.8, 0.6, -1e-3))
    far = (POINTS + np.array((5e5, 5e6, 0.0))).astype(np.float32)
    with pytest.warns(CloudWarning, match="comes in steps of"):
        pcgraph.update(one, far, viewpoint=VIEWPOINT)


@pytest.mark.parametrize("name", ["voxel_size", "seed_size"])
def test_lengths_in_another_unit_are_noticed(name):
    """Millimetres in place of metres made one voxel of a cloud, and one object, without a word."""
    extent = np.ptp(POINTS, axis=0).max()
    for length in (1.001 * extent, 20.0 * extent):
        with pytest.warns(
            CloudWarning, match=f"expected a {name} far below the extent of the cloud, got .* unit of the"
        ):
            pcgraph.segment(POINTS, viewpoint=VIEWPOINT, **{name: length})
    pcgraph.segment(POINTS, viewpoint=VIEWPOINT, **{name: 0.9 * extent})
    pcgraph.segment(POINTS[:50], **{name: 20.0 * extent})
