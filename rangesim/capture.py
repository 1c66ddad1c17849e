# SPDX-License-Identifier: Apache-2.0
"""Frames as a camera delivers them, with what is needed to decode them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.detector import Detector
from rangesim.rig import Rig
from rangesim.sensors import Sensor


@dataclass(frozen=True, eq=False)
class Capture:
    """A stack of frames of one sensor.

    Parameters
    ----------
    frames : (k, h, w) uint8, uint16 or uint32 digital numbers; or float32 radiance (W/m2/sr) of a noise-free capture.
    sensor : Sensor, the measuring principle the frames were taken with.
    rig : Rig, or None for an uncalibrated capture.
    detector : Detector, or None if unknown (a real capture) or noise-free.
    exposure_s : float, seconds per frame; NaN if unknown.
    """

    frames: np.ndarray
    sensor: Sensor
    rig: Rig | None = None
    detector: Detector | None = None
    exposure_s: float = float("nan")

    def __post_init__(self) -> None:
        if self.frames.ndim != 3 or len(self.frames) != self.sensor.n_frames:
            raise ValueError(
                f"expected {self.sensor.n_frames} frames of equal size for {self.sensor.type_name}, "
                f"got an array of shape {self.frames.shape}."
            )
