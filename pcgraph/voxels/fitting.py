# SPDX-License-Identifier: Apache-2.0
"""How large voxels and supervoxels are, so that surfaces stay whole and show their detail."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pcgraph.voxels.cells import UNIT_CELLS, cell_keys, sorted_keys, starts_of_runs
from pcgraph.voxels.grading import BLOCK, Grading
from pcgraph.voxels.grid import (
    AROUND_ON_SURFACE,
    VoxelGrid,
    VoxelLists,
    occupied_cells,
    touching_counts,
    touching_voxels,
    voxel_grid,
)
from pcgraph.voxels.spacing_law import SpacingLaw
from pcgraph.voxels.surface import roughness

VOXELS_PER_SEED = 5.0  # voxel edges between seeds, at most,
_MIN_VOXELS_PER_SEED = 3.0  # and at least
_MANY_SUPERVOXELS = 800
_MANY_ON_SMOOTH = 6000  # where surfaces are
_SMOOTH, _ROUGH = 0.14, 0.2  # smooth, in voxel edges of roughness at most; at least as rough have no more,
_WELL_JOINED = 0.9  # and so many of the voxels are joined
_VOXELS_OF_SUPERVOXEL = 0.86  # times the square of the edges between seeds
_MIN_JOINED = 0.75  # of the voxels have
_HALF_JOINED, _MIN_GAIN = 0.5, 0.1  # of them, by each step, where half of them have,
_MUCH_GAIN = 0.15  # or where fewer have, of several scans; else half is enough
_ENLARGEMENTS = 10
# Voxels can be smaller by steps of a quarter of a power of two
_REFINEMENTS = 4  # at most,
_FEW_VOXELS, _MANY_VOXELS = 120_000, 300_000  # and at most to about the latter, for the time's sake,
_ALL_JOINED = 0.93  # and of them,
_STILL_JOINED = 0.97  # or of those that are, where not even _MIN_JOINED are,
_JOINED_OF_SCAN = 0.98  # or, of one scan's, of fewer than _ALL_JOINED,
_THINNED = 0.7  # whose spacing grows by a smaller power of range, near or far,
_PRICE_OF_ROUGHNESS = 0.25, 0.4  # less so much of their roughness, where voxels were few or not, stay joined,
_FEWEST, _ENOUGH, _OF_FEWEST = 750, 40_000, 0.5  # or, of the latter down to so few, fewer, to this, less all of it,
_SLAB = 1 << 14  # as so many in the middle tell
_MIN_VOXELS = 500
# Voxels can be larger in some blocks
_LEVELS = 3  # by so many powers of two at most,
_APART = 0.2, 0.6  # where fewer of them are joined, of at most
_FEW_GRADED, _MANY_GRADED = 10_000, 20_000  # voxels, or at least,
_LEAST, _MORE = 20, 0.2  # and of so many larger ones at least _MIN_JOINED, and so many more by each power of two,
_FEWER, _OF_SURFACE = 0.65, 0.4  # unless larger voxels are so many times fewer and fewer of them joined: lines
_NEARLY_ALL, _HARDLY_ANY = 0.98, 0.003  # if fewer of all are joined, and more of all lie there


def seed_spacing(grid: VoxelGrid) -> float:
    """Five voxel edges; less, but three at least, where that leaves few supervoxels.

    On smooth surfaces that are seen from all around, as those of meshes and of thinned clouds, many are better: their
    normals are exact, and small things need supervoxels of their own.
    """
    usual, smaller = _edges_per_seed(grid, _MANY_SUPERVOXELS), _edges_per_seed(grid, _MANY_ON_SMOOTH)
    if smaller < usual and not grid.warp.of_one_scan and _joined(np.diff(grid.indptr)) >= _WELL_JOINED:
        share = min(max((_ROUGH - roughness(grid)) / (_ROUGH - _SMOOTH), 0.0), 1.0)
        usual = _edges_per_seed(grid, _MANY_SUPERVOXELS * (_MANY_ON_SMOOTH / _MANY_SUPERVOXELS) ** share)
    return grid.size * usual


def _edges_per_seed(grid: VoxelGrid, many: float) -> float:
    """Voxel edges between seeds that give so many supervoxels, within what is sensible."""
    edges = math.sqrt(grid.n_voxels / (_VOXELS_OF_SUPERVOXEL * many))
    return min(max(edges, _MIN_VOXELS_PER_SEED), VOXELS_PER_SEED)


def fitting_size(
    points: NDArray[np.float64], grid: VoxelGrid, law: SpacingLaw | None, largest: float = math.inf
) -> tuple[float, float]:
    """The size of the voxels, or a larger one where surfaces fall apart, or a smaller one where they would stay whole.

    On a surface most voxels have at least five others around them. The second is the size that it would be were voxels
    not few. They are made smaller for that where points lie so evenly that no blocks need larger ones
    (`fitting_grading`), and not so evenly that all get smaller ones anyway.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Those in the grid.
    grid : VoxelGrid
        Its voxels are of one size.
    law : SpacingLaw, optional
        How spacing depends on range, where that was asked.
    largest : float, metres
    """
    degrees = np.diff(grid.indptr)
    joined, of_few = _joined(degrees), _enough_of_few(grid, law)
    is_dust = joined < min(_MIN_JOINED, of_few)
    larger = _without_dust(points, grid, degrees, largest) if is_dust else grid.size
    usual = _with_detail(points, grid, law, degrees) if larger == grid.size else larger
    if usual == grid.size and joined >= of_few and fitting_grading(grid) is None:
        return _finest(points, grid, slice(0, grid.n_voxels), _REFINEMENTS, of_few, 1.0), usual
    return usual, usual


def _enough_of_few(grid: VoxelGrid, law: SpacingLaw | None) -> float:
    """Fraction of the voxels, less their roughness, that have to be joined, as they are few; infinite if they are not.

    The fewer there are, the fewer each thing has, and the more it needs them smaller, were it so that hardly more than
    half of them are joined. An image has its pixels where it has them, and their spacing along rows may be another.
    """
    n, of_one_scan = grid.n_voxels, grid.warp.of_one_scan
    if n >= _ENOUGH or (of_one_scan and law is None):
        return math.inf
    share = _share_by_logarithm(n, _FEWEST, _ENOUGH)
    return _OF_FEWEST + share * ((1.0 if of_one_scan else _ALL_JOINED) - _OF_FEWEST)


def _joined(degrees: NDArray[np.int64]) -> float:
    """Fraction of the voxels that have as many others around them as on a surface."""
    return float(np.mean(degrees >= AROUND_ON_SURFACE))


def _without_dust(points: NDArray[np.float64], grid: VoxelGrid, degrees: NDArray[np.int64], largest: float) -> float:
    """The size, or one larger by half powers of two, enough to join what falls apart.

    What is no surface at any size, as a line, stays. So does the size where half of it is joined and larger voxels
    hardly join more, as they do not far rings of a sweep. Where less than half of one scan is joined at first, as of a
    sweep of few beams, half is enough, unless larger voxels join much more. So it is where less than half of several
    such scans is, unless each step to three quarters joins much more.
    """
    cells, size, joined, joined_at_first = [grid.cells, grid.cells], grid.size, 0.0, _joined(degrees)
    few_beams, best = grid.warp.of_one_scan and joined_at_first < _HALF_JOINED, grid.size
    least, much = (math.inf, _MUCH_GAIN) if joined_at_first < _HALF_JOINED else (grid.size, _MIN_GAIN)
    for step in range(1, _ENLARGEMENTS + 1):
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


def _with_detail(
    points: NDArray[np.float64], grid: VoxelGrid, law: SpacingLaw | None, degrees: NDArray[np.int64]
) -> float:
    """The size, or one smaller by quarters of a power of two, down to a half, where nearly all stay joined.

    So voxels follow how evenly points lie, not only how near to each other: those of a mesh's vertices can be smaller
    than those of points at random. Where not even three quarters are joined, as in a sweep thinned to a point per cube,
    nearly as many have to stay so. The rougher the surface, the more have to: noise needs larger voxels. All this is
    read off a slab in the middle, which may be the dense part of several scans: so all together have to be joined as
    well. Points of one scan lie less densely where surfaces slant, and its rows far apart, so its grid stays as it is;
    unless it was thinned, too, so that its spacing hardly grows with range nearby, and nearly as many stay joined. For
    the time's sake no grid gets very many voxels so, nor one of many that are not all joined.
    """
    n, size, of_one_scan = grid.n_voxels, grid.size, grid.warp.of_one_scan
    if of_one_scan and (law is None or law.in_halves >= _THINNED):
        return size
    joined = _joined(degrees)
    if not _HALF_JOINED <= joined < (_ALL_JOINED if of_one_scan else math.inf):
        return size
    steps = min(_REFINEMENTS, int(2.0 * math.log2(_MANY_VOXELS / n)))  # to as many voxels as a surface would have
    if steps < 1 or (n > _FEW_VOXELS and joined < _ALL_JOINED):
        return size
    slab = slice(max(0, (n - _SLAB) // 2), min(n, (n + _SLAB) // 2))
    of_slab = _joined(degrees[slab])
    least = _ALL_JOINED if of_slab >= _MIN_JOINED else _STILL_JOINED * of_slab
    least = _JOINED_OF_SCAN * of_slab if of_one_scan else least
    if joined < least and not of_one_scan:
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


def fitting_grading(grid: VoxelGrid) -> Grading | None:
    """Blocks in which voxels are larger by powers of two, as points lie too far apart there; None if there are few.

    So it is far from the tripods of several scans, near one of which spacing was read. Whether surfaces fall apart is
    asked of each block and the 26 around it. Voxels of one scan grow with range already. Lines, as wires, fall apart at
    any size until they touch each other and are one: twice the edge leaves half of their voxels, and as few joined. Of
    a surface at least three quarters of the voxels are left as long as so few are joined.

    Parameters
    ----------
    grid : VoxelGrid
        Its voxels are of one size.
    """
    joined = grid.joined
    if grid.warp.of_one_scan or np.mean(joined) >= _NEARLY_ALL:
        return None
    keys, pitch = cell_keys(grid.cells / BLOCK, grid.size)
    ordered, order = sorted_keys(keys)
    starts = starts_of_runs(ordered)
    block = np.empty(grid.n_voxels, np.int64)
    block[order] = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    around, blocks = touching_voxels(ordered[starts[:-1]], *pitch), np.floor(grid.cells[order[starts[:-1]]] / BLOCK)
    at_first, before = _joined_around(joined, block, around)
    levels, asked = np.zeros(len(at_first), np.int8), at_first < _apart(grid.n_voxels)
    cells, of_block = grid.cells, block
    for level in range(1, _LEVELS + 1):
        if not asked.any():
            break
        cells = np.floor(cells / 2.0)
        keys, pitch = cell_keys(cells, grid.size)
        ordered, order = sorted_keys(keys)
        first = starts_of_runs(ordered)[:-1]
        cells, of_block = cells[order[first]], of_block[order[first]]
        joined = touching_counts(ordered[first], *pitch) >= AROUND_ON_SURFACE
        share, n = _joined_around(joined, of_block, around)
        asked &= (n > _FEWER * before) | (share >= _OF_SURFACE)
        before = n
        whole = asked & (share >= _MIN_JOINED) & (n >= _LEAST)
        whole &= (at_first < _HALF_JOINED) | (share - at_first >= _MORE * level)
        levels[whole] = level
        asked &= ~whole
    larger = levels > 0
    if np.mean(larger[block]) < _HARDLY_ANY:
        return None
    return Grading(blocks[larger], levels[larger])


def _apart(n_voxels: int) -> float:
    """Fraction of the voxels around that are joined below which larger ones are asked for.

    Of few voxels, each thing has few, and needs them more than its surface needs to be whole.
    """
    least, most = _APART
    return least + _share_by_logarithm(n_voxels, _FEW_GRADED, _MANY_GRADED) * (most - least)


def _share_by_logarithm(n: int, few: int, many: int) -> float:
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
