# SPDX-License-Identifier: Apache-2.0
"""The sparse voxel grid: which points share a voxel, and which voxels touch (26-neighbourhood)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.bounds import bounding_box
from pcgraph.voxels.warp import Warp

# Offsets inside a voxel and colours are summed as whole numbers: such sums do not depend on the points'
# order.
_STEPS_PER_VOXEL = float(1 << 20)
_COLOR_STEPS = 65535.0
_MAX_KEY = float(1 << 62)


@dataclass(frozen=True)
class VoxelGrid:
    """Occupied voxels of a cloud in ascending order of grid coordinates, whatever the points' order.

    Attributes
    ----------
    size : float, metres
        Edge length of a voxel in the warped space. The grid is aligned with the origin of that space.
    voxel_of_point : (n,) int32
        Voxel of each point.
    counts : (v,) int64
        Points per voxel.
    warped : (v, 3) float64, metres of the warped space
        Mean of the voxel's points there, to 2**-21 of a voxel.
    centroids : (v, 3) float64, metres, the points' frame
        The same place in the points' frame.
    edge_lengths : (v,) float64, metres
        Edge length of each voxel in the points' frame; `size` throughout unless a camera warp is in use.
    colors : (v, 3) float64, 0..1, or None
        Mean colour of the voxel's points.
    indptr : (v + 1,) int64
    neighbours : (e,) int32
        ``neighbours[indptr[i]:indptr[i + 1]]`` are the occupied among the 26 voxels around voxel i,
        ascending.
    """

    size: float
    voxel_of_point: NDArray[np.int32]
    counts: NDArray[np.int64]
    warped: NDArray[np.float64]
    centroids: NDArray[np.float64]
    edge_lengths: NDArray[np.float64]
    colors: NDArray[np.float64] | None
    indptr: NDArray[np.int64]
    neighbours: NDArray[np.int32]

    @property
    def n_voxels(self) -> int:
        """Number of occupied voxels."""
        return len(self.counts)


def voxel_grid(points: NDArray[np.float64], colors: NDArray[np.float64] | None, size: float, warp: Warp) -> VoxelGrid:
    """Voxel grid over finite points.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1.
    colors : (n, 3) float64, 0..1, or None
    size : float, metres
        Voxel edge length, > 0.
    warp : Warp
        To the space in which voxels are cubes of this size.

    Raises
    ------
    ValueError
        The cloud spans so many voxels that a grid coordinate cannot be written as a whole number.
    """
    scaled = warp.forward(points) / size
    cells = np.floor(scaled)
    keys, pitch = _keys(cells, size)
    order = np.argsort(keys)
    ordered = keys[order]
    first = np.concatenate(([True], ordered[1:] != ordered[:-1]))
    voxel_of_point = np.empty(len(points), np.int32)
    voxel_of_point[order] = np.cumsum(first, dtype=np.int32) - 1
    unique_keys = ordered[first]
    counts = np.bincount(voxel_of_point)
    offsets = np.rint((scaled - cells) * _STEPS_PER_VOXEL)
    inside = _means(offsets, voxel_of_point, counts) / _STEPS_PER_VOXEL
    warped = (cells[order[first]] + inside) * size
    centroids = warp.backward(warped)
    if colors is not None:
        colors = _means(np.rint(colors * _COLOR_STEPS), voxel_of_point, counts) / _COLOR_STEPS
    indptr, neighbours = _adjacency(unique_keys, *pitch)
    lengths = size * warp.scale(centroids)
    return VoxelGrid(size, voxel_of_point, counts, warped, centroids, lengths, colors, indptr, neighbours)


def sparse_means(
    values: NDArray[np.float64], voxel_of_point: NDArray[np.int32], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Mean of point values in [-1, 1] per voxel, (v, c), independent of the points' order."""
    return _means(np.rint(values * _STEPS_PER_VOXEL), voxel_of_point, counts) / _STEPS_PER_VOXEL


def _means(
    whole: NDArray[np.float64], voxel_of_point: NDArray[np.int32], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    sums = [np.bincount(voxel_of_point, whole[:, axis], len(counts)) for axis in range(whole.shape[1])]
    return np.stack(sums, axis=1) / counts[:, None]


def _keys(cells: NDArray[np.float64], size: float) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """One whole number per point that sorts like (x, y, z), and what a step in x and in y adds to it."""
    low, high = bounding_box(cells)
    if not _fits(high - low):
        cells = np.stack([_without_gaps(cells[:, axis]) for axis in range(3)], axis=1)
        low, high = bounding_box(cells)
        if not _fits(high - low):
            raise ValueError(f"the cloud spans too many voxels of {size:g} m; expected a larger voxel_size")
    # Two spare cells per axis keep a row's end from touching the next row's start.
    extent = (high - low).astype(np.int64) + 3
    whole = (cells - low).astype(np.int64)
    pitch = (int(extent[1] * extent[2]), int(extent[2]))
    return whole[:, 0] * pitch[0] + whole[:, 1] * pitch[1] + whole[:, 2], pitch


def _fits(span: NDArray[np.float64]) -> bool:
    return bool(np.prod(span + 3.0) < _MAX_KEY) and bool(span.max() < _MAX_KEY)


def _without_gaps(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Same order and same touching pairs, but no gap wider than one empty cell."""
    values, inverse = np.unique(cells, return_inverse=True)
    return np.concatenate(([0.0], np.cumsum(np.minimum(np.diff(values), 2.0))))[inverse]


@njit(cache=True)
def _adjacency(keys: NDArray[np.int64], pitch_x: int, pitch_y: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """CSR lists of touching voxels: nine pointers walk the sorted keys, each three voxels of a row wide."""
    n = keys.size
    indptr = np.zeros(n + 1, np.int64)
    neighbours = np.empty(0, np.int32)
    for filling in (False, True):
        pointers = np.zeros(9, np.int64)
        used = 0
        for i in range(n):
            for row in range(9):
                target = keys[i] + (row // 3 - 1) * pitch_x + (row % 3 - 1) * pitch_y - 1
                at = pointers[row]
                while at < n and keys[at] < target:
                    at += 1
                pointers[row] = at
                while at < n and keys[at] <= target + 2:
                    if at != i:
                        if filling:
                            neighbours[used] = at
                        used += 1
                    at += 1
            indptr[i + 1] = used
        if not filling:
            neighbours = np.empty(used, np.int32)
    return indptr, neighbours
