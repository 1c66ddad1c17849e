# SPDX-License-Identifier: Apache-2.0
"""Joining planes that are one, and giving loose supervoxels to the plane they lie in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.detection.regions import moments_of_regions
from pcgraph.features.moments import Moments


@dataclass(frozen=True)
class FlatLeaves:
    """Supervoxels as the search for planes sees them.

    Attributes
    ----------
    moments : Moments of n supervoxels
    normals : (n, 3) float64
    tolerances : (n,) float64, metres
        Largest root mean square distance of a supervoxel to its plane.
    shapeless : (n,) bool
        Supervoxels too small, next to the tolerance, for their normal to mean anything.
    cos_angle : float
        Cosine of the largest angle between a supervoxel and its plane.
    edges : (m, 2) int32
        Which of them touch.
    flush : (m,) bool
        Whether they meet there without step or bend.
    """

    moments: Moments
    normals: NDArray[np.float64]
    tolerances: NDArray[np.float64]
    shapeless: NDArray[np.bool_]
    cos_angle: float
    edges: NDArray[np.int32]
    flush: NDArray[np.bool_]


def plane_normals(moments: Moments) -> NDArray[np.float64]:
    """Unit directions of least spread, (k, 3), of either sign."""
    return np.linalg.eigh(moments.covariances)[1][:, :, 0]


def numbered(regions: NDArray[np.int32]) -> NDArray[np.int32]:
    """The same regions numbered from 0 without gaps, in the order of their numbers; -1 stays."""
    kept, inverse = np.unique(regions, return_inverse=True)
    return (inverse - int(kept[0] < 0)).astype(np.int32)


def join_planes(leaves: FlatLeaves, regions: NDArray[np.int32], apart: bool) -> NDArray[np.int32]:
    """Regions, (n,) int32, after those that lie in one plane are joined, the best fitting pair first.

    Parameters
    ----------
    leaves : FlatLeaves
    regions : (n,) int32
        Numbered from 0; -1 for none.
    apart : bool
        Whether regions that do not touch are joined too.
    """
    p = int(regions.max(initial=-1)) + 1
    if p < 2:
        return regions
    moments = moments_of_regions(leaves.moments, regions, p)
    tolerance = _region_tolerances(leaves, regions, p)
    allowed = np.ones((p, p), bool) if apart else _touching(leaves.edges, regions, p)
    np.fill_diagonal(allowed, False)
    state = _Pairs(moments.counts.astype(np.float64), moments.centroids.copy(), moments.covariances, tolerance)
    misfit = np.full((p, p), np.inf)
    for i in range(p):
        misfit[i] = np.where(allowed[i], state.misfits(i, leaves.cos_angle), np.inf)
    target = np.arange(p)
    while True:
        i, j = divmod(int(misfit.argmin()), p)
        if not misfit[i, j] <= 1.0:
            break
        state.merge(i, j)
        target[target == j] = i
        allowed[i] |= allowed[j]
        allowed[:, i] |= allowed[:, j]
        allowed[j] = allowed[:, j] = False
        allowed[i, i] = False
        misfit[j] = misfit[:, j] = np.inf
        misfit[i] = misfit[:, i] = np.where(allowed[i], state.misfits(i, leaves.cos_angle), np.inf)
    return numbered(np.append(target, -1)[regions].astype(np.int32))


def absorb(leaves: FlatLeaves, regions: NDArray[np.int32], apart: bool) -> NDArray[np.int32]:
    """Regions, (n,) int32, after supervoxels of none went to the plane in which they lie best.

    Parameters
    ----------
    leaves, regions, apart : as for `join_planes`
        Without `apart` a supervoxel must touch its plane.
    """
    p = int(regions.max(initial=-1)) + 1
    loose = np.flatnonzero(regions < 0)
    if p == 0 or not len(loose):
        return regions
    planes = moments_of_regions(leaves.moments, regions, p)
    normals = plane_normals(planes)
    offset = np.einsum("lpa,pa->lp", leaves.moments.centroids[loose, None] - planes.centroids, normals)
    spread = np.einsum("pa,lab,pb->lp", normals, leaves.moments.covariances[loose], normals)
    misfit = np.sqrt(offset**2 + np.maximum(spread, 0.0)) / leaves.tolerances[loose, None]
    facing = np.abs(leaves.normals[loose] @ normals.T) >= leaves.cos_angle
    good = (misfit <= 1.0) & (facing | leaves.shapeless[loose, None])
    if not apart:
        near = np.zeros((len(regions), p), bool)
        for a, b in (leaves.edges.T, leaves.edges.T[::-1]):
            known = regions[b] >= 0
            near[a[known], regions[b[known]]] = True
        good &= near[loose]
    misfit[~good] = np.inf
    found = good.any(axis=1)
    result = regions.copy()
    result[loose[found]] = misfit[found].argmin(axis=1)
    return result


def bends(leaves: FlatLeaves, regions: NDArray[np.int32], n_regions: int) -> NDArray[np.float64]:
    """How far each region's surface turns, radians, (p,): curvature times extent, 0 for a plane.

    The supervoxels' normals are fitted as a linear function of their place in the plane; what noise does to
    single normals cancels, what a ball or a cylinder does to them does not. A ball patch of radius a on a ball
    of radius R turns by a / (2 R). A surface that turns so also leaves its plane; where the distances show less than
    half of that, the turn is one of the normals only, as slanted noise causes it, and counts as 0.
    """
    planes = moments_of_regions(leaves.moments, regions, n_regions)
    variances, frames = np.linalg.eigh(planes.covariances)
    residuals = np.sqrt(np.maximum(variances[:, 0], 0.0))
    result = np.zeros(n_regions)
    usable = (regions >= 0) & ~leaves.shapeless
    for i in range(n_regions):
        member = np.flatnonzero(usable & (regions == i))
        if len(member) < 3:
            continue
        place = (leaves.moments.centroids[member] - planes.centroids[i]) @ frames[i, :, 1:]
        tilt = leaves.normals[member] @ frames[i]
        tilt = tilt[:, 1:] * np.sign(tilt[:, :1])
        root = np.sqrt(leaves.moments.counts[member] / leaves.moments.counts[member].sum())[:, None]
        place, tilt = (place - (root**2 * place).sum(axis=0)) * root, (tilt - (root**2 * tilt).sum(axis=0)) * root
        slope = np.linalg.lstsq(place, tilt, rcond=1e-6)[0]
        share = root[:, 0]
        rise = 0.5 * ((place @ slope) * place).sum(axis=1) / share  # by which the surface would leave its plane
        leaving = float(np.linalg.norm(rise - share * (share @ rise)))
        if residuals[i] >= 0.5 * leaving:
            result[i] = np.linalg.norm(place @ slope, 2)
    return result


class _Pairs:
    """Moments of regions while they merge."""

    def __init__(
        self,
        counts: NDArray[np.float64],
        centroids: NDArray[np.float64],
        covariances: NDArray[np.float64],
        tolerances: NDArray[np.float64],
    ) -> None:
        self.counts, self.centroids, self.covariances, self.tolerances = counts, centroids, covariances, tolerances
        self.normals = np.linalg.eigh(covariances)[1][:, :, 0]

    def together(self, i: int, others: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centroids and covariances of region i with each of the others."""
        share = self.counts[others] / (self.counts[others] + self.counts[i])
        gap = self.centroids[others] - self.centroids[i]
        cross = (share * (1.0 - share))[:, None, None] * gap[:, :, None] * gap[:, None, :]
        own = (1.0 - share)[:, None, None] * self.covariances[i] + share[:, None, None] * self.covariances[others]
        return self.centroids[i] + share[:, None] * gap, own + cross

    def misfits(self, i: int, cos_angle: float) -> NDArray[np.float64]:
        """Distance of region i and each other to their common plane over their tolerances, (p,); inf if they bend."""
        others = np.arange(len(self.counts))
        centers, covariances = self.together(i, others)
        normals = np.linalg.eigh(covariances)[1][:, :, 0]
        worst = np.zeros(len(others))
        for which in (np.full(len(others), i), others):
            offset = np.einsum("pa,pa->p", self.centroids[which] - centers, normals)
            spread = np.einsum("pa,pab,pb->p", normals, self.covariances[which], normals)
            worst = np.maximum(worst, np.sqrt(offset**2 + np.maximum(spread, 0.0)) / self.tolerances[which])
            worst[np.abs(np.einsum("pa,pa->p", self.normals[which], normals)) < cos_angle] = np.inf
        return worst

    def merge(self, i: int, j: int) -> None:
        """Region i takes in region j."""
        centers, covariances = self.together(i, np.array([j]))
        share = self.counts[j] / (self.counts[i] + self.counts[j])
        self.tolerances[i] = np.sqrt((1 - share) * self.tolerances[i] ** 2 + share * self.tolerances[j] ** 2)
        self.centroids[i], self.covariances[i] = centers[0], covariances[0]
        self.counts[i] += self.counts[j]
        self.normals[i] = np.linalg.eigh(covariances[0])[1][:, 0]


def _region_tolerances(leaves: FlatLeaves, regions: NDArray[np.int32], p: int) -> NDArray[np.float64]:
    member = regions >= 0
    counts = leaves.moments.counts[member]
    squares = np.bincount(regions[member], counts * leaves.tolerances[member] ** 2, p)
    return np.sqrt(squares / np.bincount(regions[member], counts, p))


def _touching(edges: NDArray[np.int32], regions: NDArray[np.int32], p: int) -> NDArray[np.bool_]:
    touching = np.zeros((p, p), bool)
    a, b = regions[edges[:, 0]], regions[edges[:, 1]]
    both = (a >= 0) & (b >= 0)
    touching[a[both], b[both]] = touching[b[both], a[both]] = True
    return touching
