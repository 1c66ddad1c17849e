# SPDX-License-Identifier: Apache-2.0
"""Projector coordinates to depth: where a camera ray meets the projector's light plane or ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.rig import Intrinsics, Rig

ITERATIONS = 20
"""Most rounds to find the undecoded projector coordinate, which matters through the lens distortion only."""
CONVERGED_PX = 1e-4


@dataclass(frozen=True, eq=False)
class Triangulation:
    """z : (n,) float64, metres, camera frame; NaN if not in front of both devices.

    epipolar_px : (n,) float64, distance in projector pixels between the decoded and the reprojected
        coordinate; zero if only one axis was decoded.
    relative_error : (n,) float64, error of z as a share of z that one projector pixel of error means, |dz/dx_p| / z.
    """

    z: np.ndarray
    epipolar_px: np.ndarray
    relative_error: np.ndarray


def triangulate(directions: np.ndarray, rig: Rig, column: np.ndarray | None, row: np.ndarray | None) -> Triangulation:
    """Depth of camera rays from projector coordinates.

    With a = R^T d and b = -R^T t (camera ray d and camera centre in the projector frame), the point at depth
    z projects to x_p = (a_x + w b_x) / (a_z + w b_z) at inverse depth w = 1/z. Column x_p and row y_p each
    give an equation linear in w (ray meets plane); with both, w is their least-squares solution in projector
    pixels. The relative error is z / |dx_p/dw| with dx_p/dw = f (b_x - x_p b_z) / (a_z + w b_z), axes in
    quadrature (lens distortion left out).

    Parameters
    ----------
    directions : (n, 3) float64, camera rays with z = 1 (lens distortion already undone), camera frame.
    column, row : (n,) float, projector pixel coordinates, pixel centres at integer + 0.5; None where not
        coded.

    Raises
    ------
    ValueError
        Neither axis is given.
    """
    if column is None and row is None:
        raise ValueError("expected projector columns, rows or both, got neither.")
    rotation, t = rig.T_camera_projector[:3, :3], rig.T_camera_projector[:3, 3]
    a, b = rotation.T @ np.asarray(directions).T, -t @ rotation
    projector = rig.projector
    both = column is not None and row is not None
    u = np.full(len(directions), projector.cx) if column is None else np.asarray(column, dtype=np.float64)
    v = np.full(len(directions), projector.cy) if row is None else np.asarray(row, dtype=np.float64)
    rounds = 1 if both or not any(projector.distortion) else ITERATIONS
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(rounds):
            x, y = projector.normalise(np.stack([u, v], axis=-1)).T
            w, slope = _inverse_depth(a, b, None if column is None else x, None if row is None else y, projector)
            if rounds == 1:
                break
            u, v, change = _complete(_point(a, b, w), projector, u, v, column is None)
            if change < CONVERGED_PX:
                break
        point = _point(a, b, w)
        z = np.where((w > 0) & np.isfinite(w) & (point[2] > 0), 1 / w, np.nan)
        epipolar = np.zeros(len(z))
        if both:
            epipolar = np.hypot(projector.fx * (point[0] / point[2] - x), projector.fy * (point[1] / point[2] - y))
        relative_error = z * point[2] / slope
    return Triangulation(z, epipolar, relative_error)


def _point(a: np.ndarray, b: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(3, n) a + w b, times depth the points in the projector frame."""
    return a + w * b[:, None]


def _inverse_depth(
    a: np.ndarray, b: np.ndarray, x: np.ndarray | None, y: np.ndarray | None, projector: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) w of the linear equations w (b_x - x b_z) = x a_z - a_x, in projector pixels; norm of their slopes."""
    numerator, denominator = np.zeros(a.shape[1]), np.zeros(a.shape[1])
    for axis, coordinate, focal in ((0, x, projector.fx), (1, y, projector.fy)):
        if coordinate is not None:
            slope = b[axis] - coordinate * b[2]
            numerator += focal**2 * slope * (coordinate * a[2] - a[axis])
            denominator += focal**2 * slope**2
    return numerator / denominator, np.sqrt(denominator)


def _complete(
    point: np.ndarray, projector: Intrinsics, u: np.ndarray, v: np.ndarray, columns_missing: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """(u, v) with the undecoded one replaced by where `point` (3, n), projector frame, projects to; largest change."""
    old = u if columns_missing else v
    new = projector.project(point.T)[:, 0 if columns_missing else 1]
    new = np.where(np.isfinite(new), new, old)
    change = float(np.abs(new - old).max(initial=0))
    return (new, v, change) if columns_missing else (u, new, change)
