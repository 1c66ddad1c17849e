# SPDX-License-Identifier: Apache-2.0
"""Path lengths come back exactly without noise, and with the noise that theory gives them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.stats import norm
from synthetic import plane_depth, plane_signals, signals_of_depth, stereo_rig

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.decoding.centroid_error import PulseCounts, centroid_error
from rangesim.decoding.histogram import coates, find_peak, window_reach
from rangesim.decoding.matched_filter import gaussian_filter
from rangesim.decoding.path_length import range_from_path_length
from rangesim.decoding.phase_shift import tap_phase
from rangesim.decoding.status import Status
from rangesim.decoding.working_range import WorkingRange
from rangesim.electronics.detector import Detector
from rangesim.electronics.spad import SpadDetector
from rangesim.instrument.instrument import Instrument
from rangesim.response import SPEED_OF_LIGHT, LightPath, NumpyMath, TransientHistogram
from rangesim.rig import Intrinsics, Rig, translation
from rangesim.sensors import AmcwDecoder, AmcwToF, DirectToF, DirectToFDecoder, IdealToF
from rangesim.signals import Signals


@given(st.floats(0.1, 10), st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.floats(-0.5, 0.5))
def test_range_from_path_length_inverts_the_ellipsoid(range_m: float, b: list[float], slope: float) -> None:
    rig = dataclasses.replace(stereo_rig(), T_camera_projector=translation(*b))
    direction = np.array([slope, 0.1, 1.0])
    point = range_m * direction / np.linalg.norm(direction)
    length = range_m + np.linalg.norm(point - b)
    found = range_from_path_length(np.array([length]), direction[None], rig)[0]
    if length - np.linalg.norm(b) > 1e-3:  # else the emitter lies on the ray: every point between has this length
        assert abs(found - range_m) < 1e-6


def test_ideal_range_is_exact_for_an_emitter_at_any_pose() -> None:
    for baseline in (0.0, 0.05, 0.5):
        rig, sensor = stereo_rig(baseline_m=baseline), IdealToF()
        signals = plane_signals(rig, sensor)
        image = decode(expose(signals, sensor, Detector()))
        lit = signals.truth.projector_visible
        assert (image.valid == lit).all()
        assert (image.status[~lit] == Status.LOW_SIGNAL).all()
        np.testing.assert_allclose(image.z[lit], signals.truth.z[lit], atol=2e-6)
        np.testing.assert_allclose(image.range_m[lit], signals.truth.range_m[lit], atol=2e-6)


def test_confidence_of_ideal_range_is_radiance_over_the_bright_ones() -> None:
    radiance = np.linspace(0.01, 1, 1000, dtype=np.float32).reshape(20, 50)
    for length_m in (0.1, 40.0):
        image = decode(Capture(np.stack([radiance, length_m * radiance]), IdealToF()))
        np.testing.assert_allclose(image.confidence, np.clip(radiance / 0.99, 0, 1), rtol=1e-3)


@pytest.mark.parametrize("waveform", ["sine", "square"])
@pytest.mark.parametrize("frequencies", [(20e6,), (20e6, 80e6, 100e6), (80e6, 16e6, 120e6)])
def test_amcw_is_exact_without_noise(waveform: str, frequencies: tuple[float, ...]) -> None:
    rig = stereo_rig(baseline_m=0.02)
    sensor = AmcwToF(frequencies, waveform=waveform)  # type: ignore[arg-type]
    for distance in (0.5, 1.0, 5.0):
        signals = plane_signals(rig, sensor, distance_m=distance, ambient=0.01)
        image = decode(expose(signals, sensor))
        lit = signals.truth.projector_visible
        assert (image.valid[lit]).all()
        assert np.nanmax(np.abs(image.z - signals.truth.z)) < 5e-5


@pytest.mark.parametrize("waveform", ["sine", "square"])
@pytest.mark.parametrize("frequencies", [(20e6,), (20e6, 80e6, 100e6)])
@pytest.mark.parametrize("ambient", [0.0, 0.3])
def test_the_taps_of_a_frequency_share_the_light_of_one_exposure(
    waveform: str, frequencies: tuple[float, ...], ambient: float
) -> None:
    """They add up to what came in, and the phase has the noise of so many electrons: sqrt(2 / N) / contrast."""
    rig = stereo_rig(baseline_m=0.02)
    sensor = AmcwToF(frequencies, waveform=waveform)  # type: ignore[arg-type]
    signals = plane_signals(rig, sensor, ambient=ambient)
    lit = signals.truth.projector_visible
    for taps in np.split(signals.frames(sensor), len(frequencies)):
        np.testing.assert_allclose(taps.sum(axis=0)[lit] / (signals.energy.direct[lit] + ambient), 1, rtol=1e-5)
        if ambient == 0.0 and waveform == "sine":
            electrons = 1000 * taps[:, lit] / signals.energy.direct[lit]  # as many reach each pixel
            drawn = np.random.default_rng(0).poisson(electrons).astype(np.float32)
            off = 2 * np.pi * (tap_phase(drawn[:, None]).normalised - tap_phase(electrons[:, None]).normalised)
            off = (off + np.pi) % (2 * np.pi) - np.pi
            assert off.std() == pytest.approx(np.sqrt(2 / 1000) / sensor.contrast, rel=0.03)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.05, 18.7), st.sampled_from([(80e6, 16e6, 120e6), (24e6, 56e6)]))
def test_amcw_unwraps_up_to_the_common_range(range_m: float, frequencies: tuple[float, ...]) -> None:
    sensor = AmcwToF(frequencies)
    phases = np.array([2 * np.pi * f * 2 * range_m / SPEED_OF_LIGHT for f in frequencies])
    taps = [100 + 40 * np.cos(p - k * np.pi / 2) for p in phases for k in range(4)]
    image = decode(Capture(np.array(taps, dtype=np.float32).reshape(-1, 1, 1), sensor))
    assert sensor.unambiguous_range_m > 18.7
    assert abs(image.range_m[0, 0] - range_m) < 1e-4


@pytest.mark.parametrize("taps", [3, 5])
def test_another_number_of_taps_is_exact_without_noise_and_has_the_noise_of_theory(taps: int) -> None:
    """sigma_phi^2 = (2 / (N B))^2 sum of sin^2(phi - theta_k) (n_k + sigma_r^2), n_k the electrons of tap k."""
    rig, sensor = stereo_rig(baseline_m=0.0), AmcwToF((50e6,), taps=taps)
    detector = Detector.time_of_flight()
    signals = plane_signals(rig, sensor, ambient=0.05)
    z = plane_depth(rig)
    lit = signals.truth.projector_visible
    assert len(sensor.frame_names()) == taps
    np.testing.assert_allclose(signals.frames(sensor).sum(axis=0)[lit], (signals.energy.direct + 0.05)[lit], rtol=1e-5)
    assert np.nanmax(np.abs(decode(expose(signals, sensor)).z - z)) < 1e-5
    capture = expose(signals, sensor, detector, exposure_s=1e-3)
    image = decode(capture)
    electrons = detector.mean_electrons(signals.frames(sensor, 0.03), None, rig, 1e-3) + detector.own_noise_e2(0.0)
    modulation = 0.8 / taps * detector.electron_rate_per_radiance(rig) * 1e-3 * signals.energy.direct
    phase = 4 * np.pi * 50e6 / SPEED_OF_LIGHT * signals.truth.range_m
    across = np.sin(phase - 2 * np.pi * np.arange(taps)[:, None, None] / taps) ** 2
    sigma = 2 / (taps * modulation) * np.sqrt((across * electrons).sum(axis=0)) * SPEED_OF_LIGHT / (4 * np.pi * 50e6)
    pull = ((image.range_m - signals.truth.range_m) / sigma)[lit & image.valid]
    assert pull.std() == pytest.approx(1, rel=0.02)


def test_a_square_wave_needs_four_taps() -> None:
    with pytest.raises(ValueError, match="expected 4 taps for a square waveform, got 3"):
        AmcwToF(waveform="square", taps=3)


def test_readings_outside_the_working_range_of_a_device_are_refused() -> None:
    rig, sensor = stereo_rig(baseline_m=0.0), AmcwToF((20e6,))
    z = np.tile(np.linspace(0.3, 6, 160), (120, 1))
    capture = expose(signals_of_depth(rig, z, [sensor]), sensor)
    free = decode(capture)
    for along, reading in (("z", free.z), ("ray", free.range_m)):
        image = decode(capture, AmcwDecoder(working_range=WorkingRange(0.5, 4.5, along)))  # type: ignore[arg-type]
        inside = (reading >= 0.5) & (reading <= 4.5)
        np.testing.assert_array_equal(image.valid, inside)
        assert (image.status[~inside & free.valid] == Status.OUT_OF_RANGE).all()
        np.testing.assert_array_equal(image.z[inside], free.z[inside])
    with pytest.raises(ValueError, match="near_m < far_m"):
        WorkingRange(2.0, 1.0)


def test_phases_that_agree_on_nothing_are_wrapped() -> None:
    sensor = AmcwToF((80e6, 100e6))
    turns = np.linspace(0, 1, 50, endpoint=False)
    taps = [[100 + 40 * np.cos(2 * np.pi * t - k * np.pi / 2) for t in turns] for k in range(4)]
    other = [[100 + 40 * np.cos(1.0 - k * np.pi / 2) for _ in turns] for k in range(4)]
    frames = np.array([*taps, *other], dtype=np.float32)[:, None, :]
    status = decode(Capture(frames, sensor)).status
    assert set(np.unique(status)) <= {Status.OK, Status.UNWRAPPING_FAILED}
    three = AmcwToF((20e6, 80e6, 100e6))
    frames = np.concatenate([frames[4:], np.roll(frames[:4], 7, axis=2), frames[:4]])
    assert (decode(Capture(frames, three)).status == Status.UNWRAPPING_FAILED).mean() > 0.3


def test_square_waves_wiggle_unless_corrected() -> None:
    rig, sensor = stereo_rig(baseline_m=0.0), AmcwToF((20e6,), waveform="square")
    z = np.tile(np.linspace(0.3, 6, 160), (120, 1))
    capture = expose(signals_of_depth(rig, z, [sensor]), sensor)
    raw = decode(capture, AmcwDecoder(correct_wiggling=False))
    wiggle = np.nanmax(np.abs(raw.z - z)) * 2 * 20e6 / SPEED_OF_LIGHT
    assert 0.008 < wiggle < 0.0125  # turns; largest |atan2 - triangle| is 0.0113
    assert np.nanmax(np.abs(decode(capture).z - z)) < 1e-4


@pytest.mark.parametrize("seed", [0, 1])
def test_noise_of_amcw_is_that_of_theory(seed: int) -> None:
    """sigma_d = c / (4 pi f) sqrt((A + sigma_r^2) / 2) / B in electrons: A mean and B modulation of the taps."""
    rig, sensor = stereo_rig(baseline_m=0.0), AmcwToF((50e6,))
    detector = Detector.time_of_flight()
    signals = plane_signals(rig, sensor, ambient=0.05)
    capture = expose(signals, sensor, detector, seed=seed)
    image = decode(capture)
    taps = detector.mean_electrons(
        signals.frames(sensor, detector.ambient_transmission), sensor.gate, rig, capture.exposure_s
    )
    phase = tap_phase(taps)
    variance = phase.mean + detector.read_noise_e**2 + 1 / 12 / detector.gain_dn_e**2
    sigma = SPEED_OF_LIGHT / (4 * np.pi * 50e6) * np.sqrt(variance / 2) / phase.modulation
    inside = image.valid
    assert inside.mean() > 0.9
    normalised = (image.range_m - signals.truth.range_m)[inside] / sigma[inside]
    assert abs(normalised.std() - 1) < 0.1
    assert abs(normalised.mean()) < 0.05


def test_several_frequencies_weigh_in_by_their_precision() -> None:
    rig, sensor = stereo_rig(baseline_m=0.0), AmcwToF((20e6, 80e6, 100e6))
    signals = plane_signals(rig, sensor)
    detector = Detector.time_of_flight()
    error = {}
    for frequencies in ((20e6,), (20e6, 80e6, 100e6)):
        one = AmcwToF(frequencies)
        capture = expose(signals, one, detector, exposure_s=2e-4) if frequencies == (20e6,) else None
        capture = capture or expose(signals, sensor, detector, exposure_s=2e-4)
        image = decode(capture)
        error[frequencies] = np.nanstd((image.z - signals.truth.z)[image.valid])
    expected = 20 / np.sqrt(20**2 + 80**2 + 100**2)
    ratio = error[(20e6, 80e6, 100e6)] / error[(20e6,)]
    assert abs(ratio / expected - 1) < 0.1


def test_dark_and_saturated_taps_say_so() -> None:
    rig, sensor = stereo_rig(baseline_m=0.0), AmcwToF()
    signals = plane_signals(rig, sensor)
    detector = Detector.time_of_flight()
    assert (decode(expose(signals, sensor, detector, 1e-7)).status == Status.LOW_SIGNAL).mean() > 0.95
    assert (decode(expose(signals, sensor, detector, 1.0)).status == Status.SATURATED).mean() > 0.9


def histogram_sensor(**changes: Any) -> DirectToF:
    return DirectToF(**({"bins": 200, "bin_s": 100e-12, "start_s": 3e-9, "pulse_fwhm_s": 0.0} | changes))


@pytest.mark.parametrize("fwhm", [0.0, 300e-12])
def test_histogram_finds_the_bin(fwhm: float) -> None:
    rig, sensor = stereo_rig(baseline_m=0.0), histogram_sensor(pulse_fwhm_s=fwhm)
    signals = plane_signals(rig, sensor, ambient=0.02)
    image = decode(expose(signals, sensor))
    lit = signals.truth.projector_visible
    assert image.valid[lit].all()
    half_bin = sensor.bin_s * SPEED_OF_LIGHT / 4
    assert np.nanmax(np.abs(image.range_m - signals.truth.range_m)) <= half_bin + 1e-4


def test_photon_noise_of_the_centroid_is_that_of_theory() -> None:
    """Without background the centroid of N photons has sigma_t / sqrt(N); the window of two sigma keeps 95 %."""
    sensor = histogram_sensor(pulse_fwhm_s=500e-12)
    rig = Rig(stereo_rig().camera, stereo_rig().projector)
    z = plane_depth(rig, normal=(0.0, 0.0, -1.0))
    signals = signals_of_depth(rig, z, [sensor])
    detector = SpadDetector(dark_counts_hz=0.0, bits=16)
    capture = expose(signals, sensor, detector, exposure_s=2e-5)
    still = decode(expose(signals, sensor))
    image = decode(capture)
    photons = capture.frames.sum(axis=0)
    inside = image.valid & (photons > 50)
    assert inside.mean() > 0.8
    sigma = 500e-12 / np.sqrt(8 * np.log(2)) * SPEED_OF_LIGHT / 2 / np.sqrt(photons)
    normalised = ((image.range_m - still.range_m) / sigma)[inside]
    assert abs(normalised.std() - 1) < 0.15


def test_coates_undoes_pile_up() -> None:
    sensor = histogram_sensor(bins=64)
    rig = stereo_rig(64, 48, baseline_m=0.0)
    signals = plane_signals(rig, sensor, distance_m=0.7, ambient=0.5)
    detector = SpadDetector(pile_up=True, bits=16, ambient_transmission=1.0, quantum_efficiency=0.6)
    exposure = 2e-4
    capture = expose(signals, sensor, detector, exposure_s=exposure)
    radiance = signals.frames(sensor, detector.ambient_fraction(sensor.gate))
    mean = detector.mean_electrons(radiance, sensor.gate, rig, exposure)
    pulses = detector.pulses(sensor.gate, exposure)
    assert capture.frames.sum(axis=0).max() <= pulses
    restored = coates(capture.frames.astype(np.float64), pulses)
    assert abs(restored.sum() / mean.sum() - 1) < 0.01
    assert capture.frames.sum() < 0.99 * mean.sum()


@pytest.mark.parametrize(("mode", "scipys"), [("wrap", "wrap"), ("edge", "nearest"), ("constant", "constant")])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_filter_of_histograms_is_scipys(mode: Any, scipys: str, dtype: type) -> None:
    """Also of histograms shorter than the filter."""
    for bins, columns, sigma_bins in ((256, 300, 4.25), (5, 3, 4.25), (80, 128, 0.7)):
        histograms = np.random.default_rng(0).random((bins, columns)).astype(dtype)
        expected = gaussian_filter1d(histograms, sigma_bins, axis=0, mode=scipys)
        found = gaussian_filter(histograms, sigma_bins, mode)
        assert found.dtype == dtype
        np.testing.assert_allclose(found, expected, rtol=4 * np.finfo(dtype).eps)


def test_a_peak_is_where_brute_force_finds_it() -> None:
    """A Gaussian pulse on an even background: its place to a fifth of a bin, its window's sum, the background."""
    bins, sigma_bins = 64, 2.0
    places = np.linspace(0, bins, 41)
    away = (np.arange(bins)[:, None] + 0.5 - places + bins / 2) % bins - bins / 2
    histograms = 3.0 + 1000 * np.exp(-0.5 * (away / sigma_bins) ** 2) / (sigma_bins * np.sqrt(2 * np.pi))
    place, height, background = find_peak(histograms, sigma_bins, is_cyclic=True)
    width = 2 * window_reach(bins, sigma_bins, True) + 1
    assert np.abs((place - places + bins / 2) % bins - bins / 2).max() < 0.2
    window = np.stack([np.roll(np.arange(bins), -int(p)) for p in np.floor(place)], axis=1)
    reach = width // 2
    inside = np.take_along_axis(histograms, np.concatenate([window[-reach:], window[: reach + 1]]), axis=0).sum(axis=0)
    np.testing.assert_allclose(height + background, inside, rtol=1e-12)
    np.testing.assert_allclose(background / width, 3.0, rtol=0.2)


