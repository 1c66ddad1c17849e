# SPDX-License-Identifier: Apache-2.0
"""Where supervoxels start."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.grid import VoxelGrid, cell_keys


def seed_voxels(grid: VoxelGrid, seed_size: float) -> NDArray[np.int32]:
    """Voxels from which supervoxels grow, (k,) int32, ascending; perhaps none.

    In each seed cell with enough voxels for a surface, it is the voxel nearest to the mean of the cell's voxels,
    of equals the first.

    Parameters
    ----------
    grid : VoxelGrid
    seed_size : float, metres
        Their R_seed: edge length of the seed cells.

    Notes
    -----
    Source: Papon et al. 2013, section 3.2. Parts of the surface that hold no seed are left to `grow`.
    """
    keys, _ = cell_keys(grid.warped / seed_size, seed_size)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.concatenate(([0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1, [len(keys)]))
    ratio = seed_size / grid.size  # a cell counts if it holds a tenth of a plane, or half of a line
    return np.sort(_nearest_to_mean(grid.warped, order, starts, min(0.1 * ratio**2, 0.5 * ratio)))


@njit(cache=True, nogil=True)
def _nearest_to_mean(
    places: NDArray[np.float64], order: NDArray[np.int64], starts: NDArray[np.int64], enough: float
) -> NDArray[np.int32]:
    seeds = np.empty(len(starts) - 1, np.int32)
    used = 0
    for cell in range(len(starts) - 1):
        start, stop = starts[cell], starts[cell + 1]
        if stop - start < enough:
            continue
        x = y = z = 0.0
        for at in range(start, stop):
            i = order[at]
            x, y, z = x + places[i, 0], y + places[i, 1], z + places[i, 2]
        x, y, z = x / (stop - start), y / (stop - start), z / (stop - start)
        least = np.inf
        for at in range(start, stop):
            i = order[at]
            away = (places[i, 0] - x) ** 2 + (places[i, 1] - y) ** 2 + (places[i, 2] - z) ** 2
            if away < least:
                seeds[used], least = i, away
        used += 1
    return seeds[:used]
