# SPDX-License-Identifier: Apache-2.0
"""Why a pixel has, or has not, a measurement."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Per-pixel outcome of a decoder. Every value but `OK` goes with NaN in the range image."""

    OK = 0
    LOW_SIGNAL = 1
    """Modulation too weak against the noise or the quantisation to be decoded."""
    SATURATED = 2
    """At least one frame is at full well, at the largest digital number, or where an unknown camera clips."""
    CODE_ERROR = 3
    """Codes contradict each other, leave the projector, or violate the epipolar geometry."""
    UNWRAPPING_FAILED = 4
    """The phases of several frequencies agree on no common distance."""
    OUT_OF_RANGE = 5
    """A distance was decoded that the sensor cannot measure (behind it, or beyond its limits)."""
