# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of binary codes: bits of pixels, and how far neighbours lie apart."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcgraph.kernel_cache import cached_njit


class LeastDifference(NamedTuple):
    """Least |pattern - inverse| of a certain bit, in the capture's units: the largest of three terms.

    floor : float32, the same for all pixels.
    relative : float32, factor on the pixel's white - black.
    sigmas : float32, multiple of the standard deviation of the difference.
    variance : (m,) float32, variance of a pixel by its digital number; (0,): it is not known, and the term is left out.
    """

    floor: np.float32
    relative: np.float32
    sigmas: np.float32
    variance: np.ndarray


@cached_njit(nogil=True, error_model="numpy")
def append_bit(pattern, inverse, contrast, least, code, uncertain):  # type: ignore[no-untyped-def]
    """Append a bit to the `code` of each pixel, and to the set of its `uncertain` bits.

    pattern, inverse : (h, w), frames of any number type. contrast : (h, w) float32, white - black.
    least : LeastDifference. code, uncertain : (h, w) int32, changed in place.
    """
    limit = np.empty(contrast.shape[1], np.float32)
    for row in range(len(contrast)):
        for column in range(len(limit)):
            limit[column] = max(least.floor, least.relative * contrast[row, column])
        if len(least.variance):
            for column in range(len(limit)):
                of_pattern = _at(least.variance, pattern[row, column])
                of_inverse = _at(least.variance, inverse[row, column])
                limit[column] = max(limit[column], least.sigmas * math.sqrt(of_pattern + of_inverse))
        for column in range(len(limit)):
            difference = np.float32(pattern[row, column]) - np.float32(inverse[row, column])
            code[row, column] = (code[row, column] << 1) | (difference > 0)
            uncertain[row, column] = (uncertain[row, column] << 1) | (abs(difference) < limit[column])


@cached_njit(nogil=True, error_model="numpy")
def _at(table, number):  # type: ignore[no-untyped-def]
    """Entry of a table for a digital number; beyond its ends, the entry at the end."""
    return table[min(np.uint32(number), np.uint32(len(table) - 1))]


@cached_njit(nogil=True, error_model="numpy")
def middle_of(values):  # type: ignore[no-untyped-def]
    """(h, w) float32, median of the values (k, h, w) float32 of each pixel; of an even number, the upper one."""
    result = np.empty(values.shape[1:], np.float32)
    sorted_values = np.empty(len(values), np.float32)
    for row in range(values.shape[1]):
        for column in range(values.shape[2]):
            for k in range(len(values)):  # insertion sort, because a word has few bits
                value, place = values[k, row, column], k
                while place > 0 and sorted_values[place - 1] > value:
                    sorted_values[place] = sorted_values[place - 1]
                    place -= 1
                sorted_values[place] = value
            result[row, column] = sorted_values[len(values) // 2]
    return result


@cached_njit(nogil=True, error_model="numpy")
def neighbour_keys(word, down, across):  # type: ignore[no-untyped-def]
    """(n,) int64, words of each pixel and of the neighbour `down` rows and `across` columns on, as one number each.

    The first word stands in the upper 32 bits. Pairs of which a pixel has no word are left out.

    word : (h, w) int32, -1 where there is none.
    """
    keys = np.empty(word.size, np.int64)
    n = 0
    for row in range(len(word) - down):
        for column in range(word.shape[1] - across):
            first, second = word[row, column], word[row + down, column + across]
            keys[n] = (np.int64(first) << 32) | np.int64(second)
            n += first >= 0 and second >= 0
    return keys[:n]


@cached_njit(nogil=True, error_model="numpy")
def coarse_step(pairs, cell_of, bits):  # type: ignore[no-untyped-def]
    """Least number of finest bits to leave out so that half of the pairs see the same cell; -1 if below three are left.

    pairs : `rangesim.codes.bit_neighbours.Pairs`. cell_of : (2^bits,) int32, cell of each word.
    """
    same = np.zeros(bits + 1, np.int64)
    for i in range(len(pairs.counts)):
        differing, length = cell_of[pairs.first[i]] ^ cell_of[pairs.second[i]], 0
        while differing:
            differing >>= 1
            length += 1
        same[length] += pairs.counts[i]
    total, found = pairs.counts.sum(), 0
    for step in range(bits - 2):
        found += same[step]
        if found >= 0.5 * total:
            return step
    return -1


@cached_njit(nogil=True, error_model="numpy")
def octaves_nearer(pairs, before, after, step):  # type: ignore[no-untyped-def]
    """Three sums over pairs that compare their distances by two tables of cells.

    They are the number of pairs whose distance is halved or doubled at least, the number of those whose distance is
    halved, and the sum of all changes, in powers of two.

    pairs : `rangesim.codes.bit_neighbours.Pairs`. before, after : (2^b,) int32, cell of each word.
    step : number of finest bits that are left out.
    """
    moved = nearer = 0
    gain = 0.0
    for i in range(len(pairs.counts)):
        first, second = pairs.first[i], pairs.second[i]
        old = max(abs((before[second] >> step) - (before[first] >> step)), 0.5)
        new = max(abs((after[second] >> step) - (after[first] >> step)), 0.5)
        if old != new:
            moved += pairs.counts[i] * (old >= 2 * new or new >= 2 * old)
            nearer += pairs.counts[i] * (old >= 2 * new)
            gain += pairs.counts[i] * math.log2(old / new)
    return moved, nearer, gain
