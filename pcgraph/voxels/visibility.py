# SPDX-License-Identifier: Apache-2.0
"""Which side of a surface is its outside, where nobody said from where it was seen: what can be seen from free places.

A scanner stood where nothing was, and what it measured it saw from there. So places around and within the cloud are
tried: those from which much of it is visible, always from the same side, tell which side that is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.grid import VoxelGrid, voxel_grid
from pcgraph.voxels.spacing import bounding_box, sphere_directions
from pcgraph.voxels.surface import fitted_windows
from pcgraph.voxels.warp import Warp

_CELLS = 3000  # of the coarse grid on which places are compared, about
_OUTSIDE = 42  # places around the cloud, and
_DISTANCE = 1.3  # how far they stand off its middle, in half diagonals of its bounding box
_INSIDE = 48  # free places within the bounding box, of a lattice of
_LATTICE = 8  # along each side
_CLEARANCE = 2.5  # cells between a free place and the next surface
_ROUNDS = 12  # of agreement between places and orientations
_VIEWS = 12  # places that the voxels themselves are looked at from
_CLOSED = 0.95  # of all directions hit by something: a hollow seen from within,
_OPEN = 0.99  # of the voxels visible from outside: there is nothing in it
_FILLING = 4  # rounds of orientation by the voxels around, of those that are seen from nowhere
_BINS_PER_RADIAN = 0.282  # of the octahedral map, over its width

_FAR = 1e3  # voxel edges from a voxel to its orientation point


@dataclass(frozen=True, eq=False)
class VisibleSides(ShortRepr):
    """Which side of its surface each of v voxels shows.

    Attributes
    ----------
    viewpoint : (3,) float64, metres
        The place that tells most.
    outside : (v, 3) float64, metres
        A place on the outer side of each voxel's surface.
    """

    viewpoint: NDArray[np.float64]
    outside: NDArray[np.float64]


def visible_sides(grid: VoxelGrid) -> VisibleSides:
    """The outer side of the surface at each voxel, found from what is visible.

    Parameters
    ----------
    grid : VoxelGrid of v voxels

    Notes
    -----
    Places all around the cloud, and free places within its bounding box, see the cells of a coarse copy of the grid,
    by a depth buffer over directions. The place that sees most says which side of what it sees is the outside. Others
    count as far as they agree with this, so a place under the floor, which sees it from below, counts nothing. The
    voxels then take the mean direction to the places that see them, those that none sees from the voxels around.
    What stands on a ground or a table hides nothing from below, either, so the first place is not one below (-z).
    A hollow closed all around, with nothing in it, is an object seen from outside, not a room.

    Visibility of points without a surface: Katz et al. 2007, here by a depth buffer, as voxels have a size.
    """
    low, high = bounding_box(grid.centroids)
    middle, reach = (low + high) / 2.0, max(float((high - low).max()) / 2.0, float(grid.edge_lengths.min()))
    centres, widths = (grid.centroids - middle) / reach, grid.edge_lengths / reach
    places, weights = _telling_places(centres, widths)
    towards = np.empty((grid.n_voxels, 3))
    in_blocks(_look_around, grid.n_voxels, places, weights, seen_from(places, centres, widths), centres, towards)
    filled = np.empty_like(towards)
    for _ in range(_FILLING):
        in_blocks(_fill, grid.n_voxels, grid.indptr, grid.neighbours, towards, filled)
        towards, filled = filled, towards
    towards[~towards.any(axis=1)] = (0.0, 0.0, 1.0)
    towards /= _lengths(towards)[:, None]
    return VisibleSides(middle + reach * places[0], grid.centroids + towards * (_FAR * grid.edge_lengths)[:, None])


def seen_from(
    places: NDArray[np.float64], centres: NDArray[np.float64], widths: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether each of n squares is visible from each of k places, (k, n) bool: none is in front by more than its depth.

    Parameters
    ----------
    places : (k, 3) float64, metres
    centres : (n, 3) float64, metres
    widths : (n,) float64, metres
    """
    seen = np.empty((len(places), len(centres)), np.bool_)
    some = slice(None, None, max(1, len(centres) // 1000))  # to know how fine a map it takes
    ranges = np.linalg.norm(places[:, None] - centres[None, some], axis=2)
    typical = np.median(widths[some] / np.maximum(ranges, 1e-12), axis=1)
    bins = np.clip(1.5 / (_BINS_PER_RADIAN * typical), 64, 1024).astype(np.int64)
    in_blocks(_look, len(places), places, bins, centres, widths, seen, smallest=1)
    return seen


def _lengths(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of rows, (n,), of the order of 1; of zeros nearly nothing."""
    return np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), 1e-12)


def _telling_places(
    centres: NDArray[np.float64], widths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (k, 3) from which the outside is seen, and how much each counts, (k,), the first most."""
    coarse = _coarse(centres, float(np.median(widths)))
    low, high = bounding_box(coarse.centroids)
    inside = _free_places(coarse, low, high)
    outside = (low + high) / 2.0 + _DISTANCE * _lengths((high - low)[None]) / 2.0 * sphere_directions(_OUTSIDE)
    if not (high > low).any():
        outside = low + sphere_directions(_OUTSIDE)
    places = np.concatenate((outside, inside))
    upwards = np.zeros((coarse.n_voxels, 3))
    upwards[:, 2] = 1.0
    normals = fitted_windows(coarse, upwards).normals
    sides = np.where(seen_from(places, coarse.centroids, coarse.edge_lengths), 1.0, 0.0)
    for k, place in enumerate(places):
        rays = place - coarse.centroids
        sides[k] *= np.einsum("ij,ij->i", rays, normals) / _lengths(rays)
    is_closed = np.array([_hit_directions(coarse.centroids - place) > _CLOSED for place in inside], bool)
    if is_closed.any() and seen_from(outside, centres, widths).any(axis=0).mean() > _OPEN:
        chosen = _spread_choice(sides[: len(outside)] != 0.0, np.ones(len(outside)))
        return outside[chosen], np.ones(len(chosen))
    weights = _agreement(sides, places[:, 2] >= low[2])
    chosen = _spread_choice(sides != 0.0, weights)
    return places[chosen], weights[chosen]


def _spread_choice(seen: NDArray[np.bool_], weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Some of the places, by weight and by how much each sees, (k, n) bool, that those before see seldom or never."""
    interest, left = np.ones(seen.shape[1]), weights.copy()
    chosen: list[int] = []
    while len(chosen) < _VIEWS and left.any():
        best = int(np.argmax(left**2 * (seen @ interest)))
        chosen.append(best)
        interest[seen[best]] *= 0.5
        left[best] = 0.0
    return np.array(chosen)


def _agreement(sides: NDArray[np.float64], leaders: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How much each place counts, (k,) float64, >= 0, given the sides that it sees, (k, n): signed cosines, 0 hidden.

    Of the places `leaders`, (k,) bool, the one that sees most is right. What is found, by turns, is nearly the leading
    pair of singular vectors, but no place counts against what it sees.
    """
    weights = np.zeros(len(sides))
    covered = np.where(leaders, (sides != 0.0).sum(axis=1), -1)
    weights[int(np.argmax(covered))] = 1.0
    for _ in range(_ROUNDS):
        outward = np.sign(weights @ sides)
        agreed = np.maximum(sides @ outward, 0.0)
        known = np.abs(sides) @ np.abs(outward)
        weights = agreed * (agreed / np.maximum(known, np.finfo(np.float64).tiny)) ** 4
        weights /= max(float(weights.max()), np.finfo(np.float64).tiny)
    return weights


def _coarse(centres: NDArray[np.float64], width: float) -> VoxelGrid:
    """Voxels in larger ones, as few as still show their shape."""
    size = width * max(1.0, math.sqrt(len(centres) / (1.5 * _CELLS)))  # as many as a surface would have
    while (coarse := voxel_grid(centres, None, size, Warp())).n_voxels > 2 * _CELLS:
        size *= 1.4
    return coarse


def _free_places(coarse: VoxelGrid, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places within the bounding box, the farthest off all surfaces first, (k, 3)."""
    from scipy.spatial import cKDTree

    steps = (np.arange(_LATTICE) + 0.5) / _LATTICE
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = low + lattice * (high - low)
    clearance = cKDTree(coarse.centroids).query(places)[0] / coarse.size
    order = np.argsort(-clearance, kind="stable")[:_INSIDE]
    return places[order[clearance[order] > _CLEARANCE]]


def _hit_directions(rays: NDArray[np.float64]) -> float:
    """Fraction of the directions in which there is something, on a map of 12 x 12 bins."""
    bins = 12
    hit = np.zeros((bins, bins), np.bool_)
    _mark(rays, hit)
    return float(hit.mean())


# --- depth buffers over directions ------------------------------------------------------------------------------------


@routine
def _bin_of(x: float, y: float, z: float, bins: int) -> tuple[float, float]:
    """Place of a direction on the octahedral map of bins x bins."""
    total = abs(x) + abs(y) + abs(z)
    u, v = x / total, y / total
    if z < 0.0:
        u, v = (1.0 - abs(v)) * (1.0 if u >= 0.0 else -1.0), (1.0 - abs(u)) * (1.0 if v >= 0.0 else -1.0)
    return 0.5 * (u + 1.0) * bins, 0.5 * (v + 1.0) * bins


@kernel
def _mark(rays: NDArray[np.float64], hit: NDArray[np.bool_]) -> None:
    bins = len(hit)
    for i in range(len(rays)):
        if rays[i, 0] != 0.0 or rays[i, 1] != 0.0 or rays[i, 2] != 0.0:
            u, v = _bin_of(rays[i, 0], rays[i, 1], rays[i, 2], bins)
            hit[min(int(u), bins - 1), min(int(v), bins - 1)] = True


@kernel
def _look(
    start: int,
    stop: int,
    places: NDArray[np.float64],
    bins_of: NDArray[np.int64],
    centres: NDArray[np.float64],
    widths: NDArray[np.float64],
    seen: NDArray[np.bool_],
) -> None:
    """Set what is seen from each place, by the least range in each bin of directions that a square may cover."""
    n = len(centres)
    at, ranges = np.empty(n, np.int32), np.empty(n, np.float32)
    for k in range(start, stop):
        bins = bins_of[k]
        per_radian = _BINS_PER_RADIAN * bins
        nearest = np.full(bins * bins, np.float32(np.inf), np.float32)
        for i in range(n):
            x, y, z = centres[i, 0] - places[k, 0], centres[i, 1] - places[k, 1], centres[i, 2] - places[k, 2]
            ranges[i] = math.sqrt(x * x + y * y + z * z)
            if ranges[i] <= 0.0:
                at[i] = -1
                continue
            u, v = _bin_of(x, y, z, bins)
            at[i] = min(int(u), bins - 1) * bins + min(int(v), bins - 1)
            half = min(0.5 * widths[i] / ranges[i] * per_radian, 8.0)
            for p in range(max(int(u - half), 0), min(int(u + half), bins - 1) + 1):
                for q in range(max(int(v - half), 0), min(int(v + half), bins - 1) + 1):
                    if ranges[i] < nearest[p * bins + q]:
                        nearest[p * bins + q] = ranges[i]
        for i in range(n):
            # A square seen at a slant is deeper than wide, and so is what a bin shows of a surface.
            depth = widths[i] + ranges[i] / per_radian
            seen[k, i] = at[i] >= 0 and ranges[i] <= nearest[at[i]] + depth


@kernel
def _look_around(
    start: int,
    stop: int,
    places: NDArray[np.float64],
    weights: NDArray[np.float64],
    seen: NDArray[np.bool_],
    centres: NDArray[np.float64],
    towards: NDArray[np.float64],
) -> None:
    """Set the weighted sum of the unit vectors from each square to the places that see it."""
    for i in range(start, stop):
        towards[i, 0] = towards[i, 1] = towards[i, 2] = 0.0
        for k in range(len(places)):
            if seen[k, i]:
                x, y, z = places[k, 0] - centres[i, 0], places[k, 1] - centres[i, 1], places[k, 2] - centres[i, 2]
                scale = weights[k] / math.sqrt(x * x + y * y + z * z)
                towards[i, 0] += scale * x
                towards[i, 1] += scale * y
                towards[i, 2] += scale * z


@kernel
def _fill(
    start: int,
    stop: int,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    towards: NDArray[np.float64],
    filled: NDArray[np.float64],
) -> None:
    """Give voxels without a direction the sum of those around."""
    for i in range(start, stop):
        for axis in range(3):
            filled[i, axis] = towards[i, axis]
        if towards[i, 0] == 0.0 and towards[i, 1] == 0.0 and towards[i, 2] == 0.0:
            for a in range(indptr[i], indptr[i + 1]):
                for axis in range(3):
                    filled[i, axis] += towards[neighbours[a], axis]
