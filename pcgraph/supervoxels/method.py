# SPDX-License-Identifier: Apache-2.0
"""What a method of grouping voxels has to provide."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.surface import LocalPlanes


class SupervoxelMethod(ABC):
    """How voxels become supervoxels.

    A method is a frozen dataclass of its settings, in a file of its own: `Vccs` is the shortest example. The steps in
    `pcgraph.supervoxels.clustering` may be used or not.
    """

    @abstractmethod
    def planes(self, grid: VoxelGrid, viewpoints: NDArray[np.float64]) -> LocalPlanes:
        """The plane on which each voxel lies, seen from (3,) or (v, 3) float64, metres."""

    @abstractmethod
    def supervoxels(
        self, grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, initial: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxel of each voxel, (v,) int32, numbered from 0 without gaps.

        Every voxel has one, and every supervoxel is connected in the 26-neighbourhood. Initial labels keep their
        numbers and voxels; others follow in the order of their first voxel.

        Parameters
        ----------
        grid : VoxelGrid of v voxels
        normals : (v, 3) float64
            Unit normals.
        seed_size : float, metres
            Spacing of supervoxels, R_seed of Papon et al. 2013.
        initial : (v,) int32
            Supervoxels from an earlier scan, numbered from 0 without gaps; -1 elsewhere.
        """

    def supervoxel_of_point(
        self, points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxel of each point, (n,) int32, given that of each voxel, (v,) int32: that of the point's voxel."""
        return supervoxels[grid.voxel_of_point]


def checked_supervoxels(found: NDArray[np.int32], n_voxels: int, method: object) -> NDArray[np.int32]:
    """The supervoxels that a method made of so many voxels, (v,) int32.

    Raises
    ------
    ValueError
        They are not one whole number per voxel, 0..k - 1, with none left out.
    """
    name = f"{type(method).__name__}.supervoxels"
    labels = np.asarray(found)
    if labels.shape != (n_voxels,) or labels.dtype.kind not in "iu":
        raise ValueError(
            f"expected {name} to return a whole number for each of {n_voxels} voxels, got {labels.shape} {labels.dtype}"
        )
    if labels.min() < 0 or labels.max() >= n_voxels or not np.bincount(labels).all():
        raise ValueError(f"expected {name} to number supervoxels 0..k - 1 without a gap, and to give each voxel one")
    return np.ascontiguousarray(labels, np.int32)
