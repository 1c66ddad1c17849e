# SPDX-License-Identifier: Apache-2.0
"""Stereo: two cameras that look at dots of a projector or at room light, and its decoder, which knows no pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np

from rangesim.capture import Capture, CaptureSet
from rangesim.decoding.disparities import Disparities, ImageNoise, match_capture
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.working_range import WorkingRange
from rangesim.geometry.dense_stereo import DenseMatching
from rangesim.geometry.stereo import rectify
from rangesim.response import DenseResponse, Dots, Images, Response
from rangesim.response.patterns import image_of
from rangesim.rig import translation
from rangesim.sensor import Background, Decoder, Emitter, FrameContent, ReceivedLight, Sensor, least_signal_for, of_type
from rangesim.settings.bounds import Bounds, Metres, check_fields

if TYPE_CHECKING:
    from rangesim.rig import Rig

ROUNDING_VARIANCE = 1 / 12
"""Variance of an even distribution over one step, in squared steps: that of the error of rounding."""

Disparity = Annotated[float, Bounds("pixels", -1e5, 1e5)]
"""A disparity in rectified pixels; the bounds exclude nonsense."""


def pattern_of(response: Response | None) -> DenseResponse | None:
    """The pattern of a stereo sensor, checked: one image of dots.

    Raises
    ------
    ValueError
        It is neither Dots nor Images of one image.
    """
    if response is None:
        return None
    if not isinstance(response, (Dots, Images)) or response.channels != 1:
        raise ValueError(f"expected the pattern as Dots, as Images of one image, or None, got {response!r}.")
    return response


def size_of(pattern: DenseResponse | None) -> tuple[int, int] | None:
    """(width, height) of the projector that shows a pattern, pixels; None: any."""
    if isinstance(pattern, Images):
        return pattern.patterns.shape[2], pattern.patterns.shape[1]
    return (pattern.width, pattern.height) if isinstance(pattern, Dots) else None


def shown_image(pattern: DenseResponse | None) -> np.ndarray:
    """(1, height, width) float32 in 0..1, a pattern at the centres of the projector's pixels, its brightest dot at 1.

    Raises
    ------
    ValueError
        There is no pattern.
    """
    size = size_of(pattern)
    if pattern is None or size is None:
        raise ValueError("expected a sensor with a pattern, got passive stereo, whose emitter is off.")
    image = image_of(pattern, *size)[:1]
    return np.asarray(image / max(float(image.max()), np.finfo(np.float32).tiny), dtype=np.float32)


@lru_cache(maxsize=16)  # a report asks for each pixel's budget several times
def texture_of(pattern: DenseResponse | None) -> float:
    """Mean square of the change of a pattern from one projector pixel to the next, per square of its mean; 0 if there
    is no pattern."""
    size = size_of(pattern)
    if pattern is None or size is None:
        return 0.0
    (image,) = image_of(pattern, *size)
    return float(np.mean(np.diff(image, axis=1) ** 2) / max(float(image.mean()) ** 2, 1e-30)) if size[0] > 1 else 0.0


@dataclass(frozen=True)
class ActiveStereo(Sensor):
    """Two cameras side by side, and a projector that shows one pattern of dots, which no decoder knows.

    Each camera takes one frame, `infrared`. The second camera stands `baseline_m` to the right of the first one, and
    looks the same way. Room light and sunlight add to the dots; where surfaces have texture, they help.

    Parameters
    ----------
    pattern : `rangesim.response.Dots`, or `Images` of one image; None: passive stereo, the emitter is off.
    baseline_m : distance of the cameras in metres, for instruments that state no rigs of their own.

    Examples
    --------
    >>> sensor = ActiveStereo(baseline_m=0.05)
    >>> sensor.n_cameras, sensor.frame_names(), sensor.details
    (2, ['infrared'], '2 cameras 50 mm apart, 7169 dots')
    """

    pattern: Response | None = field(default_factory=lambda: Dots(640, 400))
    baseline_m: Metres = 0.05

    type_name: ClassVar[str] = "active-stereo"
    triangulates: ClassVar[bool] = True
    n_cameras: ClassVar[int] = 2
    compares_texture: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_fields(self)
        pattern_of(self.pattern)

    def responses(self) -> tuple[Response, ...]:
        return () if self.pattern is None else (self.pattern,)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        light = channels[0] if len(channels) else np.zeros_like(ambient)[None]
        return np.asarray(light + ambient, dtype=np.float32)

    def patterns(self) -> np.ndarray:
        return shown_image(pattern_of(self.pattern))

    def frame_names(self) -> list[str]:
        return ["infrared"]

    def rigs(self, rig: Rig) -> tuple[Rig, ...]:
        return rig, rig.with_camera(translation(self.baseline_m, 0.0, 0.0))

    @property
    def default_emitter(self) -> Emitter:
        """A projector half-way between the cameras."""
        return Emitter(size_of(pattern_of(self.pattern)), self.baseline_m / 2)

    @property
    def default_decoder(self) -> StereoDecoder:
        return StereoDecoder()

    @classmethod
    def presets(cls) -> dict[str, Sensor]:
        return {"active-stereo": cls(), "passive-stereo": cls(pattern=None)}

    @property
    def title(self) -> str:
        return "Passive stereo" if self.pattern is None else "Active stereo"

    @property
    def details(self) -> str:
        apart = f"2 cameras {1e3 * self.baseline_m:g} mm apart"
        return f"{apart}, {described(pattern_of(self.pattern))}"


def described(pattern: DenseResponse | None) -> str:
    """A pattern in a few words."""
    if pattern is None:
        return "no pattern"
    return f"{pattern.number} dots" if isinstance(pattern, Dots) else "a pattern of its own"


@dataclass(frozen=True)
class StereoDecoder(Decoder):
    """Matches the images of two cameras along their epipolar lines, and triangulates.

    The images are rectified by the geometry of the rigs, distortion included. Readings are those of the first camera.
    A pixel without a reading has the status LOW_SIGNAL (its window shows no texture that the noise allows to locate),
    OCCLUDED, AMBIGUOUS, OUT_OF_RANGE or SATURATED. Captures without rigs count as rectified; they have disparities,
    but no depths.

    Parameters
    ----------
    matching : DenseMatching, the matcher and its checks.
    least_px, disparities : least disparity in rectified pixels, and the number of pixels above it that are searched. A
        surface at the depth f b / (least + disparities) is the nearest one that can be read.
    step_px : disparities are rounded to multiples of this, pixels; 0: they are not. Real devices have steps of 1/8 to
        1/32 pixel.
    noise : ImageNoise, where the detector is not known.
    working_range : WorkingRange, outside which readings are refused; None: all are kept.

    Examples
    --------
    >>> StereoDecoder(matching=DenseMatching(method="opencv"), disparities=64).step_px
    0.0
    """

    matching: DenseMatching = field(default_factory=DenseMatching)
    least_px: Disparity = 0.0
    disparities: Annotated[int, Bounds("a number of disparities", 2, 4096)] = 128
    step_px: Annotated[float, Bounds("pixels", 0, 16)] = 0.0
    noise: ImageNoise = field(default_factory=ImageNoise)
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "stereo"
    reads: ClassVar[type[Sensor]] = ActiveStereo

    def __post_init__(self) -> None:
        check_fields(self)

    def coordinates(self, capture: CaptureSet) -> Disparities:  # type: ignore[override]  # of two cameras
        """Disparities of the first camera's pixels, from captures of two cameras."""
        of_type(capture.sensor, ActiveStereo)
        first, second = pair_of(capture)
        pair = None
        if first.rig is not None and second.rig is not None:
            T_second_first = np.linalg.inv(second.rig.T_world_camera) @ first.rig.T_world_camera
            pair = rectify(first.rig.pinhole, second.rig.pinhole, T_second_first)
        image, noise = self.noise.mean_image(second)
        searched = self.least_px, self.least_px + self.disparities
        found = match_capture(first, image, noise, pair, searched, self.matching, self.noise)
        return quantised(found, self.step_px)

    def decode(self, capture: CaptureSet) -> RangeImage:  # type: ignore[override]  # of two cameras
        """Range image of the first camera, from captures of two cameras."""
        image = self.coordinates(capture).range_image(capture.reference.rig)
        return image if self.working_range is None else self.working_range.applied_to(image)

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        """Least light whose dots locate a match to `matching.max_sigma_px`, if a camera's pixel is as wide as a
        projector's. A passive sensor needs no light of the emitter."""
        return least_light(of_type(sensor, ActiveStereo).pattern, self.matching, self.noise, background, images=2)

    is_lower_bound: ClassVar[bool] = True

    def depth_error_m(self, sensor: Sensor, light: ReceivedLight) -> np.ndarray | None:
        """The Cramér-Rao bound of a match, z^2 / (f b) sigma_d: the texture of the dots in a window against the noise
        of two images, sigma_d^2 = 2 variance / (pixels * texture * light^2); None for passive stereo.

        It takes a camera's pixel to be as wide as a projector's. Matchers draw disparities to whole pixels and round
        them, so they stay above.
        """
        stereo = of_type(sensor, ActiveStereo)
        texture = texture_of(pattern_of(stereo.pattern))
        if not texture:
            return None
        variance = 2 * (light.emitter + light.ambient + light.own_variance)
        with np.errstate(divide="ignore"):
            disparity_px = np.sqrt(variance / texture) / (self.matching.window_px * light.emitter)
        return np.asarray(light.reading_m**2 / (light.focal_px * stereo.baseline_m) * disparity_px)

    @property
    def reach_px(self) -> int:
        return self.matching.reach

    def content(self, sensor: Sensor) -> FrameContent:
        return FrameContent(signal=1.0)


