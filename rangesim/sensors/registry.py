# SPDX-License-Identifier: Apache-2.0
"""Registry of sensors: those of the package, and those of files that a user names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pcgraph.plumbing.python_files import module_of_file, place_of_failure
from rangesim.codes import Code
from rangesim.errors import FileFormatError
from rangesim.sensor import Decoder, Sensor
from rangesim.sensors.structured_light import StructuredLight
from rangesim.settings.config import Named, brief, from_dict, nearest, shown, to_dict

IMAGES_PRESET = "gray"
"""Preset of the sensor for a folder of bare images if the user names none: the code of OpenCV's GrayCodePattern."""

_SEPARATOR = ".py:"
"""Mark between the two parts of FILE.py:NAME."""

_FRAME_NAME = re.compile(r"[\w.+-]+")
"""Names of frames that are safe in the names of files on every system."""


def presets() -> dict[str, Sensor]:
    """Sensors of all classes that are loaded, by their names on the command line.

    Examples
    --------
    >>> sorted(set(presets()) & {"gray", "gray-phase", "amcw", "direct-tof", "ideal-tof"})
    ['amcw', 'direct-tof', 'gray', 'gray-phase', 'ideal-tof']
    """
    found: dict[str, Sensor] = {}
    for kind in Sensor.known.values():
        for name, sensor in _presets_of(kind).items():
            found.setdefault(name, sensor)
    return found


def _presets_of(kind: type[Sensor]) -> dict[str, Sensor]:
    """Presets of one class; none if the class cannot be made without settings."""
    if "presets" in vars(kind):
        return kind.presets()
    try:
        return {kind.type_name: kind()}
    except Exception:  # noqa: BLE001  (a user's class without default settings; naming it raises the error)
        return {}


def sensor_of(name: str, files_in: Path | None = Path()) -> Sensor:
    """The sensor that a name stands for: a preset, or FILE.py:NAME for a sensor, a code or a class in a Python file.

    Loading a file runs it, so only name files that you trust. Its classes are known from then on, in captures and
    results too. A file that has changed is loaded again.

    Parameters
    ----------
    name : name of a preset, or FILE.py:NAME. files_in : folder to which a relative FILE refers; None: no file is
        loaded.

    Raises
    ------
    ValueError
        No such preset; the message names the nearest one.
    FileFormatError
        The file is missing or fails, or NAME is no sensor and no code.

    Examples
    --------
    >>> sensor_of("gray").code
    GrayCode(cell_px=1, words_shown='first')
    >>> sensor_of("grey", files_in=None)
    Traceback (most recent call last):
    ValueError: expected a sensor out of ..., got 'grey' (did you mean 'gray'?).
    """
    if files_in is not None and is_file_name(name):
        path, _, attribute = name.rpartition(":")
        return _sensor_in((files_in / path).resolve(), attribute)
    known = presets()
    if name not in known:
        raise ValueError(
            f"expected a sensor out of {', '.join(known)}, or FILE.py:NAME for one of your own, "
            f"got {shown(name)}{nearest(name, known)}."
        )
    return known[name]


def sensor_from_dict(data: Any, place: str, files_in: Path | None = None) -> Sensor:
    """The sensor of plain data: a name as for `sensor_of`, or a table whose `type` is a `type_name` or FILE.py:NAME.

    A table changes settings of the class, or of the sensor if NAME is a sensor.

    Parameters
    ----------
    data : str, or mapping of settings. place : name of the place in the file, for messages.
    files_in : as for `sensor_of`; the default loads no file, as is right for data from captures and results.

    Raises
    ------
    ValueError
        An unknown name or type, or settings that the sensor refuses; the message names the place.

    Examples
    --------
    >>> sensor_from_dict({"type": "amcw-tof", "contrast": 0.5}, "instrument[0].sensor").contrast
    0.5
    """
    try:
        if isinstance(data, str):
            return sensor_of(data, files_in)
        if isinstance(data, Mapping):
            given = data.get("type")
            if files_in is not None and isinstance(given, str) and is_file_name(given):
                named = to_dict(sensor_of(given, files_in))
                data = {**named, **data, "type": named["type"]}
            elif isinstance(given, str) and given not in Sensor.known:
                raise ValueError(
                    f"expected 'type' to be one of {', '.join(Sensor.known)}, got {shown(given)}"
                    f"{nearest(given, Sensor.known)}; a sensor of your own is known once its file is named, as in "
                    "--sensor FILE.py:NAME."
                )
    except (FileFormatError, ValueError) as error:
        raise ValueError(f"{place}: {error}") from error
    return from_dict(Sensor, data, place)  # type: ignore[type-abstract]


def is_file_name(name: str) -> bool:
    """Whether the name is of the form FILE.py:NAME.

    Examples
    --------
    >>> is_file_name("own_code.py:TriangleWaves"), is_file_name("gray")
    (True, False)
    """
    return _SEPARATOR in name


def check_sensor(sensor: Sensor) -> None:
    """Raise ValueError if a user's own sensor breaks a rule that all sensors keep.

    Files and records need these rules: a `type_name`, frozen dataclasses, and frame names that can be names of files.

    Examples
    --------
    >>> from rangesim.sensors import IdealToF
    >>> check_sensor(IdealToF())
    """
    kind = type(sensor)
    if not getattr(kind, "type_name", ""):
        raise ValueError(f"expected {kind.__name__} to have a type_name.")
    for thing in (sensor, sensor.default_decoder):
        if not (is_dataclass(thing) and type(thing).__dataclass_params__.frozen):
            raise ValueError(f"expected {type(thing).__name__} to be a frozen dataclass.")
    if not isinstance(sensor.default_decoder, Decoder):
        raise ValueError(f"expected the default_decoder of {kind.__name__} to be a Decoder.")
    names = sensor.frame_names()
    if wrong := [name for name in names if not _FRAME_NAME.fullmatch(name)]:
        raise ValueError(f"expected frame_names of letters, digits, _ . + and -, as for files, got {shown(wrong[0])}.")
    if sensor.gate is not None and sensor.gate.bins != len(names):
        raise ValueError(f"expected the gate of {kind.__name__} to have {len(names)} bins, got {sensor.gate.bins}.")


def _sensor_in(path: Path, attribute: str) -> Sensor:
    """The sensor of that name in a Python file. If the name is a class, its sensor with the default settings."""
    found = getattr(_module(path), attribute, None)
    try:
        if isinstance(found, type) and issubclass(found, (Sensor, Code)):
            found = found()
        if isinstance(found, Code):
            found = StructuredLight(code=found)
        if isinstance(found, Sensor):
            check_sensor(found)
            return found
    except Exception as error:  # a file of a user may raise anything
        raise FileFormatError(f"{path}: {attribute}: {type(error).__name__}: {brief(error)}") from error
    raise FileFormatError(
        f"{path}: expected {attribute} to be a sensor, a code or a class of them, got {shown(found)}."
    )


def _module(path: Path) -> ModuleType:
    """The module of a file. The file runs once, and again when it has changed."""
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected a Python file with a sensor.")
    before = [(family, dict(family.known)) for family in Named.families()]
    try:
        return module_of_file(path, "rangesim")
    except (Exception, SystemExit) as error:
        for family, known in before:
            family.known.clear()
            family.known.update(known)
        raise FileFormatError(
            f"{place_of_failure(error) or path} fails: {type(error).__name__}: {brief(error)}"
        ) from error
