# SPDX-License-Identifier: Apache-2.0
"""Rules that name the cause of each failed pixel of a range image, from the light that it was exposed to."""

from __future__ import annotations

from collections.abc import Iterator
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
    evidence, cause = Evidence(readings, tolerance_m), np.full(shape, Cause.NONE, dtype=np.uint8)
    left = evidence.failed.copy()
    if left.any():
        for holds, found in rules(evidence, left):
            cause[left & holds] = found
            left &= ~holds
            if not left.any():
                break
    return CauseMap(cause, tolerance_m)


def rules(e: Evidence, left: np.ndarray) -> Iterator[Rule]:
    """Causes in the order in which they are tried; the first one that holds is the cause of a failed pixel.

    The order follows the light from the emitter to the decoder. Saturation comes first, because it hides everything
    else. The last rule always holds, so that every failed pixel has a cause: if there is enough light, nothing disturbs
    it, and the reading without noise is correct, the noise is to blame.

    Parameters
    ----------
    left : (h, w) bool, failed pixels without a cause so far, which the caller updates. Evidence that takes time is
        looked for in these alone.
    """
    too_dark, disturbed = ~e.enough, e.optical & e.disturbed
    dim = e.is_a("glossy") & e.faint & ~e.enough_direct  # its direct light alone would be too dark
    # ---- The detector is saturated
    yield e.saturated & e.mostly_ambient & ~e.mostly(GLINT), Cause.AMBIENT
    yield e.saturated & e.piled_up & ~e.mostly(GLINT), Cause.PILE_UP
    yield e.saturated | e.mostly(GLINT), Cause.GLINT
    # ---- The device refuses what is nearer or farther than it promises to read
    yield e.out_of_range, Cause.OUT_OF_RANGE
    # ---- Surfaces that reflect or transmit the light: it does not matter whether they are lit. Direct light in
    # such a pixel comes from a neighbouring surface
    yield e.is_a("transparent", "mirror") & e.at_edge & e.enough & e.mostly(DIRECT), Cause.DEPTH_EDGE
    yield e.is_a("transparent") | (e.is_a("translucent") & too_dark), Cause.SEEN_THROUGH
    yield e.is_a("mirror") & (~e.missing | e.enough), Cause.MIRRORED_GHOST
    yield e.is_a("mirror"), Cause.SPECULAR_AWAY
    # ---- There is no straight path from the emitter
    yield e.unlit & e.enough & e.mostly(CAUSTIC), Cause.CAUSTIC
    yield e.unlit & e.enough & e.mostly(SPECULAR), Cause.MIRRORED_GHOST
    yield e.unlit, Cause.SHADOWED
    # ---- A camera of a pair does not see the point
    yield e.hidden, Cause.OCCLUDED
    # ---- Too little of the emitter's light comes back
    yield e.is_a("glossy") & e.faint & ~e.optical, Cause.SPECULAR_AWAY
    yield dim & (too_dark | e.missing), Cause.SPECULAR_AWAY
    yield dim, Cause.MIRRORED_GHOST
    yield too_dark & e.swamped, Cause.AMBIENT
    yield too_dark, Cause.LOW_SIGNAL
    # ---- The distance itself
    yield e.beyond_range, Cause.RANGE_AMBIGUITY
    yield e.off_glass, Cause.COVER_GLASS
    yield e.veiled, Cause.STRAY_LIGHT
    yield e.optical & e.textureless, Cause.NO_TEXTURE
    yield e.coarse(left & e.optical), Cause.RESOLUTION
    # ---- The pixel covers more than one distance
    yield e.moving, Cause.MOTION
    blurred, disturbed_edge = e.blurred(left & e.optical), left & e.at_edge & disturbed
    merely_inclined = e.inclined(disturbed_edge & e.may_blur) & ~blurred
    yield e.at_edge & ~(e.fails_off_edge(disturbed_edge) | merely_inclined), Cause.DEPTH_EDGE
    yield e.in_shadow, Cause.SHADOWED
    yield e.optical & ~disturbed & e.beside_shadow, Cause.SHADOWED
    yield blurred, Cause.RESOLUTION
    yield disturbed & e.mostly(CAUSTIC, OTHER), Cause.CAUSTIC
    yield disturbed & e.mostly(SPECULAR, OTHER), Cause.MIRRORED_GHOST
    yield disturbed & e.mostly(MULTIPATH, OTHER), Cause.MULTIPATH
    yield disturbed, Cause.GLINT
    # ---- The decoder, and noise
    yield e.wrong_period, Cause.RANGE_AMBIGUITY
    yield e.optical, Cause.RESOLUTION
    yield e.swamped, Cause.AMBIENT
    yield e.piled_up, Cause.PILE_UP
    yield np.ones_like(too_dark), Cause.LOW_SIGNAL
