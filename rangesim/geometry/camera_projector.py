# SPDX-License-Identifier: Apache-2.0
"""Projector coordinates to depth: where a camera ray meets the projector's light plane, or comes nearest to its ray.

The ray of a camera pixel is known: the pixel is where its light was measured. What has an error is the projector
coordinate decoded there. So the optimal triangulation of camera and projector moves the projector coordinate alone,
to the nearest place on the ray's epipolar line; that of two cameras, which shares the correction between both views
(`two_view_triangulation`), would give the depth of a ray that was not measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.rig import Intrinsics, Rig

ITERATIONS = 20
"""Iterations, at most, that find the undecoded projector coordinate, which matters through the lens distortion only."""
CONVERGED_PX = 1e-4


@dataclass(frozen=True, eq=False)
class ProjectorTriangulation:
    """z : (n,) float64, metres, camera coordinates; NaN if not in front of both devices.

    epipolar_px : (n,) float64, distance in projector pixels between the decoded and the reprojected
        coordinate, to the epipolar line; zero if only one axis was decoded.
    relative_error : (n,) float64, error of z as a fraction of z that one projector pixel of error means, |dz/dx_p| / z.
    behind_px : (n,) float64, where the rays meet behind a device, about how many projector pixels the coordinate is
        from one that would make them parallel; 0 elsewhere.
    """

    z: np.ndarray
    epipolar_px: np.ndarray
    relative_error: np.ndarray
    behind_px: np.ndarray


def triangulate_coordinates(
    directions: np.ndarray, rig: Rig, column: np.ndarray | None, row: np.ndarray | None
) -> ProjectorTriangulation:
    """Depth of camera rays from projector coordinates.

    With a = R^T d and b = -R^T t (camera ray d and camera centre in projector coordinates), the point at depth
    z projects to x_p = (a_x + w b_x) / (a_z + w b_z) at inverse depth w = 1/z: the epipolar line through a and b.
    Column x_p and row y_p each give an equation linear in w (ray meets plane). With both, they are first moved to the
    nearest place on the line, in projector pixels, where the two equations agree: the maximum likelihood for errors
    of one size in column and row. The relative error is z / |dx_p/dw| with dx_p/dw = f (b_x - x_p b_z) / (a_z + w
    b_z), axes in quadrature (lens distortion left out).

    Parameters
    ----------
    directions : (n, 3) float64, camera rays with z = 1 (lens distortion already undone), camera coordinates.
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
            if both:
                x_on, y_on = _on_epipolar_line(a, b, x, y, projector)
            else:
                x_on, y_on = x, y
            w, slope = _inverse_depth(a, b, None if column is None else x_on, None if row is None else y_on, projector)
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
        behind = np.where(np.isfinite(w) & ((w < 0) | (point[2] < 0)), np.abs(w * slope / point[2]), 0)
    return ProjectorTriangulation(z, epipolar, relative_error, behind)


def _on_epipolar_line(
    a: np.ndarray, b: np.ndarray, x: np.ndarray, y: np.ndarray, projector: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) x and y moved to the nearest place, in projector pixels, on the lines a cross b of rays a (3, n)."""
    line_x, line_y = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
    rest = a[0] * b[1] - a[1] * b[0]
    off = line_x * x + line_y * y + rest
    slope_x, slope_y = line_x / projector.fx, line_y / projector.fy  # per pixel
    off = off / (slope_x**2 + slope_y**2)
    return x - off * slope_x / projector.fx, y - off * slope_y / projector.fy


def _point(a: np.ndarray, b: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(3, n) a + w b, times depth the points in projector coordinates."""
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
    """(u, v), the undecoded one from projecting `point` (3, n), projector coordinates; and its largest change."""
    old = u if columns_missing else v
    new = projector.project(point.T)[:, 0 if columns_missing else 1]
    new = np.where(np.isfinite(new), new, old)
    change = float(np.abs(new - old).max(initial=0))
    return (new, v, change) if columns_missing else (u, new, change)
