# SPDX-License-Identifier: Apache-2.0
"""The plane on which each voxel lies.

A window is a voxel with two rings of its neighbours. A plane is fitted to each window. Each voxel then takes the window
that fits best among those around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, inlined, kernel, routine
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.eigen import plane_normal, symmetric_eigen
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid

_OWN_BONUS = 0.7
"""Factor on the squared residual of a voxel's own window, so that it wins on plain ground; chosen by eye."""
_ROUGHNESS_SAMPLE = 4096
"""Voxels at which roughness is read; chosen by eye, for the time's sake."""
_STRETCHES = 16
"""Stretches of the grid's order that these voxels make, at most, so that they are evenly spread; chosen by eye."""


class Windows(NamedTuple):
    """The window around each voxel, and the plane through it.

    Attributes
    ----------
    moments : (v, 10) float64
        Number of voxels, mean, and scatter (xx, yy, zz, xy, xz, yz) about the mean. A voxel counts as often as there
        are ways to it in two steps, so the inner ones count more.
    normals : (v, 3) float64
        Unit directions of least spread, of either sign. Those of lines: the direction across that is nearest to
        `towards`.
    residuals : (v,) float64, square metres
        Mean squared distance of the window's voxels to its plane.
    """

    moments: NDArray[np.float64]
    normals: NDArray[np.float64]
    residuals: NDArray[np.float64]


def fitted_windows(grid: VoxelGrid, towards: NDArray[np.float64]) -> Windows:
    """The window around each voxel, and the plane through it.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    towards : (v, 3) float64, metres
        From each voxel to its outer side.
    """
    n = grid.n_voxels
    ring, windows = np.empty((n, 10)), Windows(np.empty((n, 10)), np.empty((n, 3)), np.empty(n))
    in_blocks(_first_ring, n, grid.neighbourhood, grid.centroids, ring)
    in_blocks(_second_ring, n, grid.neighbourhood, ring, windows.moments)
    in_blocks(_fit, n, towards, windows)
    return windows


