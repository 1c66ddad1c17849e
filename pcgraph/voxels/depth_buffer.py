# SPDX-License-Identifier: Apache-2.0
"""What is visible from places: depth buffers over all directions, on octahedral maps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine

SAME_SURFACE_COSINE = np.float32(0.8)
"""Cosine between normals on one surface, at least."""
_BINS_PER_RADIAN = 0.35  # of the octahedral map, over its width, on average
_MAX_BINS = 512  # along each side: a map that stays in the cache
_SLANTED = np.float32(8.0)  # widths between surfels of one surface of which one may seem to hide the other
_STEEPEST = np.float32(4.0)  # of a surfel that is seen at a slant: tangent of its angle
_TINY = 1e-12
_NOTHING = (0x7F800000 << 32) + (1 << 32) - 1  # a bin with no surfel: its range is the infinity of float32
_NUMBER = (1 << 32) - 1
_FAR = np.float32(np.inf)


def visibility_from(
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    widths: NDArray[np.float64],
    normals: NDArray[np.float64],
    stretch: float = 1.0,
    n_hiding: int | None = None,
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
    n_hiding : int, optional
        How many of them hide others, the first ones; default all.
    """
    seen = np.empty((len(places), len(centres)), np.bool_)
    n_hiding = len(centres) if n_hiding is None else n_hiding
    some = slice(None, n_hiding, max(1, n_hiding // 200))  # to know how fine a map it takes
    ranges = np.linalg.norm(places[:, None] - centres[None, some], axis=2)
    typical = np.median(widths[some] / np.maximum(ranges, 1e-12), axis=1)
    bins = np.clip(1.0 / (_BINS_PER_RADIAN * typical), 64, _MAX_BINS).astype(np.int64)
    surfels = _Surfels(_columns(centres), _columns(normals), widths.astype(np.float32), np.float32(1.0 / stretch))
    in_blocks(_look, len(places), places.astype(np.float32), bins, surfels, n_hiding, seen, smallest=1)
    return seen


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
    """How surfels look from a place, (n,) float32 each.

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
    n_hiding: int,
    seen: NDArray[np.bool_],
) -> None:
    """Set what is seen from each place, by the least range in each bin of directions that a surfel may cover.

    A bin holds the range, whose bits as a float32 sort as it does, above the number of the surfel that has it.
    """
    n, nothing, half_bin = surfels.centres.shape[1], np.float32(0.0), np.float32(0.5)
    depth = surfels.depth  # read here: a field read where surfels are compared costs that loop half its time again
    at, doubtful = np.empty(n, np.int64), np.empty(n + 1, np.int64)
    views = _Views(
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
    )
    most_bins = 0
    for k in range(start, stop):
        most_bins = max(most_bins, bins_of[k])
    nearest = np.empty(most_bins * most_bins, np.int64)
    for k in range(start, stop):
        bins, last = bins_of[k], bins_of[k] - 1
        nearest[: bins * bins] = _NOTHING
        _view(places[k], bins, surfels, views)
        for i in range(n):
            at[i] = 0
            if views.ranges[i] <= nothing:
                continue
            u, v, half = views.u[i], views.v[i], views.halves[i]
            at[i] = min(int(u), last) * bins + min(int(v), last)
            if i >= n_hiding:
                continue
            first, final = min(int(max(v - half, nothing)), last), min(int(v + half), last)
            for p in range(min(int(max(u - half, nothing)), last), min(int(u + half), last) + 1):
                off = max(abs(np.float32(p) + half_bin - u) - half_bin, nothing)
                for q in range(first, final + 1):
                    beside = max(off, abs(np.float32(q) + half_bin - v) - half_bin)
                    bits = np.float32(views.ranges[i] + views.slopes[i] * beside).view(np.int32)
                    nearest[p * bins + q] = min(nearest[p * bins + q], np.int64(bits) << 32 | i)
        n_doubtful = 0
        for i in range(n):  # branch-free: it would often be mispredicted
            too_far = views.limits[i] - np.int32(nearest[at[i]] >> 32).view(np.float32)
            seen[k, i] = too_far <= nothing
            doubtful[n_doubtful] = i
            n_doubtful += (too_far > nothing) & (too_far < _SLANTED * surfels.widths[i])
        for i in doubtful[:n_doubtful]:
            seen[k, i] = _on_one_surface(i, nearest[at[i]] & _NUMBER, surfels, depth)


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
