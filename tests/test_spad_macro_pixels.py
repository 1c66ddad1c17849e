# SPDX-License-Identifier: Apache-2.0
"""Macro-pixels of SPADs: dead time, afterpulses and coincidence, against the closed forms of renewal processes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm
from synthetic import signals_of_depth, stereo_rig

from rangesim import DirectToF, Intrinsics, Rig, SpadDetector, Status, decode, expose
from rangesim.decoding.histogram import coates, pile_up_excess, undo_pile_up
from rangesim.electronics.detector import Gate
from rangesim.sensors import DirectToFDecoder

BINS, PERIOD_S, PULSES = 100, 100e-9, 20_000
GATE = Gate(PERIOD_S, PERIOD_S, BINS)
"""Bins of 1 ns that fill the period."""
PIXELS = 40


def counted(photons: np.ndarray, gate: Gate = GATE, pulses: int = PULSES, seed: int = 0, **settings: Any) -> np.ndarray:
    """(bins, PIXELS) counts of pixels that get so many photons (bins,) of each pulse, dark counts aside."""
    detector = SpadDetector(**{"dark_counts_hz": 0.0, "bits": 16, **settings})
    rig = stereo_rig(PIXELS, 1)
    per_radiance = detector.electron_rate_per_radiance(rig) * gate.period_s
    radiance = np.repeat(np.asarray(photons)[:, None, None] / per_radiance, PIXELS, axis=2).astype(np.float32)
    return detector.read_out(radiance, gate, rig, pulses * gate.period_s, seed)[:, 0].astype(np.int64)


def even(rate_hz: float, gate: Gate = GATE) -> np.ndarray:
    """Photons of each bin in constant light that brings so many per second."""
    return np.full(gate.bins, rate_hz * gate.open_s / gate.bins)


def check_rate(counts: np.ndarray, expected_hz: float, gate: Gate = GATE, pulses: int = PULSES) -> None:
    """The counts per second of open gate are as expected, within 5 standard deviations of their mean."""
    rates = counts.sum(axis=0) / (pulses * gate.open_s)
    assert abs(rates.mean() - expected_hz) < 5 * max(rates.std(), 1e-3 * expected_hz) / np.sqrt(PIXELS)


# ---- Several SPADs, each with a timer --------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [{}, {"dead_time_s": 1e-12}], ids=["binomial", "photon by photon"])
@pytest.mark.parametrize("spads", [1, 4, 16])
def test_each_spad_piles_up_on_its_own_light_and_the_counts_add_up(spads: int, settings: dict[str, float]) -> None:
    """A timer counts in bin b with the probability exp(-before) - exp(-before - mean), in a part of the light."""
    photons = 0.02 + 3.0 * (np.arange(BINS) == 30)
    counts = counted(photons, spads=spads, pulses=2000, **settings)
    before = np.concatenate([[0.0], np.cumsum(photons / spads)])
    expected = 2000 * spads * -np.diff(np.exp(-before))
    error = (counts.mean(axis=1) - expected) / np.sqrt(expected / PIXELS)
    assert np.sqrt(np.mean(error**2)) < 1.3
    restored = coates(counts.sum(axis=1), 2000 * spads * PIXELS)
    np.testing.assert_allclose(restored[:31] / (2000 * PIXELS), photons[:31], rtol=0.15, atol=1e-3)
    assert restored[30] / (2000 * PIXELS) == pytest.approx(3.0, rel=0.02)


def test_a_wall_is_read_without_bias_although_its_spads_pile_up() -> None:
    sensor, range_m = DirectToF(), np.full(500, 2.0)
    rig = Rig(Intrinsics.from_fov(500, 1, 20.0), Intrinsics.from_fov(1280, 800, 60), projector_power_w=3000.0)
    signals = signals_of_depth(rig, range_m[None], [sensor])
    still, detector = decode(expose(signals, sensor)), SpadDetector(spads=8, bits=16)
    image = decode(expose(signals, sensor, detector, exposure_s=1e-4))
    photons = detector.photons_per_pulse(signals.frames(sensor), sensor.gate, rig)
    assert np.median(photons) > 1
    assert image.valid.all()
    error = (image.range_m - still.range_m)[0]
    assert abs(error.mean()) < 5 * error.std() / np.sqrt(len(error)) + 1e-4


# ---- Dead time -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dead_time_s", [5e-9, 30.5e-9, 270e-9])
@pytest.mark.parametrize("rate_hz", [1e6, 2e7, 3e8])
@pytest.mark.parametrize("spads", [1, 5])
def test_in_constant_light_the_rate_is_that_of_a_counter_that_is_not_paralysed(
    dead_time_s: float, rate_hz: float, spads: int
) -> None:
    """m = n / (1 + n tau) for each SPAD, also for dead times over several pulses and within a bin."""
    counts = counted(even(rate_hz * spads), spads=spads, dead_time_s=dead_time_s, pile_up=False, pulses=4000)
    check_rate(counts, spads * rate_hz / (1 + rate_hz * dead_time_s), pulses=4000)
    np.testing.assert_allclose(counts.mean(axis=1) / counts.mean(), 1, atol=0.3)


def test_without_dead_time_every_photon_counts() -> None:
    photons = 0.01 + 0.5 * (np.arange(BINS) == 30)
    counts = counted(photons, pile_up=False, dead_time_s=1e-15)
    expected = photons * PULSES
    assert np.abs((counts.mean(axis=1) - expected) / np.sqrt(expected / PIXELS)).max() < 5
    assert counts.var(axis=1)[30] == pytest.approx(expected[30], rel=0.8)


def test_behind_a_bright_peak_a_spad_is_blind_for_its_dead_time() -> None:
    """Of the pulses, exp(-mean of the peak) leave the SPAD armed."""
    ambient, peak, dead_bins = 1e-3, 1.5, 20
    photons = ambient + peak * (np.arange(BINS) == 30)
    counts = counted(photons, pile_up=False, dead_time_s=dead_bins * 1e-9).mean(axis=1) / PULSES
    armed_before = 1 - ambient * dead_bins
    assert counts[25:30].mean() == pytest.approx(ambient * armed_before, rel=0.03)
    assert counts[30] == pytest.approx(armed_before * -np.expm1(-peak), rel=0.01)
    assert counts[33:49].mean() == pytest.approx(ambient * np.exp(-peak), rel=0.08)
    assert counts[60:].mean() == pytest.approx(ambient, rel=0.05)


# ---- Afterpulses -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("probability", [0.02, 0.2, 0.6])
def test_afterpulses_are_that_fraction_of_the_counts(probability: float) -> None:
    """In weak light every count has a further one with the probability q: of all counts, q are afterpulses."""
    rate_hz = 1e4
    counts = counted(
        even(rate_hz),
        pile_up=False,
        dead_time_s=5e-9,
        afterpulsing=probability,
        pulses=400_000,
        afterpulse_decay_s=2e-8,
    )
    check_rate(counts, rate_hz / (1 - probability), pulses=400_000)


def test_afterpulses_come_after_the_dead_time_and_decay() -> None:
    """The SPAD is armed again evenly over the bin that is `dead` bins behind the light's."""
    dead, decay, q, photons = 10, 8.0, 0.1, 0.05 * (np.arange(BINS) == 10)
    settings = {"dead_time_s": dead * 1e-9, "afterpulsing": q, "afterpulse_decay_s": decay * 1e-9}
    counts = counted(photons, pile_up=False, pulses=200_000, **settings).mean(axis=1)
    assert counts[11 : 10 + dead].sum() < 1e-3 * counts[10]  # afterpulses of an earlier pulse's afterpulses
    behind = counts[10 + dead :]
    assert behind.sum() == pytest.approx(counts[10] * q / (1 - q), rel=0.05)
    late = np.arange(1, 10)  # before those of afterpulses
    first = q * np.exp(-late / decay) * -np.expm1(-1 / decay) * decay * np.expm1(1 / decay)
    np.testing.assert_allclose(behind[1:10] / counts[10], first, rtol=0.1)


