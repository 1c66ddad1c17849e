# SPDX-License-Identifier: Apache-2.0
"""Shot noise and read noise, drawn from their exact distributions in compiled loops.

A photon count is the quantile of Poisson's distribution at a random number. From a mean of `SMALL_MEAN` on that number
is a standard normal deviate w, and the quantile floor(x), where x(w) is an expansion in 1 / sqrt(mean) whose error is
bounded. Where the bound leaves two whole numbers (one draw in a hundred at a mean of 4, one in ten thousand at large
ones), the cumulative probability decides. So the distribution is exact, in a third of the time of a rejection method.

References
----------
Giles: "Algorithm 955: approximation of the inverse Poisson cumulative distribution function", ACM TOMS 42 (2016): the
expansion, and the idea to correct it where it is ambiguous.
"""

from __future__ import annotations

import math

import numpy as np

from pcgraph.kernel_cache import cached_njit

SMALL_MEAN = 4.0
"""From here on the expansion is used."""
MAX_DEVIATE = 4.0
"""Largest |w| for which the bound of the expansion's error holds."""
SUMMED = 8
"""Terms of the cumulative probability that are always added, without a branch."""
_RECIPROCAL = 1 / np.arange(1.0, SUMMED + 1)
NEGLIGIBLE = 1e-17
"""Of a sum of probabilities: what is smaller does not change it."""
SPARSE = 5.0
"""Square of the photons expected over the pulses, up to which `pulses_hit` draws photons: about twice the number that
share a pulse with an earlier one."""


@cached_njit(nogil=True, error_model="numpy")
def read_frame(rng, radiance, pixel, dn):  # type: ignore[no-untyped-def]
    """Write digital numbers `dn` (h, w) of a frame of mean radiance (h, w) float32, W/m2/sr.

    pixel : `rangesim.electronics.detector.LinearPixel`.
    """
    for row in range(len(radiance)):
        for column in range(radiance.shape[1]):
            mean = _within(pixel.electrons_per_radiance * radiance[row, column] + pixel.dark_e, pixel.max_mean_e)
            electrons = poisson(rng, mean) + pixel.read_noise_e * rng.standard_normal()
            number = np.rint(pixel.gain_dn_e * electrons + pixel.offset_dn)
            dn[row, column] = min(max(number, 0.0), pixel.max_dn)


@cached_njit(nogil=True, error_model="numpy")
def count_photons(rng, radiance, pixel, counts):  # type: ignore[no-untyped-def]
    """Write the counts (bins, w) of one image row of mean radiance (bins, w) float32, W/m2/sr: every photon.

    pixel : `rangesim.electronics.spad.CountingPixel`.
    """
    for b in range(len(radiance)):
        for column in range(radiance.shape[1]):
            mean = _within(pixel.counts_per_radiance * radiance[b, column] + pixel.dark, pixel.max_mean)
            counts[b, column] = min(poisson(rng, mean), pixel.max_dn)


@cached_njit(nogil=True, error_model="numpy")
def count_first_photons(rng, radiance, pixel, pulses, counts):  # type: ignore[no-untyped-def]
    """As `count_photons`, but only the first photon of each of `pulses` pulses counts."""
    unused = np.full(radiance.shape[1], pulses)
    photons, dark, most = pixel.counts_per_radiance / pulses, pixel.dark / pulses, pixel.max_mean / pulses
    for b in range(len(radiance)):
        for column in range(radiance.shape[1]):
            mean = _within(photons * radiance[b, column] + dark, most)
            hit = pulses_hit(rng, mean, unused[column])
            unused[column] -= hit
            counts[b, column] = min(hit, pixel.max_dn)


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def pulses_hit(rng, mean, pulses):  # type: ignore[no-untyped-def]
    """How many of `pulses` bring a photon, or more, each `mean` photons on average: binomial, 1 - exp(-mean) each.

    Where few photons share a pulse, all are drawn, and those that fall into a pulse that has one are taken away.
    """
    expected = mean * pulses
    if expected * expected > SPARSE * pulses:
        return rng.binomial(pulses, -math.expm1(-mean))
    photons = int(poisson(rng, expected))
    return photons if photons < 2 else photons - _shared(rng, photons, pulses)


