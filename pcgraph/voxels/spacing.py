# SPDX-License-Identifier: Apache-2.0
"""The extent of a cloud, and how densely it samples its surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcgraph.parallel import in_blocks, kernel, routine, summing_routine
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.cells import bounding_box, cell_keys, gallop, sorted_keys, starts_of_runs
from pcgraph.voxels.eigen import AXES, plane_normal
from pcgraph.voxels.warp import Warp

_SAMPLE = 4096  # points whose nearest neighbour is sought
_CROWD = 1 << 16  # points among which it is sought, about
_BLOCKS = 32  # of space, along each axis
_TRIES = 64
_MANY_BESIDE = 512  # points in 27 cells, at most, that are looked at
_FEW_CUT_OFF = 0.05  # of the points have more beside them
_NEARLY_ALL = 0.95  # of the points (in one place: the others are outliers)
_NO_SPACING_M = 0.01
_THIN = 0.01  # of its extent: a cloud whose points, at their spacing, cover so little
_THINNED = 1 << 14  # points among which the law of spacing is looked for,
_READINGS = 1 << 10  # and how many readings of the spacing count
_MIN_READINGS = 1 << 8  # with fewer the law is not looked for
_NEIGHBOUR = 8
_MIN_SAMPLE = 512  # places of a block whose neighbours are sought
_STARTS, _APART, _FIRST_STEP = 6, 0.3, 0.1  # of the search for a place, lengths in half diagonals
_LEAST_RANGE = 1e-3  # in half extents
_SHORT_STEP = 0.1  # in half extents: of a place that was found with readings that do not count
_TINY, _FAR = float(np.finfo(np.float64).tiny), float(np.finfo(np.float32).max)
_ROUNDING = 1e-12  # variance of readings that are all alike, about, as logarithms are in single precision
_MIN_EXPLAINED = 0.55  # mean of what law and range explain
_MIN_HINT, _MIN_BY_RANGE = 0.2, 0.1  # the same, and what range explains alone, of a piece of a scan
_MIN_EXPONENT = 0.5
_MAX_EXPONENT = 1.5
_WIDE_SPAN = 3.0  # of the ranges, from a tenth to nine tenths of the readings: over this the law is looked at in halves
_MIN_EXPONENT_OF_HALF = 0.3
_ALIKE = 0.02  # explained variance: what explains less than this more is no better
_OWN_ORIGIN = 0.05  # explained variance by which another place must beat the frame's origin
_MIN_COSINE = 0.1  # between a surface and the rays that meet it: at less a beam's spacing is that along its rows
_ROW = 0.1  # of the variance along a row of points is at most across it
_PRIOR = 0.1  # of the variance for a deviation of 1 from the exponent of a beam of constant angle, in search of a place


def median_spacing(points: NDArray[np.float64], warp: Warp | None = None) -> float:
    """Median distance to the nearest point elsewhere, metres, over a sample free of the points' order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1. Duplicates count as one point.
    warp : Warp, optional
        To the space in which distances are read, such as that of a camera, whose pixels are as far apart everywhere.
        Default: the points' own.

    Returns
    -------
    float
        > 0; 0.01 if all points coincide. Where most points nearly coincide with another, as in scans laid on each
        other, it is an eighth of the median distance to the eighth (elsewhere that is less), or, if copies are many and
        near, the distance to the nearest other place.

    Notes
    -----
    Source: Lin et al. 2018 start from the same median, their lambda_0. Of large clouds only some blocks of space
    are looked at, all points of each.
    """
    drawn = _some_places(points)
    crowd = _each_place_once(drawn)
    if 2 * len(crowd) < len(drawn) < len(points):  # duplicates took the room of others
        crowd = _each_place_once(_some_places(_each_place_once(points)))
    crowd = crowd if warp is None else warp.forward(crowd)
    spacing = _median_spacing(crowd)
    low, high = bounding_box(crowd)
    if spacing * math.sqrt(len(crowd)) < _THIN * float((high - low).max()):  # perhaps the points are copies of others
        _, cells, held = np.unique(
            np.floor((crowd - low) / (100.0 * spacing)), axis=0, return_index=True, return_counts=True
        )
        of_cells = _median_spacing(crowd[np.sort(cells)])
        if of_cells > 1000.0 * spacing and held.max() < _NEARLY_ALL * len(crowd):
            return of_cells
    return spacing


def _median_spacing(crowd: NDArray[np.float64]) -> float:
    """Median distance to the nearest of distinct points, (n, 3), or an eighth of that to the eighth if that is more.

    Read at the first points. Neighbours are sought in the 27 cells of a grid around each. Only the medians need to be
    known: where the median point has its neighbours farther off than an edge, the cells are too small, and where they
    hold too many to look at all, too large.
    """
    low, high = bounding_box(crowd)
    extent, spacing = float((high - low).max()), 0.0
    edge = _edge_for_neighbours(crowd, low, extent)
    for _ in range(_TRIES):
        if not _TINY < edge < math.inf:
            break
        near, is_cut_off = _near(crowd, low, edge)
        medians = np.median(near[: 2 if len(crowd) > _NEIGHBOUR else 1], axis=1)
        if np.isfinite(medians).all():
            spacing = max(float(medians[0]), float(medians[-1]) / _NEIGHBOUR)
            if is_cut_off.mean() <= _FEW_CUT_OFF:
                break
            edge *= 0.5 if is_cut_off.mean() < _NEARLY_ALL else 0.125
        elif spacing > 0.0:  # cells are too large for some points and too small for others
            break
        else:
            edge *= 2.0
    return spacing if spacing > 0.0 else _NO_SPACING_M


def _edge_for_neighbours(points: NDArray[np.float64], low: NDArray[np.float64], extent: float) -> float:
    """Edge of cells that hold four points each, about, where these lie on surfaces."""
    counts = _blocks_of(points, low, extent / _BLOCKS)[1]
    return 2.0 * extent / _BLOCKS * math.sqrt(np.count_nonzero(counts) / len(points))


def _near(
    crowd: NDArray[np.float64], low: NDArray[np.float64], edge: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Distance to the nearest and to the eighth point, (2, s), from the first of a crowd, infinite where more than the
    edge of a cell; and whether there were too many to look at all, (s,)."""
    keys, pitch = cell_keys((crowd - low) / edge, edge)
    ordered, order = sorted_keys(keys)
    unit = math.ldexp(0.5, math.frexp(edge)[1])  # in which distances neither overflow nor are rounded
    places, reach = crowd.take(order, axis=0) / unit, edge / unit
    sample = np.flatnonzero(order < _SAMPLE)
    near, is_cut_off = np.empty((2, len(sample))), np.empty(len(sample), np.bool_)
    in_blocks(_find_near, len(sample), ordered, pitch, places, reach, sample, near, is_cut_off)
    return unit * near, is_cut_off


