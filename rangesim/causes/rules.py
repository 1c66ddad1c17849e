# SPDX-License-Identifier: Apache-2.0
"""Rules that name the cause of each failed pixel of a range image, from the light that it was exposed to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Captured
from rangesim.causes.cause import Cause, CauseMap
from rangesim.causes.evidence import Evidence
from rangesim.decoding.range_image import RangeImage
from rangesim.evaluation.comparison import TOLERANCE_M
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.response import CAUSTIC, DIRECT, GLINT, MULTIPATH, SPECULAR

if TYPE_CHECKING:
    from rangesim.signals import Signals

Rule = tuple[np.ndarray, Cause]
"""A mask (h, w) bool, and the cause of failed pixels where it holds."""

OTHER = range(MULTIPATH, GLINT + 1)
"""Kinds of light, as indices into `rangesim.response.KINDS`, that carry no depth of the surface a pixel sees."""


def explain(
    image: RangeImage,
    capture: Captured,
    signals: Signals,
    tolerance_m: float = TOLERANCE_M,
) -> CauseMap:
    """The cause of each failed pixel of a range image.

    A pixel fails if there is a surface behind it and it has no reading, or one with an error above `tolerance_m`. The
    cause is the first thing that goes wrong on the way of the light: at the surface, at the pixel, in the detector, in
    the decoder. The function finds it from the energy split and the ground truth of the signals. To tell optics from
    electronics, it decodes the signals again without noise and without ambient light. See docs/causes.md.

    Parameters
    ----------
    image : RangeImage, decoded from `capture`.
    capture : Capture or CaptureSet, as `rangesim.expose` made it from `signals`.
    signals : Signals of a transport pass that the sensor of the capture was part of.
    tolerance_m : float, metres, error above which a reading failed.

    Raises
    ------
    ValueError
        Image, capture and signals differ in size or are of different cameras, the pass lacks the sensor's signals, or
        `tolerance_m` is not positive.

    Examples
    --------
    With `signals` of `rangesim.transport` that hold this sensor, here of a wall at 1 m, in too little light:

    >>> from rangesim import Detector, decode, expose, explain
    >>> capture = expose(signals, sensor, Detector(), exposure_s=1e-9)
    >>> causes = explain(decode(capture), capture, signals)
    >>> bool(causes.failed.all())
    True
    >>> causes.fractions(signals.truth)[-1]
    {'kind': 'all', 'name': 'all', 'right': 0.0, 'causes': {'low_signal': 1.0}}
    """
    return causes_of(ReferenceReadings(image, capture, signals), tolerance_m)


def causes_of(readings: ReferenceReadings, tolerance_m: float) -> CauseMap:
    """The cause of each failed pixel, from the reference readings of a range image; raises the errors of `explain`."""
    image, capture, signals = readings.image, readings.capture.reference, readings.signals
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
    """Causes in the order in which they are tried; the first one that holds is the cause of a failed pixel.

    The order follows the light from the emitter to the decoder. Saturation comes first, because it hides everything
    else. The last rule always holds, so that every failed pixel has a cause: if there is enough light, nothing disturbs
    it, and the reading without noise is correct, the noise is to blame.
    """
    too_dark, disturbed = ~e.enough, e.optical & e.disturbed
    dim = e.is_a("glossy") & e.faint & ~e.enough_direct  # its direct light alone would be too dark
    return [
        # ---- The detector is saturated
        (e.saturated & e.mostly_ambient & ~e.mostly(GLINT), Cause.AMBIENT),
        (e.saturated & e.piled_up & ~e.mostly(GLINT), Cause.PILE_UP),
        (e.saturated | e.mostly(GLINT), Cause.GLINT),
        # ---- The device refuses what is nearer or farther than it promises to read
        (e.out_of_range, Cause.OUT_OF_RANGE),
        # ---- Surfaces that reflect or transmit the light: it does not matter whether they are lit. Direct light in
        # such a pixel comes from a neighbouring surface
        (e.is_a("transparent", "mirror") & e.at_edge & e.enough & e.mostly(DIRECT), Cause.DEPTH_EDGE),
        (e.is_a("transparent") | (e.is_a("translucent") & too_dark), Cause.SEEN_THROUGH),
        (e.is_a("mirror") & (~e.missing | e.enough), Cause.MIRRORED_GHOST),
        (e.is_a("mirror"), Cause.SPECULAR_AWAY),
        # ---- There is no straight path from the emitter
        (e.unlit & e.enough & e.mostly(CAUSTIC), Cause.CAUSTIC),
        (e.unlit & e.enough & e.mostly(SPECULAR), Cause.MIRRORED_GHOST),
        (e.unlit, Cause.SHADOWED),
        # ---- A camera of a pair does not see the point
        (e.hidden, Cause.OCCLUDED),
        # ---- Too little of the emitter's light comes back
        (e.is_a("glossy") & e.faint & ~e.optical, Cause.SPECULAR_AWAY),
        (dim & (too_dark | e.missing), Cause.SPECULAR_AWAY),
        (dim, Cause.MIRRORED_GHOST),
        (too_dark & e.swamped, Cause.AMBIENT),
        (too_dark, Cause.LOW_SIGNAL),
        # ---- The distance itself
        (e.beyond_range, Cause.RANGE_AMBIGUITY),
        (e.off_glass, Cause.COVER_GLASS),
        (e.veiled, Cause.STRAY_LIGHT),
        (e.optical & e.textureless, Cause.NO_TEXTURE),
        (e.optical & e.coarse, Cause.RESOLUTION),
        # ---- The pixel covers more than one distance
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
