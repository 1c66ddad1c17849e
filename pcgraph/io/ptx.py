# SPDX-License-Identifier: Apache-2.0
"""PTX files of terrestrial scanners (Leica Cyclone), which hold scans as lattices of directions.

A scan has ten lines above its points:

- the number of columns
- the number of rows
- four lines of three numbers: place and axes of the scanner. Their frame may be another one, so they are not used.
- four lines of four numbers: a matrix M. (x, y, z, 1) M is a point in the common frame, and the last row of M is the
  place of the scanner in it.

The points follow column by column, in the scanner's own frame: x y z intensity, or x y z intensity red green blue.
Where nothing was measured, x y z are zero. Source: Leica's manual of Cyclone; P. Bourke
(paulbourke.net/dataformats/ptx).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import COLOR_NAMES, Cloud, cloud_from_columns
from pcgraph.errors import CloudReadError
from pcgraph.io.format import CloudFile, Format
from pcgraph.io.text import MIN_ROW_BYTES, TextLines, column_of_numbers, is_number, numbers

_COUNTS = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
"""Count of the numbers in each of the ten lines above a scan's points, from the module's description of the format."""
_NAMES = {4: ("intensity",), 7: ("intensity", *COLOR_NAMES)}
"""Names of the columns after x y z, by the count of all columns in a row."""
_MAX_SIDE = 10**9
"""Largest count of columns or of rows in a scan: no file holds more. Chosen by eye; not varied."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan of a PTX file.

    Attributes
    ----------
    width, height : int
        Columns and rows.
    place : (3,) float64, metres, the common frame
        Position of the scanner.
    points : (width x height, 3) float64, metres, the common frame
        Column by column; NaN where nothing was measured.
    values : (width x height, 1 or 4) float64
        Intensity, or intensity, red, green, blue.
    """

    width: int
    height: int
    place: NDArray[np.float64]
    points: NDArray[np.float64]
    values: NDArray[np.float64]


def read_ptx(file: CloudFile) -> Cloud:
    """Cloud of a PTX file, in the common frame; points are float64.

    A single scan becomes an organised cloud (rows, columns): row 0 has the first point of each column. Several scans
    become a list of points, scan after scan, and the column ``scan`` (int32) has the number of the scan, from 0.
    `viewpoint` is the place of the scanner, (3,), or that of each point's scanner, (n, 3).

    Raises
    ------
    CloudReadError
        The lines above a scan are damaged, the last column of the matrix is not 0 0 0 1, or there are fewer points than
        columns times rows.
    """
    scans = list(_scans(file.content))
    if not scans:
        raise CloudReadError("expected a scan, which begins with its number of columns, but the file is empty")
    if len({scan.values.shape[1] for scan in scans}) > 1:
        raise CloudReadError("expected colours in all scans or in none, but some scans have them and others have not")
    points = np.concatenate([scan.points for scan in scans])
    values = np.concatenate([scan.values for scan in scans])
    names = _NAMES[3 + values.shape[1]]
    columns: dict[str, NDArray[np.generic]] = dict(zip("xyz", points.T, strict=True))
    columns |= {name: column_of_numbers(column) for name, column in zip(names, values.T, strict=True)}
    if len(scans) > 1:
        sizes = [len(scan.points) for scan in scans]
        columns["scan"] = np.repeat(np.arange(len(scans), dtype=np.int32), sizes)
        places = np.repeat(np.stack([scan.place for scan in scans]), sizes, axis=0)
        return cloud_from_columns(columns, (len(points),), places)
    (scan,) = scans
    shape = scan.width, scan.height
    columns = {name: column.reshape(shape).T.reshape(-1) for name, column in columns.items()}
    return cloud_from_columns(columns, shape[::-1], scan.place)


def _scans(content: bytes) -> Iterator[Scan]:
    lines = TextLines(content)
    stream = iter(lines)
    for line in stream:
        header = _header(line, stream, lines)
        (width,), (height,) = header[:2]
        if not all(side == np.rint(side) and 1 <= side <= _MAX_SIDE for side in (width, height)):
            raise CloudReadError(
                f"expected a scan's numbers of columns and rows ten lines above line {lines.number + 1}, "
                f"got {width:.9g} and {height:.9g}"
            )
        promised = int(width) * int(height)
        if promised * MIN_ROW_BYTES > len(content):
            raise CloudReadError(
                f"the header of a scan that ends in line {lines.number} promises {promised} points, "
                f"but the whole file has only {len(content)} bytes"
            )
        matrix = np.array(header[6:])
        if not (np.isfinite(matrix).all() and np.array_equal(matrix[:, 3], [0, 0, 0, 1])):
            raise CloudReadError(
                f"expected a matrix whose last column is 0 0 0 1 in lines {lines.number - 3} to {lines.number}, "
                f"got {matrix[:, 3].tolist()}"
            )
        table = numbers(islice(stream, promised), lines)
        if len(table) != promised or table.shape[1] not in _NAMES:
            raise CloudReadError(
                f"expected {promised} rows of 4 or 7 numbers, x y z intensity and perhaps colours, up to line "
                f"{lines.number}, got {len(table)} rows of {table.shape[1]}"
            )
        local = table[:, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            points = local @ matrix[:3, :3] + matrix[3, :3]
        points[(local == 0).all(axis=1)] = np.nan
        yield Scan(int(width), int(height), matrix[3, :3], points, table[:, 3:])


def _header(first: str, stream: Iterator[str], lines: TextLines) -> list[list[float]]:
    """Numbers in each of the ten lines above the points of a scan."""
    found = []
    line = first
    for count in _COUNTS:
        words = line.split()
        if len(words) != count or not all(map(is_number, words)):
            raise CloudReadError(
                f"expected {count} numbers in line {lines.number}, one of the ten above a scan's points, "
                f"got {line.strip()[:80]!r}"
            )
        found.append([float(word) for word in words])
        if len(found) < len(_COUNTS):
            line = next(stream, "")
    return found


PTX = Format("ptx", (".ptx",), read_ptx, organised=True)
