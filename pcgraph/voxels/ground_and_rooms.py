# SPDX-License-Identifier: Apache-2.0
"""The densest planes of a cloud: the ground or a table that bears the rest; the floor and ceiling of a room."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.voxels.directions import plane_basis
from pcgraph.voxels.grid import VoxelGrid, voxel_grid
from pcgraph.voxels.warp import Warp

LEVEL = 0.996
"""Cosine between a normal and the vertical, 5 degrees, from which on a plane is level; chosen by eye, not varied."""
_OFF_PLANE = 1.5
"""Cell edges between a plane and what lies on it, at most; chosen by eye, not varied."""


@dataclass(frozen=True)
class PlaneThresholds:
    """Search for the plane on which most lies. Chosen by eye; none was varied."""

    n_starts: int = 8  # normals from which planes are looked for
    same_plane: float = 0.95  # cosine between normals on one plane, 18 degrees
    same_normal: float = 0.99  # cosine between two starts that are one, 8 degrees
    band: float = 0.02  # of the diagonal of the bounding box: width of the band in which a plane lies


@dataclass(frozen=True)
class GroundThresholds:
    """Conditions for a plane to bear the rest, and to be the ground. Chosen by eye; none was varied."""

    min_one_sided: float = 0.8  # fraction of the rest, weighted by distance, that is on one side of the plane
    min_fraction: float = 0.1  # fraction of the cells on a plane that bears the rest
    min_fraction_of_ground: float = 0.25  # the same on the ground
    min_off: float = 0.02  # fraction of the cells off the ground, at least: something stands on it
    max_below: float = 0.02  # fraction of these that lies below it, at most
    quantiles: tuple[float, float] = (0.02, 0.98)  # along x and y, between which areas are measured
    max_area: float = 0.6  # area of what stands on the ground over that of the ground: it reaches beyond


@dataclass(frozen=True)
class RoomThresholds:
    """Conditions for two parallel planes to be the floor and the ceiling of a scanned room.

    Without this, empty corridors are inside out: nothing else tells them from crates.

    Correlations are of the logarithms of the points per column on floor and on ceiling. In rooms they are 0.1 to 0.96,
    in halls between two tripods 0.89 to 0.97. The others were chosen by eye.
    """

    parallel: float = 0.9  # cosine between normals and the axis, 26 degrees
    across: float = 0.2  # cosine between normals and the densest plane's normal, 78 degrees or more
    min_variance: float = 0.5  # variance of the points per cell beyond that of chance, in squares of their mean
    min_distance: float = 4.0  # cells between floor and ceiling
    min_fraction: float = 0.25  # fraction of the cells on either
    column: float = 1.5  # cell edges: width of the columns in which floor and ceiling are compared
    min_covered: float = 0.7  # fraction of the columns of the larger one that have both
    min_covered_in_parts: float = 0.5  # the same if the densities of both agree nearly everywhere
    min_in_one_piece: float = 0.9  # fraction of the columns with either that are connected, unless they agree so
    max_beyond: float = 0.02  # fraction of the cells below the floor or above the ceiling
    min_correlation: float = 0.2  # correlation from which on densities agree near the scanners
    min_correlation_in_parts: float = 0.8  # correlation from which on they agree nearly everywhere


_PLANE = PlaneThresholds()
_GROUND = GroundThresholds()
_ROOM = RoomThresholds()


class DominantPlane(NamedTuple):
    """The plane on which most of some places lie.

    Attributes
    ----------
    normal : (3,) float64, unit
    offset : float
        Distance of the plane from the origin along its normal, in the places' unit.
    fraction : float, 0..1
        Fraction of the places that lie on it.
    """

    normal: NDArray[np.float64]
    offset: float
    fraction: float


def dominant_plane(places: NDArray[np.float64], normals: NDArray[np.float64]) -> DominantPlane:
    """The plane on which most of n places lie, (n, 3), given their normals of either sign, (n, 3).

    Some of the normals, and the commonest direction of all, are tried. Each is replaced by the commonest direction of
    the normals near it. The plane is the band across one of these directions that holds most places with such normals.
    The commonest direction of all alone is not enough: the sides of a crate on a table tilt it by 10 degrees.
    """
    some = normals[np.linspace(0, len(normals) - 1, _PLANE.n_starts).astype(np.int64)]
    band = _PLANE.band * float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))
    best, tried = DominantPlane(np.array([0.0, 0.0, 1.0]), 0.0, 0.0), np.zeros((0, 3))
    for start in (_commonest(normals), *some):
        if _alike(tried, start, _PLANE.same_normal).any():
            continue
        near = _alike(normals, start, _PLANE.same_plane)
        normal = _commonest(normals[near]) if near.any() else start
        tried = np.concatenate((tried, start[None], normal[None]))
        on_plane = places[_alike(normals, normal, _PLANE.same_plane)]
        offsets = np.sort(np.einsum("ij,j->i", on_plane, normal))
        if not len(offsets):
            continue
        within = np.searchsorted(offsets, offsets + band, "right") - np.arange(len(offsets))
        first = int(np.argmax(within))
        fraction = float(within[first]) / len(places)
        if fraction > best.fraction:
            best = DominantPlane(normal, float(np.median(offsets[first : first + within[first]])), fraction)
    return best


def _alike(normals: NDArray[np.float64], normal: NDArray[np.float64], least: float) -> NDArray[np.bool_]:
    """Whether each of n normals, (n, 3), is within an angle of another, (3,), given its cosine; signs do not matter."""
    return np.abs(np.einsum("ij,j->i", normals, normal)) > least


def _commonest(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit direction, (3,), of the largest mean square cosine to n normals, (n, 3)."""
    direction: NDArray[np.float64] = np.linalg.eigh(np.einsum("ij,ik->jk", normals, normals))[1][:, -1]
    return direction


