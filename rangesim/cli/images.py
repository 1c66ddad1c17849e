# SPDX-License-Identifier: Apache-2.0
"""Bare images on the command line: the options that say which sensor took them, and how a capture is made of them.

This module knows no sensor by name. A preset or a file names the sensor, and the options change those settings that
the sensor has.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

if TYPE_CHECKING:
    import numpy as np

    from rangesim.capture import Captured
    from rangesim.results.captures import ImportedFrames
    from rangesim.sensor import Decoder, Sensor

ALL_AXES = "columns,rows"
"""Axes that bare images of a preset code unless an option says otherwise: both, as in OpenCV's stack of patterns."""

SensorOption = Annotated[
    str | None,
    typer.Option(
        "--sensor",
        help="Sensor that took it: a name such as amcw, or FILE.py:NAME for a sensor or a code of your own; the file "
        "is run.",
        show_default=False,
    ),
]
CodeOption = Annotated[
    str | None,
    typer.Option("--code", help="For bare images: name of the code.", show_default="the code of OpenCV's patterns"),
]
ProjectorOption = Annotated[
    str | None,
    typer.Option(
        "--projector", help="For bare images: projector pixels, for example 1024x768, unless the calibration has them."
    ),
]
AxesOption = Annotated[
    str | None,
    typer.Option(
        "--axes",
        help="For bare images: coded axes, columns, rows, or both as columns,rows.",
        show_default=f"{ALL_AXES}, or those of --sensor",
    ),
]
OrderOption = Annotated[
    str | None,
    typer.Option(
        "--order",
        help="For bare images: what they show in turn, as names of frames or patterns of names, such as "
        "'white,black,columns_bit*'. Frames that are not named were not shown.",
        show_default="found from the images",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="A setting of the code, the sensor or the decoder, as name=value: period_px=18, convention.start=sin, "
        "phase.modulation_of_scale=0.02. Repeat the option for several.",
        show_default=False,
    ),
]
ImagesOption = Annotated[
    str | None,
    typer.Option(
        "--images",
        help="For bare images: those that are frames, as patterns such as 'pat*.png', or as a text file that lists "
        "them, each with the name of its frame after it if wanted; in a .npz or .json, the place of the array.",
        show_default="all, sorted by name",
    ),
]
RotateOption = Annotated[
    int,
    typer.Option("--rotate", help="For bare images: degrees clockwise by which to turn them: 90, 180 or 270."),
]
MirrorOption = Annotated[
    bool, typer.Option("--mirror", help="For bare images: exchange left and right, after --rotate.")
]
ChannelOption = Annotated[
    str | None,
    typer.Option("--channel", help="For bare images in colour: red, green, blue or grey.", show_default="grey"),
]
BitsOption = Annotated[
    str | None,
    typer.Option(
        "--bits",
        help="For bare images: bits of a value, if fewer than the file's, such as 12; s12 for two's complement.",
    ),
]
PatternsOption = Annotated[
    Path | None,
    typer.Option(
        "--patterns",
        help="For bare images: patterns.json of the patterns that were projected, as rangesim patterns wrote it.",
        show_default="the one beside the images",
    ),
]

ONLY_BARE_IMAGES = ("code", "projector", "axes", "order", "images", "rotate", "mirror", "channel", "bits", "patterns")
"""Options that bare images need. A capture with a sidecar refuses them, because the sidecar says the same."""
ONLY_WITHOUT_PATTERNS = ("code", "projector", "axes", "order")
"""Options that say what patterns.json says."""


@dataclass(frozen=True)
class ImageOptions:
    """Values of the options of bare images; None, False or 0: not given."""

    sensor: str | None = None
    code: str | None = None
    projector: str | None = None
    axes: str | None = None
    order: str | None = None
    set_: Sequence[str] | None = None
    images: str | None = None
    rotate: int = 0
    mirror: bool = False
    channel: str | None = None
    bits: str | None = None
    patterns: Path | None = None

    def given(self, names: Sequence[str]) -> str:
        """Names of the options that were given, of `names`, as on the command line; "" if none was."""
        return ", ".join(f"--{name}" for name in names if getattr(self, name))


