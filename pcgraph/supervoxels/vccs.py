# SPDX-License-Identifier: Apache-2.0
"""Voxel cloud connectivity segmentation: supervoxels that grow over touching voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.supervoxels.connect import connect
from pcgraph.supervoxels.distance import distance, update_means
from pcgraph.supervoxels.seeds import seed_voxels
from pcgraph.voxels.grid import VoxelGrid

_REFINE_SWEEPS = 8


@dataclass(frozen=True)
class VccsWeights:
    """What counts in the distance of a voxel to a supervoxel.

    Attributes
    ----------
    color, spatial, normal : float, >= 0
        Their w_c (colours in 0..1), w_s (metres over the seed size) and w_n (one minus the cosine). The
        defaults are those of PCL's header.
    """

    color: float = 0.1
    spatial: float = 0.4
    normal: float = 1.0


def vccs(grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, weights: VccsWeights) -> NDArray[np.int32]:
    """Supervoxel of each voxel.

    Parameters
    ----------
    grid : VoxelGrid
    normals : (v, 3) float64
        Unit normals of the voxels.
    seed_size : float, metres
        Their R_seed.
    weights : VccsWeights

    Returns
    -------
    (v,) int32
        Numbered from 0 without gaps in the order of their first voxel. Every voxel has one, and every
        supervoxel is connected in the 26-neighbourhood.

    Notes
    -----
    D = w_n (1 - n . n') + w_c |c - c'| + w_s |x - x'| / R_seed. Source: Papon et al. 2013, equation 7. Three
    changes: the normals' cosine keeps its sign, so the two faces of a thin plate stay apart; growth does not
    stop at a number of steps, so that all voxels are covered; sweeps propose first and commit afterwards, so
    that no result depends on the order in which supervoxels are visited.
    """
    features, scale = _features(grid, normals, seed_size, weights)
    seeds = seed_voxels(grid, seed_size)
    greedy_sweeps = max(1, int(1.8 * seed_size / grid.size) - 1)
    owner = _grow(features, scale, grid.indptr, grid.neighbours, seeds, greedy_sweeps)
    _refine(features, scale, grid.indptr, grid.neighbours, owner, len(seeds), _REFINE_SWEEPS)
    return connect(features, scale, grid.indptr, grid.neighbours, owner)


def _features(
    grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, weights: VccsWeights
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows (position, normal, colour) and the three weights for their distances, (v, 9) and (3,)."""
    colors = np.zeros_like(normals) if grid.colors is None else grid.colors
    scale = np.array([weights.spatial / seed_size, weights.normal, weights.color])
    return np.hstack((grid.warped, normals, colors)), scale


@njit(cache=True)
def _grow(
    features: NDArray[np.float64],
    scale: NDArray[np.float64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    seeds: NDArray[np.int32],
    greedy_sweeps: int,
) -> NDArray[np.int32]:
    """Owners after growth from the seeds; early sweeps may also take a voxel from a worse owner."""
    n = len(features)
    owner, claim = np.full(n, -1, np.int32), np.full(n, -1, np.int32)
    best = np.full(n, np.inf)
    sums, means = np.zeros((len(seeds), 10)), np.zeros((len(seeds), 9))
    frontier, touched = np.empty(n, np.int32), np.empty(n, np.int32)
    for s in range(len(seeds)):
        frontier[s], owner[seeds[s]] = seeds[s], s
        best[seeds[s]] = 0.0
    n_frontier, sweep = len(seeds), 0
    while n_frontier > 0:
        update_means(features, owner, sums, means)
        n_touched = 0
        for f in range(n_frontier):
            i = frontier[f]
            s = owner[i]
            for a in range(indptr[i], indptr[i + 1]):
                j = neighbours[a]
                if owner[j] == s or (owner[j] >= 0 and sweep >= greedy_sweeps):
                    continue
                d = distance(features, j, means, s, scale)
                if d < best[j] or (d == best[j] and claim[j] > s):
                    if claim[j] < 0:
                        touched[n_touched] = j
                        n_touched += 1
                    best[j], claim[j] = d, s
        for t in range(n_touched):
            j = touched[t]
            owner[j], claim[j] = claim[j], -1
        frontier, touched = touched, frontier
        n_frontier, sweep = n_touched, sweep + 1
    return owner


@njit(cache=True)
def _refine(
    features: NDArray[np.float64],
    scale: NDArray[np.float64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    owner: NDArray[np.int32],
    n_supervoxels: int,
    sweeps: int,
) -> None:
    """Nothing; voxels on a boundary go over to the nearest supervoxel that touches them, a few times.

    After the first sweep only voxels on a boundary, and those next to one that moved, are looked at again.
    """
    sums, means = np.zeros((n_supervoxels, 10)), np.zeros((n_supervoxels, 9))
    settled, active = owner.copy(), np.ones(len(owner), np.bool_)
    for _ in range(sweeps):
        update_means(features, settled, sums, means)
        moved = 0
        for i in range(len(settled)):
            if not active[i]:
                continue
            nearest, least = settled[i], -1.0
            for a in range(indptr[i], indptr[i + 1]):
                s = settled[neighbours[a]]
                if s != nearest and s != settled[i]:
                    if least < 0.0:
                        least = distance(features, i, means, settled[i], scale)
                    d = distance(features, i, means, s, scale)
                    if d < least or (d == least and s < nearest):
                        nearest, least = s, d
            owner[i], active[i] = nearest, least >= 0.0
            moved += nearest != settled[i]
        if moved == 0:
            return
        for i in range(len(settled)):
            if owner[i] != settled[i]:
                settled[i] = owner[i]
                for a in range(indptr[i], indptr[i + 1]):
                    active[neighbours[a]] = True
