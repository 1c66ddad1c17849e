# SPDX-License-Identifier: Apache-2.0
"""Supervoxels compete for the voxels on their boundaries."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks
from pcgraph.supervoxels.distance import Metric, add_features, distance, set_means, sum_features
from pcgraph.voxels.grid import VoxelGrid

_SWEEPS = 2


def settle_boundaries(
    grid: VoxelGrid,
    features: NDArray[np.float64],
    metric: Metric,
    owner: NDArray[np.int32],
    fixed: NDArray[np.bool_],
) -> None:
    """Nothing; voxels on a boundary have gone over to the nearest supervoxel that touches them, a few times.

    First all voxels on a boundary are looked at, later those next to one that moved. All voxels of a sweep choose
    at once, by the means before it.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    features : (v, 9) float64
        From `voxel_features`.
    metric : Metric
    owner : (v,) int32, >= 0
        Supervoxel of each voxel; overwritten. Pieces may come off.
    fixed : (v,) bool
        Voxels that stay.
    """
    n = int(owner.max()) + 1
    sums, means = sum_features(features, owner, n), np.empty((n, 9))
    queued = fixed.copy()
    active = _boundary(grid.indptr, grid.neighbours, owner)
    active = active[~fixed[active]]
    for _ in range(_SWEEPS):
        set_means(sums, means)
        chosen = np.empty_like(active)
        lists = grid.indptr, grid.neighbours
        in_blocks(_choose, len(active), active, features, metric, *lists, owner, means, chosen)
        active = _move(active, chosen, features, *lists, owner, sums, queued)
        if not len(active):
            return


@njit(cache=True, nogil=True)
def _boundary(indptr: NDArray[np.int64], neighbours: NDArray[np.int32], owner: NDArray[np.int32]) -> NDArray[np.int32]:
    """Voxels that touch another supervoxel, ascending."""
    found = np.empty(len(owner), np.int32)
    used = 0
    for i in range(len(owner)):
        for a in range(indptr[i], indptr[i + 1]):
            if owner[neighbours[a]] != owner[i]:
                found[used] = i
                used += 1
                break
    return found[:used].copy()


@njit(cache=True, nogil=True)
def _choose(
    start: int,
    stop: int,
    active: NDArray[np.int32],
    features: NDArray[np.float64],
    metric: Metric,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    owner: NDArray[np.int32],
    means: NDArray[np.float64],
    chosen: NDArray[np.int32],
) -> None:
    """The nearest of the supervoxels around each active voxel; of equals its own, else the smaller number."""
    for q in range(start, stop):
        i = active[q]
        own = nearest = owner[i]
        least, last = -1.0, own
        for a in range(indptr[i], indptr[i + 1]):
            s = owner[neighbours[a]]
            if s in (own, last, nearest):
                continue
            last = s
            if least < 0.0:
                least = distance(features, i, means, own, metric)
            d = distance(features, i, means, s, metric)
            if d < least or (d == least and nearest != own and s < nearest):
                nearest, least = s, d
        chosen[q] = nearest


@njit(cache=True, nogil=True)
def _move(
    active: NDArray[np.int32],
    chosen: NDArray[np.int32],
    features: NDArray[np.float64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    owner: NDArray[np.int32],
    sums: NDArray[np.float64],
    queued: NDArray[np.bool_],
) -> NDArray[np.int32]:
    """The voxels to look at next: those that moved and those that touch them, but no fixed ones (queued).

    Owners become what was chosen.
    """
    following = np.empty(len(owner), np.int32)
    used = 0
    for q in range(len(active)):
        i = active[q]
        if owner[i] != chosen[q]:
            add_features(features, i, sums, owner[i], -1.0)
            add_features(features, i, sums, chosen[q], 1.0)
            owner[i] = chosen[q]
            for a in range(indptr[i] - 1, indptr[i + 1]):
                j = i if a < indptr[i] else neighbours[a]
                if not queued[j]:
                    queued[j] = True
                    following[used] = j
                    used += 1
    for q in range(used):
        queued[following[q]] = False
    return following[:used].copy()