@kernel
def _find_near(
    start: int,
    stop: int,
    keys: NDArray[np.int64],
    pitch: tuple[int, int],
    places: NDArray[np.float64],
    reach: float,
    sample: NDArray[np.int64],
    near: NDArray[np.float64],
    is_cut_off: NDArray[np.bool_],
) -> None:
    """Set what `_near` says, within a reach: nine pointers gallop along the sorted keys, the own row's first."""
    n, pointers, squares = len(keys), np.zeros(9, np.int64), np.empty(_NEIGHBOUR)
    for s in range(start, stop):
        own, beside = sample[s], 0
        squares[:] = np.inf
        for row in range(9):
            first = keys[own] + ((row + 4) % 9 // 3 - 1) * pitch[0] + ((row + 4) % 3 - 1) * pitch[1] - 1
            at = pointers[row] = gallop(keys, pointers[row], first)
            while at < n and keys[at] <= first + 2 and beside < _MANY_BESIDE:
                x, y, z = places[at, 0] - places[own, 0], places[at, 1] - places[own, 1], places[at, 2] - places[own, 2]
                square = x * x + y * y + z * z
                if square < squares[_NEIGHBOUR - 1] and at != own:
                    for rank in range(_NEIGHBOUR):  # into its place, without a branch
                        squares[rank], square = min(squares[rank], square), max(squares[rank], square)
                beside += 1
                at += 1
        is_cut_off[s] = beside >= _MANY_BESIDE
        near[0, s] = math.sqrt(squares[0]) if squares[0] <= reach * reach else np.inf
        near[1, s] = math.sqrt(squares[_NEIGHBOUR - 1]) if squares[_NEIGHBOUR - 1] <= reach * reach else np.inf


def _each_place_once(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """One point per place, in the order of their hashes: the first are as good as random, yet the points' own."""
    hashes = np.empty(len(points), np.int64)
    in_blocks(_hash, len(points), points, hashes)
    ordered, order = sorted_keys(hashes)
    return points.take(order[starts_of_runs(ordered)[:-1]], axis=0)


@kernel
def _hash(start: int, stop: int, points: NDArray[np.float64], hashes: NDArray[np.int64]) -> None:
    """Set a whole number per point, 0 to 2**40 - 1, that depends on its place alone, and is hardly ever another's.

    In one of five hundred crowds two of 65 536 places share one, and count as one.
    """
    for p in range(start, stop):  # + 0.0 makes one zero of the two
        x = _mix(np.float64(points[p, 0] + 0.0).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15))
        y = _mix(np.float64(points[p, 1] + 0.0).view(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F))
        z = _mix(np.float64(points[p, 2] + 0.0).view(np.uint64) * np.uint64(0x165667B19E3779F9))
        hashes[p] = np.int64(_mix(x ^ (y >> np.uint64(1)) ^ (z >> np.uint64(2))) >> np.uint64(24))


def _some_places(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """All points, or of large clouds those in some blocks of space."""
    while len(points) > 2 * _CROWD and len(smaller := some_blocks(points)) < len(points):
        points = smaller
    return points


def some_blocks(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points of as many blocks of space as it takes for a crowd, the blocks by their hashes.

    A block is as likely as it holds points: the crowd is as dense as the cloud, however that lies to the axes.
    """
    low, high = bounding_box(points)
    edge = float((high - low).max()) / _BLOCKS
    if not edge > 0.0:
        return points
    block, counts = _blocks_of(points, low, edge)
    occupied = np.flatnonzero(counts)
    counts = counts[occupied]
    order = _order_of_draw(occupied.astype(np.uint64), counts)
    taken = np.zeros(_BLOCKS**3, bool)
    taken[occupied[order]] = np.concatenate(([0], np.cumsum(counts[order])[:-1])) < _CROWD
    return points.take(np.concatenate(in_blocks(_in_taken, len(points), block, taken)), axis=0)


def _blocks_of(
    points: NDArray[np.float64], low: NDArray[np.float64], edge: float
) -> tuple[NDArray[np.int16], NDArray[np.int64]]:
    """Number of the block of space in which each point lies, (n,), and how many points each block holds."""
    block = np.empty(len(points), np.int16)
    return block, sum(in_blocks(_find_block, len(points), points, low, 1.0 / max(edge, _TINY), block))


@kernel
def _find_block(
    start: int, stop: int, points: NDArray[np.float64], low: NDArray[np.float64], scale: float, block: NDArray[np.int16]
) -> NDArray[np.int64]:
    """Set the number of the block of space in which each point lies; how many each block holds."""
    last, counts = _BLOCKS - 1, np.zeros(_BLOCKS**3, np.int64)
    for p in range(start, stop):
        x = min(int((points[p, 0] - low[0]) * scale), last)
        y = min(int((points[p, 1] - low[1]) * scale), last)
        z = min(int((points[p, 2] - low[2]) * scale), last)
        block[p] = (x * _BLOCKS + y) * _BLOCKS + z
        counts[block[p]] += 1
    return counts


@kernel
def _in_taken(start: int, stop: int, block: NDArray[np.int16], taken: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Which of some points lie in blocks that are taken."""
    found, n = np.empty(stop - start + 1, np.int64), 0
    for p in range(start, stop):
        found[n] = p
        n += taken[block[p]]
    return found[:n]


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Whole numbers without a pattern, by one step of a multiplicative hash."""
    spread = values * np.uint64(0xD6E8FEB86659FD93)
    return (spread ^ (spread >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)


_mix = routine(_mixed)  # of one number, for kernels


def _order_of_draw(numbers: NDArray[np.uint64], weights: NDArray[np.number]) -> NDArray[np.int64]:
    """Order in which things are drawn, each as likely the next as its weight says, by what their numbers hash to.

    Notes
    -----
    Source: Efraimidis and Spirakis 2006.
    """
    chances = (_mixed(numbers) >> np.uint64(11)) * 2.0**-53 + 2.0**-54  # 0..1, without both
    return np.argsort(-np.log(chances) / weights, kind="stable")


# --- spacing that grows with range: one scan from one place -----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SpacingLaw(ShortRepr):
    """Spacing in proportion to a power of the range from one place, and to the inverse root of the cosine at which rays
    from there meet the surface: the cloud is one scan, and was taken from there.

    Attributes
    ----------
    viewpoint : (3,) float64, metres
    exponent : float, 0..1.5
        About 1 for a beam of constant angle, more where noise grows with range as well.
    explained : float, at most 1
        Fraction of the variance of the spacing's logarithm that the law explains; negative if it is worse than none.
    by_range : float, 0..1
        Fraction that range explains of what cosines leave. About 0 where all is far, and only the slant of the surfaces
        makes a difference, as seen from the air.
    in_halves : float
        The lesser of the exponents in the near and in the far half of the readings, where ranges differ enough to tell;
        else `exponent`. About 0 where a fine scan of a thing lies within a coarse one of its surroundings.
    mirrored : (3,) float64, metres, or None
        A place on the other side of what is nearly one plane, if spacing does not tell which of the two it was.
    """

    viewpoint: NDArray[np.float64]
    exponent: float
    explained: float
    by_range: float
    in_halves: float
    mirrored: NDArray[np.float64] | None = None

    @property
    def holds(self) -> bool:
        """Whether the law says more than chance would, near and far."""
        return self._tells(_MIN_EXPLAINED) and self.in_halves >= _MIN_EXPONENT_OF_HALF

    @property
    def tells_place(self) -> bool:
        """Whether the place is told, be it by a piece of a scan, over whose ranges spacing hardly changes."""
        return self.holds or (self._tells(_MIN_HINT) and self.by_range >= _MIN_BY_RANGE and self.mirrored is None)

    def _tells(self, least: float) -> bool:
        """Whether law and range explain so much, and spacing grows with range."""
        return (self.explained + self.by_range) / 2.0 >= least and self.exponent >= _MIN_EXPONENT


def spacing_law(points: NDArray[np.float64], viewpoint: NDArray[np.float64] | None = None) -> SpacingLaw:
    """The power law between spacing and range that explains most, over a sample free of the points' order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1.
    viewpoint : (3,) float64, metres, optional
        From where the cloud was seen. Default: the place that explains most, or the origin if it does as well.

    Notes
    -----
    Rays of constant solid angle meet a surface at distances of r / sqrt(cos), r the range and cos that of the angle
    between ray and normal. Log spacing, by the distance to the eighth neighbour in a thinned cloud, and with the cosine
    taken out, is regressed on log range. Places all around and within the cloud are tried, then moved by ever smaller
    steps; readings far off the line, such as noise, are left out.
    """
    found = _readings(points, _READINGS if viewpoint is not None else 2 * _READINGS)
    if len(found.logs) < _MIN_READINGS:
        return SpacingLaw(np.zeros(3) if viewpoint is None else viewpoint, 0.0, 0.0, 0.0, 0.0)
    low, high = bounding_box(found.places)
    middle, reach = (low + high) / 2.0, float((high - low).max()) / 2.0
    found = _Readings((found.places - middle) / reach, found.normals, found.logs - math.log(reach))
    every, own, mirrored = found.some(slice(None, _READINGS)), viewpoint, None
    if viewpoint is None:
        spread_out = found.some(_between_points_and_surface(found))
        place, mirrored = _most_telling_places(spread_out)
        near_line = spread_out.some(_on_line(spread_out, place))
        place = _searched(near_line.some(slice(None, None, 2)), place[None], np.array([_SHORT_STEP]), 8)[0][0]
    else:
        place = (viewpoint - middle) / reach
    kept = _on_line(every, place)
    line = _regressions(every.some(kept), place[None])
    if viewpoint is None:
        origin = -middle / reach
        line_of_origin = _regressions(every.some(kept), origin[None])
        if line_of_origin.explained[0] >= line.explained[0] - _OWN_ORIGIN:
            place, line, own, mirrored = origin, line_of_origin, np.zeros(3), None
    return SpacingLaw(
        viewpoint=middle + reach * place if own is None else own,
        exponent=float(line.exponents[0]),
        explained=float(line.explained[0]),
        by_range=float(line.by_range[0]),
        in_halves=_least_exponent(every, place, float(line.exponents[0])),
        mirrored=None if mirrored is None else middle + reach * mirrored,
    )


class _Readings(NamedTuple):
    """How densely a surface is sampled at m places.

    Attributes
    ----------
    places : (m, 3) float64
    normals : (m, 3) float64
        Unit normals of the surface; zero where the points around tell none, as they lie in a row, like those on one
        ring of a sweep, which lie on the cone of its beam.
    logs : (m,) float64
        Logarithms of the spacing.
    """

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    logs: NDArray[np.float64]

    def some(self, which: NDArray[np.bool_] | NDArray[np.int64] | slice) -> _Readings:
        """Those of some places."""
        return _Readings(*(np.ascontiguousarray(column[which]) for column in self))


def _readings(points: NDArray[np.float64], number: int) -> _Readings:
    """Readings at so many places in a cloud thinned by the points' hashes, in an order as good as random."""
    chosen = points
    if len(points) > _THINNED:
        limit = np.uint64(_THINNED / len(points) * 2.0**64)
        chosen = points.take(np.concatenate(in_blocks(_thin, len(points), points, limit)), axis=0)
    if len(chosen):
        chosen = _each_place_once(chosen)
    if len(chosen) <= _NEIGHBOUR:
        return _Readings(chosen[:0], chosen[:0], np.empty(0))
    sample, tree = chosen[:number], cKDTree(chosen, 24, balanced_tree=False, compact_nodes=False)
    of_blocks = in_blocks(partial(_spacing_and_normals, tree, sample), len(sample), smallest=_MIN_SAMPLE)
    usable, spacing, normals = (np.concatenate(column) for column in zip(*of_blocks, strict=True))
    return _Readings(sample[usable], normals, np.log(spacing))


def _spacing_and_normals(
    tree: cKDTree, sample: NDArray[np.float64], start: int, stop: int
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Whether the eighth neighbours of a block of places tell a spacing, and where they do, it and the normals."""
    near, around = tree.query(sample[start:stop], k=_NEIGHBOUR + 1)
    usable = np.isfinite(near[:, -1]) & (near[:, -1] > 0.0)
    spacing = near[usable, -1]
    normals = np.empty((len(spacing), 3))
    _fit_normals(np.asarray(tree.data), around[usable], spacing, normals)
    return usable, spacing, normals


@kernel
def _fit_normals(
    places: NDArray[np.float64], around: NDArray[np.int64], spacing: NDArray[np.float64], normals: NDArray[np.float64]
) -> None:
    """Set the normals of the planes through patches of places, zero where these lie in a row, or on no plane."""
    scatter, mean, way = np.empty(6), np.empty(3), np.empty(3)
    for m in range(len(around)):
        mean[:] = 0.0
        for p in around[m]:
            for axis in range(3):
                mean[axis] += (places[p, axis] - places[around[m, 0], axis]) / spacing[m]
        mean /= around.shape[1]
        scatter[:] = 0.0
        for p in around[m]:
            for axis in range(3):
                way[axis] = (places[p, axis] - places[around[m, 0], axis]) / spacing[m] - mean[axis]
            for column in range(6):
                scatter[column] += way[AXES[column][0]] * way[AXES[column][1]]
        least = plane_normal(scatter, normals[m])
        xx, yy, zz, xy, xz, yz = scatter
        others = xx + yy + zz - least  # sum and product of the other two spreads
        product = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz - least * others
        if least < 0.0 or product < _ROW / (1.0 + _ROW) ** 2 * others * others:
            normals[m] = 0.0


def _between_points_and_surface(readings: _Readings) -> NDArray[np.int64]:
    """Which readings, ascending, count in the search for a place: drawn by the root of their spacing.

    So they lie between as points and as surface lie: at the pole of a scanner that turns by equal angles points are
    many, and not as far apart as the law says.
    """
    logs = np.minimum(readings.logs, np.percentile(readings.logs, 90))  # not for points far off
    order = _order_of_draw(np.arange(len(logs), dtype=np.uint64) + np.uint64(1), np.exp(0.5 * (logs - logs.max())))
    return np.sort(order[:_READINGS])


def _on_line(readings: _Readings, place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which readings lie near the line through all of them about a place; others may be noise."""
    log_range, log_spacing = _on_law(readings, place[None])
    residuals = log_spacing[0] - _regressions(readings, place[None]).exponents[0] * log_range[0]
    residuals -= np.median(residuals)
    return np.abs(residuals) <= 2.5 * max(1.4826 * float(np.median(np.abs(residuals))), 0.1)


def _on_law(readings: _Readings, viewpoints: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Log range, (k, m), and log spacing as it were if rays from each of k viewpoints met the surface at right angles.

    Logarithms of NumPy in single precision are taken in lanes, and so is all else here: most of the search's time.
    """
    ranges, slants = np.empty((2, len(viewpoints), len(readings.logs)), np.float32)
    places, normals = np.ascontiguousarray(readings.places.T), np.ascontiguousarray(readings.normals.T)
    _look_along_rays(places, normals, viewpoints, ranges, slants)
    np.log(ranges, out=ranges)
    np.log(slants, out=slants)
    slants *= np.float32(0.5)
    slants += readings.logs.astype(np.float32)
    return ranges, slants


@kernel
def _look_along_rays(
    places: NDArray[np.float64],
    normals: NDArray[np.float64],
    viewpoints: NDArray[np.float64],
    ranges: NDArray[np.float32],
    slants: NDArray[np.float32],
) -> None:
    """Set the range of each of m places, (3, m), from each of k viewpoints, (k, m), and the cosine between ray and
    normal, 1 where there is no normal. No range is so short that its logarithm outweighs all others."""
    for v in range(len(viewpoints)):
        px, py, pz = viewpoints[v]
        for i in range(places.shape[1]):
            x, y, z = places[0, i] - px, places[1, i] - py, places[2, i] - pz
            nx, ny, nz = normals[0, i], normals[1, i], normals[2, i]
            reach = math.sqrt(x * x + y * y + z * z) + _LEAST_RANGE
            cosine = abs(x * nx + y * ny + z * nz) / reach
            cosine = cosine if cosine > _MIN_COSINE else _MIN_COSINE
            ranges[v, i] = reach if reach < _FAR else _FAR
            slants[v, i] = 1.0 if nx * nx + ny * ny + nz * nz == 0.0 else cosine


class _Lines(NamedTuple):
    """Regressions about k viewpoints: what each explains of the variance, exponent, what range explains, (k,) each."""

    explained: NDArray[np.float64]
    exponents: NDArray[np.float64]
    by_range: NDArray[np.float64]


def _regressions(readings: _Readings, viewpoints: NDArray[np.float64], prior: float = 0.0) -> _Lines:
    """The law about each of k viewpoints, (k, 3).

    A prior, in variances, draws exponents to 1 and counts against what is explained.
    """
    found = _Lines(*np.empty((3, len(viewpoints))))
    _regress(readings.logs, *_on_law(readings, viewpoints), prior, found)
    return found


@kernel
def _regress(
    logs: NDArray[np.float64],
    log_ranges: NDArray[np.float32],
    log_spacings: NDArray[np.float32],
    prior: float,
    found: _Lines,
) -> None:
    """Set what `_regressions` returns."""
    variance, least = _sums_of_squares(logs, logs)[0], _ROUNDING * len(logs)
    for v in range(len(log_ranges)):
        of_x, of_y, products = _sums_of_squares(log_ranges[v], log_spacings[v])
        slope = (products + prior * variance) / max(of_x + prior * variance, least)
        slope = min(max(slope, 0.0), _MAX_EXPONENT)
        left = of_y - slope * (2.0 * products - slope * of_x)
        found.by_range[v] = 1.0 - left / max(of_y, least)
        found.explained[v] = 1.0 - left / max(variance, least) - prior * (slope - 1.0) ** 2
        found.exponents[v] = slope


@summing_routine
def _sums_of_squares(x: NDArray[np.floating], y: NDArray[np.floating]) -> tuple[float, float, float]:
    """Sums of the squares of two columns, and of their products, about their means."""
    n = len(x)
    sum_x = sum_y = of_x = of_y = products = 0.0
    for i in range(n):
        sum_x += x[i]
        sum_y += y[i]
    for i in range(n):
        from_x, from_y = x[i] - sum_x / n, y[i] - sum_y / n
        of_x += from_x * from_x
        of_y += from_y * from_y
        products += from_x * from_y
    return of_x, of_y, products


def _least_exponent(readings: _Readings, viewpoint: NDArray[np.float64], exponent: float) -> float:
    """The lesser of the exponents in the near and the far half, by medians; `exponent` where the span is small."""
    x, y = (column[0] for column in _on_law(readings, viewpoint[None]))
    order = np.argsort(x, kind="stable")
    if x[order[len(x) * 9 // 10]] - x[order[len(x) // 10]] < math.log(_WIDE_SPAN):
        return exponent
    slopes = []
    for half in np.array_split(order, 2):
        third = len(half) // 3
        near, far = half[:third], half[-third:]
        rise = float(np.median(y[far]) - np.median(y[near]))
        slopes.append(rise / max(float(np.median(x[far]) - np.median(x[near])), _TINY))
    return min(slopes)


def _most_telling_places(readings: _Readings) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """The place, (3,), about which spacing follows the law best, found by pattern searches around the cloud.

    In a room only places near the true one lead to it, so the search starts from several, far apart. A plane looks the
    same from its other side. Only what stands on it tells them apart, so both are compared; where that does not tell
    either, the second place is the other.
    """
    low, high = bounding_box(readings.places)
    reach = float(np.linalg.norm(high - low)) / 2.0
    some, half = readings.some(slice(None, None, 4)), readings.some(slice(None, None, 2))
    steps = (np.arange(5) + 0.5) / 5
    inside = low + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3) * (high - low)
    outside = [(low + high) / 2.0 + far * reach * sphere_directions(40) for far in (1.2, 2.0)]
    candidates = np.concatenate((inside, *outside))
    starts: list[NDArray[np.float64]] = []
    for place in candidates[np.argsort(-_regressions(some, candidates, _PRIOR).explained, kind="stable")]:
        if all(np.linalg.norm(place - start) > _APART * reach for start in starts):
            starts.append(place)
            if len(starts) == _STARTS:
                break
    found, steps = _searched(some, np.stack(starts), np.full(len(starts), _FIRST_STEP * reach), 5)
    best = np.argmax(_regressions(half, found, _PRIOR).explained, keepdims=True)
    place = _searched(half, found[best], steps[best], 8)[0][0]
    other = _mirrored(place, half)
    other = _searched(half, other[None], np.array([float(np.linalg.norm(other - place)) / 8.0]), 5)[0][0]
    first, second = _regressions(half, np.stack((place, other)), _PRIOR).explained
    if second > first:
        place, other = other, place
    return place, other if abs(first - second) < _ALIKE else None


def _mirrored(place: NDArray[np.float64], readings: _Readings) -> NDArray[np.float64]:
    """A place, (3,), on the other side of the plane on which most lies."""
    normal, offset = densest_plane(readings.places, readings.normals)
    return place - 2.0 * (place @ normal - offset) * normal


def densest_plane(places: NDArray[np.float64], normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The plane on which most of n places lie, (n, 3), with normals towards either side: unit normal, (3,), and offset.

    It has the commonest normal, and lies amid the narrowest quarter of all offsets along it.
    """
    normal = np.linalg.eigh(np.einsum("ij,ik->jk", normals, normals))[1][:, -1]
    offsets = np.sort(np.einsum("ij,j->i", places, normal))
    quarter = len(offsets) // 4
    first = int(np.argmin(offsets[quarter:] - offsets[: len(offsets) - quarter]))
    return normal, float(offsets[first + quarter // 2])


def _searched(
    readings: _Readings, places: NDArray[np.float64], steps: NDArray[np.float64], rounds: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each of k places, (k, 3), after steps to where the law explains more, and the length of its next step, (k,)."""
    each = np.arange(len(places))
    for _ in range(rounds):
        tried = places[:, None] + steps[:, None, None] * _MOVES
        explained = _regressions(readings, tried.reshape(-1, 3), _PRIOR).explained.reshape(tried.shape[:2])
        best = np.argmax(explained, axis=1)
        is_better = explained[each, best] > explained[:, 0] + 1e-4
        places = np.where(is_better[:, None], tried[each, best], places)
        steps = np.where(is_better, steps, 0.5 * steps)
    return places, steps


def sphere_directions(n: int) -> NDArray[np.float64]:
    """Unit vectors evenly over the sphere, (n, 3) float64, from +z downwards: a Fibonacci lattice."""
    number = np.arange(n) + 0.5
    z = 1.0 - 2.0 * number / n
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z * z)
    return np.stack((across * np.cos(angle), across * np.sin(angle), z), axis=1)


_MOVES = np.concatenate((np.zeros((1, 3)), np.eye(3), -np.eye(3), sphere_directions(8)))  # of a search


@kernel
def _thin(start: int, stop: int, points: NDArray[np.float64], limit: np.uint64) -> NDArray[np.int64]:
    """Those of some points of whose place a hash lies below a limit."""
    bits = points.view(np.uint64)
    found, n = np.empty(stop - start + 1, np.int64), np.int64(0)
    for p in range(start, stop):
        h = np.uint64(0x9E3779B97F4A7C15)
        for axis in range(3):
            h ^= bits[p, axis] if points[p, axis] != 0.0 else np.uint64(0)
            h *= np.uint64(0xD6E8FEB86659FD93)
            h ^= h >> np.uint64(32)
        h *= np.uint64(0xC2B2AE3D27D4EB4F)
        h ^= h >> np.uint64(29)
        h *= np.uint64(0xD6E8FEB86659FD93)
        found[n] = p
        n += h < limit
    return found[:n]
