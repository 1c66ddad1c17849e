# SPDX-License-Identifier: Apache-2.0
"""Pile-up and peaks of photon histograms, in compiled loops."""

from __future__ import annotations

import math

import numpy as np

from pcgraph.kernel_cache import cached_njit

MAX_FRACTION = 1 - 1e-6
"""Of pulses in which a photon was detected: more leave no estimate."""


@cached_njit(nogil=True, error_model="numpy")
def detected_fraction(counts, pulses, fraction):  # type: ignore[no-untyped-def]
    """Write, of histograms (k, n) of first photons, the fraction of the pulses that were left before each bin."""
    left = np.full(counts.shape[1], float(pulses))
    for b in range(len(counts)):
        for column in range(counts.shape[1]):
            fraction[b, column] = min(counts[b, column] / max(left[column], 1.0), MAX_FRACTION)
            left[column] -= counts[b, column]


@cached_njit(nogil=True, error_model="numpy")
def measure_peaks(histograms, filtered, reach, is_cyclic, place, height, background):  # type: ignore[no-untyped-def]
    """Of histograms (k, n), write what `rangesim.decoding.histogram.find_peak` returns, (n,) each.

    filtered : (k, n), the matched filter's output, whose largest value is the peak. reach : bins on either side of it
    that belong to its window.
    """
    bins, columns = histograms.shape
    everything, highest, largest = np.zeros(columns), np.zeros(columns, np.int64), filtered[0].copy()
    for b in range(bins):
        for column in range(columns):
            everything[column] += histograms[b, column]
            highest[column] = b if filtered[b, column] > largest[column] else highest[column]
            largest[column] = max(filtered[b, column], largest[column])
    for column in range(columns):
        peak = highest[column]
        width = 2 * reach + 1
        if not is_cyclic:
            width = min(peak + reach, bins - 1) - max(peak - reach, 0) + 1
        outside = everything[column] - _counts(histograms, column, peak, reach, is_cyclic)
        level = max(outside, 0.0) / max(bins - width, 1)  # a difference: rounding may leave less than nothing
        recentred = math.floor(_centroid(histograms, column, peak, reach, is_cyclic, level))
        recentred = recentred % bins if is_cyclic else min(max(recentred, 0), bins - 1)
        centroid = _centroid(histograms, column, recentred, reach, is_cyclic, level)
        place[column] = centroid % bins if is_cyclic else centroid
        background[column] = level * width
        height[column] = _counts(histograms, column, recentred, reach, is_cyclic) - background[column]


@cached_njit(nogil=True, error_model="numpy")
def _counts(histograms, column, centre, reach, is_cyclic):  # type: ignore[no-untyped-def]
    """Sum of the window around the bin `centre`."""
    total = 0.0
    for b in range(centre - reach, centre + reach + 1):
        total += _count(histograms, column, b, is_cyclic)
    return total


@cached_njit(nogil=True, error_model="numpy")
def _centroid(histograms, column, centre, reach, is_cyclic, level):  # type: ignore[no-untyped-def]
    """Mean place of what the window has above `level`, bins, beyond the ends if need be; without any its middle."""
    total = moment = 0.0
    for b in range(centre - reach, centre + reach + 1):
        above = max(_count(histograms, column, b, is_cyclic) - level, 0.0)
        total += above
        moment += (b + 0.5) * above
    return moment / total if total > 0 else centre + 0.5


@cached_njit(nogil=True, error_model="numpy")
def _count(histograms, column, b, is_cyclic):  # type: ignore[no-untyped-def]
    """Count of bin b; beyond the ends zero, or that of the other end."""
    if is_cyclic:
        return histograms[b % len(histograms), column]
    return histograms[b, column] if 0 <= b < len(histograms) else 0.0
