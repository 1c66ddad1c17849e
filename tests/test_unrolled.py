# SPDX-License-Identifier: Apache-2.0
"""Panoramas of scanners: the highest ring at the top, azimuth from left to right, strips that fit a page."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from rangesim.report.figures import Picture, unrolled
from rangesim.report.panorama import MAX_STRIP, panorama
from rangesim.rig import Spinning
from rangesim.rig.scan_patterns import spinning

VLP_16_DEG = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]


def pixels(picture: Picture) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.uri.partition(",")[2]))).convert("RGB"))


def test_rings_are_sorted_and_a_pillar_is_upright() -> None:
    """The beams fire in an odd order and lead the head by different angles; what stands upright looks upright."""
    head = Spinning(tuple(map(float, VLP_16_DEG)), 1440, azimuth_offsets_deg=tuple(np.resize([4.0, -2.0, 0.0], 16)))
    directions = head.pixel_rays().directions
    azimuth = np.degrees(np.arctan2(directions[..., 0], directions[..., 2]))
    elevation = np.degrees(-np.arcsin(directions[..., 1]))
    shown = panorama(head)
    seen = shown.pixel >= 0
    assert seen.mean() > 0.9
    columns = np.where(seen, shown.picture(azimuth, np.nan), np.nan)
    strip = columns[: (columns.shape[0] - 2) // 2]
    assert np.nanmax(np.nanmax(strip, axis=0) - np.nanmin(strip, axis=0)) < 1.0  # degrees within a column
    rows = np.where(seen, shown.picture(elevation, np.nan), np.nan)[: (columns.shape[0] - 2) // 2]
    assert (np.diff(np.nanmean(rows, axis=1)) <= 1e-6).all()  # from the highest down


@pytest.mark.parametrize("shape", [(64, 1024), (128, 2048), (16, 1808), (32, 512), (4, 36), (1, 100), (5, 1)])
def test_strips_fit_the_page(shape: tuple[int, int]) -> None:
    rays = spinning(np.radians(np.linspace(20, -20, shape[0])), shape[1], 0.1)
    height, width = pixels(unrolled(np.full(shape, 5.0), rays.directions)).shape[:2]
    assert width <= MAX_STRIP * height
    assert min(width, height) >= 1


def test_a_turn_without_readings_is_grey() -> None:
    rays = spinning([0.0, 0.1], 64, 0.1)
    picture = unrolled(np.full((2, 64), np.nan), rays.directions)
    assert len(np.unique(pixels(picture).reshape(-1, 3), axis=0)) == 1
    assert picture.caption.endswith("no reading.")
