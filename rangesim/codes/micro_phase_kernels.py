# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over pixels: the place at which a set of fringes of several periods fits best."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcgraph.parallel import kernel, routine, summing_routine

STEPS = 3
"""Number of Gauss-Newton steps from the best column to the place of least residual. The first one leaves 0.03 pixels
with a period of 16 pixels, the second one less than 0.001."""


class PeriodTable(NamedTuple):
    """Values of the frames at the centre of each projector pixel, as fractions of the amplitude.

    values : (size, F + 1) float32: cosine and sine of the first period, then one cosine per further period.
    slopes : (size, F + 1) float32, derivatives of `values`, per projector pixel.
    steepness : (size,) float32, sum of the squares of `slopes`.
    """

    values: np.ndarray
    slopes: np.ndarray
    steepness: np.ndarray


@summing_routine
def _misfit(units, i, table, column):  # type: ignore[no-untyped-def]
    """Sum of the squared differences between a pixel and a column, and minus half its derivative along the column."""
    squares, slope = np.float32(0), np.float32(0)
    for f in range(units.shape[1]):
        off = units[i, f] - table.values[column, f]
        squares += off * off
        slope += off * table.slopes[column, f]
    return squares, slope


@kernel
def find_columns(  # type: ignore[no-untyped-def]
    start, stop, units, places, table, period, reach, place, column, residual, rival
):
    """Write the best column of pixels, and how much better it fits than the best column of any other period.

    The phase of the first period leaves one place per period. Around each, the least residual follows from a
    Gauss-Newton step of at most `reach`.

    Parameters
    ----------
    units : (n, F + 1) float32, as `PeriodTable.values`. places : (n,) float32, place within the first period, turns.
    period, reach : projector pixels. place : (n,) float32, out: place of the first period's phase, projector pixels.
    column : (n,) int32, out. residual, rival : (n,) float32, out: sum of squares at the best place, and in the best
        one of the other periods; infinite if there is none.
    """
    size = len(table.values)
    for i in range(start, stop):
        best, second, best_place = np.float32(np.inf), np.float32(np.inf), np.float32(0)
        if math.isnan(places[i]):
            place[i], column[i], residual[i], rival[i] = np.nan, 0, np.inf, np.inf
            continue
        first = math.ceil(-reach / period - places[i])
        last = math.floor((size + reach) / period - places[i])
        for k in range(first, last + 1):
            x = (k + places[i]) * period
            near = min(max(int(x), 0), size - 1)
            squares, slope = _misfit(units, i, table, near)
            step = min(max(slope / table.steepness[near], -reach), reach)
            squares -= (2 * slope - step * table.steepness[near]) * step
            if squares < best:
                best, second, best_place = squares, best, x
            elif squares < second:
                second = squares
        place[i] = best_place
        column[i] = _lowest(units, i, table, min(max(int(best_place), 0), size - 1))
        residual[i], rival[i] = max(best, np.float32(0)), second


@routine
def _lowest(units, i, table, column):  # type: ignore[no-untyped-def]
    """The column of least residual that is reached from `column` downhill."""
    size = len(table.values)
    here = _misfit(units, i, table, column)[0]
    for direction in (-1, 1):
        while 0 <= column + direction < size:
            there = _misfit(units, i, table, column + direction)[0]
            if there >= here:
                break
            here, column = there, column + direction
    return column


@kernel
def fit_places(start, stop, units, column, omega, start_phase, contrast, reach, place, spread):  # type: ignore[no-untyped-def]
    """Write the place of least residual of each pixel, by Gauss-Newton steps from its column, and its standard
    deviation for frames with noise of one amplitude.

    Parameters
    ----------
    units : (n, F + 1) float32, as `PeriodTable.values`. column : (n,) int32. omega, start_phase : (F,) float32, radians
        per projector pixel, and radians: frame f shows contrast cos(omega x - start_phase).
    contrast : (F,) float32, of each period as a fraction of the first. reach : projector pixels, largest distance from
        the column's centre. place, spread : (n,) float32, out, projector pixels.
    """
    for i in range(start, stop):
        centre = column[i] + 0.5
        x = centre
        variance = 0.0
        for _ in range(STEPS):
            a = omega[0] * x
            # The first period's cosine and sine have the amplitude 1 by definition, so only their phase has noise.
            slope = (units[i, 1] * math.cos(a) - units[i, 0] * math.sin(a)) * omega[0]
            steepness = omega[0] * omega[0]
            sums, products, own = 0.0, 0.0, 2.0 / 3.0 * omega[0] * omega[0]
            for f in range(1, len(omega)):
                a = omega[f] * x - start_phase[f]
                value = contrast[f] * math.cos(a)
                grown = -contrast[f] * omega[f] * math.sin(a)
                slope += (units[i, f + 1] - value) * grown
                steepness += grown * grown
                sums, products, own = sums + grown, products + grown * value, own + grown * grown
            variance = (own + sums * sums / 3.0 + 2.0 / 3.0 * products * products) / (steepness * steepness)
            x = min(max(x + slope / steepness, centre - reach), centre + reach)
        place[i], spread[i] = x, math.sqrt(variance)
