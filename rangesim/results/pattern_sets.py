# SPDX-License-Identifier: Apache-2.0
"""Writes and reads pattern sets: the images that a projector shows for a sensor, and `patterns.json`.

DIR/manifest.json        size and SHA-256 of every file below; see `rangesim.files.atomic_directories`
    patterns.json        sensor, gamma of the projector, bits, names of the images in their order
    000_columns_bit9.png ...
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from rangesim import __version__
from rangesim.errors import FileFormatError
from rangesim.files.atomic_directories import DirectoryKind, new_directory
from rangesim.files.image_files import write_grey
from rangesim.files.schema import Name, Record, read_record, write_record
from rangesim.sensor import Sensor
from rangesim.sensors import sensor_from_dict
from rangesim.settings.bounds import Bounds, check_fields
from rangesim.settings.config import to_dict

SIDECAR = "patterns.json"
"""File of a pattern set with its settings."""
FORMAT = "rangesim-patterns"
"""Name of the format in the file."""
PATTERNS = DirectoryKind(FORMAT, SIDECAR, FileFormatError)
"""Directories that hold a pattern set."""
MAX_GAMMA = 10.0
"""Largest gamma of a projector, and the inverse of the least. Video projectors have 1.8 to 2.6."""


class PatternSetRecord(Record, frozen=True, kw_only=True):
    """The contents of `patterns.json`."""

    format: Literal["rangesim-patterns"] = "rangesim-patterns"
    format_version: Literal[1] = 1
    rangesim: str
    sensor: Any
    gamma: Annotated[float, msgspec.Meta(ge=1 / MAX_GAMMA, le=MAX_GAMMA)]
    bits: Annotated[int, msgspec.Meta(ge=1, le=16)]
    images: list[Name]


@dataclass(frozen=True)
class PatternSet:
    """The images that a projector shows so that a sensor measures.

    Parameters
    ----------
    sensor : Sensor, such as StructuredLight.
    gamma : exponent of the projector: it shows a pixel of the value v with the power v ** gamma. The images are
        corrected for it.
    bits : bits of a pixel of the projector, 1 to 16. Images of more than 8 bits are written as PNG of 16 bits.

    Examples
    --------
    >>> from rangesim.sensors import StructuredLight
    >>> PatternSet(StructuredLight(8, 4, "gray"), gamma=2.2).images().dtype
    dtype('uint8')
    """

    sensor: Sensor
    gamma: Annotated[float, Bounds("an exponent", 1 / MAX_GAMMA, MAX_GAMMA)] = 1.0
    bits: Annotated[int, Bounds("a number of bits", 1, 16)] = 8

    def __post_init__(self) -> None:
        check_fields(self)

    def images(self) -> np.ndarray:
        """(k, height, width) uint8 or uint16, the images to project, corrected for the gamma of the projector."""
        patterns = self.sensor.patterns()
        dtype = np.uint8 if self.bits <= 8 else np.uint16
        levels, largest = 2**self.bits - 1, np.iinfo(dtype).max
        result = np.empty(patterns.shape, dtype=dtype)
        for image, pattern in zip(result, patterns, strict=True):
            image[:] = np.rint(np.rint(pattern ** (1 / self.gamma) * levels) * (largest / levels))
        return result

    def file_names(self, n_images: int) -> list[str]:
        """Name of the file of each image, such as 000_columns_bit9.png."""
        names = self.sensor.frame_names()
        if len(names) != n_images:  # two cameras take a frame each of one pattern
            names = ["pattern"] * n_images
        return [f"{i:03d}_{name}.png" for i, name in enumerate(names)]


def save_patterns(patterns: PatternSet, directory: str | Path) -> int:
    """Write the images of a pattern set and `patterns.json`, and return how many images these are.

    The files appear when all of them are complete.

    Raises
    ------
    FileFormatError
        The directory exists and is neither empty nor an unchanged pattern set.
    ValueError
        The sensor's emitter shows no images.
    """
    images = patterns.images()
    names = patterns.file_names(len(images))
    record = PatternSetRecord(
        rangesim=__version__,
        sensor=to_dict(patterns.sensor),
        gamma=patterns.gamma,
        bits=patterns.bits,
        images=names,
    )
    with new_directory(directory, PATTERNS) as folder:
        for name, image in zip(names, images, strict=True):
            write_grey(folder / name, image)
        write_record(folder / SIDECAR, record)
    return len(images)


def load_patterns(path: str | Path) -> PatternSet:
    """The pattern set of a `patterns.json`, or of the directory that holds it; the images are not read.

    Raises
    ------
    FileFormatError
        The file is missing or broken, or names a sensor that is not known or refuses its settings.
    """
    path = Path(path)
    record = read_record(path / SIDECAR if path.is_dir() else path, PatternSetRecord)
    try:
        return PatternSet(sensor_from_dict(record.sensor, "sensor"), record.gamma, record.bits)
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path}: {error}") from error
