# SPDX-License-Identifier: Apache-2.0
"""The interface of a range sensor and of its decoder.

A new sensor is one file with two frozen dataclasses. The `Sensor` says which responses to light paths it reads, and
which frames it makes of them. The `Decoder` says what the frames mean: projector coordinates or path lengths, and then
a range image. The sensors that come with the package are in `rangesim.sensors`; `examples/own_sensor.py` and
`examples/own_code.py` are two that do not belong to the package."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np

from rangesim.electronics.detector import Detector, Gate, PhotoDetector
from rangesim.response import Response
from rangesim.settings.bounds import Bounds
from rangesim.settings.config import Named

if TYPE_CHECKING:
    from rangesim.capture import Capture
    from rangesim.decoding.coordinates import Coordinates
    from rangesim.decoding.range_image import RangeImage
    from rangesim.rig import Rig


TOF_BASELINE_M = 0.03
"""Distance from the camera's lens to the emitter beside it, metres, in a common time-of-flight camera."""

Threshold = Annotated[float, Bounds("0 or positive", 0, 1e6)]
"""Type of a decoder's threshold: a number of any unit that is not negative, so that it may be a fraction or a multiple
of the noise; 1e6 times the noise refuses everything."""


class Emitter(NamedTuple):
    """The emitter that a sensor comes with, for an instrument that states no other.

    size : (width, height) of the projector in pixels; None: that of the camera, for light without a pattern.
    baseline_m : metres from camera to emitter; None: a fifth of the working distance.
    """

    size: tuple[int, int] | None = None
    baseline_m: float | None = None


