# SPDX-License-Identifier: Apache-2.0
"""How much projector light a pixel has, and how much its sensor needs there, by the thresholds of the decoders.

With S electrons of signal, and a variance of the noise of alpha S + B (shot noise of the signal; of ambient light,
dark current, read-out and quantisation), a threshold of k standard deviations is S^2 = k^2 (alpha S + B), a quadratic
with one positive root.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.gray import CONTRAST_SIGMAS, RELATIVE_CONTRAST
from rangesim.decoding.histogram import MIN_COUNTS, PEAK_SIGMAS, RELATIVE_PEAK, window_reach
from rangesim.decoding.phase_shift import MAX_PHASE_SIGMA, RELATIVE_MODULATION
from rangesim.detector import Detector, PhotoDetector
from rangesim.rig import Rig
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, StructuredLight

if TYPE_CHECKING:
    from rangesim.signals import Signals


@dataclass(frozen=True, eq=False)
class LightBudget:
    """Projector light of each pixel against what its sensor needs; radiances, W/m2/sr.

    signal : (h, w) float, projector light at full power, before the camera's lens, as all radiances here.
    needed : (h, w) float, least signal that the decoder takes, in the ambient light there is.
    needed_in_the_dark : (h, w) float, the same without ambient light.
    ambient_share : (h, w) float in 0..1, share of ambient light in the variance of the noise.
    """

    signal: np.ndarray
    needed: np.ndarray
    needed_in_the_dark: np.ndarray
    ambient_share: np.ndarray


def light_budget(signals: Signals, capture: Capture) -> LightBudget:
    """Signal, least signal and share of ambient noise of every pixel of a capture made from these signals."""
    signal = signals.energy.projector.astype(np.float64)
    ambient = signals.energy.ambient.astype(np.float64)
    if capture.detector is None and capture.ambient is not None:
        ambient *= capture.ambient.scale
    if isinstance(capture.sensor, IdealToF):
        first = signals.frames(capture.sensor)[0].astype(np.float64)
        nothing = np.full(first.shape, np.finfo(np.float32).tiny)
        return LightBudget(first, nothing, nothing, np.zeros(first.shape))
    lens = np.maximum(signals.rig.camera_illumination, np.finfo(np.float32).tiny)  # what vignetting leaves
    if capture.detector is None:
        behind = _noise_free(capture, signal * lens, ambient * lens)
    else:
        behind = _noisy(capture, capture.detector, signal * lens, ambient * lens)
    needed, in_the_dark = behind.needed / lens, behind.needed_in_the_dark / lens
    return replace(behind, signal=signal, needed=needed, needed_in_the_dark=in_the_dark)


def white_radiance(rig: Rig, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) float, W/m2/sr: what white Lambertian surfaces return of the projector's light.

    points, normals : (n, 3) float, metres and unit, frame of the projector.
    """
    distance = np.linalg.norm(points, axis=-1)
    cosine = np.abs((normals * points).sum(axis=-1)) / distance
    irradiance = rig.projector_irradiance * (np.abs(points[:, 2]) / distance) ** rig.projector_vignetting
    with np.errstate(divide="ignore"):
        return np.asarray(irradiance / np.pi * cosine * distance / points[:, 2] ** 3)


def _noise_free(capture: Capture, signal: np.ndarray, ambient: np.ndarray) -> LightBudget:
    """Thresholds of noise-free captures: shares of the bright pixels and of the pixel's own brightness."""
    sensor = capture.sensor
    floor = (RELATIVE_PEAK if isinstance(sensor, DirectToF) else RELATIVE_CONTRAST) * bright_level(signal)
    dark = np.full(signal.shape, max(floor, np.finfo(np.float32).tiny))
    visibility = 0.0  # ratio of modulation to signal in which ambient light, unmodulated, counts
    if isinstance(sensor, AmcwToF):
        visibility = sensor.contrast
    elif isinstance(sensor, StructuredLight) and sensor.code == "gray-phase":
        visibility = 0.5
    needed = dark if not visibility else np.maximum(dark, RELATIVE_MODULATION * ambient / visibility)
    total = np.maximum(signal + ambient, np.finfo(np.float32).tiny)
    return LightBudget(signal, needed, dark, ambient / total)