class SupportingPlane(NamedTuple):
    """The supporting plane: the ground, a table, or a wall behind things.

    Attributes
    ----------
    upwards : (3,) float64, unit
        Its normal, towards the side on which nearly all the rest lies; z if there is no such plane.
    offset : float
        Distance of the plane from the origin along `upwards`; -inf if there is none.
    is_ground : bool
        Whether it is level and reaches beyond all that stands on it.
    """

    upwards: NDArray[np.float64]
    offset: float
    is_ground: bool


def supporting_plane(coarse: VoxelGrid, normals: NDArray[np.float64]) -> SupportingPlane:
    """The plane on which most cells lie, if nearly all the rest is on one side of it.

    `normals`, (v, 3), are those of the cells, of either sign.
    """
    normal, offset, fraction = dominant_plane(coarse.centroids, normals)
    heights = np.einsum("ij,j->i", coarse.centroids, normal) - offset
    is_rest = np.abs(heights) > _OFF_PLANE * coarse.size
    above, below = heights[is_rest & (heights > 0.0)].sum(), -heights[is_rest & (heights < 0.0)].sum()
    if fraction < _GROUND.min_fraction or max(above, below) <= _GROUND.min_one_sided * (above + below):
        return SupportingPlane(np.array([0.0, 0.0, 1.0]), -np.inf, False)
    if above < below:
        normal, offset, heights = -normal, -offset, -heights
    is_ground = (
        abs(normal[2]) >= LEVEL
        and fraction >= _GROUND.min_fraction_of_ground
        and np.mean(is_rest) >= _GROUND.min_off
        and np.mean(heights[is_rest] < 0.0) <= _GROUND.max_below
        and _level_area(coarse.centroids[is_rest]) < _GROUND.max_area * _level_area(coarse.centroids[~is_rest])
    )
    return SupportingPlane(normal, offset, bool(is_ground))


def _level_area(places: NDArray[np.float64]) -> float:
    """Area of the rectangle along x and y that holds nearly all of some places, (n, 3)."""
    low, high = np.quantile(places[:, :2], _GROUND.quantiles, axis=0)
    return float(np.prod(high - low))


