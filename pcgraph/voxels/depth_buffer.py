# SPDX-License-Identifier: Apache-2.0
"""Visibility from places: depth buffers over all directions, on octahedral maps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.voxels.directions import SAME_SURFACE_COSINE

_COARSENESS = 0.35
"""One over the bins along the map, for surfels of a radian: a bin is 1.24 surfels wide on average. Chosen by eye."""
_MIN_BINS = 64
"""Fewest bins along the map, a count. Chosen by eye."""
_MAX_BINS = 512
"""Most bins along the map, a count, so that it stays in the cache."""
_SLANTED = np.float32(8.0)
"""Most widths between surfels of one surface of which one may seem to hide the other. Chosen by eye."""
_STEEPEST = np.float32(4.0)
"""Largest slope of a surfel that is seen at a slant, the tangent of its angle. Chosen by eye."""
_TINY = 1e-12
"""Least length in a frame of the order of 1 m, so that nothing is divided by zero."""
_FAR = np.float32(np.inf)
"""Range of a bin with no surfel."""
_NOTHING = (0x7F800000 << 32) + (1 << 32) - 1
"""Word of a bin with no surfel, because the bits of an infinite float32 stand above those of a number."""
_NUMBER = (1 << 32) - 1
"""Bits of a word from which the number of a surfel is read."""


def visibility_from(
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    widths: NDArray[np.float64],
    normals: NDArray[np.float64],
    stretch: float = 1.0,
) -> NDArray[np.bool_]:
    """Whether each of n surfels is visible from each of k places, (k, n) bool: none is in front by more than its depth.

    Parameters
    ----------
    places : (k, 3) float64
        In a frame where all are of the order of 1, as single precision is enough there.
    centres : (n, 3) float64
    widths : (n,) float64
    normals : (n, 3) float64
        Towards either side. A surfel that is seen at a slant hides little of what lies beside it on the same surface.
    stretch : float, >= 1
        Widths over depths: surfels that stand for others beside them are wider, but no deeper.
    """
    return _depth_order(places, centres, widths, normals, stretch, len(centres), 0, 1.0) >= 0


def depth_order(
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    widths: NDArray[np.float64],
    normals: NDArray[np.float64],
    n_points: int,
    finer: float = 1.0,
) -> NDArray[np.int8]:
    """Whether what is seen in the direction of each of m points is nearer, -1, farther, 1, or neither, 0; (k, m) int8.

    Parameters
    ----------
    places, centres, widths, normals
        As for `visibility_from`. Widths of points are the difference of depth that counts.
    n_points : int
        How many of the surfels, the last ones, are points where nothing need be, which hide nothing.
    finer : float, >= 1
        Times as many bins along the map as usual, at most, for surfels that are drawn smaller.
    """
    n_drawn = len(centres) - n_points
    return _depth_order(places, centres, widths, normals, 1.0, n_drawn, n_drawn, finer)


def _depth_order(
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    widths: NDArray[np.float64],
    normals: NDArray[np.float64],
    stretch: float,
    n_drawn: int,
    first: int,
    finer: float,
) -> NDArray[np.int8]:
    """The same for the surfels from the first on, given how many are drawn."""
    order = np.empty((len(places), len(centres) - first), np.int8)
    some = slice(None, n_drawn, max(1, n_drawn // 200))  # to know how fine a map it takes
    ranges = np.linalg.norm(places[:, None] - centres[None, some], axis=2)
    typical = np.median(widths[some] / np.maximum(ranges, _TINY), axis=1)
    bins = np.clip(1.0 / (_COARSENESS * typical), _MIN_BINS, finer * _MAX_BINS).astype(np.int64)
    surfels = _Surfels(_columns(centres), _columns(normals), widths.astype(np.float32), np.float32(1.0 / stretch))
    in_blocks(_look, len(places), places.astype(np.float32), bins, surfels, n_drawn, order, smallest=1)
    return order


def hit_fractions(places: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fraction of the directions in which each of k places, (k, 3), has some of the centres, (n, 3); of 8 x 8 bins."""
    hits = np.empty(len(places))
    in_blocks(_count_hits, len(places), places.astype(np.float32), _columns(centres), hits, smallest=1)
    return hits


