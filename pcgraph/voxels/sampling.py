# SPDX-License-Identifier: Apache-2.0
"""Samples of a cloud that do not depend on the order of its points, as they are drawn by hashes of the coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.rounding import TINY
from pcgraph.voxels.cells import bounding_box, sorted_keys, starts_of_runs

BLOCKS = 32
"""Blocks of space along each axis, so that a block's number fits into an int16; chosen by eye, not varied."""

_CROWD = 1 << 16
"""Points of a crowd, some blocks of a large cloud with all their points, about; chosen by eye, for the time's sake."""
_SAMPLE = 1 << 14
"""Points of a sample, about; chosen by eye, for the time's sake."""
_STEPS = 2.0**18
"""Steps along the longest side of a cloud's box: so coarse that rounding to single precision changes few of them."""
_MAX_OFF = 1.5
"""Ratio of the number of points drawn to that asked for, or its inverse, at most: else steps tell too few apart."""
_SEED = np.uint64(0x9E3779B97F4A7C15)
"""First value of a hash: 2^64 over the golden ratio."""
_MULTIPLIER = np.uint64(0xD6E8FEB86659FD93)
"""Odd factor of the hash, with well mixed bits."""

Bounds = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest coordinates, (3,) each."""


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Hashes of whole numbers, by one step of a multiplicative hash."""
    spread = values * _MULTIPLIER
    return (spread ^ (spread >> np.uint64(32))) * _MULTIPLIER


_mix = routine(_mixed)  # of one number, for kernels


def sample(points: NDArray[np.float64], bounds: Bounds) -> NDArray[np.float64]:
    """Some 16 000 of a cloud's points, without duplicates, in a pseudo-random order that does not depend on theirs."""
    chosen = thinned(points, _SAMPLE, bounds)
    return each_place_once(chosen) if len(chosen) else chosen


