# SPDX-License-Identifier: Apache-2.0
"""Cells of a grid as whole numbers that sort."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks
from pcgraph.voxels.bounds import bounding_box

_MAX_KEY = float(1 << 62)


def cell_keys(scaled: NDArray[np.float64], size: float) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """One whole number per place that sorts like its cell (x, y, z), and what a step in x and in y adds to it.

    Parameters
    ----------
    scaled : (n, 3) float64
        Places in units of a cell; cells are the unit cubes.
    size : float, metres
        Edge length of a cell, for the message.

    Raises
    ------
    ValueError
        The places span so many cells that the numbers do not fit.
    """
    cells = scaled
    low, high = np.floor(bounding_box(scaled))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"the cloud spans too many voxels of {size:g} m; expected a larger voxel_size")
    if not _fits(high - low):
        cells = np.stack([_without_gaps(np.floor(scaled[:, axis])) for axis in range(3)], axis=1)
        low, high = bounding_box(cells)
        if not _fits(high - low):
            raise ValueError(f"the cloud spans too many voxels of {size:g} m; expected a larger voxel_size")
    # Two spare cells per axis keep a row's end from touching the next row's start.
    extent = (high - low).astype(np.int64) + 3
    pitch = (int(extent[1] * extent[2]), int(extent[2]))
    keys = np.empty(len(cells), np.int64)
    in_blocks(_number_cells, len(cells), cells, low, *pitch, keys)
    return keys, pitch


def sorted_keys(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys, none negative, in ascending order, and where each was; equal ones stay in their order.

    Key and place go into one number where they fit, as numbers sort three times faster than their places do.
    """
    bits = int(len(keys) - 1).bit_length()
    if int(keys.max()) >= 1 << (62 - bits):
        order = np.argsort(keys, kind="stable")
        return keys[order], order
    both = (keys << bits) | np.arange(len(keys))
    both.sort()
    return both >> bits, both & ((1 << bits) - 1)


@njit(cache=True, nogil=True)
def _number_cells(
    start: int,
    stop: int,
    cells: NDArray[np.float64],
    low: NDArray[np.float64],
    pitch_x: int,
    pitch_y: int,
    keys: NDArray[np.int64],
) -> None:
    """Keys of cells, given by their coordinates or by places in them."""
    for p in range(start, stop):
        x, y = np.int64(np.floor(cells[p, 0]) - low[0]), np.int64(np.floor(cells[p, 1]) - low[1])
        keys[p] = x * pitch_x + y * pitch_y + np.int64(np.floor(cells[p, 2]) - low[2])


def _fits(span: NDArray[np.float64]) -> bool:
    return bool(span.max() < _MAX_KEY) and bool(np.prod(span + 3.0) < _MAX_KEY)


def _without_gaps(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Same order and same touching pairs, but no gap wider than one empty cell."""
    values, inverse = np.unique(cells, return_inverse=True)
    return np.concatenate(([0.0], np.cumsum(np.minimum(np.diff(values), 2.0))))[inverse]
