# SPDX-License-Identifier: Apache-2.0
"""Taps in another order, direction or frequency than stated: one sentence names the cause; right ones are quiet."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from synthetic import signals_of_depth, stereo_rig

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.electronics.spad import SpadDetector
from rangesim.errors import RangesimWarning
from rangesim.response import SPEED_OF_LIGHT, Correlation
from rangesim.sensors import AmcwDecoder, AmcwToF, DirectToF, DirectToFDecoder

SENSORS = [AmcwToF((20e6,)), AmcwToF(), AmcwToF((80e6, 16e6, 120e6), taps=3), AmcwToF((20e6, 60e6), taps=6)]


def capture_of(sensor: AmcwToF, noise: bool = True, seed: int = 0) -> Capture:
    """Raw taps of an unknown camera in a room: a slope from 0.7 to 3 m, of two albedos."""
    rig = stereo_rig(64, 48, baseline_m=0.0)
    z = np.tile(np.linspace(0.7, 3.0, 64), (48, 1))
    signals = signals_of_depth(rig, z, [sensor], ambient=0.01)
    taken = expose(signals, sensor, Detector.time_of_flight() if noise else None, seed=seed)
    return Capture(taken.frames << 4 if noise else taken.frames, sensor)  # 12 bits, as files of 16 have them


def warnings_of(capture: Capture, decoder: AmcwDecoder | None = None) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        decode(capture, decoder)
    assert all(issubclass(w.category, RangesimWarning) for w in caught)
    return [str(w.message) for w in caught]


def sorted_taps(capture: Capture, order: list[int], only: int | None = None) -> Capture:
    """The capture with the taps of each frequency, or of one of them, in another order."""
    sensor = capture.sensor
    assert isinstance(sensor, AmcwToF)
    groups = np.split(capture.frames, len(sensor.modulation_hz))
    return Capture(np.concatenate([g[order] if only in (None, i) else g for i, g in enumerate(groups)]), sensor)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: s.details)
@pytest.mark.parametrize("noise", [True, False])
def test_right_taps_are_quiet(sensor: AmcwToF, noise: bool) -> None:
    assert warnings_of(capture_of(sensor, noise)) == []


def test_a_stated_even_harmonic_is_no_wrong_order() -> None:
    """A single-tap pixel shows the second harmonic; a near and a far wall once counted as a lost frame."""
    shape = Correlation((0.1,))
    sensor = AmcwToF(50e6, taps_per_exposure=1, contrast=0.7, correlation=shape)
    phase = np.repeat([0.05, 0.26], 1000).reshape(40, 50)
    light = 0.02 / phase**2
    taps = np.stack([1 + light * (1 + 0.7 * shape.values(phase - k / 4)) for k in range(4)]).astype(np.float32)
    assert warnings_of(Capture(taps, sensor)) == []
    assert "lie on no cosine" in " ".join(warnings_of(Capture(taps[[0, 1, 3, 3]], sensor)))


@pytest.mark.parametrize("sensor", SENSORS[:2], ids=lambda s: s.details)
@pytest.mark.parametrize(
    ("order", "words"), [([0, 2, 1, 3], "taps 1 and 2 .* 3 and 4"), ([0, 1, 3, 2], "taps 1 and 4 .* 2 and 3")]
)
def test_taps_in_another_order_are_told(sensor: AmcwToF, order: list[int], words: str) -> None:
    with pytest.warns(RangesimWarning, match=f"{words}.*not in the order 0, 90, 180, 270 degrees"):
        decode(sorted_taps(capture_of(sensor), order))


def test_six_taps_in_another_order_are_told() -> None:
    with pytest.warns(RangesimWarning, match="lie on no cosine"):
        decode(sorted_taps(capture_of(SENSORS[3]), [0, 3, 1, 4, 2, 5]))


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: s.details)
def test_taps_that_run_the_other_way_are_told_by_the_light(sensor: AmcwToF) -> None:
    backwards = [0, *range(sensor.taps - 1, 0, -1)]
    with pytest.warns(RangesimWarning, match="brighter where the path is longer"):
        decode(sorted_taps(capture_of(sensor), backwards))


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ([1, 2, 3, 0], "90 degrees"),
        ([2, 3, 0, 1], "180 degrees"),
        ([2, 1, 0, 3], "180 degrees and run the other way"),
    ],
)
def test_taps_that_start_elsewhere_are_told_by_the_light(order: list[int], words: str) -> None:
    with pytest.warns(RangesimWarning, match=f"it does if the taps of each frequency start at {words}, so"):
        decode(sorted_taps(capture_of(SENSORS[0]), order))


@pytest.mark.parametrize("sensor", [SENSORS[0], AmcwToF((20e6,), taps=6)], ids=lambda s: s.details)
@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_lost_tap_is_told(sensor: AmcwToF, lost: int) -> None:
    """The frames move up, and the last one is taken a second time, with other noise."""
    first, second = capture_of(sensor), capture_of(sensor, seed=1)
    kept = [i for i in range(sensor.taps) if i != lost]
    with pytest.warns(RangesimWarning, match="lie on no cosine .* no frame is missing or there twice"):
        decode(Capture(np.concatenate([first.frames[kept], second.frames[-1:]]), sensor))


def test_a_frame_that_is_there_twice_is_told() -> None:
    taken = capture_of(SENSORS[2])
    frames = taken.frames.copy()
    frames[4] = frames[3]
    with pytest.warns(RangesimWarning, match="frames 16MHz_0deg and 16MHz_120deg are the same image"):
        decode(Capture(frames, taken.sensor))


def test_an_empty_frame_is_told() -> None:
    taken = capture_of(SENSORS[1])
    frames = taken.frames.copy()
    frames[5] = 0
    with pytest.warns(RangesimWarning, match="80MHz_90deg: the same number at every pixel"):
        decode(Capture(frames, taken.sensor))


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: s.details)
def test_signed_numbers_that_were_read_without_their_sign_are_told(sensor: AmcwToF) -> None:
    taken = capture_of(sensor)
    signed = (taken.frames.astype(np.int64) - int(np.median(taken.frames))) // 2  # so that they fit in 16 bits
    with pytest.warns(RangesimWarning, match="in two's complement.*give --bits with an s"):
        decode(Capture((signed % 65536).astype(np.uint16), sensor))


@pytest.mark.parametrize("fraction", [0.1, 0.5, 0.8])
def test_taps_that_clip_below_the_largest_number_are_refused(fraction: float) -> None:
    taken = capture_of(SENSORS[0])
    brightest = taken.frames.max(axis=0)
    level = int(np.percentile(brightest, 100 * (1 - fraction)))
    image = decode(Capture(np.minimum(taken.frames, level), taken.sensor))
    assert (image.status[brightest > level] == Status.SATURATED).all()
    assert not (decode(taken).status == Status.SATURATED).any()


@pytest.mark.parametrize("number", [0, 2])
def test_one_frequency_whose_taps_run_the_other_way_is_told(number: int) -> None:
    sensor = SENSORS[1]
    with pytest.warns(RangesimWarning, match=f"taps of {sensor.modulation_hz[number] / 1e6:g} MHz run the other way"):
        decode(sorted_taps(capture_of(sensor), [0, 3, 2, 1], only=number))


def test_frequencies_in_another_order_are_told() -> None:
    taken = capture_of(AmcwToF((100e6, 20e6, 80e6)))
    with pytest.warns(RangesimWarning, match="they agree if they are those of 100, 20, 80 MHz in this order"):
        decode(Capture(taken.frames, AmcwToF((20e6, 80e6, 100e6))))


def test_wrong_frequencies_are_told() -> None:
    taken = capture_of(AmcwToF((80e6, 16e6, 120e6)))
    with pytest.warns(RangesimWarning, match="agree on no path length.*: check modulation_hz"):
        decode(Capture(taken.frames, AmcwToF((70e6, 20e6, 110e6))))


def test_doubts_travel_with_the_range_image() -> None:
    taken = sorted_taps(capture_of(SENSORS[0]), [0, 2, 1, 3])
    with pytest.warns(RangesimWarning, match="not in the order"):
        image = decode(taken)
    assert len(image.doubts) == 1
    assert decode(capture_of(SENSORS[0])).doubts == ()


def test_what_no_frame_tells_is_stated() -> None:
    """A wall beyond the range of one frequency is read too near, with status OK."""
    assert AmcwDecoder().undetectable(AmcwToF((20e6,))) == (
        "surfaces beyond 7.495 m would be read too near by that or a multiple of it, and no frame tells"
    )
    assert str(DirectToFDecoder().undetectable(DirectToF())).startswith("surfaces beyond 3.837 m")
    assert DirectToFDecoder().undetectable(DirectToF(laser="single-shot")) is None


def test_noise_at_the_ends_of_the_range_is_refused() -> None:
    """Near the end of the range of one frequency, noise makes the farthest surface the nearest."""
    sensor, detector, rng = AmcwToF((20e6,)), Detector.time_of_flight(), np.random.default_rng(0)
    range_m = rng.uniform(0.05, 1.0, 20_000) * sensor.unambiguous_range_m
    phi = 2 * np.pi * 20e6 * 2 * range_m / SPEED_OF_LIGHT
    mean = np.stack([500 * (1 + 0.8 * np.cos(phi - k * np.pi / 2)) / 4 for k in range(4)])
    electrons = rng.poisson(mean) + detector.read_noise_e * rng.standard_normal(mean.shape)
    frames = np.clip(np.rint(electrons * detector.gain_dn_e + detector.offset_dn), 0, 4095).astype(np.uint16)
    image = decode(Capture(frames.reshape(4, 100, 200), sensor, None, detector, 1e-3))
    error = np.abs(image.range_m.ravel() - range_m)
    assert image.valid.mean() > 0.7
    assert (error[image.valid.ravel()] > 1.0).mean() < 1e-3


@pytest.mark.validation
@pytest.mark.parametrize("pulse_fwhm_s", [0.3e-9, 1e-9])
@pytest.mark.parametrize("dark_counts_hz", [1e4, 3e4, 1e5, 1e6])
def test_dark_histograms_keep_no_peak(pulse_fwhm_s: float, dark_counts_hz: float) -> None:
    """Before, 0.7 to 1.3 % of the pixels without any light had a reading at 0.1 counts a bin."""
    sensor = DirectToF(pulse_fwhm_s=pulse_fwhm_s)
    nothing = signals_of_depth(stereo_rig(160, 120), np.full((120, 160), np.nan), [sensor])
    detector = SpadDetector(dark_counts_hz=dark_counts_hz, bits=16)
    assert decode(expose(nothing, sensor, detector, exposure_s=1e-3)).valid.mean() < 1e-4
