# SPDX-License-Identifier: Apache-2.0
"""Samples of a cloud that do not depend on the order of its points: drawn by hashes of their places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.voxels.cells import bounding_box, sorted_keys, starts_of_runs

BLOCKS = 32
"""Blocks of space along each axis."""

_CROWD = 1 << 16  # points of a crowd, about
_SAMPLE = 1 << 14
_STEPS = 2.0**18  # along the longest side of a cloud's box: rounding of single precision changes few of them
_TIMES = 1.5  # as many, or as few, as were asked for: then steps tell points from each other
_SEED = np.uint64(0x9E3779B97F4A7C15)
_TINY = float(np.finfo(np.float64).tiny)

Bounds = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest coordinates, (3,) each."""


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Whole numbers without a pattern, by one step of a multiplicative hash."""
    spread = values * np.uint64(0xD6E8FEB86659FD93)
    return (spread ^ (spread >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)


_mix = routine(_mixed)  # of one number, for kernels


def sample(points: NDArray[np.float64], bounds: Bounds) -> NDArray[np.float64]:
    """Some 16 000 of a cloud's points, each place once, in an order as good as random, whatever the points' order."""
    chosen = thinned(points, _SAMPLE, bounds)
    return each_place_once(chosen) if len(chosen) else chosen


def each_place_once(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """One point per place, in the order of their hashes: the first are as good as random, yet the points' own."""
    hashes = np.empty(len(points), np.int64)
    in_blocks(_hash, len(points), points, *_lattice(bounding_box(points)), hashes)
    ordered, order = sorted_keys(hashes)
    return points.take(order[starts_of_runs(ordered)[:-1]], axis=0)


def _lattice(bounds: Bounds) -> tuple[NDArray[np.float64], float]:
    """Corner of the box around a cloud, and steps per metre, of which so many fit in it: both move with the cloud, and
    grow with its unit. No steps where there is no such box."""
    low, high = bounds
    with np.errstate(over="ignore", divide="ignore"):
        scale = float(_STEPS / (high - low).max())
    return low, scale if np.isfinite(scale) else 0.0


@routine
def _mixed_in(h: np.uint64, number: np.uint64) -> np.uint64:
    """A hash of what has been hashed so far and one number more."""
    h = (h ^ number) * np.uint64(0xD6E8FEB86659FD93)
    return h ^ (h >> np.uint64(32))


@routine
def _mixed_steps(point: NDArray[np.float64], low: NDArray[np.float64], scale: float) -> np.uint64:
    """A whole number without a pattern, of the steps from a corner at which a point lies."""
    h = _SEED
    for axis in range(3):
        h = _mixed_in(h, np.uint64(np.int64(np.rint((point[axis] - low[axis]) * scale))))
    return _mix(h)


@routine
def _mixed_bits(point: NDArray[np.float64]) -> np.uint64:
    """A whole number without a pattern, of a point's place to the last bit."""
    h = _SEED
    for axis in range(3):
        h = _mixed_in(h, np.float64(point[axis] + 0.0).view(np.uint64))  # makes one zero of the two
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
    """Set a whole number per point, 0 to 2**45 - 1, that depends on its place alone, and is hardly ever another's.

    The first digits are of its place in steps, so that a cloud that is moved, or measured in another unit, has the same
    order, whatever is rounded; the last ones part what lies in one step. Of two places in one step a millionth share a
    hash, and count as one; of others hardly any.
    """
    for p in range(start, stop):
        first, last = _mixed_steps(points[p], low, scale) >> np.uint64(39), _mixed_bits(points[p]) >> np.uint64(44)
        hashes[p] = np.int64((first << np.uint64(20)) | last)


def some_places(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """All points, or of large clouds those in some blocks of space."""
    while len(points) > 2 * _CROWD and len(smaller := some_blocks(points)) < len(points):
        points = smaller
    return points


def some_blocks(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points of as many blocks of space as it takes for a crowd, the blocks by their hashes.

    A block is as likely as it holds points: the crowd is as dense as the cloud, however that lies to the axes.
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
    """Number of the block of space in which each point lies, (n,), and how many points each block holds."""
    block = np.empty(len(points), np.int16)
    return block, sum(in_blocks(_find_block, len(points), points, low, 1.0 / max(edge, _TINY), block))


@kernel
def _find_block(
    start: int, stop: int, points: NDArray[np.float64], low: NDArray[np.float64], scale: float, block: NDArray[np.int16]
) -> NDArray[np.int64]:
    """Set the number of the block of space in which each point lies; how many each block holds."""
    last, counts = BLOCKS - 1, np.zeros(BLOCKS**3, np.int64)
    for p in range(start, stop):
        x = min(int((points[p, 0] - low[0]) * scale), last)
        y = min(int((points[p, 1] - low[1]) * scale), last)
        z = min(int((points[p, 2] - low[2]) * scale), last)
        block[p] = (x * BLOCKS + y) * BLOCKS + z
        counts[block[p]] += 1
    return counts


def order_of_draw(numbers: NDArray[np.uint64], weights: NDArray[np.number]) -> NDArray[np.int64]:
    """Order in which things are drawn, each as likely the next as its weight says, by what their numbers hash to.

    Notes
    -----
    Source: Efraimidis and Spirakis 2006.
    """
    chances = (_mixed(numbers) >> np.uint64(11)) * 2.0**-53 + 2.0**-54  # 0..1, without both
    return np.argsort(-np.log(chances) / weights, kind="stable")


def thinned(points: NDArray[np.float64], number: int, bounds: Bounds) -> NDArray[np.float64]:
    """About so many of some points, those of least hash, or all where they are no more.

    Which these are does not depend on where the cloud lies, or on its unit, unless too many lie in one step of the
    lattice that tells them apart, as beside a stray that lies very far off.
    """
    n = len(points)
    if n <= number:
        return points
    limit, (low, scale) = np.uint64(number / n * 2.0**64), _lattice(bounds)
    chosen = np.concatenate(in_blocks(_thin, n, points, low, scale, limit))
    if not number / _TIMES <= len(chosen) <= number * _TIMES:
        chosen = np.concatenate(in_blocks(_thin, n, points, low, 0.0, limit))
    return points.take(chosen, axis=0)


@kernel
def _thin(
    start: int, stop: int, points: NDArray[np.float64], low: NDArray[np.float64], scale: float, limit: np.uint64
) -> NDArray[np.int64]:
    """Those of some points of which a hash lies below a limit: of their steps or, where there are none, their bits."""
    found, n = np.empty(stop - start + 1, np.int64), np.int64(0)
    for p in range(start, stop):
        found[n] = p
        n += (_mixed_steps(points[p], low, scale) if scale > 0.0 else _mixed_bits(points[p])) < limit
    return found[:n]


def farthest_points(places: NDArray[np.float64], first: int, n: int) -> list[int]:
    """Indices of at most n of k places, (k, 3), by farthest point sampling from the place `first`."""
    chosen, nearest = [first], np.full(len(places), np.inf)
    while len(chosen) < min(n, len(places)):
        ways = places - places[chosen[-1]]
        nearest = np.minimum(nearest, np.sqrt(np.einsum("ij,ij->i", ways, ways)))
        chosen.append(int(np.argmax(nearest)))
    return chosen
