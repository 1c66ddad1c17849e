# SPDX-License-Identifier: Apache-2.0
"""Joining regions that lie in one plane, the best fitting pair first."""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.detection.flat_leaves import FlatLeaves
from pcgraph.detection.regions import (
    cosine,
    least_axis,
    mean_square_distance,
    moments_of_regions,
    numbered,
    plane_normals,
    take_in,
)


def join_planes(leaves: FlatLeaves, regions: NDArray[np.int32], apart: bool) -> NDArray[np.int32]:
    """Regions, (n,) int32, after those that lie in one plane are joined, the best fitting pair first.

    Parameters
    ----------
    leaves : FlatLeaves
    regions : (n,) int32
        Numbered from 0; -1 for none.
    apart : bool
        Whether regions that do not touch are joined too: that looks at all pairs.
    """
    p = int(regions.max(initial=-1)) + 1
    if p < 2:
        return regions
    state, target, version = _Joining(leaves, regions, p), np.arange(p), [0] * p
    near = None if apart else _neighbours(leaves.edges, regions, p)
    queue: list[tuple[float, int, int, int, int]] = []
    for i in range(p):
        later = np.arange(i + 1, p) if near is None else np.array([j for j in near[i] if j > i], np.int64)
        queue += [(misfit, i, j, 0, 0) for misfit, j in state.fitting(i, later)]
    heapify(queue)
    while queue:
        _, i, j, then_i, then_j = heappop(queue)
        if (version[i], version[j]) != (then_i, then_j):
            continue
        state.merge(i, j)
        target[j] = i
        version[i], version[j] = then_i + 1, -1  # -1: is no more
        if near is None:
            others = np.flatnonzero(target == np.arange(p))
        else:
            for k in near[j]:
                near[k].discard(j)
                near[k].add(i)
            near[i] |= near[j]
            near[i].discard(i)
            others = np.array(sorted(near[i]), np.int64)
        for misfit, k in state.fitting(i, others[others != i]):
            low, high = min(i, k), max(i, k)
            heappush(queue, (misfit, low, high, version[low], version[high]))
    while (target != target[target]).any():
        target = target[target]
    return numbered(np.append(target, -1)[regions].astype(np.int32))


class _Joining:
    """Moments of regions while they join."""

    def __init__(self, leaves: FlatLeaves, regions: NDArray[np.int32], p: int) -> None:
        moments = moments_of_regions(leaves.moments, regions, p)
        self.counts = moments.counts.astype(np.float64)
        self.centroids, self.scatters = moments.centroids.copy(), moments.scatters.copy()
        self.normals = plane_normals(moments)
        self.tolerances = _region_tolerances(leaves, regions, p)
        self.cos_angle = leaves.cos_angle

    def fitting(self, i: int, others: NDArray[np.int64]) -> list[tuple[float, int]]:
        """Those of the other regions that lie in one plane with region i, each after its misfit, 0..1."""
        misfits = _misfits(
            i, others, self.counts, self.centroids, self.scatters, self.normals, self.tolerances, self.cos_angle
        )
        good = misfits <= 1.0
        return list(zip(misfits[good].tolist(), others[good].tolist(), strict=True))

    def merge(self, i: int, j: int) -> None:
        """Region i takes in region j."""
        share = self.counts[j] / (self.counts[i] + self.counts[j])
        self.tolerances[i] = np.sqrt((1 - share) * self.tolerances[i] ** 2 + share * self.tolerances[j] ** 2)
        self.counts[i] = take_in(
            self.counts[i], self.centroids[i], self.scatters[i], self.counts[j], self.centroids[j], self.scatters[j]
        )
        self.normals[i] = np.linalg.eigh(self.scatters[i])[1][:, 0]


@njit(cache=True, nogil=True)
def _misfits(  # type: ignore[no-untyped-def]
    i, others, counts, centroids, scatters, normals, tolerances, cos_angle
):
    """Distance of region i and each other to their common plane over their tolerances, (q,); inf if they bend."""
    result = np.full(len(others), np.inf)
    mean, normal, scatter = np.empty(3), np.zeros(3), np.empty((3, 3))
    work, vectors = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(others)):
        a, b = min(i, others[k]), max(i, others[k])
        if not _may_fit(centroids, normals, tolerances, cos_angle, a, b):
            continue
        mean[:], scatter[:] = centroids[a], scatters[a]
        take_in(counts[a], mean, scatter, counts[b], centroids[b], scatters[b])
        least_axis(scatter, work, vectors, normal)
        worst = 0.0
        for r in (a, b):
            if cosine(normals[r], normal) < cos_angle:
                worst = np.inf
                break
            square = mean_square_distance(counts[r], centroids[r], scatters[r], mean, normal)
            worst = max(worst, np.sqrt(square) / tolerances[r])
        result[k] = worst
    return result


@njit(cache=True, nogil=True)
def _may_fit(centroids, normals, tolerances, cos_angle, a, b):  # type: ignore[no-untyped-def]
    """False where no plane within the angle of both regions can come near both: most pairs, at little cost."""
    if cosine(normals[a], normals[b]) < 2.0 * cos_angle**2 - 1.0 - 1e-9:  # twice the angle
        return False
    square = height = 0.0
    for axis in range(3):
        gap = centroids[b, axis] - centroids[a, axis]
        square += gap * gap
        height += gap * normals[a, axis]
    along = np.sqrt(max(square - height * height, 0.0))
    least = abs(height) * cos_angle - along * np.sqrt(1.0 - cos_angle**2)  # step between them across such a plane
    return least <= (1.0 + 1e-9) * (tolerances[a] + tolerances[b])


def _region_tolerances(leaves: FlatLeaves, regions: NDArray[np.int32], p: int) -> NDArray[np.float64]:
    member = regions >= 0
    counts = leaves.moments.counts[member]
    squares = np.bincount(regions[member], counts * leaves.tolerances[member] ** 2, p)
    return np.sqrt(squares / np.bincount(regions[member], counts, p))


def _neighbours(edges: NDArray[np.int32], regions: NDArray[np.int32], p: int) -> list[set[int]]:
    """Regions that touch each region."""
    a, b = regions[edges[:, 0]], regions[edges[:, 1]]
    near: list[set[int]] = [set() for _ in range(p)]
    for i, j in np.unique(np.stack((a, b), axis=1)[(a >= 0) & (b >= 0) & (a != b)], axis=0).tolist():
        near[i].add(j)
        near[j].add(i)
    return near
