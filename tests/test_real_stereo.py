# SPDX-License-Identifier: Apache-2.0
"""A real pair of infra-red images with dots (848 x 480, a box, a book and a bottle on a carpet), decoded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiers import to_validate

from rangesim import ActiveStereo, Capture, CaptureSet, Intrinsics, Rig
from rangesim.decoding.disparities import Disparities
from rangesim.files.image_files import read_stack
from rangesim.geometry import DenseMatching, match_rows
from rangesim.rig import translation
from rangesim.sensors import StereoDecoder

CAMERA = Intrinsics(848, 480, 427.12, 427.12, 426.93 + 0.5, 234.78 + 0.5)
"""As simsense states it; OpenCV's pixel centres lie at integers."""
CARPET = slice(380, 470), slice(330, 830)
"""Rows and columns in which only the carpet is seen."""
BOX, BOOK = (310, 250), (320, 490)
"""Row and column of a pixel of the front of the box, and of one of the book."""


@pytest.fixture(scope="module")
def images(real_data: Path) -> np.ndarray:
    folder = real_data / "simsense"
    if not folder.is_dir():
        pytest.skip(f"no real pair at {folder}")
    return read_stack([folder / "left1.png", folder / "right1.png"])


def decoded(images: np.ndarray, matching: DenseMatching) -> Disparities:
    sensor = ActiveStereo(baseline_m=0.05)
    rig = Rig(CAMERA, Intrinsics.from_fov(640, 400, 90.0), T_camera_projector=translation(0.025, 0, 0))
    captures = [Capture(frame[None], sensor, one) for frame, one in zip(images, sensor.rigs(rig), strict=True)]
    return StereoDecoder(matching).coordinates(CaptureSet(tuple(captures)))


@pytest.mark.parametrize("method", ["census", *to_validate("zncc")])
@pytest.mark.validation
def test_the_carpet_is_a_plane_and_things_stand_on_it(images: np.ndarray, method: Any) -> None:
    found = decoded(images, DenseMatching(method))
    assert found.valid.mean() > 0.8
    y, x = np.mgrid[CARPET]
    known = found.valid[CARPET]
    assert known.mean() > 0.97
    d = found.disparity_px[CARPET][known].astype(np.float64)
    A = np.stack([x[known], y[known], np.ones(known.sum())], axis=1)
    plane = np.linalg.lstsq(A, d, rcond=None)[0]
    assert np.sqrt(np.mean((d - A @ plane) ** 2)) < 0.25  # wool is not flat: at 0.4 m, 0.2 px are 1.5 mm
    for row, column in (BOX, BOOK):
        around = found.disparity_px[row - 4 : row + 5, column - 4 : column + 5]
        above = np.nanmedian(around) - plane @ [column, row, 1]
        assert above > 1.0  # nearer than the carpet behind it


@pytest.mark.validation
def test_opencv_finds_the_same_disparities(images: np.ndarray) -> None:
    """Where both read, 99 % agree within a pixel; OpenCV's own are in steps of 1/16 pixel that lock to whole ones."""
    found = decoded(images, DenseMatching())
    other = match_rows(*images.astype(float), (0, 128), 9)
    both = np.isfinite(other) & found.valid
    apart = np.abs(found.disparity_px - other)[both]
    assert both.mean() > 0.75
    assert np.mean(apart < 1) > 0.99
    assert np.median(apart) < 0.15
