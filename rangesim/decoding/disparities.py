# SPDX-License-Identifier: Apache-2.0
"""Disparities of two images of one texture, and the range image that a rectified pair makes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.coordinates import Coordinates
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.geometry.dense_stereo import DenseMatch, DenseMatching, MatchOutcome, match_densely
from rangesim.geometry.stereo import RectifiedPair
from rangesim.sensor import Threshold
from rangesim.settings.bounds import check_fields

if TYPE_CHECKING:
    from rangesim.rig import Rig

SAME_PLACE_PX = 1e-3
"""Distance of a camera's pixel from the centre of a rectified pixel, in pixels, below which it takes that pixel's
disparity as it is. Along a slope of one pixel per pixel the disparity then errs by as much, far below its noise."""
MAX_SPAN_PX = 1.0
"""Largest difference of four neighbouring disparities, in pixels, between which a disparity is interpolated. On a
slope, neighbours differ by less. Across a depth edge they differ by more; the nearest one is taken there, because a
value in between is the depth of no surface."""
MOSTLY_SATURATED = 0.25
"""Fraction of a window, from 0 to 1. If more of it is saturated, a failed match gets the status SATURATED. A few bright
dots may saturate without harm, so it is not near 0."""
STATUS_OF = {
    MatchOutcome.MATCHED: Status.OK,
    MatchOutcome.NO_TEXTURE: Status.LOW_SIGNAL,
    MatchOutcome.OCCLUDED: Status.OCCLUDED,
    MatchOutcome.AMBIGUOUS: Status.AMBIGUOUS,
    MatchOutcome.OUT_OF_RANGE: Status.OUT_OF_RANGE,
    MatchOutcome.NO_IMAGE: Status.LOW_SIGNAL,
}
"""Status of a pixel by the outcome of its match."""


@dataclass(frozen=True)
class ImageNoise:
    """Noise that a matcher assumes where no detector states it.

    Parameters
    ----------
    of_scale : fraction of full scale, standard deviation of each pixel in digital captures of unknown detectors. The
        default is one step of 8 bits.
    relative : fraction of the bright pixels, in noise-free captures. The default keeps readings in a hundredth of the
        light, and refuses texture that is fainter than the scatter of the renderer.

    Examples
    --------
    >>> ImageNoise().relative
    0.002
    """

    of_scale: Threshold = 1 / 255
    relative: Threshold = 0.002

    def __post_init__(self) -> None:
        check_fields(self)

    def of(self, capture: Capture, frame: np.ndarray) -> np.ndarray:
        """(h, w) float32, standard deviation of the noise of a frame (h, w) of a capture, in the frame's unit."""
        noise = capture.noise(frame)
        if noise is None:
            level = self.of_scale * capture.full_scale if capture.is_digital else self.relative * bright_level(frame)
            return np.full(frame.shape, level, dtype=np.float32)
        return np.asarray(np.broadcast_to(noise, frame.shape), dtype=np.float32)

    def mean_image(self, capture: Capture) -> tuple[np.ndarray, np.ndarray]:
        """Mean frame of a capture above its black level, (h, w) float32, and the standard deviation of its noise,
        (h, w) float, in the frame's unit. Masked pixels of the mean are NaN."""
        mean = capture.frames.mean(axis=0, dtype=np.float32)
        return mean - np.float32(capture.black_level), self.of(capture, mean) / np.sqrt(len(capture.frames))


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Disparities(Coordinates):
    """Disparities d = x - x' of the pixels of the reference camera.

    Parameters
    ----------
    disparity_px : (h, w) float32, rectified pixels; NaN where `status` is not OK.
    sigma_px : (h, w) float32, rectified pixels, standard deviation of `disparity_px` by the noise of the images.
    pair : RectifiedPair whose first camera is the reference; None: no geometry is known.

    Examples
    --------
    >>> one = np.ones((1, 2))
    >>> found = Disparities(
    ...     disparity_px=np.array([[10.0, 11.0]]), sigma_px=0.1 * one, status=np.array([[0, 6]]), confidence=one,
    ...     intensity=one, pair=None,
    ... )
    >>> found.disparity_px
    array([[10., nan]], dtype=float32)
    """

    disparity_px: np.ndarray
    sigma_px: np.ndarray
    pair: RectifiedPair | None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("disparity_px", "sigma_px"):
            self._keep_valid(name, np.float32)

    def range_image(self, rig: Rig | None) -> RangeImage:
        """Range image of these disparities in the reference camera.

        Parameters
        ----------
        rig : Rig of the reference camera; None: z is NaN everywhere.
        """
        z = np.full(self.status.shape, np.nan, dtype=np.float32)
        range_m, status = z.copy(), self.status.copy()
        if rig is not None and self.pair is not None:
            directions = rig.pinhole.directions(rig.pinhole.pixel_centres())
            # Depth of the rectified camera per depth of the real one
            along = directions @ self.pair.R_rectified_first[2]
            depth = self.pair.parallel.depth(self.disparity_px) / along
            z = np.where(depth > 0, depth, np.nan).astype(np.float32)
            status[self.valid & ~np.isfinite(z)] = Status.OUT_OF_RANGE
            z[status != Status.OK] = np.nan
            range_m = (z * np.linalg.norm(directions, axis=-1)).astype(np.float32)
        return self._image(rig, z, range_m, status)

    def depth_error_m(self, image: RangeImage) -> np.ndarray:
        """(h, w) float64, metres, standard deviation of z by the noise of the images: z^2 sigma / (f b).

        image : the range image of these disparities.
        """
        if self.pair is None:
            return np.full(self.status.shape, np.nan)
        return self.pair.parallel.depth_error(image.z, self.sigma_px)


