# SPDX-License-Identifier: Apache-2.0
"""Frames as a camera delivers them: exposure, and their files."""

from rangesim.capture.capture import (
    BRIGHT_PERCENTILE,
    DTYPES,
    Capture,
    bright_level,
)

__all__ = [
    "BRIGHT_PERCENTILE",
    "DTYPES",
    "Capture",
    "bright_level",
]
