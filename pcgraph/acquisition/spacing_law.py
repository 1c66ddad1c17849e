# SPDX-License-Identifier: Apache-2.0
"""The law of spacing over range, which tells whether a cloud is one scan, and from which place it was taken."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.rings import scanner_of_rings
from pcgraph.parallel import in_blocks, kernel, summing_routine
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.rounding import TINY
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.directions import sphere_directions
from pcgraph.voxels.eigen import SYMMETRIC_INDICES, plane_normal
from pcgraph.voxels.ground_and_rooms import dominant_plane
from pcgraph.voxels.sampling import order_of_draw, sample
from pcgraph.voxels.spacing import Rows

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_MOVES = np.concatenate((np.zeros((1, 3)), np.eye(3), -np.eye(3), sphere_directions(8)))
_NEIGHBOUR = 8
"""Rank, a count, of the neighbour whose distance is the spacing; chosen by eye, not varied."""

# Kernels read these.
_FAR = float(np.finfo(np.float32).max)
_MIN_RANGE = 1e-3
"""Half extents added to each range, so that no logarithm of a short one outweighs all others."""
_ROUNDING = 1e-12
"""Variance of log spacing, dimensionless, of readings that differ by single precision alone; chosen by eye."""
_MAX_EXPONENT = 1.5
"""Exponent of range, a ratio, at most: 1 for a constant beam angle, more if noise grows with range; chosen by eye."""
_MIN_COSINE = 0.1
"""Cosine between ray and normal, at least: at a lesser one, spacing is that along the rows of a beam; chosen by eye."""
_ROW_VARIANCE_RATIO = 0.1
"""Ratio of neighbours' variance across their line to that along it: with less they lie in a row; chosen by eye."""


@dataclass(frozen=True)
class LawThresholds:
    """Conditions for the spacing law to hold, and for one of several places to count.

    Set with the tables of the benchmark and thinned sweeps in view; none was varied one by one.
    """

    min_explained: float = 0.55  # mean of `r_squared` and `partial_r_squared`
    min_explained_on_rings: float = 0.2  # the same about a place that rings tell, which needs less evidence
    min_exponent: float = 0.5  # exponent of range; 1 for a beam of constant angle
    wide_span: float = 3.0  # ratio of ranges, from a tenth to nine tenths of the readings: wide enough for two halves
    min_exponent_of_half: float = 0.3  # exponent in the near and in the far half
    trimmed: float = 0.1  # fraction of the readings at either end that `trimmed_exponent` leaves out
    min_trimmed: float = 0.7  # of the exponent: `trimmed_exponent` is that large
    as_good: float = 0.02  # difference of `r_squared` of two places that explain equally much, at most
    better_than_origin: float = 0.05  # difference of `r_squared` by which a place must beat the frame's origin
    at_viewpoint: float = 0.05  # median ranges between a viewpoint and the place that rings tell, if they are one


@dataclass(frozen=True)
class SearchThresholds:
    """Search for the place. Chosen by eye; gains are those of docs/pcgraph_experiments.md."""

    readings: int = 1 << 10  # readings of the spacing that count
    min_readings: int = 1 << 8  # with fewer the law is not looked for
    min_block: int = 512  # places whose neighbours are sought in one thread, at least
    max_spacing: float = 90.0  # percentile of the spacing: more counts as that, as points far off have
    lattice_side: int = 5  # places along each side of a lattice within the box that are tried
    n_outside: int = 40  # places at each distance around it that are tried
    outside: tuple[float, float] = (1.2, 2.0)  # half diagonals: distances from its middle
    starts: int = 6  # places from which it starts: from one, 4 of 88 searches ended outside their room; gain 0.0002
    apart: float = 0.3  # half diagonals of the box between two starts, at least
    first_step: float = 0.1  # half diagonals: short, so that a search does not leave its room
    last_step: float = 0.1  # half extents: first step once readings off the line are left out
    first_rounds: int = 5  # steps, or halvings of the step, from each start
    last_rounds: int = 8  # the same from the best place
    min_improvement: float = 1e-4  # difference of `r_squared` by which a step must be better
    max_deviation: float = 2.5  # robust standard deviations off the line, at most, of a reading that counts
    min_deviation: float = 0.1  # of log spacing: least standard deviation, for readings that fit too well
    prior: float = 0.1  # of the variance, for an exponent 1 off that of a beam of constant angle; gains nothing


_LAW = LawThresholds()
_SEARCH = SearchThresholds()


