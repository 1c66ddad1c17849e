# SPDX-License-Identifier: Apache-2.0
"""Shot noise and read noise, drawn from their exact distributions in compiled loops.

A photon count is the quantile of the Poisson distribution at a random number (inversion). For means of `SMALL_MEAN` and
more, the random number is a standard normal deviate w, and the quantile is floor(x). Here x(w) is an expansion in
1 / sqrt(mean) with a bounded error. If two whole numbers lie within the bound, the cumulative probability decides. That
happens once in a hundred draws at a mean of 4, and once in ten thousand at large means. The distribution is exact, and
drawing takes a third of the time of a rejection method.

References
----------
Giles: "Algorithm 955: approximation of the inverse Poisson cumulative distribution function", ACM TOMS 42 (2016). The
expansion is his, and so is the idea to correct it where it is ambiguous.
"""

from __future__ import annotations

import math

import numpy as np

from pcgraph.kernel_cache import cached_njit

SMALL_MEAN = 4.0
"""Mean count, in photons, from which on the expansion is used. The bound of its error holds for this mean and all
larger ones (tests/test_shot_noise.py). Below it only a few probabilities have to be added up."""
MAX_DEVIATE = 4.0
"""Standard deviations: largest |w| for which the bound of the expansion's error holds (tests/test_shot_noise.py). One
draw in 16 000 is beyond; the cumulative probability then decides it."""
SUMMED = 8
"""Count of terms of the cumulative probability that are always added, because a loop without a branch is faster. At the
largest mean that they serve (4 photons), 2 % of the draws need more terms."""
_RECIPROCAL = 1 / np.arange(1.0, SUMMED + 1)
"""1, 1/2, 1/3 ... for the terms of `SUMMED`, because multiplying is faster than dividing."""
NEGLIGIBLE = 1e-17
"""Fraction of a sum of probabilities, so small that adding it no longer changes the sum in double precision."""
DIM = 1.0
"""Expected photons in a bin below which photons are drawn one after the other, by the gaps between them. An empty bin
then takes no random number. Both ways are exact, so the value changes the speed alone."""
SPARSE = 5.0
"""Limit in photons for n^2 / m, with n the expected photons and m the pulses; half of n^2 / m is the number of photons
that share a pulse with an earlier one. Up to the limit `pulses_hit` draws photons, above it NumPy's binomial. Both are
exact, so the value changes the speed alone."""


@cached_njit(nogil=True, error_model="numpy")
def read_frame(rng, radiance, pixel, dn):  # type: ignore[no-untyped-def]
    """Write the digital numbers of a frame, with noise.

    radiance : (h, w) float32, W/m2/sr, mean radiance. pixel : `rangesim.electronics.detector.LinearPixel`.
    dn : (h, w) unsigned integers, the output.
    """
    for row in range(len(radiance)):
        for column in range(radiance.shape[1]):
            mean = _within(pixel.electrons_per_radiance * radiance[row, column] + pixel.dark_e, pixel.max_mean_e)
            electrons = poisson(rng, mean) + pixel.read_noise_e * rng.standard_normal()
            number = np.rint(pixel.gain_dn_e * electrons + pixel.offset_dn)
            dn[row, column] = min(max(number, 0.0), pixel.max_dn)


@cached_njit(nogil=True, error_model="numpy")
def count_photons(rng, radiance, pixel, counts):  # type: ignore[no-untyped-def]
    """Write the photon counts of one image row; every photon counts.

    radiance : (bins, w) float32, W/m2/sr, mean radiance. pixel : `rangesim.electronics.spad.CountingPixel`.
    counts : (bins, w) unsigned integers, the output.
    """
    gaps = first_gaps(rng, radiance.shape[1])
    for b in range(len(radiance)):
        for column in range(radiance.shape[1]):
            mean = _within(pixel.counts_per_radiance * radiance[b, column] + pixel.dark, pixel.max_mean)
            if 0 <= mean < DIM:
                gaps[column] -= mean
                photons = photons_after(rng, gaps, column) if gaps[column] < 0 else 0.0
            else:
                photons = poisson(rng, mean)
            counts[b, column] = min(photons, pixel.max_dn)


