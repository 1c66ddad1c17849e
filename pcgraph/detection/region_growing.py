# SPDX-License-Identifier: Apache-2.0
"""Regions of supervoxels that lie in one plane: region growing, curvature test, joining of coplanar regions.

`coplanar_regions` is the whole search. Its parts follow in the order in which it calls them; at the end stands the
geometry that they share. Supervoxels are known by their moments alone, so every fit is that of all their points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from pcgraph.disjoint_sets import root_of
from pcgraph.features.moments import Moments, grouped_moments
from pcgraph.parallel import kernel
from pcgraph.voxels.eigen import symmetric_eigen

MAX_TURNING_ANGLE = 0.05
"""Radians by which the surface of a plane may seem to turn. Real tables (12 Kinect clouds, mOSD) turn by 0.007 at
most; at 0.025 half of all planes there are refused, small ones by their noise, at 0.1 a fifth more pass than now. The
objects are the same at all of these."""
MIN_SUPERVOXELS = 8.0
"""Least area of a plane in median supervoxels, unless given, because sides of small objects have less. Not varied."""
MAX_SAG = 4.0
"""Tolerances by which a supervoxel may leave the plane of a region that it meets smoothly, because a Kinect bends a
flat table by about a centimetre towards the corners of its image. Measured on 12 tables (mOSD): at 2 they lose 0.003 of
their overlap, at 1 0.012; with 2 mm of noise more 0.002 and 0.032."""
JOINING = 0.4
"""Largest distance of two regions' planes in tolerances (root mean square over each), because they are better known
than those of supervoxels, and a tilted plane through two level ones comes near both. From 0.2 to 0.5 tables (mOSD)
change by 0.001; in voxels of 3 mm, half of them noise, they have 0.89 at 0.2 and 0.93 from 0.4 on. At 1 the tops of two
boxes, 5 cm apart in height and 0.7 m to the side, are one plane."""
RESIDUAL_STEPS = 16.0
"""Steps per tolerance in which supervoxels are ranked by flatness, so that the rounding of sums, and with it the order
of the points, cannot change which comes first. Any number does that."""


@dataclass(frozen=True, eq=False)
class PlanarPatches:
    """Supervoxels as the search for planes sees them.

    Attributes
    ----------
    moments : Moments of n supervoxels
    normals : (n, 3) float64
        Unit normals.
    tolerances : (n,) float64, metres
        Largest root mean square distance of a supervoxel's points to its plane.
    degenerate : (n,) bool
        Supervoxels too narrow, next to the tolerance, for their normal to mean anything.
    cos_angle : float
        Cosine of the largest angle between a supervoxel and its plane.
    edges : (m, 2) int32
        Which of them touch.
    smooth : (m,) bool
        Whether they meet there without step or crease.
    """

    moments: Moments
    normals: NDArray[np.float64]
    tolerances: NDArray[np.float64]
    degenerate: NDArray[np.bool_]
    cos_angle: float
    edges: NDArray[np.int32]
    smooth: NDArray[np.bool_]

    @property
    def state(self) -> PatchState:
        """The same for compiled loops, without the graph."""
        counts = self.moments.counts.astype(np.float64)
        return PatchState(
            counts, self.moments.centroids, self.moments.scatters, self.normals, self.tolerances, self.degenerate
        )


class PatchState(NamedTuple):
    """Supervoxels, or regions of them, for compiled loops; fields as in `Moments` and `PlanarPatches`."""

    counts: NDArray[np.float64]
    centroids: NDArray[np.float64]
    scatters: NDArray[np.float64]
    normals: NDArray[np.float64]
    tolerances: NDArray[np.float64]
    degenerate: NDArray[np.bool_]


def coplanar_regions(
    patches: PlanarPatches, areas: NDArray[np.float64], min_area: float | None, join: bool
) -> NDArray[np.int32]:
    """Plane of each of n supervoxels, (n,) int32, the one of largest area first; -1 for none.

    Parameters
    ----------
    patches : PlanarPatches
    areas : (n,) float64, square metres
        Of each supervoxel.
    min_area : float, square metres, or None
        Area that a plane must have; None: 8 median supervoxels.
    join : bool
        Whether coplanar regions that do not touch are one plane.
    """
    enough = MIN_SUPERVOXELS * float(np.median(areas)) if min_area is None else min_area
    regions = grown_regions(patches)
    regions = _kept(turning_angles(patches, regions) <= MAX_TURNING_ANGLE, regions)
    regions = join_coplanar(patches, regions, apart=False)
    if join:
        regions = join_coplanar(patches, regions, apart=True)
    regions = _kept(region_areas(areas, regions) >= enough, regions)
    regions = assign_unassigned(patches, regions, apart=join)
    return _by_area(areas, regions)


def patch_areas(moments: Moments) -> NDArray[np.float64]:
    """Area of each supervoxel, (n,) float64, square metres: that of the rectangle with the same variances."""
    variances = np.maximum(np.linalg.eigvalsh(moments.covariances), 0.0)
    return 12.0 * np.sqrt(variances[:, 1] * variances[:, 2])


def region_areas(areas: NDArray[np.float64], regions: NDArray[np.int32]) -> NDArray[np.float64]:
    """Area of each of p regions, (p,) float64, from those of their supervoxels."""
    member = regions >= 0
    return np.bincount(regions[member], areas[member], _number_of(regions)).astype(np.float64)


def moments_of_regions(supervoxels: Moments, regions: NDArray[np.int32], n_regions: int) -> Moments:
    """Moments of groups of supervoxels, exactly those of their points.

    Parameters
    ----------
    supervoxels : Moments of n supervoxels
    regions : (n,) int32, 0..n_regions - 1 or -1 for none
        Every region has a supervoxel at least.
    """
    members = np.flatnonzero(regions >= 0)
    return grouped_moments(supervoxels[members], regions[members], n_regions)


def plane_normals(moments: Moments) -> NDArray[np.float64]:
    """Unit directions of least spread, (k, 3) float64, of either sign."""
    return np.linalg.eigh(moments.covariances)[1][:, :, 0]


def _number_of(regions: NDArray[np.int32]) -> int:
    return int(regions.max(initial=-1)) + 1


def _renumbered(regions: NDArray[np.int32]) -> NDArray[np.int32]:
    """The same regions numbered from 0 without gaps, in the order of their numbers; -1 stays."""
    kept, inverse = np.unique(regions, return_inverse=True)
    return (inverse - int(kept[0] < 0)).astype(np.int32)


def _kept(good: NDArray[np.bool_], regions: NDArray[np.int32]) -> NDArray[np.int32]:
    """The good ones of the regions, renumbered."""
    return _renumbered(np.where(np.append(good, False)[regions], regions, -1).astype(np.int32))


def _by_area(areas: NDArray[np.float64], regions: NDArray[np.int32]) -> NDArray[np.int32]:
    total = region_areas(areas, regions)
    rank = np.empty(len(total) + 1, np.int32)
    rank[np.argsort(-total, kind="stable")] = np.arange(len(total), dtype=np.int32)
    rank[-1] = -1
    return rank[regions]


# ---------------------------------------------------------------------------------------------------- region growing


def grown_regions(patches: PlanarPatches) -> NDArray[np.int32]:
    """Region of each of n supervoxels, (n,) int32, -1 for none: connected sets that share a plane.

    Notes
    -----
    Region growing as in Vo et al. 2015, here from supervoxel to supervoxel, the flattest first. The plane is fitted
    anew, by least squares over all points, with every supervoxel that joins (moments are additive: Chan, Golub and
    LeVeque 1979).
    """
    n, edges = len(patches.normals), patches.edges
    both = np.concatenate((edges, edges[:, ::-1]))
    lists = csr_array((np.tile(1 + patches.smooth, 2), both.T), shape=(n, n))  # 2 if smooth: zeros would be dropped
    variances = np.linalg.eigvalsh(patches.moments.covariances)[:, 0]
    residual = np.sqrt(np.maximum(variances, 0.0)) / patches.tolerances
    order = np.lexsort((np.arange(n), -patches.moments.counts, np.rint(residual * RESIDUAL_STEPS)))
    seeds = order[(residual <= 1.0)[order] & ~patches.degenerate[order]]
    return _grow(patches.state, lists.indptr, lists.indices, lists.data == 2, seeds, patches.cos_angle)


@kernel
def _grow(patches, indptr, neighbours, smooth, seeds, cos_angle):  # type: ignore[no-untyped-def]
    """Region of each supervoxel, grown from the seeds in their order.

    Parameters
    ----------
    patches : PatchState of n supervoxels
    indptr, neighbours : CSR lists of the graph
    smooth : as neighbours, bool
        Whether the two meet without step or crease: then the limit is `MAX_SAG` tolerances instead of one.
    seeds : (s,) int64
        Supervoxels from which regions grow, unless they have one already.
    cos_angle : float
    """
    n = len(patches.counts)
    region = np.full(n, -1, np.int32)
    queue = np.empty(n, np.int64)
    fit = _Fit(np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)))
    n_regions = 0
    for seed in seeds:
        if region[seed] >= 0:
            continue
        region[seed] = n_regions
        total = _start(fit, patches, seed)
        for a in range(3):
            fit.normal[a] = patches.normals[seed, a]
        queue[0] = seed
        head, tail = 0, 1
        while head < tail:
            at = queue[head]
            head += 1
            for a in range(indptr[at], indptr[at + 1]):
                j = neighbours[a]
                if region[j] >= 0:
                    continue
                limit = MAX_SAG * patches.tolerances[j] if smooth[a] else patches.tolerances[j]
                if _mean_square_distance(patches, j, fit) > limit**2:
                    continue
                if not patches.degenerate[j] and _cosine(patches.normals, j, fit.normal) < cos_angle:
                    continue
                region[j] = n_regions
                queue[tail] = j
                tail += 1
                total = _add_moments(total, fit.mean, fit.scatter, patches, j)
                _fit_normal(fit.scatter, fit, fit.normal)
        n_regions += 1
    return region


# ---------------------------------------------------------------------------------------------------- curvature test


def turning_angles(patches: PlanarPatches, regions: NDArray[np.int32]) -> NDArray[np.float64]:
    """Angle by which each region's surface turns, (p,) float64, radians: curvature times extent, 0 for a plane.

    The supervoxels' normals are fitted as a linear function of their place in the plane. What noise does to single
    normals cancels in that fit, what a sphere or a cylinder does to them does not: a round patch of radius a on a
    sphere of radius R turns by a / (2 R). A surface that turns so also leaves its plane. Where the distances show less
    than half of that, only the normals turn, as slanted noise makes them, and the angle counts as 0. So it does for
    regions of less than three supervoxels with a normal.
    """
    p = _number_of(regions)
    planes = moments_of_regions(patches.moments, regions, p)
    variances, frames = np.linalg.eigh(planes.covariances)
    usable = np.flatnonzero((regions >= 0) & ~patches.degenerate)
    of = regions[usable]
    counts = patches.moments.counts[usable]
    weights = counts / np.bincount(of, counts, p)[of]
    place = np.einsum("na,nab->nb", patches.moments.centroids[usable] - planes.centroids[of], frames[of, :, 1:])
    tilt = np.einsum("na,nab->nb", patches.normals[usable], frames[of])
    tilt = tilt[:, 1:] * np.sign(tilt[:, :1])
    place -= _sums(weights, place, of, p)[of]
    tilt -= _sums(weights, tilt, of, p)[of]
    spread = _sums(weights, place[:, :, None] * place[:, None, :], of, p)
    # A row of supervoxels says nothing of the turn across it: widths below 1e-6 of the length do not count.
    slope = np.linalg.pinv(spread, rcond=1e-12, hermitian=True)
    slope = slope @ _sums(weights, place[:, :, None] * tilt[:, None, :], of, p)
    turn = np.linalg.eigvalsh(slope.transpose(0, 2, 1) @ spread @ slope)[:, 1]
    rise = 0.5 * np.einsum("na,nab,nb->n", place, slope[of], place)  # by which the surface would leave its plane
    leaving = np.sqrt(_sums(weights, (rise - _sums(weights, rise, of, p)[of]) ** 2, of, p))
    shows = np.sqrt(np.maximum(variances[:, 0], 0.0)) >= 0.5 * leaving
    return np.where(shows & (np.bincount(of, minlength=p) >= 3), np.sqrt(np.maximum(turn, 0.0)), 0.0)


def _sums(
    weights: NDArray[np.float64], values: NDArray[np.float64], of: NDArray[np.int32], p: int
) -> NDArray[np.float64]:
    """Weighted sum of values (n, ...) by region, (p, ...)."""
    columns = values.reshape(len(values), math.prod(values.shape[1:])).T
    sums = np.stack([np.bincount(of, weights * column, p) for column in columns], axis=1)
    return sums.astype(np.float64, copy=False).reshape(p, *values.shape[1:])


# ------------------------------------------------------------------------------------- joining of coplanar regions


def join_coplanar(patches: PlanarPatches, regions: NDArray[np.int32], apart: bool) -> NDArray[np.int32]:
    """Regions, (n,) int32, after those that lie in one plane are joined, the best fitting pair first.

    Parameters
    ----------
    patches : PlanarPatches
    regions : (n,) int32
        Numbered from 0; -1 for none.
    apart : bool
        Whether regions that do not touch are joined too: that looks at all pairs.
    """
    p = _number_of(regions)
    if p < 2:
        return regions
    member = regions >= 0
    counts = patches.moments.counts[member]
    squares = np.bincount(regions[member], counts * patches.tolerances[member] ** 2, p)
    allowed = JOINING**2 * squares / np.bincount(regions[member], counts, p)
    state = _region_state(patches, regions, p)
    own = np.maximum(np.linalg.eigvalsh(state.scatters)[:, 0], 0.0) / state.counts  # what no plane takes away
    state = state._replace(tolerances=np.sqrt(allowed + own))
    pairs = np.empty((0, 2), np.int64)
    if not apart:
        ends = regions[patches.edges].astype(np.int64)
        pairs = np.unique(np.sort(ends[(ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])], axis=1), axis=0)
    into = _join_best_first(state, pairs, apart, patches.cos_angle)
    return _renumbered(np.append(into, -1)[regions].astype(np.int32))


def _region_state(patches: PlanarPatches, regions: NDArray[np.int32], p: int) -> PatchState:
    """Regions for compiled loops; their tolerances are not set."""
    moments = moments_of_regions(patches.moments, regions, p)
    return PatchState(
        moments.counts.astype(np.float64),
        moments.centroids.copy(),
        moments.scatters.copy(),
        plane_normals(moments).copy(),
        np.zeros(p),
        np.zeros(p, bool),
    )


@kernel
def _join_best_first(regions, pairs, apart, cos_angle):  # type: ignore[no-untyped-def]
    """Region, the one of lowest number, that each of p regions becomes part of, (p,) int64.

    Parameters
    ----------
    regions : PatchState of p regions
        Overwritten.
    pairs : (q, 2) int64
        Regions that touch.
    apart : bool
        Whether all pairs may join, not only these.
    cos_angle : float
    """
    p = len(regions.counts)
    into, changed = np.arange(p), np.zeros(p, np.int64)  # changed: the number of the join in which each last grew
    present, place = np.arange(p), np.arange(p)
    rings, touching, seen = _neighbour_rings(p, pairs), np.empty(p, np.int64), np.full(p, -1, np.int64)
    fit = _Fit(np.zeros(3), np.zeros(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)))
    queue = _PairQueue(np.empty(1024), np.empty(1024, np.int64), np.empty(1024, np.int64), np.zeros(1, np.int64))
    joins = 0
    for i in range(p):
        others = present[i + 1 :] if apart else touching[: _touching(rings, i, into, seen, i, touching)]
        queue = _queue_pairs(queue, regions, i, others, joins, cos_angle)
    while queue.size[0] > 0:
        pair, stamp = queue.pairs[0], queue.stamps[0]
        i, j, queued = pair // p, pair % p, stamp // 2
        _heap_pop(queue)
        if into[i] != i or into[j] != j or changed[i] > queued or changed[j] > queued:
            continue  # a side has changed since; the pair was queued anew then
        if stamp % 2 == 0:  # known from below only
            misfit = _misfit(regions, i, j, cos_angle, fit)
            if misfit <= 1.0:
                _heap_push(queue, misfit, pair, stamp + 1)
            continue
        joins += 1
        into[j], changed[i] = i, joins
        moved = present[p - joins]
        present[place[j]], place[moved] = moved, place[j]
        _join_rings(rings, i, j)
        fraction = regions.counts[j] / (regions.counts[i] + regions.counts[j])
        square = (1 - fraction) * regions.tolerances[i] ** 2 + fraction * regions.tolerances[j] ** 2
        regions.tolerances[i] = np.sqrt(square)
        regions.counts[i] = _add_moments(regions.counts[i], regions.centroids[i], regions.scatters[i], regions, j)
        _fit_normal(regions.scatters[i], fit, regions.normals[i])
        others = present[: p - joins] if apart else touching[: _touching(rings, i, into, seen, p + joins, touching)]
        queue = _queue_pairs(queue, regions, i, others, joins, cos_angle)
    for k in range(p):
        into[k] = root_of(into, k)
    return into


@kernel
def _queue_pairs(queue, regions, i, others, joins, cos_angle):  # type: ignore[no-untyped-def]
    """The queue, grown if needed, with those pairs of region i and each other that may lie in one plane."""
    p = len(regions.counts)
    normals, centroids, tolerances = regions.normals, regions.centroids, regions.tolerances
    cos_both, sin_angle = 2.0 * cos_angle**2 - 1.0 - 1e-9, np.sqrt(1.0 - cos_angle**2)  # cos_both: of twice the angle
    nx, ny, nz, x, y, z = normals[i, 0], normals[i, 1], normals[i, 2], centroids[i, 0], centroids[i, 1], centroids[i, 2]
    for k in others:
        # Most pairs are ruled out at little cost: no plane within the angle of both normals comes near both.
        if abs(normals[k, 0] * nx + normals[k, 1] * ny + normals[k, 2] * nz) < cos_both or k == i:
            continue
        dx, dy, dz = centroids[k, 0] - x, centroids[k, 1] - y, centroids[k, 2] - z
        square = dx * dx + dy * dy + dz * dz
        above = max(abs(dx * nx + dy * ny + dz * nz), abs(dx * normals[k, 0] + dy * normals[k, 1] + dz * normals[k, 2]))
        along = np.sqrt(max(square - above * above, 0.0))
        # The step between them across such a plane is at least this:
        if above * cos_angle - along * sin_angle > (1.0 + 1e-9) * (tolerances[i] + tolerances[k]):
            continue
        misfit = _least_misfit(regions, i, k, dx, dy, dz)
        if misfit <= 1.0:
            if queue.size[0] == len(queue.pairs):
                queue = _with_room(queue)
            _heap_push(queue, misfit, min(i, k) * p + max(i, k), 2 * joins)
    return queue


@kernel
def _least_misfit(regions, i, k, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Lower bound of the misfit of two regions whose centroids are (dx, dy, dz) apart, without eigenvectors.

    The least eigenvalue of their scatter is their sum of squared distances to the best plane; over the same sum of
    their tolerances it is at most the square of the misfit. Newton's method on the characteristic polynomial, from 0,
    comes near that eigenvalue from below.
    """
    counts, tolerances, scatters = regions.counts, regions.tolerances, regions.scatters
    limit = counts[i] * tolerances[i] ** 2 + counts[k] * tolerances[k] ** 2
    weight = counts[i] * counts[k] / (counts[i] + counts[k])
    xx = scatters[i, 0, 0] + scatters[k, 0, 0] + weight * dx * dx
    yy = scatters[i, 1, 1] + scatters[k, 1, 1] + weight * dy * dy
    zz = scatters[i, 2, 2] + scatters[k, 2, 2] + weight * dz * dz
    xy = scatters[i, 0, 1] + scatters[k, 0, 1] + weight * dx * dy
    xz = scatters[i, 0, 2] + scatters[k, 0, 2] + weight * dx * dz
    yz = scatters[i, 1, 2] + scatters[k, 1, 2] + weight * dy * dz
    trace = xx + yy + zz
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    least = 0.0
    for _ in range(3):
        slope = (3.0 * least - 2.0 * trace) * least + minors
        if not slope > 1e-6 * trace * trace:  # on a line rounding decides
            return 0.0
        least -= ((least - trace) * least + minors) * least / slope - determinant / slope
    return np.sqrt(max(least - 1e-9 * trace, 0.0) / limit) * (1.0 - 1e-9)


