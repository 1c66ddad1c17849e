# SPDX-License-Identifier: Apache-2.0
"""The picture of a scanner's turn: rings from the highest down, columns as directions, strips that fit a page."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from rangesim.report.figures import MAX_STRIP, Picture, unrolled
from rangesim.rig.scan_patterns import spinning

VLP_16_DEG = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]


def pixels(picture: Picture) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.uri.partition(",")[2]))).convert("RGB"))


def test_rings_are_sorted_and_a_pillar_is_upright() -> None:
    """The beams fire in an odd order and lead the head by different angles; what stands upright looks upright."""
    leads = np.radians(np.resize([4.0, -2.0, 0.0], 16))
    rays = spinning(np.radians(VLP_16_DEG), 720, 0.1, leads, first_azimuth_rad=-np.pi)
    azimuth = np.degrees(np.arctan2(rays.directions[..., 0], rays.directions[..., 2]))
    ranges = np.where(np.abs(azimuth - 20) < 5, 3.0, 10.0)
    ranges[np.argmax(VLP_16_DEG)] = 30.0
    image = pixels(unrolled(ranges, rays.directions)).astype(int)
    top = image[:4]
    assert (top == top[0, 0]).all()  # the highest ring alone is far
    body = image[4 : (image.shape[0] - 2) // 2] if image.shape[0] > 64 else image[4:]
    assert (np.ptp(body, axis=0) <= 0).all()  # all columns are of one colour


@pytest.mark.parametrize("shape", [(64, 1024), (128, 2048), (16, 1808), (32, 512), (4, 36), (1, 100), (5, 1)])
def test_strips_fit_the_page(shape: tuple[int, int]) -> None:
    rays = spinning(np.radians(np.linspace(20, -20, shape[0])), shape[1], 0.1)
    height, width = pixels(unrolled(np.full(shape, 5.0), rays.directions)).shape[:2]
    assert width <= MAX_STRIP * height
    assert width * height >= shape[0] * shape[1]


def test_a_turn_without_readings_is_grey() -> None:
    rays = spinning([0.0, 0.1], 64, 0.1)
    picture = unrolled(np.full((2, 64), np.nan), rays.directions)
    assert len(np.unique(pixels(picture).reshape(-1, 3), axis=0)) == 1
    assert picture.caption.endswith("no reading.")