@cached_njit(nogil=True, error_model="numpy")
def count_first_photons(rng, radiance, pixel, pulses, counts):  # type: ignore[no-untyped-def]
    """Write the photon counts of one image row; only the first photon of each of `pulses` pulses counts.

    The other arguments are those of `count_photons`.
    """
    unused, gaps = np.full(radiance.shape[1], pulses), first_gaps(rng, radiance.shape[1])
    photons, dark, most = pixel.counts_per_radiance / pulses, pixel.dark / pulses, pixel.max_mean / pulses
    for b in range(len(radiance)):
        for column in range(radiance.shape[1]):
            mean = _within(photons * radiance[b, column] + dark, most)
            if 0 <= mean * unused[column] < DIM:
                gaps[column] -= mean * unused[column]
                if gaps[column] >= 0:
                    counts[b, column] = 0
                    continue
                hit = distinct(rng, int(photons_after(rng, gaps, column)), unused[column])
            else:
                hit = pulses_hit(rng, mean, unused[column])
            unused[column] -= hit
            counts[b, column] = min(hit, pixel.max_dn)


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def pulses_hit(rng, mean, pulses):  # type: ignore[no-untyped-def]
    """Number of pulses that bring at least one photon, out of `pulses` with `mean` photons each on average.

    The number is binomial with the probability 1 - exp(-mean). Where few photons share a pulse, the function draws the
    number of all photons, and subtracts those in a pulse that already has one.
    """
    expected = mean * pulses
    if expected * expected > SPARSE * pulses:
        return rng.binomial(pulses, -math.expm1(-mean))
    return distinct(rng, int(poisson(rng, expected)), pulses)


@cached_njit(nogil=True, error_model="numpy")
def distinct(rng, photons, pulses):  # type: ignore[no-untyped-def]
    """Number of pulses that bring at least one of so many photons, when each photon comes with a random pulse."""
    return photons if photons < 2 else photons - _shared(rng, photons, pulses)


@cached_njit(nogil=True, error_model="numpy")
def _shared(rng, photons, pulses):  # type: ignore[no-untyped-def]
    """Number of photons that fall into a pulse that already has one, when each photon hits a random pulse.

    The method is thinning. A photon is a candidate with the probability 1 - exp(-rate), which exceeds photons / pulses,
    so gaps between candidates are exponential. A candidate is then accepted with a second probability. The product of
    both probabilities is the fraction of the pulses that are hit so far.
    """
    shared, number = 0, 1  # the first photon, number 0, finds all pulses empty
    rate = 2 * photons / pulses if photons < 0.75 * pulses else math.inf
    while True:
        number += int(rng.standard_exponential() / rate)
        if number >= photons:
            return shared
        shared += rng.random() * pulses * -math.expm1(-rate) < number - shared
        number += 1


@cached_njit(nogil=True, error_model="numpy")
def first_gaps(rng, columns):  # type: ignore[no-untyped-def]
    """(columns,) float64, number of photons that are expected until the first one comes, for each column.

    Photons come one after the other, and the number that is expected between two of them is exponential. So a bin with
    few expected photons only shortens the gap to the next photon, until the gap is negative (`photons_after`). A
    brighter bin leaves the gap as it is, because an exponential gap has no memory.
    """
    gaps = np.empty(columns)
    for column in range(columns):
        gaps[column] = rng.standard_exponential()
    return gaps


@cached_njit(nogil=True, error_model="numpy")
def photons_after(rng, gaps, column):  # type: ignore[no-untyped-def]
    """Number of photons in a bin, as float64, that has made the gap of a column negative; updates the gap."""
    photons = 0.0
    while gaps[column] < 0:
        photons += 1
        gaps[column] += rng.standard_exponential()
    return photons


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def poisson(rng, mean):  # type: ignore[no-untyped-def]
    """A random whole number of the Poisson distribution, as float64.

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
    """The number x whose floor is the Poisson quantile at the normal deviate w, and a bound of the error of x.

    x solves Q(x, mean) = Phi(w), with Q the regularised upper incomplete gamma function (Giles's equation 10). The
    bound holds for |w| < MAX_DEVIATE.
    """
    inverse, square = 1 / math.sqrt(mean), w * w
    x = mean * (1 + inverse * w) + (2 + square) * (1 / 6 - (1 / 72) * w * inverse)
    x += (square * (7 + 3 * square) - 16) * (1 / 810) * inverse * inverse
    return x, (0.025 + 0.0012 * square * square * square) * inverse * inverse * inverse


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def _count_at(u, mean):  # type: ignore[no-untyped-def]
    """The Poisson quantile at u in [0, 1), found by adding up probabilities."""
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
    """The Poisson quantile at the normal deviate w. The search starts at `count` and goes up or down."""
    while _is_below(count, w, mean):
        count += 1
    while count > 0 and not _is_below(count - 1, w, mean):
        count -= 1
    return count


@cached_njit(nogil=True, error_model="numpy")
def _is_below(count, w, mean):  # type: ignore[no-untyped-def]
    """Whether P(N <= count) <= Phi(w). Both are compared as tails on the side of w, because small tails are precise."""
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
    """Poisson probability of a count."""
    return math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))


@cached_njit(nogil=True, error_model="numpy")
def _within(mean, most):  # type: ignore[no-untyped-def]
    """`mean`, limited to 0..`most`; NaN stays NaN."""
    if mean < 0:
        return 0.0
    return most if mean > most else mean
