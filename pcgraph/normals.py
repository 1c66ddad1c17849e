# SPDX-License-Identifier: Apache-2.0
"""Surface normals of voxels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.eigen import symmetric_eigen
from pcgraph.voxels import VoxelGrid, sparse_means


def voxel_normals(
    grid: VoxelGrid, viewpoint: NDArray[np.float64], point_normals: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Unit normal per voxel.

    Parameters
    ----------
    grid : VoxelGrid
    viewpoint : (3,) float64, metres, the points' frame
        Estimated normals point to its side.
    point_normals : (n, 3) float64, unit length or zero, optional
        Given normals are averaged per voxel and keep their direction; voxels without one get an estimate.

    Returns
    -------
    (v, 3) float64
        Normal of the plane through the centroids of two rings of neighbours, the inner ones counting more. Voxels
        that lie on a line get the normal nearest to the viewpoint, lone ones the direction to the viewpoint.

    Notes
    -----
    Source: Papon et al. 2013, as PCL estimates them, but weighted by the number of ways in which a voxel is reached
    in two steps, which rounds off edges less.
    """
    towards = viewpoint - grid.centroids
    estimated = _estimate(grid.centroids, grid.indptr, grid.neighbours, towards)
    if point_normals is None:
        return estimated
    mean = sparse_means(point_normals, grid.voxel_of_point, grid.counts)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    given = length[:, 0] > 1e-6
    return np.where(given[:, None], mean / np.where(given[:, None], length, 1.0), estimated)


@njit(cache=True)
def _estimate(
    centroids: NDArray[np.float64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    towards: NDArray[np.float64],
) -> NDArray[np.float64]:
    normals = np.empty_like(centroids)
    scatter, vectors = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(centroids)):
        _two_ring_scatter(i, centroids, indptr, neighbours, scatter)
        symmetric_eigen(scatter, vectors)
        oriented_normal(scatter, vectors, towards[i], normals[i])
    return normals


@njit(cache=True)
def _two_ring_scatter(
    i: int,
    centroids: NDArray[np.float64],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    scatter: NDArray[np.float64],
) -> None:
    x0, y0, z0 = centroids[i, 0], centroids[i, 1], centroids[i, 2]
    n = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for a in range(indptr[i] - 1, indptr[i + 1]):
        j = i if a < indptr[i] else neighbours[a]
        for b in range(indptr[j] - 1, indptr[j + 1]):
            k = j if b < indptr[j] else neighbours[b]
            x, y, z = centroids[k, 0] - x0, centroids[k, 1] - y0, centroids[k, 2] - z0
            n += 1.0
            sx, sy, sz = sx + x, sy + y, sz + z
            xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
            yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
    scatter[0, 0] = xx - sx * sx / n
    scatter[1, 1] = yy - sy * sy / n
    scatter[2, 2] = zz - sz * sz / n
    scatter[0, 1] = scatter[1, 0] = xy - sx * sy / n
    scatter[0, 2] = scatter[2, 0] = xz - sx * sz / n
    scatter[1, 2] = scatter[2, 1] = yz - sy * sz / n


@njit(cache=True)
def oriented_normal(
    diagonal: NDArray[np.float64],
    vectors: NDArray[np.float64],
    towards: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> None:
    """Nothing; `normal` becomes the unit direction of least spread that faces the viewpoint.

    Parameters
    ----------
    diagonal : (3, 3) float64
        Eigenvalues of the scatter matrix on its diagonal.
    vectors : (3, 3) float64
        Its eigenvectors, as columns.
    towards : (3,) float64, metres
        From the place of the normal to the viewpoint.
    normal : (3,) float64
        Overwritten.
    """
    low, high = 0, 0
    for axis in range(1, 3):
        if diagonal[axis, axis] < diagonal[low, low]:
            low = axis
        if diagonal[axis, axis] >= diagonal[high, high]:
            high = axis
    middle = 3 - low - high if low != high else low
    top = diagonal[high, high]
    if low != high and diagonal[middle, middle] > 1e-9 * top:
        normal[:] = vectors[:, low]
    else:  # no plane: take the part of the viewing direction that is across the line, if there is a line
        normal[:] = towards
        if top > 0.0:
            normal -= vectors[:, high] * np.dot(vectors[:, high].copy(), towards)
    length = np.sqrt(np.dot(normal, normal))
    if length <= 1e-12 * np.sqrt(np.dot(towards, towards)) or length == 0.0:
        normal[:] = 0.0
        normal[2] = 1.0
        length = 1.0
    normal /= length
    facing = np.dot(normal, towards)
    largest = np.argmax(np.abs(normal))
    if facing < 0.0 or (facing == 0.0 and normal[largest] < 0.0):
        normal *= -1.0
