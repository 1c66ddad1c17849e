# SPDX-License-Identifier: Apache-2.0
"""Captures: the frames that a camera delivers, and the exposure that makes them from signals."""

from rangesim.capture.capture import (
    BRIGHT_PERCENTILE,
    DTYPES,
    Capture,
    bright_level,
)
from rangesim.capture.capture_set import Captured, CaptureSet, together

__all__ = [
    "BRIGHT_PERCENTILE",
    "DTYPES",
    "Capture",
    "CaptureSet",
    "Captured",
    "bright_level",
    "together",
]
