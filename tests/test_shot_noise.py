# SPDX-License-Identifier: Apache-2.0
"""Photon counts are independent and follow their laws: Poisson's, and the binomial where a pulse counts but once."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numba import njit
from scipy import stats
from scipy.special import gammainc, gammaincc, ndtr
from synthetic import stereo_rig

from rangesim.electronics.detector import Detector
from rangesim.electronics.shot_noise import (
    MAX_DEVIATE,
    SMALL_MEAN,
    count_first_photons,
    count_photons,
    poisson,
    pulses_hit,
    quantile,
)
from rangesim.electronics.spad import CountingPixel, SpadDetector
from rangesim.sensors import DirectToF, StructuredLight

DRAWS = 1_000_000
MEANS = (0.01, 0.1, 0.5, 1.0, 2.5, 3.99, 4.0, 4.5, 6.0, 9.5, 20.0, 70.0, 300.0, 1e3, 1e4, 1e5)


@njit
def draw_poisson(rng, mean, counts):  # type: ignore[no-untyped-def]
    for i in range(len(counts)):
        counts[i] = poisson(rng, mean)


@njit
def draw_hits(rng, mean, pulses, counts):  # type: ignore[no-untyped-def]
    for i in range(len(counts)):
        counts[i] = pulses_hit(rng, mean, pulses)


def check_moments(counts: np.ndarray, law: stats.rv_frozen) -> None:
    """The first four central moments, each within 5 standard deviations of its estimate."""
    mean, sigma = law.mean(), law.std()
    support = np.arange(max(0.0, np.floor(mean - 12 * sigma)), mean + 12 * sigma + 30)
    central = [(((support - mean) / sigma) ** power * law.pmf(support)).sum() for power in range(9)]
    found = [(((counts - mean) / sigma) ** power).mean() for power in range(5)]
    for power in range(1, 5):
        error = np.sqrt((central[2 * power] - central[power] ** 2) / len(counts))
        assert abs(found[power] - central[power]) < 5 * error


def check_chi_square(counts: np.ndarray, law: stats.rv_frozen) -> None:
    """Counts in classes of 50 expected draws or more, as the law says."""
    edges = np.unique(law.ppf(np.linspace(0, 1, min(2000, len(counts) // 50) + 1)[1:-1]))
    edges = edges[law.sf(edges) > 0]
    expected = len(counts) * np.diff(np.concatenate([[0.0], law.cdf(edges), [1.0]]))
    found = np.bincount(np.searchsorted(edges, counts), minlength=len(expected))
    if len(expected) > 1:
        assert stats.chisquare(found, expected).pvalue > 1e-5


@pytest.mark.parametrize("mean", MEANS)
def test_counts_are_poisson(mean: float) -> None:
    counts = np.empty(DRAWS)
    draw_poisson(np.random.default_rng(int(1000 * mean)), mean, counts)
    check_moments(counts, stats.poisson(mean))
    check_chi_square(counts, stats.poisson(mean))


@pytest.mark.parametrize("pulses", [None, 100, 1000])
def test_the_bins_of_a_histogram_are_independent_and_follow_their_law(pulses: int | None) -> None:
    """Dim bins, whose photons come one after the other, stand between a bright one and an empty one."""
    means, pixel = (0.3, 0.02, 5.0, 0.7, 0.0, 0.9), CountingPixel(1.0, 0.0, 1e6, 65535)
    radiance = np.repeat(np.float32(means)[:, None], DRAWS // 20, axis=1)
    counts, rng = np.empty(radiance.shape, np.uint16), np.random.default_rng(1)
    if pulses is None:
        count_photons(rng, radiance, pixel, counts)
    else:
        count_first_photons(rng, radiance, pixel, pulses, counts)
    before = 0.0
    for mean, of_bin in zip(means, counts, strict=True):
        law = stats.poisson(mean)
        if pulses is not None:  # a pulse counts in the bin if none of its photons came before, and one comes now
            law = stats.binom(pulses, np.exp(-before / pulses) * -np.expm1(-mean / pulses))
        before += mean
        if mean:
            check_moments(of_bin, law)
            check_chi_square(of_bin, law)
    assert not counts[4].any()
    if pulses is None:
        correlation = np.corrcoef(counts[[0, 1, 2, 3, 5]])
        assert np.abs(correlation - np.eye(5)).max() < 5 / np.sqrt(counts.shape[1])


@pytest.mark.parametrize("mean", [4.0, 7.0, 30.0, 1e3, 1e5])
def test_the_tails_are_poisson(mean: float) -> None:
    """Counts that one draw in 10 000 exceeds: beyond the reach of the expansion, on both sides."""
    counts, law = np.empty(4 * DRAWS), stats.poisson(mean)
    draw_poisson(np.random.default_rng(3), mean, counts)
    low, high = law.ppf([1e-4, 1 - 1e-4])
    for found, fraction in (((counts < low).sum(), law.cdf(low - 1)), ((counts > high).sum(), law.sf(high))):
        assert abs(found - fraction * len(counts)) < 5 * np.sqrt(fraction * len(counts)) + 1


def test_the_expansion_of_the_quantile_is_within_its_bound() -> None:
    """Q(x - error) <= Phi(w) <= Q(x + error): so the whole number is right wherever x +- error hold the same."""
    for mean in np.geomspace(SMALL_MEAN, 1e5, 60):
        for w in np.linspace(-MAX_DEVIATE, MAX_DEVIATE, 161):
            x, error = quantile(w, mean)
            if x - error <= 0:
                continue
            if w < 0:
                assert gammaincc(x - error, mean) <= ndtr(w) <= gammaincc(x + error, mean)
            else:
                assert gammainc(x + error, mean) <= ndtr(-w) <= gammainc(x - error, mean)


@pytest.mark.parametrize(
    ("mean", "pulses"),
    [(1e-7, 10**6), (1e-5, 10**6), (1e-3, 10**6), (0.01, 1000), (0.1, 100), (0.5, 3), (2.0, 5), (0.3, 200), (5.0, 1)],
)
def test_pulses_with_a_photon_are_binomial(mean: float, pulses: int) -> None:
    counts, law = np.empty(DRAWS), stats.binom(pulses, -np.expm1(-mean))
    draw_hits(np.random.default_rng(pulses), mean, pulses, counts)
    check_moments(counts, law)
    check_chi_square(counts, law)


def test_no_photons_and_no_end_of_them() -> None:
    counts = np.empty(1000)
    draw_poisson(np.random.default_rng(0), 0.0, counts)
    assert not counts.any()
    draw_hits(np.random.default_rng(0), 1e9, 400, counts)
    assert (counts == 400).all()
    draw_hits(np.random.default_rng(0), 1.0, 0, counts)
    assert not counts.any()
    for mean in (-1.0, float("nan")):
        with pytest.raises(ValueError, match="mean of a photon count"):
            poisson(np.random.default_rng(0), mean)


def frames_of(mean_e: float, seed: int) -> np.ndarray:
    """(6, 300, 400) frames of uniform light, about `mean_e` electrons each, less their mean."""
    detector, rig = Detector(bits=16, full_well_e=65_000.0), stereo_rig(400, 300)
    level = mean_e / detector.electron_rate_per_radiance(rig) / 1e-3
    radiance = np.full((6, 300, 400), level, dtype=np.float32)
    frames = detector.read_out(radiance, StructuredLight().gate, rig, 1e-3, seed).astype(np.float64)
    return frames - frames.mean()


@pytest.mark.parametrize("mean_e", [1.0, 50.0, 5000.0])
def test_frames_pixels_and_seeds_are_independent(mean_e: float) -> None:
    """No correlation of values or of their squares, within 5 standard deviations."""
    one, other = frames_of(mean_e, 1), frames_of(mean_e, 2)
    pairs = [(one, other), (one[:-1], one[1:]), (one[:, :-1], one[:, 1:]), (one[..., :-1], one[..., 1:])]
    for a, b in pairs:
        for power in (1, 2):
            assert abs(np.corrcoef((a**power).ravel(), (b**power).ravel())[0, 1]) < 5 / np.sqrt(a.size)


@pytest.mark.parametrize("pile_up", [True, False])
def test_any_number_of_threads_gives_the_same_bytes(pile_up: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, radiance = stereo_rig(50, 67), np.random.default_rng(0).random((20, 67, 50), dtype=np.float32)
    sensors = (
        (StructuredLight(), Detector(), 1e-4),
        (DirectToF(bins=20, pulse_fwhm_s=0.0), SpadDetector(pile_up=pile_up), 1e-3),
    )
    for sensor, detector, exposure_s in sensors:
        frames = []
        for threads in (1, 2, 5):
            monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
            frames.append(detector.read_out(radiance, sensor.gate, rig, exposure_s, seed=3))
        assert all(np.array_equal(frames[0], other) for other in frames)
        assert len(np.unique(frames[0])) > 5