def drawn_histograms(counts: PulseCounts, bins: int, sigma_bins: float, drawn: int) -> np.ndarray:
    """(bins, drawn) counts of a Gaussian pulse on an even background, with the noise of photons, without pile-up."""
    rng, edges = np.random.default_rng(3), np.arange(bins + 1)
    means = counts.pulse * np.diff(norm.cdf((edges - counts.place) / sigma_bins)) + counts.background
    if np.isinf(counts.trials):
        return rng.poisson(means[:, None], (bins, drawn)).astype(np.float64)
    met = 1 - np.exp(-np.cumsum(means) / counts.trials)  # fraction of the pulses that have met a photon
    firsts = rng.multinomial(int(counts.trials), np.append(np.diff(met, prepend=0.0), 1 - met[-1]), drawn)
    return coates(np.ascontiguousarray(firsts.T[:-1]), int(counts.trials))


@pytest.mark.parametrize("within_bin", [0.0, 0.25, 0.5])
@pytest.mark.parametrize(
    ("pulse", "background", "trials", "sigma_bins"),
    [
        (30, 0.0, np.inf, 4.25),
        (300, 1.0, np.inf, 4.25),
        (1000, 0.0, np.inf, 4.25),
        (10000, 0.0, np.inf, 4.25),
        (1000, 1.0, 1500, 4.25),
        (300, 0.0, np.inf, 1.5),
    ],
)
def test_the_error_of_a_peak_is_that_of_drawn_histograms(
    pulse: float, background: float, trials: float, sigma_bins: float, within_bin: float
) -> None:
    """Whole bins, background and pile-up included; a pulse in the middle of its bin is read best."""
    bins, place = 64, 30 + within_bin
    counts = PulseCounts(np.array(place), np.array(float(pulse)), np.array(background), trials)
    found, _, _ = find_peak(drawn_histograms(counts, bins, sigma_bins, 20_000), sigma_bins, is_cyclic=True)
    error = float(centroid_error(counts, bins, sigma_bins, is_cyclic=True))
    assert np.sqrt(np.mean((found - place) ** 2)) == pytest.approx(error, rel=0.02)  # four standard errors


