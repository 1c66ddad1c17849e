# SPDX-License-Identifier: Apache-2.0
"""Connectivity: every supervoxel in one piece."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.supervoxels.distance import Metric, distance, set_means, sum_features
from pcgraph.voxels.grid import VoxelGrid


def connect(
    grid: VoxelGrid, features: NDArray[np.float64], metric: Metric, owner: NDArray[np.int32], known: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Owners such that each one's voxels are connected, (v,) int32, renumbered in the order of their first voxel.

    The known piece of each supervoxel, else its largest, keeps it; voxels of other pieces go, ring by ring, to the
    nearest supervoxel that touches them.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    features : (v, 9) float64
        From `voxel_features`.
    metric : Metric
    owner : (v,) int32, >= 0
        Supervoxels, perhaps in pieces.
    known : (v,) int32
        Supervoxels that exist already, each in one piece, and keep their numbers and voxels; -1 elsewhere.
    """
    n_supervoxels = int(owner.max()) + 1
    lists = grid.indptr, grid.neighbours
    kept = np.where(_largest_pieces(*lists, owner, n_supervoxels, known >= 0), owner, np.int32(-1))
    _adopt(features, metric, *lists, kept, n_supervoxels)
    return _renumber(kept, n_supervoxels, int(known.max()) + 1)


@njit(cache=True, nogil=True)
def _renumber(owner: NDArray[np.int32], n_supervoxels: int, n_known: int) -> NDArray[np.int32]:
    """Owners numbered without gaps in the order of their first voxel."""
    names, numbered = np.full(n_supervoxels, -1, np.int32), np.empty_like(owner)
    for s in range(n_known):
        names[s] = s
    used = n_known
    for i in range(len(owner)):
        if names[owner[i]] < 0:
            names[owner[i]] = used
            used += 1
        numbered[i] = names[owner[i]]
    return numbered


@njit(cache=True, nogil=True)
def _largest_pieces(
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    owner: NDArray[np.int32],
    n_supervoxels: int,
    known: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Whether each voxel lies in its owner's known piece, else in the largest (the first, if several are as large)."""
    n = len(owner)
    piece = np.full(n, -1, np.int32)
    stack = np.empty(n, np.int32)
    sizes = np.zeros(n, np.int64)
    largest = np.full(n_supervoxels, -1, np.int64)
    n_pieces = 0
    for start in range(n):
        if piece[start] >= 0:
            continue
        piece[start] = n_pieces
        stack[0] = start
        depth = 1
        while depth > 0:
            depth -= 1
            i = stack[depth]
            sizes[n_pieces] += n if known[i] else 1  # a known voxel outweighs all others
            for a in range(indptr[i], indptr[i + 1]):
                j = neighbours[a]
                if piece[j] < 0 and owner[j] == owner[i]:
                    piece[j] = n_pieces
                    stack[depth] = j
                    depth += 1
        s = owner[start]
        if largest[s] < 0 or sizes[n_pieces] > sizes[largest[s]]:
            largest[s] = n_pieces
        n_pieces += 1
    inside = np.empty(n, np.bool_)
    for i in range(n):
        inside[i] = piece[i] == largest[owner[i]]
    return inside


@njit(cache=True, nogil=True)
def _adopt(
    features: NDArray[np.float64],
    metric: Metric,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    owner: NDArray[np.int32],
    n_supervoxels: int,
) -> None:
    """Nothing; every voxel with owner -1 gets the nearest owner around it, ring by ring."""
    means = np.zeros((n_supervoxels, 9))
    set_means(sum_features(features, owner, n_supervoxels), means)
    waiting, adopted = np.empty(len(owner), np.int32), np.empty(len(owner), np.int32)
    n_waiting = 0
    for i in range(len(owner)):
        if owner[i] < 0:
            waiting[n_waiting] = i
            n_waiting += 1
    while n_waiting > 0:
        for w in range(n_waiting):
            adopted[w] = _nearest_owner(waiting[w], features, metric, indptr, neighbours, owner, means)
        left = 0
        for w in range(n_waiting):
            if adopted[w] >= 0:
                owner[waiting[w]] = adopted[w]
            else:
                waiting[left] = waiting[w]
                left += 1
        n_waiting = left


@njit(cache=True, nogil=True)
def _nearest_owner(i, features, metric, indptr, neighbours, owner, means):  # type: ignore[no-untyped-def]
    """Owner of a neighbour of voxel i with the least distance to it, the smaller of equals; -1 if there is none."""
    nearest, least = -1, np.inf
    for a in range(indptr[i], indptr[i + 1]):
        s = owner[neighbours[a]]
        if s >= 0:
            d = distance(features, i, means, s, metric)
            if d < least or (d == least and s < nearest):
                nearest, least = s, d
    return nearest
