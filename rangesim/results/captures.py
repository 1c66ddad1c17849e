# SPDX-License-Identifier: Apache-2.0
"""Writes and reads captures: a directory with one image per frame and `capture.json`, or a folder of real images."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rangesim import __version__
from rangesim.capture import DTYPES, Capture, Captured, together
from rangesim.electronics.ambient import Ambient
from rangesim.electronics.detector import PhotoDetector
from rangesim.errors import FileFormatError, warn
from rangesim.files.atomic_directories import DirectoryKind, new_directory, sidecar_of, write_manifest
from rangesim.files.frame_files import (
    CameraView,
    NumberFormat,
    as_counts,
    as_digital,
    find_frames,
    read_frames,
    read_frames_file,
)
from rangesim.files.image_files import CHANNELS, LUMA, SUFFIXES, only_colour, read_stack, write_grey
from rangesim.files.schema import write_json
from rangesim.files.text_files import read_json
from rangesim.rig import Rig
from rangesim.sensors import Sensor, sensor_from_dict
from rangesim.settings.config import check_keys, from_dict, shown, to_dict

SIDECAR = "capture.json"
"""File of a capture with its settings."""
FORMAT = "rangesim-capture"
"""Name of the format in the file."""
FORMAT_VERSION = 1
"""Version of the format, a count from 1. A change that older versions of the package cannot read increases it."""
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
    "exposure_is_automatic",
    "ambient",
    "further_cameras",
)
"""Keys of `capture.json`."""
_CAMERA = re.compile(r"camera_[0-9]{1,3}")
"""Names of folders of further cameras."""


def save_capture(capture: Captured, directory: str | Path) -> None:
    """Write a capture as a directory with one image per frame and `capture.json`.

    The captures of further cameras (`CaptureSet`) are in folders of it, `camera_2` and so on, which are captures, too.

    The images are PNG of 8 or 16 bits, or EXR of float32 for a noise-free capture. The files appear when all of them
    are complete. An older capture in the directory is replaced. Other files in it stay.

    Raises
    ------
    FileFormatError
        `directory` exists and is neither empty nor an unchanged capture, or the frames do not fit 16 bits.

    Examples
    --------
    >>> from rangesim import expose, save_capture
    >>> save_capture(expose(signals, sensor), "out/capture")  # doctest: +SKIP
    """
    with new_directory(directory, CAPTURE) as folder:
        write_capture(capture, folder)


def write_capture(captured: Captured, folder: Path) -> None:
    """Write the files of a capture and their manifest into an empty directory.

    This function does not protect the files while they are incomplete; `save_capture` does.

    Raises
    ------
    FileFormatError
        The frames do not fit 16 bits.
    """
    capture, further = captured.reference, captured.captures[1:]
    folders = [f"camera_{number}" for number in range(2, len(further) + 2)]
    for name, other in zip(folders, further, strict=True):
        (folder / name).mkdir()
        write_capture(other, folder / name)
    if capture.is_digital and capture.frames.dtype.itemsize > 2 and capture.frames.max() > 65535:
        raise FileFormatError(
            f"{folder}: expected counts up to 65535, the largest that the files hold, got {capture.frames.max()}; take "
            "a shorter exposure."
        )
    names = _file_names(capture)
    for name, frame in zip(names, capture.frames, strict=True):
        write_grey(folder / name, frame.astype(np.uint16) if frame.dtype == np.uint32 else frame)
    write_json(folder / SIDECAR, _sidecar(capture, names) | ({"further_cameras": folders} if folders else {}))
    write_manifest(folder, CAPTURE)


def load_capture(directory: str | Path) -> Captured:
    """The capture that `save_capture` wrote, with equal frames and settings; a `CaptureSet` of several cameras.

    Raises
    ------
    FileFormatError
        The directory, `capture.json` or a frame is missing or broken, or has an unknown key, a wrong size or a wrong
        type. The message names the file.

    Examples
    --------
    >>> from rangesim import decode, load_capture
    >>> image = decode(load_capture("out/tabletop/amcw/capture"))  # doctest: +SKIP
    """
    sidecar = sidecar_of(directory, CAPTURE)
    capture, further = _read_capture(sidecar)
    captures = [capture]
    for name in further:
        other, more = _read_capture(sidecar_of(sidecar.parent / name, CAPTURE))
        if more:
            raise FileFormatError(f"{sidecar.parent / name}: expected the capture of one camera.")
        captures.append(other)
    try:
        return together(captures)
    except ValueError as error:
        raise FileFormatError(f"{sidecar}: {error}") from error


def _read_capture(sidecar: Path) -> tuple[Capture, list[str]]:
    """The capture of one camera, and the names of the folders of further cameras."""
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
        further = settings.get("further_cameras", [])
        if not isinstance(further, list) or not all(isinstance(n, str) and _CAMERA.fullmatch(n) for n in further):
            raise ValueError(f"expected names such as camera_2 under further_cameras, got {shown(further)}.")
        exposure_s = math.nan if exposure is None else float(exposure)
        is_automatic = settings.get("exposure_is_automatic", False)
        if not isinstance(is_automatic, bool):
            raise ValueError(f"expected true or false under exposure_is_automatic, got {shown(is_automatic)}.")
        return Capture(frames, sensor, rig, detector, exposure_s, ambient, is_automatic), further
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{sidecar}: {str(error).removeprefix(f'{sidecar}: ')}") from error


class ImportedFrames(NamedTuple):
    """Frames (k, h, w) of a real camera, in a type that a Capture takes.

    names : names of the frames, if a list of the images states them. findings : sentences on what was assumed.
    """

    frames: np.ndarray
    names: list[str] | None = None
    findings: tuple[str, ...] = ()


def import_frames(
    place: str | Path,
    sensor: Sensor,
    images: str | None = None,
    view: CameraView | None = None,
    number: NumberFormat | None = None,
    shape: tuple[int, int] | None = None,
) -> ImportedFrames:
    """The frames of a real camera; how many there are is not checked.

    Parameters
    ----------
    place : folder of images or arrays, see `find_frames`; or a file with all frames, see `read_frames_file`.
    sensor : Sensor that took them. Histograms of a sensor that counts photons stay as they are; other numbers are
        stretched to all bits of their type, see `as_digital`.
    images : which of the files, or which array of the file. view : CameraView. number : NumberFormat.
    shape : (h, w) of the camera, for pixels that an array holds in a row; None: not known.

    Raises
    ------
    FileFormatError
        There is no such place, or a file is broken; or the numbers are not of that format.
    """
    place, number = Path(place), number or NumberFormat()
    names: list[str] | None = None
    coloured: tuple[str, ...] = ()
    if place.is_file():
        values = read_frames_file(place, sensor.n_frames, images, view, shape or (1, -1))
    else:
        files = find_frames(place, images)
        names = files.names
        if not files.paths:
            raise FileFormatError(f"{place}: expected {sensor.n_frames} images for {sensor.type_name}, got 0.")
        values = read_frames(files, view)
        coloured = _colour_finding(files.paths, values, view)
        if values.dtype == np.float32 and number.bits is None and files.paths[0].suffix.lower() in SUFFIXES:
            return ImportedFrames(values, names)  # floating-point images hold radiance
    try:
        if sensor.gate is None:
            digital = as_digital(values, number)
            return ImportedFrames(digital.frames, names, (*digital.findings, *coloured))
        if number != NumberFormat():
            raise ValueError("expected no --bits for histograms, which hold counts of photons.")
        counts = as_counts(values)
        return ImportedFrames(counts.frames, names, counts.findings)
    except ValueError as error:
        raise FileFormatError(f"{place}: {error}") from error


def _colour_finding(paths: Sequence[Path], frames: np.ndarray, view: CameraView | None) -> tuple[str, ...]:
    """A sentence if images are read as grey whose light has one colour; none if not.

    Parameters
    ----------
    paths : (k,) files of the images. frames : (k, h, w), their frames.
    """
    if len(paths) != len(frames) or (view or CameraView()).channel != "grey" or paths[0].suffix.lower() not in SUFFIXES:
        return ()
    level = [float(frame.mean()) for frame in frames]
    channel = only_colour(paths[int(np.argmax(level))], paths[int(np.argmin(level))])
    if channel is None:
        return ()
    weight = LUMA[list(CHANNELS).index(channel) - 1]
    return (f"the light changes in {channel} alone, of which grey has {weight:.1g}: give --channel {channel}.",)


def import_capture(
    folder: str | Path,
    sensor: Sensor,
    rig: Rig | None = None,
    detector: PhotoDetector | None = None,
    *,
    images: str | None = None,
    view: CameraView | None = None,
    number: NumberFormat | None = None,
) -> Capture:
    """A real capture from a folder with one image per frame, or from a file with all frames.

    The images are read in the order of their names; numbers in the names are compared by value, so 2 precedes 10. A
    `RangesimWarning` says what is assumed of the camera's numbers.

    Parameters
    ----------
    folder : folder with as many images as the sensor has frames: PNG, TIFF, JPEG, BMP or EXR of 8 or 16 bits, or arrays
        (.npy). Colour images are converted to grey. Or a file with all frames, .npy, .npz or .json.
    sensor : Sensor, whose `frame_names()` are in the order of the images.
    rig : Rig; None: not calibrated.
    detector : PhotoDetector; None: not known.
    images, view, number : as for `import_frames`.

    Raises
    ------
    FileFormatError
        There is no such folder, the number of images is wrong, or an image is broken or has another size or type than
        the others.

    Examples
    --------
    >>> from rangesim import StructuredLight, decode, import_capture, load_calibration
    >>> sensor = StructuredLight(code="gray", projector_width=1024, projector_height=768, axes=("columns", "rows"))
    >>> rig = load_calibration("rig.json")  # doctest: +SKIP
    >>> image = decode(import_capture("photographs", sensor, rig))  # doctest: +SKIP
    """
    imported = import_frames(folder, sensor, images, view, number)
    check_count(folder, imported.frames, sensor)
    for finding in imported.findings:
        warn(f"{folder}: {finding}")
    try:
        return Capture(imported.frames, sensor, rig, detector)
    except ValueError as error:
        raise FileFormatError(f"{folder}: {error}") from error


def check_count(place: str | Path, frames: np.ndarray, sensor: Sensor) -> None:
    """Raise FileFormatError unless there are as many frames (k, h, w) as the sensor has."""
    if len(frames) != sensor.n_frames:
        names = sensor.frame_names()
        raise FileFormatError(
            f"{place}: expected {sensor.n_frames} images for {sensor.type_name} ({names[0]} ... {names[-1]}), got "
            f"{len(frames)}."
        )


def _file_names(capture: Capture) -> list[str]:
    """Name of the file of each frame, such as 000_columns_bit9.png."""
    suffix = ".png" if capture.is_digital else ".exr"
    return [f"{i:03d}_{name}{suffix}" for i, name in enumerate(capture.sensor.frame_names())]


def _sidecar(capture: Capture, names: list[str]) -> dict[str, Any]:
    """Contents of `capture.json`."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "rangesim": __version__,
        "dtype": capture.frames.dtype.name,
        "sensor": to_dict(capture.sensor),
        "rig": to_dict(capture.rig),
        "detector": to_dict(capture.detector),
        "exposure_s": None if math.isnan(capture.exposure_s) else capture.exposure_s,
        "exposure_is_automatic": capture.exposure_is_automatic,
        **({} if capture.ambient is None else {"ambient": to_dict(capture.ambient)}),
        "frames": names,
    }


def _read_frames(sidecar: Path, settings: dict[str, Any], sensor: Sensor, size: tuple[int, int] | None) -> np.ndarray:
    """Frames (k, h, w) of a capture, in the type that they had when they were saved.

    size : width and height that the frames must have; None: any.
    """
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
