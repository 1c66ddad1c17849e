# SPDX-License-Identifier: Apache-2.0
"""Boundaries to within a point: points on a rim go to the surface on whose plane they lie."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.planes import LocalPlanes

_MOST = 26  # voxels around a voxel
_PLACE_WEIGHT = 0.3  # of a metre along the surface against one off the plane


def settle_points(
    points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Supervoxel of each point, (n,) int32: its voxel's or one that touches its voxel.

    A point p takes the supervoxel of the voxel i, its own or one around it of another supervoxel, with the least
    (n_i . (p - o_i))^2 + (0.3 |p - x_i|)^2, where n_i, o_i is the plane and x_i the centroid of voxel i. Voxels
    that would lose all their points keep them, so every supervoxel stays connected, and none vanishes.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Those in the grid, in its order.
    grid : VoxelGrid of v voxels
    planes : LocalPlanes of v voxels
    supervoxels : (v,) int32
    """
    chosen = np.empty(len(points), np.int32)
    lists = grid.order, grid.starts, grid.indptr, grid.neighbours
    surface = np.empty((grid.n_voxels, 8))  # a voxel's row fills one line of the cache
    surface[:, :3], surface[:, 3:6] = grid.centroids, planes.normals
    surface[:, 6] = np.einsum("ij,ij->i", planes.normals, planes.origins - grid.centroids)
    in_blocks(_settle, grid.n_voxels, points, *lists, surface, supervoxels, chosen)
    return chosen


@njit(cache=True, nogil=True)
def _settle(
    start: int,
    stop: int,
    points: NDArray[np.float64],
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    surface: NDArray[np.float64],
    supervoxels: NDArray[np.int32],
    chosen: NDArray[np.int32],
) -> None:
    """The supervoxel of the voxel on whose plane, and near which, each point lies; of equals its own voxel's."""
    weight = _PLACE_WEIGHT * _PLACE_WEIGHT
    near, owner = np.empty((_MOST, 8)), np.empty(_MOST, np.int32)
    for v in range(start, stop):
        own, n = supervoxels[v], 0
        for a in range(indptr[v], indptr[v + 1]):  # the other surfaces around
            i = neighbours[a]
            if supervoxels[i] != own:
                for column in range(7):
                    near[n, column] = surface[i, column]
                owner[n] = supervoxels[i]
                n += 1
        for at in range(starts[v], starts[v + 1]):
            chosen[order[at]] = own
        if n == 0:
            continue
        stay = 0
        for at in range(starts[v], starts[v + 1]):
            p = order[at]
            x, y, z = points[p, 0] - surface[v, 0], points[p, 1] - surface[v, 1], points[p, 2] - surface[v, 2]
            off = surface[v, 3] * x + surface[v, 4] * y + surface[v, 5] * z - surface[v, 6]
            least = off * off + weight * (x * x + y * y + z * z)
            for i in range(n):
                x, y, z = points[p, 0] - near[i, 0], points[p, 1] - near[i, 1], points[p, 2] - near[i, 2]
                away = weight * (x * x + y * y + z * z)
                if away < least:
                    off = near[i, 3] * x + near[i, 4] * y + near[i, 5] * z - near[i, 6]
                    if off * off + away < least:
                        least, chosen[p] = off * off + away, owner[i]
            stay += chosen[p] == own
        if stay == 0:
            for at in range(starts[v], starts[v + 1]):
                chosen[order[at]] = own
