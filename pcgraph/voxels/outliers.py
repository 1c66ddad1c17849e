# SPDX-License-Identifier: Apache-2.0
"""Outliers: points that belong to nothing, no denser around than noise spread through the whole volume would be."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.parallel import in_blocks, kernel
from pcgraph.rounding import TINY
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.eigen import least_eigenvalue
from pcgraph.voxels.grid import MAX_GAP, MAX_NEIGHBOURS, Neighbourhood, VoxelGrid, boundary_voxels, voxels_within

MIN_POINTS = 1000
"""Points of a cloud: in a smaller one none is an outlier, as a thing may have few; chosen by eye, not varied."""
_NEAREST = 16
"""Outlier voxels nearest to one, with itself, that tell whether it lies on a surface; chosen by eye, not varied."""
_FLAT = 0.05
"""Fraction of the variance across a plane or a line, at most, of a surface: noise has 0.2. Chosen by eye, between."""


@dataclass(frozen=True)
class NoiseThresholds:
    """Conditions for voxels to hold noise, and for a cloud to be full of it. Chosen by eye; none was varied."""

    sparse: float = 0.25  # of the median number of points around a point: with at most so many a voxel is sparse
    chance: float = 1e-4  # probability that noise alone is as dense as a voxel that stays
    min_extent: float = 32.0  # voxel edges: each side of the volume counts that long, as a flat cloud has no volume
    reach_volume: float = 4.0 / 3.0 * np.pi * MAX_GAP**3  # voxels: sphere of the widest gap, within which nothing joins
    max_fraction: float = 2.0 / 3.0  # fraction of the points that may be outliers: if more are, none is
    max_held: int = 2  # points of a voxel that noise may fill
    min_around: int = 14  # voxels around such a one; on a surface some 6 to 13 are
    min_filled: float = 0.4  # fraction of such voxels from which on noise hides among them
    parts: int = 4  # parts of the bounding box along each axis, of which noise fills all; leaves of trees do not
    min_of_mean: float = 0.2  # of the mean number of outliers per part: so many fill a part
    min_parts: float = 0.95  # fraction of the parts that are filled


@dataclass(frozen=True)
class DetachedThresholds:
    """Conditions for pieces that touch nothing to be outliers. Chosen by eye; gain 0.0007."""

    min_points: int = 5  # points of a piece that stays, as an object
    few: float = 0.02  # fraction of the points: if such pieces hold more, those on surfaces of their own stay


_NOISE = NoiseThresholds()
_DETACHED = DetachedThresholds()


def outlier_voxels(grid: VoxelGrid) -> NDArray[np.bool_]:
    """Whether the points of each voxel are outliers, (v,) bool.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
        Of one size.

    Notes
    -----
    The density of noise is the number of points in sparse voxels, over the volume of the bounding box. A voxel is an
    outlier if noise of this density would put as many points into the voxels around it, with a probability of more than
    1 in 10 000. If noise is so thin that a sphere of three voxel edges would hold less than one point of it, there must
    be as few points in that sphere, too: so the thin far end of a scan stays. Of the voxels found so far, those stay of
    whose 16 nearest most lie about a plane or a line: they are a coarse scan beside a fine one. Clouds of fewer than
    1000 points, and those of which more than two thirds would be outliers, have none.
    """
    nothing = np.zeros(grid.n_voxels, np.bool_)
    n_points = int(grid.counts.sum())
    around = np.empty(grid.n_voxels, np.int64)
    in_blocks(_count_around, grid.n_voxels, grid.neighbourhood, grid.counts, around)
    if n_points < MIN_POINTS:  # not before: kernels are warmed up on a small cloud
        return nothing
    points = np.cumsum(np.bincount(around, grid.counts))
    typical = float(np.searchsorted(points, (n_points + 1) // 2))  # median over the points
    sparse = around <= _NOISE.sparse * typical
    low, high = bounding_box(grid.cells)
    volume = float(np.prod(np.maximum(high - low + 1.0, _NOISE.min_extent)))
    density = float(grid.counts[sparse].sum()) / volume
    others = around - grid.counts
    outlier = sparse & (grid.counts <= _least_significant(density) + 1)
    outlier &= others < _least_significant(density * MAX_NEIGHBOURS)
    background = density * _NOISE.reach_volume
    if background < 1.0 and outlier.any():
        alone = np.flatnonzero(outlier)
        near = voxels_within(grid, alone, MAX_GAP)
        held = np.bincount(
            np.repeat(np.arange(len(alone)), np.diff(near.indptr)), grid.counts[near.neighbours], len(alone)
        )
        outlier[alone] = held < _least_significant(background)
    outlier &= ~_surfaces_among(outlier, grid)
    return outlier if grid.counts[outlier].sum() <= _NOISE.max_fraction * n_points else nothing


def is_full_of_noise(grid: VoxelGrid) -> bool:
    """Whether noise is so dense that it hides among voxels of this size, so that smaller ones are needed to find it.

    Then a large fraction of the voxels hold a point or two, and still have others on most sides. On a surface a voxel
    with so many around it holds more points.

    Parameters
    ----------
    grid : VoxelGrid
        Of one size.
    """
    may_be_noise = (np.diff(grid.indptr) >= _NOISE.min_around) & (grid.counts <= _NOISE.max_held)
    return float(np.mean(may_be_noise)) >= _NOISE.min_filled


def fill_the_volume(points: NDArray[np.float64], left: NDArray[np.float64]) -> bool:
    """Whether the outliers of a cloud are spread through its whole volume, as noise is and the leaves of trees are not.

    Parameters
    ----------
    points, left : (n, 3), (m, 3) float64, metres
        All points, and those that are no outliers.
    """
    low, high = bounding_box(points)
    pitch = np.maximum(high - low, TINY) / _NOISE.parts

    def in_each(some: NDArray[np.float64]) -> NDArray[np.int64]:
        """Number of points in each part of the bounding box."""
        parts = np.minimum((some - low) / pitch, _NOISE.parts - 1).astype(np.int64)
        return np.bincount(parts @ np.array((_NOISE.parts**2, _NOISE.parts, 1)), minlength=_NOISE.parts**3)

    gone = in_each(points) - in_each(left)
    return float(np.mean(gone >= _NOISE.min_of_mean * gone.mean())) >= _NOISE.min_parts


def _surfaces_among(voxels: NDArray[np.bool_], grid: VoxelGrid) -> NDArray[np.bool_]:
    """Whether each voxel lies on a surface that is made of some of the voxels alone, (v,) bool.

    `voxels`, (v,) bool, are these. One is on a surface if most of its nearest ones lie about a plane or a line with
    their own nearest ones.
    """
    found = np.zeros(len(voxels), np.bool_)
    alone = np.flatnonzero(voxels)
    if len(alone) < 2 * _NEAREST:
        return found
    from scipy.spatial import cKDTree

    places = grid.warped[alone] / grid.size
    near = cKDTree(places, balanced_tree=False).query(places, _NEAREST)[1]
    flat = np.empty(len(alone), np.bool_)
    in_blocks(_find_flat, len(alone), places, near, flat)
    found[alone] = flat[near].mean(axis=1) >= 0.5
    return found


@kernel
def _find_flat(
    start: int, stop: int, places: NDArray[np.float64], near: NDArray[np.int64], flat: NDArray[np.bool_]
) -> None:
    """Set whether the places near each place lie about a plane or a line."""
    n = near.shape[1]
    for i in range(start, stop):
        mean_x = mean_y = mean_z = 0.0
        for j in near[i]:
            mean_x, mean_y, mean_z = mean_x + places[j, 0] / n, mean_y + places[j, 1] / n, mean_z + places[j, 2] / n
        xx = yy = zz = xy = xz = yz = 0.0
        for j in near[i]:
            x, y, z = places[j, 0] - mean_x, places[j, 1] - mean_y, places[j, 2] - mean_z
            xx, yy, zz = xx + x * x, yy + y * y, zz + z * z
            xy, xz, yz = xy + x * y, xz + x * z, yz + y * z
        flat[i] = least_eigenvalue(xx, yy, zz, xy, xz, yz) < _FLAT * (xx + yy + zz)


def detached_voxels(grid: VoxelGrid) -> NDArray[np.bool_]:
    """Whether each voxel is of a detached piece, (v,) bool: at most four points, and nothing else within three edges.

    No contact joins such a piece to anything, and no gap (`pcgraph.graph.gaps.gaps`) does, but for the wider gaps
    between the rows of a scan. If detached pieces hold more than a fiftieth of the points, those on surfaces of their
    own stay, such as a coarse scan beside a fine one. Clouds of fewer than 1000 points have none. Neither have clouds
    of which more than two thirds would be such pieces.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    """
    detached, degrees = np.zeros(grid.n_voxels, np.bool_), np.diff(grid.indptr)
    is_few = (degrees < _DETACHED.min_points) & (grid.counts < _DETACHED.min_points)
    few = np.flatnonzero(is_few)
    alone = np.ones(len(few), np.bool_)  # whether it touches no larger voxel; the others need no search
    for slot in range(_DETACHED.min_points - 1):
        has = degrees[few] > slot
        alone[has] &= is_few[grid.neighbours[grid.indptr[few[has]] + slot]]
    few = few[alone]
    if not len(few) or int(grid.counts.sum()) < MIN_POINTS:
        return detached
    near = voxels_within(grid, few, MAX_GAP, np.flatnonzero(boundary_voxels(grid)))
    of, to = [np.repeat(few, np.diff(near.indptr))], [near.neighbours]
    for slot in range(_DETACHED.min_points - 1):  # centroids of touching voxels may lie farther apart than that
        some = few[degrees[few] > slot]
        of.append(some)
        to.append(grid.neighbours[grid.indptr[some] + slot])
    source, target = np.concatenate(of), np.concatenate(to)
    number = np.full(grid.n_voxels, -1)
    number[few] = np.arange(len(few))
    inner = number[target] >= 0
    piece = connected_components(np.stack((number[source[inner]], number[target[inner]]), axis=1), len(few))
    held = np.bincount(piece, grid.counts[few])
    held[piece[number[source[~inner]]]] = _DETACHED.min_points
    detached[few[held[piece] < _DETACHED.min_points]] = True
    if grid.counts[detached].sum() > _DETACHED.few * grid.counts.sum():
        detached &= ~_surfaces_among(detached, grid)
    return (
        detached if grid.counts[detached].sum() <= _NOISE.max_fraction * grid.counts.sum() else np.zeros_like(detached)
    )


def far_from(other: VoxelGrid, grid: VoxelGrid, voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Voxels of a grid, out of some, (v,) bool, that have no voxel of another grid within three edges of the larger.

    Both grids have the same size and warp.
    """
    from scipy.spatial import cKDTree

    asked, far = np.flatnonzero(voxels), np.zeros(grid.n_voxels, np.bool_)
    far[asked] = True
    for of_level, level in other.of_levels():
        edges = np.maximum(grid.warped_edges[asked], level.size)
        far[asked] &= (
            cKDTree(other.warped[of_level], balanced_tree=False).query(grid.warped[asked])[0] > MAX_GAP * edges
        )
    return far


def _least_significant(expected: float) -> int:
    """Least number of points that noise reaches with a probability below 1 in 10 000, if so many are expected."""
    number, chance = 1, -math.expm1(-expected)  # of so many or more, by the law of Poisson
    while chance >= _NOISE.chance:
        chance -= math.exp(number * math.log(expected) - expected - math.lgamma(number + 1))
        number += 1
    return number


@kernel
def _count_around(
    start: int,
    stop: int,
    neighbourhood: Neighbourhood,
    counts: NDArray[np.int64],
    around: NDArray[np.int64],
) -> None:
    """Set the number of points in each voxel and those around it."""
    indptr, neighbours = neighbourhood
    for i in range(start, stop):
        around[i] = counts[i]
        for a in range(indptr[i], indptr[i + 1]):
            around[i] += counts[neighbours[a]]
