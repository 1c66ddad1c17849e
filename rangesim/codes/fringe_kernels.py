# SPDX-License-Identifier: Apache-2.0
"""The kernel of phase unwrapping: the place on which the phases of fringes of several periods agree."""

from __future__ import annotations

import math

import numpy as np

from pcgraph.kernel_cache import cached_njit


@cached_njit(nogil=True, error_model="numpy")
def agree(places, weights, periods_px, low, high, widest, result, misfit, ambiguity):  # type: ignore[no-untyped-def]
    """Find, per pixel, the place between `low` and `high` on which all phases agree best.

    Every cycle of the finest fringes gives a candidate; each other period takes the cycle that lies nearest to it. The
    candidate with the least weighted sum of squared differences from their weighted mean wins.

    Parameters
    ----------
    places : (K, n) float32, place within the period, in turns, the finest period first and the coarsest last.
    weights : (K, n) float32, inverse variances of the places in projector pixels, in any scale.
    periods_px : (K,) float64. low, high : (n,) float32, projector pixels.
    widest : float, turns; candidates farther from the coarsest phase are left out.
    result : (n,) float32, written: the place of the finest period, projector pixels; NaN if there is no candidate.
    misfit : (n,) float32, written: largest distance of the other phases from it, in turns, 0 to 0.5.
    ambiguity : (n,) float32, written: least cost over second least, 0 to 1.
    """
    count, n = places.shape
    base, last = periods_px[0], count - 1
    rate = 1.0 / periods_px
    for i in range(n):
        turn = places[0, i]
        first = math.ceil(low[i] / base - turn - 1e-6)
        end = math.floor(high[i] / base - turn + 1e-6)
        total = 0.0
        for k in range(count):
            total += weights[k, i]
        least = second = math.inf
        if last > 0:  # what is left out costs at least this
            together = weights[0, i] + weights[last, i]
            second = weights[0, i] * weights[last, i] / max(together, 1e-30) * (widest * periods_px[last]) ** 2
        best = np.nan
        for cycle in range(first, end + 1):
            x = (cycle + turn) * base
            off = x * rate[last] - places[last, i]
            off -= np.rint(off)
            if abs(off) > widest:
                continue
            squares = mean = 0.0
            for k in range(1, count):
                off = x * rate[k] - places[k, i]
                off = (off - np.rint(off)) * periods_px[k]
                squares += weights[k, i] * off * off
                mean += weights[k, i] * off
            cost = squares - mean * mean / max(total, 1e-30)
            if cost < least:
                second, least, best = min(second, least), cost, x
            elif cost < second:
                second = cost
        result[i] = best
        if least == math.inf:
            misfit[i], ambiguity[i] = 0.5, 1.0
            continue
        worst = 0.0
        for k in range(1, count):
            off = best / periods_px[k] - places[k, i]
            worst = max(worst, abs(off - math.floor(off + 0.5)))
        misfit[i] = worst
        ambiguity[i] = 1.0 if least >= second else max(least, 0.0) / max(second, 1e-30)


@cached_njit(nogil=True, error_model="numpy")
def mean_place(places, weights, periods_px, result):  # type: ignore[no-untyped-def]
    """Replace places (n,) of the finest fringes by the weighted mean of the places that all periods tell near them.

    Parameters
    ----------
    places, weights : (K, n) float32, as for `agree`. periods_px : (K,) float64. result : (n,) float32.
    """
    count, n = places.shape
    for i in range(n):
        x, total, moment = result[i], 0.0, 0.0
        for k in range(count):
            off = places[k, i] - x / periods_px[k]
            total += weights[k, i]
            moment += weights[k, i] * (off - math.floor(off + 0.5)) * periods_px[k]
        result[i] = x + moment / max(total, 1e-30)