@cached_njit(nogil=True, error_model="numpy")
def _shared(rng, photons, pulses):  # type: ignore[no-untyped-def]
    """How many of `photons`, each in one of `pulses` by chance, fall into a pulse that has one before them.

    By thinning: a photon is a candidate with probability 1 - exp(-rate), which exceeds photons / pulses, so that the
    gaps between candidates are exponential; of these, the fraction is taken that makes it the pulses hit so far /
    pulses.
    """
    shared, number = 0, 1  # the first photon, number 0, finds all pulses empty
    rate = 2 * photons / pulses if photons < 0.75 * pulses else math.inf
    while True:
        number += int(rng.standard_exponential() / rate)
        if number >= photons:
            return shared
        shared += rng.random() * pulses * -math.expm1(-rate) < number - shared
        number += 1


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def poisson(rng, mean):  # type: ignore[no-untyped-def]
    """A whole number (float64) of Poisson's distribution.

    Raises
    ------
    ValueError
        The mean is negative or NaN.
    """
    if not mean >= 0:
        raise ValueError("expected the mean of a photon count to be 0 or positive.")
    if mean < SMALL_MEAN:
        return _count_at(rng.random(), mean)
    w = rng.standard_normal()
    x, error = quantile(w, mean)
    count = math.floor(x - error)
    if abs(w) < MAX_DEVIATE and count == math.floor(x + error):
        return float(count)
    return _search(w, mean, max(0.0, math.floor(x)))


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def quantile(w, mean):  # type: ignore[no-untyped-def]
    """x, whose floor is the Poisson quantile at the normal deviate w, and a bound of its error for |w| < MAX_DEVIATE.

    x solves Q(x, mean) = Phi(w) with Q the upper incomplete gamma function, regularised (Giles's equation 10).
    """
    inverse, square = 1 / math.sqrt(mean), w * w
    x = mean * (1 + inverse * w) + (2 + square) * (1 / 6 - (1 / 72) * w * inverse)
    x += (square * (7 + 3 * square) - 16) * (1 / 810) * inverse * inverse
    return x, (0.025 + 0.0012 * square * square * square) * inverse * inverse * inverse


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def _count_at(u, mean):  # type: ignore[no-untyped-def]
    """The Poisson quantile at u in [0, 1), by adding up probabilities."""
    probability = math.exp(-mean)
    below, count = probability, 0
    for i in range(SUMMED):
        count += u >= below
        probability *= mean * _RECIPROCAL[i]
        below += probability
    while u >= below and probability > NEGLIGIBLE:
        count += 1
        probability *= mean / count
        below += probability
    return float(count)


@cached_njit(nogil=True, error_model="numpy")
def _search(w, mean, count):  # type: ignore[no-untyped-def]
    """The Poisson quantile at the normal deviate w, beginning at `count`."""
    while _is_below(count, w, mean):
        count += 1
    while count > 0 and not _is_below(count - 1, w, mean):
        count -= 1
    return count


@cached_njit(nogil=True, error_model="numpy")
def _is_below(count, w, mean):  # type: ignore[no-untyped-def]
    """Whether P(N <= count) <= Phi(w); by the sums of the tail on w's side, which keep their precision."""
    tail, total = 0.5 * math.erfc(abs(w) * math.sqrt(0.5)), 0.0
    if w < 0:
        probability = _probability(count, mean)
        while count >= 0 and probability > NEGLIGIBLE * total:
            total += probability
            probability *= count / mean
            count -= 1
        return total <= tail
    probability = _probability(count + 1, mean)
    while probability > NEGLIGIBLE * total:
        total += probability
        count += 1
        probability *= mean / (count + 1)
    return total >= tail


@cached_njit(nogil=True, error_model="numpy")
def _probability(count, mean):  # type: ignore[no-untyped-def]
    return math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))


@cached_njit(nogil=True, error_model="numpy")
def _within(mean, most):  # type: ignore[no-untyped-def]
    """`mean` between 0 and `most`; NaN stays."""
    if mean < 0:
        return 0.0
    return most if mean > most else mean
