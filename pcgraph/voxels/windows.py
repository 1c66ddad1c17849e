# SPDX-License-Identifier: Apache-2.0
"""Windows of two rings of voxels, and the planes through them."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks
from pcgraph.voxels.eigen import plane_normal, symmetric_eigen
from pcgraph.voxels.grid import VoxelGrid


def fitted_windows(
    grid: VoxelGrid, towards: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The window around each voxel, and the plane through it.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    towards : (v, 3) float64, metres
        From each voxel to its outer side.

    Returns
    -------
    moments : (v, 10) float64
        Number of voxels (each counts as often as there are ways to it in two steps, the inner ones more), mean,
        and scatter (xx, yy, zz, xy, xz, yz) about the mean.
    normals : (v, 3) float64
        Unit directions of least spread, of either sign; across a line the one nearest to `towards`.
    residuals : (v,) float64, square metres
        Mean squared distance of the window's voxels to its plane.
    """
    n, lists = grid.n_voxels, (grid.indptr, grid.neighbours)
    ring, moments = np.empty((n, 10)), np.empty((n, 10))
    in_blocks(_first_ring, n, *lists, grid.centroids, ring)
    in_blocks(_second_ring, n, *lists, ring, moments)
    normals, residuals = np.empty((n, 3)), np.empty(n)
    in_blocks(_fit, n, moments, towards, normals, residuals)
    return moments, normals, residuals


@njit(cache=True, nogil=True)
def _first_ring(
    start: int,
    stop: int,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    centroids: NDArray[np.float64],
    ring: NDArray[np.float64],
) -> None:
    """Moments of each voxel with its neighbours: number, mean, scatter (xx, yy, zz, xy, xz, yz) about the mean."""
    for i in range(start, stop):
        sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
        for a in range(indptr[i], indptr[i + 1]):
            j = neighbours[a]
            x = centroids[j, 0] - centroids[i, 0]
            y = centroids[j, 1] - centroids[i, 1]
            z = centroids[j, 2] - centroids[i, 2]
            sx, sy, sz = sx + x, sy + y, sz + z
            xx, yy, zz, xy, xz, yz = xx + x * x, yy + y * y, zz + z * z, xy + x * y, xz + x * z, yz + y * z
        n = indptr[i + 1] - indptr[i] + 1.0
        _set_moments(ring, i, centroids[i, 0], centroids[i, 1], centroids[i, 2], n, sx, sy, sz, xx, yy, zz, xy, xz, yz)


@njit(cache=True, nogil=True)
def _second_ring(
    start: int,
    stop: int,
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    ring: NDArray[np.float64],
    moments: NDArray[np.float64],
) -> None:
    """Moments of two rings, as sums of first rings: a voxel counts as often as there are ways to it."""
    for i in range(start, stop):
        ox, oy, oz = ring[i, 1], ring[i, 2], ring[i, 3]
        n, sx, sy, sz = ring[i, 0], 0.0, 0.0, 0.0
        xx, yy, zz, xy, xz, yz = ring[i, 4], ring[i, 5], ring[i, 6], ring[i, 7], ring[i, 8], ring[i, 9]
        for a in range(indptr[i], indptr[i + 1]):
            j = neighbours[a]
            w, x, y, z = ring[j, 0], ring[j, 1] - ox, ring[j, 2] - oy, ring[j, 3] - oz
            wx, wy, wz = w * x, w * y, w * z
            n, sx, sy, sz = n + w, sx + wx, sy + wy, sz + wz
            xx, yy, zz = xx + ring[j, 4] + wx * x, yy + ring[j, 5] + wy * y, zz + ring[j, 6] + wz * z
            xy, xz, yz = xy + ring[j, 7] + wx * y, xz + ring[j, 8] + wx * z, yz + ring[j, 9] + wy * z
        _set_moments(moments, i, ox, oy, oz, n, sx, sy, sz, xx, yy, zz, xy, xz, yz)


@njit(cache=True, nogil=True, inline="always")
def _set_moments(to, i, ox, oy, oz, n, sx, sy, sz, xx, yy, zz, xy, xz, yz):  # type: ignore[no-untyped-def]
    """Sums about the place (ox, oy, oz) become number, mean, and scatter about the mean."""
    to[i, 0], to[i, 1], to[i, 2], to[i, 3] = n, ox + sx / n, oy + sy / n, oz + sz / n
    to[i, 4], to[i, 5], to[i, 6] = xx - sx * sx / n, yy - sy * sy / n, zz - sz * sz / n
    to[i, 7], to[i, 8], to[i, 9] = xy - sx * sy / n, xz - sx * sz / n, yz - sy * sz / n


@njit(cache=True, nogil=True)
def _fit(
    start: int,
    stop: int,
    moments: NDArray[np.float64],
    towards: NDArray[np.float64],
    normals: NDArray[np.float64],
    residuals: NDArray[np.float64],
) -> None:
    """Normal of each window, and the mean squared distance of its voxels to the plane."""
    matrix, vectors = np.empty((3, 3)), np.empty((3, 3))
    for i in range(start, stop):
        scatter = moments[i, 4:]
        least = plane_normal(scatter, normals[i])
        if least < 0.0:
            matrix[0, 0], matrix[1, 1], matrix[2, 2] = scatter[0], scatter[1], scatter[2]
            matrix[0, 1] = matrix[1, 0] = scatter[3]
            matrix[0, 2] = matrix[2, 0] = scatter[4]
            matrix[1, 2] = matrix[2, 1] = scatter[5]
            symmetric_eigen(matrix, vectors)
            least = max(min(matrix[0, 0], matrix[1, 1], matrix[2, 2]), 0.0)
            _degenerate_normal(matrix, vectors, towards[i], normals[i])
        residuals[i] = least / moments[i, 0]


@njit(cache=True, nogil=True)
def _degenerate_normal(
    diagonal: NDArray[np.float64],
    vectors: NDArray[np.float64],
    towards: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> None:
    """Direction of least spread; across a line, the one nearest to the viewpoint; of a point, to the viewpoint.

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
    along = reach = squares = 0.0
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
    largest = 0
    for axis in range(3):
        normal[axis] /= np.sqrt(squares)
        if abs(normal[axis]) > abs(normal[largest]):
            largest = axis
    if normal[largest] < 0.0:  # one of the two signs, for planes seen edge on
        for axis in range(3):
            normal[axis] = -normal[axis]