@pytest.mark.parametrize("bins", [3, 5, 6])
def test_the_error_of_a_peak_is_finite_where_its_window_holds_all_bins(bins: int) -> None:
    counts = PulseCounts(np.array([bins / 2, 1.0]), np.array([500.0, 0.0]), np.zeros(2))
    lit, dark = centroid_error(counts, bins, sigma_bins=bins / 5, is_cyclic=True)
    assert 0 < lit < 1
    assert np.isnan(dark)


# ---- A laser that fires again and again -------------------------------------------------------------


def walls_at(range_m: np.ndarray, sensor: DirectToF, **settings: float) -> Signals:
    """A wall per pixel, (1, n) of them; camera and lamp are in one place, so the path length is twice the range."""
    rig = Rig(Intrinsics.from_fov(len(range_m), 1, 1e-3), Intrinsics.from_fov(1280, 800, 60), **settings)  # type: ignore[arg-type]
    return signals_of_depth(rig, range_m[None], [sensor])


GATED = {"start_s": 10e-9}


@pytest.mark.parametrize("changes", [{}, {"pulse_fwhm_s": 0.0}, GATED], ids=["pulse", "no pulse", "gate"])
def test_what_lies_beyond_the_range_is_a_ghost_at_the_remainder(changes: dict[str, float]) -> None:
    """From 0.5 to 4.2 ranges: the range found is the true one modulo c / 2 times the period."""
    sensor = DirectToF(**changes)  # type: ignore[arg-type]
    period_m, start_m = (seconds * SPEED_OF_LIGHT / 2 for seconds in (sensor.period_s, sensor.start_s))
    true = np.linspace(0.5, 4.2, 3701) * period_m
    expected = true % period_m
    image = decode(expose(walls_at(true, sensor), sensor))
    error = (image.range_m[0] - expected + period_m / 2) % period_m - period_m / 2
    margin = 3 * sensor.pulse_fwhm_s * SPEED_OF_LIGHT / 2 if start_m else 0.0  # a pulse that a gate cuts off is off
    seen = (expected > start_m + margin) & (expected < period_m - margin)
    lost = (expected > margin) & (expected < start_m - margin)
    most_m = 2e-3 if sensor.pulse_fwhm_s else sensor.bin_s * SPEED_OF_LIGHT / 4 + 1e-4
    assert image.valid[0][seen].mean() > 0.999  # at a range of 0 nothing is known
    assert np.nanmax(np.abs(error[seen])) <= most_m
    assert not image.valid[0][lost].any()
    assert lost.any() == bool(start_m)


