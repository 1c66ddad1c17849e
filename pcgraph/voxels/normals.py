# SPDX-License-Identifier: Apache-2.0
"""Surface normals of voxels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.eigen import symmetric_eigen
from pcgraph.voxels.grid import VoxelGrid, sparse_means


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
        Normal of the plane through the centroids of two rings of neighbours, the inner ones counting more.
        Voxels that lie on a line get the normal nearest to the viewpoint, lone ones the direction to the
        viewpoint.

    Notes
    -----
    Source: Papon et al. 2013, as PCL estimates them, but weighted by the number of ways in which a voxel is
    reached in two steps, which rounds off edges less.
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
    """Normals by pooling moments twice: the second ring comes as sums of first rings, not voxel by voxel."""
    n = len(centroids)
    counts, means, scatters = np.ones(n), centroids.copy(), np.zeros((n, 6))
    wide_counts, wide_means, wide_scatters = np.empty(n), np.empty((n, 3)), np.empty((n, 6))
    _pool_rings(indptr, neighbours, counts, means, scatters, wide_counts, wide_means, wide_scatters)
    _pool_rings(indptr, neighbours, wide_counts, wide_means, wide_scatters, counts, means, scatters)
    normals = np.empty_like(centroids)
    scatter, vectors = np.empty((3, 3)), np.empty((3, 3))
    for i in range(n):
        scatter[0, 0], scatter[1, 1], scatter[2, 2] = scatters[i, 0], scatters[i, 1], scatters[i, 2]
        scatter[0, 1] = scatter[1, 0] = scatters[i, 3]
        scatter[0, 2] = scatter[2, 0] = scatters[i, 4]
        scatter[1, 2] = scatter[2, 1] = scatters[i, 5]
        symmetric_eigen(scatter, vectors)
        oriented_normal(scatter, vectors, towards[i], normals[i])
    return normals


@njit(cache=True)
def _pool_rings(indptr, neighbours, counts, means, scatters, to_counts, to_means, to_scatters):  # type: ignore[no-untyped-def]
    """Moments of each voxel with its neighbours; scatters (xx, yy, zz, xy, xz, yz) about the mean."""
    for i in range(len(counts)):
        n = sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
        for a in range(indptr[i] - 1, indptr[i + 1]):
            j = i if a < indptr[i] else neighbours[a]
            w = counts[j]
            x, y, z = means[j, 0] - means[i, 0], means[j, 1] - means[i, 1], means[j, 2] - means[i, 2]
            n, sx, sy, sz = n + w, sx + w * x, sy + w * y, sz + w * z
            xx, yy, zz = (
                xx + scatters[j, 0] + w * x * x,
                yy + scatters[j, 1] + w * y * y,
                zz + scatters[j, 2] + w * z * z,
            )
            xy, xz, yz = (
                xy + scatters[j, 3] + w * x * y,
                xz + scatters[j, 4] + w * x * z,
                yz + scatters[j, 5] + w * y * z,
            )
        to_counts[i] = n
        to_means[i, 0], to_means[i, 1], to_means[i, 2] = (
            means[i, 0] + sx / n,
            means[i, 1] + sy / n,
            means[i, 2] + sz / n,
        )
        to_scatters[i, 0], to_scatters[i, 1], to_scatters[i, 2] = (
            xx - sx * sx / n,
            yy - sy * sy / n,
            zz - sz * sz / n,
        )
        to_scatters[i, 3], to_scatters[i, 4], to_scatters[i, 5] = (
            xy - sx * sy / n,
            xz - sx * sz / n,
            yz - sy * sz / n,
        )


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
    along = reach = squares = facing = 0.0
    for axis in range(3):
        along += vectors[axis, high] * towards[axis]
        reach += towards[axis] ** 2
    flat = low != high and diagonal[middle, middle] > 1e-9 * top
    for axis in range(3):
        if flat:
            normal[axis] = vectors[axis, low]
        else:  # no plane: take the part of the viewing direction that is across the line, if there is a line
            normal[axis] = towards[axis] - (along * vectors[axis, high] if top > 0.0 else 0.0)
        squares += normal[axis] ** 2
    if squares <= 1e-24 * reach or squares == 0.0:  # the line goes through the viewpoint: any direction across it
        for axis in range(3):
            normal[axis] = vectors[axis, low]
        squares = 1.0
    for axis in range(3):
        normal[axis] /= np.sqrt(squares)
        facing += normal[axis] * towards[axis]
    largest = 0
    for axis in range(1, 3):
        if abs(normal[axis]) > abs(normal[largest]):
            largest = axis
    if facing < 0.0 or (facing == 0.0 and normal[largest] < 0.0):
        for axis in range(3):
            normal[axis] = -normal[axis]
