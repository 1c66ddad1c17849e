# SPDX-License-Identifier: Apache-2.0
"""How densely a cloud samples its surfaces."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel
from pcgraph.voxels.cells import bounding_box, cell_keys, gallop, sorted_keys
from pcgraph.voxels.sampling import BLOCKS, blocks_of, each_place_once, some_places
from pcgraph.voxels.warp import Warp

_SAMPLE = 4096  # points whose nearest neighbour is sought
_TRIES = 64
_NEIGHBOUR = 8
_MANY_BESIDE = 512  # points in 27 cells, at most, that are looked at
_FEW_CUT_OFF = 0.05  # of the points have more beside them
_NEARLY_ALL = 0.95  # of the points (in one place: the others are outliers)
_NO_SPACING_M = 0.01
_THIN = 0.01  # of its extent: a cloud whose points, at their spacing, cover so little
_TINY = float(np.finfo(np.float64).tiny)


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
    drawn = some_places(points)
    crowd = each_place_once(drawn)
    if 2 * len(crowd) < len(drawn) < len(points):  # duplicates took the room of others
        crowd = each_place_once(some_places(each_place_once(points)))
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
    counts = blocks_of(points, low, extent / BLOCKS)[1]
    return 2.0 * extent / BLOCKS * math.sqrt(np.count_nonzero(counts) / len(points))


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
