# SPDX-License-Identifier: Apache-2.0
"""Captures as directories, with one image per frame and `capture.json`; and real captures from folders of images."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from rangesim import __version__
from rangesim.capture import DTYPES, Capture
from rangesim.electronics.ambient import Ambient
from rangesim.electronics.detector import PhotoDetector
from rangesim.errors import FileFormatError
from rangesim.files.image_files import SUFFIXES, read_stack, write_grey
from rangesim.files.result_directories import DirectoryKind, new_directory, recover, write_manifest
from rangesim.files.schema import write_json
from rangesim.files.text_files import read_json
from rangesim.rig import Rig
from rangesim.sensors import Sensor, sensor_from_dict
from rangesim.settings.config import check_keys, from_dict, shown, to_dict

SIDECAR = "capture.json"
"""Name of the file with the settings of a capture."""
FORMAT = "rangesim-capture"
"""Name of the format in that file."""
FORMAT_VERSION = 1
"""Number of the file format, as a count from 1; a change that older versions cannot read increases it, so that they
refuse the file."""
CAPTURE = DirectoryKind(FORMAT, SIDECAR, FileFormatError)
"""Directories that hold a capture."""
_KEYS = (
    "format",
    "format_version",
    "rangesim",
    "dtype",
    "frames",
    "sensor",
    "rig",
    "detector",
    "exposure_s",
    "ambient",
)
"""Keys that `capture.json` may have."""


def save_capture(capture: Capture, directory: str | Path) -> None:
    """Write a capture to a directory: a PNG (8 or 16 bits) or EXR (float32) per frame, and `capture.json`.

    The files appear when all are complete. An older capture of the same name is replaced; files of others stay.

    Raises
    ------
    FileFormatError
        `directory` exists and is neither empty nor an unchanged capture, or the frames do not fit 16 bits.

    Examples
    --------
    >>> from rangesim import load_capture, save_capture
    >>> save_capture(capture, "captures/first")  # doctest: +SKIP
    >>> again = load_capture("captures/first")  # doctest: +SKIP
    """
    with new_directory(directory, CAPTURE) as folder:
        write_capture(capture, folder)


def write_capture(capture: Capture, folder: Path) -> None:
    """Write the files of a capture and their manifest into an empty directory, for a caller that makes it appear.

    Raises
    ------
    FileFormatError
        The frames do not fit 16 bits.
    """
    if capture.is_digital and capture.frames.dtype.itemsize > 2 and capture.frames.max() > 65535:
        raise FileFormatError(
            f"{folder}: the frames hold counts up to {capture.frames.max()}, the files at most 65535; expose shorter."
        )
    names = _file_names(capture)
    for name, frame in zip(names, capture.frames, strict=True):
        write_grey(folder / name, frame.astype(np.uint16) if frame.dtype == np.uint32 else frame)
    write_json(folder / SIDECAR, _sidecar(capture, names))
    write_manifest(folder, CAPTURE)


def load_capture(directory: str | Path) -> Capture:
    """The capture that `save_capture` wrote, with equal bytes and settings.

    Raises
    ------
    FileFormatError
        The directory, its sidecar or a frame is missing, the JSON is broken, a key is unknown, or a size or type is
        wrong; the message names the file.
    """
    sidecar = Path(directory) / SIDECAR
    recover(directory, FileFormatError)
    if not sidecar.is_file():
        raise FileFormatError(f"{directory} is no {FORMAT} directory: it has no {SIDECAR}.")
    settings = read_json(sidecar)
    if not isinstance(settings, dict) or settings.get("format") != FORMAT:
        raise FileFormatError(f"{sidecar} is no {FORMAT} file.")
    if settings.get("format_version") != FORMAT_VERSION:
        raise FileFormatError(
            f"{sidecar}: expected format version {FORMAT_VERSION}, got {shown(settings.get('format_version'))}."
        )
    try:
        check_keys(settings, _KEYS, str(sidecar))
        sensor = sensor_from_dict(settings.get("sensor"), "sensor")
        rig = Rig.from_dict(settings["rig"]) if settings.get("rig") is not None else None
        given = settings.get("detector")
        detector = from_dict(PhotoDetector, given, "detector") if given is not None else None  # type: ignore[type-abstract]
        light = settings.get("ambient")
        ambient = from_dict(Ambient, light, "ambient") if light is not None else None
        exposure = settings.get("exposure_s")
        size = (rig.camera.width, rig.camera.height) if rig else None
        frames = _read_frames(sidecar, settings, sensor, size)
        return Capture(frames, sensor, rig, detector, math.nan if exposure is None else float(exposure), ambient)
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{sidecar}: {str(error).removeprefix(f'{sidecar}: ')}") from error


def import_capture(
    folder: str | Path, sensor: Sensor, rig: Rig | None = None, detector: PhotoDetector | None = None
) -> Capture:
    """The capture of a real camera, from a folder with one image per frame.

    The images are taken in the order of their names, in which numbers count by their value.

    Parameters
    ----------
    folder : holds as many images (PNG, TIFF, JPEG, BMP or EXR; 8 or 16 bits; colour becomes grey) as the sensor has
        frames.
    sensor : Sensor; its frames are in the order of `sensor.frame_names()`.
    rig : Rig; None: the camera is not calibrated.
    detector : PhotoDetector; None: unknown.

    Raises
    ------
    FileFormatError
        There is no such folder, it holds another number of images, an image cannot be read, or images differ in size
        or type.

    Examples
    --------
    >>> from rangesim import StructuredLight, decode, import_capture
    >>> capture = import_capture("photographs", StructuredLight(1280, 800))  # doctest: +SKIP
    >>> image = decode(capture)  # doctest: +SKIP
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(f"{folder} is no folder of images.")
    paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES), key=_natural)
    if len(paths) != sensor.n_frames:
        raise FileFormatError(
            f"{folder}: expected {sensor.n_frames} images for {sensor.type_name} "
            f"({sensor.frame_names()[0]} ... {sensor.frame_names()[-1]}), got {len(paths)}."
        )
    frames = read_stack(paths)
    try:
        return Capture(frames, sensor, rig, detector)
    except ValueError as error:
        raise FileFormatError(f"{folder}: {error}") from error