@pytest.mark.parametrize(
    "changes",
    [
        GATED,
        {"start_s": 7e-9, "bins": 96, "bin_s": 300e-12, "pulse_fwhm_s": 0.9e-9},
        {"laser": "single-shot", "pulse_fwhm_s": 3e-9},
        {"laser": "single-shot", "start_s": 3e-9, "bins": 40, "bin_s": 1e-9, "pulse_fwhm_s": 5e-9},
    ],
)
def test_a_pulse_that_the_end_of_the_histogram_cuts_off_is_read_at_its_place(changes: dict[str, Any]) -> None:
    """From half a bin after the start to half a bin before the end; its centroid alone is off by 24 to 166 mm there."""
    sensor = DirectToF(**changes)
    start_m, period_m = (seconds * SPEED_OF_LIGHT / 2 for seconds in (sensor.start_s, sensor.period_s))
    half_m = sensor.bin_s * SPEED_OF_LIGHT / 4
    true = np.linspace(start_m + half_m, period_m - half_m, 997)
    image = decode(expose(walls_at(true, sensor), sensor))
    assert image.valid.all()
    np.testing.assert_allclose(image.range_m[0], true, atol=2e-3 + 0.015 * sensor.pulse_fwhm_s * SPEED_OF_LIGHT)


@pytest.mark.parametrize("sigma_bins", [1.5, 2.0, 9.0])
def test_a_peak_whose_middle_is_outside_is_placed_outside(sigma_bins: float) -> None:
    """Gaussian pulses from 1.5 sigmas before the first bin to as far behind the last; 1e5 counts on background."""
    bins = 80
    places = np.linspace(-1.5 * sigma_bins, bins + 1.5 * sigma_bins, 301)
    below = norm.cdf((np.arange(bins + 1)[:, None] - places) / sigma_bins)
    place, _, _ = find_peak(3.0 + 1e5 * np.diff(below, axis=0), sigma_bins)
    inside = (places >= 0) & (places <= bins)
    np.testing.assert_allclose(place[inside], places[inside], atol=0.1 + 0.05 * sigma_bins)
    assert (place[places < -0.3 * sigma_bins] < 0).all()
    assert (place[places > bins + 0.3 * sigma_bins] > bins).all()


