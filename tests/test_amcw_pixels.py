# SPDX-License-Identifier: Apache-2.0
"""Pixels of modulated cameras: how taps share light, harmonics, fixed patterns, stray light and two paths,
against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_signals, signals_of_depth, stereo_rig

from rangesim import load_scene, transport
from rangesim.calibration.time_of_flight import triangle_harmonics, wiggling
from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.status import Status
from rangesim.decoding.two_paths import separate
from rangesim.electronics.detector import Detector
from rangesim.motion.timing import Timing
from rangesim.response import SPEED_OF_LIGHT, Correlation, Phasor
from rangesim.rig import Intrinsics
from rangesim.sensor import Sensor
from rangesim.sensors import AmcwDecoder, AmcwToF, DirectToF, StructuredLight

SCENES = Path(__file__).resolve().parent.parent / "scenes"
SHARING = [(3, 3), (4, 4), (4, 2), (4, 1), (6, 6), (6, 3), (6, 2), (8, 2), (5, 5)]
"""Number of taps, and of those that share an exposure."""


def frames_of(sensor: AmcwToF, turns: np.ndarray, light: float = 1.0) -> np.ndarray:
    """(k, 1, n) frames of one frequency at phases in turns, of light of one path without ambient light."""
    c = SPEED_OF_LIGHT / sensor.modulation_hz[0]
    channels = []
    for response in sensor.responses():
        assert isinstance(response, Phasor)
        phi = 2 * np.pi * turns * c * response.modulation_hz / SPEED_OF_LIGHT
        channels.append(light * np.stack([np.cos(phi), np.sin(phi)])[:, None].astype(np.float32))
    white = np.full((1, turns.size), light, dtype=np.float32)
    return sensor.frames(channels, white, np.zeros_like(white))


def test_the_default_camera_is_as_before() -> None:
    """Every new option is off."""
    sensor = AmcwToF()
    assert sensor.exposure_of_frames().tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert sensor.responses() == tuple(Phasor(f) for f in sensor.modulation_hz)
    assert sensor.tap_fraction == 1 / 4
    frames = np.ones((12, 2, 3), np.float32)
    assert sensor.at_pixels(frames) is frames


@pytest.mark.parametrize(("taps", "sharing"), SHARING)
@pytest.mark.parametrize("correlation", [None, Correlation((0.05, 0.08, 0.03, 0.02), (1.0, 0.4, 0.0, -0.7))])
def test_the_taps_of_an_exposure_divide_its_light(taps: int, sharing: int, correlation: Correlation | None) -> None:
    sensor = AmcwToF((50e6,), taps=taps, taps_per_exposure=sharing, correlation=correlation)
    frames = frames_of(sensor, np.linspace(0, 1, 50), light=2.0)
    exposure = sensor.exposure_of_frames()
    assert len(set(exposure.tolist())) == taps // sharing
    assert (frames >= 0).all()
    for one in set(exposure.tolist()):
        assert (exposure == one).sum() == sharing
        collected = frames[exposure == one].sum(axis=0)
        if sharing > 1:
            np.testing.assert_allclose(collected, 2.0, rtol=1e-5)
        else:  # the other half is drained
            assert collected.max() <= 2.0
            assert collected.mean() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(("taps", "sharing"), SHARING)
def test_the_noise_of_the_phase_is_that_of_the_light_of_all_exposures(taps: int, sharing: int) -> None:
    """sigma = sqrt(2 / (exposures A)) / contrast by shot noise alone, on average over the phase; a pixel that drains
    half of the light has sqrt(2) of it."""
    sensor = AmcwToF((50e6,), taps=taps, taps_per_exposure=sharing)
    turns, electrons = np.linspace(0, 1, 20_000, endpoint=False), 4000.0
    frames = frames_of(sensor, turns, electrons)
    drawn = np.random.default_rng(0).poisson(frames)
    off = phase_of(drawn).normalised[0] - turns
    sigma = 2 * np.pi * np.sqrt(np.mean((off - np.rint(off)) ** 2))
    collected = electrons * (taps / sharing) * (0.5 if sharing == 1 else 1.0)
    assert sigma == pytest.approx(np.sqrt(2 / collected) / sensor.contrast, rel=0.02)


def test_three_exposures_of_a_kinect_v2_have_the_noise_of_three_taps_of_one() -> None:
    """It takes 0, 120 and 240 degrees with two opposite taps each; these are six taps, 60 degrees apart."""
    device = AmcwToF((50e6,), taps=6, taps_per_exposure=2)
    preset = AmcwToF((50e6,), taps=3)
    turns = np.linspace(0, 1, 1000)
    six, three = frames_of(device, turns, 1000.0), frames_of(preset, turns, 3000.0)
    difference = np.stack([six[0] - six[3], six[2] - six[5], six[4] - six[1]])  # at 0, 120, 240 degrees
    np.testing.assert_allclose(difference, three - 1000.0, atol=0.01)
    # The variance is 1000 electrons for each difference; that of the taps is the same on average
    np.testing.assert_allclose([six[0] + six[3], six[2] + six[5], six[4] + six[1]], 1000.0, rtol=1e-5)
    assert three.mean(axis=0) == pytest.approx(1000.0)


def test_frames_of_different_exposures_are_taken_at_different_times() -> None:
    timing = Timing(frame_period_s=2e-3)
    two = AmcwToF((20e6, 80e6), taps_per_exposure=2)
    assert timing.exposure_of_frames(two).tolist() == [0, 1, 0, 1, 2, 3, 2, 3]
    np.testing.assert_allclose(timing.exposure_times_s(two), 2e-3 * np.arange(4))
    assert Timing(single_tap=True).exposure_of_frames(two).tolist() == list(range(8))
    assert timing.exposure_of_frames(AmcwToF((20e6,), taps_per_exposure=1)).tolist() == [0, 1, 2, 3]
    assert two.frame_names()[:4] == ["20MHz_0deg", "20MHz_90deg", "20MHz_180deg", "20MHz_270deg"]
    assert two.details == "20, 80 MHz, 4 taps in 2 exposures, sine wave"


@pytest.mark.parametrize("changes", [{"taps_per_exposure": 3}, {"taps": 5, "taps_per_exposure": 2}])
def test_taps_that_do_not_share_exposures_evenly_are_refused(changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="expected taps_per_exposure to divide"):
        AmcwToF(**changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("taps", [3, 4, 5])
def test_each_frequency_has_its_own_contrast(taps: int) -> None:
    sensor = AmcwToF((20e6, 80e6), taps=taps, contrasts=(0.9, 0.4))
    signals = plane_signals(stereo_rig(32, 24, baseline_m=0.0), sensor)
    lit = signals.energy.direct > 0
    for group, contrast in zip(np.split(signals.frames(sensor), 2), (0.9, 0.4), strict=True):
        phase = phase_of(group)
        np.testing.assert_allclose((phase.modulation / phase.mean)[lit], contrast, rtol=1e-4)
    assert np.nanmax(np.abs(decode(expose(signals, sensor)).z - signals.truth.z)) < 1e-4
    with pytest.raises(ValueError, match="expected contrasts of 2 frequencies"):
        AmcwToF((20e6, 80e6), contrasts=(0.9,))


@pytest.mark.parametrize("taps", [3, 4, 5, 8])
@pytest.mark.parametrize("phases", [(), (0.3, -1.0, 2.0, 0.5)])
def test_harmonics_make_the_phase_of_the_taps_wiggle_by_the_closed_form(taps: int, phases: tuple[float, ...]) -> None:
    amplitudes = (0.04, 0.1, 0.03, 0.05)
    sensor = AmcwToF((20e6,), taps=taps, correlation=Correlation(amplitudes, phases), contrast=0.7)
    assert sensor.correlation is not None
    turns = np.linspace(0, 1, 200, endpoint=False)
    frames = frames_of(sensor, turns)
    k, theta = np.arange(2, 6), np.arange(taps) / taps
    psi = np.array(phases or (0.0,) * 4)
    x = 2 * np.pi * (turns - theta[:, None])
    kept = np.where(k % taps, amplitudes, 0.0)  # of the others, every tap would have the same
    c = np.cos(x) + np.tensordot(kept, np.cos(k[:, None, None] * x + psi[:, None, None]), axes=1)
    np.testing.assert_allclose(frames[:, 0], (1 + 0.7 * c) / taps, atol=2e-6)
    read = phase_of(frames).normalised[0]
    off = read - sensor.correlation.read_by(taps, turns)
    np.testing.assert_allclose(off - np.rint(off), 0, atol=1e-6)
    if not phases:
        off = read - turns - wiggling(turns, (1.0, *amplitudes), taps)
        np.testing.assert_allclose(off - np.rint(off), 0, atol=1e-6)
    off = sensor.correlation.corrected(taps, read) - turns
    np.testing.assert_allclose(off - np.rint(off), 0, atol=2e-6)


def test_a_decoder_corrects_a_measured_correlation_or_shows_its_wiggling() -> None:
    triangle = Correlation(tuple(triangle_harmonics(15)[1:]))
    sensor = AmcwToF((20e6,), correlation=triangle)
    rig = stereo_rig(baseline_m=0.0)
    z = np.tile(np.linspace(0.3, 6, 160), (120, 1))
    capture = expose(signals_of_depth(rig, z, [sensor]), sensor)
    assert np.nanmax(np.abs(decode(capture).z - z)) < 1e-4
    raw = decode(capture, AmcwDecoder(correct_wiggling=False))
    wiggle = np.nanmax(np.abs(raw.z - z)) * 2 * 20e6 / SPEED_OF_LIGHT
    assert 0.009 < wiggle < 0.0125


def test_a_curve_that_was_measured_gives_its_harmonics() -> None:
    stated = Correlation((0.03, 0.11, 0.0, 0.04), (0.4, -0.8, 0.0, 1.5))
    curve = 300 + 120 * stated.values(np.arange(50) / 50 - 0.137)
    found = Correlation.measured(curve, harmonics=6)
    turns = np.linspace(0, 1, 40)
    np.testing.assert_allclose(found.values(turns), stated.values(turns), atol=1e-9)
    with pytest.raises(ValueError, match="expected a curve of more than 16 finite samples"):
        Correlation.measured(np.ones(16))
    with pytest.raises(ValueError, match="without a first harmonic"):
        Correlation.measured(np.ones(40))


def test_a_correlation_that_no_pixel_can_have_is_refused() -> None:
    with pytest.raises(ValueError, match="taps collect no negative light"):
        AmcwToF(correlation=Correlation((0.0, 0.4)), contrast=0.9)
    with pytest.raises(ValueError, match="grows with the path length"):
        AmcwToF(taps=3, correlation=Correlation((0.7,)), contrast=0.5)
    with pytest.raises(ValueError, match="expected a sine waveform with a correlation"):
        AmcwToF(waveform="square", correlation=Correlation())


@pytest.mark.parametrize("taps", [3, 4, 6])
def test_the_fixed_pattern_is_a_delay_of_each_pixel(taps: int) -> None:
    """delay c / 2 at all frequencies, the same in every capture, and nothing of the light is lost."""
    even = AmcwToF((20e6, 80e6, 100e6), taps=taps)
    sensor = replace(even, pixel_delay_s=100e-12, pixel_seed=7)
    signals = plane_signals(stereo_rig(64, 48, baseline_m=0.0), sensor, ambient=0.2)
    off = decode(expose(signals, sensor)).range_m - decode(expose(signals, even)).range_m
    assert np.nanstd(off) == pytest.approx(100e-12 * SPEED_OF_LIGHT / 2, rel=0.05)
    again = decode(expose(signals, sensor)).range_m
    np.testing.assert_array_equal(again, decode(expose(signals, sensor)).range_m)
    expected = 100e-12 * np.random.default_rng(7).standard_normal((48, 64)) * SPEED_OF_LIGHT / 2
    np.testing.assert_allclose(off, expected, atol=1e-5)
    light = [expose(signals, s).frames.sum(axis=0) for s in (sensor, even)]
    np.testing.assert_allclose(*light, rtol=1e-6)
    assert not np.array_equal(again, decode(expose(signals, replace(sensor, pixel_seed=8))).range_m)


@pytest.mark.parametrize("sensor", [AmcwToF((20e6, 80e6)), DirectToF(bins=64, bin_s=400e-12), StructuredLight(64, 48)])
def test_stray_light_spreads_the_mean_of_the_image_and_loses_no_light(sensor: Sensor) -> None:
    rig = stereo_rig(48, 36, baseline_m=0.02, projector=Intrinsics.from_fov(64, 48, 60))
    clean = signals_of_depth(rig, np.tile(np.linspace(0.5, 3.0, 48), (36, 1)), [sensor], ambient=0.01)
    veiled = replace(clean, rig=replace(rig, camera_lens=replace(rig.camera_lens, stray_light=0.1)))
    frames, seen = expose(clean, sensor).frames, expose(veiled, sensor).frames
    np.testing.assert_allclose(seen.mean(axis=(1, 2)), frames.mean(axis=(1, 2)), rtol=1e-5)
    np.testing.assert_allclose(seen, 0.9 * frames + 0.1 * frames.mean(axis=(1, 2), keepdims=True), rtol=1e-5)


def test_stray_light_adds_the_mean_phasor_of_the_image() -> None:
    sensor, rig = AmcwToF((20e6,)), stereo_rig(48, 36, baseline_m=0.0)
    clean = signals_of_depth(rig, np.tile(np.linspace(0.5, 3.0, 48), (36, 1)), [sensor])
    veiled = replace(clean, rig=replace(rig, camera_lens=replace(rig.camera_lens, stray_light=0.05)))
    x, y = next(iter(clean.channels.values()))
    z = (x + 1j * y).astype(np.complex128)
    turns = np.angle(0.95 * z + 0.05 * z.mean()) / (2 * np.pi) % 1
    seen = decode(expose(veiled, sensor)).range_m
    np.testing.assert_allclose(seen, turns * SPEED_OF_LIGHT / 40e6, atol=1e-4)
    assert np.nanmedian(np.abs(seen - clean.truth.range_m)) > 0.01
    with pytest.raises(ValueError, match="expected a projector_lens without stray_light"):
        replace(rig, projector_lens=replace(rig.projector_lens, stray_light=0.05))


PATHS = np.random.default_rng(3).uniform([0.02, 0.06, 0.05], [0.4, 0.45, 0.9], (500, 3))
"""Phase of the first path, the second path's distance from it, in turns, and its amplitude."""


