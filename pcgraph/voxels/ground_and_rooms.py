# SPDX-License-Identifier: Apache-2.0
"""What the densest planes of a cloud are: the ground, or a table, that bears all; floor and ceiling of a room."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.voxels.directions import plane_basis
from pcgraph.voxels.grid import VoxelGrid, voxel_grid
from pcgraph.voxels.warp import Warp

# The plane on which most lies
_STARTS = 8  # normals from which planes are looked for
_ALIKE, _SAME_NORMAL = 0.95, 0.99  # cosine between normals on one plane, and of those looked from once, and more
_BAND = 0.02  # of the diagonal of the places' bounding box, within which those on one plane lie
# Grounds and rooms
LEVEL = 0.996  # cosine between a plane's normal and z: 5 degrees
_OFF_PLANE, _NEARLY_ALL = 1.5, 0.8  # cells off a plane, and how much of what lies so far off is on one side of it
_BEARS, _OF_GROUND = 0.1, 0.25  # of the cells lie on a plane that bears something, and on one that is the ground
_ANYTHING = 0.02  # of the cells lies off the ground at least, and of those, under it at most
_NEARLY_EVERYTHING = 0.02, 0.98  # quantiles
_WITHIN_GROUND = 0.6  # of the ground's area is at most that of all that stands on it
_PARALLEL, _ASIDE = 0.9, 0.2  # cosines between normals on one plane, and on those at right angles
_UNEVEN = 0.5  # variance of the points in a cell, beyond that of chance, in squares of their mean
_TOGETHER, _IN_STEP = 0.2, 0.8  # correlation, at least, of how densely points lie on either, by the logarithm; of parts
_APART = 4  # cells between floor and ceiling, at least
_FLOOR_AND_CEILING = 0.25  # of the cells lie on either of them, at least
_COLUMN = 1.5  # cells along which they are compared
_OVER_EACH_OTHER, _HALF_OVER = 0.7, 0.5  # of the floor has a ceiling over it; of parts
_IN_ONE, _BEYOND = 0.9, 0.02  # of both are in one piece, at least; and of the cells are below or above, at most


class DominantPlane(NamedTuple):
    """The plane on which most of some places lie.

    Attributes
    ----------
    normal : (3,) float64, unit
    offset : float
        Of the plane along its normal, in the places' unit.
    fraction : float, 0..1
        Of the places on it.
    """

    normal: NDArray[np.float64]
    offset: float
    fraction: float


def dominant_plane(places: NDArray[np.float64], normals: NDArray[np.float64]) -> DominantPlane:
    """The plane on which most of n places lie, (n, 3), with normals towards either side, (n, 3).

    Some of the normals, and the commonest direction of all, each give way to the commonest direction near them; the
    plane is the band across one of these that holds most places with such normals. The commonest direction of all alone
    is turned aside by whatever else there is: by the sides of a crate on a table, 10 degrees.
    """
    some = normals[np.linspace(0, len(normals) - 1, _STARTS).astype(np.int64)]
    band = _BAND * float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))
    best, tried = DominantPlane(np.array([0.0, 0.0, 1.0]), 0.0, 0.0), np.zeros((0, 3))
    for start in (_commonest(normals), *some):
        if _alike(tried, start, _SAME_NORMAL).any():
            continue
        near = _alike(normals, start)
        normal = _commonest(normals[near]) if near.any() else start
        tried = np.concatenate((tried, start[None], normal[None]))
        offsets = np.sort(np.einsum("ij,j->i", places[_alike(normals, normal)], normal))
        if not len(offsets):
            continue
        within = np.searchsorted(offsets, offsets + band, "right") - np.arange(len(offsets))
        first = int(np.argmax(within))
        fraction = float(within[first]) / len(places)
        if fraction > best.fraction:
            best = DominantPlane(normal, float(np.median(offsets[first : first + within[first]])), fraction)
    return best


def _alike(normals: NDArray[np.float64], normal: NDArray[np.float64], least: float = _ALIKE) -> NDArray[np.bool_]:
    return np.abs(np.einsum("ij,j->i", normals, normal)) > least


def _commonest(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit direction, (3,), with the largest mean square cosine to normals, (n, 3)."""
    direction: NDArray[np.float64] = np.linalg.eigh(np.einsum("ij,ik->jk", normals, normals))[1][:, -1]
    return direction


class SupportingPlane(NamedTuple):
    """The supporting plane: the ground, a table, or a wall behind things.

    Attributes
    ----------
    upwards : (3,) float64, unit
        Its normal, to where nearly all the rest stands; or z, where that lies on both sides of each plane.
    offset : float
        Of the plane along it; -inf where there is none.
    is_ground : bool
        Whether it is level, and reaches beyond all that stands on it, or lies in a hollow of it.
    """

    upwards: NDArray[np.float64]
    offset: float
    is_ground: bool