@dataclass(frozen=True, eq=False)
class SpacingLaw(ShortRepr):
    """The law that spacing follows if a cloud is one scan, about the place from which it was taken.

    Spacing is in proportion to a power of the range from that place, and to the inverse root of the cosine of the angle
    between the rays and the normals of the surface.

    Attributes
    ----------
    viewpoint : (3,) float64, metres
    exponent : float, 0..1.5
        About 1 for a beam of constant angle, more where noise grows with range as well.
    r_squared : float, at most 1
        Fraction of the variance of the spacing's logarithm that the law explains; negative if it is worse than none.
    partial_r_squared : float, 0..1
        Fraction that range explains of the variance that cosines leave. About 0 if all is far off, as seen from the
        air, so that only the slant of the surfaces makes a difference.
    min_half_exponent : float
        The smaller one of the exponents in the near and in the far half of the readings; `exponent` if ranges differ
        too little to tell. About 0 if a fine scan of a thing lies within a coarse one of its surroundings.
    trimmed_exponent : float
        The exponent without the nearest and the farthest tenth of the readings; `exponent` if the viewpoint was given.
        It is less if a few far points lie less densely, as those of a house that was seen from a window.
    mirrored : (3,) float64, metres, or None
        The place on the other side of the plane on which nearly all lies, if it explains spacing equally well.
    axis : (3,) float64, or None
        Axis about which a scanner turned, of length 1 and either sign, if its rings told the place.
    best_viewpoint : (3,) float64, metres, or None
        The place that explains most, if `viewpoint` is the frame's origin because that explains nearly as much.
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
        """Whether the law explains more than chance would, near and far; less is enough if rings told the place."""
        least = _LAW.min_explained if self.axis is None else _LAW.min_explained_on_rings
        grows_everywhere = (
            self.min_half_exponent >= _LAW.min_exponent_of_half
            and self.trimmed_exponent >= _LAW.min_trimmed * self.exponent
        )
        explains = (self.r_squared + self.partial_r_squared) / 2.0
        return explains >= least and self.exponent >= _LAW.min_exponent and grows_everywhere


def spacing_law(
    points: NDArray[np.float64],
    viewpoint: NDArray[np.float64] | None = None,
    of_points: NDArray[np.float64] | None = None,
) -> SpacingLaw:
    """The power law between spacing and range that explains most, over a sample that does not depend on order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1.
    viewpoint : (3,) float64, metres, optional
        Place from which the cloud was seen. Default: the place that explains most, or the frame's origin if that
        explains nearly as much.
    of_points : (m, 3) float64, metres, optional
        A sample of the points, if it is at hand.

    Notes
    -----
    Rays of constant solid angle meet a surface at distances in proportion to r / sqrt(cos), where r is the range and
    cos the cosine between ray and normal. The spacing is the distance to the eighth neighbour in a thinned cloud. Its
    logarithm, without the part of the cosine, is regressed on log range. Places around and within the cloud are tried,
    then moved by ever smaller steps. Readings far off the line, such as noise, are left out.
    """
    found = _readings(sample(points, bounding_box(points)) if of_points is None else of_points, 2 * _SEARCH.readings)
    if len(found.logs) < _SEARCH.min_readings:
        return SpacingLaw(np.zeros(3) if viewpoint is None else viewpoint, 0.0, 0.0, 0.0, 0.0, 0.0)
    low, high = bounding_box(found.places)
    middle, reach = (low + high) / 2.0, float((high - low).max()) / 2.0
    found = _Readings((found.places - middle) / reach, found.normals, found.logs - math.log(reach))
    every, own, mirrored, best_viewpoint = found.some(slice(None, _SEARCH.readings)), viewpoint, None, None
    spread_out = found.some(_between_points_and_surface(found))
    if viewpoint is None:
        place, mirrored = _best_scanner_positions(spread_out)
        near_line = spread_out.some(_on_line(spread_out, place))
        some, step = near_line.some(slice(None, None, 2)), np.array([_SEARCH.last_step])
        place = _searched(some, place[None], step, _SEARCH.last_rounds)[0][0]
        halved = every
    else:
        place = (viewpoint - middle) / reach
        halved = spread_out.some(_on_line(spread_out, place))  # without its scanner's pole, where readings are many
    kept = _on_line(every, place)
    line = _regressions(every.some(kept), place[None])
    if viewpoint is None:
        origin = -middle / reach
        line_of_origin = _regressions(every.some(kept), origin[None])
        if line_of_origin.r_squared[0] >= line.r_squared[0] - _LAW.better_than_origin:
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
    """The law about the place that the rings of a turning scanner tell; `law` itself if they tell none that fits it.

    Parameters
    ----------
    points : (n, 3) float64, metres
    law : SpacingLaw
        The law of these points. The search for the scanner starts from its place, the frame's origin and the middle.
    rows : Rows
        The rows of these points.
    viewpoint : (3,) float64, metres, optional
        Place from which they were seen, if it is given: then rings about it tell the axis alone.
    of_points : (m, 3) float64, metres, optional
        A sample of the points, if it is at hand.
    """
    middle = np.median(rows.points, axis=0) if len(rows.points) else np.zeros(3)
    starts = np.stack((law.viewpoint, np.zeros(3), middle)) if viewpoint is None else viewpoint[None]
    scanner = scanner_of_rings(rows, starts)
    if scanner is None:
        return law
    if viewpoint is None:
        there = spacing_law(points, scanner.place, of_points)
    elif _off(scanner.place, viewpoint, rows) <= _LAW.at_viewpoint:
        there = law
    else:
        return law
    about = replace(there, axis=scanner.axis)
    return about if about.holds else law


def _off(place: NDArray[np.float64], viewpoint: NDArray[np.float64], rows: Rows) -> float:
    """Distance of a place from a viewpoint, over the median range of rows."""
    return float(np.linalg.norm(place - viewpoint) / np.median(np.linalg.norm(rows.points - viewpoint, axis=1)))


class _Readings(NamedTuple):
    """Readings of the spacing at m places of a surface.

    Attributes
    ----------
    places : (m, 3) float64
    normals : (m, 3) float64
        Unit normals of the surface; zero if the points around lie in a row, which tells no normal. Points on one ring
        of a sweep would tell the cone of its beam instead.
    logs : (m,) float64
        Logarithms of the spacing.
    """

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    logs: NDArray[np.float64]

    def some(self, which: NDArray[np.bool_] | NDArray[np.int64] | slice) -> _Readings:
        """The readings at some of the places."""
        return _Readings(*(np.ascontiguousarray(column[which]) for column in self))


def _readings(chosen: NDArray[np.float64], number: int) -> _Readings:
    """Readings at the first places of a sample, as many as asked for."""
    if len(chosen) <= _NEIGHBOUR:
        return _Readings(chosen[:0], chosen[:0], np.empty(0))
    from scipy.spatial import cKDTree

    some, tree = chosen[:number], cKDTree(chosen, 24, balanced_tree=False, compact_nodes=False)
    of_blocks = in_blocks(partial(_spacing_and_normals, tree, some), len(some), smallest=_SEARCH.min_block)
    usable, spacing, normals = (np.concatenate(column) for column in zip(*of_blocks, strict=True))
    return _Readings(some[usable], normals, np.log(spacing))


def _spacing_and_normals(
    tree: cKDTree, some: NDArray[np.float64], start: int, stop: int
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Whether each of a block of places has a spacing, and the spacings and normals of those that do."""
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
    """Set the normals of the planes through patches of places; zero if they lie in a row, or on no plane."""
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
        if least < 0.0 or product < _ROW_VARIANCE_RATIO / (1.0 + _ROW_VARIANCE_RATIO) ** 2 * others * others:
            normals[m] = 0.0


