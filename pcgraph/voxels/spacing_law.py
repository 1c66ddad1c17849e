# SPDX-License-Identifier: Apache-2.0
"""Spacing that grows with range: one scan, and the place from which it was taken."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, summing_routine
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.directions import sphere_directions
from pcgraph.voxels.eigen import SYMMETRIC_INDICES, plane_normal
from pcgraph.voxels.ground_and_rooms import dominant_plane
from pcgraph.voxels.rings import Rows, scanner_of_rings
from pcgraph.voxels.sampling import order_of_draw, sample

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_READINGS = 1 << 10  # how many readings of the spacing count
_MIN_READINGS = 1 << 8  # with fewer the law is not looked for
_NEIGHBOUR = 8
_MIN_SAMPLE = 512  # places of a block whose neighbours are sought
_STARTS, _APART, _FIRST_STEP = 6, 0.3, 0.1  # of the search for a place, lengths in half diagonals
_MOVES = np.concatenate((np.zeros((1, 3)), np.eye(3), -np.eye(3), sphere_directions(8)))
_MIN_RANGE = 1e-3  # in half extents
_SHORT_STEP = 0.1  # in half extents: of a place that was found with readings that do not count
_TINY, _FAR = float(np.finfo(np.float64).tiny), float(np.finfo(np.float32).max)
_ROUNDING = 1e-12  # variance of readings that are all alike, about, as logarithms are in single precision
_MIN_EXPLAINED = 0.55  # mean of what law and range explain
_AT_VIEWPOINT = 0.05  # median ranges: so near to a viewpoint is the place that rings tell
_MIN_ON_RINGS = 0.2  # the same where rings tell the place
_MIN_EXPONENT = 0.5
_MAX_EXPONENT = 1.5
_WIDE_SPAN = 3.0  # of the ranges, from a tenth to nine tenths of the readings: over this the law is looked at in halves
_MIN_EXPONENT_OF_HALF = 0.3
_ENDS, _MIN_OF_MOST = 0.1, 0.7  # of the readings, nearest and farthest; exponent of the others, of that of all
_ALIKE = 0.02  # difference of r_squared, at most, of two places that explain as much
_OWN_ORIGIN = 0.05  # difference of r_squared by which another place must beat the frame's origin
_MIN_COSINE = 0.1  # between a surface and the rays that meet it: at less a beam's spacing is that along its rows
_ROW = 0.1  # of the variance along a row of points is at most across it
_PRIOR = 0.1  # of the variance for a deviation of 1 from the exponent of a beam of constant angle, in search of a place


@dataclass(frozen=True, eq=False)
class SpacingLaw(ShortRepr):
    """Spacing in proportion to a power of the range from one place, and to the inverse root of the cosine at which rays
    from there meet the surface: the cloud is one scan, and was taken from there.

    Attributes
    ----------
    viewpoint : (3,) float64, metres
    exponent : float, 0..1.5
        About 1 for a beam of constant angle, more where noise grows with range as well.
    r_squared : float, at most 1
        Fraction of the variance of the spacing's logarithm that the law explains; negative if it is worse than none.
    partial_r_squared : float, 0..1
        Fraction that range explains of what cosines leave. About 0 where all is far, and only the slant of the surfaces
        makes a difference, as seen from the air.
    min_half_exponent : float
        The lesser of the exponents in the near and in the far half of the readings, where ranges differ enough to tell;
        else `exponent`. About 0 where a fine scan of a thing lies within a coarse one of its surroundings.
    trimmed_exponent : float
        The exponent among the readings without those nearest and farthest, a tenth each, of a place that was found;
        else `exponent`. Less where little lies far off and less densely, as a house seen from a window.
    mirrored : (3,) float64, metres, or None
        A place on the other side of what is nearly one plane, if spacing does not tell which of the two it was.
    axis : (3,) float64, or None
        About which a scanner turned, of length 1, either way, if its rings told the place.
    best_viewpoint : (3,) float64, metres, or None
        The place that explains most, if the frame's origin, which explains as much, counts for it.
    """

    viewpoint: NDArray[np.float64]
    exponent: float
    r_squared: float
    partial_r_squared: float
    min_half_exponent: float
    trimmed_exponent: float
    mirrored: NDArray[np.float64] | None = None
    axis: NDArray[np.float64] | None = None
    best_viewpoint: NDArray[np.float64] | None = None

    @property
    def holds(self) -> bool:
        """Whether the law says more than chance would, near and far; or does not gainsay what rings told."""
        least = _MIN_EXPLAINED if self.axis is None else _MIN_ON_RINGS
        grows_everywhere = (
            self.min_half_exponent >= _MIN_EXPONENT_OF_HALF and self.trimmed_exponent >= _MIN_OF_MOST * self.exponent
        )
        explains = (self.r_squared + self.partial_r_squared) / 2.0
        return explains >= least and self.exponent >= _MIN_EXPONENT and grows_everywhere


def spacing_law(
    points: NDArray[np.float64],
    viewpoint: NDArray[np.float64] | None = None,
    of_points: NDArray[np.float64] | None = None,
) -> SpacingLaw:
    """The power law between spacing and range that explains most, over a sample free of the points' order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1.
    viewpoint : (3,) float64, metres, optional
        From where the cloud was seen. Default: the place that explains most, or the origin if it does as well.
    of_points : (m, 3) float64, metres, optional
        Their sample, if it is at hand.

    Notes
    -----
    Rays of constant solid angle meet a surface at distances of r / sqrt(cos), r the range and cos that of the angle
    between ray and normal. Log spacing, by the distance to the eighth neighbour in a thinned cloud, and with the cosine
    taken out, is regressed on log range. Places all around and within the cloud are tried, then moved by ever smaller
    steps; readings far off the line, such as noise, are left out.
    """
    found = _readings(sample(points, bounding_box(points)) if of_points is None else of_points, 2 * _READINGS)
    if len(found.logs) < _MIN_READINGS:
        return SpacingLaw(np.zeros(3) if viewpoint is None else viewpoint, 0.0, 0.0, 0.0, 0.0, 0.0)
    low, high = bounding_box(found.places)
    middle, reach = (low + high) / 2.0, float((high - low).max()) / 2.0
    found = _Readings((found.places - middle) / reach, found.normals, found.logs - math.log(reach))
    every, own, mirrored, best_viewpoint = found.some(slice(None, _READINGS)), viewpoint, None, None
    spread_out = found.some(_between_points_and_surface(found))
    if viewpoint is None:
        place, mirrored = _best_scanner_positions(spread_out)
        near_line = spread_out.some(_on_line(spread_out, place))
        place = _searched(near_line.some(slice(None, None, 2)), place[None], np.array([_SHORT_STEP]), 8)[0][0]
        halved = every
    else:
        place = (viewpoint - middle) / reach
        halved = spread_out.some(_on_line(spread_out, place))  # without its scanner's pole, where readings are many
    kept = _on_line(every, place)
    line = _regressions(every.some(kept), place[None])
    if viewpoint is None:
        origin = -middle / reach
        line_of_origin = _regressions(every.some(kept), origin[None])
        if line_of_origin.r_squared[0] >= line.r_squared[0] - _OWN_ORIGIN:
            best_viewpoint = middle + reach * place
            place, line, own, mirrored = origin, line_of_origin, np.zeros(3), None
    exponent = float(line.exponents[0])
    return SpacingLaw(
        viewpoint=middle + reach * place if own is None else own,
        exponent=exponent,
        r_squared=float(line.r_squared[0]),
        partial_r_squared=float(line.partial_r_squared[0]),
        min_half_exponent=_least_exponent(halved, place, exponent),
        trimmed_exponent=_exponent_of_most(every, place) if viewpoint is None else exponent,
        mirrored=None if mirrored is None else middle + reach * mirrored,
        best_viewpoint=best_viewpoint,
    )


def law_on_rings(
    points: NDArray[np.float64],
    law: SpacingLaw,
    rows: Rows,
    viewpoint: NDArray[np.float64] | None = None,
    of_points: NDArray[np.float64] | None = None,
) -> SpacingLaw:
    """The law about the place that rings of a turning scanner tell, if they do and it holds there; else as it was.

    Parameters
    ----------
    points : (n, 3) float64, metres
    law : SpacingLaw
        Of these points: the place from which that of the rings is searched, or the frame's origin, or the middle.
    rows : Rows
        Of these points.
    viewpoint : (3,) float64, metres, optional
        From where they were seen, which stays; rings about it tell the axis alone.
    of_points : (m, 3) float64, metres, optional
        Their sample, if it is at hand.
    """
    middle = np.median(rows.points, axis=0) if len(rows.points) else np.zeros(3)
    starts = np.stack((law.viewpoint, np.zeros(3), middle)) if viewpoint is None else viewpoint[None]
    scanner = scanner_of_rings(rows, starts)
    if scanner is None:
        return law
    if viewpoint is None:
        there = spacing_law(points, scanner.place, of_points)
    elif _off(scanner.place, viewpoint, rows) <= _AT_VIEWPOINT:
        there = law
    else:
        return law
    about = replace(there, axis=scanner.axis)
    return about if about.holds else law


def _off(place: NDArray[np.float64], viewpoint: NDArray[np.float64], rows: Rows) -> float:
    """Distance of a place from a viewpoint, over the median range of rows."""
    return float(np.linalg.norm(place - viewpoint) / np.median(np.linalg.norm(rows.points - viewpoint, axis=1)))


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


def _readings(chosen: NDArray[np.float64], number: int) -> _Readings:
    """Readings at so many places of a sample, the first."""
    if len(chosen) <= _NEIGHBOUR:
        return _Readings(chosen[:0], chosen[:0], np.empty(0))
    from scipy.spatial import cKDTree

    some, tree = chosen[:number], cKDTree(chosen, 24, balanced_tree=False, compact_nodes=False)
    of_blocks = in_blocks(partial(_spacing_and_normals, tree, some), len(some), smallest=_MIN_SAMPLE)
    usable, spacing, normals = (np.concatenate(column) for column in zip(*of_blocks, strict=True))
    return _Readings(some[usable], normals, np.log(spacing))


def _spacing_and_normals(
    tree: cKDTree, some: NDArray[np.float64], start: int, stop: int
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Whether the eighth neighbours of a block of places tell a spacing, and where they do, it and the normals."""
    near, around = tree.query(some[start:stop], k=_NEIGHBOUR + 1)
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
                scatter[column] += way[SYMMETRIC_INDICES[column][0]] * way[SYMMETRIC_INDICES[column][1]]
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
    order = order_of_draw(np.arange(len(logs), dtype=np.uint64) + np.uint64(1), np.exp(0.5 * (logs - logs.max())))
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
            reach = math.sqrt(x * x + y * y + z * z) + _MIN_RANGE
            cosine = abs(x * nx + y * ny + z * nz) / reach
            cosine = cosine if cosine > _MIN_COSINE else _MIN_COSINE
            ranges[v, i] = reach if reach < _FAR else _FAR
            slants[v, i] = 1.0 if nx * nx + ny * ny + nz * nz == 0.0 else cosine