@kernel
def _misfit(regions, a, b, cos_angle, fit):  # type: ignore[no-untyped-def]
    """Distance of two regions, a < b, to their common plane over their tolerances; infinite if a normal is off it."""
    total = _start(fit, regions, a)
    _add_moments(total, fit.mean, fit.scatter, regions, b)
    _fit_normal(fit.scatter, fit, fit.normal)
    worst = 0.0
    for r in (a, b):
        if _cosine(regions.normals, r, fit.normal) < cos_angle:
            return np.inf
        worst = max(worst, np.sqrt(_mean_square_distance(regions, r, fit)) / regions.tolerances[r])
    return worst


class _PairQueue(NamedTuple):
    """Binary heap of pairs of regions, the one of least misfit first, of equal ones that of lowest numbers."""

    misfits: NDArray[np.float64]
    pairs: NDArray[np.int64]
    """First number times the number of regions, plus the second."""
    stamps: NDArray[np.int64]
    """Twice the number of the join after which the two were queued, plus 1 if the misfit is exact, no bound."""
    size: NDArray[np.int64]
    """(1,): entries in use."""


@kernel
def _with_room(queue):  # type: ignore[no-untyped-def]
    """The same queue with room for twice as many."""
    n = len(queue.pairs)
    larger = _PairQueue(np.empty(2 * n), np.empty(2 * n, np.int64), np.empty(2 * n, np.int64), queue.size)
    for at in range(n):
        larger.misfits[at], larger.pairs[at] = queue.misfits[at], queue.pairs[at]
        larger.stamps[at] = queue.stamps[at]
    return larger


