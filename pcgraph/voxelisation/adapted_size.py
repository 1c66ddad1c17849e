# SPDX-License-Identifier: Apache-2.0
"""How large voxels and supervoxels are, so that surfaces stay whole and show their detail."""

from __future__ import annotations

import math

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

# Seeds
VOXELS_PER_SEED = 5.0
"""Voxel edges between seeds by default, at most,"""
MIN_VOXELS_PER_SEED = 3.0
"""and at least."""
_MIN_SUPERVOXELS = 800  # seeds move closer until there are about so many
_MIN_SUPERVOXELS_ON_SMOOTH = 6000  # or so many, on smooth surfaces
_SMOOTH, _ROUGH = 0.14, 0.2  # roughness, voxel edges, of smooth surfaces and of others; interpolated
_MIN_JOINED_IF_SMOOTH = 0.9  # joined fraction below which no surface counts as smooth
_VOXELS_PER_SUPERVOXEL = 0.86  # over the squared spacing of seeds in voxel edges
# Larger voxels, by half powers of two. A voxel is joined if it has MIN_NEIGHBOURS_ON_SURFACE neighbours.
_MIN_JOINED = 0.75  # joined fraction below which voxels are enlarged, and at which that stops
_HALF_JOINED = 0.5
_MIN_GAIN = (
    0.1  # of the joined fraction by each step, if half were joined at first; of a sweep of few beams from half on
)
_MIN_GAIN_OF_SPARSE = 0.15  # the same if fewer were, in several scans
_MAX_ENLARGEMENTS = 10
_MIN_VOXELS = 500  # left
# Smaller voxels, by quarters of a power of two
_MAX_REFINEMENTS = 4
_FEW_VOXELS = 120_000  # above: only if _ALL_JOINED are joined, and at the higher price of roughness
_MAX_VOXELS = 300_000  # of a refined grid, about
_ALL_JOINED = 0.93  # joined fraction that has to remain
_KEPT_JOINED = 0.97  # fraction of the joined ones that has to remain, where fewer than _MIN_JOINED are
_PRICE_OF_ROUGHNESS = 0.25, 0.4  # times roughness is taken off the joined fraction: up to _FEW_VOXELS, and above
_FEW, _ENOUGH = 750, 40_000  # voxels between which the joined fraction that has to remain rises, by the logarithm,
_MIN_JOINED_OF_FEW = 0.5  # from this to _ALL_JOINED, or 1 in one scan
_SLAB = 1 << 14  # voxels in the middle of the grid's order on which refining is judged
# Grading: larger voxels in some blocks, by powers of two
_MAX_LEVEL = 3
_SPARSE = 0.2, 0.6  # joined fraction below which a block is sparse, in small grids and in large ones
_SMALL_GRID, _LARGE_GRID = 10_000, 20_000  # voxels
_MIN_VOXELS_AROUND = 20  # larger voxels in and around a block, to judge it
_MIN_GAIN_PER_LEVEL = 0.2  # of the joined fraction, if half were joined at first
_LINE_RATIO, _LINE_JOINED = 0.65, 0.4  # a block holds lines if doubled edges leave fewer voxels, and fewer are joined
_NEARLY_ALL_JOINED = 0.98  # no grading from here on,
_MIN_GRADED = 0.003  # nor if a smaller fraction of all voxels would be larger


def seed_spacing(grid: VoxelGrid, acquisition: Acquisition) -> float:
    """Five voxel edges; less, but three at least, where that leaves few supervoxels.

    On smooth surfaces that are seen from all around, as those of meshes and of thinned clouds, many are better: their
    normals are exact, and small things need supervoxels of their own.
    """
    usual, smaller = _edges_per_seed(grid, _MIN_SUPERVOXELS), _edges_per_seed(grid, _MIN_SUPERVOXELS_ON_SMOOTH)
    if smaller < usual and not acquisition.is_one_scan and _joined(np.diff(grid.indptr)) >= _MIN_JOINED_IF_SMOOTH:
        fraction = min(max((_ROUGH - roughness(grid)) / (_ROUGH - _SMOOTH), 0.0), 1.0)
        usual = _edges_per_seed(grid, _MIN_SUPERVOXELS * (_MIN_SUPERVOXELS_ON_SMOOTH / _MIN_SUPERVOXELS) ** fraction)
    return grid.size * usual


def _edges_per_seed(grid: VoxelGrid, many: float) -> float:
    """Voxel edges between seeds that give so many supervoxels, within what is sensible."""
    edges = seed_spacing_for(many, grid) / grid.size
    return min(max(edges, MIN_VOXELS_PER_SEED), VOXELS_PER_SEED)


