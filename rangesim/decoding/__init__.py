# SPDX-License-Identifier: Apache-2.0
"""Captures to range images. No decoder needs the scene or the renderer."""

from __future__ import annotations

from rangesim.capture import Capture
from rangesim.range_image import RangeImage

__all__ = ["decode"]


def decode(capture: Capture) -> RangeImage:
    """Range image of a capture, by the decoder of its sensor with the default thresholds (see docs/decoding.md)."""
    return capture.sensor.decode(capture)
