# SPDX-License-Identifier: Apache-2.0
"""The plane on which each voxel lies: of the windows around it, the one that fits best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.windows import fitted_windows

_OWN_BONUS = 0.7  # the window around the voxel itself wins unless another is better by this factor


@dataclass(frozen=True, eq=False)
class LocalPlanes:
    """One plane per voxel.

    Attributes
    ----------
    normals : (v, 3) float64
        Unit normals on the viewpoint's side. Voxels that lie on a line get the normal nearest to the viewpoint,
        lone ones the direction to the viewpoint.
    origins : (v, 3) float64, metres, the points' frame
        A point of each plane: the mean of its window.
    """

    normals: NDArray[np.float64]
    origins: NDArray[np.float64]


def local_planes(grid: VoxelGrid, viewpoints: NDArray[np.float64], reach: int) -> LocalPlanes:
    """The best-fitting plane around each voxel that does not reach over an edge.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    viewpoints : (3,) or (v, 3) float64, metres, the points' frame
        From where each voxel was seen.
    reach : int, >= 0
        Voxels by which the window may lie off its voxel.

    Notes
    -----
    A window is a voxel with two rings of its neighbours. Beside an edge the window around a voxel straddles both
    faces and its normal is a compromise; but some window further in lies on one face alone. So each voxel takes,
    of the windows within `reach`, the one with the least mean squared distance of its own voxels plus the squared
    distance of this voxel to its plane. Its own window counts 0.7 times its mean alone: so on plain and evenly
    curved ground, where all windows are as good, it is preferred, and noise averages out. Source of the idea:
    Kuwahara et al. 1976, for images.
    """
    n, lists = grid.n_voxels, (grid.indptr, grid.neighbours)
    towards = viewpoints - grid.centroids
    moments, normals, residuals = fitted_windows(grid, towards)
    best, costs = np.arange(n, dtype=np.int32), _OWN_BONUS * residuals
    for _ in range(reach):
        held, better = residuals[best], np.empty_like(best)
        in_blocks(_take_best, n, *lists, grid.centroids, moments, normals, held, best, costs, better)
        best = better
    facing, origins = np.empty((n, 3)), np.empty((n, 3))
    in_blocks(_read_off, n, best, normals, moments, towards, facing, origins)
    return LocalPlanes(facing, origins)


@njit(cache=True, nogil=True)
def _take_best(
    start: int,
    stop: int,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    centroids: NDArray[np.float64],
    moments: NDArray[np.float64],
    normals: NDArray[np.float64],
    held: NDArray[np.float64],
    best: NDArray[np.int32],
    costs: NDArray[np.float64],
    better: NDArray[np.int32],
) -> None:
    """The best of the windows that a voxel and its neighbours hold so far, each as this voxel sees it.

    A window's cost is never below its residual (`held`), so on plain ground no plane need be looked at.
    """
    for i in range(start, stop):
        chosen, least = best[i], costs[i]
        for a in range(indptr[i], indptr[i + 1]):
            j = neighbours[a]
            if held[j] >= least:
                continue
            w = best[j]
            away = (
                normals[w, 0] * (centroids[i, 0] - moments[w, 1])
                + normals[w, 1] * (centroids[i, 1] - moments[w, 2])
                + normals[w, 2] * (centroids[i, 2] - moments[w, 3])
            )
            cost = held[j] + away * away
            if cost < least:
                chosen, least = w, cost
        better[i], costs[i] = chosen, least


@njit(cache=True, nogil=True)
def _read_off(
    start: int,
    stop: int,
    best: NDArray[np.int32],
    normals: NDArray[np.float64],
    moments: NDArray[np.float64],
    towards: NDArray[np.float64],
    facing: NDArray[np.float64],
    origins: NDArray[np.float64],
) -> None:
    """Each voxel's plane, its normal on the viewpoint's side."""
    for i in range(start, stop):
        x, y, z = normals[best[i], 0], normals[best[i], 1], normals[best[i], 2]
        sign = -1.0 if x * towards[i, 0] + y * towards[i, 1] + z * towards[i, 2] < 0.0 else 1.0
        facing[i, 0], facing[i, 1], facing[i, 2] = sign * x, sign * y, sign * z
        for axis in range(3):
            origins[i, axis] = moments[best[i], 1 + axis]
