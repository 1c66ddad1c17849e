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
