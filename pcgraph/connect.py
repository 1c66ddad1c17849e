# SPDX-License-Identifier: Apache-2.0
"""Connectivity: every supervoxel in one piece."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.distance import distance, update_means


def connect(
    features: NDArray[np.float64],
    scale: NDArray[np.float64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    owner: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Owners such that each one's voxels are connected, renumbered in the order of their first voxel.

    Parameters
    ----------
    features : (v, 9) float64
        Position, unit normal and colour of each voxel.
    scale : (3,) float64
        Weights of the VCCS distance.
    indptr, neighbours : (v + 1,) int64, (e,) int32
        Touching voxels.
    owner : (v,) int32, >= 0
        Supervoxels, perhaps in pieces.

    Returns
    -------
    (v,) int32
        The largest piece of each supervoxel keeps it; voxels of other pieces go, ring by ring, to the nearest
        supervoxel that touches them.
    """
    kept = np.where(_largest_pieces(indptr, neighbours, owner), owner, np.int32(-1))
    _adopt(features, scale, indptr, neighbours, kept)
    _, first, inverse = np.unique(kept, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[inverse]


@njit(cache=True)
def _largest_pieces(
    indptr: NDArray[np.int64], neighbours: NDArray[np.int32], owner: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Whether each voxel lies in the largest piece of its owner (the first one, if several are as large)."""
    n = len(owner)
    piece = np.full(n, -1, np.int32)
    stack = np.empty(n, np.int32)
    sizes = np.zeros(n, np.int64)
    largest = np.full(owner.max() + 1, -1, np.int64)
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
            sizes[n_pieces] += 1
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


@njit(cache=True)
def _adopt(
    features: NDArray[np.float64],
    scale: NDArray[np.float64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    owner: NDArray[np.int32],
) -> None:
    """Nothing; every voxel with owner -1 gets the nearest owner around it, ring by ring."""
    n_supervoxels = owner.max() + 1
    sums, means = np.zeros((n_supervoxels, 10)), np.zeros((n_supervoxels, 9))
    update_means(features, owner, sums, means)
    waiting = np.flatnonzero(owner < 0)
    while len(waiting) > 0:
        adopted = np.full(len(waiting), -1, np.int32)
        for w in range(len(waiting)):
            i = waiting[w]
            least = np.inf
            for a in range(indptr[i], indptr[i + 1]):
                s = owner[neighbours[a]]
                if s >= 0:
                    d = distance(features, i, means, s, scale)
                    if d < least or (d == least and s < adopted[w]):
                        least, adopted[w] = d, s
        owner[waiting] = adopted
        waiting = waiting[adopted < 0]
