# SPDX-License-Identifier: Apache-2.0
"""Compiled loop that finds a sequence of coloured stripes along the lines of an image."""

from __future__ import annotations

import math

import numpy as np

from pcgraph.parallel import kernel

UNCERTAIN = -1
"""Word of a pixel on the edge of a stripe; words of colours are numbers from 0 on."""

DARK = -2
"""Word of a pixel without light, across which no stripes are read; see `UNCERTAIN`."""

MAX_STEP_RATIO = 1.2
"""Largest ratio of the widths in the image of a stripe and of the more similar of its two neighbours. Between the edges
of a stripe, places are interpolated, and where two surfaces meet within one they are wrong by up to half of it. Such a
stripe is wider or narrower than both neighbours. In the scene `matte` with stripes of 10 px, 1.2 refuses 74 % of the
places that are off by more than a pixel, and 6 % of the others; 1.1 refuses 79 and 10 %, 1.3 65 and 5 %."""

MAX_EDGE_ERROR_PX = 1.0
"""Largest difference of the widths of two stripes, in pixels of the camera, that may come from their edges alone: each
is known to half a pixel where pixels do not average over their width."""

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
    step, is_bent = np.empty(width, np.float64), np.empty(width, np.bool_)  # projector pixels per pixel; NaN: unknown
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
            step[i] = stripe_px / (edge[i + 1] - edge[i])
        for i in range(n):
            is_alike, neighbours = False, 0
            for k in (i - 1, i + 1):
                if 0 <= k < n and not math.isnan(step[k]):
                    neighbours += 1
                    is_alike |= max(step[i] / step[k], step[k] / step[i]) <= MAX_STEP_RATIO
                    is_alike |= abs(stripe_px / step[i] - stripe_px / step[k]) <= MAX_EDGE_ERROR_PX
            is_bent[i] = not math.isnan(step[i]) and neighbours > 0 and not is_alike
        for i in range(n):
            if stripe[i] < 0 or is_bent[i]:
                continue
            low, high = edge[i], edge[i + 1]
            has_low, has_high = not math.isnan(low), not math.isnan(high)
            if not has_low and not has_high:
                continue
            if has_low and has_high:
                scale = step[i]
            elif has_high and not math.isnan(step[i + 1]) and not is_bent[i + 1]:
                scale = step[i + 1]  # as wide as its neighbour
            elif has_low and not math.isnan(step[i - 1]) and not is_bent[i - 1]:
                scale = step[i - 1]
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