def _file_names(capture: Capture) -> list[str]:
    """Name of the file of each frame."""
    suffix = ".png" if capture.is_digital else ".exr"
    return [f"{i:03d}_{name}{suffix}" for i, name in enumerate(capture.sensor.frame_names())]


def _sidecar(capture: Capture, names: list[str]) -> dict[str, Any]:
    """Content of `capture.json`; names : of the frames' files."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "rangesim": __version__,
        "dtype": capture.frames.dtype.name,
        "sensor": to_dict(capture.sensor),
        "rig": to_dict(capture.rig),
        "detector": to_dict(capture.detector),
        "exposure_s": None if math.isnan(capture.exposure_s) else capture.exposure_s,
        **({} if capture.ambient is None else {"ambient": to_dict(capture.ambient)}),
        "frames": names,
    }


def _read_frames(sidecar: Path, settings: dict[str, Any], sensor: Sensor, size: tuple[int, int] | None) -> np.ndarray:
    """(k, h, w) frames of the files that the settings name; size : expected width and height, None: any."""
    names, dtype = settings.get("frames"), settings.get("dtype")
    if dtype not in DTYPES:
        raise ValueError(f"expected dtype to be one of {', '.join(DTYPES)}, got {dtype!r}.")
    if not isinstance(names, list) or len(names) != sensor.n_frames:
        raise ValueError(f"expected a list of {sensor.n_frames} frames for {sensor.type_name}.")
    for name in names:
        if not isinstance(name, str) or Path(name).name != name:
            raise ValueError(f"expected plain file names under frames, got {name!r}.")
    frames = read_stack([sidecar.parent / name for name in names], size)
    stored = "uint16" if dtype == "uint32" else dtype
    if frames.dtype.name != stored:
        raise ValueError(f"expected frames of type {stored}, got {frames.dtype.name}.")
    return frames.astype(dtype, copy=False)


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Key that sorts names with their numbers by value: frame_2 before frame_10."""
    return [(0, int(s)) if s.isdigit() else (1, s) for s in re.split(r"(\d+)", path.name.lower())]