def facing_cosines(
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    seen: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Cosine between each of n normals and the direction to each of k places, (k, n) float32, 0 where hidden."""
    sides = np.empty(seen.shape, np.float32)
    in_blocks(_find_sides, len(places), places, centres, normals, seen, sides, smallest=1)
    return sides


def cosines_towards(
    place: NDArray[np.float64], unit: float, centres: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Cosine between each of n normals and the way to a place, (n,), given a unit of about that length."""
    cosines = np.empty(len(centres))
    in_blocks(_face, len(centres), place, unit, centres, normals, cosines)
    return cosines


class _Surfels(NamedTuple):
    """Surfels that stand for a surface, in columns, as loops take them in lanes: (3, n) float32, and widths, (n,).

    They are so many times as deep as wide.
    """

    centres: NDArray[np.float32]
    normals: NDArray[np.float32]
    widths: NDArray[np.float32]
    depth: np.float32


def _columns(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """The columns of (n, 3) rows, each in one piece, (3, n)."""
    return np.ascontiguousarray(rows.T, np.float32)


@routine
def _on_map(x: np.float32, y: np.float32, z: np.float32, total: np.float32) -> tuple[np.float32, np.float32]:
    """Place of a direction on the octahedral map, -1..1 each; `total` is the sum of its sizes along the axes."""
    nothing, one = np.float32(0.0), np.float32(1.0)
    u, v = x / total, y / total
    folded_u, folded_v = one - abs(v), one - abs(u)
    folded_u = folded_u if u >= nothing else -folded_u
    folded_v = folded_v if v >= nothing else -folded_v
    return (folded_u if z < nothing else u), (folded_v if z < nothing else v)


@kernel
def _count_hits(
    start: int, stop: int, places: NDArray[np.float32], centres: NDArray[np.float32], hits: NDArray[np.float64]
) -> None:
    """Set the fraction of directions in which there is something, from each place, on a map of 8 x 8 bins."""
    bins = np.empty(centres.shape[1], np.uint64)
    for k in range(start, stop):
        _find_bins(places[k], centres, bins)
        hit = np.uint64(0)  # one bit per bin
        for i in range(len(bins)):
            hit |= np.uint64(1) << bins[i]
        n_hits = 0
        while hit:
            hit &= hit - np.uint64(1)
            n_hits += 1
        hits[k] = n_hits / 64


@routine
def _find_bins(place: NDArray[np.float32], centres: NDArray[np.float32], bins: NDArray[np.uint64]) -> None:
    """Set in which of 8 x 8 bins each centre lies, seen from a place."""
    px, py, pz = place
    one, four, last = np.float32(1.0), np.float32(4.0), np.float32(7.0)
    for i in range(centres.shape[1]):
        x, y, z = centres[0, i] - px, centres[1, i] - py, centres[2, i] - pz
        u, v = _on_map(x, y, z, abs(x) + abs(y) + abs(z))
        u, v = (u + one) * four, (v + one) * four
        bins[i] = np.int32(u if u < last else last) * 8 + np.int32(v if v < last else last)


class _Views(NamedTuple):
    """Surfels as they look from a place, (n,) float32 each.

    Attributes
    ----------
    u, v : on the octahedral map, in bins
    halves : half widths on it, a little more, in bins
    ranges : of their centres
    slopes : how much farther a surfel is per bin beside its centre, as it is deeper than wide if seen at a slant
    limits : what is nearer than this hides the surfel
    """

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    halves: NDArray[np.float32]
    ranges: NDArray[np.float32]
    slopes: NDArray[np.float32]
    limits: NDArray[np.float32]


@kernel
def _look(
    start: int,
    stop: int,
    places: NDArray[np.float32],
    bins_of: NDArray[np.int64],
    surfels: _Surfels,
    n_drawn: int,
    order: NDArray[np.int8],
) -> None:
    """Set what `depth_order` returns, by the least range in each bin of directions that a surfel may cover.

    A bin holds the range, whose bits as a float32 sort as it does, above the number of the surfel that has it.
    """
    n, m, nothing = surfels.centres.shape[1], order.shape[1], np.float32(0.0)
    depth = surfels.depth  # read here: a field read where surfels are compared costs that loop half its time again
    at, doubtful, nearest = np.empty(m, np.int64), np.empty(m + 1, np.int64), np.empty(0, np.int64)
    views = _Views(
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
    )
    for k in range(start, stop):
        _view(places[k], bins_of[k], surfels, views)
        box = _box_of(views, n - m, bins_of[k])
        if box.height * box.width > len(nearest):
            nearest = np.empty(box.height * box.width, np.int64)
        _draw(views, box, n_drawn, nearest, at)
        n_doubtful = 0
        for j in range(m):  # branch-free: it would often be mispredicted
            i, found = n - m + j, np.int32(nearest[at[j]] >> 32).view(np.float32)
            too_far, is_here = views.limits[i] - found, views.ranges[i] <= nothing  # what is at the place is not seen
            farther = (found > views.ranges[i] + surfels.widths[i]) & (found < _FAR) & (not is_here)
            order[k, j] = np.int8(farther) - np.int8((too_far > nothing) | is_here)
            doubtful[n_doubtful] = j
            n_doubtful += farther | ((too_far > nothing) & (too_far < _SLANTED * surfels.widths[i]))
        for j in doubtful[:n_doubtful]:
            if _on_one_surface(n - m + j, nearest[at[j]] & _NUMBER, surfels, depth):
                order[k, j] = 0


class _Box(NamedTuple):
    """The bins of an octahedral map that are looked at: from where on, along u and v, and how many."""

    u: int
    v: int
    height: int
    width: int


@routine
def _box_of(views: _Views, first: int, bins: int) -> _Box:
    """The bins in which the centres of surfels lie, from the first on."""
    low_u = low_v = np.float32(bins)
    high_u = high_v = nothing = np.float32(0.0)
    for i in range(first, len(views.u)):
        if views.ranges[i] > nothing:
            low_u, high_u = min(low_u, views.u[i]), max(high_u, views.u[i])
            low_v, high_v = min(low_v, views.v[i]), max(high_v, views.v[i])
    u, v = min(int(min(low_u, high_u)), bins - 1), min(int(min(low_v, high_v)), bins - 1)
    return _Box(u, v, min(int(high_u), bins - 1) - u + 1, min(int(high_v), bins - 1) - v + 1)


@routine
def _draw(views: _Views, box: _Box, n_drawn: int, nearest: NDArray[np.int64], at: NDArray[np.int64]) -> None:
    """Set the nearest of the surfels that are there in each bin of a box, and the bin in which each of the last is."""
    nothing, half_bin = np.float32(0.0), np.float32(0.5)
    last_u, last_v = box.u + box.height - 1, box.v + box.width - 1
    nearest[: box.height * box.width] = _NOTHING
    at[:] = 0
    first_asked = len(views.u) - len(at)
    for i in range(len(views.u)):
        if views.ranges[i] <= nothing:
            continue
        u, v, half = views.u[i], views.v[i], views.halves[i]
        if i >= first_asked:
            at[i - first_asked] = (min(int(u), last_u) - box.u) * box.width + min(int(v), last_v) - box.v
        if i >= n_drawn:
            continue
        first, final = max(int(max(v - half, nothing)), box.v), min(int(v + half), last_v)
        for p in range(max(int(max(u - half, nothing)), box.u), min(int(u + half), last_u) + 1):
            off, row = max(abs(np.float32(p) + half_bin - u) - half_bin, nothing), (p - box.u) * box.width - box.v
            for q in range(first, final + 1):
                beside = max(off, abs(np.float32(q) + half_bin - v) - half_bin)
                bits = np.float32(views.ranges[i] + views.slopes[i] * beside).view(np.int32)
                nearest[row + q] = min(nearest[row + q], np.int64(bits) << 32 | i)


@routine
def _view(place: NDArray[np.float32], bins: int, surfels: _Surfels, views: _Views) -> None:
    """Set how surfels look from a place, on a map of bins x bins. One at the place has range 0 and is not seen."""
    centres, normals, widths, depth_of_width = surfels
    px, py, pz = place
    nothing, one, halves, bin_size = np.float32(0.0), np.float32(1.0), np.float32(0.5 * bins), np.float32(2.0 / bins)
    margin, widest = np.float32(0.6), np.float32(24.0)
    for i in range(len(widths)):
        x, y, z = centres[0, i] - px, centres[1, i] - py, centres[2, i] - pz
        total = abs(x) + abs(y) + abs(z)
        u, v = _on_map(x, y, z, total)
        views.u[i], views.v[i] = (u + one) * halves, (v + one) * halves
        square = x * x + y * y + z * z
        distance = math.sqrt(square)
        bin_width = bin_size * total  # across the direction, at least, as of the surfel
        half = margin * widths[i] / bin_width
        half = half if half < widest else widest
        views.halves[i] = half
        depth = abs(x * normals[0, i] + y * normals[1, i] + z * normals[2, i])
        across = square - depth * depth
        across = math.sqrt(across if across > nothing else nothing)
        slope = across / depth
        slope = bin_width * (slope if across < _STEEPEST * depth else _STEEPEST)
        views.slopes[i] = slope
        views.ranges[i] = distance
        deep = depth_of_width * widths[i] + slope * half  # from edge to edge
        limit = distance - (deep if deep < widths[i] else widths[i]) - np.float32(0.5) * bin_width
        views.limits[i] = limit if distance > nothing else _FAR


@routine
def _on_one_surface(i: int, j: int, surfels: _Surfels, depth: np.float32) -> bool:
    """Whether two surfels lie on each other's planes and near: at a slant one may seem to hide the other."""
    centres, normals, width = surfels.centres, surfels.normals, surfels.widths[i]
    cosine = off = off_other = square = np.float32(0.0)
    for axis in range(3):
        way = centres[axis, i] - centres[axis, j]
        square += way * way
        cosine += normals[axis, i] * normals[axis, j]
        off += way * normals[axis, i]
        off_other += way * normals[axis, j]
    reach, flat = _SLANTED * width, depth * width
    return bool(abs(cosine) >= SAME_SURFACE_COSINE and max(abs(off), abs(off_other)) < flat and square < reach * reach)


@kernel
def _find_sides(
    start: int,
    stop: int,
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    seen: NDArray[np.bool_],
    sides: NDArray[np.float32],
) -> None:
    """Set the cosine between each normal and the direction to each place, 0 where hidden."""
    for k in range(start, stop):
        for i in range(len(centres)):
            sides[k, i] = _facing(places[k], 1.0, centres, normals, i) if seen[k, i] else 0.0


@kernel
def _face(
    start: int,
    stop: int,
    place: NDArray[np.float64],
    unit: float,
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    cosines: NDArray[np.float64],
) -> None:
    """Set the cosine between each normal and the way to a place, given a unit of about that length."""
    for i in range(start, stop):
        cosines[i] = _facing(place, unit, centres, normals, i)


@routine
def _facing(
    place: NDArray[np.float64], unit: float, centres: NDArray[np.float64], normals: NDArray[np.float64], i: int
) -> float:
    """Cosine between a normal and the way to a place; in units, as squares of tiny lengths are zero."""
    x, y, z = (place[0] - centres[i, 0]) / unit, (place[1] - centres[i, 1]) / unit, (place[2] - centres[i, 2]) / unit
    length = max(math.sqrt(x * x + y * y + z * z), _TINY)
    return (x * normals[i, 0] + y * normals[i, 1] + z * normals[i, 2]) / length
