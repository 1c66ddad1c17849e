# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over photon histograms: several pulses of a known shape in each."""

from __future__ import annotations

import math

import numpy as np

from pcgraph.kernel_cache import cached_njit

ROUNDS = 20
"""Largest number of rounds in which all returns of a pixel are fitted in turn. Well apart, two suffice; at Sparrow's
limit, 20 bring the places to a hundredth of a bin."""
STEPS = 4
"""Number of scoring steps of one return per round. More steps are of no use, because the next round takes them."""
CONVERGED = 1e-4
"""Rounds end when no place moves farther, in bins, and the background changes by no larger fraction of all counts. The
noise is larger: with a million counts it is a thousandth, of the pulse's width and of the counts."""
SETTLED = 0.01
"""Standard deviations of a place; a place that moves no farther has settled, because the noise hides it."""
MAX_STEP = 0.5
"""Largest scoring step in bins. It is limited, because far from the maximum the steps overshoot."""
FLOOR = 1e-6
"""Least expected count of a bin, as a fraction of the return's counts. A bin that should be empty would otherwise weigh
infinitely, although shapes are not known that well."""
CORE = 0.02
"""Least light of a bin that a return is found in and fitted to, as a fraction of the light in the pulse's fullest bin.
The tail beyond tells little of the place, and in real devices differs most from the pulse that was measured: the tail
of a TMF8820's reference pulse is five times that of a wall. A Gaussian is fitted over 2.8 standard deviations to each
side."""
WHOLE = 0.5
"""Least fraction of a pulse's energy (sum of squares) inside the histogram. If less is inside, its flank alone would
tell its place."""


@cached_njit(nogil=True, error_model="numpy")
def fit_returns(histograms, excess, shape, rules, is_cyclic, distance, place, strength, sigma):  # type: ignore[no-untyped-def]
    """Write the places, strengths and standard deviations (most, n) of the returns of each histogram.

    histograms : (k, n) counts. excess : (k, n) or (1, 1), variance of the counts over their means.
    shape : `PulseShape`. rules : `ReturnRules`. distance : bins, least one of two returns.
    """
    bins, columns = histograms.shape
    template = np.empty(shape.before + shape.behind + 1)
    for j in range(len(template)):
        template[j] = _part(shape, j - shape.before - 0.5)
    core = CORE * template.max()
    template[template < core] = 0.0
    excesses, counts, expected, others = np.empty((4, bins))
    is_refused = np.empty(bins, np.bool_)
    at, n, spread, at_before, n_before = np.empty((5, rules.most))
    for column in range(columns):
        total = 0.0
        for b in range(bins):
            counts[b] = histograms[b, column]
            total += counts[b]
            is_refused[b] = False
            excesses[b] = excess[b % len(excess), column % excess.shape[1]]
        found, level = 0, max(total, 0.0) / bins
        while found < rules.most:
            _expect(expected, level, at, n, found, -1, shape, is_cyclic)
            candidate, amount = _strongest(
                counts, expected, level, excesses, is_refused, template, shape.before, rules, is_cyclic
            )
            if candidate < 0:
                break
            at_before[:found], n_before[:found], level_before = at[:found], n[:found], level
            at[found], n[found] = candidate + 0.5, amount
            found += 1
            for _ in range(ROUNDS):
                moved = 0.0
                for i in range(found):
                    _expect(others, level, at, n, found, i, shape, is_cyclic)
                    was = at[i]
                    at[i], n[i], spread[i] = _fit(counts, others, excesses, at[i], n[i], shape, core, is_cyclic)
                    moved = max(moved, abs(at[i] - was) - SETTLED * spread[i])
                _expect(expected, level, at, n, found, -1, shape, is_cyclic)
                level_was, level = level, _level(counts, expected, level, rules.tolerance)
                if moved < CONVERGED and abs(level - level_was) * bins <= CONVERGED * total:
                    break
            if not _is_apart(at, n, found, distance, bins, is_cyclic, rules.counts):
                found -= 1  # the new one is a part of another
                at[:found], n[:found], level = at_before[:found], n_before[:found], level_before
                is_refused[candidate] = True
        if found > 1:
            _widen(spread, level, at, n, found, excesses, shape, core, is_cyclic)
        _write(at, n, spread, found, column, place, strength, sigma, bins, is_cyclic)