def _between_points_and_surface(readings: _Readings) -> NDArray[np.int64]:
    """Numbers of the readings that count in the search for a place, ascending: drawn with the root of their spacing.

    So their density is between that of the points and that of the surface. Points alone would mislead: at the pole of a
    scanner that turns by equal angles they are many, and nearer to each other than the law says.
    """
    logs = np.minimum(readings.logs, np.percentile(readings.logs, _SEARCH.max_spacing))
    order = order_of_draw(np.arange(len(logs), dtype=np.uint64) + np.uint64(1), np.exp(0.5 * (logs - logs.max())))
    return np.sort(order[: _SEARCH.readings])


def _on_line(readings: _Readings, place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each reading lies near the regression line of all readings about a place; others may be noise."""
    log_range, log_spacing = _on_law(readings, place[None])
    residuals = log_spacing[0] - _regressions(readings, place[None]).exponents[0] * log_range[0]
    residuals -= np.median(residuals)
    spread = 1.4826 * float(np.median(np.abs(residuals)))  # standard deviation, if they are normal
    return np.abs(residuals) <= _SEARCH.max_deviation * max(spread, _SEARCH.min_deviation)


def _on_law(readings: _Readings, viewpoints: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Log range, (k, m), and log spacing without the part of the cosine, (k, m), about each of k viewpoints.

    Most of the search's time is spent here. It is in single precision, as NumPy's logarithms of that are vectorised.
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
    normal, (k, m); 1 if there is no normal."""
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
    """Regressions about k viewpoints, (k,) float64 each; the fields are those of `SpacingLaw`."""

    r_squared: NDArray[np.float64]
    exponents: NDArray[np.float64]
    partial_r_squared: NDArray[np.float64]


def _regressions(readings: _Readings, viewpoints: NDArray[np.float64], prior: float = 0.0) -> _Lines:
    """Regressions of log spacing on log range about each of k viewpoints, (k, 3).

    The prior, a fraction of the variance, pulls exponents towards 1, and r_squared is less for exponents far from 1.
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
    """The smaller one of the exponents in the near and the far half, by medians; `exponent` if the span is small."""
    x, y = (column[0] for column in _on_law(readings, viewpoint[None]))
    order = np.argsort(x, kind="stable")
    if x[order[len(x) * 9 // 10]] - x[order[len(x) // 10]] < math.log(_LAW.wide_span):
        return exponent
    slopes = []
    for half in np.array_split(order, 2):
        third = len(half) // 3
        near, far = half[:third], half[-third:]
        rise = float(np.median(y[far]) - np.median(y[near]))
        slopes.append(rise / max(float(np.median(x[far]) - np.median(x[near])), TINY))
    return min(slopes)


def _exponent_of_most(readings: _Readings, viewpoint: NDArray[np.float64]) -> float:
    """The exponent without the nearest and the farthest tenth of the readings."""
    x = _on_law(readings, viewpoint[None])[0][0]
    low, high = np.quantile(x, (_LAW.trimmed, 1.0 - _LAW.trimmed))
    most = readings.some((x >= low) & (x <= high))
    return float(_regressions(most, viewpoint[None]).exponents[0])


def _best_scanner_positions(readings: _Readings) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """The place, (3,), about which spacing follows the law best; and its mirror image, if that is as good, else None.

    Pattern searches start from several places far apart, as in a room only places near the true one lead to it. A plane
    looks the same from its other side; only what stands on it tells the two sides apart. So the place is compared with
    its mirror image.
    """
    low, high = bounding_box(readings.places)
    reach = float(np.linalg.norm(high - low)) / 2.0
    some, half = readings.some(slice(None, None, 4)), readings.some(slice(None, None, 2))
    steps = (np.arange(_SEARCH.lattice_side) + 0.5) / _SEARCH.lattice_side
    inside = low + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3) * (high - low)
    directions = sphere_directions(_SEARCH.n_outside)
    outside = [(low + high) / 2.0 + far * reach * directions for far in _SEARCH.outside]
    candidates = np.concatenate((inside, *outside))
    starts: list[NDArray[np.float64]] = []
    for place in candidates[np.argsort(-_regressions(some, candidates, _SEARCH.prior).r_squared, kind="stable")]:
        if all(np.linalg.norm(place - start) > _SEARCH.apart * reach for start in starts):
            starts.append(place)
            if len(starts) == _SEARCH.starts:
                break
    first_steps = np.full(len(starts), _SEARCH.first_step * reach)
    found, steps = _searched(some, np.stack(starts), first_steps, _SEARCH.first_rounds)
    best = np.argmax(_regressions(half, found, _SEARCH.prior).r_squared, keepdims=True)
    place = _searched(half, found[best], steps[best], _SEARCH.last_rounds)[0][0]
    other = _mirrored(place, half)
    step = float(np.linalg.norm(other - place)) / 8.0  # an eighth of the way from one to the other
    other = _searched(half, other[None], np.array([step]), _SEARCH.first_rounds)[0][0]
    first, second = _regressions(half, np.stack((place, other)), _SEARCH.prior).r_squared
    if second > first:
        place, other = other, place
    return place, other if abs(first - second) < _LAW.as_good else None


def _mirrored(place: NDArray[np.float64], readings: _Readings) -> NDArray[np.float64]:
    """The mirror image of a place, (3,), on the other side of the plane on which most readings lie."""
    normal, offset, _ = dominant_plane(readings.places, readings.normals)
    return place - 2.0 * (place @ normal - offset) * normal


def _searched(
    readings: _Readings, places: NDArray[np.float64], steps: NDArray[np.float64], rounds: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each of k places, (k, 3), moved by steps to where the law explains more, and its next step's length, (k,)."""
    each = np.arange(len(places))
    for _ in range(rounds):
        tried = places[:, None] + steps[:, None, None] * _MOVES
        r_squared = _regressions(readings, tried.reshape(-1, 3), _SEARCH.prior).r_squared.reshape(tried.shape[:2])
        best = np.argmax(r_squared, axis=1)
        is_better = r_squared[each, best] > r_squared[:, 0] + _SEARCH.min_improvement
        places = np.where(is_better[:, None], tried[each, best], places)
        steps = np.where(is_better, steps, 0.5 * steps)
    return places, steps
