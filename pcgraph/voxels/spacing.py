# SPDX-License-Identifier: Apache-2.0
"""The extent of a cloud, and how densely it samples its surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcgraph.parallel import in_blocks, kernel
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.cells import bounding_box, cell_keys, gallop, sorted_keys, starts_of_runs

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
_READINGS = 1 << 10  # and at how many of them spacing is read
_MIN_READINGS = 1 << 8  # with fewer the law is not looked for
_NEIGHBOUR = 8
_TRIMMINGS = 2
_LEAST_RANGE = 1e-3  # in half extents
_TINY = float(np.finfo(np.float64).tiny)
_MIN_EXPLAINED = 0.5
_MIN_EXPONENT = 0.5
_MAX_EXPONENT = 1.5
_WIDE_SPAN = 3.0  # of the ranges, from a tenth to nine tenths of the readings: over this the law is looked at in halves
_MIN_EXPONENT_OF_HALF = 0.3
_OWN_ORIGIN = 0.1  # explained variance by which another place must beat the frame's origin


def median_spacing(points: NDArray[np.float64]) -> float:
    """Median distance to the nearest point elsewhere, metres, over a sample free of the points' order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1. Duplicates count as one point.

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
    blocks = np.bincount(_blocks_of(points, low, max(extent, _TINY) / _BLOCKS))
    return 2.0 * extent / _BLOCKS * math.sqrt(np.count_nonzero(blocks) / len(points))


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
                    rank = _NEIGHBOUR - 1
                    while rank > 0 and squares[rank - 1] > square:
                        squares[rank] = squares[rank - 1]
                        rank -= 1
                    squares[rank] = square
                beside += 1
                at += 1
        is_cut_off[s] = beside >= _MANY_BESIDE
        near[0, s] = math.sqrt(squares[0]) if squares[0] <= reach * reach else np.inf
        near[1, s] = math.sqrt(squares[_NEIGHBOUR - 1]) if squares[_NEIGHBOUR - 1] <= reach * reach else np.inf


