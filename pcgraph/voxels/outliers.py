# SPDX-License-Identifier: Apache-2.0
"""Outliers: points that belong to nothing, no denser around than noise spread through the whole volume would be."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.parallel import in_blocks, kernel
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.eigen import least_eigenvalue
from pcgraph.voxels.grid import MAX_GAP, MAX_NEIGHBOURS, Neighbourhood, VoxelGrid, boundary_voxels, voxels_within

OUTLIER = -2
"""Label of a point that belongs to nothing."""
MIN_POINTS = 1000
"""Of fewer points none is called an outlier."""

_SPARSE = 0.25  # of the median number of points around a point
_CHANCE = 1e-4  # with which noise alone is as dense as what is kept
_MIN_EXTENT = 32.0  # voxels: noise fills a volume, and a flat cloud has none
_VOLUME_OF_REACH = 4.0 / 3.0 * np.pi * MAX_GAP**3
_MAX_FRACTION = 2.0 / 3.0
_PIECE = 5  # points: fewer, all alone, are no object
_MANY_DETACHED = 0.02  # of the points
_FEW_HELD, _SURROUNDED, _FILLED = 2, 14, 0.4  # points in a voxel, at most; voxels around it, at least; of all voxels
_PARTS, _OF_MEAN, _OF_PARTS = 4, 0.2, 0.95  # of the bounding box, along each axis; points in each; and of them
_NEAREST = 16  # voxels of which
_FLAT = 0.05  # of the variance is at most across a surface; of noise 0.2


def outlier_voxels(grid: VoxelGrid) -> NDArray[np.bool_]:
    """Whether the points of each voxel are outliers, (v,) bool.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
        Of one size.

    Notes
    -----
    The density of noise is what sparse voxels hold, over the volume of the bounding box. A voxel is an outlier if noise
    of this density had, with a chance of more than 1 in 10 000, as many points in the voxels around it. Where noise is
    so thin that a reach of three voxel edges is nearly empty of it, there must be as few points within that reach, too,
    so that the thin far end of a scan is not taken for noise. What has been found is then looked at alone: where most
    of the 16 nearest of it lie about a plane or a line, they are a coarse scan beside a fine one, and stay. Clouds of
    fewer than 1000 points, and those of which more than two thirds would be outliers, have none.
    """
    nothing = np.zeros(grid.n_voxels, np.bool_)
    n_points = int(grid.counts.sum())
    around = np.empty(grid.n_voxels, np.int64)
    in_blocks(_count_around, grid.n_voxels, grid.neighbourhood, grid.counts, around)
    if n_points < MIN_POINTS:  # only now: the cloud that kernels are warmed up on is small
        return nothing
    points = np.cumsum(np.bincount(around, grid.counts))
    typical = float(np.searchsorted(points, (n_points + 1) // 2))  # median over the points
    sparse = around <= _SPARSE * typical
    low, high = bounding_box(grid.cells)
    volume = float(np.prod(np.maximum(high - low + 1.0, _MIN_EXTENT)))
    density = float(grid.counts[sparse].sum()) / volume
    others = around - grid.counts
    outlier = sparse & (grid.counts <= _least_significant(density) + 1)
    outlier &= others < _least_significant(density * MAX_NEIGHBOURS)
    background = density * _VOLUME_OF_REACH
    if background < 1.0 and outlier.any():
        alone = np.flatnonzero(outlier)
        near = voxels_within(grid, alone, MAX_GAP)
        held = np.bincount(
            np.repeat(np.arange(len(alone)), np.diff(near.indptr)), grid.counts[near.neighbours], len(alone)
        )
        outlier[alone] = held < _least_significant(background)
    outlier &= ~_surfaces_among(outlier, grid)
    return outlier if grid.counts[outlier].sum() <= _MAX_FRACTION * n_points else nothing


def is_full_of_noise(grid: VoxelGrid) -> bool:
    """Whether noise is so dense that it hides among voxels of this size; smaller ones tell it from surfaces.

    A large part of them hold a point or two then, and still have others on most sides, as no surface does.

    Parameters
    ----------
    grid : VoxelGrid
        Of one size.
    """
    return float(np.mean((np.diff(grid.indptr) >= _SURROUNDED) & (grid.counts <= _FEW_HELD))) >= _FILLED


def fill_the_volume(points: NDArray[np.float64], left: NDArray[np.float64]) -> bool:
    """Whether those points that are gone are noise through the whole volume, and not what is sparse in part of it.

    Noise is in all parts of the bounding box, the leaves of trees are not.

    Parameters
    ----------
    points, left : (n, 3), (m, 3) float64, metres
        All, and those of them that are left.
    """
    low, high = bounding_box(points)
    pitch = np.maximum(high - low, np.finfo(np.float64).tiny) / _PARTS

    def in_each(some: NDArray[np.float64]) -> NDArray[np.int64]:
        parts = np.minimum((some - low) / pitch, _PARTS - 1).astype(np.int64)
        return np.bincount(parts @ np.array((_PARTS**2, _PARTS, 1)), minlength=_PARTS**3)

    gone = in_each(points) - in_each(left)
    return float(np.mean(gone >= _OF_MEAN * gone.mean())) >= _OF_PARTS


def _surfaces_among(voxels: NDArray[np.bool_], grid: VoxelGrid) -> NDArray[np.bool_]:
    """Which of some voxels, (v,) bool, lie on a surface of those alone: flat about most of their nearest ones."""
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
    """Set whether the places near each lie about a plane or a line."""
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
    """Voxels of pieces of at most four points that have nothing else within three voxel edges, (v,) bool.

    No contact joins such a piece to anything, and no gap (`pcgraph.graph.gaps.gaps`) but a wider one, as between the
    rows of a scan. Where they hold more than a fiftieth of the points, what lies on surfaces of its own, as a coarse
    scan beside a fine one, stays. Clouds of fewer than 1000 points, and those that are such pieces to more than two
    thirds, have none.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    """
    detached, degrees = np.zeros(grid.n_voxels, np.bool_), np.diff(grid.indptr)
    is_few = (degrees < _PIECE) & (grid.counts < _PIECE)
    few = np.flatnonzero(is_few)
    alone = np.ones(len(few), np.bool_)  # touching nothing larger; the others need no search
    for slot in range(_PIECE - 1):
        has = degrees[few] > slot
        alone[has] &= is_few[grid.neighbours[grid.indptr[few[has]] + slot]]
    few = few[alone]
    if not len(few) or int(grid.counts.sum()) < MIN_POINTS:
        return detached
    near = voxels_within(grid, few, MAX_GAP, np.flatnonzero(boundary_voxels(grid)))
    of, to = [np.repeat(few, np.diff(near.indptr))], [near.neighbours]
    for slot in range(_PIECE - 1):  # touching voxels may have centroids farther apart
        some = few[degrees[few] > slot]
        of.append(some)
        to.append(grid.neighbours[grid.indptr[some] + slot])
    source, target = np.concatenate(of), np.concatenate(to)
    number = np.full(grid.n_voxels, -1)
    number[few] = np.arange(len(few))
    inner = number[target] >= 0
    piece = connected_components(np.stack((number[source[inner]], number[target[inner]]), axis=1), len(few))
    held = np.bincount(piece, grid.counts[few])
    held[piece[number[source[~inner]]]] = _PIECE
    detached[few[held[piece] < _PIECE]] = True
    if grid.counts[detached].sum() > _MANY_DETACHED * grid.counts.sum():
        detached &= ~_surfaces_among(detached, grid)
    return detached if grid.counts[detached].sum() <= _MAX_FRACTION * grid.counts.sum() else np.zeros_like(detached)


def is_near(grid: VoxelGrid, other: VoxelGrid) -> NDArray[np.bool_]:
    """Whether each voxel lies within three edges, of the larger one, of a voxel of another grid of the same size and
    warp, (v,) bool."""
    from scipy.spatial import cKDTree

    near = np.zeros(grid.n_voxels, np.bool_)
    for of_level, level in other.of_levels():
        edges = np.maximum(grid.warped_edges, level.size)
        distances = cKDTree(other.warped[of_level]).query(grid.warped)[0]
        near |= distances <= MAX_GAP * edges
    return near


def _least_significant(expected: float) -> int:
    """Least number of points that noise, of which so many are expected, reaches with a chance below `_CHANCE`."""
    number, chance = 1, -math.expm1(-expected)  # of so many or more, by the law of Poisson
    while chance >= _CHANCE:
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
