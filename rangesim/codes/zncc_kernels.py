# SPDX-License-Identifier: Apache-2.0
"""Compiled loops that match the values of pixels with the columns of a stack of patterns."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcgraph.parallel import kernel, summing_routine

LEAST_TURN = 1e-12
"""Least sine squared of the angle between two neighbouring columns, below which they are not told from each other in
double precision."""

TINY = 1e-30
"""Squared length that replaces zero where something is divided by it, in squared units of the frames: far below that of
any pixel, and its inverse is still a float32."""


class Columns(NamedTuple):
    """Columns of a stack of patterns as vectors of K values; those that look alike side by side are one cell.

    vectors : (n, K) float64, value of each frame minus the mean over the frames. directions : (n, K) float64, the same
        of length 1. lobes : (n, 2) int64, first and last cell that look more alike the nearer they are to the cell,
        and one cell more on either side.
    products : (n - 1, 3) float64, dot products of the vectors of two neighbours: of the first with itself, of both, of
        the second with itself.
    edges : (n + 1,) float64, projector pixels, where the cells begin and end.
    """

    vectors: np.ndarray
    directions: np.ndarray
    lobes: np.ndarray
    products: np.ndarray
    edges: np.ndarray


class Matches(NamedTuple):
    """The best and the second best match of each of m pixels.

    cell : (m,) int64, the best cell, or the first of two neighbours between which the best place lies.
    fraction : (m,) float32, 0 to 1, how far the place lies from that cell towards the next one.
    correlation, second : (m,) float32, zero-mean normalised cross-correlation (ZNCC) at the best place, and at the best
        cell outside its lobe; 0 if it is negative, or if there is no such cell.
    apart : (m,) float32, in the unit of the values: distance of the two matches, each at its best gain.
    length : (m,) float32, in the unit of the values: of the vector of the pixel's values minus their mean.
    gain : (m,) float32, in the unit of the values: what a pattern's change from 0 to 1 changes in the pixel.
    turn : (m,) float32, by how much the vector of the patterns changes per projector pixel, without its length.
    """

    cell: np.ndarray
    fraction: np.ndarray
    correlation: np.ndarray
    second: np.ndarray
    apart: np.ndarray
    length: np.ndarray
    gain: np.ndarray
    turn: np.ndarray


@summing_routine
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(len(a)):
        total += np.float64(a[k]) * np.float64(b[k])
    return total


@kernel
def find_lobes(start, stop, directions, lobes):  # type: ignore[no-untyped-def]
    """Write the lobes (n, 2) of cells start to stop, see `Columns`."""
    n = len(directions)
    for c in range(start, stop):
        for side in range(2):
            step, previous, cell = 2 * side - 1, 1.0, c
            while 0 <= cell + step < n:
                alike = _dot(directions[c], directions[cell + step])
                if alike >= previous:
                    break
                previous, cell = alike, cell + step
            lobes[c, side] = min(max(cell + step, 0), n - 1)


@kernel
def match_best(scores, best, values, columns, matches):  # type: ignore[no-untyped-def]
    """Write the best match of each of m pixels, and -2, less than any correlation, over the scores of its lobe.

    scores : (m, n) float32, values times directions. best : (m,) int64, cells of the highest scores; they are moved to
    the highest in double precision, because single precision does not tell neighbours of smooth patterns from each
    other. values : (m, K) float32, of zero mean.
    """
    vectors, directions = columns.vectors, columns.directions
    n, frames = vectors.shape
    for pixel in range(len(values)):
        y, top = values[pixel], best[pixel]
        here = _dot(y, directions[top])
        for step in (-1, 1):
            while 0 <= top + step < n:
                there = _dot(y, directions[top + step])
                if there <= here:
                    break
                top, here = top + step, there
        cell, fraction, explained = top, 0.0, max(here, 0.0) ** 2
        turn = lone_turn = math.inf
        for first in (top - 1, top):
            if first < 0 or first + 1 >= n:
                continue
            pp, pq, qq = columns.products[first]
            yp, yq = _dot(y, vectors[first]), _dot(y, vectors[first + 1])
            determinant = pp * qq - pq * pq
            if determinant < LEAST_TURN * pp * qq:
                continue
            here_turn = determinant / max(0.25 * (pp + 2 * pq + qq), TINY)  # at the middle of the two
            lone_turn = min(lone_turn, here_turn)
            of_p, of_q = yp * qq - yq * pq, yq * pp - yp * pq
            if of_p < 0 or of_q < 0 or of_p + of_q <= 0:
                continue
            by_both = (of_p * yp + of_q * yq) / determinant
            if by_both >= explained:
                cell, fraction, explained, turn = first, of_q / (of_p + of_q), by_both, here_turn
        turn = turn if turn < math.inf else min(lone_turn, 1 / TINY)
        after = min(cell + 1, n - 1)
        length = 0.0
        for k in range(frames):
            place = vectors[cell, k] + fraction * (vectors[after, k] - vectors[cell, k])
            length += place * place
        matches.cell[pixel], matches.fraction[pixel] = cell, fraction
        matches.length[pixel] = max(_dot(y, y), TINY) ** 0.5
        matches.correlation[pixel] = min(explained**0.5 / matches.length[pixel], 1.0)
        matches.gain[pixel], matches.turn[pixel] = explained**0.5 / max(length, TINY) ** 0.5, turn**0.5
        for other in range(columns.lobes[top, 0], columns.lobes[top, 1] + 1):
            scores[pixel, other] = -2.0


@kernel
def match_second(scores, other, columns, matches):  # type: ignore[no-untyped-def]
    """Write the second best match of each of m pixels.

    scores : (m, n) float32, as `match_best` leaves them. other : (m,) int64, cells of the highest of these scores.
    """
    vectors, directions = columns.vectors, columns.directions
    n = len(vectors)
    for pixel in range(len(other)):
        cell, fraction = matches.cell[pixel], np.float64(matches.fraction[pixel])
        rival, across = max(np.float64(scores[pixel, other[pixel]]), 0.0), 0.0
        if rival > 0:
            direction = directions[other[pixel]]
            across = _dot(vectors[cell], direction) * (1 - fraction)
            across += _dot(vectors[min(cell + 1, n - 1)], direction) * fraction
        length, gain = np.float64(matches.length[pixel]), np.float64(matches.gain[pixel])
        explained = (matches.correlation[pixel] * length) ** 2
        matches.second[pixel] = min(rival / length, 1.0)
        matches.apart[pixel] = max(explained + rival * rival - 2 * gain * rival * across, 0.0) ** 0.5
