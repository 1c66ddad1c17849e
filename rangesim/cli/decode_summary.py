# SPDX-License-Identifier: Apache-2.0
"""Summary of `rangesim decode`: fractions of pixels by status, and the likely cause where few are measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.range_image import MIN_MEASURED, RangeImage
from rangesim.decoding.status import Status
from rangesim.errors import one_line
from rangesim.report.palette import STATUS_NAMES
from rangesim.results.decoded_captures import Decoded

MIN_BRIGHTEST = 1 / 8
"""Brightest value of all frames, as a fraction of full scale, below which the summary reports it, because the camera
may have at least three bits less than its files (12 bits in files of 16 bits give 1/16), or the exposure may be too
short. A larger fraction would blame exposures that are long enough."""

MAX_BASELINE_M = 10.0
"""Baseline in metres beyond which the calibration is probably in millimetres. A rig on a desk or a robot is smaller.
Few rigs have a baseline of less than 10 mm, and a file in millimetres would give 10 mm as 10 m."""


MIN_BASELINE_M = 1e-3
"""Least baseline in metres of devices that triangulate. A baseline in metres that is stated in millimetres is less."""


def status_fractions(image: RangeImage) -> dict[str, float]:
    """Fractions of the pixels, 0 to 1, by the name of their status, for all statuses."""
    counts = np.bincount(image.status.ravel(), minlength=len(Status))
    return {STATUS_NAMES[status]: float(counts[status] / image.status.size) for status in Status}


def likely_cause(image: RangeImage, capture: Capture) -> str | None:
    """A clause that says why little was measured, or what is wrong with the readings; None if nothing points to a
    cause.

    The decoder knows the causes that depend on the measuring principle, see `Decoder.likely_cause`.
    """
    if capture.rig is not None and capture.rig.baseline_m > MAX_BASELINE_M:
        return (
            f"camera and emitter are {capture.rig.baseline_m:g} m apart: if the calibration is in millimetres, "
            "give --unit 0.001"
        )
    if capture.rig is not None and capture.sensor.triangulates and capture.rig.baseline_m < MIN_BASELINE_M:
        return (
            f"camera and projector are {1000 * capture.rig.baseline_m:.2g} mm apart: if the calibration is in metres, "
            "give --unit 1"
        )
    decoder = image.decoder or capture.sensor.default_decoder
    if cause := decoder.likely_cause(capture, image):
        return cause
    if capture.is_digital and not capture.frames.any():
        return (
            f"the brightest value is 0 of {capture.full_scale:.0f}, so nothing was recorded: check that these are the "
            "frames (--images), and that the camera exposed them"
        )
    measured = float(image.valid.mean())
    clipped = float((image.status == Status.SATURATED).mean())
    too_bright = f"{100 * clipped:.0f} % of the pixels are as bright as the camera can tell: expose shorter"
    may_have_fewer_bits = capture.is_digital and capture.detector is None and capture.sensor.gate is None
    # Few cameras have 16 bits.
    if may_have_fewer_bits and (measured < MIN_MEASURED or capture.frames.dtype.itemsize > 1):
        brightest = int(capture.frames.max())
        if brightest < MIN_BRIGHTEST * capture.full_scale:
            return (
                f"the brightest value is {brightest} of {capture.full_scale:.0f}: give --bits {brightest.bit_length()} "
                f"if the camera has no more{f'; {too_bright}' if clipped > measured else ', or expose longer'}"
            )
    if measured >= MIN_MEASURED:
        return None
    if clipped > measured:
        return too_bright
    if capture.is_digital and float((image.status == Status.LOW_SIGNAL).mean()) > measured:
        swing = float(np.median(np.ptp(capture.frames, axis=0)))
        return (
            f"half of the pixels change by {swing:.0f} of {capture.full_scale:.0f} or less in all images: expose "
            "longer, keep other light away, and check that the patterns were shown"
        )
    if float((image.status == Status.CODE_ERROR).mean()) > measured:
        return "codes miss their epipolar line or each other: check --calibration, --code-step and the patterns' order"
    return None


def unchecked(image: RangeImage) -> str | None:
    """A clause that says what the data cannot tell of a calibration; None if both axes are coded or there is no code.

    Columns and rows together must meet the epipolar line. One axis alone gives a depth for every calibration.
    """
    one = [c is not None for c in (image.projector_column, image.projector_row)]
    if image.camera is None or sum(one) != 1:
        return None
    return f"{'columns' if one[0] else 'rows'} alone do not check the calibration: show both axes once to check it"


def summary(decoded: Decoded, out: Path, is_given: bool = False) -> str:
    """One line on the result: fractions of all statuses that pixels have, depths, notes, doubts, and the likely cause.

    is_given : whether the user gave a calibration for the capture, so that it may be one of another rig.
    """
    image, fractions = decoded.image, dict(decoded.status)
    measured = fractions.pop(STATUS_NAMES[Status.OK])
    parts = [f"{100 * measured:.1f} % of the pixels {'decoded' if image.camera is None else 'measured'}"]
    if image.camera is not None and image.valid.any():
        name, reading_m = "z" if image.camera.is_pinhole else "range", image.reading_m[image.valid]
        parts[0] += f", {name} from {reading_m.min():.3f} to {reading_m.max():.3f} m"
    if others := ", ".join(f"{100 * fraction:.1f} % {name}" for name, fraction in fractions.items() if fraction):
        parts.append(others)
    if image.valid.any() and (clause := (image.decoder or decoded.sensor.default_decoder).undetectable(decoded.sensor)):
        parts.append(clause)
    if image.camera is None:
        parts.append("without --calibration there is no depth")
    parts += [text.removesuffix(".") for text in (*image.notes, *image.doubts)]
    if decoded.likely_cause:
        parts.append(decoded.likely_cause)
    if is_given and (clause := unchecked(image)):
        parts.append(clause)
    return f"{one_line(out)}: {'; '.join(parts)}."
