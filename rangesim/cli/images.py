# SPDX-License-Identifier: Apache-2.0
"""Bare images on the command line: the options that say which sensor took them, and how a capture is made of them.

This module knows no sensor by name. A preset or a file names the sensor, and the options change those settings that
the sensor has.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rangesim.capture import Capture, Captured
    from rangesim.sensor import Sensor

ALL_AXES = "columns,rows"
"""Axes that bare images of a preset code unless an option says otherwise: both, as in OpenCV's stack of patterns."""

SensorOption = Annotated[
    str | None,
    typer.Option(
        "--sensor", help="Sensor of your own that took it, as FILE.py:NAME; the file is run.", show_default=False
    ),
]
CodeOption = Annotated[
    str | None,
    typer.Option(
        "--code",
        help="For bare images: preset of the sensor that took them.",
        show_default="the code of OpenCV's patterns",
    ),
]
ProjectorOption = Annotated[
    str | None, typer.Option("--projector", help="For bare images: projector pixels, for example 1024x768.")
]
AxesOption = Annotated[
    str | None,
    typer.Option(
        "--axes",
        help="For bare images: coded axes, columns, rows, or both as columns,rows.",
        show_default=f"{ALL_AXES}, or those of --sensor",
    ),
]
PeriodOption = Annotated[
    float | None,
    typer.Option(
        "--period", help="For bare images with fringes: their period, projector pixels.", show_default="the sensor's"
    ),
]
StepsOption = Annotated[
    int | None,
    typer.Option("--steps", help="For bare images with fringes: phase steps per axis.", show_default="the sensor's"),
]
BitsOption = Annotated[
    int | None, typer.Option("--bits", help="For bare images: bits of a value, if fewer than the file's, such as 12.")
]


def sensor_of_images(
    own: str | None, code: str | None, projector: str | None, axes: str | None, period: float | None, steps: int | None
) -> Sensor | None:
    """The sensor that the options name; None if they name no sensor, or one whose projector has no known size.

    Parameters
    ----------
    own : value of --sensor, FILE.py:NAME. code : value of --code, a preset; None: `IMAGES_PRESET`.
    projector, axes, period, steps : values of these options; None: not given.

    Raises
    ------
    ValueError
        The options name no known sensor, or settings that the sensor does not have or refuses.
    """
    from rangesim.sensors import sensor_of
    from rangesim.sensors.registry import IMAGES_PRESET
    from rangesim.settings.config import from_dict, to_dict

    if own is not None:
        sensor = _own_sensor(own)
    else:
        sensor, axes = sensor_of(code or IMAGES_PRESET, files_in=None), axes or ALL_AXES
        if projector is None and (sensor.default_emitter.size is not None or code is None):
            return None
    size = sensor.default_emitter.size if projector is None else _size(projector)
    if size is not None and (projector is not None or axes is not None):
        sensor = sensor.for_projector(*size, None if axes is None else [axis.strip() for axis in axes.split(",")])
    given = {name: value for name, value in (("period_px", period), ("steps", steps)) if value is not None}
    if not given:
        return sensor
    return from_dict(type(sensor), {**to_dict(sensor), **given}, sensor.type_name)


def _own_sensor(name: str) -> Sensor:
    """The sensor of FILE.py:NAME."""
    from rangesim.sensors import is_file_name, sensor_of
    from rangesim.settings.config import shown

    if not is_file_name(name):
        raise ValueError(f"expected --sensor as FILE.py:NAME, got {shown(name)}; a capture itself names its sensor.")
    return sensor_of(name)


def _size(projector: str) -> tuple[int, int]:
    """(width, height) in pixels of an option such as 1024x768."""
    from rangesim.settings.config import shown

    size = re.fullmatch(r"(\d+)[x×](\d+)", projector)
    if not size:
        raise ValueError(f"expected --projector as WIDTHxHEIGHT in pixels, such as 1024x768, got {shown(projector)}.")
    return int(size[1]), int(size[2])


def load_frames(folder: Path, sensor: Sensor | None, bits: int | None) -> Captured:
    """The capture of a directory with a sidecar, or of bare images; a directory may hold those of several cameras.

    Parameters
    ----------
    sensor : Sensor that took bare images; None: not known. bits : bits of their values, if fewer than those of the
        file.
    """
    from rangesim.errors import FileFormatError
    from rangesim.results.captures import SIDECAR, import_capture, load_capture

    if not folder.is_dir():
        raise FileFormatError(f"{folder} is no directory; expected a capture or a folder of images.")
    if (folder / SIDECAR).is_file():
        return load_capture(folder)
    if sensor is None:
        raise ValueError(
            f"{folder} has no {SIDECAR}, so it holds bare images: expected --projector WIDTHxHEIGHT as well, or "
            "--sensor FILE.py:NAME."
        )
    loaded = import_capture(folder, sensor)
    return loaded if bits is None else _full_scale(loaded, bits)


def _full_scale(capture: Capture, bits: int) -> Capture:
    """The capture with digital numbers of `bits` stretched to all bits of its type, so that white is white."""
    import numpy as np

    dtype = capture.frames.dtype
    if not capture.is_digital or not 1 <= bits <= 8 * dtype.itemsize:
        raise ValueError(f"expected --bits of 1 to {8 * dtype.itemsize} for {dtype} images, got {bits}.")
    if int(capture.frames.max()) >= 2**bits:
        raise ValueError(f"expected digital numbers below {2**bits} for --bits {bits}, got {capture.frames.max()}.")
    stretch = np.iinfo(dtype).max / (2**bits - 1)
    return replace(capture, frames=np.rint(capture.frames * stretch).astype(dtype))