class Loaded(NamedTuple):
    """A capture; its decoder with other settings, or None; and sentences on what was found and assumed."""

    captured: Captured
    decoder: Decoder | None = None
    findings: tuple[str, ...] = ()


def load_frames(
    place: Path,
    options: ImageOptions,
    axes: str | None,
    camera_size: tuple[int, int] | None = None,
    projector_size: tuple[int, int] | None = None,
) -> Loaded:
    """The capture of a directory with a sidecar, or of bare images; a directory may hold those of several cameras.

    Parameters
    ----------
    place : the directory, or a file with all frames.
    axes : coded axes unless an option names others; None: those of the sensor.
    camera_size, projector_size : (width, height) as a calibration states them; None: not known.

    Raises
    ------
    ValueError
        The options contradict each other or the sidecar, or name no known sensor or setting.
    FileFormatError
        The place holds no capture, or other frames than those of the sensor.
    """
    from rangesim.errors import FileFormatError
    from rangesim.results.captures import SIDECAR, load_capture
    from rangesim.results.pattern_sets import SIDECAR as PATTERNS
    from rangesim.results.pattern_sets import load_patterns

    if options.sensor is not None and options.code is not None:
        raise ValueError("expected either --sensor or --code, got both.")
    if not place.is_dir() and not place.is_file():
        raise FileFormatError(f"{place} is no directory and no file; expected a capture or a folder of images.")
    if (place / SIDECAR).is_file():
        if surplus := options.given(ONLY_BARE_IMAGES):
            raise ValueError(f"{place} is a capture whose {SIDECAR} says how it was taken: leave out {surplus}.")
        named = None if options.sensor is None else _sensor(options.sensor)  # its file defines the capture's sensor
        captured = load_capture(place)
        sensor = captured.reference.sensor
        if named is not None and type(sensor) is not type(named):
            raise ValueError(f"expected --sensor to name the sensor of {place}, {sensor.type_name}.")
        _, decoder = with_settings(sensor, options.set_ or (), only_decoder=f"{place / SIDECAR}")
        return Loaded(captured, decoder)
    patterns = options.patterns or (place / PATTERNS if (place / PATTERNS).is_file() else None)
    if patterns is not None:
        if surplus := options.given(ONLY_WITHOUT_PATTERNS):
            raise ValueError(f"{patterns} says which patterns were shown: leave out {surplus}.")
        if options.sensor is not None:
            _sensor(options.sensor)  # its file defines the code of the patterns
        of_patterns: Sensor | None = load_patterns(patterns).sensor
    else:
        of_patterns = sensor_of_images(options, axes, projector_size)
    if of_patterns is None:
        raise ValueError(
            f"{place} has no {SIDECAR}, so it holds bare images: expected --projector WIDTHxHEIGHT as well, or "
            "--sensor FILE.py:NAME."
        )
    sensor, decoder = with_settings(of_patterns, options.set_ or ())
    return _imported(place, sensor, decoder, options, camera_size, is_stated=patterns is not None)


