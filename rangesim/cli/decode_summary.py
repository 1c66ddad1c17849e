# SPDX-License-Identifier: Apache-2.0
"""The summary of `rangesim decode`: fractions of pixels by status, and the likely cause where few are measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.errors import one_line
from rangesim.report.palette import STATUS_NAMES
from rangesim.results.decoded_files import Decoded
from rangesim.rig import Rig
from rangesim.sensors import StructuredLight

MIN_MEASURED = 0.5
"""Fraction of measured pixels below which a cause is looked for."""
MIN_CONTRAST = 0.02
"""Fraction of full scale by which black is brighter than white where the two are exchanged."""
MIN_BRIGHTEST = 1 / 8
"""Fraction of full scale below which the brightest value of all frames is told, as the detector's
full scale may be less."""
MAX_BASELINE_M = 10.0
"""Baseline beyond which the calibration is probably in millimetres."""
MAX_ACROSS = 0.25
"""Ratio of the baseline across the stripes to that along them, below which an axis tells little depth."""


def status_fractions(image: RangeImage) -> dict[str, float]:
    """Fractions of the pixels, 0 to 1, by the name of their status; all statuses, also those of no pixel."""
    counts = np.bincount(image.status.ravel(), minlength=len(Status))
    return {STATUS_NAMES[status]: float(counts[status] / image.status.size) for status in Status}


def likely_cause(image: RangeImage, capture: Capture) -> str | None:
    """Why little was measured, or what is wrong with what was, in a clause; None if nothing points anywhere."""
    if capture.rig is not None and capture.rig.baseline_m > MAX_BASELINE_M:
        return (
            f"camera and emitter are {capture.rig.baseline_m:g} m apart: if the calibration is in millimetres, "
            "give --unit 0.001"
        )
    if isinstance(capture.sensor, StructuredLight) and _rows_come_first(image):
        return "columns change along the image's height and rows along its width: rows may have been shown first"
    if float((image.status == Status.OK).mean()) >= MIN_MEASURED:
        return None
    if isinstance(capture.sensor, StructuredLight):
        contrast = capture.frames[-2].astype(np.float32) - capture.frames[-1].astype(np.float32)
        clear = MIN_CONTRAST * capture.full_scale
        inverted = float((contrast < -clear).mean())
        if inverted > float((contrast > clear).mean()):
            return (
                f"black is brighter than white at {100 * inverted:.0f} % of the pixels: the last two images are white, "
                "then black"
            )
        if axis := _axis_along_baseline(image, capture.sensor, capture.rig):
            other = "rows" if axis == "columns" else "columns"
            return f"{axis} tell no depth here, for camera and projector stand apart along them: code {other}"
    if capture.is_digital and capture.detector is None:
        brightest = int(capture.frames.max())
        if brightest < MIN_BRIGHTEST * capture.full_scale:
            return (
                f"the brightest value is {brightest} of {capture.full_scale:.0f}: give --bits "
                f"{max(brightest.bit_length(), 1)} if the camera has no more, or expose longer"
            )
    if float((image.status == Status.CODE_ERROR).mean()) > float((image.status == Status.OK).mean()):
        return "codes miss their epipolar line or each other: check --calibration, --code-step and the patterns' order"
    return None


def _axis_along_baseline(image: RangeImage, sensor: StructuredLight, rig: Rig | None) -> str | None:
    """The only coded axis, if the baseline runs along its stripes and most decoded pixels are out of range for that."""
    if rig is None or len(sensor.axes) != 1:
        return None
    decoded = np.isin(image.status, [Status.OK, Status.OUT_OF_RANGE])
    if 2 * np.count_nonzero(image.status == Status.OUT_OF_RANGE) <= np.count_nonzero(decoded):
        return None
    x, y = np.abs(rig.T_camera_projector[:3, :3].T @ rig.T_camera_projector[:3, 3])[:2]
    axis = sensor.axes[0]
    across, along = (x, y) if axis == "columns" else (y, x)
    return axis if across < MAX_ACROSS * along else None


def _rows_come_first(image: RangeImage) -> bool:
    """Whether columns change down the image and rows across it, each twice as much as the other way."""
    if image.projector_column is None or image.projector_row is None:
        return False
    column, row = (_changes(c) for c in (image.projector_column, image.projector_row))
    return column[1] > 2 * column[0] and row[0] > 2 * row[1]


def _changes(coordinate: np.ndarray) -> tuple[float, float]:
    """Mean size of the change to the next pixel across and down; 0 where no neighbours were decoded."""
    steps = (np.abs(np.diff(coordinate, axis=axis)) for axis in (1, 0))
    known = (s[np.isfinite(s)] for s in steps)
    across, down = (float(k.mean()) if k.size else 0.0 for k in known)
    return across, down


def summary(decoded: Decoded, out: Path) -> str:
    """One line on the result: fractions of all statuses that pixels have, depths, and the likely cause."""
    image, fractions = decoded.image, dict(decoded.status)
    measured = fractions.pop(STATUS_NAMES[Status.OK])
    parts = [f"{100 * measured:.1f} % of the pixels {'decoded' if image.camera is None else 'measured'}"]
    if image.camera is not None and image.valid.any():
        z = image.z[image.valid]
        parts[0] += f", z from {z.min():.3f} to {z.max():.3f} m"
    if others := ", ".join(f"{100 * fraction:.1f} % {name}" for name, fraction in fractions.items() if fraction):
        parts.append(others)
    if image.camera is None:
        parts.append("without --calibration there is no depth")
    if decoded.likely_cause:
        parts.append(decoded.likely_cause)
    return f"{one_line(out)}: {'; '.join(parts)}."
