# SPDX-License-Identifier: Apache-2.0
"""Bits of a code with inverse patterns to numbers, and to projector coordinates."""

from __future__ import annotations

import numpy as np

from rangesim.capture import Capture
from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.contrast import difference_noise
from rangesim.codes.thresholds import GrayThresholds
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status

CELL_SIGMA = 12**-0.5
"""Standard deviation of a place that is known to lie in a cell, in cells: that of an even distribution."""


def decode_gray(seen: AxisFrames, cell_px: int, thresholds: GrayThresholds) -> AxisCode:
    """Projector coordinate of each pixel from Gray bits.

    A bit is the sign of pattern - inverse; it is uncertain where the noise is larger than the difference. A pixel on
    the edge of a stripe has one uncertain bit, which does no harm if a flip of it leads to a neighbouring cell: the
    function then returns the edge between the two cells. It refuses all other pixels with uncertain bits.

    Parameters
    ----------
    seen : frames (2 b, h, w), each pattern followed by its inverse, most significant bit first.
    cell_px : int, projector pixels per cell of the code.
    """
    capture, contrast = seen.capture, seen.contrast
    coordinate = np.empty(contrast.values.shape, dtype=np.float32)
    status = np.zeros(contrast.values.shape, dtype=np.uint8)
    for rows in bands(len(status)):
        code, uncertain = _classify(capture, seen.frames[:, rows], contrast.values[rows], thresholds)
        low, high = binary_of_gray(code), binary_of_gray(code ^ uncertain)
        on_edge = (uncertain & (uncertain - 1) == 0) & (np.abs(low - high) <= 1)
        coordinate[rows] = (0.5 * (low + high) + 0.5) * cell_px
        status[rows][coordinate[rows] >= seen.size + cell_px / 2] = Status.CODE_ERROR
        failed = ~contrast.is_enough[rows] | ~on_edge
        status[rows][failed] = Status.LOW_SIGNAL
        status[rows][failed & capture.saturated(capture.frames[:, rows])] = Status.SATURATED
    sigma_px = np.broadcast_to(np.float32(CELL_SIGMA * cell_px), status.shape)
    return AxisCode(coordinate, status, cell_px, sigma_px)


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
    """Least |pattern - inverse| of a certain bit, in the capture's units."""
    noise = difference_noise(capture, pattern, inverse)
    if noise is not None:
        return np.maximum(thresholds.bit_sigmas * noise, thresholds.relative_bit * contrast)
    if capture.is_digital:
        return thresholds.bit_of_scale * capture.full_scale
    return thresholds.relative_bit * contrast


def binary_of_gray(gray: np.ndarray) -> np.ndarray:
    """Numbers whose Gray codes are `gray` (integers of up to 32 bits): the running exclusive or from the top bit.

    Examples
    --------
    >>> import numpy as np
    >>> binary_of_gray(np.array([0b000, 0b001, 0b011, 0b010, 0b110]))
    array([0, 1, 2, 3, 4])
    """
    result = gray.copy()
    for step in (16, 8, 4, 2, 1):
        result ^= result >> step
    return result
