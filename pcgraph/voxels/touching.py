# SPDX-License-Identifier: Apache-2.0
"""Which occupied voxels touch."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks

_MOST = 26


def touching(keys: NDArray[np.int64], pitch_x: int, pitch_y: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The 26-neighbourhood of occupied voxels as CSR lists, indptr (v + 1,) and neighbours (e,), ascending.

    Parameters
    ----------
    keys : (v,) int64
        Ascending, x pitch_x + y pitch_y + z of each voxel, with two cells to spare at the end of every row.
    pitch_x, pitch_y : int
        What a step in x and in y adds to a key.
    """
    counts = np.empty(len(keys), np.int64)
    room = np.empty((len(keys), _MOST), np.int32)
    in_blocks(_walk, len(keys), keys, pitch_x, pitch_y, counts, room)
    indptr = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    neighbours = np.empty(indptr[-1], np.int32)
    in_blocks(_pack, len(keys), indptr, room, neighbours)
    return indptr, neighbours


@njit(cache=True, nogil=True)
def _walk(
    start: int,
    stop: int,
    keys: NDArray[np.int64],
    pitch_x: int,
    pitch_y: int,
    counts: NDArray[np.int64],
    room: NDArray[np.int32],
) -> None:
    """The lists, one row each: nine pointers walk the sorted keys, each along one row of three voxels around."""
    n = len(keys)
    pointers = np.empty(9, np.int64)
    shifts = np.empty(9, np.int64)
    for row in range(9):
        shifts[row] = (row // 3 - 1) * pitch_x + (row % 3 - 1) * pitch_y - 1
        pointers[row] = np.searchsorted(keys, keys[start] + shifts[row]) if start < stop else 0
    for i in range(start, stop):
        count = 0
        for row in range(9):
            target = keys[i] + shifts[row]
            at = pointers[row]
            while at < n and keys[at] < target:
                at += 1
            pointers[row] = at
            while at < n and keys[at] <= target + 2:
                if at != i:
                    room[i, count] = at
                    count += 1
                at += 1
        counts[i] = count


@njit(cache=True, nogil=True)
def _pack(
    start: int, stop: int, indptr: NDArray[np.int64], room: NDArray[np.int32], neighbours: NDArray[np.int32]
) -> None:
    """The lists one after the other."""
    for i in range(start, stop):
        first = indptr[i]
        for q in range(indptr[i + 1] - first):
            neighbours[first + q] = room[i, q]
