# SPDX-License-Identifier: Apache-2.0
"""Labels for points that were not segmented: that of the surface they lie on."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from pcgraph.inputs import positive
from pcgraph.segmentation import Segmentation

CANDIDATES = 8
NEARBY = 1.0  # voxel edges beyond the nearest voxel within which another one may be the better


def labels_at(segmentation: Segmentation, points: ArrayLike, max_distance: float | None = None) -> NDArray[np.int32]:
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
        Anything known of supervoxels follows in one step: ``tree.cut(n=5)[labels]`` where `labels` is not -1.

    Raises
    ------
    ValueError
        A shape is not as above, or `max_distance` is not a positive number.

    Notes
    -----
    Of the voxels about as near as the nearest one (a voxel's edge further at most) the one is taken whose plane,
    through its centroid across its normal, passes nearest to the point: beside a crease that is the right side.
    """
    array = np.asarray(points)
    if array.ndim not in (2, 3) or array.shape[-1] != 3 or array.dtype.kind not in "fiu":
        raise ValueError(f"expected points as numbers of shape (m, 3) or (h, w, 3), got {array.shape} {array.dtype}")
    surface = segmentation.surface
    grid, flat = surface.grid, array.reshape(-1, 3).astype(np.float64)
    finite = np.isfinite(flat).all(axis=1)
    labels = np.full(len(flat), -1, np.int32)
    places = flat[finite]
    if not len(places):
        return labels.reshape(array.shape[:-1])
    n_near = min(CANDIDATES, grid.n_voxels)
    distance, voxel = cKDTree(grid.centroids).query(places, k=list(range(1, n_near + 1)))
    edge = grid.edge_lengths[voxel[:, 0]]
    limit = 2.0 * edge if max_distance is None else positive("max_distance", max_distance)
    offset = np.einsum("mka,mka->mk", places[:, None] - grid.centroids[voxel], surface.normals[voxel])
    # Among equally near planes the nearer voxel: on a flat surface all planes are the same.
    misfit = np.abs(offset) + 0.1 * distance
    misfit[distance > distance[:, :1] + NEARBY * edge[:, None]] = np.inf
    best = voxel[np.arange(len(places)), misfit.argmin(axis=1)]
    labels[finite] = np.where(distance[:, 0] <= limit, surface.supervoxels[best], -1)
    return labels.reshape(array.shape[:-1])