def _imported(
    place: Path,
    sensor: Sensor,
    decoder: Decoder | None,
    options: ImageOptions,
    camera_size: tuple[int, int] | None,
    is_stated: bool,
) -> Loaded:
    """The capture of bare images. is_stated : whether a patterns.json states their order."""
    from rangesim.capture import Capture
    from rangesim.errors import FileFormatError
    from rangesim.files.frame_files import CameraView, NumberFormat
    from rangesim.results.captures import check_count, import_frames

    view = CameraView(options.rotate, options.mirror, options.channel or "grey")  # type: ignore[arg-type]
    shape = None if camera_size is None else camera_size[::-1]
    imported = import_frames(place, sensor, options.images, view, NumberFormat.parse(options.bits), shape)
    if options.order is not None:
        if imported.names is not None:
            raise ValueError(f"{options.images} names the frames: leave out --order.")
        sensor = _in_order(sensor, [entry.strip() for entry in options.order.split(",")], options.axes)
    sensor, frames = _by_name(sensor, imported, options.axes)
    findings = imported.findings
    try:
        sensor, found = _as_found(sensor, frames, is_stated)
        findings += found
    except ValueError as error:
        raise FileFormatError(
            f"{place}: {error} If some images are no frames, name the others with --images."
        ) from error
    check_count(place, frames, sensor)
    try:
        return Loaded(Capture(frames, sensor), decoder, tuple(f"{place}: {finding}" for finding in findings))
    except ValueError as error:
        raise FileFormatError(f"{place}: {error}") from error


def _as_found(sensor: Sensor, frames: np.ndarray, is_stated: bool) -> tuple[Sensor, tuple[str, ...]]:
    """The sensor with the conventions that the frames tell, and what they told.

    If --order states the order, nothing is looked for; if a patterns.json does, only whether the images are in another.
    """
    from rangesim.conventions import detect_convention, detect_order
    from rangesim.sensors import StructuredLight

    if not isinstance(sensor, StructuredLight):
        return sensor, ()
    if is_stated:
        if len(frames) != sensor.n_frames:
            return sensor, ()
        found = detect_order(frames, sensor)
        return found.sensor, tuple(f"not as the patterns were written: {text}" for text in found.findings)
    if sensor.order:
        return sensor, ()
    found = detect_convention(frames, sensor)
    return found.sensor, found.findings


def _in_order(sensor: Sensor, order: Sequence[str], axes: str | None) -> Sensor:
    """The sensor with frames in that order. Unless `axes` states them, it codes the axes that the order names."""
    from rangesim.sensors import StructuredLight

    if not isinstance(sensor, StructuredLight):
        raise ValueError(f"expected an order of frames only for structured light, got it for {sensor.type_name}.")
    named = tuple(axis for axis in sensor.axes if any(axis in entry for entry in order))
    return replace(sensor, order=tuple(order), axes=named if named and axes is None else sensor.axes)


def _by_name(sensor: Sensor, imported: ImportedFrames, axes: str | None) -> tuple[Sensor, np.ndarray]:
    """The sensor and its frames, if a list of the images names each frame."""
    from rangesim.settings.config import nearest, shown

    names, known = imported.names, sensor.frame_names()
    if names is None:
        return sensor, imported.frames
    if wrong := [name for name in names if name not in known]:
        raise ValueError(
            f"{sensor.type_name} has no frame {shown(wrong[0])}{nearest(wrong[0], known)}; it has {', '.join(known)}."
        )
    if len(names) < len(known):
        return _in_order(sensor, names, axes), imported.frames
    return sensor, imported.frames[[names.index(name) for name in known]]


def sensor_of_images(
    options: ImageOptions, axes: str | None, projector_size: tuple[int, int] | None = None
) -> Sensor | None:
    """The sensor that the options name; None if they name no sensor, or one whose projector has no known size.

    Parameters
    ----------
    axes, projector_size : as for `load_frames`.

    Raises
    ------
    ValueError
        The options name no known sensor, or settings that the sensor refuses.
    """
    from rangesim.sensors.registry import IMAGES_PRESET

    name = options.sensor or options.code
    sensor = _sensor(name or IMAGES_PRESET, may_be_file=options.sensor is not None)
    has_projector = sensor.default_emitter.size is not None
    size = _size(options.projector) if options.projector is not None else projector_size if has_projector else None
    if size is None and name is None:
        return None
    coded = options.axes or axes
    if size is None and not has_projector:
        if options.axes is not None:
            raise ValueError(f"expected --axes only for a sensor with a projector, got it for {sensor.type_name}.")
        return sensor
    size = size or sensor.default_emitter.size
    assert size is not None
    if options.projector is None and projector_size is None and coded is None:
        return sensor
    return sensor.for_projector(*size, None if coded is None else [axis.strip() for axis in coded.split(",")])