class Sensor(Named, ABC):
    """A measuring principle: the responses to light paths that it reads, and the frames that it makes of them.

    A sensor holds no geometry (that is in the `Rig`), no electronics (`PhotoDetector`) and no thresholds (`Decoder`).
    It only names defaults: `default_emitter`, `default_detector` and `default_decoder`; an `Instrument` can have
    others. Subclasses are frozen dataclasses.

    Examples
    --------
    >>> from rangesim.sensors import AmcwToF
    >>> sensor = AmcwToF((20e6, 80e6))
    >>> sensor.n_frames, sensor.frame_names()[:2]
    (8, ['20MHz_0deg', '20MHz_90deg'])
    >>> sensor.details
    '20, 80 MHz, 4 taps, sine wave'
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files and sidecars."""

    is_ideal: ClassVar[bool] = False
    """Whether this is a reference that nobody can build: its frames have no noise, and reports do not rank it."""

    n_cameras: ClassVar[int] = 1
    """Number of cameras. The captures of several are a `rangesim.capture.CaptureSet`; see `rigs`."""

    compares_texture: ClassVar[bool] = False
    """Whether a reading compares the pattern of neighbouring pixels, so that it needs the light of their whole area."""

    triangulates: ClassVar[bool] = False
    """Whether depth follows from two pinholes, so that camera and projector have to be such."""

    first_return_frame: ClassVar[int | None] = None
    """Index of the frame that holds the radiance of the first return, for a sensor that reads no other light."""

    # ---- How it measures ---------------------------------------------------------------------------------------------

    @abstractmethod
    def responses(self) -> tuple[Response, ...]:
        """Weights of light paths that the transport pass has to sum up; each call must return equal ones."""

    @abstractmethod
    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """(k, h, w) float32, W/m2/sr, mean radiance of the frames, from what the transport pass accumulated.

        The arguments are whole images, so that a frame may depend on neighbouring pixels.

        Parameters
        ----------
        channels : one (c, h, w) float32 per response, in the order of `responses()`, W/m2/sr.
        white : (h, w) float32, W/m2/sr, radiance under constant light of the emitter at full power, without ambient.
        ambient : (h, w) float32, W/m2/sr, radiance of all other light that passes the camera's filter.
        """

    @abstractmethod
    def frame_names(self) -> list[str]:
        """One short name per frame, as used for files and plots."""

    @property
    def n_frames(self) -> int:
        """Number of frames in a capture."""
        return len(self.frame_names())

    @property
    def reads_emitter(self) -> bool:
        """Whether the sensor reads light of its emitter; if not, shadows and the emitter's power mean nothing to it."""
        return bool(self.responses())

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        """Number of consecutive frames of a capture that one exposure fills.

        Parameters
        ----------
        single_tap : whether pixels have only one charge store, so that each frame needs an exposure of its own.
        """
        return 1

    def exposure_of_frames(self, single_tap: bool = False) -> np.ndarray:
        """(k,) int, index of the exposure that fills each frame; exposures follow each other from 0.

        A sensor overrides it if the frames of an exposure are not consecutive.

        Parameters
        ----------
        single_tap : see `frames_per_exposure`.
        """
        return np.arange(self.n_frames) // self.frames_per_exposure(single_tap)

    def at_pixels(self, frames: np.ndarray) -> np.ndarray:
        """(k, h, w) float32, W/m2/sr, frames with the fixed errors of each pixel; by default there are none.

        It is called once, with the frames of the whole image.

        Parameters
        ----------
        frames : (k, h, w) float32, W/m2/sr, frames of equal pixels.
        """
        return frames

    # ---- Emitter, detector, decoder ----------------------------------------------------------------------------------

    @property
    @abstractmethod
    def default_emitter(self) -> Emitter:
        """The emitter that this sensor comes with, for instruments that do not state their own."""

    @property
    @abstractmethod
    def default_decoder(self) -> Decoder:
        """The decoder that the sensor comes with."""

    def rigs(self, rig: Rig) -> tuple[Rig, ...]:
        """Rigs of all `n_cameras` cameras of the sensor, which share the emitter; by default the given one alone.

        Parameters
        ----------
        rig : Rig of the reference camera and the emitter. It comes first in the result.
        """
        return (rig,)

    @property
    def default_detector(self) -> PhotoDetector | None:
        """The detector that the sensor comes with, by default an industrial camera; None: frames have no noise."""
        return Detector()

    @property
    def gate(self) -> Gate | None:
        """Time in which photons are counted; None: frames integrate all light of an exposure."""
        return None

    @classmethod
    def presets(cls) -> dict[str, Sensor]:
        """Sensors of this kind by their names on the command line; by default `type_name` with default settings.

        Presets are not inherited: a subclass of a sensor has its own, or the default.
        """
        return {cls.type_name: cls()}

    def for_projector(self, width: int, height: int, axes: Sequence[str] | None = None) -> Sensor:
        """This sensor with a code for a projector of another size. A sensor with such a code overrides this.

        The command line asks for it, because images of a real camera do not say how large the projector was.

        Parameters
        ----------
        width, height : int, pixels of the projector.
        axes : coded axes, some of "columns" and "rows"; None: those of this sensor.

        Raises
        ------
        ValueError
            This sensor has no code, or one that cannot be shown by such a projector.
        """
        raise ValueError(f"expected a sensor whose code has the size of a projector, got {self.type_name}.")

    def patterns(self) -> np.ndarray:
        """(k, height, width) float32 in 0..1: the images that the projector shows. A sensor with some overrides this.

        Raises
        ------
        ValueError
            The sensor's emitter shows no images, or they are not known.
        """
        raise ValueError(f"expected a sensor that knows the images of its projector, got {self.type_name}.")

    def check(self, width: int, height: int) -> None:
        """Raise ValueError if this sensor does not fit a projector of that many pixels."""
        for response in self.responses():
            response.check(width, height)

    # ---- Meaning of its readings -------------------------------------------------------------------------------------

    def white_image(self, frames: np.ndarray) -> np.ndarray:
        """(h, w) image as if under even light, in which calibration finds boards; by default the mean of the frames.

        Parameters
        ----------
        frames : (k, h, w), all frames of a capture.
        """
        return np.asarray(frames.mean(axis=0))

    def is_beyond_range(self, path_length_m: np.ndarray) -> np.ndarray:
        """(...) bool, where the sensor mistakes a path of that length (metres) for another, or does not see it."""
        return np.zeros(np.shape(path_length_m), dtype=bool)

    @property
    def shortest_period_m(self) -> float | None:
        """Metres of range after which the finest signal repeats itself, so that a reading can be off by as much; None
        if no signal repeats itself."""
        return None

    # ---- How it is presented -----------------------------------------------------------------------------------------

    @property
    def title(self) -> str:
        """Name of the sensor in running text."""
        return self.type_name

    @property
    def details(self) -> str:
        """Settings of the sensor in a few words."""
        return f"{self.n_frames} frame{'s' * (self.n_frames != 1)}"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        """Indices of up to three of the captured frames (k, h, w) that show how the sensor works."""
        return sorted({0, self.n_frames // 2, self.n_frames - 1})


S = TypeVar("S", bound=Sensor)


@dataclass(frozen=True)
class Background:
    """Light and noise of each pixel beside the signal, on which the thresholds of decoders depend.

    All values share one unit, `unit`: electrons of an exposure (of a photon counter, its counts) for captures with
    noise, and W/m2/sr for noise-free captures, whose thresholds are fractions of other radiances.

    Parameters
    ----------
    ambient : (h, w) float64, ambient light in a frame that integrates all of it.
    bright : float, light of the emitter in bright pixels, see `rangesim.capture.bright_level`.
    dark : float, mean of a frame without light.
    noise_variance : float, variance of what the detector itself adds to a frame, in electrons squared; None for a
        noise-free capture.

    Examples
    --------
    >>> import numpy as np
    >>> Background(np.zeros((1, 2)), bright=5000.0, noise_variance=16.0).unit
    'electrons'
    >>> noise_free = Background(np.zeros((1, 2)), bright=0.5)
    >>> noise_free.unit, noise_free.floor(0.01)
    ('W/m2/sr', array([[0.005, 0.005]]))
    """

    ambient: np.ndarray
    bright: float
    dark: float = 0.0
    noise_variance: float | None = None

    @property
    def unit(self) -> Literal["electrons", "W/m2/sr"]:
        """Unit of `ambient`, `bright` and `dark`, and of the signals that are compared with them."""
        return "W/m2/sr" if self.noise_variance is None else "electrons"

    def floor(self, fraction: float) -> np.ndarray:
        """(h, w) float64, least signal of a noise-free capture: that fraction of the bright pixels, never 0."""
        return np.full(self.ambient.shape, max(fraction * self.bright, float(np.finfo(np.float32).tiny)))


@dataclass(frozen=True)
class ReceivedLight:
    """Light that the pixels of a capture with noise received, as the closed forms of the noise need it.

    `rangesim.evaluation.closed_forms` makes it from signals; `Decoder.depth_error_m` takes it. Electrons are those of
    one exposure; of a photon counter, they are its counts in all bins together.

    Parameters
    ----------
    emitter : (h, w) float64, electrons, light of the emitter at full power.
    ambient : (h, w) float64, electrons, ambient light that passes the filter.
    own_variance : float, electrons squared, variance that the detector itself adds to a frame, dark current included.
    reading_m : (h, w) float64, metres, true reading: z, or the range of a camera that is no pinhole.
    path_length_m : (h, w) float64, metres, true length of the path from the emitter to the surface and to the camera.
    per_length : (h, w) float64, change of the reading per metre of path length there and back.
    per_column, per_row : (h, w) float64, metres, change of the reading per projector pixel; NaN without such an axis.
    pixel_columns, pixel_rows : (h, w) float64, projector pixels across that a camera's pixel covers; NaN likewise.
    focal_px : float, focal length of the camera in pixels along its rows; NaN if it is no pinhole.
    trials : float, number of pulses of which each can hide later photons; infinite if no photon is hidden.
    """

    emitter: np.ndarray
    ambient: np.ndarray
    own_variance: float
    reading_m: np.ndarray
    path_length_m: np.ndarray
    per_length: np.ndarray
    per_column: np.ndarray
    per_row: np.ndarray
    pixel_columns: np.ndarray
    pixel_rows: np.ndarray
    focal_px: float
    trials: float = math.inf

    def of_pixels(self, where: np.ndarray) -> ReceivedLight:
        """The light of some pixels (h, w) bool alone, as of an image of one row."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: x[where][None] for name, x in values.items() if isinstance(x, np.ndarray)})


class FrameContent(NamedTuple):
    """Light and dark current in the frame, or group of frames, that decides about a reading.

    signal : fraction of the emitter's light at full power. ambient : fraction of the ambient light.
    dark : multiple of the dark electrons of a frame.
    """

    signal: float = 0.5
    ambient: float = 1.0
    dark: float = 1.0


class Decoder(Named, ABC):
    """Makes range images of captures, in two steps: `coordinates` reads the frames, `decode` adds the geometry.

    Subclasses are frozen dataclasses; their fields are thresholds. For each pixel, a decoder may look at as many pixels
    around it as it likes.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.capture import Capture
    >>> from rangesim.sensors import StructuredLight
    >>> sensor = StructuredLight(64, 48)
    >>> seen = sensor.default_decoder.coordinates(Capture(sensor.patterns(), sensor))  # as if the camera saw them flat
    >>> seen.column[0, :3].round(3)
    array([0.5, 1.5, 2.5], dtype=float32)
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in configuration files."""
    reads: ClassVar[type[Sensor]] = Sensor  # type: ignore[type-abstract]
    """Class of the sensors whose captures this decoder accepts."""
    is_lower_bound: ClassVar[bool] = False
    """Whether `depth_error_m` is a bound that no method can surpass, and not the error of this decoder's method."""
    working_range: Any = None
    """A `rangesim.decoding.working_range.WorkingRange`, outside which readings are refused; None: all are kept. A
    decoder with this setting has a field for it."""

    def check(self, sensor: Sensor) -> None:
        """Raise ValueError if this decoder takes no captures of the sensor."""
        of_type(sensor, self.reads)

    @abstractmethod
    def coordinates(self, capture: Capture) -> Coordinates:
        """Readings before any geometry: `ProjectorCoordinates` or `PathLengths`. The rig is not used.

        Raises
        ------
        ValueError
            The capture is of a sensor that this decoder does not know.
        """

    def decode(self, capture: Capture) -> RangeImage:
        """Range image of a capture: its `coordinates`, and the geometry of its rig.

        Raises
        ------
        ValueError
            The capture is of a sensor that this decoder does not know, the sensor does not fit the rig's projector, or
            the working range is along z and the camera has rays that lead sideways or backwards.
        """
        if capture.rig is not None:
            capture.sensor.check(capture.rig.projector.width, capture.rig.projector.height)
            if self.working_range is not None:
                self.working_range.check(capture.rig.camera)
        return self.placed(self.coordinates(capture), capture.rig)

    def placed(self, coordinates: Coordinates, rig: Rig | None) -> RangeImage:
        """Range image of coordinates that this decoder has read, without those outside its working range."""
        image = coordinates.range_image(rig)
        return image if self.working_range is None else self.working_range.applied_to(image)  # type: ignore[no-any-return]

    def pixel_reader(self, sensor: Sensor) -> Callable[[Capture], Coordinates] | None:
        """A function that reads simulated captures of a sensor as `coordinates` does, without checks of the capture as
        a whole; None, the default, if frames or reading of a pixel depend on its place or on other pixels.

        A capture is simulated here if it is noise-free, or if its detector is known. With such a function, some pixels
        can be simulated and read without the others, as a capture of one row. Of the whole image, only the level of the
        bright pixels (`rangesim.capture.bright_level`) may count.
        """
        return None

    @abstractmethod
    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        """(h, w) float64, least light of the emitter at full power that the thresholds accept, in `background.unit`."""

    def depth_error_m(self, sensor: Sensor, light: ReceivedLight) -> np.ndarray | None:
        """(h, w) float64, metres, root mean square error of a correct reading by a closed form; None if there is none.

        It is the error by noise and by quantisation in direct light. It follows from the light alone, and shares no
        code with the estimates that `coordinates` makes from frames.
        """
        return None

    @property
    def reach_px(self) -> int:
        """Pixels around a pixel on which its reading depends, so that a depth edge as far away can spoil it."""
        return 0

    def content(self, sensor: Sensor) -> FrameContent:
        """Light and dark current in the frame that decides about a reading, on average over the patterns."""
        return FrameContent()

    def undetectable(self, sensor: Sensor) -> str | None:
        """A clause on wrong readings of which nothing in a capture tells; None if there are none.

        `rangesim decode` shows it for real captures.
        """
        return None

    def likely_cause(self, capture: Capture, image: RangeImage) -> str | None:
        """A clause with a likely mistake in how the capture was taken, judged by `image`; None if none is known.

        `rangesim decode` shows it, and adds the causes that do not depend on the measuring principle.
        """
        return None


def of_type(sensor: Sensor, kind: type[S]) -> S:
    """The sensor, which has to be of that type; ValueError if it is not.

    Examples
    --------
    >>> from rangesim.sensors import AmcwToF, IdealToF
    >>> of_type(AmcwToF(), IdealToF)
    Traceback (most recent call last):
    ValueError: expected a capture of ideal-tof, got one of amcw-tof.
    """
    if not isinstance(sensor, kind):
        raise ValueError(f"expected a capture of {kind.type_name}, got one of {sensor.type_name}.")
    return sensor


def least_signal_for(sigmas2: float, signal: float, noise_variance: np.ndarray) -> np.ndarray:
    """(h, w) float64, electrons, least S with S^2 = `sigmas2` (`signal` S + `noise_variance`).

    S is the light that equals t standard deviations (`sigmas2` is t^2) of the noise: the shot noise of the fraction
    `signal` of S, and all other noise. The equation is a quadratic with one positive root.

    Parameters
    ----------
    noise_variance : (h, w) float, electrons squared, variance of all other noise.

    Examples
    --------
    >>> import numpy as np
    >>> least_signal_for(5.0**2, 1.0, np.array([[0.0, 144.0]]))
    array([[25. , 73.78825336]])
    """
    half = 0.5 * sigmas2 * signal
    return np.asarray(half + np.sqrt(half**2 + sigmas2 * noise_variance))