def voxel_size_for(n_supervoxels: int, points: NDArray[np.float64], grid: VoxelGrid) -> float:
    """The voxel size, metres, or a smaller one, down to a half, at which so many supervoxels have some voxels each.

    As long as three quarters of the voxels stay joined, or half where fewer are from the start.
    """
    size, least = grid.size, _MIN_JOINED if _joined(np.diff(grid.indptr)) >= _MIN_JOINED else _HALF_JOINED
    finer = grid
    for step in range(1, _MAX_REFINEMENTS + 1):
        if seed_spacing_for(n_supervoxels, finer) >= MIN_VOXELS_PER_SEED * finer.size:
            break
        finer = voxel_grid(points, grid.size / 2.0 ** (step / 4.0), grid.warp)
        if _joined(np.diff(finer.indptr)) < least:
            break
        size = finer.size
    return size


def seed_spacing_for(n_supervoxels: float, grid: VoxelGrid) -> float:
    """Spacing, metres, of so many supervoxels, about, on the surface that the voxels of a grid cover."""
    return grid.size * math.sqrt(grid.n_voxels / (_VOXELS_PER_SUPERVOXEL * n_supervoxels))


def adapted_voxel_size(
    points: NDArray[np.float64], grid: VoxelGrid, acquisition: Acquisition, largest: float = math.inf
) -> tuple[float, float]:
    """The size of the voxels, or a larger one where surfaces fall apart, or a smaller one where they would stay whole.

    On a surface most voxels have at least five others around them. The second is the size that it would be were voxels
    not few. They are made smaller for that where points lie so evenly that no blocks need larger ones
    (`adapted_grading`), and not so evenly that all get smaller ones anyway.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Those in the grid.
    grid : VoxelGrid
        Its voxels are of one size.
    acquisition : Acquisition
    largest : float, metres
    """
    degrees = np.diff(grid.indptr)
    joined, of_few = _joined(degrees), _enough_of_few(grid, acquisition)
    is_fragmented = joined < min(_MIN_JOINED, of_few)
    larger = _enlarged_size(points, grid, degrees, largest, acquisition.is_one_scan) if is_fragmented else grid.size
    usual = _refined_size(points, grid, degrees, acquisition.is_one_scan) if larger == grid.size else larger
    if usual == grid.size and joined >= of_few and adapted_grading(grid, acquisition) is None:
        return _finest(points, grid, slice(0, grid.n_voxels), _MAX_REFINEMENTS, of_few, 1.0), usual
    return usual, usual


def _enough_of_few(grid: VoxelGrid, acquisition: Acquisition) -> float:
    """Fraction of the voxels, less their roughness, that have to be joined, as they are few; infinite if they are not.

    The fewer there are, the fewer each thing has, and the more it needs them smaller, were it so that hardly more than
    half of them are joined. An image has its pixels where it has them, and their spacing along rows may be another.
    """
    n = grid.n_voxels
    if n >= _ENOUGH or acquisition.has_pixels:
        return math.inf
    fraction = _log_interpolated(n, _FEW, _ENOUGH)
    return _MIN_JOINED_OF_FEW + fraction * ((1.0 if acquisition.is_one_scan else _ALL_JOINED) - _MIN_JOINED_OF_FEW)


def _joined(degrees: NDArray[np.int64]) -> float:
    """Fraction of the voxels that have as many others around them as on a surface."""
    return float(np.mean(degrees >= MIN_NEIGHBOURS_ON_SURFACE))


def _enlarged_size(
    points: NDArray[np.float64], grid: VoxelGrid, degrees: NDArray[np.int64], largest: float, of_one_scan: bool
) -> float:
    """The size, or one larger by half powers of two, enough to join what falls apart.

    What is no surface at any size, as a line, stays. So does the size where half of it is joined and larger voxels
    hardly join more, as they do not far rings of a sweep. Where less than half of one scan is joined at first, as of a
    sweep of few beams, half is enough, unless larger voxels join much more. So it is where less than half of several
    such scans is, unless each step to three quarters joins much more.
    """
    cells, size, joined, joined_at_first = [grid.cells, grid.cells], grid.size, 0.0, _joined(degrees)
    few_beams, best = of_one_scan and joined_at_first < _HALF_JOINED, grid.size
    least, much = (math.inf, _MIN_GAIN_OF_SPARSE) if joined_at_first < _HALF_JOINED else (grid.size, _MIN_GAIN)
    for step in range(1, _MAX_ENLARGEMENTS + 1):
        size *= math.sqrt(2.0)
        if size > largest:
            break
        # After two steps eight cells are one, so that only the first step needs the points.
        places, lattice = grid.warp.on_lattice(points, size) if step == 1 else (cells[0] / 2.0, UNIT_CELLS)
        larger, degrees = occupied_cells(places, size, lattice)
        if len(larger) < _MIN_VOXELS:
            break
        cells, before, joined = [cells[1], larger], joined, _joined(degrees)
        if few_beams and joined >= _HALF_JOINED:
            if before >= _HALF_JOINED and joined - before < _MIN_GAIN:
                break
            best = size
        least = min(least, size) if joined >= _HALF_JOINED else least
        if joined >= _MIN_JOINED:
            if not few_beams:
                best = size if joined - joined_at_first >= much * step else least
            break
    return best


