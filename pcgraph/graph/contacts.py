# SPDX-License-Identifier: Apache-2.0
"""Contacts: where two supervoxels touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.grid import VoxelGrid

_MOST_OWNERS = 26


@dataclass(frozen=True)
class Contacts:
    """Pairs of touching supervoxels and what their rims look like; m pairs, side 0 is the smaller number.

    Attributes
    ----------
    edges : (m, 2) int32
        Supervoxels, the smaller first, rows in ascending order.
    voxels : (m, 2) int64
        Voxels of each side that touch the other side.
    positions : (m, 2, 3) float64, metres
        Mean centroid of those voxels.
    normals : (m, 2, 3) float64
        Unit mean of their normals (zero if they cancel).
    lengths : (m,) float64, metres
        Sum of those voxels' edge lengths, mean of both sides.
    """

    edges: NDArray[np.int32]
    voxels: NDArray[np.int64]
    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    lengths: NDArray[np.float64]


def contacts(grid: VoxelGrid, normals: NDArray[np.float64], supervoxels: NDArray[np.int32]) -> Contacts:
    """Contacts between supervoxels: one per pair with voxels in each other's 26-neighbourhood.

    Parameters
    ----------
    grid : VoxelGrid
    normals : (v, 3) float64
        Unit normals of the voxels.
    supervoxels : (v,) int32
        Supervoxel of each voxel.
    """
    voxel, other = _rims(grid.indptr, grid.neighbours, supervoxels)
    own = supervoxels[voxel].astype(np.int64)
    low, high = np.minimum(own, other), np.maximum(own, other)
    n = int(supervoxels.max()) + 1
    keys, edge = np.unique(low * n + high, return_inverse=True)
    rim = 2 * edge + (own > other)
    voxels = np.bincount(rim, minlength=2 * len(keys))
    positions = _rim_sums(grid.centroids[voxel], rim, len(keys)) / voxels.reshape(-1, 2, 1)
    sums = _rim_sums(normals[voxel], rim, len(keys))
    length = np.linalg.norm(sums, axis=2, keepdims=True)
    edges = np.stack((keys // n, keys % n), axis=1).astype(np.int32)
    lengths = np.bincount(edge, grid.edge_lengths[voxel], len(keys)) / 2.0
    return Contacts(edges, voxels.reshape(-1, 2), positions, sums / np.maximum(length, 1e-12), lengths)


def _rim_sums(values: NDArray[np.float64], rim: NDArray[np.int64], n_edges: int) -> NDArray[np.float64]:
    sums = [np.bincount(rim, values[:, axis], 2 * n_edges) for axis in range(3)]
    return np.stack(sums, axis=1, dtype=np.float64).reshape(n_edges, 2, 3)


@njit(cache=True)
def _rims(
    indptr: NDArray[np.int64], neighbours: NDArray[np.int32], supervoxels: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Each voxel on a rim, once per other supervoxel that it touches, with that supervoxel."""
    voxel, other = np.empty(len(neighbours), np.int32), np.empty(len(neighbours), np.int64)
    seen = np.empty(_MOST_OWNERS, np.int64)
    used = 0
    for i in range(len(supervoxels)):
        n_seen = 0
        for a in range(indptr[i], indptr[i + 1]):
            s = supervoxels[neighbours[a]]
            if s == supervoxels[i]:
                continue
            for known in range(n_seen):
                if seen[known] == s:
                    break
            else:
                seen[n_seen] = s
                n_seen += 1
                voxel[used], other[used] = i, s
                used += 1
    return voxel[:used].copy(), other[:used].copy()
