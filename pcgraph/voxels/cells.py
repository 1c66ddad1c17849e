# SPDX-License-Identifier: Apache-2.0
"""Keys of the cells of a cubic grid: whole numbers that sort like the cells, which brings points of a cell together."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine

_MAX_KEY = float(1 << 62)
_DIGIT_BITS = 12
"""Bits per digit of the radix sort, at most: with less it takes more rounds, with more larger tables; chosen by eye."""
_SHORT = 1 << 14
"""Numbers of a short list, whose sort has smaller tables, as filling them takes most of its time; chosen by eye."""
_DIGIT_BITS_OF_SHORT = 8
"""Bits of a digit when a short list is sorted, at most; chosen by eye."""
_KEY_BITS = 63
"""Count of bits of a key, because an int64 has one more for the sign."""
_BATCH = 1024
"""Points that are fetched together, about, 24 kB of coordinates; chosen by eye, for speed."""
_MIN_BLOCK = 1 << 16
"""Points for a thread of its own, at least: its start takes longer than to look through fewer; chosen by eye."""


def bounding_box(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinates, (3,) each, of points (n, 3), n >= 1; NaN if one is."""
    of_blocks = in_blocks(_bounds, len(points), np.ascontiguousarray(points, np.float64), smallest=_MIN_BLOCK)
    bounds = np.array(of_blocks)
    return bounds[:, :3].min(axis=0), bounds[:, 3:].max(axis=0)


@kernel
def _bounds(start: int, stop: int, points: NDArray[np.float64]) -> tuple[float, float, float, float, float, float]:
    """Lowest and highest coordinates of some of the points."""
    low_x, low_y, low_z = points[start, 0], points[start, 1], points[start, 2]
    high_x, high_y, high_z = low_x, low_y, low_z
    for p in range(start, stop):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        low_x, low_y, low_z = x if x < low_x else low_x, y if y < low_y else low_y, z if z < low_z else low_z
        high_x, high_y, high_z = x if x > high_x else high_x, y if y > high_y else high_y, z if z > high_z else high_z
        if math.isnan(x + y + z) and (math.isnan(x) or math.isnan(y) or math.isnan(z)):
            return math.nan, math.nan, math.nan, math.nan, math.nan, math.nan
    return low_x, low_y, low_z, high_x, high_y, high_z


