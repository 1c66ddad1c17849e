# SPDX-License-Identifier: Apache-2.0
"""Gray code with inverse patterns: frames to projector coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.settings.bounds import Bounds, check_fields

Threshold = Annotated[float, Bounds("0 or positive", 0, 1e6)]


@dataclass(frozen=True)
class GrayThresholds:
    """Least differences of frames that count.

    Where the detector is known, they are multiples of the noise; in digital captures of an unknown one, fractions of
    full scale, as OpenCV's; in noise-free captures, fractions of brightness.

    contrast_sigmas, bit_sigmas : of white - black and of pattern - inverse, in standard deviations of the difference.
    contrast_of_scale, bit_of_scale : the same as fractions of full scale, for digital captures of unknown detectors.
    relative_contrast : white - black of noise-free captures, as a fraction of that of the bright pixels.
    relative_bit : pattern - inverse as a fraction of the pixel's white - black, unless the detector is unknown: pixels
        in shadow that see the patterns by interreflection alone show fine stripes fainter than that, at whatever
        exposure.
    """

    contrast_sigmas: Threshold = 5.0
    bit_sigmas: Threshold = 3.0
    contrast_of_scale: Threshold = 40 / 255
    bit_of_scale: Threshold = 5 / 255
    relative_contrast: Threshold = 1e-4
    relative_bit: Threshold = 0.1

    def __post_init__(self) -> None:
        check_fields(self)


class Contrast(NamedTuple):
    """values : (h, w) float32, white - black in the capture's units. is_enough : (h, w) bool."""

    values: np.ndarray
    is_enough: np.ndarray


@dataclass(frozen=True, eq=False)
class GrayCode:
    """Decoded Gray code along one axis.

    coordinate : (h, w) float32, projector pixels: centre of the cell, or its edge where the camera pixel lies
        on it.
    status : (h, w) uint8, `Status`.
    cell_px : int, size of a cell, projector pixels (1, or coarser where a phase follows).
    """

    coordinate: np.ndarray
    status: np.ndarray
    cell_px: int


def direct_contrast(capture: Capture, white: np.ndarray, black: np.ndarray, thresholds: GrayThresholds) -> Contrast:
    """White - black of frames (h, w) of a capture, and where it is enough to decode."""
    white, black = white.astype(np.float32), black.astype(np.float32)
    contrast = white - black
    noise = _difference_noise(capture, white, black)
    if noise is not None:
        least: np.ndarray | float = thresholds.contrast_sigmas * noise
    elif capture.is_digital:
        least = thresholds.contrast_of_scale * capture.full_scale
    else:
        least = thresholds.relative_contrast * bright_level(contrast)
    return Contrast(contrast, np.asarray(contrast > least))


def decode_gray(
    capture: Capture, frames: np.ndarray, shift: int, size: int, contrast: Contrast, thresholds: GrayThresholds
) -> GrayCode:
    """Projector coordinate of each pixel from Gray bits.

    A bit is the sign of pattern - inverse; it is uncertain where the difference drowns in noise. One
    uncertain bit is what a pixel on a stripe edge shows, and does no harm if flipping it leads to a
    neighbouring cell: then the edge between the two is returned. Anything else is refused.

    Parameters
    ----------
    frames : (2 b, h, w), pattern and inverse by turns, most significant bit first.
    shift : int, finest bits left out. size : int, projector pixels along the axis.
    contrast : of the same capture.
    """
    cell = 1 << shift
    coordinate, status = (
        np.empty(contrast.values.shape, dtype=np.float32),
        np.zeros(contrast.values.shape, dtype=np.uint8),
    )
    for rows in bands(len(status)):
        code, uncertain = _classify(capture, frames[:, rows], contrast.values[rows], thresholds)
        low, high = binary_of_gray(code), binary_of_gray(code ^ uncertain)
        on_edge = (uncertain & (uncertain - 1) == 0) & (np.abs(low - high) <= 1)
        coordinate[rows] = (0.5 * (low + high) + 0.5) * cell
        status[rows][coordinate[rows] >= size + cell / 2] = Status.CODE_ERROR
        failed = ~contrast.is_enough[rows] | ~on_edge
        status[rows][failed] = Status.LOW_SIGNAL
        status[rows][failed & capture.saturated(capture.frames[:, rows])] = Status.SATURATED
    return GrayCode(coordinate, status, cell)


def _classify(
    capture: Capture, frames: np.ndarray, contrast: np.ndarray, thresholds: GrayThresholds
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) int32 each: the code, and the set of its bits that are uncertain."""
    code = np.zeros(contrast.shape, dtype=np.int32)
    uncertain = np.zeros_like(code)
    for pattern, inverse in zip(frames[0::2], frames[1::2], strict=True):
        pattern, inverse = pattern.astype(np.float32), inverse.astype(np.float32)
        difference = pattern - inverse
        code = (code << 1) | (difference > 0)
        least = _least_bit(capture, pattern, inverse, contrast, thresholds)
        uncertain = (uncertain << 1) | (np.abs(difference) < least)
    return code, uncertain


def _least_bit(
    capture: Capture, pattern: np.ndarray, inverse: np.ndarray, contrast: np.ndarray, thresholds: GrayThresholds
) -> np.ndarray | float:
    noise = _difference_noise(capture, pattern, inverse)
    if noise is not None:
        return np.maximum(thresholds.bit_sigmas * noise, thresholds.relative_bit * contrast)
    if capture.is_digital:
        return thresholds.bit_of_scale * capture.full_scale
    return thresholds.relative_bit * contrast


def _difference_noise(capture: Capture, a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    noise_a, noise_b = capture.noise(a), capture.noise(b)
    return None if noise_a is None or noise_b is None else np.sqrt(noise_a**2 + noise_b**2)


def binary_of_gray(gray: np.ndarray) -> np.ndarray:
    """Number whose Gray code is `gray` (up to 32 bits): the running exclusive or of its bits from the top."""
    result = gray.copy()
    for step in (16, 8, 4, 2, 1):
        result ^= result >> step
    return result
