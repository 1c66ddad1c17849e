# SPDX-License-Identifier: Apache-2.0
"""Decoded projector coordinates to a range image, and which of its readings are within the working range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.contradictions import behind_contradiction
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.errors import warn
from rangesim.geometry.camera_projector import triangulate_coordinates
from rangesim.settings.bounds import Bounds, check_fields

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


def range_image_from_coordinates(
    capture: Capture,
    column: np.ndarray | None,
    row: np.ndarray | None,
    *,
    status: np.ndarray,
    confidence: np.ndarray,
    intensity: np.ndarray,
    limits: TriangulationLimits,
    code_is_doubted: bool = False,
) -> RangeImage:
    """Range image of decoded projector coordinates; see `RangeImage` for the arrays.

    Without a rig, z is NaN everywhere and `status` is that of the code. `RangesimWarning` if many rays meet behind a
    device.

    Parameters
    ----------
    column, row : (h, w) float32, projector pixels; None where not coded. They count where `status` is OK.
    code_is_doubted : whether a warning said so already, so that rays behind a device have their cause.
    """
    status, decoded = status.copy(), status == Status.OK
    column, row = (None if x is None else np.where(decoded, x, np.float32(np.nan)) for x in (column, row))
    z = np.full(status.shape, np.nan, dtype=np.float32)
    range_m = z.copy()
    if capture.rig is not None:
        behind_px = []
        for rows in bands(len(status)):
            y, x = np.nonzero(decoded[rows])
            directions = capture.rig.camera.directions(np.stack([x + 0.5, y + rows.start + 0.5], axis=-1))
            found = triangulate_coordinates(
                directions,
                capture.rig,
                None if column is None else column[rows][y, x],
                None if row is None else row[rows][y, x],
            )
            behind_px.append(found.behind_px.astype(np.float32))
            outcome = np.zeros(len(directions), dtype=np.uint8)
            usable = found.relative_error * COORDINATE_ERROR_PX <= limits.max_relative_error
            outcome[~(np.isfinite(found.z) & usable)] = Status.OUT_OF_RANGE
            outcome[found.epipolar_px > limits.epipolar_tolerance_px] = Status.CODE_ERROR
            depth = np.where(outcome == Status.OK, found.z, np.nan)
            status[rows][y, x], z[rows][y, x] = outcome, depth
            range_m[rows][y, x] = depth * np.linalg.norm(directions, axis=-1)
        contradiction = behind_contradiction(np.concatenate(behind_px))
        if contradiction and not code_is_doubted:
            warn(contradiction)
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