# ---- Coincidence -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [1e7, 1e8, 1e9])
@pytest.mark.parametrize("window_s", [0.5e-9, 4e-9])
@pytest.mark.validation
def test_two_photons_within_a_window_make_a_count(rate_hz: float, window_s: float) -> None:
    """A count takes one photon, and further ones until a gap is short: 1 + 1 / p of them, p = 1 - exp(-rate window)."""
    settings = {"spads": 16, "coincidence": 2, "coincidence_window_s": window_s, "pile_up": False}
    counts = counted(even(rate_hz), pulses=4000, **settings)
    p = -np.expm1(-rate_hz * window_s)
    check_rate(counts, rate_hz * p / (1 + p), pulses=4000)


@pytest.mark.parametrize("coincidence", [2, 3])
def test_accidental_coincidences_in_weak_light(coincidence: int) -> None:
    """rate^k window^(k - 1) / (k - 1)!, the first photon's rate times the chance of k - 1 more within the window."""
    rate_hz, window_s = 5e6, 10e-9
    counts = counted(
        even(rate_hz), spads=64, coincidence=coincidence, coincidence_window_s=window_s, pile_up=False, pulses=40_000
    )
    expected = rate_hz * (rate_hz * window_s) ** (coincidence - 1) / (coincidence - 1)
    assert counts.sum() / (40_000 * PIXELS * PERIOD_S) == pytest.approx(expected, rel=0.12)


