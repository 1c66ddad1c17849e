# SPDX-License-Identifier: Apache-2.0
"""The sparse voxel grid: which points share a voxel, and which voxels touch (26-neighbourhood)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.cells import cell_keys, sorted_keys
from pcgraph.voxels.touching import touching
from pcgraph.voxels.warp import Warp

# Offsets inside a voxel and colours are summed as whole numbers: such sums do not depend on the points'
# order.
_STEPS_PER_VOXEL = float(1 << 20)
_COLOR_STEPS = 65535.0


@dataclass(frozen=True, eq=False)
class VoxelGrid(ShortRepr):
    """Occupied voxels of a cloud in ascending order of grid coordinates, whatever the points' order.

    Attributes
    ----------
    size : float, metres
        Edge length of a voxel in the warped space. The grid is aligned with the origin of that space.
    warp : Warp
        To that space.
    cells : (v, 3) float64
        Grid coordinates, whole numbers.
    voxel_of_point : (n,) int32
        Voxel of each point.
    order : (n,) int64
        Points voxel by voxel, ascending within each.
    starts : (v + 1,) int64
        ``order[starts[i]:starts[i + 1]]`` are the points of voxel i.
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
    warp: Warp
    cells: NDArray[np.float64]
    voxel_of_point: NDArray[np.int32]
    order: NDArray[np.int64]
    starts: NDArray[np.int64]
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
    with np.errstate(over="ignore"):
        scaled = warp.forward(points) / size
    keys, pitch = cell_keys(scaled, size)
    ordered, order = sorted_keys(keys)
    starts = np.concatenate(([0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1, [len(keys)]))
    n_voxels = len(starts) - 1
    voxel_of_point, warped = np.empty(len(points), np.int32), np.empty((n_voxels, 3))
    in_blocks(_gather, n_voxels, starts, order, scaled, voxel_of_point, warped)
    warped *= size
    centroids = warp.backward(warped)
    if colors is not None:
        colors = _sorted_means(colors, starts, order, _COLOR_STEPS)
    indptr, neighbours = touching(ordered[starts[:-1]], *pitch)
    lengths = size * warp.scale(centroids)
    counts = np.diff(starts)
    cells = np.floor(scaled[order[starts[:-1]]])
    members = voxel_of_point, order, starts, counts
    return VoxelGrid(size, warp, cells, *members, warped, centroids, lengths, colors, indptr, neighbours)


def voxel_means(values: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.float64]:
    """Mean of vectors of points, (n, 3), in [-1, 1], per voxel, (v, 3), independent of the points' order."""
    return _sorted_means(values, grid.starts, grid.order, _STEPS_PER_VOXEL)


def _sorted_means(
    values: NDArray[np.float64], starts: NDArray[np.int64], order: NDArray[np.int64], steps: float
) -> NDArray[np.float64]:
    means = np.empty((len(starts) - 1, 3))
    in_blocks(_average, len(means), starts, order, values, steps, means)
    return means


@njit(cache=True, nogil=True)
def _gather(
    start: int,
    stop: int,
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    scaled: NDArray[np.float64],
    voxel_of_point: NDArray[np.int32],
    warped: NDArray[np.float64],
) -> None:
    """Each point learns its voxel, each voxel the mean of its points in units of a voxel."""
    for v in range(start, stop):
        x = y = z = np.int64(0)
        first = order[starts[v]]
        cell_x, cell_y, cell_z = np.floor(scaled[first, 0]), np.floor(scaled[first, 1]), np.floor(scaled[first, 2])
        for at in range(starts[v], starts[v + 1]):
            p = order[at]
            voxel_of_point[p] = v
            x += np.int64(np.rint((scaled[p, 0] - cell_x) * _STEPS_PER_VOXEL))
            y += np.int64(np.rint((scaled[p, 1] - cell_y) * _STEPS_PER_VOXEL))
            z += np.int64(np.rint((scaled[p, 2] - cell_z) * _STEPS_PER_VOXEL))
        total = (starts[v + 1] - starts[v]) * _STEPS_PER_VOXEL
        warped[v, 0], warped[v, 1], warped[v, 2] = cell_x + x / total, cell_y + y / total, cell_z + z / total


@njit(cache=True, nogil=True)
def _average(
    start: int,
    stop: int,
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    values: NDArray[np.float64],
    steps: float,
    means: NDArray[np.float64],
) -> None:
    """Means of vectors by voxel, summed as whole numbers."""
    for v in range(start, stop):
        x = y = z = np.int64(0)
        for at in range(starts[v], starts[v + 1]):
            p = order[at]
            x += np.int64(np.rint(values[p, 0] * steps))
            y += np.int64(np.rint(values[p, 1] * steps))
            z += np.int64(np.rint(values[p, 2] * steps))
        total = max(starts[v + 1] - starts[v], 1) * steps
        means[v, 0], means[v, 1], means[v, 2] = x / total, y / total, z / total
