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


def plane_normals(moments: Moments) -> NDArray[np.float64]:
    """Unit directions of least spread, (k, 3), of either sign."""
    return np.linalg.eigh(moments.covariances)[1][:, :, 0]


def numbered(regions: NDArray[np.int32]) -> NDArray[np.int32]:
    """The same regions numbered from 0 without gaps, in the order of their numbers; -1 stays."""
    kept, inverse = np.unique(regions, return_inverse=True)
    return (inverse - int(kept[0] < 0)).astype(np.int32)


@njit(cache=True, nogil=True)
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
                if mean_square_distance(counts[j], centroids[j], scatters[j], mean, normal) > limit**2:
                    continue
                if not shapeless[j] and cosine(normals[j], normal) < cos_angle:
                    continue
                region[j] = n_regions
                queue[tail] = j
                tail += 1
                total = take_in(total, mean, scatter, counts[j], centroids[j], scatters[j])
                least_axis(scatter, work, vectors, normal)
        n_regions += 1
    return region


@njit(cache=True, nogil=True)
def take_in(count, mean, scatter, more, its_mean, its_scatter):  # type: ignore[no-untyped-def]
    """Number of points of two groups together; `mean` and `scatter` of the first become those of both.

    Source: Chan, Golub and LeVeque 1979. `pcgraph.features.moments` has it written out, as rows handed on as views cost
    it six times the time.
    """
    total = count + more
    share = more / total
    for a in range(3):
        for b in range(3):
            shift = (its_mean[a] - mean[a]) * (its_mean[b] - mean[b])
            scatter[a, b] += its_scatter[a, b] + count * share * shift
    for a in range(3):
        mean[a] += share * (its_mean[a] - mean[a])
    return total


@njit(cache=True, nogil=True)
def mean_square_distance(count, centroid, scatter, mean, normal):  # type: ignore[no-untyped-def]
    """Mean square distance of a group's points to the plane through `mean` across the unit `normal`."""
    offset = spread = 0.0
    for a in range(3):
        offset += normal[a] * (centroid[a] - mean[a])
        for b in range(3):
            spread += normal[a] * scatter[a, b] * normal[b]
    return offset * offset + max(spread, 0.0) / count


@njit(cache=True, nogil=True)
def cosine(first, second):  # type: ignore[no-untyped-def]
    """|first . second| of two unit vectors."""
    return abs(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


@njit(cache=True, nogil=True)
def least_axis(scatter, work, vectors, normal):  # type: ignore[no-untyped-def]
    """Nothing; `normal` becomes the direction of least scatter, on the side where it was."""
    work[:] = scatter
    symmetric_eigen(work, vectors)
    low = 0
    for axis in range(1, 3):
        if work[axis, axis] < work[low, low]:
            low = axis
    side = 0.0
    for a in range(3):
        side += vectors[a, low] * normal[a]
    for a in range(3):
        normal[a] = vectors[a, low] if side >= 0.0 else -vectors[a, low]
