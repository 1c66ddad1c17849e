# SPDX-License-Identifier: Apache-2.0
"""Rules that name the cause of every failed pixel, from its range image and the light that made it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture
from rangesim.causes.cause import Cause, CauseMap
from rangesim.causes.evidence import Evidence
from rangesim.decoding.range_image import RangeImage
from rangesim.evaluation.comparison import OUTLIER_M
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.response import CAUSTIC, DIRECT, GLINT, MULTIPATH, SPECULAR

if TYPE_CHECKING:
    from rangesim.signals import Signals

Rule = tuple[np.ndarray, Cause]

OTHER = range(MULTIPATH, GLINT + 1)
"""Kinds of light that carry no depth of the surface a pixel sees."""


def explain(
    image: RangeImage,
    capture: Capture,
    signals: Signals,
    tolerance_m: float = OUTLIER_M,
) -> CauseMap:
    """The cause of every failed pixel, from the energy split and the ground truth of its pass.

    A pixel fails if there is a surface behind it and no reading, or one off by more than `tolerance_m`. The cause
    is the first thing that goes wrong on the way of the light: at the surface, at the pixel, in the detector, in
    the decoder. To part optics from electronics, the same signals are decoded once more without noise and
    without ambient light.

    Parameters
    ----------
    image : RangeImage, decoded from `capture`.
    capture : Capture, as `rangesim.expose` made it from `signals`.
    signals : Signals of the pass; the sensor of the capture must have been part of it.
    tolerance_m : float, metres.

    Raises
    ------
    ValueError
        Image, capture and signals differ in size, the pass lacks the sensor's signals, or `tolerance_m` is not
        positive.
    """
    return causes_of(ReferenceReadings(image, capture, signals), tolerance_m)


def causes_of(readings: ReferenceReadings, tolerance_m: float) -> CauseMap:
    """The cause of every failed pixel of a range image, from its reference readings; errors as of `explain`."""
    image, capture, signals = readings.image, readings.capture, readings.signals
    shape = signals.truth.z.shape
    if image.z.shape != shape or capture.frames.shape[1:] != shape:
        raise ValueError(
            f"expected image and capture of shape {shape} as the signals, got {image.z.shape} and "
            f"{capture.frames.shape[1:]}."
        )
    if capture.rig is not None and not capture.rig.shares_camera_pose(signals.rig):
        raise ValueError("expected a capture that was exposed from these signals, got that of a camera elsewhere.")
    if not tolerance_m > 0:
        raise ValueError(f"expected a positive tolerance_m in metres, got {tolerance_m}.")
    evidence = Evidence(readings, tolerance_m)
    if not evidence.failed.any():
        return CauseMap(np.zeros(shape, dtype=np.uint8), tolerance_m)
    masks, causes = zip(*rules(evidence), strict=True)
    cause = np.select(masks, causes)
    return CauseMap(np.where(evidence.failed, cause, Cause.NONE).astype(np.uint8), tolerance_m)


def rules(e: Evidence) -> list[Rule]:
    """Causes in the order in which they are considered; for a failed pixel the first that holds is the cause.

    The order is that of the light, except that saturation comes first: it hides everything else. The last rule
    holds wherever it is asked, so no failed pixel is without a cause: with enough light, nothing that disturbs
    it, and a right reading without noise, it was the noise.
    """
    too_dark, disturbed = ~e.enough, e.optical & e.disturbed
    dim = e.is_a("glossy") & e.faint & ~e.enough_direct  # without the light that it reflects, it would be dark
    return [
        # ---- The detector, blinded
        (e.saturated & e.mostly_ambient & ~e.mostly(GLINT), Cause.AMBIENT),
        (e.saturated & e.piled_up & ~e.mostly(GLINT), Cause.PILE_UP),
        (e.saturated | e.mostly(GLINT), Cause.GLINT),
        # ---- Surfaces that pass the light on: whether they are lit does not matter. Direct light is their neighbour's
        (e.is_a("transparent", "mirror") & e.at_edge & e.enough & e.mostly(DIRECT), Cause.DEPTH_EDGE),
        (e.is_a("transparent") | (e.is_a("translucent") & too_dark), Cause.SEEN_THROUGH),
        (e.is_a("mirror") & (~e.missing | e.enough), Cause.MIRRORED_GHOST),
        (e.is_a("mirror"), Cause.SPECULAR_AWAY),
        # ---- No straight way for the light
        (e.unlit & e.enough & e.mostly(CAUSTIC), Cause.CAUSTIC),
        (e.unlit & e.enough & e.mostly(SPECULAR), Cause.MIRRORED_GHOST),
        (e.unlit, Cause.SHADOWED),
        # ---- Too little of it comes back
        (e.is_a("glossy") & e.faint & ~e.optical, Cause.SPECULAR_AWAY),
        (dim & (too_dark | e.missing), Cause.SPECULAR_AWAY),
        (dim, Cause.MIRRORED_GHOST),
        (too_dark & e.swamped, Cause.AMBIENT),
        (too_dark, Cause.LOW_SIGNAL),
        # ---- The distance itself
        (e.beyond_range, Cause.RANGE_AMBIGUITY),
        (e.optical & e.coarse, Cause.RESOLUTION),
        # ---- The pixel holds more than one distance
        (e.moving, Cause.MOTION),
        (e.at_edge & ~(disturbed & (e.fails_off_edge | e.merely_inclined)), Cause.DEPTH_EDGE),
        (e.in_shadow, Cause.SHADOWED),
        (e.optical & ~disturbed & e.beside_shadow, Cause.SHADOWED),
        (e.optical & e.blurred, Cause.RESOLUTION),
        (disturbed & e.mostly(CAUSTIC, OTHER), Cause.CAUSTIC),
        (disturbed & e.mostly(SPECULAR, OTHER), Cause.MIRRORED_GHOST),
        (disturbed & e.mostly(MULTIPATH, OTHER), Cause.MULTIPATH),
        (disturbed, Cause.GLINT),
        # ---- The decoder, and noise
        (e.wrong_period, Cause.RANGE_AMBIGUITY),
        (e.optical, Cause.RESOLUTION),
        (e.swamped, Cause.AMBIENT),
        (e.piled_up, Cause.PILE_UP),
        (np.ones_like(too_dark), Cause.LOW_SIGNAL),
    ]
