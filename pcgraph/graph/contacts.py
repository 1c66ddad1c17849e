# SPDX-License-Identifier: Apache-2.0
"""Contacts: where two supervoxels touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.grid import VoxelGrid

_MOST_OWNERS = 26


@dataclass(frozen=True, eq=False)
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
    voxel, other, pair, keys = _rims(grid.indptr, grid.neighbours, supervoxels)
    order = np.argsort(keys)
    edge_of_pair = np.empty(len(keys), np.int64)
    edge_of_pair[order] = np.arange(len(keys))
    edges = np.stack((keys[order] >> 32, keys[order] & 0xFFFFFFFF), axis=1).astype(np.int32)
    side = supervoxels[voxel] > other
    voxels, positions, directions, lengths = _rim_means(
        voxel, edge_of_pair[pair], side.view(np.uint8), grid.centroids, normals, grid.edge_lengths, len(keys)
    )
    return Contacts(edges, voxels, positions, directions, lengths)


@njit(cache=True, nogil=True)
def _rims(  # type: ignore[no-untyped-def]
    indptr: NDArray[np.int64], neighbours: NDArray[np.int32], supervoxels: NDArray[np.int32]
):
    """Each voxel on a rim, once per other supervoxel that it touches: voxel, other, pair; and the pairs' keys.

    Pairs are numbered as they come up; their key is (smaller << 32) + larger.
    """
    voxel, other = np.empty(len(neighbours), np.int32), np.empty(len(neighbours), np.int32)
    pair = np.empty(len(neighbours), np.int32)
    keys, slots = np.empty(512, np.int64), np.full(2048, -1, np.int32)
    seen = np.empty(_MOST_OWNERS + 1, np.int32)
    used = n_keys = 0
    for i in range(len(supervoxels)):
        own = last = supervoxels[i]
        n_seen = 0
        for a in range(indptr[i], indptr[i + 1]):  # without a branch, which would often be guessed wrongly
            seen[n_seen] = supervoxels[neighbours[a]]
            n_seen += (seen[n_seen] != own) & (seen[n_seen] != last)
            last = supervoxels[neighbours[a]]
        for b in range(n_seen):
            for known in range(b):
                if seen[known] == seen[b]:
                    break
            else:
                if n_keys == len(keys):
                    keys, slots = _grown(keys)
                key = (np.int64(min(seen[b], own)) << 32) + np.int64(max(seen[b], own))
                slot = _slot(key, keys, slots)
                if slots[slot] < 0:
                    slots[slot], keys[n_keys] = n_keys, key
                    n_keys += 1
                voxel[used], other[used], pair[used] = i, seen[b], slots[slot]
                used += 1
    return voxel[:used].copy(), other[:used].copy(), pair[:used].copy(), keys[:n_keys].copy()


@njit(cache=True, nogil=True)
def _slot(key: int, keys: NDArray[np.int64], slots: NDArray[np.int32]) -> int:
    """Place of a key in the hash table, or the empty place where it belongs."""
    mask = len(slots) - 1
    at = ((key * 0x9E3779B97F4A7C1) >> 32) & mask
    while slots[at] >= 0 and keys[slots[at]] != key:
        at = (at + 1) & mask
    return at


@njit(cache=True, nogil=True)
def _grown(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The same keys with room for as many again, and their hash table, a quarter full."""
    wide, slots = np.empty(2 * len(keys), np.int64), np.full(8 * len(keys), -1, np.int32)
    for number in range(len(keys)):
        wide[number] = keys[number]
        slots[_slot(keys[number], wide, slots)] = number
    return wide, slots


@njit(cache=True, nogil=True)
def _rim_means(voxel, edge, side, centroids, normals, edge_lengths, m):  # type: ignore[no-untyped-def]
    """Voxels (m, 2), mean positions and unit mean normals (m, 2, 3), and lengths (m,) of both rims of m edges."""
    voxels, lengths = np.zeros((m, 2), np.int64), np.zeros(m)
    positions, directions = np.zeros((m, 2, 3)), np.zeros((m, 2, 3))
    for row in range(len(voxel)):
        i, e, s = voxel[row], edge[row], side[row]
        voxels[e, s] += 1
        lengths[e] += 0.5 * edge_lengths[i]
        for axis in range(3):
            positions[e, s, axis] += centroids[i, axis]
            directions[e, s, axis] += normals[i, axis]
    for e in range(m):
        for s in range(2):
            squares = directions[e, s, 0] ** 2 + directions[e, s, 1] ** 2 + directions[e, s, 2] ** 2
            for axis in range(3):
                positions[e, s, axis] /= voxels[e, s]
                directions[e, s, axis] /= max(np.sqrt(squares), 1e-12)
    return voxels, positions, directions, lengths
