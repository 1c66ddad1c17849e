# SPDX-License-Identifier: Apache-2.0
"""Regions of supervoxels: planes grown over the graph, and moments of any set of supervoxels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.features.moments import Moments, grouped_moments
from pcgraph.voxels.eigen import symmetric_eigen

SLACK = 4.0  # how far, in tolerances, a surface may sag from its plane steadily: real sensors bend tables


def moments_of_regions(leaves: Moments, regions: NDArray[np.int32], n_regions: int) -> Moments:
    """Moments of groups of supervoxels, exactly those of their points.

    Parameters
    ----------
    leaves : Moments of n supervoxels
    regions : (n,) int32, 0..n_regions - 1 or -1 for none
        Every region has a supervoxel at least.
    """
    members = np.flatnonzero(regions >= 0)
    return grouped_moments(leaves[members], regions[members], n_regions)


@njit(cache=True)
def grow_planes(
    indptr: NDArray[np.int32],
    neighbours: NDArray[np.int32],
    flush: NDArray[np.bool_],
    seeds: NDArray[np.int64],
    counts: NDArray[np.int64],
    centroids: NDArray[np.float64],
    scatters: NDArray[np.float64],
    normals: NDArray[np.float64],
    tolerances: NDArray[np.float64],
    shapeless: NDArray[np.bool_],
    cos_angle: float,
) -> NDArray[np.int32]:
    """Region of each of n supervoxels, (n,) int32, -1 for none: connected sets that share a plane.

    Parameters
    ----------
    indptr, neighbours : CSR lists of the graph
    flush : as neighbours, bool
        Whether the two meet without step or bend.
    seeds : (s,) int64
        Supervoxels from which regions grow, in this order, unless they have one already.
    counts, centroids, scatters : (n,), (n, 3), (n, 3, 3)
        Their moments.
    normals : (n, 3) float64
        Unit normals.
    tolerances : (n,) float64, metres
        Largest root mean square distance of a supervoxel's points to the plane of its region; `SLACK` times as
        much where it meets a supervoxel of the region flush.
    shapeless : (n,) bool
        Supervoxels whose normal means nothing; only their distance decides.
    cos_angle : float
        Cosine of the largest angle between a supervoxel's and its region's normal.

    Notes
    -----
    The plane is fitted anew, by least squares over all points, with every supervoxel that joins (moments are
    additive: Chan, Golub and LeVeque 1979).
    """
    n = len(counts)
    region = np.full(n, -1, np.int32)
    queue = np.empty(n, np.int64)
    mean, normal, work, vectors = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    scatter = np.empty((3, 3))
    n_regions = 0
    for seed in seeds:
        if region[seed] >= 0:
            continue
        region[seed] = n_regions
        total = float(counts[seed])
        mean[:], scatter[:], normal[:] = centroids[seed], scatters[seed], normals[seed]
        queue[0] = seed
        head, tail = 0, 1
        while head < tail:
            at = queue[head]
            head += 1
            for a in range(indptr[at], indptr[at + 1]):
                j = neighbours[a]
                if region[j] >= 0:
                    continue
                limit = SLACK * tolerances[j] if flush[a] else tolerances[j]
                if not _fits(j, counts, centroids, scatters, normals, limit, shapeless, cos_angle, mean, normal):
                    continue
                region[j] = n_regions
                queue[tail] = j
                tail += 1
                total = _add(j, total, counts, centroids, scatters, mean, scatter)
                work[:] = scatter
                symmetric_eigen(work, vectors)
                _least(work, vectors, normal)
        n_regions += 1
    return region


@njit(cache=True)
def _fits(j, counts, centroids, scatters, normals, limit, shapeless, cos_angle, mean, normal):  # type: ignore[no-untyped-def]
    """Whether a supervoxel lies along the plane through `mean` across `normal`."""
    offset = facing = spread = 0.0
    for a in range(3):
        offset += normal[a] * (centroids[j, a] - mean[a])
        facing += normal[a] * normals[j, a]
        for b in range(3):
            spread += normal[a] * scatters[j, a, b] * normal[b]
    near = offset * offset + spread / counts[j] <= limit**2
    return near and (shapeless[j] or abs(facing) >= cos_angle)


@njit(cache=True)
def _add(j, total, counts, centroids, scatters, mean, scatter):  # type: ignore[no-untyped-def]
    """New number of points; mean and scatter of the region take in one more supervoxel."""
    together = total + counts[j]
    share = counts[j] / together
    for a in range(3):
        for b in range(3):
            shift = (centroids[j, a] - mean[a]) * (centroids[j, b] - mean[b])
            scatter[a, b] += scatters[j, a, b] + total * share * shift
    for a in range(3):
        mean[a] += share * (centroids[j, a] - mean[a])
    return together


@njit(cache=True)
def _least(diagonal, vectors, normal):  # type: ignore[no-untyped-def]
    """Eigenvector of the smallest eigenvalue, on the side where the normal was."""
    low = 0
    for axis in range(1, 3):
        if diagonal[axis, axis] < diagonal[low, low]:
            low = axis
    side = 0.0
    for a in range(3):
        side += vectors[a, low] * normal[a]
    for a in range(3):
        normal[a] = vectors[a, low] if side >= 0.0 else -vectors[a, low]
