# SPDX-License-Identifier: Apache-2.0
"""The interface of methods that group voxels."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.surface import LocalPlanes


class SupervoxelMethod(ABC):
    """A method that groups voxels into supervoxels.

    A method is a frozen dataclass of its settings, in a file of its own; `Vccs` is the shortest example. It may use the
    steps in `pcgraph.supervoxels.clustering`.
    """

    @abstractmethod
    def planes(self, grid: VoxelGrid, viewpoints: NDArray[np.float64]) -> LocalPlanes:
        """Plane of each voxel, whose normal points to the viewpoints, (3,) or (v, 3) float64, metres."""

    @abstractmethod
    def supervoxels(
        self, grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, initial: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxel of each voxel, (v,) int32, numbered from 0 without gaps.

        Every voxel has a supervoxel, and every supervoxel is connected in the 26-neighbourhood. Initial supervoxels
        keep their numbers and voxels; others follow in the order of their first voxel.

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
        """Supervoxel of each point, (n,) int32, given those of voxels, (v,) int32: here that of the point's voxel."""
        return supervoxels[grid.voxel_of_point]


def checked_supervoxels(found: NDArray[np.int32], n_voxels: int, method: object) -> NDArray[np.int32]:
    """The supervoxels that a method made of `n_voxels` voxels, (v,) int32, checked.

    Raises
    ------
    ValueError
        They are not one whole number per voxel, 0..k - 1 without gaps.
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
