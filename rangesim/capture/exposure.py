# SPDX-License-Identifier: Apache-2.0
"""Exposure: the capture that a camera would make of the light in signals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, overload

import numpy as np

from rangesim.capture import Capture, Captured, CaptureSet, bright_level, together
from rangesim.electronics.detector import PhotoDetector
from rangesim.errors import warn
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.settings.bounds import SECONDS, check_number
from rangesim.settings.config import ShortRepr
from rangesim.settings.seeds import check_seed, derived_seed

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient
    from rangesim.signals import Signals, SignalSet

TARGET_FRACTION = 0.7
"""Fraction of the saturation capacity to which automatic exposure brings the bright pixels (`bright_level`).

A larger value saturates more of the brightest 1 % of the pixels; a smaller one uses less of the dynamic range. Other
values were not measured.
"""


@overload
def expose(  # type: ignore[overload-overlap]
    signals: SignalSet,
    sensor: Sensor,
    detector: PhotoDetector | None = ...,
    exposure_s: float | None = ...,
    seed: int = ...,
    ambient: Ambient | None = ...,
) -> CaptureSet: ...


@overload
def expose(
    signals: Signals,
    sensor: Sensor,
    detector: PhotoDetector | None = ...,
    exposure_s: float | None = ...,
    seed: int = ...,
    ambient: Ambient | None = ...,
) -> Capture: ...


def expose(
    signals: Signals,
    sensor: Sensor,
    detector: PhotoDetector | None = None,
    exposure_s: float | None = None,
    seed: int = 0,
    ambient: Ambient | None = None,
) -> Captured:
    """The capture that a sensor takes of signals, with the noise and the limits of a detector.

    Of signals of several cameras (`SignalSet`) it is a `CaptureSet`. All cameras then have one exposure, which
    automatic exposure chooses for the first one, and noise of their own. The first one has the same bytes as alone.

    Parameters
    ----------
    signals : Signals of a transport pass that this sensor was part of.
    sensor : Sensor.
    detector : Detector (EMVA 1288) or, for direct time of flight, SpadDetector. None: the capture is noise-free; its
        frames are float32 radiance in W/m2/sr and contain the ambient light without a filter. The frames of an ideal
        sensor (`Sensor.is_ideal`) are always noise-free.
    exposure_s : float, seconds per frame; None: chosen by `auto_exposure_s`, and the capture says so
        (`Capture.exposure_is_automatic`). A noise-free capture has none.
    seed : int from 0 to 2^64 - 1, seed of the noise. Every frame has its own random stream (with a SpadDetector, every
        image row has one); the same seed gives the same bytes on any number of threads.
    ambient : Ambient, kind and strength of the light of the scene's own emitters; the detector's band
        (`band_width_m`) then decides how much of this light reaches it. None: unknown; then the detector's
        `ambient_transmission` decides. Another ambient light needs no new transport pass.

    Raises
    ------
    ValueError
        The pass lacks the sensor's signals, the exposure is not positive or is stated without a detector, the seed is
        out of its range, detector and sensor do not go together, or ambient light is stated for a scene that has none.

    Examples
    --------
    `signals` is what `rangesim.transport(scene, rig, sensor)` returns, here of a wall at 1 m:

    >>> from rangesim import Detector, expose
    >>> capture = expose(signals, sensor, Detector(read_noise_e=5.0), exposure_s=1e-3, seed=1)
    >>> capture.frames.dtype.name, capture.frames.shape == (sensor.n_frames, 48, 64)
    ('uint16', True)
    >>> expose(signals, sensor).is_digital  # noise-free: radiance
    False
    """
    return exposed(signals, sensor, detector, exposure_s, seed, ambient).capture


@dataclass(frozen=True, eq=False, repr=False)
class Exposure(ShortRepr):
    """A capture together with the light that it was exposed from.

    capture : Capture, or CaptureSet of several cameras.
    signals : Signals.
    radiance : (k, h, w) float32, W/m2/sr, mean of the light that the detector of the reference camera turns into each
        frame; None: the capture is noise-free, and its frames are the radiance.
    """

    capture: Captured
    signals: Signals
    radiance: np.ndarray | None = None

    def photons_per_pulse(self) -> np.ndarray | None:
        """(h, w) float64, mean number of photons that each pixel detects per laser pulse; with pile-up, it counts only
        the first of them. None if the detector integrates, or the capture is noise-free."""
        capture = self.capture.reference
        if capture.detector is None or self.radiance is None or capture.sensor.gate is None:
            return None
        return capture.detector.photons_per_pulse(self.radiance, capture.sensor.gate, self.signals.rig)

    def warn_of_overexposure(self, name: str) -> None:
        """Warn if the detector's shortest exposure, which was chosen automatically, saturates the bright pixels.

        name : name of the instrument.

        Warns
        -----
        RangesimWarning
        """
        capture, rig = self.capture.reference, self.signals.rig
        detector = capture.detector
        if detector is None or self.radiance is None or capture.exposure_s > detector.min_exposure_s:
            return
        level = bright_level(self.radiance.max(axis=0)) * detector.electron_rate_per_radiance(rig)
        if level * capture.exposure_s > detector.capacity_e:
            lit = self.signals.energy.projector > 0
            fraction = np.mean(capture.saturated(capture.frames), where=lit) if lit.any() else 0.0
            warn(
                f"{name}: the detector's shortest exposure, {capture.exposure_s:g} s, saturates {100 * fraction:.0f} % "
                "of the pixels that get light of the emitter; take less light "
                f"(its power_w is {rig.projector_power_w:g}), or a shorter min_exposure_s."
            )


def exposed(
    signals: Signals,
    sensor: Sensor,
    detector: PhotoDetector | None = None,
    exposure_s: float | None = None,
    seed: int = 0,
    ambient: Ambient | None = None,
) -> Exposure:
    """Capture of `sensor` with the light that it was exposed from; parameters and errors are those of `expose`."""
    if detector is not None and not isinstance(detector, PhotoDetector):
        raise ValueError(f"expected a Detector, a SpadDetector or None, got {detector!r}.")
    seed = check_seed(seed)
    if exposure_s is not None:
        check_number("exposure_s", exposure_s, SECONDS)
        if detector is None and not sensor.is_ideal:
            raise ValueError(
                f"expected a detector with exposure_s, such as {sensor.type_name}'s default_detector; without one, the "
                "frames are radiance, and no exposure counts."
            )
    if ambient is not None:
        ambient.check_emitters(bool(signals.energy.ambient.any()))
    if detector is None or sensor.is_ideal:
        return Exposure(noise_free_capture(signals, sensor, ambient), signals)
    captures, of_reference, is_automatic = [], None, exposure_s is None
    for number, one in enumerate(signals.cameras):
        radiance = mean_radiance(one, sensor, detector, ambient)
        of_reference = radiance if of_reference is None else of_reference
        if exposure_s is None:
            exposure_s = auto_exposure_s(radiance, sensor, detector, one.rig)
        frames = detector.read_out(radiance, sensor.gate, one.rig, exposure_s, _seed_of_camera(seed, number))
        captures.append(Capture(frames, sensor, one.rig, detector, exposure_s, ambient, is_automatic))
    return Exposure(together(captures), signals, of_reference)


def _seed_of_camera(seed: int, number: int) -> int:
    """Seed of the noise of a camera; that of the reference camera, number 0, is the seed itself."""
    return derived_seed(seed, number) if number else seed


def noise_free_capture(
    signals: Signals, sensor: Sensor, ambient: Ambient | None = None, sampling_errors: float = 0.0
) -> Captured:
    """Capture of the radiance of signals, without a detector; a `CaptureSet` of several cameras.

    sampling_errors : factor on the draw of the sampling error that is added to the signals; 0: none is added.
    """
    unfiltered = 1.0 if ambient is None else ambient.scale

    def radiance(one: Signals) -> np.ndarray:
        return _through_lens(sensor.at_pixels(one.frames(sensor, unfiltered, sampling_errors)), one.rig)

    return capture_of_frames(signals, sensor, radiance, ambient)


def capture_of_frames(
    signals: Signals, sensor: Sensor, frames_of: Callable[[Signals], np.ndarray], ambient: Ambient | None = None
) -> Captured:
    """Noise-free capture of frames that a function makes for each camera of the signals.

    frames_of : function of the signals of one camera that returns frames (k, h, w) float32, W/m2/sr.
    ambient : Ambient that the frames were taken in; None: not stated.
    """
    return together([Capture(frames_of(one), sensor, one.rig, ambient=ambient) for one in signals.cameras])


def exposed_again(capture: Captured, signals: Signals, seed: int, sampling_errors: float = 0.0) -> Captured:
    """Capture of the same signals with the same settings, and with the noise of another seed.

    sampling_errors : factor on the draw of the sampling error that is added to the signals; 0: none is added.

    Raises
    ------
    ValueError
        The detector of the capture is not known.
    """
    captures = []
    for number, (taken, one) in enumerate(zip(capture.captures, signals.cameras, strict=True)):
        if taken.detector is None:
            raise ValueError("expected a capture whose detector is known, got one without.")
        radiance = mean_radiance(one, taken.sensor, taken.detector, taken.ambient, sampling_errors)
        gate, camera_seed = taken.sensor.gate, _seed_of_camera(seed, number)
        frames = taken.detector.read_out(radiance, gate, one.rig, taken.exposure_s, camera_seed)
        captures.append(replace(taken, frames=frames))
    return together(captures)


def mean_radiance(
    signals: Signals,
    sensor: Sensor,
    detector: PhotoDetector,
    ambient: Ambient | None,
    sampling_errors: float = 0.0,
) -> np.ndarray:
    """(k, h, w) float32, W/m2/sr, mean radiance of the frames that a detector takes.

    sampling_errors : factor on the draw of the sampling error that is added to the signals; 0: none is added.
    """
    lit = signals.frames(sensor, detector.ambient_fraction(sensor.gate, ambient), sampling_errors)
    return _through_lens(sensor.at_pixels(lit), signals.rig)


def _through_lens(frames: np.ndarray, rig: Rig) -> np.ndarray:
    """Frames (k, h, w) behind the camera's lens, which darkens the corners if it vignettes, and for smaller pixels.

    The lens scatters stray light over each frame alike, so no light is lost: it has the phase, the code and the path
    length of the image's mean.
    """
    fraction = rig.camera_illumination
    frames = frames if (fraction == 1).all() else frames * fraction
    if rig.camera_lens.stray_light:
        stray = rig.camera_lens.stray_light
        mean = frames.mean(axis=(1, 2), dtype=np.float64, keepdims=True)
        frames = ((1 - stray) * frames + stray * mean).astype(np.float32)
    return frames


def auto_exposure_s(radiance: np.ndarray, sensor: Sensor, detector: PhotoDetector, rig: Rig) -> float:
    """Exposure in seconds, one for all frames, that brings the bright pixels to 70 % of saturation.

    Of the pixels that receive light, 99 % are at or below that level in their brightest frame: highlights of mirrors
    and glossy surfaces may saturate. The exposure stays between the detector's shortest and longest one.

    Parameters
    ----------
    radiance : (k, h, w) float, W/m2/sr, mean of the frames.
    """
    level = bright_level(radiance.max(axis=0)) * detector.electron_rate_per_radiance(rig)
    if level == 0:
        return detector.max_exposure_s
    wanted = TARGET_FRACTION * detector.capacity_e / level
    return float(np.clip(wanted, detector.min_exposure_s, detector.max_exposure_s))
