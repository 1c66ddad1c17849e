# SPDX-License-Identifier: Apache-2.0
"""Captures: the frames that a camera delivers, with the data that a decoder needs besides them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rangesim.electronics.detector import Blindness, PhotoDetector
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.settings.config import ShortRepr

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient

DTYPES = ("uint8", "uint16", "uint32", "float32")
"""Types that frames may have: digital numbers of up to 8, 16 or 32 bits, or radiance."""

BRIGHT_PERCENTILE = 99.0
"""Percentile of the lit pixels, in percent, that counts as the level of bright pixels.

The brightest 1 % is left out, because highlights of mirrors and glossy surfaces would otherwise set the exposure and
the contrast thresholds of the whole image.
"""


def bright_level(values: np.ndarray) -> float:
    """Level of bright pixels: percentile `BRIGHT_PERCENTILE` of the positive values; 0 if there are none."""
    positive = values[values > 0]
    return float(np.percentile(positive, BRIGHT_PERCENTILE)) if positive.size else 0.0


@dataclass(frozen=True)
class ClippingThresholds:
    """Thresholds by which `clip_level` decides whether the largest value in an image is the level where a camera clips.

    The defaults distinguish images in which 5 to 50 % of the pixels clip from patterns of one brightness
    (`tests/test_decode_summary.py`). Other values were not measured.

    levels : number of levels below the largest value that are compared with it, each 1/256 of that value wide.
    min_fraction : least fraction of the pixels that are at the largest value; fewer are single highlights.
    min_pixels : least number of such pixels, because in an image of a few pixels the brightest one alone is many.
    min_peak : least ratio of the number of these pixels to the mean number of pixels in one of the `levels` below; a
        smaller value takes the peaks of fringes for clipping.
    min_tail : least ratio of the number of pixels in all `levels` below to the number at the largest value; an image of
        few grey levels (black and white, for example) has no pixels there, and does not clip.
    """

    levels: int = 16
    min_fraction: float = 0.005
    min_pixels: int = 2
    min_peak: float = 10.0
    min_tail: float = 0.05


CLIPPING = ClippingThresholds()
"""Thresholds that `Capture.saturated` uses where the detector is unknown."""


def clip_level(brightest: np.ndarray, max_dn: int) -> int:
    """The digital number at which a camera clips: `max_dn`, or a lower one at which many pixels pile up.

    The values of video end at 235 of 255; other images end where a converter or a raw developer cuts them off. In such
    an image, many pixels have the largest value, and a few have each of the values just below it. An image of two
    values has no pixel just below the largest value. Fringes have not many more pixels at their peaks than just below.
    Neither of the two counts as clipped.

    Parameters
    ----------
    brightest : (h, w) integer, the largest value of each pixel in all frames.
    max_dn : largest digital number that the type of the frames or the detector allows.
    """
    top = int(brightest.max())
    if top >= max_dn or top < 2 * CLIPPING.levels:
        return max_dn
    at_top = int((brightest == top).sum())
    width = max(1.0, top / 256)
    below = int(((brightest < top) & (brightest >= top - CLIPPING.levels * width)).sum())
    piled = at_top > CLIPPING.min_peak * below / CLIPPING.levels and below > CLIPPING.min_tail * at_top
    is_many = at_top > CLIPPING.min_fraction * brightest.size and at_top >= CLIPPING.min_pixels
    return top if piled and is_many else max_dn


def _masked_in_all(frames: np.ndarray) -> np.ndarray:
    """The frames (k, h, w). If a pixel of float32 frames is not finite in one frame, it becomes NaN in all frames."""
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
        capture. A pixel that is not finite in one frame becomes NaN in all frames: it is masked, and has no reading.
    sensor : Sensor, the measuring principle with which the frames were taken.
    rig : Rig; None: the capture is not calibrated.
    detector : PhotoDetector; None: unknown (a real capture), or the capture is noise-free.
    exposure_s : float, seconds per frame; NaN if unknown.
    ambient : Ambient, the ambient light that the capture was taken in; None: not stated.
    exposure_is_automatic : bool, whether the exposure was chosen for this light. At another distance, on another
        material or in other light it would be another one.

    Raises
    ------
    ValueError
        The number of frames is not that of the sensor, or the frames differ from the rig's camera in size, or have
        another type.

    Examples
    --------
    Frames of a real camera are decoded like simulated ones:

    >>> import numpy as np
    >>> import rangesim
    >>> sensor = rangesim.AmcwToF()
    >>> frames = np.full((sensor.n_frames, 3, 4), 100, dtype=np.uint16)
    >>> capture = rangesim.Capture(frames, sensor)
    >>> capture.is_digital, capture.full_scale
    (True, 65535.0)
    """

    frames: np.ndarray
    sensor: Sensor
    rig: Rig | None = None
    detector: PhotoDetector | None = None
    exposure_s: float = float("nan")
    ambient: Ambient | None = None
    exposure_is_automatic: bool = False

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
    def captures(self) -> tuple[Capture, ...]:
        """This capture alone, as `CaptureSet.captures` of several cameras."""
        return (self,)

    @property
    def reference(self) -> Capture:
        """This capture, as `CaptureSet.reference` of several cameras."""
        return self

    @property
    def is_digital(self) -> bool:
        """Whether the frames are digital numbers, not radiance."""
        return bool(np.issubdtype(self.frames.dtype, np.integer))

    @property
    def black_level(self) -> float:
        """Digital number of a pixel without light; 0 if the detector is unknown, or the capture is noise-free."""
        return self.detector.black_level_dn if self.detector else 0.0

    @property
    def full_scale(self) -> float:
        """Largest signal above the black level that a frame can hold; if noise-free, the level of the bright pixels."""
        if not self.is_digital:
            return bright_level(self.frames.max(axis=0)) or 1.0
        return self._max_dn - self.black_level

    @property
    def _max_dn(self) -> int:
        """Largest digital number of the detector, or of the type of the frames if the detector is unknown."""
        return self.detector.max_dn if self.detector else int(np.iinfo(self.frames.dtype).max)

    def saturated(self, frames: np.ndarray) -> np.ndarray:
        """(h, w) bool, whether any of `frames` (k, h, w) of this capture is at the level where the camera clips.

        The level is the largest digital number of a known detector. For an unknown one, `clip_level` finds it.
        """
        if not self.is_digital:
            return np.zeros(frames.shape[1:], dtype=bool)
        level = self._max_dn if self.detector else self._clip_level
        return np.asarray(frames.max(axis=0) >= level)

    @cached_property
    def _clip_level(self) -> int:
        """Digital number at which an unknown camera clips, see `clip_level`."""
        return clip_level(self.frames.max(axis=0), self._max_dn)

    def noise(self, frame: np.ndarray) -> np.ndarray | None:
        """Standard deviation of the noise of each pixel of a frame, in digital numbers, by the detector's formula; None
        if the detector is unknown or counts photons."""
        return self.detector.noise_dn(frame) if self.detector else None

    @property
    def blindness(self) -> Blindness | None:
        """When the timers of the detector were blind; None if they never were, or the detector is unknown."""
        return self.detector.blindness(self.sensor.gate, self.exposure_s) if self.detector else None
