# SPDX-License-Identifier: Apache-2.0
"""Supervoxels that grow from seeds over touching voxels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.supervoxels.distance import Metric, add_features, distance, set_means, sum_features
from pcgraph.voxels.grid import VoxelGrid


def grow(
    grid: VoxelGrid,
    features: NDArray[np.float64],
    metric: Metric,
    seeds: NDArray[np.int32],
    seed_size: float,
    known: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Supervoxel of each voxel, (v,) int32: what each seed reached first or, early on, is nearer to.

    A connected part of the grid without a seed becomes one supervoxel.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    features : (v, 9) float64
        From `voxel_features`.
    metric : Metric
    seeds : (k,) int32
        Distinct voxels; those that are known are no seeds.
    seed_size : float, metres
        During the first 1.8 seed_size / voxel size sweeps, as in PCL, a voxel may go over to a nearer supervoxel.
    known : (v,) int32
        Supervoxels that exist already and keep their voxels, but may grow; -1 elsewhere.
    """
    greedy_sweeps = max(1, int(min(1.8 * seed_size / grid.size, 1e9)) - 1)
    seeds = seeds[known[seeds] < 0]
    owner, n_known = known.copy(), int(known.max()) + 1
    owner[seeds] = np.arange(n_known, n_known + len(seeds), dtype=np.int32)
    n_owners = n_known + len(seeds)
    _grow(features, metric, grid.indptr, grid.neighbours, known >= 0, owner, n_owners, greedy_sweeps)
    _own_the_rest(grid.indptr, grid.neighbours, owner, n_owners)
    return owner


@njit(cache=True, nogil=True)
def _grow(
    features: NDArray[np.float64],
    metric: Metric,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    fixed: NDArray[np.bool_],
    owner: NDArray[np.int32],
    n_owners: int,
    greedy_sweeps: int,
) -> None:
    """Nothing; owners have spread as far as there are voxels. Early sweeps may also take from a worse owner."""
    n = len(features)
    claim, best = np.full(n, -1, np.int32), np.full(n, np.inf)
    sums, means = sum_features(features, owner, n_owners), np.zeros((n_owners, 9))
    frontier, touched = np.empty(n, np.int32), np.empty(n, np.int32)
    n_frontier, sweep = 0, 0
    for i in range(n):
        if owner[i] >= 0:
            best[i] = -1.0 if fixed[i] else 0.0  # no distance is below -1
            frontier[n_frontier] = i
            n_frontier += 1
    while n_frontier > 0:
        set_means(sums, means)
        n_touched = 0
        for f in range(n_frontier):
            i = frontier[f]
            s = owner[i]
            for a in range(indptr[i], indptr[i + 1]):
                j = neighbours[a]
                if owner[j] == s or (owner[j] >= 0 and sweep >= greedy_sweeps):
                    continue
                d = distance(features, j, means, s, metric)
                if d < best[j] or (d == best[j] and claim[j] > s):
                    if claim[j] < 0:
                        touched[n_touched] = j
                        n_touched += 1
                    best[j], claim[j] = d, s
        for t in range(n_touched):
            j = touched[t]
            if owner[j] >= 0:
                add_features(features, j, sums, owner[j], -1.0)
            add_features(features, j, sums, claim[j], 1.0)
            owner[j], claim[j] = claim[j], -1
        frontier, touched = touched, frontier
        n_frontier, sweep = n_touched, sweep + 1


@njit(cache=True, nogil=True)
def _own_the_rest(
    indptr: NDArray[np.int64], neighbours: NDArray[np.int32], owner: NDArray[np.int32], n_supervoxels: int
) -> None:
    """Nothing; each connected part of the voxels without owner becomes a supervoxel of its own."""
    stack = np.empty(len(owner), np.int32)
    for start in range(len(owner)):
        if owner[start] >= 0:
            continue
        owner[start], stack[0], depth = n_supervoxels, start, 1
        while depth > 0:
            depth -= 1
            i = stack[depth]
            for a in range(indptr[i], indptr[i + 1]):
                j = neighbours[a]
                if owner[j] < 0:
                    owner[j], stack[depth] = n_supervoxels, j
                    depth += 1
        n_supervoxels += 1
