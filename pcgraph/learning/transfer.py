# SPDX-License-Identifier: Apache-2.0
"""Supervoxels of points that were not segmented: those of the surface they lie on."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from pcgraph.inputs import positive
from pcgraph.segmentation import Segmentation
from pcgraph.voxels.surface import Surface

CANDIDATES = 8
NEARBY = 1.0  # voxel edges beyond the nearest voxel within which another one may be the better
BLOCK = 1 << 16  # points at a time


def supervoxels_at(
    segmentation: Segmentation, points: ArrayLike, max_distance: float | None = None
) -> NDArray[np.int32]:
    """Supervoxel of each of m new points, (m,) or their leading shape, int32; -1 if far from all, or not finite.

    Parameters
    ----------
    segmentation : Segmentation
    points : (m, 3) or (h, w, 3) float, metres, the segmented points' frame
    max_distance : float, metres, optional
        How far the centroid of the nearest voxel may be. Default: twice that voxel's edge.

    Returns
    -------
    int32
        Anything known of supervoxels follows in one step: ``tree.cut(n=5)[leaf]`` where `leaf` is not -1.

    Raises
    ------
    ValueError
        A shape is not as above, or `max_distance` is not a positive number.

    Notes
    -----
    Of the voxels about as near as the nearest one (a voxel's edge further at most) the one is taken whose plane,
    through its centroid across its normal, passes nearest to the point: beside a crease that is the right side.
    It is not the rule by which `pcgraph.segment` gave points to supervoxels: of the segmented points 85 (simulated
    rooms) to 91 % (real tables) get their own again, most others one beside it: for 99.5 % and more the object is
    the same.
    """
    array = np.asarray(points)
    if array.ndim not in (2, 3) or array.shape[-1] != 3 or array.dtype.kind not in "fiu":
        raise ValueError(f"expected points as numbers of shape (m, 3) or (h, w, 3), got {array.shape} {array.dtype}")
    limit = None if max_distance is None else positive("max_distance", max_distance)
    flat = array.reshape(-1, 3)
    leaf = np.full(len(flat), -1, np.int32)
    finite = np.flatnonzero(np.isfinite(flat).all(axis=1))
    tree = cKDTree(segmentation.surface.grid.centroids)
    for start in range(0, len(finite), BLOCK):
        some = finite[start : start + BLOCK]
        leaf[some] = _nearest(segmentation.surface, tree, flat[some].astype(np.float64), limit)
    return leaf.reshape(array.shape[:-1])


def _nearest(surface: Surface, tree: cKDTree, places: NDArray[np.float64], limit: float | None) -> NDArray[np.int32]:
    """Supervoxel of each of m finite places, (m,) int32; -1 if far from all."""
    grid = surface.grid
    distance, voxel = tree.query(places, k=list(range(1, min(CANDIDATES, grid.n_voxels) + 1)))
    edge = grid.edge_lengths[voxel[:, 0]]
    offset = np.einsum("mka,mka->mk", places[:, None] - grid.centroids[voxel], surface.normals[voxel])
    # Among equally near planes the nearer voxel: on a flat surface all planes are the same.
    misfit = np.abs(offset) + 0.1 * distance
    misfit[distance > distance[:, :1] + NEARBY * edge[:, None]] = np.inf
    best = voxel[np.arange(len(places)), misfit.argmin(axis=1)]
    return np.where(distance[:, 0] <= (2.0 * edge if limit is None else limit), surface.supervoxels[best], -1)
