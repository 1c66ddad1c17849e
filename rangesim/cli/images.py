# SPDX-License-Identifier: Apache-2.0
"""Bare images on the command line: the options that say which sensor took them, and how a capture is made of them.

This module knows no sensor by name. A preset or a file names the sensor, and the options change those settings that
the sensor has.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="A setting of the sensor that took bare images, or of its code, as name=value: period_px=18, "
        "convention.start=sin. Repeat the option for several.",
        show_default=False,
    ),
]
BitsOption = Annotated[
    int | None, typer.Option("--bits", help="For bare images: bits of a value, if fewer than the file's, such as 12.")
]


def sensor_of_images(
    own: str | None, code: str | None, projector: str | None, axes: str | None, given: list[str] | None
) -> Sensor | None:
    """The sensor that the options name; None if they name no sensor, or one whose projector has no known size.

    Parameters
    ----------
    own : value of --sensor, FILE.py:NAME. code : value of --code, a preset; None: `IMAGES_PRESET`.
    projector, axes : values of these options; None: not given. given : values of --set.

    Raises
    ------
    ValueError
        The options name no known sensor, or settings that the sensor does not have or refuses.
    """
    from rangesim.sensors import sensor_of
    from rangesim.sensors.registry import IMAGES_PRESET

    if own is not None:
        sensor = _own_sensor(own)
    else:
        sensor, axes = sensor_of(code or IMAGES_PRESET, files_in=None), axes or ALL_AXES
        if projector is None and (sensor.default_emitter.size is not None or code is None):
            return None
    size = sensor.default_emitter.size if projector is None else _size(projector)
    if size is not None and (projector is not None or axes is not None):
        sensor = sensor.for_projector(*size, None if axes is None else [axis.strip() for axis in axes.split(",")])
    return with_settings(sensor, given or [])


def with_settings(sensor: Sensor, given: list[str]) -> Sensor:
    """The sensor with other settings.

    Parameters
    ----------
    given : settings as name=value. A name is that of a field of the sensor, or of a field of its code, with or without
        the name before it: `code.period_px` or `period_px`. A value is written as in TOML; text needs no quotes.

    Raises
    ------
    ValueError
        A setting without =, or that the sensor does not have or refuses.
    """
    from rangesim.settings.config import from_dict, nearest, shown, to_dict

    table = to_dict(sensor)
    for setting in given:
        name, is_there, text = setting.partition("=")
        if not is_there:
            raise ValueError(f"expected --set as name=value, got {shown(setting)}.")
        places = _places(table, name.strip())
        if not places:
            known = [path for path in _paths(table) if not path.endswith("type")]
            raise ValueError(f"{sensor.type_name}: unknown setting {shown(name)}{nearest(name, known)}.")
        if len(places) > 1:
            raise ValueError(f"expected --set with one of {', '.join(places)}, got {shown(name)}.")
        *outer, last = places[0].split(".")
        inner = table
        for key in outer:
            inner = inner[key]
        inner[last] = _toml_value(text.strip())
    return from_dict(type(sensor), table, sensor.type_name) if given else sensor


def _places(table: dict[str, Any], name: str) -> list[str]:
    """Paths of the settings that a name may mean: the whole path if there is one, else all paths that end with it."""
    paths = _paths(table)
    return [name] if name in paths else [path for path in paths if path.endswith(f".{name}")]


def _paths(table: dict[str, Any]) -> list[str]:
    """Dotted paths of all settings in a table of tables."""
    inner = [f"{key}.{path}" for key, value in table.items() if isinstance(value, dict) for path in _paths(value)]
    return [*table, *inner]


def _toml_value(text: str) -> Any:
    """The value that a text stands for in TOML; the text itself if it is no TOML."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


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
