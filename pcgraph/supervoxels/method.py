# SPDX-License-Identifier: Apache-2.0
"""The interface of methods that group voxels."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from pcgraph.voxelisation.adapted_size import seed_spacing_for
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.surface import LocalPlanes

_MAX_TRIES = 8
"""Count of spacings that are tried for a number of supervoxels: chosen by eye, not varied."""
_NEAR = 0.02
"""Logarithm of the ratio of supervoxels to those asked for at which the search ends, so 2 %: chosen by eye."""


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


def supervoxels_by(
    method: SupervoxelMethod,
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    seed_size: float,
    initial: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Supervoxel of each voxel by a method, (v,) int32; voxels of each size by themselves, equally many edges apart.

    Supervoxels of earlier scans keep their numbers.
    """
    if grid.levels is None:
        return checked_supervoxels(method.supervoxels(grid, normals, seed_size, initial), grid.n_voxels, method)
    found, n_found = np.empty(grid.n_voxels, np.int32), int(initial.max()) + 1
    for of_level, level in grid.of_levels():
        earlier, number = np.unique(initial[of_level], return_inverse=True)
        own = (number - np.count_nonzero(earlier < 0)).astype(np.int32)
        earlier = earlier[earlier >= 0]
        seed = seed_size * (level.size / grid.size)
        labels = method.supervoxels(level, normals[of_level], seed, own)
        labels = checked_supervoxels(labels, level.n_voxels, method)
        n_new = int(labels.max()) + 1 - len(earlier)
        found[of_level] = np.concatenate((earlier, n_found + np.arange(n_new)))[labels]
        n_found += n_new
    return found


def seed_size_for(n_supervoxels: int, grid: VoxelGrid, normals: NDArray[np.float64], method: SupervoxelMethod) -> float:
    """Spacing of supervoxels, metres, that makes about so many: the best of a few that come ever nearer.

    Their number jumps where cells of seeds come to lie otherwise on walls. Then the middle of the interval is next.
    """
    seed, best, least_off = seed_spacing_for(n_supervoxels, grid), grid.size, math.inf
    more, fewer = grid.size, math.inf  # spacings that give more, and fewer
    for _ in range(_MAX_TRIES):
        seed = max(seed, grid.size)
        n = int(supervoxels_by(method, grid, normals, seed, np.full(grid.n_voxels, -1, np.int32)).max()) + 1
        off = abs(math.log(n / n_supervoxels))
        if off < least_off:
            best, least_off = seed, off
        if off <= _NEAR or (n < n_supervoxels and seed == grid.size):
            break
        more, fewer = (max(more, seed), fewer) if n > n_supervoxels else (more, min(fewer, seed))
        seed *= math.sqrt(n / n_supervoxels)
        if fewer < math.inf and not more < seed < fewer:
            seed = math.sqrt(more * fewer)
    return best
