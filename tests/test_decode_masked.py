# SPDX-License-Identifier: Apache-2.0
"""Pixels that one frame of radiance holds as NaN or infinity measure nothing; all others are as without them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

from rangesim import save_range_image
from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.codes import GrayPhase
from rangesim.decoding import decode
from rangesim.decoding.status import Status
from rangesim.files.image_files import write_grey
from rangesim.results.captures import import_capture
from rangesim.results.range_images import load_range_image
from rangesim.sensor import Sensor
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, StructuredLight

SENSORS = [
    StructuredLight(code="gray", axes=("columns", "rows")),
    StructuredLight(code="gray"),
    StructuredLight(code=GrayPhase(11.0, 5)),
    AmcwToF(),
    DirectToF(),
    IdealToF(),
]
MASK = np.s_[10:30, 20:50]


def capture_of(sensor: Sensor) -> Capture:
    return expose(plane_signals(stereo_rig(64, 48), sensor), sensor)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: s.type_name)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_pixel_that_one_frame_masks_has_too_little_light(sensor: Sensor, value: float) -> None:
    capture = capture_of(sensor)
    whole = decode(capture)
    outside = np.ones(whole.z.shape, dtype=bool)
    outside[MASK] = False
    for k in range(0, len(capture.frames), max(1, len(capture.frames) // 8)):
        frames = capture.frames.copy()
        frames[(k, *MASK)] = value
        image = decode(replace(capture, frames=frames))
        assert (image.status[MASK] == Status.LOW_SIGNAL).all()
        assert np.isnan(image.z[MASK]).all()
        np.testing.assert_array_equal(image.status[outside], whole.status[outside])
        assert np.isclose(image.z[outside], whole.z[outside], rtol=1e-6, equal_nan=True).all()


def test_the_range_image_of_frames_with_infinity_can_be_loaded(tmp_path: Path) -> None:
    sensor = StructuredLight(64, 48, code="gray", axes=("columns",))
    patterns = 0.1 + sensor.patterns()
    patterns[3, MASK[0], MASK[1]] = np.inf
    (tmp_path / "images").mkdir()
    for i, frame in enumerate(patterns):
        write_grey(tmp_path / "images" / f"{i}.exr", frame)
    image = decode(import_capture(tmp_path / "images", sensor))
    save_range_image(image, tmp_path / "range.npz")
    loaded = load_range_image(tmp_path / "range.npz")
    assert (loaded.status[MASK] == Status.LOW_SIGNAL).all()
    assert (loaded.status != Status.OK).sum() == 20 * 30
