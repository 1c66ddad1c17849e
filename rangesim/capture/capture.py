# SPDX-License-Identifier: Apache-2.0
"""Frames as a camera delivers them, with what is needed to decode them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rangesim.electronics.detector import PhotoDetector
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.settings.config import ShortRepr

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient

DTYPES = ("uint8", "uint16", "uint32", "float32")


BRIGHT_PERCENTILE = 99.0
"""Percentile of the lit pixels that counts as bright: highlights of mirrors and gloss lie beyond."""


def bright_level(values: np.ndarray) -> float:
    """Level of bright pixels: the 99th percentile of the positive values; 0 if there are none."""
    positive = values[values > 0]
    return float(np.percentile(positive, BRIGHT_PERCENTILE)) if positive.size else 0.0


MIN_CLIPPED_FRACTION = 0.005
"""Least fraction of the pixels at the level where a camera clips."""
MIN_CLIP_PEAK = 10.0
"""Least ratio of the pixels at that level to those at an average one of the `CLIP_LEVELS` below."""
MIN_CLIP_TAIL = 0.05
"""Least ratio of the pixels in the `CLIP_LEVELS` below together to those at that level; an image of few grey levels has
none."""
CLIP_LEVELS = 16
"""Number of levels looked at below, each 1/256 of the level where the camera clips."""


def clip_level(brightest: np.ndarray, max_dn: int) -> int:
    """The digital number at which a camera clips: `max_dn`, unless values pile up at a lower largest one.

    Video levels end at 235 of 255, others at what a converter or a developer of raw images leaves. There the values
    below go on up to the end, and many stand on it. Images of two values have nothing below, and peaks of fringes no
    such pile: neither is clipped.

    Parameters
    ----------
    brightest : (h, w) integer, the largest value of each pixel in all frames.
    """
    top = int(brightest.max())
    if top >= max_dn or top < 2 * CLIP_LEVELS:
        return max_dn
    at_top = int((brightest == top).sum())
    width = max(1.0, top / 256)
    below = int(((brightest < top) & (brightest >= top - CLIP_LEVELS * width)).sum())
    piled = at_top > MIN_CLIP_PEAK * below / CLIP_LEVELS and below > MIN_CLIP_TAIL * at_top
    return top if piled and at_top > MIN_CLIPPED_FRACTION * brightest.size else max_dn


def _masked_in_all(frames: np.ndarray) -> np.ndarray:
    """Frames (k, h, w), those of float32 with NaN in all where one of them is not finite."""
    if np.issubdtype(frames.dtype, np.integer):
        return frames
    masked = np.zeros(frames.shape[1:], dtype=bool)
    for frame in frames:
        masked |= ~np.isfinite(frame)
    return np.where(masked, np.float32(np.nan), frames) if masked.any() else frames


@dataclass(frozen=True, eq=False, repr=False)
class Capture(ShortRepr):
    """A stack of frames of one sensor.

    Parameters
    ----------
    frames : (k, h, w) uint8, uint16 or uint32 digital numbers; or float32 radiance (W/m2/sr) of a noise-free
        capture. A pixel that is not finite in one frame is kept as NaN in all: it is masked, and measures nothing.
    sensor : Sensor, the measuring principle the frames were taken with.
    rig : Rig, or None for an uncalibrated capture.
    detector : PhotoDetector, or None if unknown (a real capture) or noise-free.
    exposure_s : float, seconds per frame; NaN if unknown.
    ambient : Ambient, the ambient light it was taken in, or None if not stated.
    """

    frames: np.ndarray
    sensor: Sensor
    rig: Rig | None = None
    detector: PhotoDetector | None = None
    exposure_s: float = float("nan")
    ambient: Ambient | None = None

    def __post_init__(self) -> None:
        if self.frames.ndim != 3 or len(self.frames) != self.sensor.n_frames or self.frames.size == 0:
            raise ValueError(
                f"expected {self.sensor.n_frames} frames of equal size for {self.sensor.type_name}, "
                f"got an array of shape {self.frames.shape}."
            )
        if self.frames.dtype.name not in DTYPES:
            raise ValueError(f"expected frames of type {', '.join(DTYPES)}, got {self.frames.dtype.name}.")
        if self.rig is not None and self.frames.shape[1:] != (self.rig.camera.height, self.rig.camera.width):
            raise ValueError(
                f"expected frames of {self.rig.camera.width} x {self.rig.camera.height} pixels as the rig's camera, "
                f"got {self.frames.shape[2]} x {self.frames.shape[1]}."
            )
        object.__setattr__(self, "frames", _masked_in_all(self.frames))

    @property
    def is_digital(self) -> bool:
        """Whether the frames are digital numbers, not radiance."""
        return bool(np.issubdtype(self.frames.dtype, np.integer))

    @property
    def black_level(self) -> float:
        """Digital number without light; 0 if unknown or noise-free."""
        return self.detector.black_level_dn if self.detector else 0.0

    @property
    def full_scale(self) -> float:
        """Largest signal above black that a frame can hold; of a noise-free capture, that of its bright pixels."""
        if not self.is_digital:
            return bright_level(self.frames.max(axis=0)) or 1.0
        return self._max_dn - self.black_level

    @property
    def _max_dn(self) -> int:
        return self.detector.max_dn if self.detector else int(np.iinfo(self.frames.dtype).max)

    def saturated(self, frames: np.ndarray) -> np.ndarray:
        """(h, w) bool, where any of `frames` (k, h, w) of this capture is at the level where the camera clips.

        That is the largest digital number, or a lower one where an unknown detector's values end, see `clip_level`.
        """
        if not self.is_digital:
            return np.zeros(frames.shape[1:], dtype=bool)
        level = self._max_dn if self.detector else self._clip_level
        return np.asarray(frames.max(axis=0) >= level)

    @cached_property
    def _clip_level(self) -> int:
        return clip_level(self.frames.max(axis=0), self._max_dn)

    def noise(self, frame: np.ndarray) -> np.ndarray | None:
        """Standard deviation of the pixels of a frame, in its units; None if the detector is unknown, or counts."""
        return self.detector.noise_dn(frame) if self.detector else None
