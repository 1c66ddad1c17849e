# SPDX-License-Identifier: Apache-2.0
"""The sparse voxel grid: which points share a voxel, which voxels touch, and the union of two grids."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.columns import group_means
from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.cells import UNIT_CELLS, Lattice, cell_keys, gallop, sorted_keys, starts_of_runs
from pcgraph.voxels.grading import BLOCK, Grading, enlarged
from pcgraph.voxels.warp import Warp

_STEPS_PER_VOXEL = float(1 << 20)
"""Steps per voxel edge in which offsets are summed as whole numbers: such sums do not depend on the points' order."""
_COLOR_STEPS = 65535.0
"""Steps per unit in which colours are summed, for the same reason: 257 for each step of 8 bits, so that those are
exact."""
MAX_NEIGHBOURS = 26
"""Count of voxels around one of the same size, at most: 3^3 - 1, as in a cube. A larger one may have more."""
MIN_NEIGHBOURS_ON_SURFACE = 5
"""Count of voxels around one from which on it is joined: so many are there on a surface, but not on a line."""
MAX_GAP = Warp.max_gap
"""Widest gap, in voxel edges between centroids; `RangeWarp.max_gap` is wider."""
_STRETCH = 1024
"""Count of cells in a row whose neighbours are counted together; chosen by eye, for speed."""
_COUNTED = 1 << 16
"""Cells, about, that such stretches hold in all; chosen by eye, for the time's sake."""
_END = np.iinfo(np.int64).max
_NO_BUFFER = np.empty(0, np.int32)  # stands for lists that are not wanted
_INTERIOR_NEIGHBOURS = 8
"""Count of voxels around one amid a surface, at least: 8 on a plane along two axes, fewer at its border."""
_MIN_IN_PROJECTION = 6
"""Count of the 8 places beside a voxel, seen along an axis, that a surface takes up at least, however steep it is."""


class VoxelLists(NamedTuple):
    """Voxels near each of v voxels, as lists one after the other (CSR).

    Attributes
    ----------
    indptr : (v + 1,) int64
    neighbours : (e,) int32
        ``neighbours[indptr[i]:indptr[i + 1]]`` are those near voxel i, ascending.
    """

    indptr: NDArray[np.int64]
    neighbours: NDArray[np.int32]