def _each_place_once(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """One point per place, in the order of their hashes: the first are as good as random, yet the points' own."""
    ordered, order = sorted_keys((_hashes(points) >> np.uint64(1)).astype(np.int64))
    return points.take(order[starts_of_runs(ordered)[:-1]], axis=0)


def _hashes(points: NDArray[np.float64]) -> NDArray[np.uint64]:
    """A whole number per point that depends on its place alone, and differs between places."""
    bits = (points + 0.0).view(np.uint64)  # + 0.0 makes one zero of the two
    odd = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    mixed = _mixed(bits * odd)
    return _mixed(mixed[:, 0] ^ (mixed[:, 1] >> np.uint64(1)) ^ (mixed[:, 2] >> np.uint64(2)))


def _some_places(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """All points, or of large clouds those in some blocks of space."""
    while len(points) > 2 * _CROWD and len(smaller := some_blocks(points)) < len(points):
        points = smaller
    return points


def some_blocks(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points of as many blocks of space as it takes for a crowd, the blocks by their hashes.

    A block is as likely as it holds points (Efraimidis and Spirakis 2006): the crowd is as dense as the cloud, however
    that lies to the axes.
    """
    low, high = bounding_box(points)
    edge = float((high - low).max()) / _BLOCKS
    if not edge > 0.0:
        return points
    block = _blocks_of(points, low, edge)
    counts = np.bincount(block)
    occupied = np.flatnonzero(counts)
    counts = counts[occupied]
    chances = (_mixed(occupied.astype(np.uint64)) >> np.uint64(11)) * 2.0**-53 + 2.0**-54  # 0..1, without both
    order = np.argsort(-np.log(chances) / counts, kind="stable")
    taken = np.zeros(_BLOCKS**3, bool)
    taken[occupied[order]] = np.concatenate(([0], np.cumsum(counts[order])[:-1])) < _CROWD
    return points.take(np.flatnonzero(taken[block]), axis=0)


def _blocks_of(points: NDArray[np.float64], low: NDArray[np.float64], edge: float) -> NDArray[np.int32]:
    """Number of the block of space in which each point lies, (n,)."""
    block = np.empty(len(points), np.int32)
    in_blocks(_find_block, len(points), points, low, edge, block)
    return block


@kernel
def _find_block(
    start: int, stop: int, points: NDArray[np.float64], low: NDArray[np.float64], edge: float, block: NDArray[np.int32]
) -> None:
    """Set the number of the block of space in which each point lies."""
    last = _BLOCKS - 1
    for p in range(start, stop):
        x = min(int((points[p, 0] - low[0]) / edge), last)
        y = min(int((points[p, 1] - low[1]) / edge), last)
        z = min(int((points[p, 2] - low[2]) / edge), last)
        block[p] = (x * _BLOCKS + y) * _BLOCKS + z


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Whole numbers without a pattern, by one step of a multiplicative hash."""
    spread = values * np.uint64(0xD6E8FEB86659FD93)
    return (spread ^ (spread >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)


# --- spacing that grows with range: one scan from one place -----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SpacingLaw(ShortRepr):
    """Spacing in proportion to a power of the range from one place: the cloud is one scan, and was taken from there.

    Attributes
    ----------
    viewpoint : (3,) float64, metres
    exponent : float, 0..1.5
        About 1 for a beam of constant angle, more where noise grows with range as well.
    explained : float, 0..1
        Fraction of the variance of the spacing's logarithm that the law explains.
    in_halves : float
        The lesser of the exponents in the near and in the far half of the readings, where ranges differ enough to tell;
        else `exponent`. About 0 where a fine scan of a thing lies within a coarse one of its surroundings.
    """

    viewpoint: NDArray[np.float64]
    exponent: float
    explained: float
    in_halves: float

    @property
    def holds(self) -> bool:
        """Whether the law says more than chance would, near and far."""
        told = self.explained >= _MIN_EXPLAINED and self.exponent >= _MIN_EXPONENT
        return told and self.in_halves >= _MIN_EXPONENT_OF_HALF


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
    Log spacing, by the distance to the eighth neighbour in a thinned cloud, is regressed on log range. Places all
    around and within the cloud are tried, then moved by ever smaller steps; readings far off the line, such as noise,
    are left out.
    """
    nowhere = SpacingLaw(np.zeros(3) if viewpoint is None else viewpoint, 0.0, 0.0, 0.0)
    places, spacing = _readings(points)
    if len(places) < _MIN_READINGS:
        return nowhere
    low, high = bounding_box(places)
    middle, reach = (low + high) / 2.0, float((high - low).max()) / 2.0
    origin, logs = -middle / reach, np.log(spacing / reach)
    places = (places - middle) / reach
    place = None if viewpoint is None else (viewpoint - middle) / reach
    kept = np.ones(len(logs), bool)
    for _ in range(_TRIMMINGS):
        found = _most_telling_place(places[kept], logs[kept]) if place is None else place
        explained, exponent = _regressions(places[kept], logs[kept], found[None])
        residuals = logs - exponent[0] * np.log(_ranges(places, found))
        residuals -= np.median(residuals[kept])
        spread = 1.4826 * float(np.median(np.abs(residuals[kept])))
        kept = np.abs(residuals) <= 2.5 * max(spread, 0.1)
    if viewpoint is None:
        of_origin, exponent_of_origin = _regressions(places[kept], logs[kept], origin[None])
        if of_origin[0] >= explained[0] - _OWN_ORIGIN:
            in_halves = _least_exponent(places, logs, origin, float(exponent_of_origin[0]))
            return SpacingLaw(np.zeros(3), float(exponent_of_origin[0]), float(of_origin[0]), in_halves)
    in_halves = _least_exponent(places, logs, found, float(exponent[0]))
    return SpacingLaw(middle + reach * found, float(exponent[0]), float(explained[0]), in_halves)


def _readings(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Some places, (m, 3), and the spacing there, (m,), in a cloud thinned by the points' hashes."""
    chosen = points
    if len(points) > _THINNED:
        taken = np.empty(len(points), np.bool_)
        in_blocks(_thin, len(points), points, np.uint64(_THINNED / len(points) * 2.0**64), taken)
        chosen = points.take(np.flatnonzero(taken), axis=0)
    if len(chosen):
        chosen = _each_place_once(chosen)
    if len(chosen) <= _NEIGHBOUR:
        return chosen[:0], np.empty(0)
    sample = chosen[:_READINGS]
    spacing = cKDTree(chosen, balanced_tree=False, compact_nodes=False).query(sample, k=_NEIGHBOUR + 1)[0][:, -1]
    usable = np.isfinite(spacing) & (spacing > 0.0)
    return sample[usable], spacing[usable]


def _ranges(places: NDArray[np.float64], viewpoint: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances from a viewpoint, (m,), none so near that its logarithm outweighs all others."""
    rays = places - viewpoint
    return np.sqrt(np.einsum("...i,...i->...", rays, rays)) + _LEAST_RANGE


def _regressions(
    places: NDArray[np.float64], logs: NDArray[np.float64], viewpoints: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Explained fraction of the variance, and exponent, (k,) each, of the law about each of k viewpoints."""
    explained, slopes = np.empty(len(viewpoints)), np.empty(len(viewpoints))
    _regress(places, logs - logs.mean(), viewpoints, explained, slopes)
    return explained, slopes


@kernel
def _regress(
    places: NDArray[np.float64],
    y: NDArray[np.float64],
    viewpoints: NDArray[np.float64],
    explained: NDArray[np.float64],
    slopes: NDArray[np.float64],
) -> None:
    """Set what `_regressions` returns, of logarithms whose mean is zero."""
    x = np.empty(len(y))
    for v in range(len(viewpoints)):
        mean = 0.0
        for i in range(len(y)):
            square = 0.0
            for axis in range(3):
                square += (places[i, axis] - viewpoints[v, axis]) ** 2
            x[i] = math.log(math.sqrt(square) + _LEAST_RANGE)
            mean += x[i] / len(y)
        variance = squares = products = 0.0
        for i in range(len(y)):
            variance += y[i] * y[i]
            squares += (x[i] - mean) * (x[i] - mean)
            products += (x[i] - mean) * y[i]
        slope = min(max(products / max(squares, _TINY), 0.0), _MAX_EXPONENT)
        left = variance - slope * (2.0 * products - slope * squares)
        explained[v], slopes[v] = 1.0 - left / max(variance, _TINY), slope


def _least_exponent(
    places: NDArray[np.float64], logs: NDArray[np.float64], viewpoint: NDArray[np.float64], exponent: float
) -> float:
    """The lesser of the exponents in the near and the far half, by medians; `exponent` where the span is small."""
    x = np.log(_ranges(places, viewpoint))
    order = np.argsort(x, kind="stable")
    if x[order[len(x) * 9 // 10]] - x[order[len(x) // 10]] < math.log(_WIDE_SPAN):
        return exponent
    slopes = []
    for half in np.array_split(order, 2):
        third = len(half) // 3
        near, far = half[:third], half[-third:]
        rise = float(np.median(logs[far]) - np.median(logs[near]))
        slopes.append(rise / max(float(np.median(x[far]) - np.median(x[near])), _TINY))
    return min(slopes)


def _most_telling_place(places: NDArray[np.float64], logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """The place, (3,), about which spacing follows the law best, found by a pattern search around the cloud."""
    low, high = bounding_box(places)
    steps = (np.arange(5) + 0.5) / 5
    inside = low + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3) * (high - low)
    reach = float(np.linalg.norm(high - low)) / 2.0
    outside = [(low + high) / 2.0 + far * reach * sphere_directions(40) for far in (1.2, 2.0)]
    candidates, some = np.concatenate((inside, *outside)), slice(None, None, 4)
    place = candidates[int(np.argmax(_regressions(places[some], logs[some], candidates)[0]))]
    places, logs = places[::2], logs[::2]
    best = _regressions(places, logs, place[None])[0][0]
    moves, step = np.concatenate((np.eye(3), -np.eye(3), sphere_directions(8))), 0.3 * reach
    for _ in range(14):
        tried = place + step * moves
        explained = _regressions(places, logs, tried)[0]
        if explained.max() > best + 1e-4:
            place, best = tried[int(np.argmax(explained))], float(explained.max())
        else:
            step *= 0.5
    return place


def sphere_directions(n: int) -> NDArray[np.float64]:
    """Unit vectors evenly over the sphere, (n, 3) float64, from +z downwards: a Fibonacci lattice."""
    number = np.arange(n) + 0.5
    z = 1.0 - 2.0 * number / n
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z * z)
    return np.stack((across * np.cos(angle), across * np.sin(angle), z), axis=1)


@kernel
def _thin(start: int, stop: int, points: NDArray[np.float64], limit: np.uint64, taken: NDArray[np.bool_]) -> None:
    """Set whether a hash of each point's place lies below a limit."""
    bits = points.view(np.uint64)
    for p in range(start, stop):
        h = np.uint64(0x9E3779B97F4A7C15)
        for axis in range(3):
            h ^= bits[p, axis] if points[p, axis] != 0.0 else np.uint64(0)
            h *= np.uint64(0xD6E8FEB86659FD93)
            h ^= h >> np.uint64(32)
        h *= np.uint64(0xC2B2AE3D27D4EB4F)
        h ^= h >> np.uint64(29)
        h *= np.uint64(0xD6E8FEB86659FD93)
        taken[p] = h < limit