def test_coincidence_keeps_the_laser_and_drops_ambient_light() -> None:
    photons = 0.005 + 3.0 * (np.arange(BINS) == 40)  # half a photon of ambient light per pulse
    alone = counted(photons, spads=16).sum(axis=1)
    together = counted(photons, spads=16, coincidence=2, coincidence_window_s=1e-9, dead_time_s=20e-9).sum(axis=1)
    signal = slice(39, 42)
    assert together[signal].sum() / (PULSES * PIXELS) == pytest.approx(1 - 4 * np.exp(-3.0), rel=0.05)
    before = slice(0, 39)
    assert together[before].sum() / together[signal].sum() < 0.03 * alone[before].sum() / alone[signal].sum()


def test_coincidence_makes_weak_walls_late_and_bright_ones_early() -> None:
    """A count comes with the later of two photons of the pulse: in weak light sigma / sqrt(pi) behind its middle."""
    pulse, sigma = np.diff(norm.cdf((np.arange(BINS + 1) - 50) / 4)), 4.0
    settings = {"spads": 64, "coincidence": 2, "coincidence_window_s": 40e-9}
    weak, bright = (counted(n * pulse, pulses=p, **settings).sum(axis=1) for n, p in ((0.05, 200_000), (10.0, 1000)))
    late = [(np.arange(BINS) + 0.5) @ counts / counts.sum() - 50 for counts in (weak, bright)]
    assert late[0] == pytest.approx(sigma / np.sqrt(np.pi), rel=0.06)
    assert late[1] < -0.8 * sigma


def test_coincidence_counts_once_a_pulse_if_the_timer_does() -> None:
    photons = np.zeros(BINS)
    photons[[20, 60]] = 50.0
    settings = {"spads": 64, "coincidence": 4, "coincidence_window_s": 1e-9, "dead_time_s": 5e-9}
    first = counted(photons, pulses=500, **settings).mean(axis=1)
    every = counted(photons, pulses=500, pile_up=False, **settings).mean(axis=1)
    assert first[20] == pytest.approx(500, rel=1e-3)
    assert first[60] == 0
    assert every[60] > 500  # of about 35 SPADs that fire, groups of four are counted


# ---- The rest --------------------------------------------------------------------------------------------------------


def test_outside_the_gate_nothing_is_counted_and_dead_time_goes_on() -> None:
    gate = Gate(4 * PERIOD_S, PERIOD_S, BINS)
    counts = counted(even(1e9, gate), gate, pile_up=False, dead_time_s=390e-9, pulses=2000)
    assert counts.sum(axis=0).mean() == pytest.approx(2000, rel=0.01)  # each pulse finds it armed at the start or soon
    assert counts[:30].sum() > 0.9 * counts.sum()


