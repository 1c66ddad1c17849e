# SPDX-License-Identifier: Apache-2.0
"""Frames of real cameras: a folder of images or arrays, or one file with all of them; and the numbers that they hold.

A camera's files say little: which of them are frames, how the camera was turned, and how many bits a number has, the
user knows. `CameraView` and `NumberFormat` hold what the user says.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from rangesim.errors import FileFormatError
from rangesim.files.array_files import read_array, read_arrays
from rangesim.files.image_files import CHANNELS, LUMA, SUFFIXES, read_grey, read_stack
from rangesim.files.text_files import read_json, read_text
from rangesim.settings.config import nearest, shown

ARRAY = ".npy"
"""Suffix of a file with one array."""
ARRAYS = ".npz"
"""Suffix of a file with several arrays by name."""
TABLE = ".json"
"""Suffix of a file with nested lists, as devices write histograms."""
STACKS = (ARRAY, ARRAYS, TABLE)
"""Suffixes of files that hold all frames of a capture."""
LIST = ".txt"
"""Suffix of a file that lists images in the order of the frames."""
MAX_LISTED = 5
"""Largest number of names in a message."""


# ---- Which files ----------------------------------------------------------------------------------------------------


class FrameFiles(NamedTuple):
    """Image files in the order of the frames; `names` are the names of the frames, if a list states them."""

    paths: list[Path]
    names: list[str] | None = None


def find_frames(folder: Path, images: str | None = None) -> FrameFiles:
    """The files of a folder that hold frames, in their order.

    Parameters
    ----------
    folder : folder of images (PNG, TIFF, JPEG, BMP, PGM, EXR) or of arrays (.npy), one for each frame, or of one array
        with all frames.
    images : patterns of file names, separated by commas, such as "pat*.png"; or a text file that lists the images, one
        in a line, each with the name of its frame after it if wanted. None: all images. Files that match one pattern
        are in the order of their names, in which numbers count by value, so that 2 precedes 10.

    Raises
    ------
    FileFormatError
        There is no such folder or no such image, or the list is broken.
    """
    if not folder.is_dir():
        got = "a file" if folder.exists() else "a path with nothing there"
        raise FileFormatError(f"{folder}: expected a folder of images, got {got}.")
    if images is not None and images.lower().endswith(LIST):
        return _listed(folder, Path(images))
    try:
        known = sorted((p for p in folder.iterdir() if p.suffix.lower() in (*SUFFIXES, ARRAY)), key=_natural)
    except OSError as error:
        raise FileFormatError(f"cannot read {folder}: {error.strerror or error}.") from error
    if images is None:
        if len({path.suffix.lower() == ARRAY for path in known}) > 1:
            raise FileFormatError(
                f"{folder}: expected images or arrays (.npy), got both: say which with --images, as '*.png'."
            )
        return FrameFiles(known)
    found: list[Path] = []
    for pattern in (part.strip() for part in images.split(",")):
        matching = [path for path in known if fnmatchcase(path.name, pattern)]
        if not matching:
            few = ", ".join(path.name for path in known[:MAX_LISTED]) + (
                " and others" if len(known) > MAX_LISTED else ""
            )
            got = f"a folder with {few}" if known else f"a folder without any ({', '.join((*SUFFIXES, ARRAY))})"
            hint = nearest(pattern, [path.name for path in known])
            raise FileFormatError(f"{folder}: expected images that match {shown(pattern)}{hint}, got {got}.")
        found += [path for path in matching if path not in found]
    return FrameFiles(found)


def _listed(folder: Path, list_file: Path) -> FrameFiles:
    """The images that a text file lists, by paths relative to the folder, with the names of their frames if stated."""
    paths: list[Path] = []
    names: list[str] = []
    for line in read_text(list_file).splitlines():
        entry = line.strip()
        if not entry or entry.startswith("#"):
            continue
        path, name = folder / entry, ""
        if not _is_file(path):
            words = re.split(r"[\s,;]+", entry)
            path, name = folder / entry.removesuffix(words[-1]).rstrip(" \t,;"), words[-1] if len(words) > 1 else ""
            if not name or not _is_file(path):
                raise FileFormatError(
                    f"{list_file}: expected the names of files in {folder}, one in a line, got {shown(entry)}, which "
                    "is none."
                )
        paths.append(path)
        names += [name] if name else []
    if not paths:
        raise FileFormatError(f"{list_file}: expected the name of an image in each line, got no line with one.")
    if names and len(names) < len(paths):
        raise FileFormatError(
            f"{list_file}: expected the name of a frame after each image or after none, got {len(names)} names for "
            f"{len(paths)} images."
        )
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise FileFormatError(f"{list_file}: expected each frame once, got {shown(twice)} twice.")
    return FrameFiles(paths, names or None)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # an impossible name
        return False


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Key that sorts the names of files so that image2 comes before image10."""
    return [(0, int(s)) if s.isdigit() else (1, s) for s in re.split(r"([0-9]{1,18})", path.name.lower())]


