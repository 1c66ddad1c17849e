# SPDX-License-Identifier: Apache-2.0
"""Laws of reading pixels without the others: the same readings, from the same frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

from rangesim import AmcwToF, Capture, DirectToF, IdealToF, Sensor, StructuredLight, decode, expose
from rangesim.causes.reference_frames import footprint_frames, frames_of_pixels, single_path_frames
from rangesim.codes import Code, GrayCode
from rangesim.decoding.path_length import PathLengths
from rangesim.rig import Rig
from rangesim.sensor import Decoder, pixel_reader_of
from rangesim.sensors.amcw import AmcwDecoder
from rangesim.settings.config import has_defaults

KINDS = {name: kind for name, kind in Code.known.items() if has_defaults(kind) and kind.is_by_pixel}
CODED = {
    name: StructuredLight(code=kind())
    for name, kind in KINDS.items()
    if kind.__module__.startswith("rangesim.")  # other tests make codes of their own
}
TIMED: dict[str, Sensor] = {
    "amcw": AmcwToF(),
    "histogram": DirectToF(bins=128, bin_s=200e-12, pulse_fwhm_s=400e-12),
    "ideal": IdealToF(),
}


def some_pixels(rig: Rig) -> np.ndarray:
    return np.random.default_rng(5).random((rig.camera.height, rig.camera.width)) < 0.1


@pytest.mark.parametrize("sensor", [*CODED.values(), *TIMED.values()], ids=[*CODED, *TIMED])
def test_some_pixels_are_read_as_in_the_whole_image(sensor: Sensor) -> None:
    rig = stereo_rig()
    signals, some = plane_signals(rig, sensor), some_pixels(rig)
    reader, frames = sensor.default_decoder.pixel_reader(sensor), expose(signals, sensor).frames
    assert reader is not None
    alone = reader(Capture(frames[:, some][:, None], sensor)).spread(some).range_image(rig)
    whole = decode(Capture(frames, sensor, rig))
    assert whole.valid[some].any()
    assert alone.z[some].tobytes() == whole.z[some].tobytes()
    np.testing.assert_array_equal(alone.status[some], whole.status[some])
    assert not alone.valid[~some].any()


@pytest.mark.parametrize("sensor", [CODED["gray-phase"], *TIMED.values()], ids=["gray-phase", *TIMED])
def test_a_reader_differs_from_the_decoder_only_in_its_silence(sensor: Sensor) -> None:
    """A capture whose frames are in another order is doubted by the decoder, and read to the same bytes."""
    rig = stereo_rig()
    capture = expose(plane_signals(rig, sensor), sensor, sensor.default_detector, 1e-3, seed=2)
    capture = replace(capture, frames=capture.frames[::-1])
    reader = sensor.default_decoder.pixel_reader(sensor)
    assert reader is not None
    silent = reader(capture).range_image(rig)
    assert not silent.doubts
    if isinstance(sensor, (StructuredLight, AmcwToF)):
        with pytest.warns(match="."):
            loud = decode(capture)
        assert loud.doubts
    else:
        loud = decode(capture)
    assert silent.z.tobytes() == loud.z.tobytes()


@pytest.mark.parametrize("sensor", [StructuredLight(projector_gamma=2.2), StructuredLight(code="de-bruijn")])
def test_what_the_image_around_tells_is_not_read_by_pixel(sensor: Sensor) -> None:
    assert sensor.default_decoder.pixel_reader(sensor) is None


@pytest.mark.parametrize("sensor", [CODED["gray-phase"], *TIMED.values()], ids=["gray-phase", *TIMED])
def test_straight_light_of_some_pixels_is_that_of_the_whole_image(sensor: Sensor) -> None:
    rig = stereo_rig()
    truth, some = plane_signals(rig, sensor).truth, some_pixels(rig)
    alone = frames_of_pixels(sensor, rig, truth, some)[:, 0]
    assert alone.tobytes() == single_path_frames(sensor, rig, truth)[:, some].tobytes()
    spread = frames_of_pixels(sensor, rig, truth, some, is_spread=True)[:, 0]
    whole = footprint_frames(sensor, rig, truth, some)
    assert spread.tobytes() == whole[:, some].tobytes()
    assert whole[:, ~some].tobytes() == single_path_frames(sensor, rig, truth)[:, ~some].tobytes()


def test_a_subclass_that_reads_otherwise_does_not_inherit_the_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    for family in (Sensor, Decoder, Code):
        monkeypatch.setattr(family, "known", dict(family.known))  # the classes of this test leave with it

    class OtherFrames(AmcwToF):
        type_name = "amcw-of-a-test"

        def frames(self, channels: Any, white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
            return super().frames(channels, white, ambient)

    class OtherReadings(AmcwDecoder):
        type_name = "amcw-decoder-of-a-test"

        def coordinates(self, capture: Capture) -> PathLengths:
            return super().coordinates(capture)

    class OtherCode(GrayCode):
        type_name = "gray-of-a-test"

        def decode(self, seen: Any, thresholds: Any) -> Any:
            return super().decode(seen, thresholds)

    assert pixel_reader_of(AmcwDecoder(), AmcwToF()) is not None
    assert pixel_reader_of(AmcwDecoder(), OtherFrames()) is None
    assert pixel_reader_of(OtherReadings(), AmcwToF()) is None
    coded = StructuredLight(code=OtherCode())
    assert pixel_reader_of(coded.default_decoder, coded) is None
