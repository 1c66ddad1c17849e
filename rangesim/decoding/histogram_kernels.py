# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over photon histograms: pile-up and peaks."""

from __future__ import annotations

import math

import numpy as np

from pcgraph.kernel_cache import cached_njit

MAX_FRACTION = 1 - 1e-6
"""Largest fraction that a bin may have taken of the pulses left before it. At 1 the logarithm of Coates' formula is
infinite; the value here is one pulse of a million away from it."""


MAX_OUTSIDE = 3.0
"""Largest distance of a pulse's middle from the bins that show its flank, in standard deviations of the pulse. If the
middle is farther out, less than 0.2 % of the pulse is in the bins, and noise alone would decide its place."""

MAX_STEPS = 50
"""Largest number of Newton steps to the place of a pulse that is cut off, so that searches end that never converge. A
few steps usually suffice."""

MIN_RATE = 1e-3
"""Least rate at which a cut-off pulse's centroid grows with its place (a ratio) in a Newton step. A smaller one, as of
a pulse far outside, would make the step grow without bound."""

CONVERGED = 1e-6
"""Largest step, in standard deviations of the pulse, at which its place counts as found. The noise is much larger: with
a million counts it is a thousandth."""


@cached_njit(nogil=True, error_model="numpy")
def all_photons(counts, pulses, photons):  # type: ignore[no-untyped-def]
    """Write the number of photons (k, n) that Coates' formula makes of counts.

    counts : (k, n) int, histograms of the first photon of each of `pulses` pulses.
    """
    left = np.full(counts.shape[1], float(pulses))
    for b in range(len(counts)):
        for column in range(counts.shape[1]):
            count = counts[b, column]
            if count == 0:  # most bins of most histograms
                photons[b, column] = 0.0
            else:
                photons[b, column] = -pulses * math.log1p(-min(count / max(left[column], 1.0), MAX_FRACTION))
                left[column] -= count


@cached_njit(nogil=True, error_model="numpy")
def total_counts(counts, total):  # type: ignore[no-untyped-def]
    """Write the sum (n,) float64 of the counts (k, n) of each histogram."""
    total[:] = 0.0
    for b in range(len(counts)):
        for column in range(len(total)):
            total[column] += counts[b, column]


@cached_njit(nogil=True, error_model="numpy")
def counts_until(counts, last, total):  # type: ignore[no-untyped-def]
    """Write the sums (m, n) int64 of the counts (k, n) of each histogram, up to and with the bins `last` (m, n)."""
    total[:] = 0
    for b in range(len(counts)):
        for i in range(len(last)):
            for column in range(counts.shape[1]):
                total[i, column] += counts[b, column] if b <= last[i, column] else 0


@cached_njit(nogil=True, error_model="numpy")
def measure_peaks(  # type: ignore[no-untyped-def]
    histograms, filtered, reach, sigma, is_cyclic, place, height, background
):
    """Write the place, height and background (n,) of the peak of each histogram, see `find_peak`.

    histograms : (k, n) counts. filtered : (k, n), the matched filter's output, whose largest value is the peak.
    reach : number of bins on either side of the peak that its window holds. sigma : bins, standard deviation of the
    pulse.
    """
    bins, columns = histograms.shape
    everything, highest, largest = np.zeros(columns), np.zeros(columns, np.int32), filtered[0].copy()
    total_counts(histograms, everything)
    for b in range(bins):
        for column in range(columns):  # a loop of its own, without branches, is vectorised
            highest[column] = np.int32(b) if filtered[b, column] > largest[column] else highest[column]
            largest[column] = max(filtered[b, column], largest[column])
    for column in range(columns):
        peak = int(highest[column])
        width = 2 * reach + 1
        if not is_cyclic:
            width = min(peak + reach, bins - 1) - max(peak - reach, 0) + 1
        outside = everything[column] - _counts(histograms, column, peak, reach, is_cyclic)
        level = max(outside, 0.0) / max(bins - width, 1)  # rounding may make the difference negative
        recentred = math.floor(_centroid(histograms, column, peak, reach, is_cyclic, level))
        recentred = recentred % bins if is_cyclic else min(max(recentred, 0), bins - 1)
        centroid = _centroid(histograms, column, recentred, reach, is_cyclic, level)
        if is_cyclic:
            centroid %= bins
        elif sigma > 0 and (recentred < reach or recentred + reach >= bins):
            low, high = max(recentred - reach, 0), min(recentred + reach + 1, bins)
            centroid = whole_peak(centroid, float(low), float(high), sigma)
        place[column] = centroid
        background[column] = level * width
        height[column] = _counts(histograms, column, recentred, reach, is_cyclic) - background[column]


@cached_njit(nogil=True, error_model="numpy")
def whole_peak(centroid, low, high, sigma):  # type: ignore[no-untyped-def]
    """Place of a Gaussian pulse whose part between `low` and `high` has this centroid; all in bins, sigma > 0.

    If a normal distribution is cut off, the mean of the part grows with the mean of the whole, at the rate (variance of
    the part) / sigma^2. Newton's method uses that rate. A pulse farther outside than `MAX_OUTSIDE` is placed at
    `MAX_OUTSIDE`.
    """
    first, last = low - MAX_OUTSIDE * sigma, high + MAX_OUTSIDE * sigma
    place = centroid
    for _ in range(MAX_STEPS):
        a, b = (low - place) / sigma, (high - place) / sigma
        density_a, density_b = math.exp(-0.5 * a * a), math.exp(-0.5 * b * b)
        mass = math.sqrt(0.5 * math.pi) * (math.erf(b * math.sqrt(0.5)) - math.erf(a * math.sqrt(0.5)))
        shift = (density_a - density_b) / mass
        rate = 1 + (a * density_a - b * density_b) / mass - shift * shift
        before = place
        place = min(max(place + (centroid - place - sigma * shift) / max(rate, MIN_RATE), first), last)
        if abs(place - before) < CONVERGED * sigma:
            break
    return place


@cached_njit(nogil=True, error_model="numpy")
def _counts(histograms, column, centre, reach, is_cyclic):  # type: ignore[no-untyped-def]
    """Sum of the counts in the window around the bin `centre`."""
    total = 0.0
    for b in range(centre - reach, centre + reach + 1):
        total += _count(histograms, column, b, is_cyclic)
    return total


@cached_njit(nogil=True, error_model="numpy")
def _centroid(histograms, column, centre, reach, is_cyclic, level):  # type: ignore[no-untyped-def]
    """Centroid in bins of the counts above `level` in the window; its middle if there are none.

    It may lie beyond the ends of the histogram, where the window goes on at the other end.
    """
    total = moment = 0.0
    for b in range(centre - reach, centre + reach + 1):
        above = max(_count(histograms, column, b, is_cyclic) - level, 0.0)
        total += above
        moment += (b + 0.5) * above
    return moment / total if total > 0 else centre + 0.5


@cached_njit(nogil=True, error_model="numpy")
def _count(histograms, column, b, is_cyclic):  # type: ignore[no-untyped-def]
    """Count of bin b. Beyond the ends it is zero, or that of the bin at the other end if the histogram is cyclic."""
    if is_cyclic:
        return histograms[b % len(histograms), column]
    return histograms[b, column] if 0 <= b < len(histograms) else 0.0