def match_capture(
    capture: Capture,
    other_image: np.ndarray,
    other_noise: np.ndarray,
    pair: RectifiedPair | None,
    disparities_px: tuple[float, float],
    matching: DenseMatching,
    noise: ImageNoise,
) -> Disparities:
    """Disparities of the pixels of a capture against another image.

    Parameters
    ----------
    capture : Capture of the reference camera, whose mean frame is matched.
    other_image, other_noise : image of the second camera, and the standard deviation of its noise in the image's unit;
        (h, w) float each. They are as this camera sees them, and are rectified here.
    pair : RectifiedPair; None: both images are rectified already.
    disparities_px : least and largest disparity, rectified pixels.
    """
    frame, own_noise = noise.mean_image(capture)
    if pair is None:
        rectified, noises = (frame, other_image), (own_noise, other_noise)
    else:
        rectified = pair.warp(frame, other_image, "spline")
        noises = tuple(np.nan_to_num(n) for n in pair.warp(own_noise, other_noise))  # type: ignore[assignment]
    width = rectified[0].shape[1]
    least = disparities_px[0]
    largest = min(disparities_px[1], least + width - 1)
    found = match_densely(*rectified, (least, largest), matching, noises)
    found = found if pair is None else at_real_pixels(found, pair)
    status = np.zeros(frame.shape, dtype=np.uint8)
    for outcome, meaning in STATUS_OF.items():
        status[found.outcome == outcome] = meaning
    contrast, is_saturated = _window_statistics(capture, frame, matching.window_px)
    status[(status != Status.OK) & is_saturated] = Status.SATURATED
    return Disparities(
        disparity_px=found.disparity_px,
        sigma_px=found.sigma_px,
        pair=pair,
        status=status,
        confidence=np.nan_to_num(2 * contrast / np.float32(capture.full_scale)),
        intensity=frame,
    )


def at_real_pixels(found: DenseMatch, pair: RectifiedPair) -> DenseMatch:
    """Disparities at the pixels of the real first camera: interpolated between four neighbours on one surface, and
    those of the nearest rectified pixel elsewhere."""
    places = pair.pixels_of_first(pair.first.pixel_centres()) - 0.5
    height, width = found.outcome.shape
    known = np.isfinite(places).all(axis=-1)
    x, y = (np.where(known, places[..., i], 0.0) for i in (0, 1))
    near_x, near_y = np.rint(x).astype(int).clip(0, width - 1), np.rint(y).astype(int).clip(0, height - 1)
    disparity, sigma = found.disparity_px[near_y, near_x].copy(), found.sigma_px[near_y, near_x].copy()
    outcome = found.outcome[near_y, near_x].copy()
    outcome[~known] = MatchOutcome.NO_IMAGE
    left, top = np.floor(x).astype(int).clip(0, max(width - 2, 0)), np.floor(y).astype(int).clip(0, max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)
    four = np.stack([found.disparity_px[row, column] for row in (top, bottom) for column in (left, right)])
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    apart = np.maximum(np.abs(x - near_x), np.abs(y - near_y)) > SAME_PLACE_PX
    with np.errstate(invalid="ignore"):
        smooth = apart & (outcome == MatchOutcome.MATCHED) & (np.ptp(four, axis=0) <= MAX_SPAN_PX)
    disparity[smooth] = (weights * four).sum(axis=0)[smooth]
    wrong = outcome != MatchOutcome.MATCHED
    disparity[wrong], sigma[wrong] = np.nan, np.nan
    return DenseMatch(disparity, sigma, outcome)


def _window_statistics(capture: Capture, frame: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) standard deviation of the frame in the window around each pixel, and whether the window is saturated."""
    from scipy.ndimage import uniform_filter

    values = np.nan_to_num(frame.astype(np.float64))
    mean = uniform_filter(values, side)
    variance = np.maximum(uniform_filter(values**2, side) - mean**2, 0)
    full = uniform_filter(capture.saturated(capture.frames).astype(np.float32), side)
    return np.sqrt(variance), np.asarray(full > MOSTLY_SATURATED)