def roughness(grid: VoxelGrid) -> float:
    """Roughness of the smooth surfaces of a grid, voxel edges: how noisy they are.

    The rms distance of a voxel and those that touch it to their plane is read at evenly spread voxels. Roughness is the
    lower quartile of that. Two rings of voxels would read the edges of small things as noise.
    """
    n = grid.n_voxels
    stretches = max(1, min(n // _ROUGHNESS_SAMPLE, _STRETCHES))
    rings = Windows(np.empty((n, 10)), np.empty((n, 3)), np.full(n, np.nan))
    towards = np.zeros((n, 3))
    towards[:, 2] = 1.0
    for stretch in range(stretches):
        start = n * stretch // stretches
        stop = min(start + _ROUGHNESS_SAMPLE // stretches, n)
        _first_ring(start, stop, grid.neighbourhood, grid.centroids, rings.moments)
        _fit(start, stop, towards, rings)
    return float(np.nanquantile(np.sqrt(rings.residuals) / grid.edge_lengths, 0.25))


@kernel
def _first_ring(
    start: int,
    stop: int,
    neighbourhood: Neighbourhood,
    centroids: NDArray[np.float64],
    ring: NDArray[np.float64],
) -> None:
    """Moments of each voxel with its neighbours: number, mean, scatter (xx, yy, zz, xy, xz, yz) about the mean."""
    indptr, neighbours = neighbourhood
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


@kernel
def _second_ring(
    start: int,
    stop: int,
    neighbourhood: Neighbourhood,
    ring: NDArray[np.float64],
    moments: NDArray[np.float64],
) -> None:
    """Moments of each voxel with two rings of neighbours, as sums of first rings."""
    indptr, neighbours = neighbourhood
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


@inlined
def _set_moments(to, i, ox, oy, oz, n, sx, sy, sz, xx, yy, zz, xy, xz, yz):  # type: ignore[no-untyped-def]
    """Write number, mean, and scatter about the mean, given sums about the place (ox, oy, oz)."""
    to[i, 0], to[i, 1], to[i, 2], to[i, 3] = n, ox + sx / n, oy + sy / n, oz + sz / n
    to[i, 4], to[i, 5], to[i, 6] = xx - sx * sx / n, yy - sy * sy / n, zz - sz * sz / n
    to[i, 7], to[i, 8], to[i, 9] = xy - sx * sy / n, xz - sx * sz / n, yz - sy * sz / n


@kernel
def _fit(start: int, stop: int, towards: NDArray[np.float64], windows: Windows) -> None:
    """Set the normal of each window, and the mean squared distance of its voxels to the plane."""
    moments, normals, residuals = windows
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


@routine
def _degenerate_normal(
    diagonal: NDArray[np.float64],
    vectors: NDArray[np.float64],
    towards: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> None:
    """Set the normal of voxels that may be on no plane: the direction of least spread if they are on one.

    On a line it is the direction across that is nearest to the viewpoint; of a single place, the direction to the
    viewpoint.

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


@dataclass(frozen=True, eq=False)
class LocalPlanes:
    """One plane per voxel.

    Attributes
    ----------
    normals : (v, 3) float64
        Unit normals on the viewpoint's side. A voxel on a line has the normal nearest to the direction to the
        viewpoint; a lone voxel has that direction.
    origins : (v, 3) float64, metres, the points' frame
        A point of each plane: the mean of its window.
    """

    normals: NDArray[np.float64]
    origins: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surface(ShortRepr):
    """Occupied voxels with their normals and supervoxels.

    Attributes
    ----------
    grid : VoxelGrid of v voxels
        Centroids, colours, counts, edge lengths, and which voxels touch.
    normals : (v, 3) float64
        Unit normals on the viewpoint's side.
    supervoxels : (v,) int32
        Supervoxel of each voxel.
    """

    grid: VoxelGrid
    normals: NDArray[np.float64]
    supervoxels: NDArray[np.int32]

    def mean_edge_lengths(self, n_supervoxels: int) -> NDArray[np.float64]:
        """Mean edge of each supervoxel's voxels, (n_supervoxels,) float64, metres."""
        sums = np.bincount(self.supervoxels, self.grid.edge_lengths, n_supervoxels)
        return sums / np.bincount(self.supervoxels, minlength=n_supervoxels)

    def mean_normals(self, n_supervoxels: int) -> NDArray[np.float64]:
        """Mean normal of each supervoxel's voxels, weighted by their points, (n_supervoxels, 3) float64."""
        weights = self.grid.counts.astype(np.float64)
        total = np.bincount(self.supervoxels, weights, n_supervoxels)
        sums = [np.bincount(self.supervoxels, weights * self.normals[:, axis], n_supervoxels) for axis in range(3)]
        return np.stack(sums, axis=1) / total[:, None]


def local_planes(grid: VoxelGrid, viewpoints: NDArray[np.float64], reach: int) -> LocalPlanes:
    """The best-fitting plane around each voxel that does not reach over an edge.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    viewpoints : (3,) or (v, 3) float64, metres, the points' frame
        Place from which each voxel was seen.
    reach : int, >= 0
        Voxels by which the window may lie off its voxel.

    Notes
    -----
    A window is a voxel with two rings of its neighbours. Beside an edge the window around a voxel straddles both faces,
    and its normal is a compromise. But some window further in lies on one face alone. So each voxel takes one of the
    windows within `reach`: that of the least mean squared distance of its own voxels to its plane plus the squared
    distance of this voxel to the plane. For its own window only 0.7 times the former counts. So it is preferred on
    plain and evenly curved ground, where all windows are equally good, and noise averages out. Source of the idea:
    Kuwahara et al. 1976, for images.
    """
    n, neighbourhood = grid.n_voxels, grid.neighbourhood
    towards = viewpoints - grid.centroids
    windows = fitted_windows(grid, towards)
    best, costs = np.arange(n, dtype=np.int32), _OWN_BONUS * windows.residuals
    for _ in range(reach):
        held, better = windows.residuals[best], np.empty_like(best)
        in_blocks(_take_best, n, neighbourhood, grid.centroids, windows, held, best, costs, better)
        best = better
    planes = LocalPlanes(np.empty((n, 3)), np.empty((n, 3)))
    in_blocks(_set_planes, n, best, windows, towards, planes.normals, planes.origins)
    return planes


@kernel
def _set_planes(
    start: int,
    stop: int,
    best: NDArray[np.int32],
    windows: Windows,
    towards: NDArray[np.float64],
    normals: NDArray[np.float64],
    origins: NDArray[np.float64],
) -> None:
    """Set the plane of each voxel to that of its window, with its normal on the side of the viewpoint."""
    for i in range(start, stop):
        w, facing = best[i], 0.0
        for axis in range(3):
            facing += windows.normals[w, axis] * towards[i, axis]
            origins[i, axis] = windows.moments[w, 1 + axis]
        for axis in range(3):
            normals[i, axis] = windows.normals[w, axis] * (-1.0 if facing < 0.0 else 1.0)


@kernel
def _take_best(
    start: int,
    stop: int,
    neighbourhood: Neighbourhood,
    centroids: NDArray[np.float64],
    windows: Windows,
    held: NDArray[np.float64],
    best: NDArray[np.int32],
    costs: NDArray[np.float64],
    better: NDArray[np.int32],
) -> None:
    """Set the best of the windows that a voxel and its neighbours hold so far, by what each costs this voxel.

    The cost of a window is never below its residual (`held`), so on plain ground no plane has to be looked at.
    """
    indptr, neighbours = neighbourhood
    moments, normals, _ = windows
    for i in range(start, stop):
        chosen, least = best[i], costs[i]
        for a in range(indptr[i], indptr[i + 1]):
            j = neighbours[a]
            if held[j] >= least:
                continue
            w = best[j]
            away = (
                normals[w, 0] * (centroids[i, 0] - moments[w, 1])
                + normals[w, 1] * (centroids[i, 1] - moments[w, 2])
                + normals[w, 2] * (centroids[i, 2] - moments[w, 3])
            )
            cost = held[j] + away * away
            if cost < least:
                chosen, least = w, cost
        better[i], costs[i] = chosen, least
