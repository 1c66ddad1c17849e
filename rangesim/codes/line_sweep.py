# SPDX-License-Identifier: Apache-2.0
"""Line sweep: one bright line that moves over the projector; a pixel is where the line was when it was brightest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.zncc_matching import correlation_contradiction
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields

FAR = 4.0
"""Distance from the brightest line, in standard deviations of a line, from which on another peak is another place. A
line is below 4e-4 of its peak there, and below 0.14 if it is twice as wide, out of focus."""

MAX_SECOND = 0.5
"""Largest brightness of the second peak as a fraction of the first. With more, either may be the direct light."""

MIN_WIDTH = 0.7
"""Least measured width of a line as a fraction of the width shown. Defocus only widens a line; a narrower one has a
frame in a wrong place."""

MIN_FRACTION = 1e-3
"""Least fraction of the peak that counts for the frames beside it, and of full scale that counts for the peak, so that
logarithms stay finite."""


@dataclass(frozen=True)
class LineSweep(Code):
    """A line of Gaussian profile, shown at equal steps from one step before the first pixel to one after the last.

    The logarithm of a Gaussian is a parabola, so three frames around the peak tell its place to a fraction of a pixel,
    also when a defocused lens has widened the line. Light of interreflection makes a peak of its own in other frames.

    Parameters
    ----------
    line_px : float, standard deviation of the line, projector pixels.
    step_px : float, distance from one line to the next, projector pixels; at most twice `line_px`.

    References
    ----------
    - Curless, Levoy: "Better optical triangulation through spacetime analysis", ICCV (1995): the time of the peak.
    - Fisher, Naidu: "A comparison of algorithms for subpixel peak detection" (1996): the logarithms of three values.

    Examples
    --------
    >>> LineSweep(step_px=4.0).names(8)
    ['line0', 'line1', 'line2', 'line3', 'line4']
    """

    line_px: Annotated[float, Bounds("projector pixels", 0.5, 1e4)] = 6.0
    step_px: Annotated[float, Bounds("projector pixels", 0.5, 1e4)] = 8.0

    type_name: ClassVar[str] = "line-sweep"
    title: ClassVar[str] = "Structured light (line sweep)"

    def __post_init__(self) -> None:
        check_fields(self)
        if self.step_px > 2 * self.line_px:
            raise ValueError(
                f"expected step_px to be at most twice line_px, got {self.step_px:g} and {self.line_px:g}."
            )

    def check(self, size: int) -> None:
        limits.check("frames", self.n_lines(size), "lines")

    def n_lines(self, size: int) -> int:
        """Number of lines."""
        return math.ceil(size / self.step_px) + 3

    def places(self, size: int) -> np.ndarray:
        """(n,) float64, projector pixels, centres of the lines."""
        return (np.arange(self.n_lines(size)) - 1) * self.step_px

    def names(self, size: int) -> list[str]:
        return [f"line{k}" for k in range(self.n_lines(size))]

    def patterns(self, size: int) -> np.ndarray:
        x = np.arange(size) + 0.5
        return np.exp(-0.5 * ((x - self.places(size)[:, None]) / self.line_px) ** 2).astype(np.float32)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        capture, gray = seen.capture, thresholds.gray
        coordinate = np.empty(seen.contrast.values.shape, dtype=np.float32)
        status = np.zeros(coordinate.shape, dtype=np.uint8)
        sigma_px = None if capture.noise(seen.frames[0, :1]) is None else np.empty_like(coordinate)
        for rows in bands(len(status)):
            black, contrast = seen.contrast.black[rows].astype(np.float32), seen.contrast.values[rows]
            peak = np.clip(seen.frames[:, rows].argmax(axis=0), 1, len(seen.frames) - 2)
            beside = [_at(seen.frames[:, rows], peak + side) for side in (-1, 0, 1)]
            before, top, after = (value - black for value in beside)
            least = MIN_FRACTION * np.maximum(top, np.float32(MIN_FRACTION * capture.full_scale))
            a, b, c = (np.log(np.maximum(value, least)) for value in (before, top, after))
            bend = np.minimum(a - 2 * b + c, np.float32(-1e-6))
            coordinate[rows] = self.step_px * (peak - 1 + 0.5 * (a - c) / bend)
            second = _largest_far_from(seen.frames[:, rows], peak, math.ceil(FAR * self.line_px / self.step_px))
            second = second - black
            failed = status[rows]
            narrowest = (self.step_px / (MIN_WIDTH * self.line_px)) ** 2
            failed[(second > MAX_SECOND * top) | (-bend > narrowest) | (top < np.maximum(before, after))] = (
                Status.CODE_ERROR
            )
            weak = ~seen.contrast.is_enough[rows] | ~(top >= gray.relative_bit * contrast)
            if sigma_px is not None:
                noises = [np.asarray(capture.noise(value)) for value in beside]
                of_a, of_b, of_c = (n / np.maximum(v, least) for n, v in zip(noises, (before, top, after), strict=True))
                by_a, by_c, by_b = (bend - (a - c)), (bend + (a - c)), 2 * (a - c)
                spread = np.sqrt((by_a * of_a) ** 2 + (by_b * of_b) ** 2 + (by_c * of_c) ** 2)
                sigma_px[rows] = 0.5 * self.step_px * spread / bend**2
                weak |= ~(sigma_px[rows] < self.step_px / 2) | (top < gray.bit_sigmas * noises[1])
            elif capture.is_digital:
                weak |= top < gray.bit_of_scale * capture.full_scale
            failed[weak] = Status.LOW_SIGNAL
            failed[capture.saturated(seen.frames[:, rows])] = Status.SATURATED
        return AxisCode(coordinate, status, 1.0, sigma_px)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return correlation_contradiction(seen, self.patterns(seen.size))

    @property
    def details(self) -> str:
        return f"line of {self.line_px:g} px that moves by {self.step_px:g} px"


def _at(frames: np.ndarray, index: np.ndarray) -> np.ndarray:
    """(h, w) float32, the value of each pixel in the frame of that index (h, w)."""
    return np.take_along_axis(frames, index[None], axis=0)[0].astype(np.float32)


def _largest_far_from(frames: np.ndarray, peak: np.ndarray, distance: int) -> np.ndarray:
    """(h, w) float32, largest value of each pixel in frames more than `distance` from its peak; -inf: none."""
    result = np.full(peak.shape, -np.inf, dtype=np.float32)
    for k, frame in enumerate(frames):
        is_far = np.abs(peak - k) > distance
        np.maximum(result, frame, out=result, where=is_far, casting="unsafe")
    return result
