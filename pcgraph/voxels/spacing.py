# SPDX-License-Identifier: Apache-2.0
"""Spacing of the points of a cloud on its surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel
from pcgraph.rounding import TINY
from pcgraph.voxels.cells import bounding_box, cell_keys, gallop, sorted_keys
from pcgraph.voxels.sampling import BLOCKS, blocks_of, each_place_once, some_places
from pcgraph.voxels.warp import Warp

VOXELS_PER_SPACING = 3.5
"""Edge of a voxel over the spacing of the points, unless surfaces need larger or smaller ones.

Chosen with some clouds of the benchmark in view. With 2.5, 4 of 27 clouds gain more than 0.05 in covering and 12 lose
as much.
"""

# Kernels read these.
_NEIGHBOUR = 8
"""Rank of the neighbour whose distance counts where points nearly coincide; see `median_spacing`. Chosen by eye."""
_MAX_BESIDE = 512
"""Points in the 27 cells around one that are looked at, at most; chosen by eye, for the time's sake."""
_ROWS_OF_CELLS = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Offsets along x and y, in cell edges, of the rows of cells around one: near ones first, so that the search ends
soon."""


@dataclass(frozen=True)
class SpacingThresholds:
    """Reading of the spacing. Chosen by eye; none was varied."""

    sample: int = 4096  # points whose nearest neighbours are sought
    row_sample: int = 1280  # points, of these, that are asked whether they lie in a row
    max_sizes: int = 64  # sizes of cells that are tried
    max_cut_off: float = 0.05  # fraction of the points around which too many lie to look at all
    nearly_all: float = 0.95  # fraction of the points: the others are outliers, or lie far off
    row_offset: float = 0.25  # of the way between a point's two nearest: in a row, it lies no farther off their line
    thin: float = 0.01  # of the extent: if points at this spacing cover so little of it, they may be copies
    cube: float = 100.0  # spacings: edge of the cubes of which one point each is looked at then
    copies_apart: float = 1000.0  # spacings: the points of these cubes are at least so far apart, if points are copies
    max_copies: int = 256  # copies of a place: if cubes hold more points, they are things that lie far apart
    of_coincident: float = 0.01  # metres: the spacing of points that all coincide


_READ = SpacingThresholds()


class Rows(NamedTuple):
    """Points that lie in a row with their two nearest neighbours.

    Attributes
    ----------
    points : (m, 3) float64, metres
        The middle point of each row.
    directions : (m, 3) float64
        Direction of each row, of length 1 and either sign.
    """

    points: NDArray[np.float64]
    directions: NDArray[np.float64]


def median_spacing(points: NDArray[np.float64], warp: Warp | None = None) -> float:
    """Median distance to the nearest other place, metres, over a sample that does not depend on the points' order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1. Duplicates count as one point.
    warp : Warp, optional
        To the space in which distances are read. In that of a camera, pixels are equally far apart everywhere. Default:
        the points' own.

    Returns
    -------
    float
        > 0; 0.01 if all points coincide. If most points nearly coincide with another, as in scans laid on each other,
        it is an eighth of the median distance to the eighth neighbour, which is less elsewhere. If the points are many
        copies of each other, it is the distance between places that are no copies.

    Notes
    -----
    Source: Lin et al. 2018 start from the same median, their lambda_0. Of a large cloud only some blocks of space are
    looked at, with all their points.
    """
    return spacing_and_rows(points, warp)[0]


def spacing_and_rows(points: NDArray[np.float64], warp: Warp | None = None) -> tuple[float, Rows]:
    """`median_spacing`, and the rows among the points that it is read at, in the space of the warp.

    Rows are in the order of their points' hashes, which is as good as random.
    """
    drawn = some_places(points)
    crowd = each_place_once(drawn)
    if 2 * len(crowd) < len(drawn) < len(points):  # duplicates took the place of other points
        crowd = each_place_once(some_places(each_place_once(points)))
    crowd = crowd if warp is None else warp.forward(crowd)
    spacing, rows = _read(crowd)
    low, high = bounding_box(crowd)
    if spacing * math.sqrt(len(crowd)) < _READ.thin * float((high - low).max()):  # the points may be copies of others
        _, cells, held = np.unique(
            np.floor((crowd - low) / (_READ.cube * spacing)), axis=0, return_index=True, return_counts=True
        )
        full = _fullest(held)
        of_cells = _read(crowd[np.sort(cells[full])])[0]
        if of_cells > _READ.copies_apart * spacing and len(full) > 1 and len(crowd) <= _READ.max_copies * len(full):
            return of_cells, rows
    return spacing, rows


def _fullest(held: NDArray[np.int64]) -> NDArray[np.int64]:
    """The fewest cells that hold nearly all points, given how many each holds: cells of points far off are left out."""
    order = np.argsort(-held, kind="stable")
    return order[: int(np.searchsorted(np.cumsum(held[order]), _READ.nearly_all * held.sum())) + 1]


def _read(crowd: NDArray[np.float64]) -> tuple[float, Rows]:
    """Spacing of distinct points, (n, 3), and the rows among them.

    The spacing is the median distance to the nearest point, or an eighth of the median distance to the eighth if that
    is more. It is read at the first points. Their neighbours are sought in the 27 cells of a grid around each. Cells
    are too small if the median point has no neighbour within an edge; they are too large if they hold too many points
    to look at all. Another size is tried then.
    """
    low, high = bounding_box(crowd)
    extent, spacing, rows = float((high - low).max()), 0.0, Rows(*np.empty((2, 0, 3)))
    edge = _edge_for_neighbours(crowd, low, extent)
    for _ in range(_READ.max_sizes):
        if not TINY < edge < math.inf:
            break
        found = _near(crowd, low, edge)
        medians, cut_off = np.median(found.distances[: 2 if len(crowd) > _NEIGHBOUR else 1], axis=1), found.is_cut_off
        if np.isfinite(medians).all():
            spacing, rows = max(float(medians[0]), float(medians[-1]) / _NEIGHBOUR), _rows(crowd, found, edge)
            if cut_off.mean() <= _READ.max_cut_off:
                break
            edge *= 0.5 if cut_off.mean() < _READ.nearly_all else 0.125
        elif spacing > 0.0:  # cells are too large for some points and too small for others
            break
        else:
            edge *= 2.0
    return spacing if spacing > 0.0 else _READ.of_coincident, rows


def _rows(crowd: NDArray[np.float64], found: _Near, edge: float) -> Rows:
    """The points that lie in a row: between their two nearest, and near the line through these.

    `edge` is the size of the cells in which neighbours were sought. It serves as unit of length, so that squares
    neither overflow nor vanish.
    """
    has_two = np.all(found.nearest >= 0, axis=0)
    points = crowd[: found.nearest.shape[1]][has_two]
    one, other = (crowd[found.nearest[:, has_two]] - points) / edge
    way = other - one
    squares = np.einsum("ij,ij->i", way, way)
    between = np.einsum("ij,ij->i", one, other)
    off = np.einsum("ij,ij->i", one, one) * np.einsum("ij,ij->i", other, other) - between * between  # area, squared
    in_row = (between < 0.0) & (off <= (_READ.row_offset * squares) ** 2) & (squares > 0.0)
    return Rows(points[in_row], way[in_row] / np.sqrt(squares[in_row])[:, None])


def _edge_for_neighbours(points: NDArray[np.float64], low: NDArray[np.float64], extent: float) -> float:
    """Edge of cells that hold about four points each, if these lie on surfaces."""
    counts = blocks_of(points, low, extent / BLOCKS)[1]
    return 2.0 * extent / BLOCKS * math.sqrt(np.count_nonzero(counts) / len(points))


class _Near(NamedTuple):
    """Neighbours of the first s points of a crowd.

    Attributes
    ----------
    distances : (2, s) float64
        Distances to the nearest point and to the eighth; infinite beyond the edge of a cell.
    nearest : (2, r) int64
        Numbers of the two nearest of the first r points; -1 if none is near.
    is_cut_off : (s,) bool
        Whether there were too many points around to look at all.
    """

    distances: NDArray[np.float64]
    nearest: NDArray[np.int64]
    is_cut_off: NDArray[np.bool_]


def _near(crowd: NDArray[np.float64], low: NDArray[np.float64], edge: float) -> _Near:
    """Neighbours of the first points of a crowd, sought in cells of a given edge; `low` is their lowest corner."""
    cells = (crowd - low) / edge
    keys, pitch = cell_keys(cells, edge)
    ordered, order = sorted_keys(keys)
    unit = math.ldexp(0.5, math.frexp(edge)[1])  # in which distances neither overflow nor are rounded
    places, reach = crowd.take(order, axis=0) / unit, edge / unit
    sample = np.flatnonzero(order < _READ.sample)
    n = len(sample)
    found = _Near(np.empty((2, n)), np.full((2, min(n, _READ.row_sample)), -1), np.empty(n, np.bool_))
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
    """Set what `_near` returns, given the edge of a cell, `reach`: nine pointers gallop along the sorted keys.

    Rows of cells that lie farther off than the eighth nearest so far are left out.
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
            while at < n and keys[at] <= first + 2 and beside < _MAX_BESIDE:
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
        found.is_cut_off[s] = beside >= _MAX_BESIDE
        for i_near, square in ((0, squares[0]), (1, squares[_NEIGHBOUR - 1])):
            found.distances[i_near, s] = math.sqrt(square) if square <= reach * reach else np.inf
