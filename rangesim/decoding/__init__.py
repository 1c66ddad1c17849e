# SPDX-License-Identifier: Apache-2.0
"""Decoding: captures to coordinates, and to range images. No decoder needs the scene or the renderer.

The decoders are in `rangesim.sensors`; this package has the steps that they consist of. See docs/decoding.md.
"""

from __future__ import annotations

from dataclasses import replace

from rangesim.capture import Capture, Captured, CaptureSet
from rangesim.decoding.range_image import RangeImage
from rangesim.sensor import Decoder
from rangesim.settings.config import shown

__all__ = ["decode"]

_HINTS = ("expose the signals of all cameras together", "decode each capture of the set by itself")
"""What to do if a capture has too few cameras, and if it has too many."""


def decode(capture: Captured, decoder: Decoder | None = None) -> RangeImage:
    """Range image of a capture (docs/decoding.md).

    Parameters
    ----------
    capture : Capture, simulated or real; of a sensor with several cameras a CaptureSet. The range image is then one of
        the reference camera.
    decoder : Decoder; None: the decoder that the sensor comes with, with the default thresholds.

    Raises
    ------
    ValueError
        The argument is no capture, or a capture of a sensor that the decoder does not know, or has more or fewer
        cameras than the sensor; or the decoder returned something other than a range image of the capture.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.sensors import IdealToF
    >>> frames = np.array([[[0.5, 0.0]], [[1.5, 0.0]]], dtype=np.float32)  # 0.5 W/m2/sr after 3 m, and darkness
    >>> decode(Capture(frames, IdealToF())).range_m
    array([[1.5, nan]], dtype=float32)
    """
    if not isinstance(capture, (Capture, CaptureSet)):
        raise ValueError(f"expected a Capture, as expose, load_capture or import_capture return, got {capture!r}.")
    sensor = capture.sensor
    if len(capture.captures) != sensor.n_cameras:
        raise ValueError(
            f"expected captures of {sensor.n_cameras} camera{'s' * (sensor.n_cameras != 1)} for {sensor.type_name}, "
            f"got {len(capture.captures)}; {_HINTS[sensor.n_cameras == 1]}."
        )
    decoder = decoder or sensor.default_decoder
    decoder.check(sensor)
    image = decoder.decode(capture)  # type: ignore[arg-type]  # decoders of one camera take a Capture
    _check(image, capture.reference, decoder)
    return replace(image, decoder=decoder)


def _check(image: RangeImage, capture: Capture, decoder: Decoder) -> None:
    """Raise ValueError if a decoder returned anything but a range image of the capture."""
    name, shape = type(decoder).__name__, capture.frames.shape[1:]
    if not isinstance(image, RangeImage):
        raise ValueError(f"expected {name} to return a RangeImage, got {shown(image)}.")
    for key, dtype in (("z", "float32"), ("range_m", "float32"), ("confidence", "float32"), ("status", "uint8")):
        values = getattr(image, key)
        if values.shape != shape or values.dtype.name != dtype:
            raise ValueError(
                f"expected {name} to return {key} of shape {shape} and type {dtype}, "
                f"got {values.shape} and {values.dtype}."
            )
    if not image.is_consistent:
        raise ValueError(f"expected {name} to return z where status is OK, and NaN everywhere else.")
