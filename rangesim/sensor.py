# SPDX-License-Identifier: Apache-2.0
"""The interface of a range sensor and of its decoder.

A new sensor is one file with two frozen dataclasses: a `Sensor`, which says what it reads of light paths and which
frames it makes of them, and a `Decoder`, which makes a range image of the frames. Those that come with the package
stand in `rangesim.sensors`; `examples/own_sensor.py` and `examples/own_code.py` are two from outside.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from rangesim.electronics.detector import Detector, Gate, PhotoDetector
from rangesim.response import Response
from rangesim.settings.config import Named

if TYPE_CHECKING:
    from rangesim.capture import Capture
    from rangesim.decoding.range_image import RangeImage


TOF_BASELINE_M = 0.03
"""Metres from the camera's lens to the lamp beside it, of a common time-of-flight camera."""


class Emitter(NamedTuple):
    """The emitter that a sensor comes with, where an instrument does not say otherwise.

    size : (width, height) of the projector in pixels; None: as the camera, for light without a pattern.
    baseline_m : metres from camera to emitter; None: a fifth of the working distance.
    """

    size: tuple[int, int] | None = None
    baseline_m: float | None = None


class Sensor(Named, ABC):
    """A measuring principle: which responses to light paths it reads, and which frames it makes of them.

    A sensor holds no geometry (that is the `Rig`), no electronics (`PhotoDetector`) and no thresholds (`Decoder`), but
    it names the ones it comes with. Subclasses are frozen dataclasses.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files and sidecars."""

    is_ideal: ClassVar[bool] = False
    """Whether this is a reference that nobody can build: its frames have no noise, and reports name no winner of it."""

    first_return_frame: ClassVar[int | None] = None
    """Index of the frame that holds the radiance of the first return, for a sensor that reads no light but that."""

    # ---- What it measures --------------------------------------------------------------------------------------------

    @abstractmethod
    def responses(self) -> tuple[Response, ...]:
        """The basis of linear functionals that the transport pass has to accumulate; equal ones each time."""

    @abstractmethod
    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """(k, h, w) float32 mean radiance of the frames, W/m2/sr, from what the transport pass accumulated.

        Images are always whole, so that a frame may depend on neighbouring pixels.

        Parameters
        ----------
        channels : one (c, h, w) float32 per response, in the order of `responses()`, W/m2/sr.
        white : (h, w) float32, radiance under constant light of the projector at full power, without ambient.
        ambient : (h, w) float32, radiance of all other light that passes the camera's filter.
        """

    @abstractmethod
    def frame_names(self) -> list[str]:
        """One short name per frame, as used for files and plots."""

    @property
    def n_frames(self) -> int:
        """Number of frames in a capture."""
        return len(self.frame_names())

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        """Number of frames, one after another in the capture, that one and the same exposure fills.

        `single_tap` : pixels have but one charge store, so that frames which could share an exposure do not.
        """
        return 1

    # ---- What it comes with ------------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def emitter(self) -> Emitter:
        """The emitter it comes with."""

    @property
    @abstractmethod
    def default_decoder(self) -> Decoder:
        """The decoder it comes with."""

    @property
    def default_detector(self) -> PhotoDetector | None:
        """The detector it comes with, by default an industrial camera; None: frames have no noise."""
        return Detector()

    @property
    def gate(self) -> Gate | None:
        """When photons are counted; None: frames integrate all light of an exposure."""
        return None

    @classmethod
    def presets(cls) -> dict[str, Sensor]:
        """Sensors of this kind by their names on the command line; by default `type_name` with default settings.

        Not inherited: a subclass of a sensor has its own, or the default.
        """
        return {cls.type_name: cls()}

    def check(self, width: int, height: int) -> None:
        """Raise ValueError if this sensor does not fit a projector of that many pixels."""
        for response in self.responses():
            response.check(width, height)

    # ---- What its readings mean --------------------------------------------------------------------------------------

    def is_beyond_range(self, path_length_m: np.ndarray) -> np.ndarray:
        """(...) bool, where a path of that length is taken for another, or not seen at all."""
        return np.zeros(np.shape(path_length_m), dtype=bool)

    @property
    def shortest_period_m(self) -> float | None:
        """Metres of range after which the finest signal repeats itself, so that readings can be off by that much; None
        if none does."""
        return None

    # ---- For people --------------------------------------------------------------------------------------------------

    @property
    def title(self) -> str:
        """What it is called in running text."""
        return self.type_name

    @property
    def details(self) -> str:
        """Its settings in a few words."""
        return f"{self.n_frames} frame{'s' * (self.n_frames != 1)}"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        """Indices of up to three of the captured frames (k, h, w) that show how it works."""
        return sorted({0, self.n_frames // 2, self.n_frames - 1})


S = TypeVar("S", bound=Sensor)


@dataclass(frozen=True)
class Background:
    """What comes on top of the projector's light in each pixel, as far as the thresholds of decoders depend on it.

    Units are electrons of an exposure, counts for sensors that count, or, of a noise-free capture, W/m2/sr.

    ambient : (h, w) float64, ambient light in a frame that integrates all of it.
    bright : projector light in bright pixels, see `rangesim.capture.bright_level`.
    dark : mean of a frame without light.
    noise_variance : variance of what the detector itself adds to a frame; None for a noise-free capture.
    """

    ambient: np.ndarray
    bright: float
    dark: float = 0.0
    noise_variance: float | None = None

    def floor(self, fraction: float) -> np.ndarray:
        """(h, w) least signal of a noise-free capture: that fraction of the bright pixels', and more than nothing."""
        return np.full(self.ambient.shape, max(fraction * self.bright, float(np.finfo(np.float32).tiny)))


class FrameContent(NamedTuple):
    """What the frame, or group of frames, that a reading rests on holds of the light and dark current of an exposure.

    signal : fraction of the projector's light at full power. ambient : fraction of the ambient light.
    dark : multiple of the dark electrons of a frame.
    """

    signal: float = 0.5
    ambient: float = 1.0
    dark: float = 1.0


class Decoder(Named, ABC):
    """Makes range images of captures. Subclasses are frozen dataclasses; their fields are thresholds.

    A decoder may look at as many pixels around each as it likes.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files."""
    reads: ClassVar[type[Sensor]] = Sensor  # type: ignore[type-abstract]
    """The sensors whose captures it takes."""

    def check(self, sensor: Sensor) -> None:
        """Raise ValueError if it takes no captures of the sensor."""
        of_type(sensor, self.reads)

    @abstractmethod
    def decode(self, capture: Capture) -> RangeImage:
        """Range image of a capture.

        Raises
        ------
        ValueError
            The capture is of a sensor that this decoder does not know.
        """

    @abstractmethod
    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        """(h, w) float64, least light of the projector at full power that the thresholds take, in the units of
        `background`."""

    def content(self, sensor: Sensor) -> FrameContent:
        """What the frame that decides about a reading holds, on average over the patterns."""
        return FrameContent()


def of_type(sensor: Sensor, kind: type[S]) -> S:
    """The sensor, which has to be of that type; ValueError if it is not."""
    if not isinstance(sensor, kind):
        raise ValueError(f"expected a capture of {kind.type_name}, got one of {sensor.type_name}.")
    return sensor


def least_signal_for(sigmas2: float, signal: float, noise_variance: np.ndarray) -> np.ndarray:
    """(h, w) least S with S^2 = `sigmas2` (`signal` S + `noise_variance`), electrons.

    That is a threshold of so many standard deviations, squared, against the shot noise of a fraction `signal` of the
    light itself and against all other noise, of variance `noise_variance`: a quadratic with one positive root.
    """
    half = 0.5 * sigmas2 * signal
    return np.asarray(half + np.sqrt(half**2 + sigmas2 * noise_variance))
