# SPDX-License-Identifier: Apache-2.0
"""Where supervoxels start."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from pcgraph.voxels.grid import VoxelGrid


def seed_voxels(grid: VoxelGrid, seed_size: float) -> NDArray[np.int32]:
    """Voxels from which supervoxels grow, ascending, at least one in every connected component of the grid.

    Parameters
    ----------
    grid : VoxelGrid
    seed_size : float, metres
        Their R_seed: edge length of the seed cells.

    Returns
    -------
    (k,) int32
        In each seed cell with enough voxels for a surface, the voxel nearest to the mean of the cell's
        voxels; in a component that has no such cell, the best of its fullest cell.

    Notes
    -----
    Source: Papon et al. 2013, section 3.2, whose filter against seeds in the void drops components
    altogether.
    """
    components = component_of_voxel(grid)
    cell_of_voxel = _seed_cells(np.floor(grid.warped / seed_size), components)
    cell_counts = np.bincount(cell_of_voxel)
    means = np.stack([np.bincount(cell_of_voxel, grid.warped[:, axis]) / cell_counts for axis in range(3)], axis=1)
    offset = grid.warped - means[cell_of_voxel]
    distance = np.einsum("ij,ij->i", offset, offset)
    order = np.lexsort((distance, cell_of_voxel))
    best_of_cell = order[np.cumsum(cell_counts) - cell_counts]
    component_of_cell = components[best_of_cell]
    ratio = seed_size / grid.size  # a cell counts if it holds a tenth of a plane, or half of a line
    enough = cell_counts >= min(0.1 * ratio**2, 0.5 * ratio)
    fullest = np.zeros(len(cell_counts), bool)
    by_fill = np.lexsort((-cell_counts, component_of_cell))
    starts = np.flatnonzero(np.diff(component_of_cell[by_fill], prepend=-1))
    fullest[by_fill[starts]] = True
    return np.sort(best_of_cell[enough | fullest]).astype(np.int32)


def component_of_voxel(grid: VoxelGrid) -> NDArray[np.int32]:
    """Connected component of each voxel under the 26-neighbourhood, (v,) int32, numbered by first voxel."""
    ones = np.ones(len(grid.neighbours), np.int8)
    matrix = csr_array((ones, grid.neighbours, grid.indptr), shape=(grid.n_voxels, grid.n_voxels))
    return connected_components(matrix, directed=False)[1]


def _seed_cells(cells: NDArray[np.float64], components: NDArray[np.int32]) -> NDArray[np.int64]:
    """Seed cell of each voxel, (v,); one that two components share counts as two, being two surfaces."""
    order = np.lexsort((cells[:, 2], cells[:, 1], cells[:, 0], components))
    ordered, owner = cells[order], components[order]
    new = (owner[1:] != owner[:-1]) | (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(cells), np.int64)
    number[order] = np.concatenate(([0], np.cumsum(new)))
    return number