class Neighbourhood(NamedTuple):
    """The 26-neighbourhood of occupied voxels as kernels take it: `VoxelLists` of unsigned numbers.

    An unsigned index cannot count from the end, so kernels do not test for that. The test takes up to a third of the
    time of a loop over neighbours.

    Attributes
    ----------
    indptr : (v + 1,) uint64
    neighbours : (e,) uint32
    """

    indptr: NDArray[np.uint64]
    neighbours: NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class VoxelGrid(ShortRepr):
    """Occupied voxels of a cloud in ascending order of level and grid coordinates, whatever the points' order.

    Attributes
    ----------
    size : float, metres
        Edge length of a voxel in the warped space, at level 0. The grid is aligned with the origin of that space.
    warp : Warp
        The transform to that space.
    cells : (v, 3) float64
        Grid coordinates, whole numbers, in edges of the voxel itself.
    voxel_of_point : (n,) int32
        Voxel of each point.
    order : (n,) int64
        Points voxel by voxel, ascending within each.
    starts : (v + 1,) int64
        ``order[starts[i]:starts[i + 1]]`` are the points of voxel i.
    counts : (v,) int64
        Points per voxel.
    warped : (v, 3) float64, metres of the warped space
        Mean of the voxel's points in the warped space, to 2**-21 of a voxel edge.
    centroids : (v, 3) float64, metres, the points' frame
        `warped` in the points' frame.
    edge_lengths : (v,) float64, metres
        Edge length of each voxel in the points' frame.
    colors : (v, 3) float64, 0..1, or None
        Mean colour of the voxel's points.
    indptr : (v + 1,) int64
    neighbours : (e,) int32
        ``neighbours[indptr[i]:indptr[i + 1]]`` are the voxels that touch voxel i: the occupied ones of the 26 around
        it, ascending.
    features : (v, d) float64, -4..4, or None
        Means of the voxel's points' features, scaled.
    levels : (v,) int8, or None
        Number of times that the edge of each voxel is doubled; None if none is.
    grading : Grading, or None
        Blocks in which edges are doubled; None if there are none.
    """

    size: float
    warp: Warp
    cells: NDArray[np.float64]
    voxel_of_point: NDArray[np.int32]
    order: NDArray[np.int64]
    starts: NDArray[np.int64]
    counts: NDArray[np.int64]
    warped: NDArray[np.float64]
    centroids: NDArray[np.float64]
    edge_lengths: NDArray[np.float64]
    colors: NDArray[np.float64] | None
    indptr: NDArray[np.int64]
    neighbours: NDArray[np.int32]
    features: NDArray[np.float64] | None = None
    levels: NDArray[np.int8] | None = None
    grading: Grading | None = None

    @property
    def n_voxels(self) -> int:
        """Number of occupied voxels."""
        return len(self.counts)

    @property
    def warped_edges(self) -> NDArray[np.float64]:
        """Edge length of each voxel in the warped space, (v,) float64, metres."""
        return enlarged(np.full(self.n_voxels, self.size), self.levels)

    def of_levels(self) -> Iterator[tuple[NDArray[np.bool_], VoxelGrid]]:
        """Voxels of each level, (v,) bool, and the grid of these alone, whose voxels have one size."""
        if self.levels is None:
            yield np.ones(self.n_voxels, np.bool_), self
            return
        for level in np.unique(self.levels):
            of_level = self.levels == level
            size = math.ldexp(self.size, int(level))
            yield of_level, replace(grid_without(self, ~of_level), size=size, levels=None, grading=None)

    @property
    def joined(self) -> NDArray[np.bool_]:
        """Whether each voxel is joined, (v,) bool: at least five others are around it, as on a surface."""
        return np.diff(self.indptr) >= MIN_NEIGHBOURS_ON_SURFACE

    def around(self, voxels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Pairs of touching voxels, (t,), the first of some, (s,): index in `voxels` of the first; the other."""
        degrees = np.diff(self.indptr)[voxels]
        row = np.repeat(np.arange(len(voxels)), degrees)
        return row, self.neighbours[_concatenated_ranges(self.indptr[voxels], degrees)]

    def touching_pairs(self) -> NDArray[np.int64]:
        """Pairs of voxels that touch, (m, 2), each in both orders."""
        source = np.repeat(np.arange(self.n_voxels), np.diff(self.indptr))
        return np.stack((source, self.neighbours.astype(np.int64)), axis=1)

    @property
    def neighbourhood(self) -> Neighbourhood:
        """The lists of touching voxels, in the form that kernels take."""
        return Neighbourhood(self.indptr.view(np.uint64), self.neighbours.view(np.uint32))


def grid_without(grid: VoxelGrid, voxels: NDArray[np.bool_]) -> VoxelGrid:
    """The grid without some of its voxels, (v,) bool, and without their points."""
    stays, point_stays = ~voxels, ~voxels[grid.voxel_of_point]
    kept = np.flatnonzero(stays)
    number = np.cumsum(stays, dtype=np.int32) - 1
    point_number = np.cumsum(point_stays) - 1
    degrees = np.empty(len(kept), np.int64)
    lists = in_blocks(_kept_neighbours, len(kept), kept, grid.neighbourhood, stays, number, degrees)
    counts, held = grid.counts[kept], np.diff(grid.starts)
    return replace(
        grid,
        cells=grid.cells.take(kept, axis=0),
        voxel_of_point=number[grid.voxel_of_point[point_stays]],
        order=point_number[grid.order[np.repeat(stays, held)]],
        starts=np.concatenate(([0], np.cumsum(held[kept]))),
        counts=counts,
        warped=grid.warped.take(kept, axis=0),
        centroids=grid.centroids.take(kept, axis=0),
        edge_lengths=grid.edge_lengths[kept],
        colors=None if grid.colors is None else grid.colors.take(kept, axis=0),
        indptr=np.concatenate(([0], np.cumsum(degrees))),
        neighbours=np.concatenate(lists),
        features=None if grid.features is None else grid.features.take(kept, axis=0),
        levels=None if grid.levels is None else grid.levels[kept],
    )


@kernel
def _kept_neighbours(
    start: int,
    stop: int,
    kept: NDArray[np.int64],
    grid: Neighbourhood,
    stays: NDArray[np.bool_],
    number: NDArray[np.int32],
    degrees: NDArray[np.int64],
) -> NDArray[np.int32]:
    """Lists of the neighbours that stay, by their new numbers, one kept voxel after the other; set their lengths,
    `degrees`."""
    most = np.int64(grid.indptr[kept[stop - 1] + 1] - grid.indptr[kept[start]]) if start < stop else 0
    found, n = np.empty(most, np.int32), 0
    for i in range(start, stop):
        before = n
        for at in range(grid.indptr[kept[i]], grid.indptr[kept[i] + 1]):
            j = grid.neighbours[at]
            if stays[j]:
                found[n] = number[j]
                n += 1
        degrees[i] = n - before
    return found[:n]


def voxel_grid(points: NDArray[np.float64], size: float, warp: Warp, grading: Grading | None = None) -> VoxelGrid:
    """Voxel grid over finite points, without colours and features (`with_means`).

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1.
    size : float, metres
        Voxel edge length, > 0.
    warp : Warp
        Transform to the space in which voxels are cubes of this size.
    grading : Grading, optional
        Blocks in which voxels are larger.

    Raises
    ------
    ValueError
        The cloud spans so many voxels that a grid coordinate cannot be written as a whole number.
    """
    (places, lattice), level_of_point = warp.on_lattice(points, size), None
    if grading is not None:
        places, lattice = lattice.in_cells(places), UNIT_CELLS
        level_of_point = grading.levels_of(places)
        places /= enlarged(np.ones(len(places)), level_of_point)[:, None]
    keys, pitch = _keys_of_levels(places, level_of_point, size, lattice)
    ordered, order = sorted_keys(keys)
    starts = starts_of_runs(ordered)
    n_voxels = len(starts) - 1
    levels = None if level_of_point is None else level_of_point[order[starts[:-1]]]
    voxel_of_point, (cells, warped) = np.empty(len(points), np.int32), np.empty((2, n_voxels, 3))
    in_blocks(_gather, n_voxels, starts, order, places, *lattice, voxel_of_point, cells, warped)
    warped *= size if levels is None else enlarged(np.full(n_voxels, size), levels)[:, None]
    centroids = warp.backward(warped)
    indptr, neighbours = _touching(ordered[starts[:-1]], pitch, cells, levels)
    return VoxelGrid(
        size=size,
        warp=warp,
        cells=cells,
        voxel_of_point=voxel_of_point,
        order=order,
        starts=starts,
        counts=np.diff(starts),
        warped=warped,
        centroids=centroids,
        edge_lengths=enlarged(size * warp.scale(centroids), levels),
        colors=None,
        indptr=indptr,
        neighbours=neighbours,
        levels=levels,
        grading=grading,
    )


def with_means(
    grid: VoxelGrid, colors: NDArray[np.float64] | None, features: NDArray[np.float32] | None = None
) -> VoxelGrid:
    """The grid with the mean colours, of (n, 3) float64, 0..1, and features, (n, d) float32, scaled, of its points."""
    return replace(
        grid,
        colors=None if colors is None else _sorted_means(colors, grid.starts, grid.order, _COLOR_STEPS),
        features=None if features is None else group_means(features, grid.voxel_of_point, grid.n_voxels),
    )


def voxel_means(values: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.float64]:
    """Mean of vectors of points, (n, 3), in [-1, 1], per voxel, (v, 3), independent of the points' order."""
    return _sorted_means(values, grid.starts, grid.order, _STEPS_PER_VOXEL)


def _sorted_means(
    values: NDArray[np.float64], starts: NDArray[np.int64], order: NDArray[np.int64], steps: float
) -> NDArray[np.float64]:
    """Means of vectors, (n, 3), by voxel, (v, 3), summed in so many steps per unit."""
    means = np.empty((len(starts) - 1, 3))
    in_blocks(_average, len(means), starts, order, values, steps, means)
    return means


@kernel
def _gather(
    start: int,
    stop: int,
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    places: NDArray[np.float64],
    corner: NDArray[np.float64],
    edge: float,
    voxel_of_point: NDArray[np.int32],
    cells: NDArray[np.float64],
    warped: NDArray[np.float64],
) -> None:
    """Set the voxel of each point, each voxel's cell, and the mean of its points in units of a voxel.

    Sums are of whole numbers, exact as long as a voxel has less than 2**32 points, so that their order does not count.
    """
    low_x, low_y, low_z = corner[0], corner[1], corner[2]
    for v in range(start, stop):
        x = y = z = 0.0
        p = order[starts[v]]
        cell_x, cell_y = np.floor((places[p, 0] - low_x) / edge), np.floor((places[p, 1] - low_y) / edge)
        cell_z = np.floor((places[p, 2] - low_z) / edge)
        cells[v, 0], cells[v, 1], cells[v, 2] = cell_x, cell_y, cell_z
        for at in range(starts[v], starts[v + 1]):
            p = order[at]
            voxel_of_point[p] = v
            x += np.rint(((places[p, 0] - low_x) / edge - cell_x) * _STEPS_PER_VOXEL)
            y += np.rint(((places[p, 1] - low_y) / edge - cell_y) * _STEPS_PER_VOXEL)
            z += np.rint(((places[p, 2] - low_z) / edge - cell_z) * _STEPS_PER_VOXEL)
        total = (starts[v + 1] - starts[v]) * _STEPS_PER_VOXEL
        warped[v, 0], warped[v, 1], warped[v, 2] = cell_x + x / total, cell_y + y / total, cell_z + z / total


@routine
def most_around(indptr: NDArray[np.uint64]) -> np.int64:
    """Length of the longest list of a `Neighbourhood`, at least 26, given the starts of its lists."""
    most = np.int64(MAX_NEIGHBOURS)
    for i in range(len(indptr) - 1):
        most = max(most, np.int64(indptr[i + 1] - indptr[i]))
    return most


@kernel
def _average(
    start: int,
    stop: int,
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    values: NDArray[np.float64],
    steps: float,
    means: NDArray[np.float64],
) -> None:
    """Set the means of vectors by voxel, summed as whole numbers, as in `_gather`."""
    for v in range(start, stop):
        x = y = z = 0.0
        for at in range(starts[v], starts[v + 1]):
            p = order[at]
            x += np.rint(values[p, 0] * steps)
            y += np.rint(values[p, 1] * steps)
            z += np.rint(values[p, 2] * steps)
        total = max(starts[v + 1] - starts[v], 1) * steps
        means[v, 0], means[v, 1], means[v, 2] = x / total, y / total, z / total


# --- which occupied voxels touch ---


def _keys_of_levels(
    places: NDArray[np.float64], levels: NDArray[np.int8] | None, size: float, lattice: Lattice = UNIT_CELLS
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """`cell_keys` of places on a lattice. If they have levels, (n,), they are in edges of their own voxels, and keys
    sort by level first.

    Cells of each level are counted from the first block, as their coordinates may be far from zero.

    Raises
    ------
    ValueError
        The places span so many cells that the numbers do not fit.
    """
    if levels is None:
        return cell_keys(places, size, lattice=lattice)
    per_block = BLOCK / enlarged(np.ones(len(places)), levels)[:, None]
    whole = np.floor(places)
    whole -= per_block * np.floor(whole / per_block).min(axis=0)
    keys, pitch = cell_keys(whole, size, rooms=2 * (int(levels.max()) + 1))
    of_level = keys.max() + 2 * pitch[0]  # so that cells of two levels never seem to touch
    return keys + levels * of_level, pitch


def _touching(
    keys: NDArray[np.int64], pitch: tuple[int, int], cells: NDArray[np.float64], levels: NDArray[np.int8] | None
) -> VoxelLists:
    """`touching_voxels`, with the voxels of other levels that touch."""
    same = touching_voxels(keys, *pitch)
    if levels is None:
        return same
    finer, coarser = _touching_across(cells, levels)
    n, counts = len(keys), np.diff(same.indptr)
    larger = np.bincount(finer, minlength=n)
    smaller = np.bincount(coarser, minlength=n)
    indptr = np.concatenate((np.zeros(1, np.int64), np.cumsum(smaller + counts + larger)))
    neighbours = np.empty(indptr[-1], np.int32)
    neighbours[_concatenated_ranges(indptr[:-1] + smaller, counts)] = same.neighbours
    neighbours[_concatenated_ranges(indptr[:-1], smaller)] = finer[np.lexsort((finer, coarser))]
    neighbours[_concatenated_ranges(indptr[:-1] + smaller + counts, larger)] = coarser[np.lexsort((coarser, finer))]
    return VoxelLists(indptr, neighbours)


def _concatenated_ranges(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Whole numbers of several ranges, start to start + count - 1 each, one range after the other."""
    return np.arange(counts.sum()) + np.repeat(starts - np.cumsum(counts) + counts, counts)


def _touching_across(
    cells: NDArray[np.float64], levels: NDArray[np.int8]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of touching voxels of two levels, finer and coarser ones, (m,) each. They lie at borders of blocks."""
    finer, coarser, present = [np.empty(0, np.int64)], [np.empty(0, np.int64)], np.unique(levels)
    for level in present[:-1]:
        per_block = float(BLOCK >> int(level))
        of_level = np.flatnonzero(levels == level)
        in_block = cells[of_level] % per_block
        at_border = ((in_block == 0.0) | (in_block == per_block - 1.0)).any(axis=1)
        of_level = of_level[at_border]
        blocks = np.floor(cells[of_level] / per_block)
        for other in present[present > level]:
            coarse, ratio = np.flatnonzero(levels == other), 2.0 ** (int(other) - int(level))
            fine = of_level[_beside_blocks(blocks, np.floor(cells[coarse] / (per_block / ratio)))]
            low, high = np.floor((cells[fine] - 1.0) / ratio), np.floor((cells[fine] + 1.0) / ratio)
            keys, pitch = cell_keys(np.concatenate((cells[coarse], low, high)), 1.0)
            sought, at_low = keys[: len(coarse)], keys[len(coarse) : len(coarse) + len(fine)]
            for corner in np.ndindex(2, 2, 2):
                within = np.all((low < high) | (np.array(corner) == 0), axis=1)
                target = at_low[within] + corner[0] * pitch[0] + corner[1] * pitch[1] + corner[2]
                at = np.minimum(np.searchsorted(sought, target), len(sought) - 1)
                touches = sought[at] == target
                finer.append(fine[within][touches])
                coarser.append(coarse[at[touches]])
    return np.concatenate(finer), np.concatenate(coarser)


def _beside_blocks(blocks: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each of n blocks, (n, 3), touches one of some others, (n,) bool."""
    steps = np.stack(np.meshgrid(*3 * [[-1.0, 0.0, 1.0]]), axis=-1).reshape(-1, 3)
    around = (np.unique(others, axis=0)[:, None] + steps).reshape(-1, 3)
    keys = cell_keys(np.concatenate((around, blocks)), 1.0)[0]
    return np.isin(keys[len(around) :], keys[: len(around)])


def occupied_cells(
    places: NDArray[np.float64], size: float, lattice: Lattice = UNIT_CELLS
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Cells that hold places, (v, 3) float64, ascending, and the number of occupied cells around some of them, int64.

    If there are many cells, those around are counted for evenly spread stretches of cells.

    Parameters
    ----------
    places : (n, 3) float64
        Places on the lattice.
    size : float, metres
        Edge length of a cell, for the message of the error.
    lattice : Lattice
        Default: places are in cell edges.

    Raises
    ------
    ValueError
        The places span so many cells that a grid coordinate cannot be written as a whole number.
    """
    keys, pitch = cell_keys(places, size, lattice=lattice)
    ordered, order = sorted_keys(keys)
    first = starts_of_runs(ordered)[:-1]
    occupied, degrees = ordered[first], np.empty(len(first), np.int64)
    step = _STRETCH * max(1, len(first) // _COUNTED)
    stretches = [slice(at, min(at + _STRETCH, len(first))) for at in range(0, len(first), step)]
    for stretch in stretches:
        _walk(stretch.start, stretch.stop, occupied, *pitch, degrees, _NO_BUFFER)
    counted = np.concatenate([degrees[stretch] for stretch in stretches])
    return np.floor(lattice.in_cells(places.take(order[first], axis=0))), counted


def touching_voxels(keys: NDArray[np.int64], pitch_x: int, pitch_y: int) -> VoxelLists:
    """The 26-neighbourhood of occupied voxels.

    Parameters
    ----------
    keys : (v,) int64
        Ascending keys, x pitch_x + y pitch_y + z of each voxel, with two cells to spare at the end of every row.
    pitch_x, pitch_y : int
        What a step in x and in y adds to a key.
    """
    counts = np.empty(len(keys), np.int64)
    room = np.empty(
        len(keys) * MAX_NEIGHBOURS, np.int32
    )  # most is never touched; not in the kernel, as in `sorted_keys`
    lists = in_blocks(_walk, len(keys), keys, pitch_x, pitch_y, counts, room)
    neighbours = lists[0] if len(lists) == 1 else np.concatenate(lists)
    return VoxelLists(np.concatenate((np.zeros(1, np.int64), np.cumsum(counts))), neighbours)


def touching_counts(keys: NDArray[np.int64], pitch_x: int, pitch_y: int) -> NDArray[np.int64]:
    """Number of occupied voxels among the 26 around each voxel, (v,); arguments as for `touching_voxels`."""
    counts = np.empty(len(keys), np.int64)
    in_blocks(_walk, len(keys), keys, pitch_x, pitch_y, counts, _NO_BUFFER)
    return counts


@kernel
def _walk(
    start: int,
    stop: int,
    keys: NDArray[np.int64],
    pitch_x: int,
    pitch_y: int,
    counts: NDArray[np.int64],
    room: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Lists of touching voxels, one after the other, in `room`, if that is not empty; set their lengths, `counts`.

    Nine pointers walk along the sorted keys, one for each row of three voxels around. They are unsigned as the numbers
    of `Neighbourhood` are.
    """
    with_lists, found, n_found = len(room) > 0, room[start * MAX_NEIGHBOURS :], 0
    pointers, end, one = np.empty(9, np.uint64), np.uint64(len(keys)), np.uint64(1)
    shifts = np.empty(9, np.int64)
    for row in range(9):
        shifts[row] = (row // 3 - 1) * pitch_x + (row % 3 - 1) * pitch_y - 1
        low, high = 0, len(keys) if start < stop else 0  # np.searchsorted takes seconds to compile
        while low < high:
            middle = (low + high) // 2
            if keys[middle] < keys[start] + shifts[row]:
                low = middle + 1
            else:
                high = middle
        pointers[row] = low
    for i in range(start, stop):
        count = 0
        for row in range(9):
            target = keys[i] + shifts[row]
            at = pointers[row]
            while at < end and keys[at] < target:
                at += one
            pointers[row] = at
            while at < end and keys[at] <= target + 2:
                if at != np.uint64(i):
                    if with_lists:
                        found[n_found + count] = at
                    count += 1
                at += one
        counts[i] = count
        n_found += count
    return found[: n_found if with_lists else 0]


# --- which voxels lie near each other ---


def boundary_voxels(grid: VoxelGrid) -> NDArray[np.bool_]:
    """Whether each voxel lies at the end of a surface, with fewer than eight voxels around it, (v,) bool."""
    return np.diff(grid.indptr) < _INTERIOR_NEIGHBOURS


def at_ends(grid: VoxelGrid, voxels: NDArray[np.int64], surfaces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each of m voxels lies at the end of its surface, (m,) bool, even if that is two voxels thick.

    Amid a surface, six of the eight places beside a voxel are occupied, as seen along one of the axes. At an end there
    is no such axis. `surfaces` are the numbers of those on which the grid's voxels lie, (v,).
    """
    ends = np.empty(len(voxels), np.bool_)
    in_blocks(_find_ends, len(voxels), voxels, surfaces, grid.cells, grid.levels, grid.neighbourhood, ends)
    return ends


@kernel
def _find_ends(
    start: int,
    stop: int,
    voxels: NDArray[np.int64],
    surfaces: NDArray[np.int64],
    cells: NDArray[np.float64],
    levels: NDArray[np.int8] | None,
    around: Neighbourhood,
    ends: NDArray[np.bool_],
) -> None:
    """Set whether each of some voxels lies at the end of its surface."""
    taken, side = np.empty((3, 9), np.int64), np.empty(3, np.int64)  # places beside the voxel, as seen along each axis
    for m in range(start, stop):
        i, is_end = voxels[m], True
        for axis in range(3):
            for place in range(9):
                taken[axis, place] = 0
        for a in range(around.indptr[i], around.indptr[i + 1]):
            j = around.neighbours[a]
            if surfaces[j] != surfaces[i]:
                continue
            for axis in range(3):
                side[axis] = _beside(cells, levels, i, j, axis)
            right, ahead, above = side[0], side[1], side[2]
            taken[0, 3 * ahead + above] = taken[1, 3 * right + above] = taken[2, 3 * right + ahead] = 1
        for axis in range(3):
            n_taken = -taken[axis, 4]  # without its own place
            for place in range(9):
                n_taken += taken[axis, place]
            is_end = is_end and n_taken < _MIN_IN_PROJECTION
        ends[m] = is_end


@routine
def _beside(cells: NDArray[np.float64], levels: NDArray[np.int8] | None, i: int, j: int, axis: int) -> int:
    """Position along an axis of voxel j, which touches voxel i: 0 before it, 1 in line with it, 2 behind it."""
    step = cells[j, axis] - cells[i, axis]
    if levels is not None and levels[i] != levels[j]:
        step = math.floor((cells[j, axis] + 0.5) * 2.0 ** (levels[j] - levels[i])) - cells[i, axis]
    return int(min(max(step, -1.0), 1.0)) + 1


def voxels_within(
    grid: VoxelGrid,
    voxels: NDArray[np.int64],
    reach: float,
    among: NDArray[np.int64] | None = None,
    *,
    later: bool = False,
) -> VoxelLists:
    """Voxels near each of m voxels, without itself: the means of their points lie within some voxel edges of its own.

    Of two voxels of different levels, the edge of the larger one counts.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    voxels : (m,) int64
        Ascending.
    reach : float, voxel edges
    among : (a,) int64, optional
        Voxels that may be found, ascending. Default: all.
    later : bool
        Whether only voxels of larger numbers are sought, so that each pair is found once.
    """
    if grid.levels is not None:
        return _within_of_levels(grid, voxels, reach, np.arange(grid.n_voxels) if among is None else among, later)
    keys, pitch = cell_keys(grid.cells, grid.size, max(math.ceil(reach), 2))
    places, counts = grid.warped / grid.size, np.zeros(len(voxels), np.int64)
    around = _Places(keys[voxels], places[voxels])
    sought = _Places(keys, places) if among is None else _Places(keys[among], places[among])
    found = np.concatenate(in_blocks(_within, len(voxels), around, sought, pitch, reach, later, counts))
    indptr = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    return VoxelLists(indptr, found if among is None else among.astype(np.int32)[found])


def _within_of_levels(
    grid: VoxelGrid, voxels: NDArray[np.int64], reach: float, among: NDArray[np.int64], later: bool
) -> VoxelLists:
    """`voxels_within` for a grid of several levels: pairs are sought level by level, by that of their larger voxel."""
    assert grid.levels is not None
    source, target = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for level in np.unique(grid.levels):
        places = grid.warped / math.ldexp(grid.size, int(level))
        keys, pitch = cell_keys(places, grid.size, max(math.ceil(reach), 2))
        for ones, others, of_both in (
            (voxels[grid.levels[voxels] == level], among[grid.levels[among] == level], True),
            (voxels[grid.levels[voxels] == level], among[grid.levels[among] < level], False),
            (voxels[grid.levels[voxels] < level], among[grid.levels[among] == level], False),
        ):
            ones, others = (some[np.argsort(keys[some], kind="stable")] for some in (ones, others))
            counts = np.zeros(len(ones), np.int64)
            around, sought = _Places(keys[ones], places[ones]), _Places(keys[others], places[others])
            found = in_blocks(_within, len(ones), around, sought, pitch, reach, later and of_both, counts)
            source.append(np.repeat(ones, counts))
            target.append(others[np.concatenate(found)])
    sources, targets = np.concatenate(source), np.concatenate(target)
    if later:
        sources, targets = sources[sources < targets], targets[sources < targets]
    order = np.lexsort((targets, sources))
    counts = np.bincount(np.searchsorted(voxels, sources), minlength=len(voxels))
    return VoxelLists(np.concatenate((np.zeros(1, np.int64), np.cumsum(counts))), targets[order].astype(np.int32))


class _Places(NamedTuple):
    """Places of n voxels.

    Attributes
    ----------
    keys : (n,) int64
        Keys of their cells, ascending.
    means : (n, 3) float64
        Means of their points, in voxel edges.
    """

    keys: NDArray[np.int64]
    means: NDArray[np.float64]


@kernel
def _within(
    start: int,
    stop: int,
    around: _Places,
    sought: _Places,
    pitch: tuple[int, int],
    reach: float,
    later: bool,
    counts: NDArray[np.int64],
) -> NDArray[np.int32]:
    """Lists of the voxels within reach of each, one after the other; set their lengths, `counts`.

    Pointers gallop along the sorted keys, one for each row of cells.
    """
    keys, places = sought.keys, sought.means
    n, cells, n_rows = len(keys), int(np.ceil(reach)), 0
    shifts = np.empty((2 * cells + 1) ** 2, np.int64)  # of the rows' middles, ascending
    for x in range(0 if later else -cells, cells + 1):
        for y in range(0 if later and x == 0 else -cells, cells + 1):
            if max(abs(x) - 1, 0) ** 2 + max(abs(y) - 1, 0) ** 2 <= reach * reach:
                shifts[n_rows] = x * pitch[0] + y * pitch[1]
                n_rows += 1
    pointers = np.zeros(n_rows, np.int64)
    ahead = np.full(n_rows, keys[0] if n else 0)  # keys at the pointers
    n_found, found = 0, np.empty(1024, np.int32)
    for v in range(start, stop):
        own, before = around.keys[v], n_found
        mean_x, mean_y, mean_z = around.means[v, 0], around.means[v, 1], around.means[v, 2]
        for row in range(n_rows):
            middle = own + shifts[row]
            if ahead[row] > middle + cells:
                continue
            first = own + 1 if later and row == 0 else middle - cells
            at = pointers[row] = gallop(keys, pointers[row], first)
            ahead[row] = keys[at] if at < n else _END
            while at < n and keys[at] <= middle + cells:
                if keys[at] != own:
                    x, y, z = places[at, 0] - mean_x, places[at, 1] - mean_y, places[at, 2] - mean_z
                    if x * x + y * y + z * z <= reach * reach:
                        if n_found == len(found):
                            found = np.concatenate((found, np.empty_like(found)))
                        found[n_found] = at
                        n_found += 1
                at += 1
        counts[v] = n_found - before
    return found[:n_found]


# --- two scans of one scene in one grid ---


@dataclass(frozen=True, eq=False)
class GridUnion:
    """The union of two grids.

    Attributes
    ----------
    grid : VoxelGrid of v voxels
        Means are weighted by points. `counts` are of the points of both grids; `voxel_of_point`, `order` and `starts`
        are of the second grid's points alone.
    first, second : (v1,), (v2,) int64
        Number in the union of each voxel of the two grids.
    """

    grid: VoxelGrid
    first: NDArray[np.int64]
    second: NDArray[np.int64]


def grid_union(a: VoxelGrid, b: VoxelGrid) -> GridUnion:
    """Union of two grids of the same size, warp and grading.

    Raises
    ------
    ValueError
        One grid has colours or features and the other has none.
    """
    if (a.colors is None) != (b.colors is None):
        raise ValueError("expected colours with both scans or with neither, got them with one")
    if (a.features is None) != (b.features is None):
        raise ValueError("expected features with both scans or with neither, got them with one")
    cells = np.vstack((a.cells, b.cells))
    levels = None if a.levels is None or b.levels is None else np.concatenate((a.levels, b.levels))
    keys, pitch = _keys_of_levels(cells, levels, a.size)
    unique_keys, at, voxel = np.unique(keys, return_index=True, return_inverse=True)
    first, second = voxel[: a.n_voxels], voxel[a.n_voxels :]
    counts = np.zeros(len(unique_keys), np.int64)
    counts[first] += a.counts
    counts[second] += b.counts

    def blend(of_a: NDArray[np.float64], of_b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Means of both grids, weighted by points."""
        mean = np.zeros((len(counts), of_a.shape[1]))
        mean[first] = of_a
        fraction = (b.counts / counts[second])[:, None]
        mean[second] += fraction * (of_b - mean[second])
        return mean

    warped = blend(a.warped, b.warped)
    colors = None if a.colors is None or b.colors is None else blend(a.colors, b.colors)
    features = None if a.features is None or b.features is None else blend(a.features, b.features)
    centroids = a.warp.backward(warped)
    points_of_b = np.zeros(len(counts) + 1, np.int64)
    points_of_b[second + 1] = b.counts
    levels = None if levels is None else levels[at]
    indptr, neighbours = _touching(unique_keys, pitch, cells[at], levels)
    grid = VoxelGrid(
        size=a.size,
        warp=a.warp,
        cells=cells[at],
        voxel_of_point=second[b.voxel_of_point].astype(np.int32),
        order=b.order,
        starts=np.cumsum(points_of_b),
        counts=counts,
        warped=warped,
        centroids=centroids,
        edge_lengths=enlarged(a.size * a.warp.scale(centroids), levels),
        colors=colors,
        indptr=indptr,
        neighbours=neighbours,
        features=features,
        levels=levels,
        grading=a.grading,
    )
    return GridUnion(grid, first, second)
