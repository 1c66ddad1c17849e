# SPDX-License-Identifier: Apache-2.0
"""Light budget: the emitter's light that a pixel receives, and the light that its decoder needs there."""

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
    """Light of the emitter that each pixel receives, and the light that its sensor needs; (h, w) float64 each.

    Radiances are in W/m2/sr, before the camera's lens.

    signal : radiance of the emitter's light at full power.
    needed : smallest signal that the decoder accepts in the ambient light of the capture.
    needed_in_the_dark : smallest signal that the decoder accepts without ambient light.
    ambient_fraction : fraction (0..1) of the variance of the noise that ambient light makes.
    """

    signal: np.ndarray
    needed: np.ndarray
    needed_in_the_dark: np.ndarray
    ambient_fraction: np.ndarray


def light_budget(signals: Signals, capture: Capture, decoder: Decoder) -> LightBudget:
    """The light budget of each pixel of a capture that was exposed from these signals.

    decoder : the decoder whose thresholds decide how much light is needed.
    """
    sensor, content = capture.sensor, decoder.content(capture.sensor)
    signal = signals.energy.projector.astype(np.float64)
    ambient = signals.energy.ambient.astype(np.float64)
    if capture.detector is None and capture.ambient is not None:
        ambient *= capture.ambient.scale
    lens = np.maximum(signals.rig.camera_illumination, np.finfo(np.float32).tiny)  # fraction that vignetting leaves
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
    """Background in electrons, and the gain in electrons per W/m2/sr, for radiances behind the lens.

    signal, ambient : (h, w) float64, W/m2/sr, of the emitter and of ambient light.
    """
    gate = capture.sensor.gate
    dark, bright = (float(detector.mean_electrons(np.full(1, x), gate, rig, capture.exposure_s)[0]) for x in (0.0, 1.0))
    gain = bright - dark
    behind_filter = detector.ambient_fraction(gate, capture.ambient) * ambient * gain
    return Background(behind_filter, bright_level(signal * gain), dark, detector.own_noise_e2(dark)), gain


def white_radiance(rig: Rig, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) float64, W/m2/sr, radiance that white Lambertian surfaces return of the emitter's light.

    points : (n, 3) float, metres, in projector coordinates.
    normals : (n, 3) float, unit vectors of the surfaces there, in projector coordinates.
    """
    distance = np.linalg.norm(points, axis=-1)
    cosine = np.abs((normals * points).sum(axis=-1)) / distance
    irradiance = rig.projector_irradiance * (np.abs(points[:, 2]) / distance) ** rig.projector_lens.vignetting
    with np.errstate(divide="ignore"):
        return np.asarray(irradiance / np.pi * cosine * distance / points[:, 2] ** 3)
