# SPDX-License-Identifier: Apache-2.0
"""Signals whose frames were taken at different times, and the accumulator that collects them from several passes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.motion.displacement import displacement
from rangesim.motion.passes import Pass
from rangesim.motion.timing import Timing
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.signals import NO_SAMPLING_ERROR, Signals, StillSignals


@dataclass(frozen=True, eq=False, repr=False)
class MovingSignals(Signals):
    """Signals of one sensor whose frames were taken while something moved.

    `rig`, `energy` and `truth` are those at the middle of the acquisition.

    sensor : the sensor that the frames belong to.
    lit : (k, h, w) float32, W/m2/sr, the frames without ambient light.
    ambient : (e, h, w) float32, W/m2/sr, ambient light during each exposure, before any filter.
    ambient_gain : (k,) float32, fraction of the ambient light that each frame receives.
    exposure_of_frames : (k,) int, exposure of each frame, an index into `ambient`.
    lit_error : (k, h, w) float32, W/m2/sr, a draw of the sampling error of `lit`; None: not known.
    """

    sensor: Sensor = field(kw_only=True)
    lit: np.ndarray = field(kw_only=True)
    ambient: np.ndarray = field(kw_only=True)
    ambient_gain: np.ndarray = field(kw_only=True)
    exposure_of_frames: np.ndarray = field(kw_only=True)
    lit_error: np.ndarray | None = field(kw_only=True, default=None)

    @property
    def knows_sampling_error(self) -> bool:
        return self.lit_error is not None

    def frames(self, sensor: Sensor, ambient_transmission: float = 1.0, sampling_errors: float = 0.0) -> np.ndarray:
        if sensor != self.sensor:
            raise ValueError(
                f"expected {self.sensor}, because the signals are the frames of this sensor alone, got {sensor}."
            )
        lit = self.lit
        if sampling_errors:
            if self.lit_error is None:
                raise ValueError(NO_SAMPLING_ERROR)
            lit = lit + np.float32(sampling_errors) * self.lit_error
        gain = np.float32(ambient_transmission) * self.ambient_gain
        parts = zip(lit, gain, self.exposure_of_frames, strict=True)
        return np.stack([frame + g * self.ambient[exposure] for frame, g, exposure in parts])


class FrameStack:
    """Accumulator for the frames of one sensor; it adds the part of each pass, and does not keep the pass.

    Parameters
    ----------
    sensor : the sensor that the frames belong to.
    timing : the times of its exposures, and which frames share one.
    rig : Rig without motion.
    middle, at_middle : the pass at the middle of the acquisition, and its signals.
    """

    def __init__(self, sensor: Sensor, timing: Timing, rig: Rig, middle: Pass, at_middle: StillSignals) -> None:
        self.sensor, self.rig = sensor, rig
        self.middle = middle
        self.at_middle = replace(at_middle, channels={}, sampling=None)  # without the large arrays
        self.exposure_of_frames = timing.exposure_of_frames(sensor)
        image = (rig.camera.height, rig.camera.width)
        self.lit = np.zeros((sensor.n_frames, *image), dtype=np.float32)
        self.lit_error = np.zeros_like(self.lit) if at_middle.knows_sampling_error else None
        self.ambient = np.zeros((len(timing.exposure_times_s(sensor)), *image), dtype=np.float32)
        self.motion_m = np.zeros(image, dtype=np.float32)

    def add(self, one: Pass, signals: StillSignals) -> None:
        """Add the light that a pass has for the frames of this sensor, and update the motion of its pixels."""
        frames = signals.frames(self.sensor, 0.0)
        error = None if self.lit_error is None else signals.frames(self.sensor, 0.0, sampling_errors=1.0) - frames
        for part in one.contributions:
            if part.sensor == self.sensor:
                fraction = np.float32(part.fraction)
                one.window.of(self.lit)[part.frames] += fraction * frames[part.frames]
                if self.lit_error is not None and error is not None:
                    one.window.of(self.lit_error)[part.frames] += fraction * error[part.frames]
                one.window.of(self.ambient)[part.exposure] += fraction * signals.energy.ambient
        cropped = replace(self.rig, camera=signals.rig.camera)
        leaves = displacement(self.at_middle.truth, self.rig, self.middle.poses, one.poses)
        comes = displacement(signals.truth, cropped, one.poses, self.middle.poses)
        moved = one.window.of(self.motion_m)
        np.maximum(moved, np.maximum(one.window.of(leaves), comes), out=moved)
        # A shadow moves with the object that casts it, even over surfaces at rest
        lit_at_middle = one.window.of(self.at_middle.truth.projector_visible)
        passed_by_shadow = binary_dilation(lit_at_middle != signals.truth.projector_visible, np.ones((3, 3)))
        caster = max(np.nanmax(leaves, initial=0), np.nanmax(comes, initial=0))
        moved[passed_by_shadow] = np.maximum(moved[passed_by_shadow], caster)

    def signals(self) -> MovingSignals:
        """The signals, after all passes have been added."""
        return MovingSignals(
            rig=self.at_middle.rig,
            energy=self.at_middle.energy,
            truth=self.at_middle.truth,
            motion_m=self.motion_m,
            truncation=self.at_middle.truncation,
            sensor=self.sensor,
            lit=self.lit,
            ambient=self.ambient,
            ambient_gain=_ambient_gain(self.sensor),
            exposure_of_frames=self.exposure_of_frames,
            lit_error=self.lit_error,
        )


def _ambient_gain(sensor: Sensor) -> np.ndarray:
    """Fraction of the ambient light that each frame receives: (k,) float32.

    Frames are affine in ambient light. So the fraction is the frames of one pixel with an ambient radiance of 1 and no
    other light.
    """
    dark = [np.zeros((r.channels, 1, 1), dtype=np.float32) for r in sensor.responses()]
    return sensor.frames(dark, np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32))[:, 0, 0]
