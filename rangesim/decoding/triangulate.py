# SPDX-License-Identifier: Apache-2.0
"""Projector coordinates to depth: where a camera ray meets the projector's light plane or ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.rig import Intrinsics, Rig
from rangesim.settings.bounds import Bounds, check_fields

ITERATIONS = 20
"""Iterations, at most, that find the undecoded projector coordinate, which matters through the lens distortion only."""
CONVERGED_PX = 1e-4
COORDINATE_ERROR_PX = 0.5
"""Projector pixels of error that the working range must allow for."""


@dataclass(frozen=True)
class TriangulationLimits:
    """What triangulation takes.

    epipolar_tolerance_px : projector pixels; where both axes are coded, pixels whose column and row miss the epipolar
        line by more get `CODE_ERROR`.
    max_relative_error : the working range: pixels where half a projector pixel of error would shift the depth by a
        larger fraction get `OUT_OF_RANGE`. With parallel axes z may be at most 2 f b max_relative_error, f the
        projector's focal length in pixels, b the baseline; light planes along the baseline measure nothing.
    """

    epipolar_tolerance_px: Annotated[float, Bounds("0 or positive", 0, 1e9)] = 5.0
    max_relative_error: Annotated[float, Bounds("0 or positive", 0, 1e9)] = 0.05

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False)
class Triangulation:
    """z : (n,) float64, metres, camera coordinates; NaN if not in front of both devices.

    epipolar_px : (n,) float64, distance in projector pixels between the decoded and the reprojected
        coordinate; zero if only one axis was decoded.
    relative_error : (n,) float64, error of z as a fraction of z that one projector pixel of error means, |dz/dx_p| / z.
    """

    z: np.ndarray
    epipolar_px: np.ndarray
    relative_error: np.ndarray


def triangulate(directions: np.ndarray, rig: Rig, column: np.ndarray | None, row: np.ndarray | None) -> Triangulation:
    """Depth of camera rays from projector coordinates.

    With a = R^T d and b = -R^T t (camera ray d and camera centre in projector coordinates), the point at depth
    z projects to x_p = (a_x + w b_x) / (a_z + w b_z) at inverse depth w = 1/z. Column x_p and row y_p each
    give an equation linear in w (ray meets plane); with both, w is their least-squares solution in projector
    pixels. The relative error is z / |dx_p/dw| with dx_p/dw = f (b_x - x_p b_z) / (a_z + w b_z), axes in
    quadrature (lens distortion left out).

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


def range_image_from_coordinates(
    capture: Capture,
    column: np.ndarray | None,
    row: np.ndarray | None,
    *,
    status: np.ndarray,
    confidence: np.ndarray,
    intensity: np.ndarray,
    limits: TriangulationLimits,
) -> RangeImage:
    """Range image of decoded projector coordinates; see `RangeImage` for the arrays.

    Without a rig, z is NaN everywhere and `status` is that of the code.

    Parameters
    ----------
    column, row : (h, w) float32, projector pixels; None where not coded. They count where `status` is OK.
    """
    status, decoded = status.copy(), status == Status.OK
    column, row = (None if x is None else np.where(decoded, x, np.float32(np.nan)) for x in (column, row))
    z = np.full(status.shape, np.nan, dtype=np.float32)
    range_m = z.copy()
    if capture.rig is not None:
        for rows in bands(len(status)):
            y, x = np.nonzero(decoded[rows])
            directions = capture.rig.camera.directions(np.stack([x + 0.5, y + rows.start + 0.5], axis=-1))
            found = triangulate(
                directions,
                capture.rig,
                None if column is None else column[rows][y, x],
                None if row is None else row[rows][y, x],
            )
            outcome = np.zeros(len(directions), dtype=np.uint8)
            usable = found.relative_error * COORDINATE_ERROR_PX <= limits.max_relative_error
            outcome[~(np.isfinite(found.z) & usable)] = Status.OUT_OF_RANGE
            outcome[found.epipolar_px > limits.epipolar_tolerance_px] = Status.CODE_ERROR
            depth = np.where(outcome == Status.OK, found.z, np.nan)
            status[rows][y, x], z[rows][y, x] = outcome, depth
            range_m[rows][y, x] = depth * np.linalg.norm(directions, axis=-1)
    return RangeImage(
        z=z,
        range_m=range_m,
        confidence=np.clip(confidence, 0, 1).astype(np.float32),
        status=status,
        intensity=intensity,
        camera=capture.rig.camera if capture.rig else None,
        T_world_camera=capture.rig.T_world_camera if capture.rig else None,
        projector_column=column,
        projector_row=row,
    )


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