class Lattice(NamedTuple):
    """A lattice of cubic cells: along each axis, a place lies (place - corner) / edge cells off its corner.

    Kernels compute that anew where they need it. That takes less time than to read it from memory.

    Attributes
    ----------
    corner : (3,) float64
    edge : float
        Edge length of a cell, in the unit of the corner.
    """

    corner: NDArray[np.float64]
    edge: float

    def in_cells(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places, (n, 3), in cell edges from the corner; infinite if that overflows."""
        counted = np.empty((len(places), 3))
        in_blocks(_count_from, len(places), places, *self, counted)
        return counted


UNIT_CELLS = Lattice(np.zeros(3), 1.0)
"""The lattice of places that are in cell edges already."""


def cell_keys(
    places: NDArray[np.float64], size: float, spare: int = 2, rooms: int = 1, lattice: Lattice = UNIT_CELLS
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """A key per place, a whole number that sorts like its cell (x, y, z), and what a step in x and in y adds to it.

    Parameters
    ----------
    places : (n, 3) float64
        On the lattice, n >= 1.
    size : float, metres
        Edge length of a cell, for the message of the error.
    spare : int, >= 2
        Unused cells at the end of every row, so that a cell up to so many steps beyond a row's end is not taken for one
        of the next row.
    rooms : int
        Number of such sets of keys that have to fit into int64, side by side.
    lattice : Lattice
        Default: places are in cell edges.

    Raises
    ------
    ValueError
        The places span so many cells that the numbers do not fit.
    """
    with np.errstate(over="ignore"):
        low, high = (np.floor((end - lattice.corner) / lattice.edge) for end in bounding_box(places))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"the cloud spans too many voxels of {size:g} m; expected a larger voxel_size")
    if not _fits(high - low, spare, rooms):
        cells = np.floor(lattice.in_cells(places))
        places, lattice = np.stack([_without_gaps(along) for along in cells.T], axis=1), UNIT_CELLS
        low, high = bounding_box(places)
        if not _fits(high - low, spare, rooms):
            raise ValueError(f"the cloud spans too many voxels of {size:g} m; expected a larger voxel_size")
    extent = (high - low).astype(np.int64) + 1 + spare
    pitch = (int(extent[1] * extent[2]), int(extent[2]))
    keys = np.empty(len(places), np.int64)
    in_blocks(_number_cells, len(places), places, *lattice, low, pitch, keys)
    return keys, pitch


def sorted_keys(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys, none negative, in ascending order, and where each was; equal keys stay in their order.

    `keys` is overwritten. This is a radix sort, digit by digit from the last. As keys span few bits, it is four to
    seven times as fast as comparing them.
    """
    place_bits, key_bits = len(keys).bit_length(), int(keys.max()).bit_length()
    low_bits = _KEY_BITS - place_bits
    if key_bits <= low_bits:
        n_digits = max(-(-key_bits // (_DIGIT_BITS if len(keys) > _SHORT else _DIGIT_BITS_OF_SHORT)), 1)
        digit_bits = max(-(-key_bits // n_digits), 1)
        room = np.empty(len(keys), np.int64)  # not in the kernel: NumPy asks for huge pages
        return _sort_by_digits(keys, room, np.zeros((n_digits, 1 << digit_bits), np.int64), place_bits, digit_bits)
    order = sorted_keys(keys & ((1 << low_bits) - 1))[1]
    order = order[sorted_keys(keys[order] >> low_bits)[1]]
    return keys[order], order


def starts_of_runs(ordered: NDArray[np.int64]) -> NDArray[np.int64]:
    """Starts of the m runs of equal keys, and the end of the last, (m + 1,), of keys (n,), n >= 1."""
    return np.concatenate(([0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1, [len(ordered)]))


@routine
def gallop(keys: NDArray[np.int64], at: int, key: int) -> int:
    """The first index from `at` on of a key that is not below `key`; keys ascend. By steps that double, then halve."""
    n, step = len(keys), 1
    while at + step < n and keys[at + step] < key:
        at += step
        step *= 2
    while step > 0:
        if at + step < n and keys[at + step] < key:
            at += step
        step //= 2
    return at + 1 if at < n and keys[at] < key else at


@routine
def fetch_batch(
    values: NDArray[np.float64],
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    first: int,
    stop: int,
    rows: NDArray[np.float64],
) -> tuple[int, NDArray[np.float64]]:
    """End of a batch of voxels that starts with `first`, and an array whose first rows are the values of its points.

    ``order[starts[i]:starts[i + 1]]`` are the points of voxel i. A batch has about a thousand points, or is one voxel.
    Rows far apart in memory are fetched together, in half of the time that it takes one by one amid other work. They
    go into `rows` if they fit.
    """
    last = first
    while last < stop and starts[last] - starts[first] < _BATCH:
        last += 1
    count = starts[last] - starts[first]
    if count > len(rows):
        rows = np.empty((2 * max(count, _BATCH), 3))
    for m in range(count):
        p = order[starts[first] + m]
        rows[m, 0], rows[m, 1], rows[m, 2] = values[p, 0], values[p, 1], values[p, 2]
    return last, rows


@kernel
def _sort_by_digits(
    keys: NDArray[np.int64], room: NDArray[np.int64], starts: NDArray[np.int64], place_bits: int, digit_bits: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys in ascending order, and where each was (radix sort; Knuth, The Art of Computer Programming 3, 5.2.5).

    A key and its index, of `place_bits` bits, are moved as one number, to and fro between `keys` and `room`. `starts`,
    zero at first, has a row for each digit and a column for each of its values.
    """
    n, n_digits, mask = len(keys), len(starts), (1 << digit_bits) - 1
    for i in range(n):
        for digit in range(n_digits):
            starts[digit, (keys[i] >> (digit * digit_bits)) & mask] += 1
        keys[i] = keys[i] << place_bits | i
    ordered = keys
    for digit in range(n_digits):
        start, shift = starts[digit], place_bits + digit * digit_bits
        if start[(ordered[0] >> shift) & mask] == n:
            continue  # all have the same
        total = 0
        for value in range(len(start)):
            start[value], total = total, total + start[value]
        for i in range(n):
            value = (ordered[i] >> shift) & mask
            at = start[value]
            start[value] = at + 1
            room[at] = ordered[i]
        ordered, room = room, ordered
    order = room
    for i in range(n):
        order[i] = ordered[i] & ((1 << place_bits) - 1)
        ordered[i] >>= place_bits
    return ordered, order


@kernel
def _count_from(
    start: int,
    stop: int,
    places: NDArray[np.float64],
    corner: NDArray[np.float64],
    edge: float,
    counted: NDArray[np.float64],
) -> None:
    """Set `counted`: places in cell edges from the corner."""
    for p in range(start, stop):
        for axis in range(3):
            counted[p, axis] = (places[p, axis] - corner[axis]) / edge


@kernel
def _number_cells(
    start: int,
    stop: int,
    places: NDArray[np.float64],
    corner: NDArray[np.float64],
    edge: float,
    low: NDArray[np.float64],
    pitch: tuple[int, int],
    keys: NDArray[np.int64],
) -> None:
    """Set the keys of the places' cells, which are counted from the lowest cell."""
    for p in range(start, stop):
        x = np.int64(np.floor((places[p, 0] - corner[0]) / edge) - low[0])
        y = np.int64(np.floor((places[p, 1] - corner[1]) / edge) - low[1])
        keys[p] = x * pitch[0] + y * pitch[1] + np.int64(np.floor((places[p, 2] - corner[2]) / edge) - low[2])


def _fits(span: NDArray[np.float64], spare: int, rooms: int) -> bool:
    """Whether so many cells along each axis, spare ones included, have numbers that fit into int64, in so many sets."""
    return bool(span.max() < _MAX_KEY) and bool(rooms * np.prod(span + 1.0 + spare) < _MAX_KEY)


def _without_gaps(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Numbers of cells along an axis, (n,), with the same order and the same touching pairs, but without wide gaps."""
    values, inverse = np.unique(cells, return_inverse=True)
    return np.concatenate(([0.0], np.cumsum(np.minimum(np.diff(values), 2.0))))[inverse]
