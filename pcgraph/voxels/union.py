# SPDX-License-Identifier: Apache-2.0
"""Two scans of one scene in one voxel grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.voxels.cells import cell_keys
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.touching import touching


@dataclass(frozen=True, eq=False)
class GridUnion:
    """What two grids occupy together.

    Attributes
    ----------
    grid : VoxelGrid of v voxels
        Means weighted by points. Its `voxel_of_point`, `order` and `starts` speak of the second grid's points, its
        `counts` of those of both.
    first, second : (v1,), (v2,) int64
        Where the voxels of either grid went.
    """

    grid: VoxelGrid
    first: NDArray[np.int64]
    second: NDArray[np.int64]


def grid_union(a: VoxelGrid, b: VoxelGrid) -> GridUnion:
    """Union of two grids of the same size and warp.

    Raises
    ------
    ValueError
        One grid has colours and the other has none.
    """
    if (a.colors is None) != (b.colors is None):
        raise ValueError("expected colours with both scans or with neither, got them with one")
    cells = np.vstack((a.cells, b.cells))
    keys, pitch = cell_keys(cells, a.size)
    unique_keys, at, voxel = np.unique(keys, return_index=True, return_inverse=True)
    first, second = voxel[: a.n_voxels], voxel[a.n_voxels :]
    counts = np.zeros(len(unique_keys), np.int64)
    counts[first] += a.counts
    counts[second] += b.counts

    def blend(of_a: NDArray[np.float64], of_b: NDArray[np.float64]) -> NDArray[np.float64]:
        mean = np.zeros((len(counts), 3))
        mean[first] = of_a
        share = (b.counts / counts[second])[:, None]
        mean[second] += share * (of_b - mean[second])
        return mean

    warped = blend(a.warped, b.warped)
    colors = None if a.colors is None or b.colors is None else blend(a.colors, b.colors)
    centroids = a.warp.backward(warped)
    lengths = a.size * a.warp.scale(centroids)
    voxel_of_point = second[b.voxel_of_point].astype(np.int32)
    starts = np.zeros(len(counts) + 1, np.int64)
    starts[second + 1] = b.counts
    members = voxel_of_point, b.order, np.cumsum(starts)
    lists = touching(unique_keys, *pitch)
    grid = VoxelGrid(a.size, a.warp, cells[at], *members, counts, warped, centroids, lengths, colors, *lists)
    return GridUnion(grid, first, second)
