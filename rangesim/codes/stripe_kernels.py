# SPDX-License-Identifier: Apache-2.0
"""Compiled loop that finds a sequence of coloured stripes along the lines of an image."""

from __future__ import annotations

import math

import numpy as np

from pcgraph.parallel import kernel

UNCERTAIN, DARK = -1, -2
"""Words of pixels on the edge of a stripe, and of pixels without light."""

CHANCE = 2
"""Number of stripes that are left out where a surface ends beside another one: the first stripe of the other surface
continues the sequence by chance in one of 5 cases, so that three of them do in one of 125."""


@kernel
def decode_lines(  # type: ignore[no-untyped-def]
    start, stop, words, values, table, n_colours, window, stripe_px, coordinate, is_known, counts
):
    """Write coordinates (h, w) and where they are known (h, w) for lines start to stop; count windows per line.

    words : (h, w) int8, colour of each pixel, `UNCERTAIN` or `DARK`. values : (c, h, w) float32, channels, above 0
    where they are on. table : (n_colours ** window,) int32, number of the first stripe of each window; -1: none.
    counts : (h, 2) int64, windows that were looked up and windows that were found.
    """
    width = words.shape[1]
    first, last = np.empty(width, np.int64), np.empty(width, np.int64)  # first and last pixel of each run
    colour, chain = np.empty(width, np.int64), np.empty(width, np.int64)
    uncertain = np.empty(width, np.bool_)
    stripe, edge = np.empty(width, np.int64), np.empty(width + 1, np.float64)
    for y in range(start, stop):
        n, part = 0, 0
        for x in range(width):
            word = words[y, x]
            if word == -2:
                part += 1
            if word < 0:
                continue
            if n > 0 and chain[n - 1] == part and colour[n - 1] == word:
                last[n - 1] = x
            else:
                first[n], last[n], colour[n], chain[n] = x, x, word, part
                n += 1
        stripe[:n] = -1  # -1: not found, -2: windows disagree
        for i in range(n - window + 1):
            if chain[i] != chain[i + window - 1]:
                continue
            number = 0
            for k in range(window):
                number = number * n_colours + colour[i + k]
            counts[y, 0] += 1
            place = table[number]
            if place < 0:
                continue
            counts[y, 1] += 1
            for k in range(window):
                if stripe[i + k] == -1:
                    stripe[i + k] = place + k
                elif stripe[i + k] != place + k:
                    stripe[i + k] = -2
        begin = 0
        while begin < n:
            end = begin + 1
            while stripe[begin] >= 0 and end < n and chain[end] == chain[begin] and stripe[end] == stripe[end - 1] + 1:
                end += 1
            after, before_it = end < n and chain[end] == chain[begin], begin > 0 and chain[begin - 1] == chain[begin]
            for k in range(begin, end):
                is_last, is_first = after and k >= end - CHANCE, before_it and k < begin + CHANCE
                uncertain[k] = is_last or is_first
            begin = end
        for k in range(n):
            if uncertain[k]:
                stripe[k] = -1
        for i in range(n - 1):  # edge[i + 1]: where run i ends and the next stripe of the sequence begins
            edge[i + 1] = math.nan
            if stripe[i] < 0 or stripe[i + 1] != stripe[i] + 1 or chain[i] != chain[i + 1]:
                continue
            total, found = 0.0, 0
            for c in range(len(values)):
                before, after = values[c, y, last[i]], values[c, y, first[i + 1]]
                if (before > 0) == (after > 0):
                    continue
                for x in range(last[i], first[i + 1]):
                    if (values[c, y, x] > 0) != (values[c, y, x + 1] > 0):
                        # The area under the step: exact where pixels average over their width, whatever that is.
                        place = x - 1.0
                        for k in range(x - 1, x + 3):
                            value = values[c, y, k] if first[i] <= k <= last[i + 1] else (1.0 if k <= x else -1.0)
                            if first[i] <= k <= last[i + 1] and before <= 0:
                                value = -value
                            place += 0.5 * (1.0 + min(max(value, -1.0), 1.0))
                        total += place
                        found += 1
                        break
            if found:
                edge[i + 1] = total / found
        edge[0], edge[n] = math.nan, math.nan
        for i in range(n):
            if stripe[i] < 0:
                continue
            low, high = edge[i], edge[i + 1]
            has_low, has_high = not math.isnan(low), not math.isnan(high)
            if not has_low and not has_high:
                continue
            if has_low and has_high:
                scale = stripe_px / (high - low)
            elif has_high and i + 2 <= n and not math.isnan(edge[i + 2]):
                scale = stripe_px / (edge[i + 2] - high)  # as wide as its neighbour
            elif has_low and i > 0 and not math.isnan(edge[i - 1]):
                scale = stripe_px / (low - edge[i - 1])
            else:
                continue
            begin, end = first[i], last[i] + 1
            if has_low:
                begin = max(math.ceil(low - 0.5), 0)
            if has_high:
                end = min(math.ceil(high - 0.5), width)
            for x in range(begin, end):
                place = stripe_px * stripe[i] + (x + 0.5 - low) * scale
                if not has_low:
                    place = stripe_px * (stripe[i] + 1) - (high - x - 0.5) * scale
                # A run with one edge may go on into a stripe of the same colour on another surface.
                beyond = max(stripe_px * stripe[i] - place, place - stripe_px * (stripe[i] + 1))
                if (has_low and has_high) or beyond <= 0.5 * scale:
                    coordinate[y, x] = min(max(place, stripe_px * stripe[i]), stripe_px * (stripe[i] + 1))
                    is_known[y, x] = True