@cached_njit(nogil=True, error_model="numpy")
def _widen(spread, level, at, n, found, excess, shape, core, is_cyclic):  # type: ignore[no-untyped-def]
    """Raise the standard deviations of the places of returns that overlap to those of a fit of all of them at once.

    They follow from the inverse of the Fisher information of all places and strengths. core : see `_fit`.
    """
    bins, size = len(excess), 2 * found
    expected, slopes, information = np.empty(bins), np.zeros((size, bins)), np.zeros((size, size))
    _expect(expected, level, at, n, found, -1, shape, is_cyclic)
    strongest = 0.0
    for i in range(found):
        strongest = max(strongest, n[i])
        middle = math.floor(at[i])
        for b in range(middle - shape.before, middle + shape.behind + 1):
            part = _part(shape, b - at[i])
            if part >= core and (is_cyclic or 0 <= b < bins):
                slopes[2 * i, b % bins] += -n[i] * (_density(shape, b + 1 - at[i]) - _density(shape, b - at[i]))
                slopes[2 * i + 1, b % bins] += part
    overlap = False
    for b in range(bins):
        weight = 1 / (max(expected[b], FLOOR * strongest) * excess[b])
        for i in range(size):
            if slopes[i, b] != 0:
                for j in range(size):
                    information[i, j] += slopes[i, b] * slopes[j, b] * weight
                    overlap = overlap or (i // 2 != j // 2 and slopes[j, b] != 0)
    if not overlap:
        return
    scale = np.empty(size)
    for i in range(size):
        if not information[i, i] > 0:
            return
        scale[i] = 1 / math.sqrt(information[i, i])
    for i in range(size):
        for j in range(size):
            information[i, j] *= scale[i] * scale[j]
    for i in range(size):  # Gauss and Jordan's inversion in place; the matrix is positive definite
        pivot = information[i, i]
        if not pivot > 1e-9:
            return
        information[i, i] = 1.0
        information[i] /= pivot
        for j in range(size):
            if j != i:
                factor = information[j, i]
                information[j, i] = 0.0
                information[j] -= factor * information[i]
    for i in range(found):
        spread[i] = max(spread[i], math.sqrt(information[2 * i, 2 * i]) * scale[2 * i])


@cached_njit(nogil=True, error_model="numpy")
def _write(at, n, spread, found, column, place, strength, sigma, bins, is_cyclic):  # type: ignore[no-untyped-def]
    """Write the returns of a column, nearest first."""
    place[:, column], strength[:, column], sigma[:, column] = np.nan, 0.0, np.nan
    for i in range(found):
        if is_cyclic:
            at[i] %= bins
    order = np.argsort(at[:found])
    for i in range(found):
        place[i, column], strength[i, column] = at[order[i]], n[order[i]]
        sigma[i, column] = spread[order[i]]


@cached_njit(nogil=True, error_model="numpy")
def _strongest(counts, expected, level, excess, is_refused, template, before, rules, is_cyclic):  # type: ignore[no-untyped-def]
    """Bin and strength of the strongest return that is not explained yet and meets the rules; -1 if there is none.

    template : parts of a pulse in bins around its place, without its tail.
    """
    bins, best, most = len(counts), -1, 0.0
    energy = (template**2).sum()
    for b in range(bins):
        if is_refused[b]:
            continue
        square = match = variance = other = 0.0
        for j in range(len(template)):
            i = b + j - before
            if is_cyclic:
                i %= bins
            elif i < 0 or i >= bins:
                continue
            t = template[j]
            if t == 0:
                continue
            square += t * t
            match += t * (counts[i] - expected[i])
            variance += t * t * expected[i] * excess[i]
            other += t * (expected[i] - level)
        if square < WHOLE * energy:
            continue
        amount = match / square
        deviation = math.sqrt(max(variance, 0.0)) / square
        least = max(rules.counts, rules.sigmas * deviation + 0.25 * rules.sigmas**2)
        if amount > most and amount >= max(least, rules.tolerance * other / square):
            best, most = b, amount
    return best, most


@cached_njit(nogil=True, error_model="numpy")
def _is_apart(at, n, found, distance, bins, is_cyclic, least):  # type: ignore[no-untyped-def]
    """Whether all returns are strong, and the new one is at least `distance` from all others.

    Of several returns, the new one also has to be within the histogram: noise at its ends looks like a flank.
    """
    new = at[found - 1]
    if found > 1 and not is_cyclic and not 0 <= new <= bins:
        return False
    for i in range(found):
        away = abs(at[i] - new)
        if is_cyclic:
            away = min(away % bins, bins - away % bins)
        if not n[i] >= least or not n[i] > 0 or (i < found - 1 and away < distance):
            return False
    return True


@cached_njit(nogil=True, error_model="numpy")
def _level(counts, expected, level, tolerance):  # type: ignore[no-untyped-def]
    """Background per bin: the mean of what the returns leave, weighted by its precision in each bin.

    expected : counts that `level` and the returns bring to each bin. The returns' part is known to `tolerance` of it.
    """
    weights = total = 0.0
    least = FLOOR * max(expected.max(), 1e-30)
    for b in range(len(counts)):
        of_returns = max(expected[b] - level, 0.0)
        weight = 1 / max(level + of_returns + (tolerance * of_returns) ** 2, least)
        weights += weight
        total += weight * (counts[b] - of_returns)
    return max(total / weights, 0.0)


@cached_njit(nogil=True, error_model="numpy")
def _expect(expected, level, at, n, found, without, shape, is_cyclic):  # type: ignore[no-untyped-def]
    """Write the expected counts of each bin: the level and the returns, except the one of index `without`."""
    bins = len(expected)
    expected[:] = level
    for i in range(found):
        if i != without:
            middle = math.floor(at[i])
            for b in range(middle - shape.before, middle + shape.behind + 1):
                if is_cyclic or 0 <= b < bins:
                    expected[b % bins] += n[i] * _part(shape, b - at[i])


@cached_njit(nogil=True, error_model="numpy")
def _fit(counts, others, excess, at, n, shape, core, is_cyclic):  # type: ignore[no-untyped-def]
    """Place, strength and the place's standard deviation of one return, after some scoring steps.

    The score and the Fisher information are those of Poisson counts with the means n part_b(at) + others_b.

    core : least part of the pulse in a bin that is fitted, see `CORE`.
    """
    bins, spread = len(counts), np.inf
    for _ in range(STEPS):
        nn = np_ = pp = gn = gp = 0.0
        middle = math.floor(at)
        for b in range(middle - shape.before, middle + shape.behind + 1):
            if not is_cyclic and (b < 0 or b >= bins):
                continue
            part = _part(shape, b - at)
            if part < core:
                continue
            slope = -n * (_density(shape, b + 1 - at) - _density(shape, b - at))
            mean = n * part + others[b % bins]
            weight = 1 / (max(mean, FLOOR * n) * excess[b % bins])
            rest = (counts[b % bins] - mean) * weight
            gn, gp = gn + part * rest, gp + slope * rest
            nn, np_, pp = nn + part * part * weight, np_ + part * slope * weight, pp + slope * slope * weight
        determinant = nn * pp - np_ * np_
        if not determinant > 1e-12 * nn * pp:  # a pulse within one bin has no slope: its strength alone is fitted
            n = max(n + gn / nn, 0.0) if nn > 0 else n
            spread = math.sqrt(1 / 12)
            continue
        move = (nn * gp - np_ * gn) / determinant
        move = min(max(move, -MAX_STEP), MAX_STEP)
        grow = (gn - np_ * move) / nn
        at, n = at + move, max(n + grow, 0.1 * n)
        spread = math.sqrt(nn / determinant)
        if abs(move) < CONVERGED:
            break
    return at, n, spread


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def _part(shape, start):  # type: ignore[no-untyped-def]
    """Fraction of the pulse in the bin that begins `start` bins behind its place."""
    return _arrived(shape, start + 1) - _arrived(shape, start)


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def _arrived(shape, at):  # type: ignore[no-untyped-def]
    """Fraction of the pulse that has arrived, `at` bins behind its place."""
    x = (at - shape.start) * shape.steps
    if x <= 0:
        return 0.0
    i = int(x)
    if i >= len(shape.arrived) - 1:
        return 1.0
    return shape.arrived[i] + (x - i) * (shape.arrived[i + 1] - shape.arrived[i])


@cached_njit(nogil=True, error_model="numpy", forceinline=True)
def _density(shape, at):  # type: ignore[no-untyped-def]
    """Derivative of `_arrived`, per bin."""
    x = (at - shape.start) * shape.steps
    i = int(x)
    if x <= 0 or i >= len(shape.density) - 1:
        return 0.0
    return shape.density[i] + (x - i) * (shape.density[i + 1] - shape.density[i])