def _refined_size(points: NDArray[np.float64], grid: VoxelGrid, degrees: NDArray[np.int64], of_one_scan: bool) -> float:
    """The size, or one smaller by quarters of a power of two, down to a half, where nearly all stay joined.

    So voxels follow how evenly points lie, not only how near to each other: those of a mesh's vertices can be smaller
    than those of points at random. Where not even three quarters are joined, as in a sweep thinned to a point per cube,
    nearly as many have to stay so. The rougher the surface, the more have to: noise needs larger voxels. All this is
    read off a slab in the middle, which may be the dense part of several scans: so all together have to be joined as
    well. Points of one scan lie less densely where surfaces slant, and its rows far apart, so its grid stays as it is.
    For the time's sake no grid gets very many voxels so, nor one of many that are not all joined.
    """
    n, size, joined = grid.n_voxels, grid.size, _joined(degrees)
    if of_one_scan or joined < _HALF_JOINED:
        return size
    steps = min(_MAX_REFINEMENTS, int(2.0 * math.log2(_MAX_VOXELS / n)))  # to as many voxels as a surface would have
    if steps < 1 or (n > _FEW_VOXELS and joined < _ALL_JOINED):
        return size
    slab = slice(max(0, (n - _SLAB) // 2), min(n, (n + _SLAB) // 2))
    of_slab = _joined(degrees[slab])
    least = _ALL_JOINED if of_slab >= _MIN_JOINED else _KEPT_JOINED * of_slab
    if joined < least:
        return size
    return _finest(points, grid, slab, steps, least, _PRICE_OF_ROUGHNESS[n > _FEW_VOXELS])


def _finest(points: NDArray[np.float64], grid: VoxelGrid, slab: slice, steps: int, least: float, price: float) -> float:
    """The size, or the smallest of some steps at which so many of the voxels in a slab, less a price, are joined."""
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
    """Blocks in which voxels are larger by powers of two, as points lie too far apart there; None if there are few.

    So it is far from the tripods of several scans, near one of which spacing was read. Whether surfaces fall apart is
    asked of each block and the 26 around it. Voxels of one scan grow with range already. Lines, as wires, fall apart at
    any size until they touch each other and are one: twice the edge leaves half of their voxels, and as few joined. Of
    a surface at least three quarters of the voxels are left as long as so few are joined.

    Parameters
    ----------
    grid : VoxelGrid
        Its voxels are of one size.
    acquisition : Acquisition
    """
    joined = grid.joined
    if acquisition.is_one_scan or np.mean(joined) >= _NEARLY_ALL_JOINED:
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
    for level in range(1, _MAX_LEVEL + 1):
        if not asked.any():
            break
        cells = np.floor(cells / 2.0)
        keys, pitch = cell_keys(cells, grid.size)
        ordered, order = sorted_keys(keys)
        first = starts_of_runs(ordered)[:-1]
        cells, of_block = cells[order[first]], of_block[order[first]]
        joined = touching_counts(ordered[first], *pitch) >= MIN_NEIGHBOURS_ON_SURFACE
        fraction, n = _joined_around(joined, of_block, around)
        asked &= (n > _LINE_RATIO * before) | (fraction >= _LINE_JOINED)
        before = n
        whole = asked & (fraction >= _MIN_JOINED) & (n >= _MIN_VOXELS_AROUND)
        whole &= (at_first < _HALF_JOINED) | (fraction - at_first >= _MIN_GAIN_PER_LEVEL * level)
        levels[whole] = level
        asked &= ~whole
    larger = levels > 0
    if np.mean(larger[block]) < _MIN_GRADED:
        return None
    return Grading(blocks[larger], levels[larger])


def _sparse_below(n_voxels: int) -> float:
    """Fraction of the voxels around that are joined below which larger ones are asked for.

    Of few voxels, each thing has few, and needs them more than its surface needs to be whole.
    """
    least, most = _SPARSE
    return least + _log_interpolated(n_voxels, _SMALL_GRID, _LARGE_GRID) * (most - least)


def _log_interpolated(n: int, few: int, many: int) -> float:
    """How far a number is from few to many, 0..1, by the logarithm."""
    return min(max(math.log(n / few) / math.log(many / few), 0.0), 1.0)


def _joined_around(
    joined: NDArray[np.bool_], block: NDArray[np.int64], around: VoxelLists
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fraction of the voxels in each block and those around it that are joined, and how many there are, (b,) each."""
    n_blocks = len(around.indptr) - 1
    of_block = np.repeat(np.arange(n_blocks), np.diff(around.indptr))
    sums = []
    for counted in (np.ones(len(joined)), joined):
        own = np.bincount(block, counted, n_blocks)
        sums.append((own + np.bincount(of_block, own[around.neighbours], n_blocks)).astype(np.float64))
    n, n_joined = sums
    return n_joined / np.maximum(n, 1.0), n
