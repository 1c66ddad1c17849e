# SPDX-License-Identifier: Apache-2.0
"""Neighbours of pixels: windows of images as ever, nearest rays of scanners, whatever the order of their rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from rangesim.decoding.range_image import RangeImage
from rangesim.evaluation.comparison import compare
from rangesim.evaluation.depth_edges import across, depth_edges
from rangesim.evaluation.neighbourhood import IMAGE, RayNeighbourhood, neighbourhood
from rangesim.rig import Camera, Intrinsics, Risley, Spinning
from rangesim.signals import GroundTruth

OUSTER = Spinning(
    tuple(np.linspace(16.6, -16.6, 64).round(2).tolist()), 1024, azimuth_offsets_deg=(3.164, 1.055, -1.055, -3.164) * 16
)
VLP_16 = Spinning((-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15), 900)
ROSETTE = Risley(20, 500, (9.0, 9.0), (121.6, -77.8), 0.1)


def test_windows_of_images_are_those_of_filters() -> None:
    z = np.random.default_rng(0).uniform(1, 2, (20, 30))
    z[3:5, 7:9] = np.nan
    depth = np.where(np.isfinite(z), z, np.inf)
    near, far = minimum_filter(depth, 3, mode="nearest"), maximum_filter(depth, 3, mode="nearest")
    expected = (depth > across(near, 0.01)) | (far > across(depth, 0.01))
    np.testing.assert_array_equal(depth_edges(z, 0.01), expected)
    rows, columns = IMAGE.around(np.ones(z.shape, dtype=bool), 2)
    for number, shifted in enumerate(IMAGE.shifted(z, 2)):
        np.testing.assert_array_equal(shifted.ravel(), z[rows[:, number], columns[:, number]])
    assert neighbourhood(None) is neighbourhood(Intrinsics.from_fov(8, 6, 60.0)) is IMAGE


@pytest.mark.parametrize("camera", [OUSTER, VLP_16, ROSETTE], ids=["staggered", "firing order", "rosette"])
def test_neighbours_of_scanners_look_beside(camera: Camera) -> None:
    directions = camera.pixel_rays().directions
    pixels = neighbourhood(camera)
    assert isinstance(pixels, RayNeighbourhood)
    rows, columns = pixels.around(np.ones(directions.shape[:2], dtype=bool), 1)
    apart = np.linalg.norm(directions[rows, columns] - directions.reshape(-1, 1, 3), axis=-1)
    assert np.degrees(apart.max()) < 0.8
    assert ((apart > 0).sum(axis=1) >= 1).mean() > 0.99
    np.testing.assert_array_equal(
        np.stack(pixels.shifted(camera.times_s, 1), axis=-1).reshape(len(rows), -1), camera.times_s[rows, columns]
    )


@pytest.mark.parametrize("camera", [OUSTER, VLP_16], ids=["staggered", "firing order"])
def test_a_post_before_a_wall_has_edges_only_beside_it(camera: Spinning) -> None:
    directions = camera.pixel_rays().directions
    azimuth = np.degrees(np.arctan2(directions[..., 0], directions[..., 2]))
    ranges = np.where(np.abs(azimuth) < 5, 4.0, 8.0)
    edges = depth_edges(ranges, 0.01, neighbourhood(camera))
    off = np.abs(np.abs(azimuth) - 5)
    assert off[edges].max() < 0.9
    assert edges[off < 0.1].all()
    table = depth_edges(ranges, 0.01)  # of the table's rows: neighbours by place alone
    assert (off[table].max() < 0.9) == (camera is VLP_16)


def test_a_comparison_of_a_scanner_takes_its_neighbours() -> None:
    directions = OUSTER.pixel_rays().directions
    azimuth = np.degrees(np.arctan2(directions[..., 0], directions[..., 2]))
    true_m = np.where(np.abs(azimuth) < 5, 4.0, 8.0).astype(np.float32)
    between = np.abs(np.abs(azimuth) - 5) < 0.15
    measured = np.where(between, 6.0, true_m).astype(np.float32)
    status, one = np.zeros(true_m.shape, dtype=np.uint8), np.ones_like(true_m)
    image = RangeImage(measured, measured, one, status, one, OUSTER, np.eye(4))
    first, vectors = np.zeros(true_m.shape, dtype=np.int32), np.zeros((*true_m.shape, 3), dtype=np.float32)
    lit = np.ones(true_m.shape, dtype=bool)
    truth = GroundTruth(true_m, true_m, vectors, first, first, vectors[..., :2], lit, ("wall",), ("matte",))
    comparison = compare(image, truth)
    np.testing.assert_array_equal(comparison.flying, between)
    assert comparison.row("all").edge_pixels < 10 * between.sum()
