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
"""Number of histograms that are filtered together, so that they stay in a core's cache: with 256 bins, 128 kB in single
precision."""

AT_ONCE = 1024
"""Number of totals that are added up together, so that they stay in the cache nearest to the processor: 4 kB."""

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
    from pcgraph.parallel import in_blocks

    reach = int(REACH_SIGMAS * sigma_bins + 0.5)
    weights = np.exp(-0.5 / (sigma_bins * sigma_bins) * np.arange(-reach, reach + 1.0) ** 2)
    weights /= weights.sum()
    bins = np.arange(len(histograms))
    sources = np.pad(bins, reach, constant_values=NOTHING) if mode == "constant" else np.pad(bins, reach, mode=mode)
    histograms = np.ascontiguousarray(histograms)
    result, half = np.empty(histograms.shape, histograms.dtype), weights[reach:].astype(histograms.dtype)
    in_blocks(_correlate, histograms.shape[1], histograms, sources, half, result)
    return result


@cached_njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _correlate(start, stop, histograms, sources, weights, result):  # type: ignore[no-untyped-def]
    """Write the symmetric correlation along the bins into the columns of `result` from `start` to `stop`.

    weights : from the middle outwards. sources : for each bin of the histograms, lengthened on both sides by the
    filter's reach, the index of the bin whose content it has.
    """
    bins, reach, zero = len(result), len(weights) - 1, np.zeros(1, histograms.dtype)[0]
    filled = np.zeros(len(sources) + 1, np.int64)  # number of bins before each one that are not empty
    lengthened = np.zeros(len(sources) * COLUMNS, histograms.dtype)  # bin after bin
    totals = np.empty(bins * COLUMNS, histograms.dtype)
    for first in range(start, stop, COLUMNS):
        last = min(first + COLUMNS, stop)
        for b in range(len(sources)):
            row = lengthened[b * COLUMNS : b * COLUMNS + last - first]
            if sources[b] == NOTHING:
                row[:] = zero
            else:
                row[:] = histograms[sources[b], first:last]
            counts = 0
            for i in range(last - first):  # without a branch, so that it is vectorised
                counts += row[i] != zero
            filled[b + 1] = filled[b] + (counts > 0)
        for begin in range(0, bins * COLUMNS, AT_ONCE):
            total, middle = totals[begin : begin + AT_ONCE], begin + reach * COLUMNS
            if filled[begin // COLUMNS] == filled[(begin + len(total)) // COLUMNS + 2 * reach]:
                total[:] = zero  # histograms of one surface are empty in most bins
                continue
            total[:] = lengthened[middle : middle + len(total)] * weights[0]
            distance = reach
            while distance >= 4:  # four at a time, from far to near, so that the totals are read and written less often
                far, w = distance * COLUMNS, weights[distance - 3 : distance + 1]
                a0, b0 = lengthened[middle - far :], lengthened[middle + far :]
                a1, b1 = lengthened[middle - far + COLUMNS :], lengthened[middle + far - COLUMNS :]
                a2, b2 = lengthened[middle - far + 2 * COLUMNS :], lengthened[middle + far - 2 * COLUMNS :]
                a3, b3 = lengthened[middle - far + 3 * COLUMNS :], lengthened[middle + far - 3 * COLUMNS :]
                for i in range(len(total)):
                    outer = total[i] + (a0[i] + b0[i]) * w[3] + (a1[i] + b1[i]) * w[2]
                    total[i] = outer + (a2[i] + b2[i]) * w[1] + (a3[i] + b3[i]) * w[0]
                distance -= 4
            for near in range(distance, 0, -1):
                below, above = lengthened[middle - near * COLUMNS :], lengthened[middle + near * COLUMNS :]
                for i in range(len(total)):
                    total[i] += (below[i] + above[i]) * weights[near]
        for b in range(bins):
            result[b, first:last] = totals[b * COLUMNS : b * COLUMNS + last - first]
