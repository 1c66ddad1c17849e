# SPDX-License-Identifier: Apache-2.0
"""How densely a cloud samples its surfaces."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel
from pcgraph.voxels.cells import bounding_box, cell_keys, gallop, sorted_keys
from pcgraph.voxels.rings import Rows
from pcgraph.voxels.sampling import BLOCKS, blocks_of, each_place_once, some_places
from pcgraph.voxels.warp import Warp

VOXELS_PER_SPACING = 3.5
"""Edge of a voxel over the spacing of the points, unless surfaces need larger or smaller ones."""

_SAMPLE = 4096  # points whose nearest neighbour is sought
_TRIES = 64
_NEIGHBOUR = 8
_MANY_BESIDE = 512  # points in 27 cells, at most, that are looked at
_FEW_CUT_OFF = 0.05  # of the points have more beside them
_NEARLY_ALL = 0.95  # of the points: the others are outliers
_ROWS_OF_CELLS = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))  # the near ones first
_NO_SPACING_M = 0.01
_IN_ROWS = 1280  # points of which it is asked whether they lie in a row
_ROW = 0.25  # of the way between a point's two nearest: it lies no farther off their line
_COPIES = 256  # of a place, at most: where cells hold more, they are things that lie far apart
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
    return spacing_and_rows(points, warp)[0]


def spacing_and_rows(points: NDArray[np.float64], warp: Warp | None = None) -> tuple[float, Rows]:
    """`median_spacing`, and the rows among the points that are looked at for it, in the space of the warp.

    Rows come in the order of their points' hashes, which is as good as random.
    """
    drawn = some_places(points)
    crowd = each_place_once(drawn)
    if 2 * len(crowd) < len(drawn) < len(points):  # duplicates took the room of others
        crowd = each_place_once(some_places(each_place_once(points)))
    crowd = crowd if warp is None else warp.forward(crowd)
    spacing, rows = _read(crowd)
    low, high = bounding_box(crowd)
    if spacing * math.sqrt(len(crowd)) < _THIN * float((high - low).max()):  # perhaps the points are copies of others
        _, cells, held = np.unique(
            np.floor((crowd - low) / (100.0 * spacing)), axis=0, return_index=True, return_counts=True
        )
        full = _fullest(held)
        of_cells = _read(crowd[np.sort(cells[full])])[0]
        if of_cells > 1000.0 * spacing and len(full) > 1 and len(crowd) <= _COPIES * len(full):
            return of_cells, rows
    return spacing, rows


def _fullest(held: NDArray[np.int64]) -> NDArray[np.int64]:
    """The fewest of some cells, given how many points each holds, that hold nearly all: not those of points far off."""
    order = np.argsort(-held, kind="stable")
    return order[: int(np.searchsorted(np.cumsum(held[order]), _NEARLY_ALL * held.sum())) + 1]


def _read(crowd: NDArray[np.float64]) -> tuple[float, Rows]:
    """Median distance to the nearest of distinct points, (n, 3), or an eighth of that to the eighth if that is more;
    and rows.

    Read at the first points. Neighbours are sought in the 27 cells of a grid around each. Only the medians need to be
    known: where the median point has its neighbours farther off than an edge, the cells are too small, and where they
    hold too many to look at all, too large.
    """
    low, high = bounding_box(crowd)
    extent, spacing, rows = float((high - low).max()), 0.0, Rows(*np.empty((2, 0, 3)))
    edge = _edge_for_neighbours(crowd, low, extent)
    for _ in range(_TRIES):
        if not _TINY < edge < math.inf:
            break
        found = _near(crowd, low, edge)
        medians, cut_off = np.median(found.distances[: 2 if len(crowd) > _NEIGHBOUR else 1], axis=1), found.is_cut_off
        if np.isfinite(medians).all():
            spacing, rows = max(float(medians[0]), float(medians[-1]) / _NEIGHBOUR), _rows(crowd, found, edge)
            if cut_off.mean() <= _FEW_CUT_OFF:
                break
            edge *= 0.5 if cut_off.mean() < _NEARLY_ALL else 0.125
        elif spacing > 0.0:  # cells are too large for some points and too small for others
            break
        else:
            edge *= 2.0
    return spacing if spacing > 0.0 else _NO_SPACING_M, rows


def _rows(crowd: NDArray[np.float64], found: _Near, edge: float) -> Rows:
    """The points that lie between their two nearest, no more than a quarter of the way between these off the line.

    The edge is what neighbours are within, a unit in which squares neither overflow nor vanish.
    """
    has_two = np.all(found.nearest >= 0, axis=0)
    points = crowd[: found.nearest.shape[1]][has_two]
    one, other = (crowd[found.nearest[:, has_two]] - points) / edge
    way = other - one
    squares = np.einsum("ij,ij->i", way, way)
    between = np.einsum("ij,ij->i", one, other)
    off = np.einsum("ij,ij->i", one, one) * np.einsum("ij,ij->i", other, other) - between * between  # area, squared
    in_row = (between < 0.0) & (off <= (_ROW * squares) ** 2) & (squares > 0.0)
    return Rows(points[in_row], way[in_row] / np.sqrt(squares[in_row])[:, None])


def _edge_for_neighbours(points: NDArray[np.float64], low: NDArray[np.float64], extent: float) -> float:
    """Edge of cells that hold four points each, about, where these lie on surfaces."""
    counts = blocks_of(points, low, extent / BLOCKS)[1]
    return 2.0 * extent / BLOCKS * math.sqrt(np.count_nonzero(counts) / len(points))


class _Near(NamedTuple):
    """Of the first s points of a crowd: distances to the nearest and to the eighth other, (2, s), infinite where more
    than the edge of a cell; numbers of the two nearest of the very first, (2, r), -1 if none is near; whether there
    were too many to look at all, (s,)."""

    distances: NDArray[np.float64]
    nearest: NDArray[np.int64]
    is_cut_off: NDArray[np.bool_]


def _near(crowd: NDArray[np.float64], low: NDArray[np.float64], edge: float) -> _Near:
    """What lies around the first points of a crowd, within cells of an edge."""
    cells = (crowd - low) / edge
    keys, pitch = cell_keys(cells, edge)
    ordered, order = sorted_keys(keys)
    unit = math.ldexp(0.5, math.frexp(edge)[1])  # in which distances neither overflow nor are rounded
    places, reach = crowd.take(order, axis=0) / unit, edge / unit
    sample = np.flatnonzero(order < _SAMPLE)
    n = len(sample)
    found = _Near(np.empty((2, n)), np.full((2, min(n, _IN_ROWS)), -1), np.empty(n, np.bool_))
    in_cell = cells[:n] - np.floor(cells[:n])
    in_blocks(_find_near, n, ordered, order, pitch, places, in_cell, reach, sample, found)
    found.distances[:] *= unit
    return found


@kernel
def _find_near(
    start: int,
    stop: int,
    keys: NDArray[np.int64],
    order: NDArray[np.int64],
    pitch: tuple[int, int],
    places: NDArray[np.float64],
    in_cell: NDArray[np.float64],
    reach: float,
    sample: NDArray[np.int64],
    found: _Near,
) -> None:
    """Set what `_near` returns, within a reach: nine pointers gallop along the sorted keys.

    Rows of cells that lie farther off than the eighth nearest are left out.
    """
    n, pointers, squares = len(keys), np.zeros(9, np.int64), np.empty(_NEIGHBOUR)
    for i in range(start, stop):
        own, beside, s = sample[i], 0, order[sample[i]]
        for rank in range(_NEIGHBOUR):
            squares[rank] = np.inf
        for row in range(9):
            across, along = _ROWS_OF_CELLS[row]
            x = reach * (in_cell[s, 0] if across < 0 else across * (1.0 - in_cell[s, 0]))
            y = reach * (in_cell[s, 1] if along < 0 else along * (1.0 - in_cell[s, 1]))
            if x * x + y * y >= squares[_NEIGHBOUR - 1]:
                continue
            first = keys[own] + across * pitch[0] + along * pitch[1] - 1
            at = pointers[row] = gallop(keys, pointers[row], first)
            while at < n and keys[at] <= first + 2 and beside < _MANY_BESIDE:
                x, y, z = places[at, 0] - places[own, 0], places[at, 1] - places[own, 1], places[at, 2] - places[own, 2]
                square = x * x + y * y + z * z
                if square < squares[_NEIGHBOUR - 1] and at != own:
                    if s < found.nearest.shape[1] and square < squares[1]:
                        found.nearest[1, s] = order[at] if square >= squares[0] else found.nearest[0, s]
                        found.nearest[0, s] = order[at] if square < squares[0] else found.nearest[0, s]
                    for rank in range(_NEIGHBOUR):  # into its place, without a branch
                        squares[rank], square = min(squares[rank], square), max(squares[rank], square)
                beside += 1
                at += 1
        found.is_cut_off[s] = beside >= _MANY_BESIDE
        for i_near, square in ((0, squares[0]), (1, squares[_NEIGHBOUR - 1])):
            found.distances[i_near, s] = math.sqrt(square) if square <= reach * reach else np.inf
