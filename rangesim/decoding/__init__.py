# SPDX-License-Identifier: Apache-2.0
"""Captures to range images. No decoder needs the scene or the renderer."""

from __future__ import annotations

from collections.abc import Callable

from rangesim.capture import Capture
from rangesim.decoding.amcw import decode_amcw
from rangesim.decoding.histogram import decode_direct
from rangesim.decoding.path_length import decode_ideal
from rangesim.decoding.structured_light import decode_structured_light
from rangesim.range_image import RangeImage
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight

__all__ = ["DECODERS", "decode"]

DECODERS: dict[type[Sensor], Callable[[Capture], RangeImage]] = {
    StructuredLight: decode_structured_light,
    IdealToF: decode_ideal,
    AmcwToF: decode_amcw,
    DirectToF: decode_direct,
}
"""The decoder of each kind of sensor; a sensor of your own adds its own here."""


def decode(capture: Capture) -> RangeImage:
    """Range image of a capture, by the decoder of its sensor with the default thresholds (see docs/decoding.md).

    Raises
    ------
    ValueError
        Not a capture, or there is no decoder for this kind of sensor.
    """
    if not isinstance(capture, Capture):
        raise ValueError(f"expected a Capture, as expose, load_capture or import_capture return, got {capture!r}.")
    decoder = DECODERS.get(type(capture.sensor))
    if decoder is None:
        known = ", ".join(kind.__name__ for kind in DECODERS)
        raise ValueError(
            f"expected a capture of {known}, got one of {type(capture.sensor).__name__}; add it to DECODERS."
        )
    return decoder(capture)
