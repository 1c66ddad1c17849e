# SPDX-License-Identifier: Apache-2.0
"""Which occupied voxels touch."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks


def touching(keys: NDArray[np.int64], pitch_x: int, pitch_y: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The 26-neighbourhood of occupied voxels as CSR lists, indptr (v + 1,) and neighbours (e,), ascending.

    Parameters
    ----------
    keys : (v,) int64
        Ascending, x pitch_x + y pitch_y + z of each voxel, with two cells to spare at the end of every row.
    pitch_x, pitch_y : int
        What a step in x and in y adds to a key.
    """
    indptr = np.zeros(len(keys) + 1, np.int64)
    in_blocks(_walk, len(keys), keys, pitch_x, pitch_y, indptr, np.empty(0, np.int32))
    np.cumsum(indptr, out=indptr)
    neighbours = np.empty(indptr[-1], np.int32)
    in_blocks(_walk, len(keys), keys, pitch_x, pitch_y, indptr, neighbours)
    return indptr, neighbours


@njit(cache=True, nogil=True)
def _walk(
    start: int,
    stop: int,
    keys: NDArray[np.int64],
    pitch_x: int,
    pitch_y: int,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
) -> None:
    """Lengths of the lists if `neighbours` is empty, else the lists: nine pointers walk the sorted keys.

    Each pointer follows one row of three voxels around the voxel at hand.
    """
    n = len(keys)
    pointers = np.empty(9, np.int64)
    for row in range(9):
        shift = (row // 3 - 1) * pitch_x + (row % 3 - 1) * pitch_y - 1
        pointers[row] = np.searchsorted(keys, keys[start] + shift) if start < stop else 0
    for i in range(start, stop):
        used = indptr[i]
        count = 0
        for row in range(9):
            target = keys[i] + (row // 3 - 1) * pitch_x + (row % 3 - 1) * pitch_y - 1
            at = pointers[row]
            while at < n and keys[at] < target:
                at += 1
            pointers[row] = at
            while at < n and keys[at] <= target + 2:
                if at != i:
                    if len(neighbours) > 0:
                        neighbours[used + count] = at
                    count += 1
                at += 1
        if len(neighbours) == 0:
            indptr[i + 1] = count