def is_scanned_room(
    centres: NDArray[np.float64], normals: NDArray[np.float64], points: NDArray[np.float64], size: float
) -> bool:
    """Whether n cells are a room that scanners on tripods saw from within, between a floor and a ceiling.

    Floor and ceiling are two parallel planes, perhaps opposite walls. Their normal is z, that of the densest plane, or
    that of the densest plane at right angles to this. They cover nearly the same area, are in one piece, and nothing is
    below or above. (Boxes in a row, of which all sides were seen, have gaps between them.)

    A closed box alone may be a thing that was seen from outside. But a scanner that stands in a room is near to floor
    and ceiling at the same place, so there points lie densely on both. Of a thing that is seen from outside, points lie
    densely on one of two opposite sides. If the densities agree nearly everywhere, floor and ceiling may be in several
    pieces, as halfway between two tripods far apart.

    Parameters
    ----------
    centres : (n, 3) float64
        Mean of the points of each cell.
    normals : (n, 3) float64
        Unit normals of either sign.
    points : (n,) float64
        Number of points in each cell.
    size : float
        Edge length of a cell, in the unit of the centres.
    """
    mean = float(points.mean())
    if points.var() - mean < _ROOM.min_variance * mean * mean:  # no more uneven than points at random
        return False
    z, densest = np.array([0.0, 0.0, 1.0]), dominant_plane(centres, normals).normal
    aside = np.abs(np.einsum("ij,j->i", normals, densest)) < _ROOM.across
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
    """Whether the two densest planes across an axis are floor and ceiling of a room, as `is_scanned_room` says."""
    heights = np.einsum("ij,j->i", centres, axis) / size
    level = np.abs(np.einsum("ij,j->i", normals, axis)) > _ROOM.parallel
    if not level.any():
        return False
    layers, counts = np.unique(np.floor(heights[level]), return_counts=True)
    pairs = counts + np.where(np.diff(layers, append=np.inf) == 1.0, np.append(counts[1:], 0), 0)  # planes lie between
    first = int(np.argmax(pairs))
    second = int(np.argmax(np.where(np.abs(layers - layers[first]) > _ROOM.min_distance, pairs, 0)))
    floor, ceiling = np.sort(layers[[first, second]]) + 1.0
    on_floor, on_ceiling = (level & (np.abs(heights - height) < _OFF_PLANE) for height in (floor, ceiling))
    if first == second or np.mean(on_floor | on_ceiling) < _ROOM.min_fraction:
        return False
    flat = np.zeros_like(centres)
    flat[:, :2] = np.einsum("ij,kj->ik", centres, plane_basis(axis))
    columns = voxel_grid(flat, _ROOM.column * size, Warp())
    of_cell = columns.voxel_of_point
    n_floor, n_ceiling = (np.bincount(of_cell, on, columns.n_voxels) for on in (on_floor, on_ceiling))
    has_either, has_both = (n_floor > 0.0) | (n_ceiling > 0.0), (n_floor > 0.0) & (n_ceiling > 0.0)
    touching = columns.touching_pairs()
    piece = connected_components(touching[has_either[touching].all(axis=1)], columns.n_voxels)
    beyond = has_either[of_cell] & ((heights < floor - _OFF_PLANE) | (heights > ceiling + _OFF_PLANE))
    most = max(np.count_nonzero(n_floor), np.count_nonzero(n_ceiling))
    covered, in_one = np.count_nonzero(has_both) / most, np.bincount(piece[has_either]).max()
    if covered < _ROOM.min_covered_in_parts or np.mean(beyond) > _ROOM.max_beyond:
        return False
    in_parts = covered < _ROOM.min_covered or in_one < _ROOM.min_in_one_piece * np.count_nonzero(has_either)
    of_floor, of_ceiling = (
        np.log(np.bincount(of_cell, on * points, columns.n_voxels)[has_both] / n[has_both])
        for on, n in ((on_floor, n_floor), (on_ceiling, n_ceiling))
    )
    of_floor, of_ceiling = of_floor - of_floor.mean(), of_ceiling - of_ceiling.mean()
    spreads = float(of_floor.std() * of_ceiling.std())
    together = float(np.mean(of_floor * of_ceiling))
    least = _ROOM.min_correlation_in_parts if in_parts else _ROOM.min_correlation
    return spreads > 0.0 and together >= least * spreads
