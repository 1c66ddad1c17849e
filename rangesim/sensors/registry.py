# SPDX-License-Identifier: Apache-2.0
"""Which sensors there are: those of the package, and those of files that a user names."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

from rangesim.errors import FileFormatError
from rangesim.sensor import Sensor
from rangesim.settings.config import brief, from_dict, named_subclasses, nearest, shown

_SEPARATOR = ".py:"


def presets() -> dict[str, Sensor]:
    """Sensors by the names that stand for them on the command line, of all classes that are loaded."""
    return {name: sensor for kind in _kinds() for name, sensor in kind.presets().items()}


def sensor_of(name: str, files_in: Path | None = Path()) -> Sensor:
    """The sensor of a preset's name, or of FILE.py:NAME, a sensor or class of sensors in a Python file.

    Loading a file runs it, so only name files that you trust. Its classes are known from then on, in captures and
    results too.

    Parameters
    ----------
    files_in : folder from which a relative FILE counts; None: no file is loaded.

    Raises
    ------
    ValueError
        No such preset; the message names the nearest one.
    FileFormatError
        The file is missing or fails, or NAME is no sensor.
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

    Parameters
    ----------
    files_in : as for `sensor_of`; the default loads no file, for what is read back from captures and results.

    Raises
    ------
    ValueError
        An unknown name or type, or settings that the sensor refuses; the message names the place.
    """
    try:
        if isinstance(data, str):
            return sensor_of(data, files_in)
        if isinstance(data, Mapping):
            given = data.get("type")
            if files_in is not None and isinstance(given, str) and is_file_name(given):
                data = {**data, "type": sensor_of(given, files_in).type_name}
            elif isinstance(given, str) and given not in (types := [k.type_name for k in _kinds()]):
                raise ValueError(
                    f"expected 'type' to be one of {', '.join(types)}, got {shown(given)}{nearest(given, types)}; "
                    "a sensor of your own is known once its file is named, as in --sensor FILE.py:NAME."
                )
    except (FileFormatError, ValueError) as error:
        raise ValueError(f"{place}: {error}") from error
    return from_dict(Sensor, data, place)  # type: ignore[type-abstract]


def is_file_name(name: str) -> bool:
    """Whether this is FILE.py:NAME."""
    return _SEPARATOR in name


def _kinds() -> list[type[Sensor]]:
    """All classes of sensors that are loaded."""
    return list(named_subclasses(Sensor))  # type: ignore[type-abstract]


def _sensor_in(path: Path, attribute: str) -> Sensor:
    found = getattr(_module(path), attribute, None)
    if isinstance(found, Sensor):
        return found
    if not (isinstance(found, type) and issubclass(found, Sensor)):
        raise FileFormatError(f"{path}: expected {attribute} to be a sensor or a class of sensors, got {shown(found)}.")
    try:
        return found()
    except TypeError as error:  # abstract, or arguments without default
        raise FileFormatError(f"{path}: {attribute} cannot be made without arguments: {brief(error)}.") from error


@cache
def _module(path: Path) -> ModuleType:
    """The module of a file, which runs once."""
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected a Python file with a sensor.")
    name = f"_rangesim_file_{path.stem}_{crc32(bytes(path)):x}"
    spec = spec_from_file_location(name, path)
    assert spec is not None, path  # a .py file has one
    assert spec.loader is not None, path
    module = module_from_spec(spec)
    before = {kind.type_name for kind in _kinds()}
    sys.modules[name] = module  # dataclasses look their own module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise FileFormatError(f"{path} fails: {type(error).__name__}: {brief(error)}.") from error
    for kind in _kinds():
        if kind.__module__ == name and kind.type_name in before:
            raise FileFormatError(f"{path}: the type_name {kind.type_name!r} of {kind.__name__} is taken.")
    return module
