# SPDX-License-Identifier: Apache-2.0
"""The Gaussian filter of photon histograms, along their bins."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pcgraph.kernel_cache import cached_njit

REACH_SIGMAS = 4.0
"""Standard deviations after which the filter is cut off, as in SciPy."""
COLUMNS = 128
"""Histograms that are filtered together: they stay in a core's cache."""
NOTHING = -1
"""Source of a bin beyond the ends that is empty."""


def gaussian_filter(histograms: np.ndarray, sigma_bins: float, mode: Literal["wrap", "edge", "constant"]) -> np.ndarray:
    """(k, n) filtered histograms: those of `scipy.ndimage.gaussian_filter1d`, in a third of the time.

    Parameters
    ----------
    histograms : (k, n) float32 or float64, one per column; the result has their type.
    sigma_bins : float, bins, standard deviation.
    mode : what lies beyond the ends: the other end, the last bin again, or nothing.
    """
    reach = int(REACH_SIGMAS * sigma_bins + 0.5)
    weights = np.exp(-0.5 / (sigma_bins * sigma_bins) * np.arange(-reach, reach + 1.0) ** 2)
    weights /= weights.sum()
    bins = np.arange(len(histograms))
    sources = np.pad(bins, reach, constant_values=NOTHING) if mode == "constant" else np.pad(bins, reach, mode=mode)
    result = np.empty(histograms.shape, histograms.dtype)
    _correlate(histograms, sources, weights[reach:], result)
    return result


@cached_njit(nogil=True, error_model="numpy")
def _correlate(histograms, sources, weights, result):  # type: ignore[no-untyped-def]
    """Symmetric correlation along the bins; `weights` from the middle outwards.

    sources : the bin that each one of the histograms lengthened by the filter's reach on both sides repeats.
    """
    (bins, columns), reach = result.shape, len(weights) - 1
    lengthened, totals = np.zeros((len(sources), COLUMNS)), np.empty(COLUMNS)
    for first in range(0, columns, COLUMNS):
        stop = min(first + COLUMNS, columns)
        for b in range(len(sources)):
            if sources[b] == NOTHING:
                lengthened[b] = 0.0
            else:
                lengthened[b, : stop - first] = histograms[sources[b], first:stop]
        for b in range(bins):
            middle = lengthened[b + reach]
            for i in range(COLUMNS):
                totals[i] = middle[i] * weights[0]
            for distance in range(reach, 0, -1):
                below, above, weight = (
                    lengthened[b + reach - distance],
                    lengthened[b + reach + distance],
                    weights[distance],
                )
                for i in range(COLUMNS):
                    totals[i] += (below[i] + above[i]) * weight
            result[b, first:stop] = totals[: stop - first]