def two_path_phasors(amplitude: np.ndarray | float = PATHS[:, 2]) -> list[np.ndarray]:
    first, second = np.exp(2j * np.pi * PATHS[:, 0]), np.exp(2j * np.pi * (PATHS[:, 0] + PATHS[:, 1]))
    return [(first**k + amplitude * second**k)[None] for k in (1, 2, 3)]


def test_two_paths_are_separated_exactly() -> None:
    found = separate(two_path_phasors(), None)
    assert found.found.all()
    off = found.turns[0] - PATHS[:, 0]
    np.testing.assert_allclose(off - np.rint(off), 0, atol=1e-9)


def test_light_of_one_path_keeps_its_reading() -> None:
    assert not separate(two_path_phasors(0.0), None).found.any()
    noise = np.full((1, len(PATHS)), 0.01)
    rng = np.random.default_rng(0)
    drawn = [
        m + 0.01 * (rng.standard_normal(m.shape) + 1j * rng.standard_normal(m.shape)) for m in two_path_phasors(0.0)
    ]
    assert separate(drawn, [noise] * 3).found.mean() < 0.01


def two_path_capture(detector: Detector | None, frequencies: tuple[float, ...], share: float = 0.25) -> Capture:
    """A wall at 1 m, and `share` of its light again by a detour of 0.8 m."""
    sensor, rig = AmcwToF(frequencies), stereo_rig(80, 60, baseline_m=0.0)
    wall = signals_of_depth(rig, np.full((60, 80), 1.0), [sensor])
    detour = signals_of_depth(rig, np.full((60, 80), 1.0), [sensor], delay_m=0.8)
    channels = {r: c + np.float32(share) * detour.channels[r] for r, c in wall.channels.items()}
    energy = replace(wall.energy, multipath=np.float32(share) * wall.energy.direct)
    capture = expose(replace(wall, channels=channels, energy=energy), sensor, detector, 2e-3 if detector else None)
    assert isinstance(capture, Capture)
    return capture