@kernel
def _heap_push(queue, misfit, pair, stamp):  # type: ignore[no-untyped-def]
    """Add an entry; there must be room."""
    at = queue.size[0]
    queue.size[0] += 1
    while at > 0:
        up = (at - 1) // 2
        if queue.misfits[up] < misfit or (queue.misfits[up] == misfit and queue.pairs[up] <= pair):
            break
        _move(queue, up, at)
        at = up
    queue.misfits[at], queue.pairs[at], queue.stamps[at] = misfit, pair, stamp


@kernel
def _move(queue, source, target):  # type: ignore[no-untyped-def]
    """Copy an entry."""
    queue.misfits[target], queue.pairs[target] = queue.misfits[source], queue.pairs[source]
    queue.stamps[target] = queue.stamps[source]


@kernel
def _heap_pop(queue):  # type: ignore[no-untyped-def]
    """Remove the first entry."""
    queue.size[0] -= 1
    size = queue.size[0]
    misfit, pair, stamp = queue.misfits[size], queue.pairs[size], queue.stamps[size]
    at = 0
    while 2 * at + 1 < size:
        low = 2 * at + 1
        if low + 1 < size and (
            queue.misfits[low + 1] < queue.misfits[low]
            or (queue.misfits[low + 1] == queue.misfits[low] and queue.pairs[low + 1] < queue.pairs[low])
        ):
            low += 1
        if misfit < queue.misfits[low] or (misfit == queue.misfits[low] and pair <= queue.pairs[low]):
            break
        _move(queue, low, at)
        at = low
    queue.misfits[at], queue.pairs[at], queue.stamps[at] = misfit, pair, stamp


