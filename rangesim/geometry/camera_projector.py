# SPDX-License-Identifier: Apache-2.0
"""Depth from projector coordinates: the point where a camera ray meets a light plane or a ray of the projector.

The ray of a camera pixel is exact, because the pixel is the place where its light was measured. The projector
coordinate decoded there has an error. So the optimal triangulation of camera and projector moves only the projector
coordinate, to the nearest place on the epipolar line of the ray. The optimal triangulation of two cameras
(`two_view_triangulation`) moves the pixels in both views; here this would give the depth of another ray than that of
the pixel.

Used by: rangesim.decoding.triangulation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.rig import Intrinsics, Rig

MAX_ITERATIONS = 20
"""Largest number of iterations for the projector coordinate that was not decoded. It matters only through the lens
distortion, so that a few iterations usually suffice; the limit ends the iterations of pixels that never converge."""

CONVERGED_PX = 1e-4
"""Largest change of that coordinate, in projector pixels, at which the iterations end. A smaller change does not
matter, because the noise of a decoded coordinate is far larger."""


@dataclass(frozen=True, eq=False)
class ProjectorTriangulation:
    """Depths of camera rays from projector coordinates, with their sensitivity to errors.

    Attributes
    ----------
    z : (n,) float64, depth in camera coordinates, metres; NaN where the point is not in front of both devices.
    epipolar_px : (n,) float64, distance in projector pixels from the decoded coordinate to the epipolar line; 0 if only
        one axis was decoded.
    relative_error : (n,) float64, error of z, as a fraction of z, that an error of one projector pixel causes:
        |dz / dx_p| / z, in 1 / px.
    behind_px : (n,) float64. If the rays meet behind a device: roughly the distance, in projector pixels, from the
        coordinate to one that would make the rays parallel. Else 0.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import Intrinsics, Rig, translation
    >>> device = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> rig = Rig(device, device, np.eye(4), translation(0.2, 0, 0))  # the projector stands 0.2 m to the right
    >>> found = triangulate_coordinates(np.array([[0.0, 0.0, 1.0]]), rig, column=np.array([160.0]), row=None)
    >>> found.z, found.relative_error
    (array([1.]), array([0.00625]))
    """

    z: np.ndarray
    epipolar_px: np.ndarray
    relative_error: np.ndarray
    behind_px: np.ndarray


def triangulate_coordinates(
    directions: np.ndarray, rig: Rig, column: np.ndarray | None, row: np.ndarray | None
) -> ProjectorTriangulation:
    """Depth of camera rays from projector coordinates.

    Let a = R^T d be the camera ray d and b = -R^T t the camera centre, both in projector coordinates. The point at
    depth z has the inverse depth w = 1 / z and projects to x_p = (a_x + w b_x) / (a_z + w b_z): a point of the epipolar
    line through a and b. The column x_p and the row y_p each give one linear equation for w: the equation of a ray that
    meets a plane. If both are given, they are first moved to the nearest place on the epipolar line, in projector
    pixels, where the two equations agree. This is the maximum likelihood for errors of the same size in column and row.

    The relative error is z / |dx_p/dw| with dx_p/dw = f (b_x - x_p b_z) / (a_z + w b_z), both axes added in quadrature,
    without the lens distortion.

    Parameters
    ----------
    directions : (n, 3) float64, camera rays with z = 1 in camera coordinates, lens distortion already removed.
    rig : Rig, for the projector's intrinsics and `T_camera_projector`.
    column, row : (n,) float, projector pixel coordinates, pixel centres at integer + 0.5; None for an axis that was not
        coded.

    Raises
    ------
    ValueError
        Neither axis is given.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import Intrinsics, Rig, translation
    >>> device = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> rig = Rig(device, device, np.eye(4), translation(0.2, 0, 0))
    >>> rays = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
    >>> triangulate_coordinates(rays, rig, column=np.array([160.0, 320.0]), row=None).z
    array([1., 2.])
    """
    if column is None and row is None:
        raise ValueError("expected projector columns, rows or both, got neither.")
    rotation, t = rig.T_camera_projector[:3, :3], rig.T_camera_projector[:3, 3]
    a, b = rotation.T @ np.asarray(directions).T, -t @ rotation
    projector = rig.image_projector
    both = column is not None and row is not None
    u = np.full(len(directions), projector.cx) if column is None else np.asarray(column, dtype=np.float64)
    v = np.full(len(directions), projector.cy) if row is None else np.asarray(row, dtype=np.float64)
    rounds = 1 if both or not any(projector.distortion) else MAX_ITERATIONS
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
    """(n,) x and y, each moved to the nearest place on its epipolar line, nearest in projector pixels.

    x, y (n,) are normalised projector coordinates. The lines are a cross b, with rays a (3, n) and centre b (3,).
    """
    line_x, line_y = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
    rest = a[0] * b[1] - a[1] * b[0]
    off = line_x * x + line_y * y + rest
    slope_x, slope_y = line_x / projector.fx, line_y / projector.fy  # per pixel
    off = off / (slope_x**2 + slope_y**2)
    return x - off * slope_x / projector.fx, y - off * slope_y / projector.fy


def _point(a: np.ndarray, b: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(3, n) a + w b, which is w times the points in projector coordinates; w (n,) is their inverse depth."""
    return a + w * b[:, None]


def _inverse_depth(
    a: np.ndarray, b: np.ndarray, x: np.ndarray | None, y: np.ndarray | None, projector: Intrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) inverse depth w from the linear equations w (b_x - x b_z) = x a_z - a_x, and the norm (n,) of their slopes.

    The equations of both axes are weighted as errors in projector pixels. A coordinate x or y of None has no equation.
    """
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
    """Both projector pixel coordinates (u, v), and the largest change of the one that was not decoded, in pixels.

    The coordinate that was not decoded is found by projecting `point` (3, n), in projector coordinates.
    """
    old = u if columns_missing else v
    new = projector.project(point.T)[:, 0 if columns_missing else 1]
    new = np.where(np.isfinite(new), new, old)
    change = float(np.abs(new - old).max(initial=0))
    return (new, v, change) if columns_missing else (u, new, change)