@pytest.mark.parametrize("z", [0.15, 3.7])
def test_noise_near_the_end_of_the_histogram_has_no_bias(z: float) -> None:
    sensor = DirectToF(laser="single-shot", pulse_fwhm_s=2e-9)
    signals = walls_at(np.full(2000, z), sensor, projector_power_w=1e6)
    detector = SpadDetector(bits=16, pile_up=False, dark_counts_hz=0.0)
    photons = detector.mean_electrons(signals.frames(sensor), sensor.gate, signals.rig, 1.0).sum(axis=0).max()
    image = decode(expose(signals, sensor, detector, 2000 / photons))
    assert image.valid.mean() > 0.99
    errors = image.range_m[image.valid].astype(float) - z
    assert abs(errors.mean()) < 4 * errors.std() / np.sqrt(errors.size) + 1e-3


def test_what_a_single_shot_leaves_behind_is_lost() -> None:
    for laser, found in (("periodic", 0.2), ("single-shot", np.nan)):
        sensor = DirectToF(laser=laser)  # type: ignore[arg-type]
        most_m = sensor.period_s * SPEED_OF_LIGHT / 2
        image = decode(expose(walls_at(np.array([0.7, 1.2]) * most_m, sensor), sensor))
        np.testing.assert_allclose(image.range_m[0] / most_m, [0.7, found], atol=1e-3)