# ---- What the camera saw --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CameraView:
    """Rule by which images become frames.

    rotate : degrees clockwise by which the images are turned. mirror : whether left and right are then exchanged.
    channel : one of `CHANNELS`, of images with colours.
    """

    rotate: Literal[0, 90, 180, 270] = 0
    mirror: bool = False
    channel: str = "grey"

    def __post_init__(self) -> None:
        if self.rotate not in (0, 90, 180, 270):
            raise ValueError(f"expected to rotate by 0, 90, 180 or 270 degrees clockwise, got {self.rotate}.")
        if self.channel not in CHANNELS:
            raise ValueError(
                f"expected a channel out of {', '.join(CHANNELS)}, got {shown(self.channel)}"
                f"{nearest(self.channel, CHANNELS)}."
            )

    def of(self, frames: np.ndarray) -> np.ndarray:
        """The frames (k, h, w), turned and mirrored."""
        turned = np.rot90(frames, -self.rotate // 90, axes=(1, 2))
        return np.ascontiguousarray(turned[:, :, ::-1] if self.mirror else turned)

    def without_colours(self, array: np.ndarray) -> np.ndarray:
        """Images (..., 3) or (..., 4) of an array as (...), in the type of the array."""
        if self.channel != "grey":
            return array[..., list(CHANNELS).index(self.channel) - 1]
        grey = sum(weight * array[..., i].astype(np.float64) for i, weight in enumerate(LUMA))
        return np.asarray(grey if array.dtype.kind == "f" else np.rint(grey), dtype=array.dtype)


def read_frames(files: FrameFiles, view: CameraView | None = None) -> np.ndarray:
    """The frames (k, h, w) of files, as the camera's numbers: of any type for arrays, else uint8, uint16 or float32.

    Raises
    ------
    FileFormatError
        A file is missing or unreadable, or the images differ in size or type; the message names the file.
    """
    view = view or CameraView()
    if len(files.paths) == 1 and files.paths[0].suffix.lower() == ARRAY:
        array = read_array(files.paths[0])
        if array.ndim > 2:
            return view.of(_stack(files.paths[0], array, view, 0))
    return view.of(read_stack(files.paths, read=partial(_image, view=view)))


def _image(path: Path, view: CameraView) -> np.ndarray:
    """The image (h, w) of a file."""
    if path.suffix.lower() != ARRAY:
        return read_grey(path, view.channel)
    array = read_array(path)
    _check_numbers(path, array)
    if array.ndim == 3 and array.shape[-1] in (3, 4):
        return view.without_colours(array)
    if array.ndim != 2:
        raise FileFormatError(f"{path}: expected an image (h, w), got an array of shape {array.shape}.")
    return array


def read_frames_file(
    path: Path, n_frames: int, name: str | None = None, view: CameraView | None = None, shape: tuple[int, int] = (1, -1)
) -> np.ndarray:
    """The frames (k, h, w) of one file with all of them.

    Parameters
    ----------
    path : .npy; or .npz or .json with several arrays. An array is (k, h, w), or (h, w, k) if its last axis alone has
        `n_frames` entries; or (k, n) or (n, k) for pixels in a row, as a sensor of few zones delivers histograms.
    n_frames : number of frames of the sensor.
    name : of a .npz, the name of the array; of a .json, the keys and indices that lead to it, such as "12.hists". None:
        the file holds one array.
    shape : (h, w) of pixels in a row; -1: as many as there are.

    Raises
    ------
    FileFormatError
        The file is missing or broken, or has no such array.
    """
    view = view or CameraView()
    suffix = path.suffix.lower()
    if suffix not in STACKS:
        raise FileFormatError(
            f"{path}: expected a folder of images, or a file with all frames ({', '.join(STACKS)}), got "
            f"{f'a file {suffix}' if suffix else 'a file without suffix'}."
        )
    if suffix == ARRAY:
        if name is not None:
            raise FileFormatError(
                f"{path}: expected no name, because it holds one array, got {shown(name)}: leave out --images."
            )
        array = read_array(path)
    elif suffix == ARRAYS:
        arrays = read_arrays(path, None if name is None else [name])
        if len(arrays) != 1:
            raise FileFormatError(f"{path}: expected one array, got {', '.join(arrays)}: say which with --images NAME.")
        array = next(iter(arrays.values()))
    else:
        array = _of_table(path, read_json(path), name)
    if array.ndim == 2:
        _check_numbers(path, array)
        if n_frames not in array.shape:
            raise FileFormatError(
                f"{path}: expected {n_frames} values for each pixel, got an array of {array.shape[0]} x "
                f"{array.shape[1]}."
            )
        pixels = array.T if array.shape[1] == n_frames else array
        fits = -1 in shape or math.prod(shape) == pixels.shape[1]
        array = pixels.reshape(n_frames, *(shape if fits else (1, -1)))
    return view.of(_stack(path, array, view, n_frames))


def _stack(path: Path, array: np.ndarray, view: CameraView, n_frames: int) -> np.ndarray:
    """The frames (k, h, w) of an array of three axes, or of four for colours."""
    _check_numbers(path, array)
    if array.ndim == 4 and array.shape[-1] in (3, 4):
        array = view.without_colours(array)
    if array.ndim != 3:
        raise FileFormatError(f"{path}: expected frames (k, h, w), got an array of shape {array.shape}.")
    if len(array) != n_frames and array.shape[-1] == n_frames:
        array = np.moveaxis(array, -1, 0)
    return array


def _check_numbers(path: Path, array: np.ndarray) -> None:
    if array.dtype.kind not in "biuf" or array.size == 0:
        raise FileFormatError(f"{path}: expected an array of numbers, got {shown(array)}.")


def _of_table(path: Path, data: Any, name: str | None) -> np.ndarray:
    """The array at a place in nested lists and tables."""
    for key in name.split(".") if name else ():
        place = int(key) if key.isdigit() and len(key) < 10 and isinstance(data, list) else key
        is_there = place < len(data) if isinstance(place, int) else isinstance(data, dict) and place in data
        if not is_there:
            holds = f"a list of {len(data)}" if isinstance(data, list) else shown(data)
            raise FileFormatError(f"{path}: expected --images as keys and indices such as 0.hists, but {key!r} leads "
                                  f"nowhere in {holds}.")  # fmt: skip
        data = data[place]
    try:
        array = np.array(data)
        if array.dtype.kind not in "iuf":
            raise ValueError
    except (ValueError, OverflowError):
        kind = f"a table of {', '.join(map(str, list(data)[:MAX_LISTED]))}" if isinstance(data, dict) else shown(data)
        raise FileFormatError(
            f"{path}: expected nested lists of numbers, got {kind}; say where with --images, such as 0.hists."
        ) from None
    return array


# ---- What the numbers mean ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NumberFormat:
    """Bits of a digital number of the camera, which may be fewer than those of the file.

    bits : 1 to 32; None: those of the file's type for unsigned integers of 8 and 16 bits, and else as many as the
        largest number needs. is_signed : whether the numbers are in two's complement.

    Examples
    --------
    >>> NumberFormat.parse("s12")
    NumberFormat(bits=12, is_signed=True)
    """

    bits: int | None = None
    is_signed: bool = False

    @classmethod
    def parse(cls, text: str | None) -> NumberFormat:
        """The format that a text such as 12, or s12 for two's complement, stands for; ValueError if none."""
        if text is None:
            return cls()
        match = re.fullmatch(r"(s?)([0-9]{1,9})", text.strip())
        if match is None or not 1 <= int(match[2]) <= 32:
            raise ValueError(f"expected --bits as 1 to 32, or s1 to s32 for two's complement, got {shown(text)}.")
        return cls(int(match[2]), bool(match[1]))


class Digital(NamedTuple):
    """Frames (k, h, w) of unsigned integers, and sentences on what was assumed of the camera's numbers."""

    frames: np.ndarray
    findings: tuple[str, ...] = ()


def as_counts(values: np.ndarray) -> Digital:
    """Counts of photons, uint32: histograms are not stretched, because their noise is that of their counts.

    Raises
    ------
    ValueError
        A number that is no count.
    """
    finite = np.isfinite(values) if values.dtype.kind == "f" else np.ones(1, dtype=bool)
    counts = np.where(finite, values, 0)
    low, high = (counts.min(), counts.max())
    if low < 0 or high >= 2**32:
        raise ValueError(f"expected counts from 0 to {2**32 - 1} in the bins of histograms, got {shown(float(low))}.")
    result = counts.astype(np.uint32)
    if (result != counts).any():
        part = float(counts[result != counts][0])
        raise ValueError(f"expected whole counts in the bins of histograms, got {part:g}: add them, do not average.")
    return Digital(result, _masked_finding(finite))


def as_digital(values: np.ndarray, number: NumberFormat) -> Digital:
    """The numbers of a camera as unsigned integers over all bits of their type, so that the largest number is white.

    Numbers with a sign, such as differences of taps, are moved up by half of the range. Of differences between frames,
    which are what decoders look at, nothing changes. Floating-point numbers are digital numbers, too, not radiance, or
    fractions of full scale if none is beyond 1. They are rounded to 1 / 65535 of full scale (to 2^-32 above 16 bits). A
    pixel that is not finite in one frame has no signal in all of them.

    Raises
    ------
    ValueError
        A number beyond the stated bits.
    """
    kind, size = values.dtype.kind, 8 * values.dtype.itemsize
    if kind == "b":
        values, kind, size = values.astype(np.uint8) * np.uint8(255), "u", 8
    if kind == "u" and size <= 16 and not number.is_signed and number.bits in (None, size):
        return Digital(values)
    if kind == "u" and number.bits is not None and number.bits > size:
        raise ValueError(f"expected --bits of 1 to {size} for {values.dtype} images, got {number.bits}.")
    finite = np.isfinite(values).all(axis=0) if kind == "f" else np.ones(values.shape[1:], dtype=bool)
    if not finite.any():
        raise ValueError("expected pixels that are finite in all frames, got none: check how the frames were saved.")
    if kind == "u" and number.is_signed:
        values = _twos_complement(values, number.bits or size)
    low, high = (float(of([of(frame[finite]) for frame in values])) for of in (np.min, np.max))
    is_signed = number.is_signed or low < 0
    is_fraction = kind == "f" and number.bits is None and high <= 1 and low >= -1
    findings = list(_masked_finding(finite))
    bits = number.bits
    if is_fraction:
        lowest, highest = -1.0 if is_signed else 0.0, 1.0
        findings.append(f"numbers from {low:.4g} to {high:.4g} are taken as fractions of full scale; --bits says else.")
    else:
        if bits is None:
            bits = (
                max(math.ceil(high).bit_length(), math.ceil(-low - 1).bit_length() if is_signed else 0, 1) + is_signed
            )
            sign = " in two's complement" if is_signed else ""
            findings.append(
                f"numbers from {low:.6g} to {high:.6g} are taken as {bits} bits{sign}; --bits states another number."
            )
        lowest, highest = (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1) if is_signed else (0.0, 2.0**bits - 1)
        if low < lowest or high > highest:
            outside = low if low < lowest else high
            sign = "s" if is_signed else ""
            raise ValueError(
                f"expected digital numbers from {lowest:.0f} to {highest:.0f} for --bits {sign}{bits}, "
                f"got {outside:.6g}."
            )
    dtype: type[np.unsignedinteger[Any]] = np.uint16 if bits is None or bits <= 16 else np.uint32
    if kind == "u" and size == 8 and not is_signed:
        dtype = np.uint8
    stretch = float(np.iinfo(dtype).max) / (highest - lowest)
    frames = np.empty(values.shape, dtype=dtype)
    for frame, taken in zip(frames, values, strict=True):
        known = np.where(finite, taken, 0).astype(np.float64)
        frame[:] = np.rint((known - lowest) * stretch)
    return Digital(frames, tuple(findings))


def _twos_complement(values: np.ndarray, bits: int) -> np.ndarray:
    """Unsigned numbers of a file read as two's complement of `bits`; above them, the file has zeros or the sign."""
    wide = values.astype(np.int64)
    size, half = 8 * values.dtype.itemsize, 1 << (bits - 1)
    if bits > size:
        raise ValueError(f"expected --bits of s1 to s{size} for {values.dtype} numbers, got s{bits}.")
    signed = ((wide & ((1 << bits) - 1)) ^ half) - half
    wrong = (wide != signed) & (wide != signed + (1 << bits)) & (wide != signed + (1 << size))
    if wrong.any():
        raise ValueError(f"expected two's complement of {bits} bits for --bits s{bits}, got {wide[wrong][0]}.")
    return np.asarray(signed)


def _masked_finding(finite: np.ndarray) -> tuple[str, ...]:
    """A sentence on pixels without a number, if there are any."""
    bad = int(np.count_nonzero(~finite))
    return (f"{bad} of {finite.size} numbers or pixels are not finite, and count as without signal.",) if bad else ()
