# SPDX-License-Identifier: Apache-2.0
"""Gaussian filter of photon histograms, along their bins."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pcgraph.kernel_cache import cached_njit

REACH_SIGMAS = 4.0
"""Distance in standard deviations at which the filter is cut off: the default of SciPy, so that results agree with
it."""

COLUMNS = 128
"""Number of histograms that are filtered together, so that they stay in a core's cache: with 256 bins, 256 kB."""

NOTHING = -1
"""Index that stands for an empty bin beyond the ends; no bin has it."""


def gaussian_filter(histograms: np.ndarray, sigma_bins: float, mode: Literal["wrap", "edge", "constant"]) -> np.ndarray:
    """(k, n) filtered histograms, equal to those of `scipy.ndimage.gaussian_filter1d`, in a third of its time.

    Parameters
    ----------
    histograms : (k, n) float32 or float64, one per column; the result has their type.
    sigma_bins : float, bins, standard deviation.
    mode : content of the bins beyond the ends: "wrap", the bins at the other end; "edge", the last bin again;
        "constant", nothing.

    Examples
    --------
    >>> import numpy as np
    >>> gaussian_filter(np.array([[0.0], [0.0], [1.0], [0.0], [0.0]]), 0.5, "constant").ravel().round(3)
    array([0.   , 0.106, 0.787, 0.106, 0.   ])
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
    """Write the symmetric correlation along the bins into `result`.

    weights : from the middle outwards. sources : for each bin of the histograms, lengthened on both sides by the
    filter's reach, the index of the bin whose content it has.
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
