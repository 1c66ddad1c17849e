# SPDX-License-Identifier: Apache-2.0
"""Instruments by name: devices that people have, and sensors alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from rangesim.instrument import instrument as instruments
from rangesim.instrument.instrument import Instrument, name_of
from rangesim.presets.preset import Preset, read_preset
from rangesim.sensors import is_file_name, sensor_of
from rangesim.sensors import presets as sensor_presets
from rangesim.settings.config import check_keys, nearest, on_top_of, shown, to_dict

FOLDER = Path(__file__).resolve().parent / "devices"
"""Folder with the files of the devices that come with the package."""

SUFFIX = ".toml"
"""Suffix of a file of a device; a name with this suffix is the path of such a file."""

DEFAULT_SENSORS = ("gray-phase", "amcw", "ideal-tof")
"""Sensors that an experiment compares if none are given: structured light, time of flight, and the ideal ranger, which
no time-of-flight camera can surpass."""


def names() -> tuple[str, ...]:
    """Names of the devices that come with the package, in alphabetical order.

    Examples
    --------
    >>> "kinect-v2" in names()
    True
    """
    return tuple(sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}")))


def describe(name: str | Path) -> Preset:
    """A device with its data sheet and its sources.

    Parameters
    ----------
    name : name of a device, or path of a file of your own that ends in .toml.

    Raises
    ------
    ValueError
        No such device; the message names the nearest one.
    FileFormatError
        The file is missing, or has an unknown key, a bad value, or a number without source.

    Examples
    --------
    >>> describe("kinect-v2").sheet.range_m
    (0.5, 4.5)
    >>> describe("kinect-v3")
    Traceback (most recent call last):
    ValueError: expected a device out of ..., or a file FILE.toml, got 'kinect-v3' (did you mean 'kinect-v2'?).
    """
    if is_device_file(str(name)):
        return read_preset(name)
    if name not in names():
        raise ValueError(
            f"expected a device out of {', '.join(names())}, or a file FILE{SUFFIX}, "
            f"got {shown(name)}{nearest(str(name), names())}."
        )
    return _bundled(str(name))


@lru_cache(maxsize=64)  # these files do not change
def _bundled(name: str) -> Preset:
    return read_preset(FOLDER / f"{name}{SUFFIX}")


def load(name: str | Path) -> Instrument:
    """The instrument of a device. Parameters and errors are those of `describe`.

    Examples
    --------
    >>> camera = load("kinect-v2")
    >>> camera.sensor.details, camera.camera.width
    ('80, 16, 120 MHz, 3 taps, sine wave', 512)
    """
    return describe(name).instrument


def is_device_file(name: str) -> bool:
    """Whether a name is that of a device's file.

    Examples
    --------
    >>> is_device_file("mine.toml"), is_device_file("kinect-v2")
    (True, False)
    """
    return name.endswith(SUFFIX)


def instrument(name: str, **settings: Any) -> Instrument:
    """The instrument of a name: a device, a file of a device, or a sensor with its default detector and decoder.

    Parameters
    ----------
    name : a device such as "kinect-v2"; a file that ends in .toml; a sensor such as "amcw", or FILE.py:NAME, see
        `rangesim.sensors.sensor_of`.
    settings : fields of `Instrument` besides name and sensor, which replace those of the device.

    Raises
    ------
    ValueError, FileFormatError
        As `describe`, `rangesim.sensors.sensor_of` and `Instrument`.

    Examples
    --------
    >>> instrument("direct-tof", power_w=0.5).power_w
    0.5
    >>> instrument("azure-kinect-nfoov")
    Traceback (most recent call last):
    ValueError: expected a sensor ... got 'azure-kinect-nfoov' (did you mean 'azure-kinect-nfov'?).
    """
    if _is_device(name):
        return replace(load(name), **settings) if settings else load(name)
    _check_known(name)
    sensor = sensor_of(name)
    return Instrument(name_of(name, sensor), sensor, **settings)


def instrument_from_dict(table: Any, place: str, files_in: Path | None = None) -> Instrument:
    """The instrument that a table of settings describes; `sensor` may be the name of a device.

    All other keys then replace settings of the device. Tables, such as `detector`, `camera` and `camera_lens`, do so
    key by key, unless they state another `type`.

    Parameters
    ----------
    table : as for `rangesim.instrument.instrument.instrument_from_dict`.
    place : where the table stands, for messages.
    files_in : folder that relative paths of files count from, both FILE.py:NAME of a sensor and FILE.toml of a device.
        None: no file of a user is loaded.

    Raises
    ------
    ValueError, FileFormatError
        An unknown name, an unknown key or a bad value. The message names the place.

    Examples
    --------
    >>> one = instrument_from_dict({"sensor": "kinect-v2", "name": "weak", "power_w": 0.01}, "instrument[0]")
    >>> one.name, one.power_w, one.camera.width
    ('weak', 0.01, 512)
    """
    given = table.get("sensor") if isinstance(table, Mapping) else None
    if isinstance(given, str) and (given in names() or (is_device_file(given) and files_in is not None)):
        device = load(files_in / given if files_in is not None and is_device_file(given) else given)
        return _changed(device, {key: value for key, value in table.items() if key != "sensor"}, place)
    if isinstance(given, str):
        try:
            _check_known(given)
        except ValueError as error:
            raise ValueError(f"{place}.sensor: {error}") from error
    return instruments.instrument_from_dict(table, place, files_in)


def _changed(device: Instrument, changes: Mapping[str, Any], place: str) -> Instrument:
    """The device with some of its settings replaced."""
    check_keys(changes, [f.name for f in fields(Instrument)], place)
    changed = {key: on_top_of(getattr(device, key), value) for key, value in changes.items()}
    return instruments.instrument_from_dict({**to_dict(device), **changed}, place)


def _is_device(name: str) -> bool:
    return name in names() or is_device_file(name)


def _check_known(name: str) -> None:
    """Raise ValueError if a name is neither a device nor a sensor, nor that of a sensor in a file."""
    known = (*sensor_presets(), *names())
    if not is_file_name(name) and name not in known:
        raise ValueError(
            f"expected a sensor or a device out of {', '.join(known)}, or FILE.py:NAME for a sensor of your own, "
            f"got {shown(name)}{nearest(name, known)}."
        )