def _noisy(capture: Capture, detector: PhotoDetector, signal: np.ndarray, ambient: np.ndarray) -> LightBudget:
    rig, sensor, exposure_s = capture.rig, capture.sensor, capture.exposure_s
    assert rig is not None  # signals always have one
    dark_e = float(detector.mean_electrons(np.zeros(1), sensor, rig, exposure_s)[0])
    gain = float(detector.mean_electrons(np.ones(1), sensor, rig, exposure_s)[0]) - dark_e  # electrons per W/m2/sr
    ambient_e = detector.ambient_share(sensor, capture.ambient) * ambient * gain
    needed_e = _least_electrons(capture, detector, dark_e, ambient_e)
    in_the_dark_e = _least_electrons(capture, detector, dark_e, np.zeros_like(ambient_e))
    dark_in_frame_e = dark_e * (_window_bins(sensor) if isinstance(sensor, DirectToF) else 1)
    other = _own_noise(detector, dark_in_frame_e) + _signal_in_frame(capture) * signal * gain
    ambient_in_frame = _ambient_in_frame(capture) * ambient_e
    share = ambient_in_frame / np.maximum(ambient_in_frame + other, np.finfo(np.float32).tiny)
    return LightBudget(signal, needed_e / gain, in_the_dark_e / gain, share)


def _least_electrons(capture: Capture, detector: PhotoDetector, dark_e: float, ambient_e: np.ndarray) -> np.ndarray:
    """(h, w) electrons of projector light at full power at the thresholds of the decoder; see the module."""
    sensor, own = capture.sensor, _own_noise(detector, dark_e)
    if isinstance(sensor, DirectToF):  # counts in the window of the peak against those of the background under it
        background = _window_bins(sensor) * (dark_e + ambient_e / sensor.bins)
        return np.asarray(np.maximum(MIN_COUNTS, PEAK_SIGMAS * np.sqrt(background)))
    if isinstance(sensor, AmcwToF):  # phase sigma = sqrt(2 / 4) noise / (contrast S / 2), taps hold half the light
        k2 = 2.0 / (sensor.contrast * MAX_PHASE_SIGMA) ** 2
        return _root(k2, 0.5, 0.5 * ambient_e + own)
    least = _root(CONTRAST_SIGMAS**2, 1.0, 2 * (ambient_e + own))  # white - black
    if isinstance(sensor, StructuredLight) and sensor.code == "gray-phase":  # sigma = sqrt(2 / N) noise / (S / 2)
        k2 = 8.0 / (sensor.steps * MAX_PHASE_SIGMA**2)
        least = np.maximum(least, _root(k2, 0.5, ambient_e + own))
    return least


def _root(k2: float, alpha: float, b: np.ndarray) -> np.ndarray:
    """Positive root of S^2 = k2 (alpha S + b)."""
    half = 0.5 * k2 * alpha
    return np.asarray(half + np.sqrt(half**2 + k2 * b))


def _own_noise(detector: PhotoDetector, dark_e: float) -> float:
    """Variance of the noise of the detector itself in a frame, electrons squared."""
    if isinstance(detector, Detector):
        return dark_e + detector.read_noise_e**2 + 1 / (12 * detector.gain_dn_e**2)
    return dark_e


def _signal_in_frame(capture: Capture) -> float:
    """Share of the light at full power that a frame holds: a histogram's peak all, taps and fringes half."""
    return 1.0 if isinstance(capture.sensor, DirectToF) else 0.5


def _ambient_in_frame(capture: Capture) -> float:
    sensor = capture.sensor
    if isinstance(sensor, DirectToF):
        return _window_bins(sensor) / sensor.bins
    return 0.5 if isinstance(sensor, AmcwToF) else 1.0


def _window_bins(sensor: DirectToF) -> int:
    """Bins in the window of a peak; see `rangesim.decoding.histogram.find_peak`."""
    return 2 * window_reach(sensor.bins, sensor.sigma_bins, sensor.is_cyclic) + 1
