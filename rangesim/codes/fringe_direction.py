# SPDX-License-Identifier: Apache-2.0
"""Direction of fringes: whether their phase grows from pixel to pixel as the Gray code of the same axis does."""

from __future__ import annotations

import math

import numpy as np

from rangesim.codes.axis_code import AxisCode
from rangesim.decoding.phase_shift import phase_of

MIN_PAIRS = 30
"""Least number of pairs of neighbours that tell a direction. If each were a guess, a mean of 0.5 or more would have a
probability of 0.3 %; a larger number would leave out small images."""


def phase_direction(frames: np.ndarray, gray: AxisCode, usable: np.ndarray, period_px: float) -> float:
    """Agreement of phase and Gray code from pixel to pixel: 1 if both grow the same way, -1 if the opposite way.

    It is 0 if too few pairs of neighbours tell. Only neighbours in neighbouring cells are compared. A step of the phase
    has a direction only if it is below half a period. So one of the two pixels must lie in a row of pixels within its
    cell that is too long for pixels half a period apart: two pixels if the cell is at most half a period.

    Parameters
    ----------
    frames : (N, h, w), fringes of one period. gray : AxisCode of the same axis. usable : (h, w) bool, pixels within a
        cell, not on an edge. period_px : float, projector pixels.
    """
    cell = np.where(usable, gray.coordinate / np.float32(gray.cell_px), np.float32(np.nan))
    length = math.ceil(2 * gray.cell_px / period_px - 1e-9) + 1  # (length - 1) steps of half a period leave the cell
    agreement, pairs = 0.0, 0
    for axis in (0, 1):
        # Each row of pixels along the axis: `length` in a cell, and the next pixel in another one; then the other way.
        along, shown = np.moveaxis(cell, axis, -1), np.moveaxis(frames, 1 + axis, -1)
        for ahead, seen in ((along, shown), (along[:, ::-1], shown[..., ::-1])):
            count = ahead.shape[1] - length
            if count <= 0:
                continue
            is_near = np.ones((ahead.shape[0], count), dtype=bool)
            for k in range(1, length):
                is_near &= ahead[:, k : k + count] == ahead[:, :count]
            here, there = length - 1, length
            step = ahead[:, there:] - ahead[:, here : here + count]
            y, x = np.nonzero(is_near & (np.abs(step) == 1))
            turn = phase_of(seen[:, y, x + there]).normalised - phase_of(seen[:, y, x + here]).normalised
            agreement += float((np.sign(turn - np.rint(turn)) * step[y, x]).sum())
            pairs += len(y)
    return agreement / pairs if pairs >= MIN_PAIRS else 0.0