def test_a_second_path_is_taken_out_of_the_reading_and_its_noise_is_told() -> None:
    frequencies = (40e6, 120e6, 80e6)
    still = two_path_capture(None, frequencies)
    plain, corrected = decode(still), decode(still, AmcwDecoder(two_paths=True))
    assert abs(np.nanmedian(plain.z - 1.0)) > 0.01
    assert np.nanmax(np.abs(corrected.z - 1.0)) < 1e-4
    capture = two_path_capture(Detector.time_of_flight(), frequencies)
    seen = AmcwDecoder(two_paths=True).coordinates(capture)
    image = decode(capture, AmcwDecoder(two_paths=True))
    assert seen.sigma_m is not None
    pull = ((image.range_m - corrected.range_m) / (seen.sigma_m / 2))[image.valid]
    assert abs(np.median(pull)) < 0.2
    assert 0.8 < 1.4826 * np.median(np.abs(pull)) < 1.2


def test_two_paths_need_three_frequencies_of_small_ratios() -> None:
    with pytest.raises(ValueError, match="three frequencies f, 2 f and 3 f"):
        AmcwDecoder(two_paths=True).check(AmcwToF())
    with pytest.raises(ValueError, match="three frequencies f, 2 f and 3 f"):
        decode(two_path_capture(None, (20e6, 80e6)), AmcwDecoder(two_paths=True))


