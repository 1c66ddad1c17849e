# SPDX-License-Identifier: Apache-2.0
"""The surface as its voxels sample it: what remains of a cloud once its points are labelled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.grid import VoxelGrid


@dataclass(frozen=True, eq=False)
class Surface(ShortRepr):
    """Occupied voxels with their normals and supervoxels.

    Attributes
    ----------
    grid : VoxelGrid of v voxels
        Centroids, colours, counts, edge lengths, and which voxels touch.
    normals : (v, 3) float64
        Unit normals on the viewpoint's side.
    supervoxels : (v,) int32
        Supervoxel of each voxel.
    """

    grid: VoxelGrid
    normals: NDArray[np.float64]
    supervoxels: NDArray[np.int32]

    def mean_normals(self, n_supervoxels: int) -> NDArray[np.float64]:
        """Mean normal of each supervoxel's voxels, weighted by their points, (n_supervoxels, 3) float64."""
        weights = self.grid.counts.astype(np.float64)
        total = np.bincount(self.supervoxels, weights, n_supervoxels)
        sums = [np.bincount(self.supervoxels, weights * self.normals[:, axis], n_supervoxels) for axis in range(3)]
        return np.stack(sums, axis=1) / total[:, None]
