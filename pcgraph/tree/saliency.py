# SPDX-License-Identifier: Apache-2.0
"""Saliency: the altitude up to which a boundary lasts as segments merge (ultrametric contour map)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.hierarchy import AncestorIndex, ancestor_index, lowest_common_ancestor
from pcgraph.parallel import kernel
from pcgraph.tree.tree import SegmentationTree
from pcgraph.voxels.grid import Neighbourhood
from pcgraph.voxels.surface import Surface


def voxel_saliency(tree: SegmentationTree, surface: Surface) -> NDArray[np.float64]:
    """Boundary strength of each voxel, (v,) float64, the altitudes' unit.

    It is the largest altitude at which the voxel's supervoxel merges with another one that the voxel touches
    (26-neighbourhood), and 0 inside supervoxels. Voxels above a level are the boundaries of the cut at that altitude,
    two voxels wide.

    Parameters
    ----------
    tree : SegmentationTree
        Its leaves are the surface's supervoxels.
    surface : Surface of v voxels

    Raises
    ------
    ValueError
        The surface has a supervoxel that is no leaf of the tree.

    Notes
    -----
    Source: Arbelaez et al. 2011, ultrametric contour maps.
    """
    last, grid = int(surface.supervoxels.max(initial=0)), surface.grid
    if last >= tree.n_leaves:
        raise ValueError(f"expected a surface of the tree's {tree.n_leaves} leaves, got one with supervoxel {last}")
    index = ancestor_index(tree.parents)
    return _strongest_contacts(index, tree.altitudes, grid.neighbourhood, surface.supervoxels)


def point_saliency(tree: SegmentationTree, surface: Surface) -> NDArray[np.float64]:
    """Boundary strength of each finite point, (n,) float64, the altitudes' unit: that of its voxel.

    Raises as `voxel_saliency`.
    """
    return voxel_saliency(tree, surface)[surface.grid.voxel_of_point]


@kernel
def _strongest_contacts(
    index: AncestorIndex,
    altitudes: NDArray[np.float64],
    around: Neighbourhood,
    supervoxels: NDArray[np.int32],
) -> NDArray[np.float64]:
    indptr, neighbours = around
    strength = np.zeros(len(supervoxels))
    for voxel in range(len(supervoxels)):
        own = supervoxels[voxel]
        seen = own  # neighbours come in runs of one supervoxel
        for a in range(indptr[voxel], indptr[voxel + 1]):
            other = supervoxels[neighbours[a]]
            if other in (own, seen):
                continue
            seen = other
            level = altitudes[lowest_common_ancestor(index, own, other)]
            strength[voxel] = max(strength[voxel], level)
    return strength