def test_pixels_of_little_light_are_refused_with_every_kind_of_pixel() -> None:
    detector = Detector.time_of_flight()
    for taps, sharing in SHARING:
        sensor = AmcwToF((20e6, 80e6), taps=taps, taps_per_exposure=sharing)
        signals = plane_signals(stereo_rig(32, 24, baseline_m=0.0), sensor)
        assert (decode(expose(signals, sensor, detector, 1e-8)).status == Status.LOW_SIGNAL).mean() > 0.95
        assert (decode(expose(signals, sensor, detector, 1.0)).status == Status.SATURATED).mean() > 0.9


@pytest.mark.validation
@pytest.mark.parametrize(
    ("frequencies", "exposure_s", "most"),
    [((20e6, 40e6, 60e6), None, 0.4), ((40e6, 80e6, 120e6), None, 0.5), ((40e6, 80e6, 120e6), 5e-3, 0.6)],
)
def test_two_paths_take_most_of_the_error_out_of_a_corner(
    frequencies: tuple[float, ...], exposure_s: float | None, most: float
) -> None:
    """The table of docs/decoding.md; in weak light the reading stays as it is."""
    scene, sensor = load_scene(SCENES / "corner.xml"), AmcwToF(frequencies)
    signals = transport(scene, scene.rig(baseline_m=0.03, width=160, height=120), [sensor], spp=64)
    errors = []
    for time_s in (exposure_s, 1e-4):
        capture = expose(signals, sensor, Detector.time_of_flight() if time_s else None, time_s)
        images = [decode(capture, AmcwDecoder(two_paths=two)) for two in (False, True)]
        errors.append([float(np.nanmedian(np.abs(i.range_m - signals.truth.range_m))) for i in images])
    (plain, corrected), weak = errors
    assert plain > 0.02
    assert corrected < most * plain
    assert weak[1] == pytest.approx(weak[0], rel=0.05)
