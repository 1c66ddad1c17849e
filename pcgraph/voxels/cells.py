# SPDX-License-Identifier: Apache-2.0
"""Cells of a cubic grid as whole numbers that sort: how points are brought to those beside them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine

_MAX_KEY = float(1 << 62)
_DIGIT, _DIGIT_OF_FEW = 12, 8  # bits, at most, as more digits take more rounds, and their tables time to fill;
_FEW = 1 << 14  # of so many numbers and fewer
_BITS = 63  # of a number that is not negative
_AT_ONCE = 1024  # points, about
_POINTS_OF_BLOCK = 1 << 16  # that are looked through in less time than it takes to start a thread


def bounding_box(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinates, (3,) each, of points (n, 3), n >= 1; NaN if one is."""
    of_blocks = in_blocks(_bounds, len(points), np.ascontiguousarray(points, np.float64), smallest=_POINTS_OF_BLOCK)
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
    """A lattice of cubic cells: a place lies (place - corner) / edge cells off its corner, along each axis.

    Kernels compute that where they need it, as it takes less time than to read it again.

    Attributes
    ----------
    corner : (3,) float64
    edge : float
    """

    corner: NDArray[np.float64]
    edge: float

    def in_cells(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places, (n, 3), in edges of cells off the corner; infinite beyond all numbers."""
        counted = np.empty((len(places), 3))
        in_blocks(_count_from, len(places), places, *self, counted)
        return counted


UNIT_CELLS = Lattice(np.zeros(3), 1.0)
"""That of places which are in edges of cells already."""


def cell_keys(
    places: NDArray[np.float64], size: float, spare: int = 2, rooms: int = 1, lattice: Lattice = UNIT_CELLS
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """One whole number per place that sorts like its cell (x, y, z), and what a step in x and in y adds to it.

    Parameters
    ----------
    places : (n, 3) float64
        On the lattice, n >= 1.
    size : float, metres
        Edge length of a cell, for the message.
    spare : int, >= 2
        Cells to spare at the end of every row: of those that are farther along it or beside it by so many, at most,
        none is taken for one of the next row.
    rooms : int
        How many times as many numbers there have to be.
    lattice : Lattice
        Default: places are in edges of cells.

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
    """Keys, none negative, in ascending order, and where each was; equal ones stay in their order.

    The array that holds them is used up.
    By their digits, the last first: keys span few bits, so this is four to seven times as fast as comparing them.
    """
    place_bits, key_bits = len(keys).bit_length(), int(keys.max()).bit_length()
    low_bits = _BITS - place_bits
    if key_bits <= low_bits:
        n_digits = max(-(-key_bits // (_DIGIT if len(keys) > _FEW else _DIGIT_OF_FEW)), 1)
        room = np.empty(len(keys), np.int64)  # here, as NumPy asks for huge pages and kernels do not
        digit_bits = max(-(-key_bits // n_digits), 1)
        return _sort_by_digits(keys, room, np.zeros((n_digits, 1 << digit_bits), np.int64), place_bits, digit_bits)
    order = sorted_keys(keys & ((1 << low_bits) - 1))[1]
    order = order[sorted_keys(keys[order] >> low_bits)[1]]
    return keys[order], order


def starts_of_runs(ordered: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each of m runs of equal keys starts, and where the last one ends, (m + 1,), of keys (n,), n >= 1."""
    return np.concatenate(([0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1, [len(ordered)]))


@routine
def gallop(keys: NDArray[np.int64], at: int, key: int) -> int:
    """The first place from `at` on of a key not below one, in ascending keys: by steps that double, then halve."""
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
    """Where a batch of voxels ends that starts with the first, and its points' rows, of which it needs the first ones.

    ``order[starts[i]:starts[i + 1]]`` are the points of voxel i; a batch has about a thousand, or is one voxel. Rows
    far apart in memory are fetched side by side, in half the time of one by one amid other work, and into the room of
    those before where they fit.
    """
    last = first
    while last < stop and starts[last] - starts[first] < _AT_ONCE:
        last += 1
    count = starts[last] - starts[first]
    if count > len(rows):
        rows = np.empty((2 * max(count, _AT_ONCE), 3))
    for m in range(count):
        p = order[starts[first] + m]
        rows[m, 0], rows[m, 1], rows[m, 2] = values[p, 0], values[p, 1], values[p, 2]
    return last, rows


@kernel
def _sort_by_digits(
    keys: NDArray[np.int64], room: NDArray[np.int64], starts: NDArray[np.int64], place_bits: int, digit_bits: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys in ascending order, and where each was (radix sort; Knuth, The Art of Computer Programming 3, 5.2.5).

    A key and its place, of so many bits, are moved as one number, to and fro between the array and a room for as many.
    `starts`, zero at first, has a row for each digit and a column for each of its values.
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
    """Set places in edges of cells off the corner."""
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
    """Set the keys of the places' cells, counted from the lowest."""
    for p in range(start, stop):
        x = np.int64(np.floor((places[p, 0] - corner[0]) / edge) - low[0])
        y = np.int64(np.floor((places[p, 1] - corner[1]) / edge) - low[1])
        keys[p] = x * pitch[0] + y * pitch[1] + np.int64(np.floor((places[p, 2] - corner[2]) / edge) - low[2])


def _fits(span: NDArray[np.float64], spare: int, rooms: int) -> bool:
    return bool(span.max() < _MAX_KEY) and bool(rooms * np.prod(span + 1.0 + spare) < _MAX_KEY)


def _without_gaps(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Same order and same touching pairs, but no gap wider than one empty cell."""
    values, inverse = np.unique(cells, return_inverse=True)
    return np.concatenate(([0.0], np.cumsum(np.minimum(np.diff(values), 2.0))))[inverse]
