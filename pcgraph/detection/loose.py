# SPDX-License-Identifier: Apache-2.0
"""Giving loose supervoxels to the plane they lie in."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.detection.flat_leaves import FlatLeaves
from pcgraph.detection.regions import cosine, mean_square_distance, moments_of_regions, plane_normals


def absorb(leaves: FlatLeaves, regions: NDArray[np.int32], apart: bool) -> NDArray[np.int32]:
    """Regions, (n,) int32, after supervoxels of none went to the plane in which they lie best.

    Parameters
    ----------
    leaves, regions, apart : as for `join_planes`
        Without `apart` a supervoxel must touch its plane.
    """
    p = int(regions.max(initial=-1)) + 1
    loose = np.flatnonzero(regions < 0)
    if p == 0 or not len(loose):
        return regions
    if apart:
        choices, first, last = np.arange(p), np.zeros(len(loose), np.int64), np.full(len(loose), p)
    else:
        ends = np.concatenate((leaves.edges, leaves.edges[:, ::-1]))
        ends = ends[(regions[ends[:, 0]] < 0) & (regions[ends[:, 1]] >= 0)]
        order = np.lexsort((regions[ends[:, 1]], ends[:, 0]))
        choices, owner = regions[ends[order, 1]].astype(np.int64), ends[order, 0]
        first, last = np.searchsorted(owner, loose, "left"), np.searchsorted(owner, loose, "right")
    planes, moments = moments_of_regions(leaves.moments, regions, p), leaves.moments
    result = regions.copy()
    result[loose] = _best_planes(
        loose,
        first,
        last,
        choices,
        planes.centroids,
        plane_normals(planes),
        moments.counts,
        moments.centroids,
        moments.scatters,
        leaves.normals,
        leaves.tolerances,
        leaves.shapeless,
        leaves.cos_angle,
    )
    return result


@njit(cache=True, nogil=True)
def _best_planes(  # type: ignore[no-untyped-def]
    loose,
    first,
    last,
    choices,
    means,
    plane_normals,
    counts,
    centroids,
    scatters,
    normals,
    tolerances,
    shapeless,
    cos_angle,
):
    """Plane, of choices[first:last], in which each loose supervoxel lies best, (l,) int32; -1 if in none."""
    best = np.full(len(loose), -1, np.int32)
    for k in range(len(loose)):
        leaf, least = loose[k], tolerances[loose[k]] ** 2
        for c in range(first[k], last[k]):
            r = choices[c]
            if not shapeless[leaf] and cosine(normals[leaf], plane_normals[r]) < cos_angle:
                continue
            square = mean_square_distance(counts[leaf], centroids[leaf], scatters[leaf], means[r], plane_normals[r])
            if square < least or (square == least and best[k] < 0):
                best[k], least = r, square
    return best
