# SPDX-License-Identifier: Apache-2.0
"""Boundaries to within a point: points on a rim go to the surface on whose plane they lie."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.planes import LocalPlanes

_PLACE_WEIGHT = 0.3  # of a metre along the surface against one off the plane


def settle_points(
    points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Supervoxel of each point, (n,) int32: its voxel's or one that touches its voxel.

    A point p takes the supervoxel of the voxel i, its own or one around it, with the least
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
    lists = grid.indptr, grid.neighbours
    rim = np.empty(grid.n_voxels, np.bool_)
    in_blocks(_find_rims, grid.n_voxels, *lists, supervoxels, rim)
    surface = grid.centroids, planes.normals, planes.origins
    in_blocks(_settle, len(points), points, grid.voxel_of_point, rim, *lists, *surface, supervoxels, chosen)
    _keep_every_voxel(grid.voxel_of_point, supervoxels, chosen)
    return chosen


@njit(cache=True, nogil=True)
def _find_rims(
    start: int,
    stop: int,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    supervoxels: NDArray[np.int32],
    rim: NDArray[np.bool_],
) -> None:
    """Which voxels touch another supervoxel."""
    for i in range(start, stop):
        rim[i] = False
        for a in range(indptr[i], indptr[i + 1]):
            if supervoxels[neighbours[a]] != supervoxels[i]:
                rim[i] = True
                break


@njit(cache=True, nogil=True)
def _settle(
    start: int,
    stop: int,
    points: NDArray[np.float64],
    voxel_of_point: NDArray[np.int32],
    rim: NDArray[np.bool_],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    centroids: NDArray[np.float64],
    normals: NDArray[np.float64],
    origins: NDArray[np.float64],
    supervoxels: NDArray[np.int32],
    chosen: NDArray[np.int32],
) -> None:
    """The supervoxel of the voxel on whose plane, and near which, each point lies; of equals its own voxel's."""
    weight = _PLACE_WEIGHT * _PLACE_WEIGHT
    for p in range(start, stop):
        v = voxel_of_point[p]
        chosen[p] = supervoxels[v]
        if not rim[v]:
            continue
        least = np.inf
        for a in range(indptr[v] - 1, indptr[v + 1]):
            i = v if a < indptr[v] else neighbours[a]
            x, y, z = points[p, 0] - centroids[i, 0], points[p, 1] - centroids[i, 1], points[p, 2] - centroids[i, 2]
            off = (
                normals[i, 0] * (points[p, 0] - origins[i, 0])
                + normals[i, 1] * (points[p, 1] - origins[i, 1])
                + normals[i, 2] * (points[p, 2] - origins[i, 2])
            )
            cost = off * off + weight * (x * x + y * y + z * z)
            if cost < least:
                least, chosen[p] = cost, supervoxels[i]


@njit(cache=True, nogil=True)
def _keep_every_voxel(
    voxel_of_point: NDArray[np.int32], supervoxels: NDArray[np.int32], chosen: NDArray[np.int32]
) -> None:
    """Nothing; points of voxels that none of them chose go back to their voxel's supervoxel."""
    kept = np.zeros(len(supervoxels), np.bool_)
    for p in range(len(chosen)):
        if chosen[p] == supervoxels[voxel_of_point[p]]:
            kept[voxel_of_point[p]] = True
    for p in range(len(chosen)):
        if not kept[voxel_of_point[p]]:
            chosen[p] = supervoxels[voxel_of_point[p]]