def supporting_plane(coarse: VoxelGrid, normals: NDArray[np.float64]) -> SupportingPlane:
    """The plane on which most cells lie, if nearly all the rest is on one side of it."""
    normal, offset, fraction = dominant_plane(coarse.centroids, normals)
    heights = np.einsum("ij,j->i", coarse.centroids, normal) - offset
    is_rest = np.abs(heights) > _OFF_PLANE * coarse.size
    above, below = heights[is_rest & (heights > 0.0)].sum(), -heights[is_rest & (heights < 0.0)].sum()
    if fraction < _BEARS or max(above, below) <= _NEARLY_ALL * (above + below):
        return SupportingPlane(np.array([0.0, 0.0, 1.0]), -np.inf, False)
    if above < below:
        normal, offset, heights = -normal, -offset, -heights
    is_ground = (
        abs(normal[2]) >= LEVEL
        and fraction >= _OF_GROUND
        and np.mean(is_rest) >= _ANYTHING
        and np.mean(heights[is_rest] < 0.0) <= _ANYTHING
        and _level_area(coarse.centroids[is_rest]) < _WITHIN_GROUND * _level_area(coarse.centroids[~is_rest])
    )
    return SupportingPlane(normal, offset, bool(is_ground))


def _level_area(places: NDArray[np.float64]) -> float:
    """Area of the rectangle along x and y that holds nearly all places."""
    low, high = np.quantile(places[:, :2], _NEARLY_EVERYTHING, axis=0)
    return float(np.prod(high - low))


def is_scanned_room(
    centres: NDArray[np.float64], normals: NDArray[np.float64], points: NDArray[np.float64], size: float
) -> bool:
    """Whether cells of a size, at n places, (n, 3), with either normals, (n, 3), that hold so many points each, (n,),
    were seen from tripods between a floor and a ceiling.

    These are two parallel planes: across z, or the normal of the densest plane, or of the densest of those at right
    angles to that; perhaps opposite walls. Both are in one piece, either covers nearly what the other does, and nothing
    is below or above: boxes in a row, of which all sides were seen, have gaps between. What was seen elsewhere, through
    a window, does not count. A closed box alone may be a thing. But who stands in a room is near to floor and ceiling
    at the same place, and there points lie the denser on both; before a thing one of two opposite sides is seen. Where
    they do so nearly everywhere, both may be in parts, as halfway between two tripods far apart.
    """
    mean = float(points.mean())
    if points.var() - mean < _UNEVEN * mean * mean:  # not more than points at random would
        return False
    z, densest = np.array([0.0, 0.0, 1.0]), dominant_plane(centres, normals).normal
    aside = np.abs(np.einsum("ij,j->i", normals, densest)) < _ASIDE
    axes = [z, densest]
    if aside.any():
        axes.append(dominant_plane(centres[aside], normals[aside]).normal)
    return any(_bound_a_room(centres, normals, points, size, axis) for axis in axes)


def _bound_a_room(
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    points: NDArray[np.float64],
    size: float,
    axis: NDArray[np.float64],
) -> bool:
    """Whether the two densest planes across an axis are floor and ceiling as `is_scanned_room` says."""
    heights = np.einsum("ij,j->i", centres, axis) / size
    level = np.abs(np.einsum("ij,j->i", normals, axis)) > _PARALLEL
    if not level.any():
        return False
    layers, counts = np.unique(np.floor(heights[level]), return_counts=True)
    pairs = counts + np.where(np.diff(layers, append=np.inf) == 1.0, np.append(counts[1:], 0), 0)  # planes lie between
    first = int(np.argmax(pairs))
    second = int(np.argmax(np.where(np.abs(layers - layers[first]) > _APART, pairs, 0)))
    floor, ceiling = np.sort(layers[[first, second]]) + 1.0
    on_floor, on_ceiling = (level & (np.abs(heights - height) < _OFF_PLANE) for height in (floor, ceiling))
    if first == second or np.mean(on_floor | on_ceiling) < _FLOOR_AND_CEILING:
        return False
    flat = np.zeros_like(centres)
    flat[:, :2] = np.einsum("ij,kj->ik", centres, plane_basis(axis))
    columns = voxel_grid(flat, _COLUMN * size, Warp())
    of_cell = columns.voxel_of_point
    n_floor, n_ceiling = (np.bincount(of_cell, on, columns.n_voxels) for on in (on_floor, on_ceiling))
    has_either, has_both = (n_floor > 0.0) | (n_ceiling > 0.0), (n_floor > 0.0) & (n_ceiling > 0.0)
    touching = columns.touching_pairs()
    piece = connected_components(touching[has_either[touching].all(axis=1)], columns.n_voxels)
    beyond = has_either[of_cell] & ((heights < floor - _OFF_PLANE) | (heights > ceiling + _OFF_PLANE))
    most = max(np.count_nonzero(n_floor), np.count_nonzero(n_ceiling))
    covered, in_one = np.count_nonzero(has_both) / most, np.bincount(piece[has_either]).max()
    if covered < _HALF_OVER or np.mean(beyond) > _BEYOND:
        return False
    in_parts = covered < _OVER_EACH_OTHER or in_one < _IN_ONE * np.count_nonzero(has_either)
    of_floor, of_ceiling = (
        np.log(np.bincount(of_cell, on * points, columns.n_voxels)[has_both] / n[has_both])
        for on, n in ((on_floor, n_floor), (on_ceiling, n_ceiling))
    )
    of_floor, of_ceiling = of_floor - of_floor.mean(), of_ceiling - of_ceiling.mean()
    spreads = float(of_floor.std() * of_ceiling.std())
    together = float(np.mean(of_floor * of_ceiling))
    return spreads > 0.0 and together >= (_IN_STEP if in_parts else _TOGETHER) * spreads
