# SPDX-License-Identifier: Apache-2.0
"""How much projector light a pixel has, and how much its sensor needs there, by the thresholds of its decoder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.electronics.detector import PhotoDetector
from rangesim.rig import Rig
from rangesim.sensor import Background, Decoder

if TYPE_CHECKING:
    from rangesim.signals import Signals


@dataclass(frozen=True, eq=False)
class LightBudget:
    """Projector light of each pixel against what its sensor needs; radiances, W/m2/sr.

    signal : (h, w) float, projector light at full power, before the camera's lens, as all radiances here.
    needed : (h, w) float, least signal that the decoder takes, in the ambient light there is.
    needed_in_the_dark : (h, w) float, the same without ambient light.
    ambient_fraction : (h, w) float in 0..1, of ambient light in the variance of the noise.
    """

    signal: np.ndarray
    needed: np.ndarray
    needed_in_the_dark: np.ndarray
    ambient_fraction: np.ndarray


def light_budget(signals: Signals, capture: Capture, decoder: Decoder) -> LightBudget:
    """Signal, least signal and fraction of ambient noise of every pixel of a capture made from these signals."""
    sensor, content = capture.sensor, decoder.content(capture.sensor)
    signal = signals.energy.projector.astype(np.float64)
    ambient = signals.energy.ambient.astype(np.float64)
    if capture.detector is None and capture.ambient is not None:
        ambient *= capture.ambient.scale
    lens = np.maximum(signals.rig.camera_illumination, np.finfo(np.float32).tiny)  # what vignetting leaves
    through = ambient * lens
    if capture.detector is None:
        background = Background(through, bright_level(signal * lens))
        gain = 1.0
        total = np.maximum(signal * lens + through, np.finfo(np.float32).tiny)
        ambient_fraction = through / total if content.ambient else np.zeros_like(total)
    else:
        background, gain = _in_electrons(signals.rig, capture, capture.detector, signal * lens, through)
        other = capture.detector.own_noise_e2(content.dark * background.dark) + content.signal * signal * lens * gain
        ambient_in_frame = content.ambient * background.ambient
        ambient_fraction = ambient_in_frame / np.maximum(ambient_in_frame + other, np.finfo(np.float32).tiny)
    in_the_dark = replace(background, ambient=np.zeros_like(background.ambient))
    if sensor.first_return_frame is not None:
        signal = signals.frames(sensor)[sensor.first_return_frame].astype(np.float64)
    return LightBudget(
        signal=signal,
        needed=decoder.least_signal(sensor, background) / gain / lens,
        needed_in_the_dark=decoder.least_signal(sensor, in_the_dark) / gain / lens,
        ambient_fraction=ambient_fraction,
    )


def _in_electrons(
    rig: Rig, capture: Capture, detector: PhotoDetector, signal: np.ndarray, ambient: np.ndarray
) -> tuple[Background, float]:
    """Background in electrons, and electrons per W/m2/sr, of radiances behind the lens."""
    gate = capture.sensor.gate
    dark, bright = (float(detector.mean_electrons(np.full(1, x), gate, rig, capture.exposure_s)[0]) for x in (0.0, 1.0))
    gain = bright - dark
    behind_filter = detector.ambient_fraction(gate, capture.ambient) * ambient * gain
    return Background(behind_filter, bright_level(signal * gain), dark, detector.own_noise_e2(dark)), gain


def white_radiance(rig: Rig, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) float, W/m2/sr: what white Lambertian surfaces return of the projector's light.

    points, normals : (n, 3) float, metres and unit, in projector coordinates.
    """
    distance = np.linalg.norm(points, axis=-1)
    cosine = np.abs((normals * points).sum(axis=-1)) / distance
    irradiance = rig.projector_irradiance * (np.abs(points[:, 2]) / distance) ** rig.projector_lens.vignetting
    with np.errstate(divide="ignore"):
        return np.asarray(irradiance / np.pi * cosine * distance / points[:, 2] ** 3)