def sensor_to_show(options: ImageOptions) -> Sensor:
    """The sensor whose patterns the options describe, of the projector's own size unless they state one.

    Raises
    ------
    ValueError
        The options name no known sensor, or settings that it does not have or refuses.
    """
    sensor = sensor_of_images(options, axes=None)
    assert sensor is not None  # a name is given
    sensor, decoder = with_settings(sensor, options.set_ or ())
    if decoder is not None:
        raise ValueError("expected --set with settings of the code or the sensor: patterns have no decoder.")
    if options.order is None:
        return sensor
    return _in_order(sensor, [entry.strip() for entry in options.order.split(",")], options.axes)


def with_settings(
    sensor: Sensor, given: Sequence[str], only_decoder: str | None = None
) -> tuple[Sensor, Decoder | None]:
    """The sensor, and its decoder, with other settings; the decoder is None if none of its settings is given.

    Parameters
    ----------
    given : settings as name=value. A name is that of a field of the sensor, of its code or of its decoder, with or
        without names before it: `code.period_px` or `period_px`, `decoder.phase.max_sigma_rad` or `max_sigma_rad`. A
        value is written as in TOML; text needs no quotes.
    only_decoder : file that states the settings of the sensor, which are then refused; None: all may be given.

    Raises
    ------
    ValueError
        A setting without =, or that sensor and decoder do not have or refuse.
    """
    from rangesim.settings.config import from_dict, nearest, shown, to_dict

    decoder = sensor.default_decoder
    tables = {"": to_dict(sensor), "decoder.": to_dict(decoder)}
    changed = set()
    for setting in given:
        name, is_there, text = setting.partition("=")
        if not is_there:
            raise ValueError(f"expected --set as name=value, got {shown(setting)}.")
        known = {f"{prefix}{path}": (prefix, path) for prefix, table in tables.items() for path in _paths(table)}
        places = _places(known, name.strip())
        if not places:
            valid = [path.removeprefix("decoder.") for path in known if not path.endswith("type")]
            raise ValueError(f"{sensor.type_name}: unknown setting {shown(name)}{nearest(name, valid)}.")
        if len(places) > 1:
            raise ValueError(f"expected --set with one of {', '.join(places)}, got {shown(name)}.")
        prefix, path = known[places[0]]
        if only_decoder is not None and prefix == "":
            raise ValueError(f"expected --set with a setting of the decoder, got {shown(name)}, which {only_decoder} "
                             "states.")  # fmt: skip
        *outer, last = path.split(".")
        inner = tables[prefix]
        for key in outer:
            inner = inner[key]
        inner[last] = _toml_value(text.strip())
        changed.add(prefix)
    return (
        from_dict(type(sensor), tables[""], sensor.type_name) if "" in changed else sensor,
        from_dict(type(decoder), tables["decoder."], "decoder") if "decoder." in changed else None,
    )


def _places(paths: dict[str, Any], name: str) -> list[str]:
    """Paths of the settings that a name may mean: the whole path if there is one, else all paths that end with it."""
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


def _sensor(name: str, may_be_file: bool = True) -> Sensor:
    """The sensor of a name, also of a device that people have; or of FILE.py:NAME."""
    from rangesim import presets
    from rangesim.sensors import sensor_of

    if may_be_file and name in presets.names():
        return presets.load(name).sensor
    return sensor_of(name) if may_be_file else sensor_of(name, files_in=None)


def _size(projector: str) -> tuple[int, int]:
    """(width, height) in pixels of an option such as 1024x768."""
    from rangesim.settings.config import shown

    size = re.fullmatch(r"(\d+)[x×](\d+)", projector)
    if not size:
        raise ValueError(f"expected --projector as WIDTHxHEIGHT in pixels, such as 1024x768, got {shown(projector)}.")
    return int(size[1]), int(size[2])
