# SPDX-License-Identifier: Apache-2.0
"""What a sensor sees where: the nearest voxel in every direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.surface import Surface

_MOST_CELLS = 4e6
_MOST_CELLS_PER_VOXEL = 16  # to either side; only voxels that nearly touch the sensor are wider


@dataclass(frozen=True, eq=False)
class BearingImage:
    """A lattice of directions with the voxel seen in each.

    Attributes
    ----------
    voxels : (h, w) int32
        Voxel seen, -1 where none. Cells that touch are neighbouring directions.
    wraps : bool
        Whether what lies between the last column and the first is a gap like any other, as in a panorama.
    """

    voxels: NDArray[np.int32]
    wraps: bool = False


def bearing_image(surface: Surface, viewpoint: NDArray[np.float64]) -> BearingImage:
    """Spherical image around the viewpoint in which a voxel at median distance fills about one cell.

    Parameters
    ----------
    surface : Surface of v voxels
    viewpoint : (3,) float64, metres, the points' frame

    Notes
    -----
    The poles lie in the direction and counter-direction in which there is least to see, the seam behind the middle of
    the view, so that a camera's image has neither. Nearer voxels hide farther ones and fill as many cells as their
    width needs.
    """
    grid = surface.grid
    rays = grid.centroids - viewpoint
    ranges = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    seen = np.flatnonzero(ranges > 0.5 * grid.edge_lengths)  # the sensor's own voxel lies in no direction
    if not len(seen):
        return BearingImage(np.full((1, 1), -1, np.int32))
    bearings = rays[seen] / ranges[seen, None]
    width = grid.edge_lengths[seen] / ranges[seen]
    cell = max(float(np.median(width)), np.sqrt(4.0 * np.pi / _MOST_CELLS))
    frame = _frame(bearings)
    azimuth = np.arctan2(bearings @ frame[1], bearings @ frame[0])
    height = bearings @ frame[2]
    elevation = np.arcsin(np.clip(height, -1.0, 1.0))
    row = ((elevation - elevation.min()) / cell).astype(np.int64)
    column = ((azimuth - azimuth.min()) / cell).astype(np.int64)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    half = np.ceil(0.5 * width / cell - 0.5)
    stretched = np.ceil(0.5 * width / (cell * np.sqrt(np.maximum(1.0 - height * height, 1e-6))) - 0.5)
    halves = np.minimum(np.stack((half, stretched), axis=1), _MOST_CELLS_PER_VOXEL).astype(np.int64)
    voxels = _nearest(row, column, halves, seen.astype(np.int32), ranges, *shape)
    return BearingImage(voxels, bool(np.ptp(azimuth) > np.pi))


def _frame(bearings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Forward, sideways and polar direction, rows of (3, 3)."""
    pole = np.linalg.eigh(bearings.T @ bearings)[1][:, 0]
    mean = bearings.mean(axis=0)
    forward = mean - pole * (pole @ mean)
    if np.linalg.norm(forward) < 1e-6:  # as much on one side as on the other: any forward will do
        forward = np.cross(pole, np.eye(3)[np.abs(pole).argmin()])
    forward /= np.linalg.norm(forward)
    return np.stack((forward, np.cross(pole, forward), pole))


@njit(cache=True, nogil=True)
def _nearest(row, column, halves, voxel, ranges, height, width):  # type: ignore[no-untyped-def]
    """The nearest voxel of each cell, -1 where there is none."""
    image = np.full((height, width), -1, np.int32)
    for i in range(len(voxel)):
        for r in range(max(row[i] - halves[i, 0], 0), min(row[i] + halves[i, 0] + 1, height)):
            for c in range(max(column[i] - halves[i, 1], 0), min(column[i] + halves[i, 1] + 1, width)):
                if image[r, c] < 0 or ranges[voxel[i]] < ranges[image[r, c]]:
                    image[r, c] = voxel[i]
    return image
