# SPDX-License-Identifier: Apache-2.0
"""Writes and reads a decoded capture: the directory that `rangesim decode` writes.

DIR/manifest.json        size and SHA-256 of every file below; see `rangesim.files.atomic_directories`
    decoded.json         sensor, rig, fraction of the pixels by status, likely cause if few pixels have a reading;
                         findings: what the frames told of themselves, and what was assumed;
                         doubts: sentences on what in the capture contradicts itself;
                         notes: sentences on what the decoder has corrected
    range.npz            range image
    cloud.ply            points, metres, camera coordinates; missing if there are none
    depth.png ...        pictures of the maps
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rangesim import __version__
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import FileFormatError
from rangesim.files.atomic_directories import DirectoryKind, new_directory, sidecar_of
from rangesim.files.schema import Fraction, Record, read_record, write_record
from rangesim.results.range_images import load_range_image, save_range_image
from rangesim.rig import Rig
from rangesim.sensors import Sensor, sensor_from_dict
from rangesim.settings.config import ShortRepr, to_dict

SIDECAR = "decoded.json"
"""File of a decoded capture with its settings."""
FORMAT = "rangesim-decoded"
"""Name of the format in the file."""
DECODED = DirectoryKind(FORMAT, SIDECAR, FileFormatError)
"""Directories that hold a decoded capture."""


class DecodedRecord(Record, frozen=True, kw_only=True):
    """The contents of `decoded.json`; the fields are those of `Decoded`, and the doubts and notes of its image."""

    format: Literal["rangesim-decoded"] = "rangesim-decoded"
    format_version: Literal[1] = 1
    sensor: Any
    rig: Any
    rangesim: str
    status: dict[str, Fraction]
    likely_cause: str | None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Decoded(ShortRepr):
    """A range image with the sensor and the rig of its capture.

    image : RangeImage.
    sensor : Sensor that took the capture.
    rig : Rig; None: not calibrated.
    status : fraction of the pixels with each status, by the status's name.
    likely_cause : clause that says why few pixels have a reading; None if no cause is likely.
    findings : sentences on what the frames told of how they were taken, and on what was assumed.
    """

    image: RangeImage
    sensor: Sensor
    rig: Rig | None
    status: dict[str, float]
    likely_cause: str | None
    findings: tuple[str, ...] = ()


def save_decoded(decoded: Decoded, directory: str | Path, pictures: Mapping[str, bytes]) -> None:
    """Write the files of a decoded capture. They appear when all of them are complete.

    Parameters
    ----------
    pictures : contents of PNG files of the maps by name, as `rangesim.report.figures.map_pictures` makes them.

    Raises
    ------
    FileFormatError
        The directory exists and is neither empty nor an unchanged decoded capture.
    """
    record = DecodedRecord(
        sensor=to_dict(decoded.sensor),
        rig=to_dict(decoded.rig),
        rangesim=__version__,
        status=decoded.status,
        likely_cause=decoded.likely_cause,
        doubts=decoded.image.doubts,
        notes=decoded.image.notes,
        findings=decoded.findings,
    )
    image = decoded.image
    with new_directory(directory, DECODED) as folder:
        write_record(folder / SIDECAR, record)
        save_range_image(image, folder / "range.npz")
        for name, content in pictures.items():
            (folder / f"{name}.png").write_bytes(content)
        if image.camera is not None and image.valid.any():
            image.to_point_cloud().save(folder / "cloud.ply")


def load_decoded(directory: str | Path) -> Decoded:
    """The decoded capture that `save_decoded` wrote.

    Raises
    ------
    FileFormatError
        The directory holds no decoded capture, or a file is missing or broken. The message names the file.
    """
    folder = Path(directory)
    record = read_record(sidecar_of(folder, DECODED), DecodedRecord)
    try:
        sensor = sensor_from_dict(record.sensor, "sensor")
        rig = None if record.rig is None else Rig.from_dict(record.rig)
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{folder / SIDECAR}: {error}") from error
    return Decoded(
        load_range_image(folder / "range.npz"), sensor, rig, record.status, record.likely_cause, record.findings
    )