class _Rings(NamedTuple):
    """Neighbours of regions: each has a ring of links, so that two regions are joined by exchanging two links."""

    last: NDArray[np.int64]
    """(p,): a link of each region's ring, -1 for none."""
    following: NDArray[np.int64]
    """(2 q,): next link in the ring."""
    to: NDArray[np.int64]
    """(2 q,): region to which a link leads, by its first number."""


@kernel
def _neighbour_rings(p, pairs):  # type: ignore[no-untyped-def]
    """Rings of p regions of which these pairs, (q, 2), touch."""
    rings = _Rings(np.full(p, -1), np.empty(2 * len(pairs), np.int64), np.empty(2 * len(pairs), np.int64))
    for link in range(2 * len(pairs)):
        at = pairs[link // 2, link % 2]
        rings.to[link] = pairs[link // 2, 1 - link % 2]
        rings.following[link] = link
        if rings.last[at] >= 0:
            rings.following[link], rings.following[rings.last[at]] = rings.following[rings.last[at]], link
        rings.last[at] = link
    return rings


@kernel
def _join_rings(rings, i, j):  # type: ignore[no-untyped-def]
    """Region i takes the neighbours of region j."""
    a, b = rings.last[i], rings.last[j]
    if a >= 0 and b >= 0:
        rings.following[a], rings.following[b] = rings.following[b], rings.following[a]
    rings.last[i] = max(a, b) if min(a, b) < 0 else a


@kernel
def _touching(rings, i, into, seen, mark, touching):  # type: ignore[no-untyped-def]
    """Number of regions that touch region i, which are written to `touching`; `seen` holds the mark of each."""
    n, link = 0, rings.last[i]
    while link >= 0:
        link = rings.following[link]
        k = root_of(into, rings.to[link])
        if k != i and seen[k] != mark:
            seen[k] = mark
            touching[n] = k
            n += 1
        if link == rings.last[i]:
            break
    return n


# ------------------------------------------------------------------------------------------------------- assignment


def assign_unassigned(patches: PlanarPatches, regions: NDArray[np.int32], apart: bool) -> NDArray[np.int32]:
    """Regions, (n,) int32, after each supervoxel of none went to the plane in which it lies best, if in any.

    Parameters
    ----------
    patches, regions, apart : as for `join_coplanar`
        Without `apart` a supervoxel must touch its plane.
    """
    p = _number_of(regions)
    unassigned = np.flatnonzero(regions < 0)
    if p == 0 or not len(unassigned):
        return regions
    if apart:
        choices, first, last = np.arange(p), np.zeros(len(unassigned), np.int64), np.full(len(unassigned), p)
    else:
        ends = np.concatenate((patches.edges, patches.edges[:, ::-1]))
        ends = ends[(regions[ends[:, 0]] < 0) & (regions[ends[:, 1]] >= 0)]
        order = np.lexsort((regions[ends[:, 1]], ends[:, 0]))
        choices, owner = regions[ends[order, 1]].astype(np.int64), ends[order, 0]
        first, last = np.searchsorted(owner, unassigned, "left"), np.searchsorted(owner, unassigned, "right")
    planes, result = _region_state(patches, regions, p), regions.copy()
    result[unassigned] = _best_planes(
        patches.state, planes, unassigned, choices, np.stack((first, last), axis=1), patches.cos_angle
    )
    return result


@kernel
def _best_planes(patches, planes, unassigned, choices, slices, cos_angle):  # type: ignore[no-untyped-def]
    """Plane, of its slice of the choices, in which each of u supervoxels lies best, (u,) int32; -1 if in none.

    Parameters
    ----------
    patches, planes : PatchState
    unassigned : (u,) int64
    choices : (c,) int64
    slices : (u, 2) int64
        First and last + 1 of each one's choices.
    cos_angle : float
    """
    best = np.full(len(unassigned), -1, np.int32)
    centroids, normals, means = patches.centroids, planes.normals, planes.centroids
    for k in range(len(unassigned)):
        i = unassigned[k]
        least = patches.tolerances[i] ** 2
        for c in range(slices[k, 0], slices[k, 1]):
            r = choices[c]
            offset = 0.0
            for a in range(3):
                offset += normals[r, a] * (centroids[i, a] - means[r, a])
            if offset * offset > least:  # most choices
                continue
            if not patches.degenerate[i] and _cosine(patches.normals, i, normals[r]) < cos_angle:
                continue
            spread = 0.0
            for a in range(3):
                for b in range(3):
                    spread += normals[r, a] * patches.scatters[i, a, b] * normals[r, b]
            square = offset * offset + max(spread, 0.0) / patches.counts[i]
            if square < least or (square == least and best[k] < 0):
                best[k], least = r, square
    return best


# --------------------------------------------------------------------------------------------------- shared geometry


class _Fit(NamedTuple):
    """Plane of a group of points and what its fit needs: (3,) and (3, 3) float64."""

    mean: NDArray[np.float64]
    normal: NDArray[np.float64]
    scatter: NDArray[np.float64]
    work: NDArray[np.float64]
    vectors: NDArray[np.float64]


@kernel
def _start(fit, patches, j):  # type: ignore[no-untyped-def]
    """Number of points of patch j; mean and scatter of the fit become its own."""
    for a in range(3):
        fit.mean[a] = patches.centroids[j, a]
        for b in range(3):
            fit.scatter[a, b] = patches.scatters[j, a, b]
    return patches.counts[j]


@kernel
def _add_moments(count, mean, scatter, patches, j):  # type: ignore[no-untyped-def]
    """Number of points of a group and patch j together; `mean` and `scatter` of the group become those of both.

    Source: Chan, Golub and LeVeque 1979.
    """
    more, means, scatters = patches.counts[j], patches.centroids, patches.scatters
    total = count + more
    fraction = more / total
    for a in range(3):
        for b in range(3):
            shift = (means[j, a] - mean[a]) * (means[j, b] - mean[b])
            scatter[a, b] += scatters[j, a, b] + count * fraction * shift
    for a in range(3):
        mean[a] += fraction * (means[j, a] - mean[a])
    return total


@kernel
def _mean_square_distance(patches, j, fit):  # type: ignore[no-untyped-def]
    """Mean square distance of the points of patch j to the fitted plane, square metres."""
    offset = spread = 0.0
    for a in range(3):
        offset += fit.normal[a] * (patches.centroids[j, a] - fit.mean[a])
        for b in range(3):
            spread += fit.normal[a] * patches.scatters[j, a, b] * fit.normal[b]
    return offset * offset + max(spread, 0.0) / patches.counts[j]


@kernel
def _cosine(normals, j, normal):  # type: ignore[no-untyped-def]
    """|cosine| between row j of unit vectors and a unit vector."""
    return abs(normals[j, 0] * normal[0] + normals[j, 1] * normal[1] + normals[j, 2] * normal[2])


@kernel
def _fit_normal(scatter, fit, normal):  # type: ignore[no-untyped-def]
    """Set `normal` to the direction of least scatter, on the side where it was."""
    work, vectors = fit.work, fit.vectors
    for a in range(3):
        for b in range(3):
            work[a, b] = scatter[a, b]
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
