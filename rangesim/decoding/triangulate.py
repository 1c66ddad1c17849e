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
    a, b = directions @ rotation, -t @ rotation
    projector = rig.projector
    both = column is not None and row is not None
    u = np.full(len(a), projector.cx) if column is None else np.asarray(column, dtype=np.float64)
    v = np.full(len(a), projector.cy) if row is None else np.asarray(row, dtype=np.float64)
    rounds = 1 if both or not any(projector.distortion) else ITERATIONS
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(rounds):
            xy = projector.normalise(np.stack([u, v], axis=-1))
            w, slope = _inverse_depth(a, b, xy, projector, column is not None, row is not None)
            if rounds == 1:
                break
            u, v, change = _complete(a + w[:, None] * b, projector, u, v, column is None)
            if change < CONVERGED_PX:
                break
        point = a + w[:, None] * b
        z = np.where((w > 0) & np.isfinite(w) & (point[:, 2] > 0), 1 / w, np.nan)
        error = (point[:, :2] / point[:, 2:] - xy) * [projector.fx, projector.fy]
        epipolar = np.hypot(error[:, 0], error[:, 1]) if both else np.zeros(len(a))
        relative_error = z * point[:, 2] / slope
    return Triangulation(z, epipolar, relative_error)


def _inverse_depth(
    a: np.ndarray, b: np.ndarray, xy: np.ndarray, projector: Intrinsics, columns: bool, rows: bool
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) w of the linear equations w (b_x - x b_z) = x a_z - a_x, in projector pixels; norm of their slopes."""
    numerator, denominator = np.zeros(len(a)), np.zeros(len(a))
    for axis, used, focal in ((0, columns, projector.fx), (1, rows, projector.fy)):
        if used:
            slope = b[axis] - xy[:, axis] * b[2]
            numerator += focal**2 * slope * (xy[:, axis] * a[:, 2] - a[:, axis])
            denominator += focal**2 * slope**2
    return numerator / denominator, np.sqrt(denominator)


def _complete(
    point: np.ndarray, projector: Intrinsics, u: np.ndarray, v: np.ndarray, columns_missing: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """(u, v) with the undecoded one replaced by where `point` (n, 3), projector frame, projects to; largest change."""
    old = u if columns_missing else v
    new = projector.project(point)[:, 0 if columns_missing else 1]
    new = np.where(np.isfinite(new), new, old)
    change = float(np.abs(new - old).max(initial=0))
    return (new, v, change) if columns_missing else (u, new, change)
