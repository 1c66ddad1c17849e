# SPDX-License-Identifier: Apache-2.0
"""Sizes of voxels and supervoxels, such that surfaces stay whole and show their detail.

A voxel is joined if at least five others are around it, as on a surface; see `MIN_NEIGHBOURS_ON_SURFACE`. The joined
fraction is that of the voxels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.kinds import Acquisition
from pcgraph.voxels.cells import UNIT_CELLS, cell_keys, sorted_keys, starts_of_runs
from pcgraph.voxels.grading import BLOCK, Grading
from pcgraph.voxels.grid import (
    MIN_NEIGHBOURS_ON_SURFACE,
    VoxelGrid,
    VoxelLists,
    occupied_cells,
    touching_counts,
    touching_voxels,
    voxel_grid,
)
from pcgraph.voxels.surface import roughness

# Gains are those of docs/pcgraph_experiments.md: the mean of all scores, less the mean without the rule.

VOXELS_PER_SEED = 5.0
"""Voxel edges between seeds by default, at most; chosen by eye."""
MIN_VOXELS_PER_SEED = 3.0
"""Voxel edges between seeds, at least, so that a supervoxel has some eight voxels; 2 was tried and given up."""
_MIN_JOINED = 0.75
"""Joined fraction below which voxels are enlarged, and at which that stops; chosen by eye, not varied."""
_HALF_JOINED = 0.5
"""Joined fraction below which a cloud is sparse, as scans of few beams are; chosen by eye, not varied."""


@dataclass(frozen=True)
class SeedThresholds:
    """Distance of seeds (`seed_spacing`). Gain: 0.0023; of closer seeds on smooth surfaces 0.0022."""

    min_supervoxels: int = 800  # count, about: seeds move closer until there are so many
    min_supervoxels_on_smooth: int = 6000  # the same on smooth surfaces; 8000 gains 0.007 for things, room1 loses 0.009
    smooth: float = 0.14  # voxel edges, roughness of smooth surfaces; 0.1 loses things of toys and fruit
    rough: float = 0.2  # voxel edges, roughness of others; between the two the count is interpolated
    min_joined: float = 0.9  # joined fraction below which no surface counts as smooth; chosen by eye
    voxels_per_supervoxel: float = 0.86  # over the squared seed spacing in voxel edges; its source is not recorded


@dataclass(frozen=True)
class EnlargementThresholds:
    """Enlargement of voxels, by half powers of two, if surfaces fall apart. Gain: 0.0033."""

    max_steps: int = 10  # half powers of two: 32 times the size
    min_voxels: int = 500  # voxels that have to be left
    min_gain: float = 0.1  # fraction of the voxels that each step has to join, if half were joined: cars in sweeps
    min_gain_of_sparse: float = 0.15  # the same if fewer were joined: scans of few beams join 0.06 to 0.11, bins 0.175


@dataclass(frozen=True)
class RefinementThresholds:
    """Reduction of voxels, by quarters of a power of two, as long as surfaces stay whole. Gain: 0.0071."""

    max_steps: int = 4  # quarters of a power of two: half the size
    all_joined: float = 0.93  # fraction of the voxels that has to stay joined; 0.92 to 0.935 are alike to 0.01
    kept_joined: float = 0.97  # fraction of the joined voxels that has to stay so, if fewer than `_MIN_JOINED` are
    price: float = 0.25  # joined fraction per voxel edge of roughness; 0.2 to 0.35 are alike to 0.01
    price_of_large: float = 0.4  # the same for large grids
    large: int = 120_000  # voxels of a large grid, which costs time: it is refined only if all are joined
    max_voxels: int = 300_000  # voxels of a refined grid, about; at 480 000 a room of a million points takes 1.8 times
    slab: int = 1 << 14  # voxels, in the middle of the grid's order, off which all this is read
    few: int = 750  # voxels: if a grid has no more, it is enough that `joined_of_few` stay joined;
    enough: int = 40_000  # voxels: from here on the rule for few ends; between, the fraction rises with the logarithm
    joined_of_few: float = 0.5  # fraction of the voxels; it rises to `all_joined`, or to 1 in one scan
    price_of_few: float = 1.0  # price of roughness for these; with a quarter of it heaps in noise fall apart


@dataclass(frozen=True)
class GradingThresholds:
    """Enlargement of voxels by powers of two, block by block.

    Without this a law fails: half of a scene may be thinned. Tried and given up: two doublings at most; asking blocks
    of which fewer than 0.5, or 0.75, are joined; one block alone if it has 20 or 80 voxels; blocks of 8 voxels.
    """

    max_level: int = 3  # doublings of the edge
    sparse_in_small: float = 0.2  # joined fraction of a sparse block, at most, in a small grid
    sparse_in_large: float = 0.6  # the same in a large one; between, it is interpolated by the logarithm
    small: int = 10_000  # voxels of a small grid, whose things have few
    large: int = 20_000  # voxels of a large one
    min_voxels: int = 20  # larger voxels in and around a block: with fewer it is not judged
    min_gain: float = 0.2  # fraction of the voxels that each doubling has to join, if half were joined at first
    line_ratio: float = 0.65  # fraction of a block's voxels that doubled edges leave of lines, at most; planes: 0.76
    line_joined: float = 0.4  # joined fraction of these, at most; 0.3 to 0.5, and ratios of 0.6 to 0.8, are as good
    nearly_all_joined: float = 0.98  # joined fraction of all voxels, from which on there is no grading
    min_graded: float = 0.003  # fraction of the voxels that grading has to make larger


_SEEDS = SeedThresholds()
_LARGER = EnlargementThresholds()
_SMALLER = RefinementThresholds()
_GRADED = GradingThresholds()


def seed_spacing(grid: VoxelGrid, acquisition: Acquisition) -> float:
    """Spacing of seeds, metres: five voxel edges; less, but at least three, if that gives few supervoxels.

    On the smooth surfaces of meshes and of thinned clouds more supervoxels are better: normals are exact there, and
    small things need supervoxels of their own.
    """
    few, many = _SEEDS.min_supervoxels, _SEEDS.min_supervoxels_on_smooth
    usual = _edges_per_seed(grid, few)
    may_be_closer = _edges_per_seed(grid, many) < usual and not acquisition.is_one_scan
    if may_be_closer and _joined(np.diff(grid.indptr)) >= _SEEDS.min_joined:
        fraction = min(max((_SEEDS.rough - roughness(grid)) / (_SEEDS.rough - _SEEDS.smooth), 0.0), 1.0)
        usual = _edges_per_seed(grid, few * (many / few) ** fraction)
    return grid.size * usual


def _edges_per_seed(grid: VoxelGrid, many: float) -> float:
    """Voxel edges between seeds, 3..5, that give about as many supervoxels as asked for."""
    edges = seed_spacing_for(many, grid) / grid.size
    return min(max(edges, MIN_VOXELS_PER_SEED), VOXELS_PER_SEED)


def voxel_size_for(n_supervoxels: int, points: NDArray[np.float64], grid: VoxelGrid) -> float:
    """The largest voxel size, metres, from that of the grid down to a half of it, that allows for so many supervoxels.

    Seeds have to lie three voxel edges apart. Voxels do not get so small that fewer than three quarters are joined, or
    half of them if fewer than three quarters are at first.
    """
    size, least = grid.size, _MIN_JOINED if _joined(np.diff(grid.indptr)) >= _MIN_JOINED else _HALF_JOINED
    finer = grid
    for step in range(1, _SMALLER.max_steps + 1):
        if seed_spacing_for(n_supervoxels, finer) >= MIN_VOXELS_PER_SEED * finer.size:
            break
        finer = voxel_grid(points, grid.size / 2.0 ** (step / 4.0), grid.warp)
        if _joined(np.diff(finer.indptr)) < least:
            break
        size = finer.size
    return size


def seed_spacing_for(n_supervoxels: float, grid: VoxelGrid) -> float:
    """Spacing of seeds, metres, that gives about `n_supervoxels` on the surface that the voxels of a grid cover."""
    return grid.size * math.sqrt(grid.n_voxels / (_SEEDS.voxels_per_supervoxel * n_supervoxels))


def adapted_voxel_size(
    points: NDArray[np.float64], grid: VoxelGrid, acquisition: Acquisition, largest: float = math.inf
) -> tuple[float, float]:
    """Size of the voxels, metres: larger than now if surfaces fall apart, smaller if they would stay whole.

    A cloud of few points may have still smaller voxels, so that each thing has some. That is so if neither of the two
    rules changes the size, and no block needs larger voxels (`adapted_grading`). The second result is the size without
    this last rule.

    Parameters
    ----------
    points : (n, 3) float64, metres
        The points in the grid.
    grid : VoxelGrid
        Its voxels are of one size.
    acquisition : Acquisition
    largest : float, metres
        Upper limit of an enlarged size.
    """
    degrees = np.diff(grid.indptr)
    joined, of_few = _joined(degrees), _enough_of_few(grid, acquisition)
    is_fragmented = joined < min(_MIN_JOINED, of_few)
    larger = _enlarged_size(points, grid, degrees, largest, acquisition.is_one_scan) if is_fragmented else grid.size
    usual = _refined_size(points, grid, degrees, acquisition.is_one_scan) if larger == grid.size else larger
    if usual == grid.size and joined >= of_few and adapted_grading(grid, acquisition) is None:
        return _finest(points, grid, slice(0, grid.n_voxels), _SMALLER.max_steps, of_few, _SMALLER.price_of_few), usual
    return usual, usual


def _enough_of_few(grid: VoxelGrid, acquisition: Acquisition) -> float:
    """Joined fraction, less roughness, that has to be left when few voxels are made smaller; infinite for many voxels.

    The fewer voxels there are, the fewer each thing has; so the fewer of them have to stay joined. It is infinite for
    images, too, whose spacing along rows may differ from that along columns.
    """
    n = grid.n_voxels
    if n >= _SMALLER.enough or acquisition.has_pixels:
        return math.inf
    fraction = _log_interpolated(n, _SMALLER.few, _SMALLER.enough)
    most = 1.0 if acquisition.is_one_scan else _SMALLER.all_joined
    return _SMALLER.joined_of_few + fraction * (most - _SMALLER.joined_of_few)


def _joined(degrees: NDArray[np.int64]) -> float:
    """Joined fraction, 0..1, of voxels that have so many others around them, (v,)."""
    return float(np.mean(degrees >= MIN_NEIGHBOURS_ON_SURFACE))


def _enlarged_size(
    points: NDArray[np.float64], grid: VoxelGrid, degrees: NDArray[np.int64], largest: float, of_one_scan: bool
) -> float:
    """The size, or a larger one by half powers of two, enough to join what falls apart.

    - If at least half of the voxels are joined at first, the size is the first at which three quarters are, provided
      that each step on average joins a tenth more. Else it stays, as for the far rings of a sweep.
    - In one scan of which less than half is joined, such as a sweep of few beams, half is enough. The size grows on as
      long as each step joins a tenth more.
    - In several scans of which less than half is joined, half is enough, too, unless each step to three quarters joins
      0.15 more.
    - If no size joins three quarters, the size stays (in a sweep of few beams, as the second rule says): what is no
      surface at any size, such as a line, keeps it.
    """
    cells, size, joined, joined_at_first = [grid.cells, grid.cells], grid.size, 0.0, _joined(degrees)
    is_sparse, best = joined_at_first < _HALF_JOINED, grid.size
    few_beams = of_one_scan and is_sparse
    least, much = (math.inf, _LARGER.min_gain_of_sparse) if is_sparse else (grid.size, _LARGER.min_gain)
    for step in range(1, _LARGER.max_steps + 1):
        size *= math.sqrt(2.0)
        if size > largest:
            break
        # After two steps eight cells are one, so that only the first step needs the points.
        places, lattice = grid.warp.on_lattice(points, size) if step == 1 else (cells[0] / 2.0, UNIT_CELLS)
        larger, degrees = occupied_cells(places, size, lattice)
        if len(larger) < _LARGER.min_voxels:
            break
        cells, before, joined = [cells[1], larger], joined, _joined(degrees)
        if few_beams and joined >= _HALF_JOINED:
            if before >= _HALF_JOINED and joined - before < _LARGER.min_gain:
                break
            best = size
        least = min(least, size) if joined >= _HALF_JOINED else least
        if joined >= _MIN_JOINED:
            if not few_beams:
                best = size if joined - joined_at_first >= much * step else least
            break
    return best


def _refined_size(points: NDArray[np.float64], grid: VoxelGrid, degrees: NDArray[np.int64], of_one_scan: bool) -> float:
    """The size, or a smaller one by quarters of a power of two, down to a half, at which nearly all voxels stay joined.

    So the size follows how evenly points lie, not only how near to each other: the evenly spaced vertices of a mesh
    allow for smaller voxels than points at random.

    - If fewer than three quarters of the voxels are joined at first, as in a sweep thinned to a point per cube, nearly
      as many have to stay joined.
    - The rougher the surface, the more voxels have to stay joined, as noise needs larger voxels.
    - This is read off a slab in the middle of the grid. It may be the dense part of several scans, so all voxels of the
      grid have to be joined as well.
    - One scan keeps its size: its points lie less densely where surfaces slant, and its rows lie far apart.
    - To save time, no grid gets more than some 300 000 voxels, and large grids that are not all joined keep their size.
    """
    n, size, joined = grid.n_voxels, grid.size, _joined(degrees)
    if of_one_scan or joined < _HALF_JOINED:
        return size
    steps = min(_SMALLER.max_steps, int(2.0 * math.log2(_SMALLER.max_voxels / n)))  # 4 steps: 4 times as many
    if steps < 1 or (n > _SMALLER.large and joined < _SMALLER.all_joined):
        return size
    slab = slice(max(0, (n - _SMALLER.slab) // 2), min(n, (n + _SMALLER.slab) // 2))
    of_slab = _joined(degrees[slab])
    least = _SMALLER.all_joined if of_slab >= _MIN_JOINED else _SMALLER.kept_joined * of_slab
    if joined < least:
        return size
    return _finest(points, grid, slab, steps, least, _SMALLER.price_of_large if n > _SMALLER.large else _SMALLER.price)


def _finest(points: NDArray[np.float64], grid: VoxelGrid, slab: slice, steps: int, least: float, price: float) -> float:
    """The size after some steps by quarters of a power of two: the smallest that leaves enough voxels joined.

    The joined fraction of the voxels in a slab, less `price` times their roughness, has to be at least `least`.
    """
    size, some = grid.size, points[grid.order[grid.starts[slab.start] : grid.starts[slab.stop]]]
    for step in range(1, steps + 1):
        finer = voxel_grid(some, grid.size / 2.0 ** (step / 4.0), grid.warp)
        joined = _joined(np.diff(finer.indptr))
        if joined < least:
            break
        if joined - price * roughness(finer) >= least:
            size = finer.size
    return size


def adapted_grading(grid: VoxelGrid, acquisition: Acquisition) -> Grading | None:
    """Blocks in which voxels are larger by powers of two, because points lie far apart there; None if there are few.

    Spacing was read near one of several tripods; far from them surfaces fall apart. That is asked of each block with
    the 26 around it. One scan needs none of this, as its voxels grow with range. Blocks of lines, such as wires, keep
    their size: lines fall apart at any size until they touch each other and are one. They are told by doubling the
    edge, which leaves half of the voxels of a line, and as few joined; of a surface of which so few voxels are joined
    it leaves at least three quarters.

    Parameters
    ----------
    grid : VoxelGrid
        Its voxels are of one size.
    acquisition : Acquisition
    """
    joined = grid.joined
    if acquisition.is_one_scan or np.mean(joined) >= _GRADED.nearly_all_joined:
        return None
    keys, pitch = cell_keys(grid.cells / BLOCK, grid.size)
    ordered, order = sorted_keys(keys)
    starts = starts_of_runs(ordered)
    block = np.empty(grid.n_voxels, np.int64)
    block[order] = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    around, blocks = touching_voxels(ordered[starts[:-1]], *pitch), np.floor(grid.cells[order[starts[:-1]]] / BLOCK)
    at_first, before = _joined_around(joined, block, around)
    levels, asked = np.zeros(len(at_first), np.int8), at_first < _sparse_below(grid.n_voxels)
    cells, of_block = grid.cells, block
    for level in range(1, _GRADED.max_level + 1):
        if not asked.any():
            break
        cells = np.floor(cells / 2.0)
        keys, pitch = cell_keys(cells, grid.size)
        ordered, order = sorted_keys(keys)
        first = starts_of_runs(ordered)[:-1]
        cells, of_block = cells[order[first]], of_block[order[first]]
        joined = touching_counts(ordered[first], *pitch) >= MIN_NEIGHBOURS_ON_SURFACE
        fraction, n = _joined_around(joined, of_block, around)
        asked &= (n > _GRADED.line_ratio * before) | (fraction >= _GRADED.line_joined)
        before = n
        whole = asked & (fraction >= _MIN_JOINED) & (n >= _GRADED.min_voxels)
        whole &= (at_first < _HALF_JOINED) | (fraction - at_first >= _GRADED.min_gain * level)
        levels[whole] = level
        asked &= ~whole
    larger = levels > 0
    if np.mean(larger[block]) < _GRADED.min_graded:
        return None
    return Grading(blocks[larger], levels[larger])


def _sparse_below(n_voxels: int) -> float:
    """Joined fraction below which a block is sparse, in a grid of so many voxels.

    In a small grid each thing has few voxels. It needs these more than its surface needs to be whole.
    """
    least, most = _GRADED.sparse_in_small, _GRADED.sparse_in_large
    return least + _log_interpolated(n_voxels, _GRADED.small, _GRADED.large) * (most - least)


def _log_interpolated(n: int, few: int, many: int) -> float:
    """Position of a number between few and many on a logarithmic scale, 0..1."""
    return min(max(math.log(n / few) / math.log(many / few), 0.0), 1.0)


def _joined_around(
    joined: NDArray[np.bool_], block: NDArray[np.int64], around: VoxelLists
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joined fraction of the voxels in each of b blocks and those around it, (b,), and the number of voxels, (b,)."""
    n_blocks = len(around.indptr) - 1
    of_block = np.repeat(np.arange(n_blocks), np.diff(around.indptr))
    sums = []
    for counted in (np.ones(len(joined)), joined):
        own = np.bincount(block, counted, n_blocks)
        sums.append((own + np.bincount(of_block, own[around.neighbours], n_blocks)).astype(np.float64))
    n, n_joined = sums
    return n_joined / np.maximum(n, 1.0), n