def each_place_once(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points without duplicates, in the order of their hashes, so that the first of them are a random sample."""
    hashes = np.empty(len(points), np.int64)
    in_blocks(_hash, len(points), points, *_lattice(bounding_box(points)), hashes)
    ordered, order = sorted_keys(hashes)
    return points.take(order[starts_of_runs(ordered)[:-1]], axis=0)


def _lattice(bounds: Bounds) -> tuple[NDArray[np.float64], float]:
    """Lattice that moves and scales with a cloud: the lowest corner of its box, and steps per metre, of which 2^18 span
    the longest side. 0 steps if the box has no size."""
    low, high = bounds
    with np.errstate(over="ignore", divide="ignore"):
        scale = float(_STEPS / (high - low).max())
    return low, scale if np.isfinite(scale) else 0.0


@routine
def _mixed_in(h: np.uint64, number: np.uint64) -> np.uint64:
    """Hash of a hash and one more number."""
    h = (h ^ number) * _MULTIPLIER
    return h ^ (h >> np.uint64(32))


@routine
def _mixed_steps(point: NDArray[np.float64], low: NDArray[np.float64], scale: float) -> np.uint64:
    """Hash of a point's place in whole steps from a corner."""
    h = _SEED
    for axis in range(3):
        h = _mixed_in(h, np.uint64(np.int64(np.rint((point[axis] - low[axis]) * scale))))
    return _mix(h)


@routine
def _mixed_bits(point: NDArray[np.float64]) -> np.uint64:
    """Hash of a point's place to the last bit."""
    h = _SEED
    for axis in range(3):
        h = _mixed_in(h, np.float64(point[axis] + 0.0).view(np.uint64))  # -0.0 becomes 0.0
    return _mix(h)


@kernel
def _hash(
    start: int,
    stop: int,
    points: NDArray[np.float64],
    low: NDArray[np.float64],
    scale: float,
    hashes: NDArray[np.int64],
) -> None:
    """Set a hash per point, 0 to 2**45 - 1, that depends on its place alone.

    Its high bits are a hash of the place in steps, so that a cloud that is moved, or measured in another unit, has the
    same order in spite of rounding. Its low bits tell points in one step from each other. One in a million pairs in one
    step share a hash, and count as duplicates; of other pairs hardly any.
    """
    for p in range(start, stop):
        first, last = _mixed_steps(points[p], low, scale) >> np.uint64(39), _mixed_bits(points[p]) >> np.uint64(44)
        hashes[p] = np.int64((first << np.uint64(20)) | last)


def some_places(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """All points of a cloud; of a large one those in some blocks of space."""
    while len(points) > 2 * _CROWD and len(smaller := some_blocks(points)) < len(points):
        points = smaller
    return points


def some_blocks(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """All points of some blocks of space, about as many as a crowd has; blocks are drawn by their hashes.

    The chance of a block is in proportion to its points. So the crowd is as dense as the cloud, however that lies to
    the axes.
    """
    low, high = bounding_box(points)
    edge = float((high - low).max()) / BLOCKS
    if not edge > 0.0:
        return points
    block, counts = blocks_of(points, low, edge)
    occupied = np.flatnonzero(counts)
    counts = counts[occupied]
    order = order_of_draw(occupied.astype(np.uint64), counts)
    taken = np.zeros(BLOCKS**3, bool)
    taken[occupied[order]] = np.concatenate(([0], np.cumsum(counts[order])[:-1])) < _CROWD
    return points.take(np.flatnonzero(taken[block]), axis=0)


def blocks_of(
    points: NDArray[np.float64], low: NDArray[np.float64], edge: float
) -> tuple[NDArray[np.int16], NDArray[np.int64]]:
    """Number of the block of space in which each point lies, (n,), and the number of points in each block, (b,).

    `low` is the lowest corner of the first block, `edge` the length of a block.
    """
    block = np.empty(len(points), np.int16)
    return block, sum(in_blocks(_find_block, len(points), points, low, 1.0 / max(edge, TINY), block))


@kernel
def _find_block(
    start: int, stop: int, points: NDArray[np.float64], low: NDArray[np.float64], scale: float, block: NDArray[np.int16]
) -> NDArray[np.int64]:
    """Set the number of the block of space in which each point lies; return the number of points in each block."""
    last, counts = BLOCKS - 1, np.zeros(BLOCKS**3, np.int64)
    for p in range(start, stop):
        x = min(int((points[p, 0] - low[0]) * scale), last)
        y = min(int((points[p, 1] - low[1]) * scale), last)
        z = min(int((points[p, 2] - low[2]) * scale), last)
        block[p] = (x * BLOCKS + y) * BLOCKS + z
        counts[block[p]] += 1
    return counts


def order_of_draw(numbers: NDArray[np.uint64], weights: NDArray[np.number]) -> NDArray[np.int64]:
    """Order of a weighted random draw without replacement, (n,), by the hashes of `numbers`, (n,), as random numbers.

    Notes
    -----
    Source: Efraimidis and Spirakis 2006.
    """
    chances = (_mixed(numbers) >> np.uint64(11)) * 2.0**-53 + 2.0**-54  # between 0 and 1, exclusive
    return np.argsort(-np.log(chances) / weights, kind="stable")


def thinned(points: NDArray[np.float64], number: int, bounds: Bounds) -> NDArray[np.float64]:
    """About `number` of the points: those of the least hashes; all if there are no more.

    The draw does not depend on where the cloud lies, or on its unit. It does if too many points share a step of the
    lattice, because a stray lies very far off: then they are drawn by their bits.
    """
    n = len(points)
    if n <= number:
        return points
    limit, (low, scale) = np.uint64(number / n * 2.0**64), _lattice(bounds)
    chosen = np.concatenate(in_blocks(_thin, n, points, low, scale, limit))
    if not number / _MAX_OFF <= len(chosen) <= number * _MAX_OFF:
        chosen = np.concatenate(in_blocks(_thin, n, points, low, 0.0, limit))
    return points.take(chosen, axis=0)


@kernel
def _thin(
    start: int, stop: int, points: NDArray[np.float64], low: NDArray[np.float64], scale: float, limit: np.uint64
) -> NDArray[np.int64]:
    """Numbers of the points whose hash is below a limit: that of their steps; if `scale` is 0, that of their bits."""
    found, n = np.empty(stop - start + 1, np.int64), np.int64(0)
    for p in range(start, stop):
        found[n] = p
        n += (_mixed_steps(points[p], low, scale) if scale > 0.0 else _mixed_bits(points[p])) < limit
    return found[:n]


def farthest_points(places: NDArray[np.float64], first: int, n: int) -> list[int]:
    """Indices of n of k places, (k, 3), or of all if n > k, by farthest point sampling from the place `first`."""
    chosen, nearest = [first], np.full(len(places), np.inf)
    while len(chosen) < min(n, len(places)):
        ways = places - places[chosen[-1]]
        nearest = np.minimum(nearest, np.sqrt(np.einsum("ij,ij->i", ways, ways)))
        chosen.append(int(np.argmax(nearest)))
    return chosen