@pytest.mark.parametrize(
    "settings",
    [{"spads": 9}, {"dead_time_s": 1e-8, "pile_up": False}, {"spads": 4, "coincidence": 2}, {"afterpulsing": 0.1}],
)
def test_the_same_seed_counts_the_same(settings: dict[str, Any]) -> None:
    one, again, other = (counted(even(3e7), seed=s, pulses=500, **settings) for s in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()


def test_settings_that_need_no_macro_pixel_change_no_byte() -> None:
    photons = 0.01 + 2.0 * (np.arange(BINS) == 30)
    for pile_up in (True, False):
        plain = counted(photons, pulses=500, pile_up=pile_up)
        same = counted(photons, pulses=500, pile_up=pile_up, coincidence_window_s=1e-8, afterpulse_decay_s=1e-7)
        np.testing.assert_array_equal(plain, same)


def test_a_pixel_in_floods_of_light_ends() -> None:
    counts = counted(np.full(BINS, 1e6), pulses=50, pile_up=False, dead_time_s=10e-9)
    assert counts.sum(axis=0).mean() == pytest.approx(50 * PERIOD_S / 10e-9, rel=0.02)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"spads": 0}, "number of SPADs"),
        ({"coincidence": 0}, "number of photons"),
        ({"afterpulsing": 1.0}, "probability"),
        ({"dead_time_s": -1e-9}, "0 or positive"),
        ({"coincidence_window_s": 0.0}, "positive and finite"),
    ],
)
def test_settings_out_of_their_bounds_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SpadDetector(**settings)


# ---- Undone by decoders ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        {"dead_time_s": 20e-9, "pile_up": False},
        {"dead_time_s": 150.3e-9, "pile_up": False},
        {"dead_time_s": 60e-9},
        {"dead_time_s": 5e-9, "pile_up": False, "spads": 4},
    ],
)
def test_what_dead_time_hides_is_undone(settings: dict[str, Any]) -> None:
    """Also where it reaches over to the next pulse; and the counts scatter by as much more as is said."""
    photons = 0.004 + 0.8 * np.exp(-0.5 * ((np.arange(BINS) - 60) / 3) ** 2) / 7.5
    counts = counted(photons, pulses=40_000, **settings)
    blind = SpadDetector(**settings).blindness(GATE, 40_000 * PERIOD_S)
    assert blind is not None
    restored, excess = undo_pile_up(counts, blind), pile_up_excess(counts, blind)
    expected = photons * 40_000
    error = (restored - expected[:, None]) / np.sqrt(expected[:, None] * excess)
    assert np.abs(error.mean(axis=1)).max() < 5 / np.sqrt(PIXELS)
    assert error.std() == pytest.approx(1, abs=0.1)
    assert np.abs(counts.mean(axis=1) / expected - 1).max() > 0.1  # what is undone is no trifle


@pytest.mark.parametrize("decoder", [DirectToFDecoder(), DirectToFDecoder(max_returns=2)])
@pytest.mark.parametrize("photons", [0.3, 2.0, 30.0])
def test_a_wall_is_read_within_its_noise_or_refused_in_spite_of_dead_time(
    decoder: DirectToFDecoder, photons: float
) -> None:
    sensor = DirectToF()
    rig = Rig(Intrinsics.from_fov(300, 1, 20.0), Intrinsics.from_fov(1280, 800, 60))
    signals = signals_of_depth(rig, np.full((1, 300), 2.0), [sensor])
    still, detector = decode(expose(signals, sensor), decoder), SpadDetector(dead_time_s=10e-9, pile_up=False, bits=16)
    brought = detector.photons_per_pulse(signals.frames(sensor), sensor.gate, rig).max()
    bright = replace(rig, projector_power_w=photons / brought)
    signals = signals_of_depth(bright, np.full((1, 300), 2.0), [sensor])
    image = decode(expose(signals, sensor, detector, exposure_s=2e-4, seed=5), decoder)
    if photons > 10:
        assert (image.status == Status.SATURATED).all()
        return
    assert image.valid.all()
    lengths = decoder.coordinates(expose(signals, sensor, detector, exposure_s=2e-4, seed=5))
    assert lengths.sigma_m is not None
    normalised = ((image.range_m - still.range_m) / (lengths.sigma_m / 2))[0]
    assert abs(normalised.mean()) < 0.5
    assert normalised.std() < 1.6
