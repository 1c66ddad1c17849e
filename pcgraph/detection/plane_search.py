# SPDX-License-Identifier: Apache-2.0
"""The search for planes over the graph: regions grow, what bends goes, what is coplanar joins."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from pcgraph.detection.bends import bends
from pcgraph.detection.coplanar import join_planes
from pcgraph.detection.flat_leaves import FlatLeaves
from pcgraph.detection.loose import absorb
from pcgraph.detection.regions import grow_planes, numbered

MOST_BEND = 0.05  # radians
LEAST_SUPERVOXELS = 8.0


def plane_regions(leaves: FlatLeaves, areas: NDArray[np.float64], least: float | None, join: bool) -> NDArray[np.int32]:
    """Plane of each of n supervoxels, (n,) int32, the one of largest area first; -1 for none.

    Parameters
    ----------
    leaves : FlatLeaves
    areas : (n,) float64, square metres
        Of each supervoxel.
    least : float, square metres, or None
        Area that a plane must have; None: 8 median supervoxels.
    join : bool
        Whether coplanar pieces that do not touch are one plane.
    """
    enough = LEAST_SUPERVOXELS * float(np.median(areas)) if least is None else least
    regions = _grown(leaves)
    regions = _only(bends(leaves, regions) <= MOST_BEND, regions)
    regions = join_planes(leaves, regions, apart=False)
    if join:
        regions = join_planes(leaves, regions, apart=True)
    regions = _only(region_areas(areas, regions) >= enough, regions)
    regions = absorb(leaves, regions, apart=join)
    return _by_size(areas, regions)


def _grown(leaves: FlatLeaves) -> NDArray[np.int32]:
    n, edges = len(leaves.normals), leaves.edges
    both = np.concatenate((edges, edges[:, ::-1]))
    lists = csr_array((np.tile(1 + leaves.flush, 2), both.T), shape=(n, n))  # 2 where flush: zeros would be dropped
    residual = np.sqrt(np.maximum(np.linalg.eigvalsh(leaves.moments.covariances)[:, 0], 0.0)) / leaves.tolerances
    # In steps, so that the rounding of sums cannot change who comes first.
    order = np.lexsort((np.arange(n), -leaves.moments.counts, np.rint(residual * 16.0)))
    seeds = order[(residual <= 1.0)[order] & ~leaves.shapeless[order]]
    return grow_planes(
        lists.indptr,
        lists.indices,
        lists.data == 2,
        seeds,
        leaves.moments.counts,
        leaves.moments.centroids,
        leaves.moments.scatters,
        leaves.normals,
        leaves.tolerances,
        leaves.shapeless,
        leaves.cos_angle,
    )


def leaf_areas(leaves: FlatLeaves) -> NDArray[np.float64]:
    """Area of each supervoxel, square metres: that of the rectangle with the same variances."""
    variances = np.maximum(np.linalg.eigvalsh(leaves.moments.covariances), 0.0)
    return 12.0 * np.sqrt(variances[:, 1] * variances[:, 2])


def region_areas(areas: NDArray[np.float64], regions: NDArray[np.int32]) -> NDArray[np.float64]:
    """Area of each of p regions, (p,), from those of their supervoxels."""
    member = regions >= 0
    return np.bincount(regions[member], areas[member], int(regions.max(initial=-1)) + 1).astype(np.float64)


def _only(good: NDArray[np.bool_], regions: NDArray[np.int32]) -> NDArray[np.int32]:
    """The good ones of the regions, numbered anew."""
    return numbered(np.where(np.append(good, False)[regions], regions, -1).astype(np.int32))


def _by_size(areas: NDArray[np.float64], regions: NDArray[np.int32]) -> NDArray[np.int32]:
    total = region_areas(areas, regions)
    rank = np.empty(len(total) + 1, np.int32)
    rank[np.argsort(-total, kind="stable")] = np.arange(len(total), dtype=np.int32)
    rank[-1] = -1
    return rank[regions]
