# SPDX-License-Identifier: Apache-2.0
"""Where supervoxels start."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.cells import cell_keys, sorted_keys
from pcgraph.voxels.grid import VoxelGrid


def seed_voxels(grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, two_sided: bool) -> NDArray[np.int32]:
    """Voxels from which supervoxels grow, (k,) int32, ascending; perhaps none.

    In each seed cell with enough voxels for a surface, it is the voxel nearest to the mean of the cell's voxels,
    of equals the first. Unless `two_sided`, voxels of the cell that face away from it count as another surface,
    with a seed of its own if they are enough.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals.
    seed_size : float, metres
        Their R_seed: edge length of the seed cells.
    two_sided : bool
        Whether opposite normals are the same.

    Notes
    -----
    Source: Papon et al. 2013, section 3.2. Parts of the surface that hold no seed are left to `grow`.
    """
    keys, _ = cell_keys(grid.warped / seed_size, seed_size)
    ordered, order = sorted_keys(keys)
    starts = np.concatenate(([0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1, [len(keys)]))
    ratio = seed_size / grid.size  # a cell counts if it holds a tenth of a plane, or half of a line
    enough = min(0.1 * ratio * ratio, 0.5 * ratio)
    return np.sort(_seeds_of_cells(grid.warped, normals, order, starts, enough, two_sided))


@njit(cache=True, nogil=True)
def _seeds_of_cells(
    places: NDArray[np.float64],
    normals: NDArray[np.float64],
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    enough: float,
    two_sided: bool,
) -> NDArray[np.int32]:
    """One seed per cell, or two where surfaces face away from each other."""
    seeds = np.empty(2 * (len(starts) - 1), np.int32)
    used = 0
    for cell in range(len(starts) - 1):
        members = order[starts[cell] : starts[cell + 1]]
        if len(members) < enough:
            continue
        seed = _nearest_to_mean(places, members, len(members))
        seeds[used] = seed
        used += 1
        if two_sided:
            continue
        turned = 0
        for at in range(len(members)):  # those that face away come to the front of the list
            i = members[at]
            facing = 0.0
            for axis in range(3):
                facing += normals[i, axis] * normals[seed, axis]
            if facing < 0.0:
                members[turned], members[at] = i, members[turned]
                turned += 1
        if turned > 0 and turned >= enough:
            seeds[used] = _nearest_to_mean(places, members, turned)
            used += 1
    return seeds[:used]


@njit(cache=True, nogil=True)
def _nearest_to_mean(places: NDArray[np.float64], members: NDArray[np.int64], n: int) -> int:
    """Of the first n members the one nearest to their mean, of equals the smallest."""
    x = y = z = 0.0
    for at in range(n):
        i = members[at]
        x, y, z = x + places[i, 0], y + places[i, 1], z + places[i, 2]
    x, y, z = x / n, y / n, z / n
    nearest, least = -1, np.inf
    for at in range(n):
        i = members[at]
        away = (places[i, 0] - x) ** 2 + (places[i, 1] - y) ** 2 + (places[i, 2] - z) ** 2
        if away < least or (away == least and i < nearest):
            nearest, least = i, away
    return nearest