@given(st.floats(0, 400), st.integers(1, 300), st.floats(1e-3, 0.5), st.floats(0, 3), st.floats(0, 3))
def test_lengths_are_binned_modulo_the_period(
    length_m: float, bins: int, width_m: float, start_m: float, gap_m: float
) -> None:
    """Every length has a bin where the bins fill the period; exactly on an edge, that on either side."""
    response = TransientHistogram(start_m, width_m, bins, bins * width_m + gap_m)
    path = LightPath(*(np.array([x]) for x in (0.0, 0.0, length_m)), np.array([True]))
    found = response.bin(path, NumpyMath())[0]
    places = [(length_m - start_m + d) % (bins * width_m + gap_m) for d in (-1e-6, 1e-6)]
    assert found in [min(int(place // width_m), bins) for place in places]
    assert found < bins or gap_m > 0


def test_the_ghost_piles_up_before_what_it_comes_before() -> None:
    """A pixel sees walls at 1.2 and 0.5 ranges. In each period the first photon counts, be it the ghost's."""
    sensor = DirectToF(pulse_fwhm_s=0.0)
    most_m = sensor.period_s * SPEED_OF_LIGHT / 2
    ghost, near = walls_at(np.full(2000, 1.2 * most_m), sensor), walls_at(np.full(2000, 0.5 * most_m), sensor)
    (response,) = sensor.responses()
    detector, exposure_s, photons = SpadDetector(dark_counts_hz=0.0, bits=16), 2e-4, np.array([0.7, 0.4])  # a period
    pulses = detector.pulses(sensor.gate, exposure_s)
    channel = 0
    for signals, n in zip((ghost, near), photons, strict=True):
        brought = detector.mean_electrons(signals.frames(sensor), sensor.gate, ghost.rig, exposure_s).sum(axis=0)
        channel = channel + signals.channels[response] * (n * pulses / brought)
    capture = expose(dataclasses.replace(ghost, channels={response: channel}), sensor, detector, exposure_s)
    bins = np.flatnonzero(capture.frames.any(axis=(1, 2)))
    assert bins.tolist() == [51, 128]
    expected = -np.expm1(-photons) * [1, np.exp(-photons[0])] * pulses
    counts = capture.frames[bins, 0].mean(axis=1)
    np.testing.assert_allclose(counts, expected, atol=5 * np.sqrt(expected.max() / 2000))
    restored = coates(capture.frames.astype(float), pulses)[bins, 0].mean(axis=1)
    np.testing.assert_allclose(restored, photons * pulses, rtol=0.01)


def variance_of_coates(photons: np.ndarray, pulses: int, place: np.ndarray, reach: int) -> np.ndarray:
    """(n,) bins squared, of the centroid within the window around `place`. photons : (k, n) per bin and pulse."""
    b = np.arange(len(photons))[:, None]
    inside = np.abs(b - np.floor(place)) <= reach
    bin_variance = np.expm1(photons) * np.exp(np.cumsum(photons, axis=0) - photons) / pulses  # fraction / (pulses left)
    total = (photons * inside).sum(axis=0)
    return np.asarray((inside * (b + 0.5 - place) ** 2 * bin_variance).sum(axis=0) / total**2)


@pytest.mark.parametrize("exposure_s", [1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("wall_m", [0.2, 2.0, 3.0])
@pytest.mark.parametrize("pulse_fwhm_s", [1e-9, 0.3e-9])
def test_with_any_light_a_reading_is_within_its_noise_or_refused(
    exposure_s: float, wall_m: float, pulse_fwhm_s: float
) -> None:
    """From 0.3 to 1000 photons a pulse. The noise is the closed form for Coates' estimate of a bin in a fixed window.

    The window follows the counts, which makes 1.2 to 1.6 of it with a long pulse; the few that keep pulses by luck are
    biased, within the noise.
    """
    sensor = DirectToF(pulse_fwhm_s=pulse_fwhm_s)
    signals = walls_at(np.linspace(wall_m, wall_m + 0.05, 1000), sensor)
    (response,) = sensor.responses()
    detector, still = SpadDetector(dark_counts_hz=0.0, bits=16), decode(expose(signals, sensor)).range_m[0]
    pulses, bin_m = detector.pulses(sensor.gate, exposure_s), sensor.bin_s * SPEED_OF_LIGHT / 2
    brought = detector.mean_electrons(signals.frames(sensor), sensor.gate, signals.rig, exposure_s)[:, 0]
    reach = window_reach(sensor.bins, sensor.sigma_bins, sensor.is_cyclic)
    shares = []
    for photons in (0.3, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 9.0, 11.0, 33.0, 123.0, 330.0, 1000.0):
        factor = photons * pulses / brought.sum(axis=0)
        capture = expose(
            dataclasses.replace(signals, channels={response: signals.channels[response] * factor}),
            sensor,
            detector,
            exposure_s=exposure_s,
        )
        image = decode(capture)
        ok, error = image.valid[0], image.range_m[0] - still
        assert (ok | (image.status[0] == Status.SATURATED)).all()
        shares.append(ok.mean())
        left = pulses * np.exp(-photons)
        assert ok.all() or left < 40
        assert not ok.any() or left > 1
        if ok.any():
            variance = variance_of_coates(brought * factor / pulses, pulses, still / bin_m, reach)
            normalised = error[ok] / (bin_m * np.sqrt(variance[ok]))
            assert np.sqrt(np.mean(normalised**2)) < (2 if ok.mean() > 0.99 else 3)
            assert np.abs(normalised).max() < 10
            if ok.mean() > 0.99:
                bias_m = 0.02 * pulse_fwhm_s * SPEED_OF_LIGHT / 2
                assert abs(error[ok].mean()) < bias_m + 4 * error[ok].std() / np.sqrt(ok.sum())
    assert shares[0] == 1
    assert shares[-1] == 0


@given(st.floats(0, 400), st.integers(2, 300), st.floats(1e-3, 0.5), st.floats(0, 3))
def test_shared_bins_keep_the_mean_length(length_m: float, bins: int, width_m: float, start_m: float) -> None:
    """Two bins side by side, of weights that add up to one; their centres' mean is the length modulo the period."""
    response = TransientHistogram(start_m, width_m, bins, bins * width_m, is_shared=True)
    path = LightPath(*(np.array([x]) for x in (0.0, 0.0, length_m)), np.array([True]))
    (lower, a), (upper, b) = [(int(i[0]), float(w[0])) for i, w in response.bin_weights(path, NumpyMath())]
    assert a + b == pytest.approx(1)
    assert min(a, b) >= 0
    assert upper == (lower + 1) % bins
    off = start_m + (lower + 0.5 + b) * width_m - length_m
    assert (off + bins * width_m / 2) % (bins * width_m) == pytest.approx(bins * width_m / 2, abs=1e-6)


@pytest.mark.parametrize("pulse_bins", [0.1, 0.5, 1.0, 2.0, 10.0])
def test_the_histogram_has_the_place_and_width_of_the_pulse(pulse_bins: float) -> None:
    """Mean, and over all places within a bin also the variance: that of the pulse, and of fine bins in a bin."""
    sensor = DirectToF(bins=100, pulse_fwhm_s=pulse_bins * 100e-12)
    range_m = np.linspace(0.7, 0.8, 2001)
    frames = walls_at(range_m, sensor).channels
    histogram = sensor.frames(list(frames.values()), np.zeros((1, 2001)), np.zeros((1, 2001)))[:, 0].astype(float)
    histogram /= histogram.sum(axis=0)
    place = (np.arange(100) + 0.5) @ histogram
    true = 2 * range_m / SPEED_OF_LIGHT / sensor.bin_s
    variance = ((np.arange(100)[:, None] + 0.5 - true) ** 2 * histogram).sum(axis=0)
    fine = sensor.responses()[0].channels // 100
    assert np.abs(place - true).max() < (1e-3 if fine == 1 else 0.5)
    assert np.abs((place - true).mean()) < 0.01
    assert variance.mean() == pytest.approx(sensor.sigma_bins**2 + (1 - fine**-2) / 12, abs=0.02)


def test_no_light_is_lost_by_the_pulse() -> None:
    sensor = DirectToF()
    signals = walls_at(np.linspace(1.0, 9.0, 500), sensor)
    (response,) = sensor.responses()
    np.testing.assert_allclose(signals.frames(sensor).sum(axis=0), signals.channels[response].sum(axis=0), rtol=1e-5)


def test_the_usual_sensor_knows_the_place_within_a_bin_and_piles_up() -> None:
    """Light is shared by two bins, so the mean of a peak has no error but that of the window around it. Without a
    pulse all light is in one bin, and the error its width over the root of 12."""
    range_m = np.linspace(0.5, 3.5, 5000)
    rms_m = []
    for sensor in (DirectToF(), DirectToF(pulse_fwhm_s=0.0)):
        image = decode(expose(walls_at(range_m, sensor), sensor))
        rms_m.append(np.sqrt(np.mean((image.range_m[0] - range_m) ** 2)))
    assert rms_m[0] < 0.7e-3
    assert rms_m[1] == pytest.approx(DirectToF().bin_s * SPEED_OF_LIGHT / 2 / np.sqrt(12), rel=0.01)
    assert SpadDetector().pile_up


def test_histogram_of_darkness_is_low_signal() -> None:
    rig, sensor = stereo_rig(32, 24), histogram_sensor()
    nothing = signals_of_depth(rig, np.full((24, 32), np.nan), [sensor])
    assert (decode(expose(nothing, sensor)).status == Status.LOW_SIGNAL).all()
    image = decode(expose(nothing, sensor, SpadDetector(), exposure_s=1e-3))
    assert (image.status == Status.LOW_SIGNAL).mean() > 0.99


def test_wrong_sensors_are_refused() -> None:
    capture = Capture(np.ones((2, 4, 4), np.float32), IdealToF())
    with pytest.raises(ValueError, match="amcw-tof"):
        decode(capture, AmcwDecoder())
    with pytest.raises(ValueError, match="expected a capture of direct-tof, got one of ideal-tof"):
        decode(capture, DirectToFDecoder())
    with pytest.raises(ValueError, match="amcw-tof"):
        AmcwDecoder().decode(capture)
    with pytest.raises(ValueError, match="expected a capture of amcw-tof, got one of ideal-tof"):
        Instrument("one", IdealToF(), decoder=AmcwDecoder())


@pytest.mark.parametrize("bins", [20, 256])
def test_a_pulse_that_fills_the_histogram_is_refused(bins: int) -> None:
    """One as long as the period, with pile-up, was read 0.48 m off with status OK."""
    half = 0.5 * bins * 100e-12
    DirectToF(bins=bins, pulse_fwhm_s=half)
    for pulse in (1.01 * half, 2 * half):
        with pytest.raises(ValueError, match="pulse_fwhm_s to be at most half of the histogram"):
            DirectToF(bins=bins, pulse_fwhm_s=pulse)
