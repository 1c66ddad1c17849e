# SPDX-License-Identifier: Apache-2.0
"""Closed forms of the errors that noise and quantisation make, from the light that the pixels received.

Each decoder has its own (`rangesim.sensor.Decoder.depth_error_m`), as far as there is one in the literature. They take
the light of a pass, the exposure and the detector, and no frame: so they can be compared with the errors of
decoded frames.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Captured
from rangesim.rig import Intrinsics
from rangesim.sensor import Decoder, ReceivedLight, Sensor

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient
    from rangesim.electronics.detector import PhotoDetector
    from rangesim.rig import Rig
    from rangesim.signals import Signals

STEP = 1e-4
"""Relative step of a depth, over which lengths and projector coordinates are differentiated: far above the rounding of
float64, and far below the curvature of either."""


def error_by_theory(signals: Signals, captured: Captured, decoder: Decoder) -> np.ndarray | None:
    """(h, w) float64, metres, root mean square error of correct readings by a closed form; None if there is none.

    It is NaN where the surface is beyond the sensor's range, because no reading there is correct.

    Parameters
    ----------
    signals : Signals that the capture was exposed from.
    captured : Capture or CaptureSet; its frames are not used.
    decoder : Decoder of the readings.

    Examples
    --------
    `signals` is what `rangesim.transport(scene, rig, sensor)` returns, here of a wall at 1 m:

    >>> from rangesim import Detector, expose
    >>> capture = expose(signals, sensor, Detector(), exposure_s=1e-3)
    >>> error_by_theory(signals, capture, sensor.default_decoder).shape
    (48, 64)
    """
    if captured.reference.detector is None or not captured.reference.is_digital:
        return None
    light, sensor = received_light(signals, captured), captured.sensor
    error_m = decoder.depth_error_m(sensor, light)
    return None if error_m is None else np.where(sensor.is_beyond_range(light.path_length_m), np.nan, error_m)


def received_light(signals: Signals, captured: Captured) -> ReceivedLight:
    """The light that the pixels of the reference camera received in one exposure of a capture.

    Raises
    ------
    ValueError
        The capture has no detector.
    """
    capture = captured.reference
    if capture.detector is None:
        raise ValueError("expected a capture with a detector, got a noise-free one.")
    return light_of_exposure(signals, capture.sensor, capture.detector, capture.exposure_s, capture.ambient)


def light_of_exposure(
    signals: Signals, sensor: Sensor, detector: PhotoDetector, exposure_s: float, ambient: Ambient | None
) -> ReceivedLight:
    """The light that the pixels of the reference camera receive in one exposure, seconds."""
    rig, energy, gate = signals.rig, signals.energy, sensor.gate
    illumination = rig.camera_illumination.astype(np.float64)
    passed = detector.ambient_fraction(gate, ambient)

    def electrons(radiance: np.ndarray) -> np.ndarray:
        lit = illumination * radiance.astype(np.float64)
        return detector.mean_electrons(lit, gate, rig, exposure_s) - dark_e

    dark_e = 0.0
    dark_e = float(electrons(np.zeros((1, 1)))[0, 0])
    reading_m = rig.camera.reading(signals.truth).astype(np.float64)
    (near_m, near_px), (far_m, far_px) = (_seen_at(rig, reading_m * (1 + sign * STEP / 2)) for sign in (-1, 1))
    change_m = STEP * reading_m
    with np.errstate(divide="ignore", invalid="ignore"):
        per_column, per_row = np.moveaxis(change_m[..., None] / (far_px - near_px), -1, 0)
        per_length = change_m / (far_m - near_m)
    blind = detector.blindness(gate, exposure_s)
    return ReceivedLight(
        emitter=electrons(energy.projector),
        ambient=electrons(passed * energy.ambient),
        own_variance=detector.own_noise_e2(dark_e),
        reading_m=reading_m,
        path_length_m=(near_m + far_m) / 2,
        per_length=per_length,
        per_column=per_column,
        per_row=per_row,
        pixel_columns=_across((near_px + far_px)[..., 0] / 2),
        pixel_rows=_across((near_px + far_px)[..., 1] / 2),
        focal_px=rig.camera.fx if isinstance(rig.camera, Intrinsics) else math.nan,
        trials=math.inf if blind is None else blind.trials,
    )


def _across(coordinate_px: np.ndarray) -> np.ndarray:
    """(h, w) float64, change of a projector coordinate (h, w) over a camera's pixel, along columns or rows: that to the
    nearer of two neighbours, which lies on the same surface; 0 where no neighbour sees anything."""
    found = np.zeros(coordinate_px.shape)
    for axis in (0, 1):
        step = np.abs(np.diff(coordinate_px, axis=axis))
        edge = np.full_like(np.take(coordinate_px, [0], axis=axis), np.nan)
        to_both = np.concatenate([edge, step], axis=axis), np.concatenate([step, edge], axis=axis)
        found = np.fmax(found, np.fmin(*to_both))
    return found


def _seen_at(rig: Rig, reading_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Path length (h, w) there and back, metres, and projector coordinates (h, w, 2), pixels, of points at readings on
    the rays of the pixels; NaN coordinates for an emitter without an image."""
    if isinstance(rig.camera, Intrinsics):
        along = rig.camera.directions(rig.camera.pixel_centres()) * reading_m[..., None]
    else:
        along = rig.camera.rays.directions * reading_m[..., None]
    back = along - rig.emitter_offsets
    length_m = np.linalg.norm(along, axis=-1) + np.linalg.norm(back, axis=-1)
    if not (isinstance(rig.projector, Intrinsics) and isinstance(rig.camera, Intrinsics)):
        return length_m, np.full((*reading_m.shape, 2), np.nan)
    with np.errstate(invalid="ignore"):
        return length_m, rig.projector.project(back @ rig.T_camera_projector[:3, :3])
