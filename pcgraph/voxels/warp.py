# SPDX-License-Identifier: Apache-2.0
"""Warps between the points' space and the space in which voxels are cubes of one size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks


@dataclass(frozen=True)
class Warp:
    """The identity: voxels of one size everywhere."""

    def forward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Warped positions, (n, 3) float64, metres, of points (n, 3) in metres."""
        return points

    def backward(self, warped: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points, (n, 3) float64, metres, of warped positions."""
        return warped

    def scale(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Metres in space per metre of the warped space at each point, (n,) float64."""
        return np.ones(len(points))


@dataclass(frozen=True)
class CameraWarp(Warp):
    """Voxels that grow in proportion to depth, as a camera's pixels do on what it sees.

    With p = point - viewpoint and the reference depth z0, the warped position is z0 (x/z, y/z, ln(z/z0)).

    Attributes
    ----------
    viewpoint : (3,) float64, metres
        Centre of projection; the optical axis is the z axis.
    reference_depth : float, metres
        Depth at which the warp keeps lengths.

    Notes
    -----
    Source: the single-camera transform of PCL's VCCS (x/z, y/z, ln z), here with a scale that keeps metres.
    """

    viewpoint: NDArray[np.float64]
    reference_depth: float

    def forward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Warped positions, (n, 3) float64; points must lie in front of the viewpoint."""
        warped = np.empty((len(points), 3))
        in_blocks(_see, len(points), points, self.viewpoint, self.reference_depth, warped)
        return warped

    def backward(self, warped: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points, (n, 3) float64, metres, of warped positions."""
        depth = self.reference_depth * np.exp(warped[:, 2] / self.reference_depth)
        lateral = warped[:, :2] * (depth / self.reference_depth)[:, None]
        return np.column_stack((lateral, depth)) + self.viewpoint

    def scale(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth over reference depth, (n,) float64."""
        return (points[:, 2] - self.viewpoint[2]) / self.reference_depth


@njit(cache=True, nogil=True)
def _see(
    start: int,
    stop: int,
    points: NDArray[np.float64],
    viewpoint: NDArray[np.float64],
    reference_depth: float,
    warped: NDArray[np.float64],
) -> None:
    """Points as a camera sees them, in metres at the reference depth."""
    for p in range(start, stop):
        depth = points[p, 2] - viewpoint[2]
        scale = reference_depth / depth
        warped[p, 0] = (points[p, 0] - viewpoint[0]) * scale
        warped[p, 1] = (points[p, 1] - viewpoint[1]) * scale
        warped[p, 2] = -np.log(scale) * reference_depth


def choose_warp(points: NDArray[np.float64], viewpoint: NDArray[np.float64], camera: bool) -> Warp:
    """Camera warp about the median depth, or the identity.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1.
    viewpoint : (3,) float64, metres
    camera : bool
        Whether a camera at the viewpoint that looks along +z took the points.

    Raises
    ------
    ValueError
        `camera` is true and a point does not lie in front of it.
    """
    if not camera:
        return Warp()
    depth = points[:, 2] - viewpoint[2]
    if depth.min() <= 0.0:
        raise ValueError(
            f"camera=True expects all points in front of the viewpoint (z > {viewpoint[2]:g} m), "
            f"got z down to {points[:, 2].min():g} m; pass camera=False"
        )
    return CameraWarp(viewpoint, float(np.median(depth)))
