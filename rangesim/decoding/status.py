# SPDX-License-Identifier: Apache-2.0
"""Status of a pixel: measured, or the reason why not."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Outcome of a decoder for one pixel. If the value is not `OK`, the range image has NaN at the pixel.

    Examples
    --------
    >>> import numpy as np
    >>> np.array([[0, 2]], dtype=np.uint8) == Status.SATURATED
    array([[False,  True]])
    """

    OK = 0
    LOW_SIGNAL = 1
    """Modulation too weak against the noise or the quantisation to be decoded."""
    SATURATED = 2
    """At least one frame is at full well, at the largest digital number, or at the level where an unknown camera
    clips."""
    CODE_ERROR = 3
    """Codes contradict each other, leave the projector, or violate the epipolar geometry."""
    UNWRAPPING_FAILED = 4
    """The phases of several frequencies do not agree on one distance."""
    OUT_OF_RANGE = 5
    """The sensor cannot measure the decoded distance: it lies behind the sensor, or beyond its limits."""
    OCCLUDED = 6
    """The second camera of a pair does not see the point."""
    AMBIGUOUS = 7
    """Several places fit equally well, or two ways to match images disagree."""
