# SPDX-License-Identifier: Apache-2.0
"""Gray code with inverse patterns: frames to projector coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.bands import bands
from rangesim.status import Status

WHITE_BLACK_SHARE = 40 / 255
PATTERN_INVERSE_SHARE = 5 / 255
"""OpenCV's thresholds on white - black and |pattern - inverse|, of full scale: for digital captures of an
unknown detector, where the noise is not known."""
CONTRAST_SIGMAS = 5.0
BIT_SIGMAS = 3.0
"""The same in standard deviations of the difference, where the detector is known."""
RELATIVE_CONTRAST = 1e-4
"""Least white - black of noise-free captures, as a share of that of the bright pixels."""
RELATIVE_BIT = 0.1
"""Least |pattern - inverse| as a share of the pixel's white - black, unless the detector is unknown: pixels in shadow
that see the patterns by interreflection alone show fine stripes fainter than that, at whatever exposure."""


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


def direct_contrast(capture: Capture) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) float32 white - black in the capture's units, and (h, w) bool where it is strong enough to decode."""
    white, black = capture.frames[-2].astype(np.float32), capture.frames[-1].astype(np.float32)
    contrast = white - black
    noise = _difference_noise(capture, white, black)
    if noise is not None:
        threshold: np.ndarray | float = CONTRAST_SIGMAS * noise
    elif capture.is_digital:
        threshold = WHITE_BLACK_SHARE * capture.full_scale
    else:
        threshold = RELATIVE_CONTRAST * bright_level(contrast)
    return contrast, np.asarray(contrast > threshold)


def decode_gray(capture: Capture, frames: np.ndarray, shift: int, size: int) -> GrayCode:
    """Projector coordinate of each pixel from Gray bits.

    A bit is the sign of pattern - inverse; it is uncertain where the difference drowns in noise. One
    uncertain bit is what a pixel on a stripe edge shows, and does no harm if flipping it leads to a
    neighbouring cell: then the edge between the two is returned. Anything else is refused.

    Parameters
    ----------
    frames : (2 b, h, w), pattern and inverse by turns, most significant bit first.
    shift : int, finest bits left out. size : int, projector pixels along the axis.
    """
    contrast, bright = direct_contrast(capture)
    cell = 1 << shift
    coordinate, status = np.empty(contrast.shape, dtype=np.float32), np.zeros(contrast.shape, dtype=np.uint8)
    for rows in bands(len(contrast)):
        code, uncertain = _classify(capture, frames[:, rows], contrast[rows])
        low, high = _binary(code), _binary(code ^ uncertain)
        on_edge = (uncertain & (uncertain - 1) == 0) & (np.abs(low - high) <= 1)
        coordinate[rows] = (0.5 * (low + high) + 0.5) * cell
        status[rows][coordinate[rows] >= size + cell / 2] = Status.CODE_ERROR
        failed = ~bright[rows] | ~on_edge
        status[rows][failed] = Status.LOW_SIGNAL
        status[rows][failed & capture.saturated(capture.frames[:, rows])] = Status.SATURATED
    return GrayCode(coordinate, status, cell)


def _classify(capture: Capture, frames: np.ndarray, contrast: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) int32 each: the code, and the set of its bits that are uncertain."""
    code = np.zeros(contrast.shape, dtype=np.int32)
    uncertain = np.zeros_like(code)
    for pattern, inverse in zip(frames[0::2], frames[1::2], strict=True):
        pattern, inverse = pattern.astype(np.float32), inverse.astype(np.float32)
        difference = pattern - inverse
        code = (code << 1) | (difference > 0)
        threshold = _bit_threshold(capture, pattern, inverse, contrast)
        uncertain = (uncertain << 1) | (np.abs(difference) < threshold)
    return code, uncertain


def _bit_threshold(
    capture: Capture, pattern: np.ndarray, inverse: np.ndarray, contrast: np.ndarray
) -> np.ndarray | float:
    noise = _difference_noise(capture, pattern, inverse)
    if noise is not None:
        return np.maximum(BIT_SIGMAS * noise, RELATIVE_BIT * contrast)
    if capture.is_digital:
        return PATTERN_INVERSE_SHARE * capture.full_scale
    return RELATIVE_BIT * contrast


def _difference_noise(capture: Capture, a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    noise_a, noise_b = capture.noise(a), capture.noise(b)
    return None if noise_a is None or noise_b is None else np.sqrt(noise_a**2 + noise_b**2)


def _binary(gray: np.ndarray) -> np.ndarray:
    """Number whose Gray code is `gray` (up to 32 bits): the running exclusive or of its bits from the top."""
    result = gray.copy()
    for step in (16, 8, 4, 2, 1):
        result ^= result >> step
    return result
