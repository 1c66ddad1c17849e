# SPDX-License-Identifier: Apache-2.0
"""Stereo of one camera and a stored reference image of the projector's dots, as in the first Kinect; its decoder.

The reference image is what the camera sees of the dots on a plane at a known distance z0. On a surface at the distance
z, each dot has moved along the baseline by d = f b (1 / z - 1 / z0) pixels, where f is the focal length and b the
distance of camera and projector; so z = 1 / (1 / z0 + d / (f b)). A projector shows on every plane what a camera in its
place would see of it. The reference image is therefore the pattern itself, moved by f b / z0, and the matcher of two
cameras serves: the projector takes the place of the second camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, ClassVar

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.disparities import Disparities, ImageNoise, match_capture
from rangesim.decoding.working_range import WorkingRange
from rangesim.geometry.dense_stereo import DenseMatching
from rangesim.geometry.stereo import rectify
from rangesim.response import DenseResponse, Dots, LightPath, NumpyMath, Response
from rangesim.rig import Intrinsics, Rig
from rangesim.sensor import Background, Decoder, Emitter, FrameContent, Sensor, of_type
from rangesim.sensors.active_stereo import (
    Disparity,
    described,
    least_light,
    pattern_of,
    quantised,
    shown_image,
    size_of,
)
from rangesim.settings.bounds import Bounds, Metres, check_fields

SAMPLES = 4
"""Number of places along each side of a pixel of the reference image at which the pattern is read. With 4, dots of a
standard deviation of 0.3 pixels keep their places to 0.01 pixel."""


@dataclass(frozen=True)
class ReferencePatternStereo(Sensor):
    """A camera that finds the dots of a projector in a stored image of them.

    The camera takes one frame, `infrared`. Surfaces need no texture of their own, but where no dots arrive, nothing is
    read.

    Parameters
    ----------
    pattern : `rangesim.response.Dots`, or `Images` of one image.
    baseline_m : distance of camera and projector in metres, for instruments that state no rig of their own.

    Examples
    --------
    >>> ReferencePatternStereo().details
    'a camera 75 mm beside a projector of 8560 dots'
    """

    pattern: Response = field(default_factory=lambda: Dots(640, 480))
    baseline_m: Metres = 0.075

    type_name: ClassVar[str] = "reference-pattern"
    triangulates: ClassVar[bool] = True
    compares_texture: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_fields(self)
        pattern_of(self.pattern)

    def responses(self) -> tuple[Response, ...]:
        return (self.pattern,)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        return np.asarray(channels[0] + ambient, dtype=np.float32)

    def patterns(self) -> np.ndarray:
        """(1, height, width) float32 in 0..1, the dots as a video projector in the place of the laser shows them."""
        return shown_image(pattern_of(self.pattern))

    def frame_names(self) -> list[str]:
        return ["infrared"]

    def for_projector(self, width: int, height: int, axes: Sequence[str] | None = None) -> ReferencePatternStereo:
        """This sensor with dots for a projector of another size. `axes` mean nothing to dots.

        Raises
        ------
        ValueError
            The pattern is an image of another size.
        """
        if isinstance(self.pattern, Dots):
            return replace(self, pattern=replace(self.pattern, width=width, height=height))
        self.check(width, height)
        return self

    @property
    def default_emitter(self) -> Emitter:
        return Emitter(size_of(pattern_of(self.pattern)), self.baseline_m)

    @property
    def default_decoder(self) -> ReferencePatternDecoder:
        return ReferencePatternDecoder()

    @property
    def title(self) -> str:
        return "Dots against a reference image"

    @property
    def details(self) -> str:
        return f"a camera {1e3 * self.baseline_m:g} mm beside a projector of {described(pattern_of(self.pattern))}"


@dataclass(frozen=True)
class ReferencePatternDecoder(Decoder):
    """Matches the camera's image with the stored image of the dots, and triangulates with the projector.

    Status as of `StereoDecoder`; a pixel is OCCLUDED if the dots that it would see are hidden from the projector.

    Parameters
    ----------
    matching : DenseMatching, the matcher and its checks.
    least_px, disparities : least disparity f b / z in rectified pixels, and the number of pixels above it that are
        searched.
    step_px : disparities against the reference image are rounded to multiples of this, pixels; 0: they are not. The
        first Kinect has steps of 1/8 pixel (Khoshelham and Elberink, Sensors 12, 2012, give them as 11 bits).
    reference_m : distance of the plane of the reference image, metres, from which the steps count.
    noise : ImageNoise, where the detector is not known.
    working_range : WorkingRange, outside which readings are refused; None: all are kept.

    Examples
    --------
    >>> ReferencePatternDecoder(step_px=0.125).reference_m
    1.0
    """

    matching: DenseMatching = field(default_factory=DenseMatching)
    least_px: Disparity = 0.0
    disparities: Annotated[int, Bounds("a number of disparities", 2, 4096)] = 128
    step_px: Annotated[float, Bounds("pixels", 0, 16)] = 0.0
    reference_m: Metres = 1.0
    noise: ImageNoise = field(default_factory=ImageNoise)
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "reference-pattern"
    reads: ClassVar[type[Sensor]] = ReferencePatternStereo

    def __post_init__(self) -> None:
        check_fields(self)

    def coordinates(self, capture: Capture) -> Disparities:
        """Disparities of the camera's pixels against the projector's; the rig of the capture makes the reference image.

        Raises
        ------
        ValueError
            The capture has no rig, or its projector or camera is no pinhole.
        """
        sensor = of_type(capture.sensor, ReferencePatternStereo)
        if capture.rig is None:
            raise ValueError("expected a capture with a rig: the reference image depends on camera and projector.")
        pattern = pattern_of(sensor.pattern)
        assert pattern is not None
        seen_by = projector_as_camera(capture.rig)
        pair = rectify(capture.rig.pinhole, seen_by, np.linalg.inv(capture.rig.T_camera_projector))
        image = reference_image(pattern, capture.rig.image_projector, seen_by)
        searched = self.least_px, self.least_px + self.disparities
        noise = np.zeros_like(image)
        found = match_capture(capture, image, noise, pair, searched, self.matching, self.noise)
        return quantised(found, self.step_px, float(pair.parallel.disparity(self.reference_m)))

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        """Least light whose dots locate a match to `matching.max_sigma_px`, see `StereoDecoder.least_signal`."""
        pattern = of_type(sensor, ReferencePatternStereo).pattern
        return least_light(pattern, self.matching, self.noise, background, images=1)

    @property
    def reach_px(self) -> int:
        return self.matching.reach

    def content(self, sensor: Sensor) -> FrameContent:
        return FrameContent(signal=1.0)


def projector_as_camera(rig: Rig) -> Intrinsics:
    """Intrinsics of a camera in the place of the projector, with its field of view and pixels as fine as the camera's.

    Examples
    --------
    >>> rig = Rig(Intrinsics.from_fov(320, 240, 50.0), Intrinsics.from_fov(640, 480, 50.0))
    >>> projector_as_camera(rig).width
    320
    """
    projector = rig.image_projector
    scale = rig.pinhole.fx / projector.fx
    size = (max(2, round(scale * n)) for n in (projector.width, projector.height))
    return projector.resized(*size)


@lru_cache(maxsize=4)  # a device stores it once, and a report decodes several times
def reference_image(pattern: DenseResponse, projector: Intrinsics, seen_by: Intrinsics) -> np.ndarray:
    """(h, w) float32, mean of a pattern over each pixel of a camera in the projector's place; NaN beyond the pattern.

    projector : the projector that shows the pattern. seen_by : intrinsics of the camera, see `projector_as_camera`.
    """
    total = np.zeros((seen_by.height, seen_by.width))
    places = seen_by.pixel_centres()
    for i, j in np.ndindex(SAMPLES, SAMPLES):
        offset = (np.array([i, j]) + 0.5) / SAMPLES - 0.5
        uv = projector.project(seen_by.directions(places + offset))
        inside = (uv >= 0).all(axis=-1) & (uv <= [projector.width, projector.height]).all(axis=-1)
        u, v = (np.where(inside, uv[..., n], 0.0) for n in (0, 1))
        (weight,) = pattern.weights(LightPath(u, v, np.zeros_like(u), True), NumpyMath())
        total += np.where(inside, weight, np.nan) / SAMPLES**2
    return total.astype(np.float32)
