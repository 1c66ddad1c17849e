# SPDX-License-Identifier: Apache-2.0
"""Captures to range images. No decoder needs the scene or the renderer."""

from __future__ import annotations

from rangesim.capture import Capture
from rangesim.decoding.range_image import RangeImage
from rangesim.sensor import Decoder

__all__ = ["decode"]


def decode(capture: Capture, decoder: Decoder | None = None) -> RangeImage:
    """Range image of a capture (docs/decoding.md).

    Parameters
    ----------
    decoder : Decoder; None: the one its sensor comes with, with the default thresholds.

    Raises
    ------
    ValueError
        Not a capture, or one of a sensor that the decoder does not know.
    """
    if not isinstance(capture, Capture):
        raise ValueError(f"expected a Capture, as expose, load_capture or import_capture return, got {capture!r}.")
    return (decoder or capture.sensor.default_decoder).decode(capture)
