# SPDX-License-Identifier: Apache-2.0
"""Structured-light captures to range images."""

from __future__ import annotations

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.bands import bands
from rangesim.decoding.gray import GrayCode, decode_gray, direct_contrast
from rangesim.decoding.phase_shift import refine_by_phase
from rangesim.decoding.triangulate import triangulate
from rangesim.range_image import RangeImage
from rangesim.rig import Rig
from rangesim.sensors import StructuredLight
from rangesim.status import Status

EPIPOLAR_TOLERANCE_PX = 5.0
"""Projector pixels by which column and row may disagree with each other."""
COORDINATE_ERROR_PX = 0.5
MAX_RELATIVE_ERROR = 0.05
"""Where an error of half a projector pixel means a larger share of the depth, the geometry measures no depth."""


def decode_structured_light(
    capture: Capture,
    epipolar_tolerance_px: float = EPIPOLAR_TOLERANCE_PX,
    max_relative_error: float = MAX_RELATIVE_ERROR,
) -> RangeImage:
    """Range image of a Gray code or Gray code + phase shift capture.

    Without a rig, only the projector coordinates are decoded: z is NaN everywhere, `status` is that of the
    code.

    Parameters
    ----------
    epipolar_tolerance_px : float, projector pixels; where both axes are coded, pixels whose column and row
        miss the epipolar line by more get `CODE_ERROR`.
    max_relative_error : float; the working range: pixels where half a projector pixel of error would shift the
        depth by a larger share get `OUT_OF_RANGE`. With parallel axes z may be at most 2 f b max_relative_error, f the
        projector's focal length in pixels, b the baseline; light planes along the baseline measure nothing.

    Raises
    ------
    ValueError
        The capture is of another sensor, or the rig's projector has another size than the patterns.
    """
    sensor = _sensor(capture)
    codes = {axis: _decode_axis(capture, sensor, axis) for axis in sensor.axes}
    status = _worst([code.status for code in codes.values()])
    decoded = status == Status.OK
    column, row = (_masked(codes.get(axis), decoded) for axis in ("columns", "rows"))
    z = np.full(status.shape, np.nan, dtype=np.float32)
    range_m = z.copy()
    if capture.rig is not None:
        for rows in bands(len(status)):
            y, x = np.nonzero(decoded[rows])
            z[rows][y, x], range_m[rows][y, x], status[rows][y, x] = _depth(
                np.stack([x + 0.5, y + rows.start + 0.5], axis=-1),
                capture.rig,
                None if column is None else column[rows][y, x],
                None if row is None else row[rows][y, x],
                epipolar_tolerance_px,
                max_relative_error,
            )
    contrast, _ = direct_contrast(capture)
    return RangeImage(
        z=z,
        range_m=range_m,
        confidence=np.clip(contrast / np.float32(capture.full_scale), 0, 1).astype(np.float32),
        status=status,
        intensity=capture.frames[-2].astype(np.float32) - np.float32(capture.black_level),
        camera=capture.rig.camera if capture.rig else None,
        T_world_camera=capture.rig.T_world_camera if capture.rig else None,
        projector_column=column,
        projector_row=row,
    )


def _sensor(capture: Capture) -> StructuredLight:
    sensor = capture.sensor
    if not isinstance(sensor, StructuredLight):
        raise ValueError(f"expected a structured-light capture, got {sensor.type_name}.")
    if capture.rig is not None:
        given = (capture.rig.projector.width, capture.rig.projector.height)
        if given != (sensor.projector_width, sensor.projector_height):
            raise ValueError(
                f"expected a projector of {sensor.projector_width} x {sensor.projector_height} pixels as the patterns, "
                f"but the rig's has {given[0]} x {given[1]}."
            )
    return sensor


def _decode_axis(capture: Capture, sensor: StructuredLight, axis: str) -> GrayCode:
    """Projector coordinate along one axis, from that axis' run of frames."""
    start = 0
    for earlier in sensor.axes[: sensor.axes.index(axis)]:  # type: ignore[arg-type]
        start += 2 * sensor.gray_response(earlier).channels + _steps(sensor)
    response = sensor.gray_response(axis)
    end = start + 2 * response.channels
    code = decode_gray(capture, capture.frames[start:end], response.shift, sensor.size(axis))
    if sensor.code == "gray-phase":
        code = refine_by_phase(capture, code, capture.frames[end : end + sensor.steps], sensor.period_px)
    outside = (code.coordinate < -0.5) | (code.coordinate > sensor.size(axis) + 0.5)
    code.status[outside & (code.status == Status.OK)] = Status.CODE_ERROR
    return code


def _steps(sensor: StructuredLight) -> int:
    return sensor.steps if sensor.code == "gray-phase" else 0


def _worst(statuses: list[np.ndarray]) -> np.ndarray:
    """The first status that is not OK, per pixel."""
    result = statuses[0].copy()
    for status in statuses[1:]:
        result = np.where(result == Status.OK, status, result)
    return result


def _masked(code: GrayCode | None, decoded: np.ndarray) -> np.ndarray | None:
    return None if code is None else np.where(decoded, code.coordinate, np.float32(np.nan))


def _depth(
    pixels: np.ndarray,
    rig: Rig,
    column: np.ndarray | None,
    row: np.ndarray | None,
    tolerance_px: float,
    max_relative_error: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z, range and status of decoded camera pixels (n, 2), (n,) each."""
    directions = rig.camera.directions(pixels)
    result = triangulate(directions, rig, column, row)
    status = np.zeros(len(directions), dtype=np.uint8)
    usable = result.relative_error * COORDINATE_ERROR_PX <= max_relative_error
    status[~(np.isfinite(result.z) & usable)] = Status.OUT_OF_RANGE
    status[result.epipolar_px > tolerance_px] = Status.CODE_ERROR
    z = np.where(status == Status.OK, result.z, np.nan)
    return z, z * np.linalg.norm(directions, axis=-1), status
