# SPDX-License-Identifier: Apache-2.0
"""The kernel of phase unwrapping: the place on which the phases of fringes of several periods agree."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcgraph.kernel_cache import cached_njit


class Agreement(NamedTuple):
    """Limits within which the phases of several periods agree on a place.

    widest : float, turns, distance from the coarsest phase beyond which no place is tried.
    misfit : float, turns, largest distance of any phase from the place.
    ambiguity : float, largest cost of the best place as a fraction of that of the second best.
    """

    widest: float
    misfit: float
    ambiguity: float


@cached_njit(nogil=True, error_model="numpy")
def agree(places, weights, periods_px, low, high, gap, limits, result, agrees, is_clear):  # type: ignore[no-untyped-def]
    """Find, per pixel, the place between `low` and `high` on which all phases agree best.

    Every cycle of the finest fringes gives a candidate; each other period takes the cycle that lies nearest to it. The
    candidate with the least weighted sum of squared differences from their weighted mean wins. The one nearest to the
    coarsest phase is tried first; then those whose distance from that phase alone does not cost too much already to be
    the best, or to make it ambiguous.

    Parameters
    ----------
    places : (K, n) float32, place within the period, in turns, the finest period first and the coarsest last.
    weights : (K, n) float32, inverse variances of the places in projector pixels, in any scale.
    periods_px : (K,) float64. low, high : (n,) float32, projector pixels.
    gap : (n,) float32, difference of the costs of two places that noise does not make. limits : Agreement.
    result : (n,) float32, written: the place of the finest period, projector pixels; NaN if there is no candidate.
    agrees : (n,) bool, written: whether there is one, and only one, within the limits.
    is_clear : (n,) bool, written: whether the second best place costs more than the best one by `gap`.
    """
    count, n = places.shape
    last = count - 1
    base, coarsest = periods_px[0], periods_px[last]
    rate, ratio = 1.0 / periods_px, coarsest / base
    widest, sure = limits.widest, 1.0 / limits.ambiguity
    for i in range(n):
        turn, place = places[0, i], places[last, i]
        first = np.ceil(low[i] / base - turn - 1e-6)
        end = np.floor(high[i] / base - turn + 1e-6)
        total = 0.0
        for k in range(count):
            total += weights[k, i]
        per_weight = 1.0 / max(total, 1e-30)
        least = second = math.inf
        rise = 0.0  # a candidate costs at least this times the square of its distance from the coarsest phase
        if last > 0:
            together = weights[0, i] + weights[last, i]
            rise = weights[0, i] * weights[last, i] / max(together, 1e-30) * coarsest**2
            second = rise * widest**2  # what is left out costs at least this
        best = np.nan
        enough = second  # a candidate that costs more is neither best nor does it make the best ambiguous
        nearest = min(max(np.rint(place * ratio - turn), first), end)
        cycle, is_first = nearest, True
        while cycle <= end:
            x = (cycle + turn) * base
            far = x * rate[last] - place
            far -= np.rint(far)
            ahead = 1.0
            if abs(far) <= widest and rise * far * far <= enough:
                squares = mean = 0.0
                for k in range(1, count):
                    off = x * rate[k] - places[k, i]
                    off = (off - np.rint(off)) * periods_px[k]
                    squares += weights[k, i] * off * off
                    mean += weights[k, i] * off
                cost = squares - mean * mean * per_weight
                if cost < least:
                    second, least, best = min(second, least), cost, x
                    enough = min(second, max(sure * least, least + gap[i]))
                elif cost < second:
                    second = cost
                    enough = min(second, max(sure * least, least + gap[i]))
            elif ratio > 2:  # to where the coarsest phase is near again
                reach = min(widest, math.sqrt(enough / max(rise, 1e-30)))
                ahead = max(np.ceil(((far > 0) - far - reach) * ratio - 1e-6), 1.0)
            if is_first:
                cycle, is_first = first, False
            else:
                cycle += ahead
            if cycle == nearest:
                cycle += 1
        result[i] = best
        worst = 0.0
        for k in range(1, count):
            off = best * rate[k] - places[k, i]
            worst = max(worst, abs(off - np.rint(off)))
        agrees[i] = least < second and worst <= limits.misfit and max(least, 0.0) <= limits.ambiguity * second
        is_clear[i] = second - least >= gap[i]


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
