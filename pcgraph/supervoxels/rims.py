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
    place, plane, cost = np.empty((3, 27)), np.empty((4, 27)), np.empty(27)
    owner = np.empty(27, np.int32)
    for v in range(start, stop):
        own = supervoxels[v]
        rim = False
        for a in range(indptr[v], indptr[v + 1]):
            rim |= supervoxels[neighbours[a]] != own
        for at in range(starts[v], starts[v + 1]):
            chosen[order[at]] = own
        if not rim:
            continue
        n = 0
        for a in range(indptr[v] - 1, indptr[v + 1]):  # places and planes of the voxels around, about this voxel
            i = v if a < indptr[v] else neighbours[a]
            if i != v and supervoxels[i] == own:
                continue
            plane[3, n], owner[n] = surface[i, 6], supervoxels[i]
            for axis in range(3):
                place[axis, n] = surface[i, axis] - surface[v, axis]
                plane[axis, n] = surface[i, 3 + axis]
                plane[3, n] += plane[axis, n] * place[axis, n]
            n += 1
        stay = 0
        for at in range(starts[v], starts[v + 1]):
            p = order[at]
            x, y, z = points[p, 0] - surface[v, 0], points[p, 1] - surface[v, 1], points[p, 2] - surface[v, 2]
            for i in range(n):
                off = plane[0, i] * x + plane[1, i] * y + plane[2, i] * z - plane[3, i]
                away = (place[0, i] - x) ** 2 + (place[1, i] - y) ** 2 + (place[2, i] - z) ** 2
                cost[i] = off * off + weight * away
            best = 0
            for i in range(1, n):
                if cost[i] < cost[best]:
                    best = i
            chosen[p] = owner[best]
            stay += chosen[p] == own
        if stay == 0:
            for at in range(starts[v], starts[v + 1]):
                chosen[order[at]] = own