class _Lines(NamedTuple):
    """Regressions about k viewpoints: what each explains of the variance, exponent, what range explains, (k,) each."""

    r_squared: NDArray[np.float64]
    exponents: NDArray[np.float64]
    partial_r_squared: NDArray[np.float64]


def _regressions(readings: _Readings, viewpoints: NDArray[np.float64], prior: float = 0.0) -> _Lines:
    """The law about each of k viewpoints, (k, 3).

    A prior, in variances, draws exponents to 1 and counts against r_squared.
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
        found.partial_r_squared[v] = 1.0 - left / max(of_y, least)
        found.r_squared[v] = 1.0 - left / max(variance, least) - prior * (slope - 1.0) ** 2
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


def _exponent_of_most(readings: _Readings, viewpoint: NDArray[np.float64]) -> float:
    """The exponent among the readings of middling range."""
    x = _on_law(readings, viewpoint[None])[0][0]
    low, high = np.quantile(x, (_ENDS, 1.0 - _ENDS))
    most = readings.some((x >= low) & (x <= high))
    return float(_regressions(most, viewpoint[None]).exponents[0])


def _best_scanner_positions(readings: _Readings) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
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
    for place in candidates[np.argsort(-_regressions(some, candidates, _PRIOR).r_squared, kind="stable")]:
        if all(np.linalg.norm(place - start) > _APART * reach for start in starts):
            starts.append(place)
            if len(starts) == _STARTS:
                break
    found, steps = _searched(some, np.stack(starts), np.full(len(starts), _FIRST_STEP * reach), 5)
    best = np.argmax(_regressions(half, found, _PRIOR).r_squared, keepdims=True)
    place = _searched(half, found[best], steps[best], 8)[0][0]
    other = _mirrored(place, half)
    other = _searched(half, other[None], np.array([float(np.linalg.norm(other - place)) / 8.0]), 5)[0][0]
    first, second = _regressions(half, np.stack((place, other)), _PRIOR).r_squared
    if second > first:
        place, other = other, place
    return place, other if abs(first - second) < _ALIKE else None


def _mirrored(place: NDArray[np.float64], readings: _Readings) -> NDArray[np.float64]:
    """A place, (3,), on the other side of the plane on which most lies."""
    normal, offset, _ = dominant_plane(readings.places, readings.normals)
    return place - 2.0 * (place @ normal - offset) * normal


def _searched(
    readings: _Readings, places: NDArray[np.float64], steps: NDArray[np.float64], rounds: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each of k places, (k, 3), after steps to where the law explains more, and the length of its next step, (k,)."""
    each = np.arange(len(places))
    for _ in range(rounds):
        tried = places[:, None] + steps[:, None, None] * _MOVES
        r_squared = _regressions(readings, tried.reshape(-1, 3), _PRIOR).r_squared.reshape(tried.shape[:2])
        best = np.argmax(r_squared, axis=1)
        is_better = r_squared[each, best] > r_squared[:, 0] + 1e-4
        places = np.where(is_better[:, None], tried[each, best], places)
        steps = np.where(is_better, steps, 0.5 * steps)
    return places, steps