def pair_of(capture: CaptureSet) -> tuple[Capture, Capture]:
    """Both captures of a set of two; ValueError if they are not two, or not rectified and of different size."""
    if not isinstance(capture, CaptureSet) or len(capture.captures) != 2:
        raise ValueError(f"expected a CaptureSet of two cameras, got {capture!r}.")
    first, second = capture.captures
    if first.rig is None and first.frames.shape != second.frames.shape:
        raise ValueError(
            f"expected rigs, or rectified images of one size, got {first.frames.shape[1:]} and "
            f"{second.frames.shape[1:]}."
        )
    return first, second


def quantised(found: Disparities, step_px: float, from_px: float = 0.0) -> Disparities:
    """The disparities rounded to multiples of a step, counted from `from_px`; a step of 0 leaves them as they are.

    Rounding adds step^2 / 12 to their variance.
    """
    if not step_px:
        return found
    rounded = np.rint((found.disparity_px - from_px) / step_px) * step_px + from_px
    sigma = np.sqrt(found.sigma_px**2 + step_px**2 * ROUNDING_VARIANCE)
    return replace(found, disparity_px=rounded, sigma_px=sigma)


def least_light(
    pattern: Response | None, matching: DenseMatching, noise: ImageNoise, background: Background, images: int
) -> np.ndarray:
    """(h, w) float64, least light of the emitter, in `background.unit`, with which a window of the pattern is located
    to `matching.max_sigma_px`: sigma^2 = images * variance / (pixels * texture * light^2).

    images : number of images with noise, 1 or 2.
    """
    texture = texture_of(pattern_of(pattern))
    shape = background.ambient.shape
    if not texture:
        return np.zeros(shape)
    sigmas2 = images / (matching.window_px**2 * texture * matching.max_sigma_px**2)
    if background.noise_variance is None:
        return np.full(shape, np.sqrt(sigmas2) * noise.relative * background.bright)
    return least_signal_for(sigmas2, 1.0, background.ambient + background.noise_variance)
