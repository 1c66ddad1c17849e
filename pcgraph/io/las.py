# SPDX-License-Identifier: Apache-2.0
"""LAS 1.0 to 1.4 and LAZ files of airborne and terrestrial laser scanners; COPC files are read as LAZ files.

The libraries laspy and, for LAZ, lazrs read and write them: the extra ``las``.
"""

from __future__ import annotations

import logging
import re
import struct
import warnings
from collections.abc import Callable
from io import BytesIO
from itertools import chain
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import COLOR_NAMES, Cloud
from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError, library_reason
from pcgraph.io.flat_columns import Arrays, described, flatten, unflatten
from pcgraph.io.format import Format

_HEADER_BYTES = 227
"""Bytes of the shortest header, that of LAS 1.0 to 1.2. Source: the LAS specification of ASPRS."""
_VLR_BYTES = 54
"""Bytes of a variable length record without its data. Source: the LAS specification of ASPRS."""
_PIECE = 1 << 20
"""Count of points that are unpacked at a time, so that memory grows with what the file really holds. Chosen by eye; not
varied."""
_LAYERED = b"\x03\x00"
"""Compressor of LAZ for the point formats from 6 on."""
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of each item of a compressed point: its base, colours, colours with infrared, wave packets. Extra bytes, item
14, have one layer for each byte."""
_MAX_OF_8_BITS = 255
"""Largest channel value of a cloud whose colours count as stored in 8 bits, in steps of a channel.

Colours of 16 bits with no larger value would be almost black, because white is 65535.
"""
_WHITE_RATIO = 257
"""Ratio of white in 16 bits to white in 8 bits, 65535 / 255, from the limits of the two types."""
_DESCRIPTION = ("pcgraph", 1)
"""User ID and record ID of the variable length record that holds the description of the columns. The user ID is ours,
so that any record ID is free."""
_PROJECTION = "LASF_Projection"
"""User of the variable length records that hold a coordinate reference system, from the standard."""
_MAX_VLR_BYTES = 65535
"""Largest size of the data of a variable length record, bytes, because the format counts them in 16 bits."""
_MAX_EXTRA_FIELDS = _MAX_VLR_BYTES // 192
"""Largest count of fields of extra bytes, because one record describes all of them, each in 192 bytes."""
_MAX_NAME = 31
"""Largest length of a field's name, characters, because the format has 32 bytes and some readers expect a NUL as the
last one."""
_SECONDS_PER_WEEK = 604800
"""GPS times from 0 to below this are seconds of the week; LAS counts all others from 2011, with a flag that says so."""
_UNUSED = {"return_number": 1, "number_of_returns": 1}
"""Values of dimensions that a written cloud does not have, if not 0: the standard counts returns from 1."""
_COARSEST_STEP = 1e-4
"""Largest step to which coordinates off any grid are rounded, metres: 0.1 mm, because laser scanners resolve less."""
_STEPS_PER_EXTENT = 1e7
"""Least count of steps in the extent of a small cloud off any grid: about as many as the 24 bits of float32
distinguish."""
_MAX_STEPS = 2.0**31 - 2.0
"""Largest count of steps from the offset to a coordinate, because LAS stores it as int32; one step is left for
rounding."""
_GRIDS = tuple(10.0**-digits for digits in range(10))
"""Steps, metres, of the decimal grids that are tried. Other steps, such as 0.002 or 0.00025, are multiples of these."""
_FINE_ENOUGH = 16
"""Least ratio of a grid's step to the rounding of the coordinates. On a finer grid, every number would seem to lie.
Chosen by eye; not varied."""
_SAMPLE = 1000
"""Count of coordinates that are tried on a grid before all of them, to save time. Chosen by eye; not varied."""


# ---- Reading -------------------------------------------------------------------------------------------------------


def read_las(content: bytes) -> Cloud:
    """Cloud of a LAS or LAZ file, given the file's bytes.

    - Points are float64: stored whole numbers times the scale, plus the offset. Coordinate reference systems are not
      read.
    - Each dimension of the point format and of the extra bytes is a column under laspy's name: ``intensity``,
      ``classification``, ``gps_time`` and so on. Dimensions that are zero at all points are columns too, so that all
      tiles of a survey have the same columns. Bit fields are uint8.
    - Scaled extra bytes are float64; their values for "no data" stay as they are.
    - Classes are a column, not `labels`, because they are not instances. Extra bytes ``label`` or ``labels`` of whole
      numbers are labels. Extra bytes ``NormalX``, ``NormalY``, ``NormalZ``, or ``nx`` and so on, are normals.
    - Colours of 16 bits are scaled to 8. If no channel is above 255, they count as stored in 8 bits, which the standard
      does not allow. If all points are black, the cloud has no colours.

    Raises
    ------
    CloudReadError
        The header is damaged, the file is shorter than the header says, or a library is missing.

    Warns
    -----
    UserWarning
        The file has a coordinate reference system.
    """
    _check_length(content)
    laspy = _laspy(CloudReadError, "reading", compressed=bool(content[104] & 0xC0))
    try:
        points, fields, standard, text, is_georeferenced = _unpacked(laspy, content)
    except CloudReadError:
        raise
    except MemoryError:
        raise CloudReadError("the points do not fit into memory: split the file, or thin out its points") from None
    except BaseException as error:  # of damaged files, laspy raises whatever its parts raise, lazrs a panic of Rust
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise CloudReadError(f"the LAS file is damaged: {library_reason(error)}") from None
    if is_georeferenced:
        warnings.warn(
            "left out the coordinate reference system of the LAS file: assign it again to files that are written",
            stacklevel=2,
        )
    own = described(text)
    if own is not None:  # dimensions of the point format that the written cloud did not have
        for name in standard.intersection(fields) - {*map(str, own["columns"].values()), *COLOR_NAMES}:
            if (fields[name] == _UNUSED.get(name, 0)).all():
                del fields[name]
    return unflatten(points, _colors(fields, is_own=own is not None), fields, own)


class _Unpacked(NamedTuple):
    """The content of a LAS file.

    Attributes
    ----------
    points : (n, 3) float64
    fields : dict of name to (n,) or (n, c) array
        All other dimensions.
    standard : set of str
        Names of the dimensions of the point format.
    description : bytes, or None
        The record that `flatten` made, if the file has one.
    is_georeferenced : bool
        Whether the file has a coordinate reference system.
    """

    points: NDArray[np.floating]
    fields: Arrays
    standard: set[str]
    description: bytes | None
    is_georeferenced: bool


def _unpacked(laspy: ModuleType, content: bytes) -> _Unpacked:
    with np.errstate(over="ignore", invalid="ignore"), laspy.open(BytesIO(content), read_evlrs=False) as reader:
        header = reader.header
        if header.are_points_compressed and header.point_count:
            is_coarse = _largest_chunk(content, header) > _PIECE
            reader.laz_backend = laspy.LazBackend.Lazrs if is_coarse else laspy.LazBackend.LazrsParallel
        dimensions = [name for name in header.point_format.dimension_names if name not in ("X", "Y", "Z")]
        standard = set(header.point_format.standard_dimension_names)
        records = header.vlrs.get_by_id(_DESCRIPTION[0], (_DESCRIPTION[1],))
        is_georeferenced = any(record.user_id == _PROJECTION for record in header.vlrs)
        empty = laspy.ScaleAwarePointRecord.zeros(0, header=header)
        points, columns = [], []
        for piece in chain([empty], reader.chunk_iterator(_PIECE)):
            points.append(np.stack([piece.x, piece.y, piece.z], axis=1))
            columns.append({name: np.array(piece[name]) for name in dimensions})
    n_found = sum(map(len, points))
    if n_found != header.point_count:
        raise CloudReadError(f"the LAS header promises {header.point_count} points, but {n_found} follow")
    fields: Arrays = {name: np.concatenate([piece.pop(name) for piece in columns]) for name in dimensions}
    text = records[0].record_data_bytes() if records else None
    return _Unpacked(np.concatenate(points), fields, standard, text, is_georeferenced)


def _check_length(content: bytes) -> None:
    """Raise CloudReadError if the file is shorter than its header says, before memory is taken for its points."""
    if len(content) < _HEADER_BYTES or not content.startswith(b"LASF"):
        raise CloudReadError("expected a LAS header that begins with 'LASF', but found none")
    minor = content[25]
    start, n_records, point_format, size, n_points = struct.unpack_from("<IIBHI", content, 96)
    if minor >= 4 and len(content) >= 255:
        n_points = struct.unpack_from("<Q", content, 247)[0]
    if n_records * _VLR_BYTES > len(content):
        raise CloudReadError(f"the LAS header promises {n_records} records, but the file has {len(content)} bytes")
    available, needed = len(content) - start, n_points * size
    if available < 0:
        raise CloudReadError(f"the LAS header promises points from byte {start} on, but the file has {len(content)}")
    n_further = struct.unpack_from("<I", content, 243)[0] if minor >= 4 and len(content) >= 255 else 0
    has_waveforms = minor == 3
    if not point_format & 0xC0 and not n_points and available >= size > 0 and not (n_further or has_waveforms):
        raise CloudReadError(f"the LAS header promises no points, but {available} bytes follow: its writer did not end")
    if not point_format & 0xC0 and available < needed:
        raise CloudReadError(
            f"the LAS header promises {n_points} points ({needed} bytes), but only {available} bytes follow"
        )


def _largest_chunk(content: bytes, header: Any) -> int:
    """Number of points in the largest chunk of a LAZ file; the parallel reader allocates memory for all of them.

    Raises CloudReadError if the file promises chunks longer than itself, or layers longer than their chunk: lazrs takes
    memory for what is promised, and ends the process if there is none. Source: the LASzip specification. Chunks of the
    point formats from 6 on hold the first point, the count of points, the lengths of the layers and the layers.
    """
    import lazrs

    packing, start = header.vlrs[header.vlrs.index("LasZipVlr")].record_data, header.offset_to_point_data
    kinds = struct.unpack_from(f"<{3 * struct.unpack_from('<H', packing, 32)[0]}H", packing, 34)
    items = list(zip(kinds[::3], kinds[1::3], strict=True))
    size = sum(n_bytes for _, n_bytes in items)
    if size != header.point_format.size:
        raise CloudReadError(f"expected compressed points of {header.point_format.size} bytes, got {size}")
    (table,) = struct.unpack_from("<q", content, start)
    if table < 0:  # the writer could not go back: the place is at the end of the file
        (table,) = struct.unpack_from("<q", content, len(content) - 8)
    _, n_chunks = struct.unpack_from("<2I", content, table)
    if n_chunks * size > len(content):
        raise CloudReadError(f"the LAZ file promises {n_chunks} chunks, but it is only {len(content)} bytes long")
    source = BytesIO(content)
    source.seek(start)
    n_layers = sum(_LAYERS.get(kind, n_bytes) for kind, n_bytes in items) if packing[:2] == _LAYERED else 0
    at, largest = start + 8, 0  # after the place of the table
    for n_points, n_bytes in lazrs.read_chunk_table(source, lazrs.LazVlr(packing)):
        if at + n_bytes > len(content):
            raise CloudReadError(f"the LAZ file promises a chunk of {n_bytes} bytes, but {len(content) - at} follow")
        lengths = struct.unpack_from(f"<{n_layers}I", content, at + size + 4)
        if sum(lengths) > n_bytes:
            raise CloudReadError(f"the LAZ file promises layers of {sum(lengths)} bytes in a chunk of {n_bytes}")
        at, largest = at + n_bytes, max(largest, n_points)
    return largest


def _colors(fields: Arrays, is_own: bool) -> NDArray[np.generic] | None:
    """Colours, (n, 3) uint8, or uint16 where white is 65535; removed from `fields`.

    None: the file has none, or another program wrote it and all points are black.
    """
    if not all(name in fields for name in COLOR_NAMES):
        return None
    colors = np.stack([fields.pop(name) for name in COLOR_NAMES], axis=1)
    brightest = int(colors.max(initial=0))
    if brightest == 0 and not is_own:
        return None
    return colors.astype(np.uint8) if brightest <= _MAX_OF_8_BITS else colors


def _laspy(error: type[PcgraphError], what: str, compressed: bool) -> ModuleType:
    """The module laspy; raises `error`, which names the extra, if laspy, or lazrs for LAZ, is missing."""
    try:
        import laspy

        if compressed:
            import lazrs  # noqa: F401 - laspy finds it by itself
    except ImportError:
        needed = "laspy and lazrs" if compressed else "laspy"
        name = ".laz" if compressed else ".las"
        raise error(f"{what} {name} needs {needed}: pip install rangesim[las]") from None
    logging.getLogger("laspy").addHandler(logging.NullHandler())  # else its errors are printed beside our sentence
    return laspy


# ---- Writing -------------------------------------------------------------------------------------------------------


def encode_las(cloud: Cloud, suffix: str) -> bytes:
    """Bytes of a LAS 1.4 file, or of a LAZ file if `suffix` is ``.laz``, with every column of a cloud.

    Coordinates are whole numbers of steps from an offset. Coordinates on a decimal grid, as all from LAS files are,
    stay on that grid: they come back the same but for the rounding of doubles. Others are rounded to steps of at most
    0.1 mm, in small clouds to a ten millionth of the extent. Colours are stored in 16 bits, times 257.

    The point format is 6; with colours it is 7; with colours and a column ``nir`` it is 8. A column is stored in a
    dimension of the point format if that has its name and type, and enough bits. All other columns are extra bytes of
    their own types: normals ``NormalX``, ``NormalY``, ``NormalZ``, labels ``label``, vectors ``name_0``, ``name_1`` and
    so on. Bools become uint8, float16 becomes float32. Names of extra bytes are cut to 31 characters of ASCII. A record
    that other programs skip tells `read_las` the full names and the vectors. A coordinate reference system is not
    written. GPS times beyond a week are flagged as standard time (less 1e9 s), others as seconds of the week.

    Raises
    ------
    CloudWriteError
        There are more than 341 fields of extra bytes; or the points are so far apart that 32
        bits per coordinate would lose what their type resolves.
    """
    points = cloud.points
    laspy = _laspy(CloudWriteError, "writing", compressed=suffix == ".laz")
    header = laspy.LasHeader(version="1.4", point_format=_point_format(cloud))
    header.global_encoding.wkt = True  # the standard demands it for formats from 6 on
    header.generating_software = "pcgraph"
    header.creation_date = None  # the same cloud gives the same bytes
    times = np.asarray(cloud.columns.get("gps_time", 0.0), np.float64)
    if ((times < 0) | (times >= _SECONDS_PER_WEEK)).any():
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD  # else seconds of the week
    standard = {dimension.name: dimension for dimension in header.point_format.dimensions}
    taken = {*laspy.PointFormat(8).dimension_names, "x", "y", "z", "xyz"}
    scalars = {name: column for name, column in cloud.columns.items() if column.ndim == cloud.points.ndim - 1}
    kept = [name for name, column in scalars.items() if name in standard and _fits(column, standard[name])]
    fields, description = flatten(cloud, kept, taken, _safe_name)
    extra = [name for name in fields if name not in kept]
    if len(extra) > _MAX_EXTRA_FIELDS or len(description) > _MAX_VLR_BYTES:
        raise CloudWriteError(
            f"expected at most {_MAX_EXTRA_FIELDS} fields of extra bytes, and names of {_MAX_VLR_BYTES} bytes in all, "
            f"got {len(extra)} and {len(description)}: leave columns out, or write .ply or .npz"
        )
    header.add_extra_dims([laspy.ExtraBytesParams(name, fields[name].dtype.newbyteorder("=")) for name in extra])
    header.vlrs.append(laspy.VLR(*_DESCRIPTION, "columns, as JSON", description))
    grids = [_grid(column) for column in points.T]
    header.scales, header.offsets = np.array([g.step for g in grids]), np.array([g.offset for g in grids])
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    for axis, column, grid in zip("XYZ", points.T, grids, strict=True):
        record[axis] = np.rint((column.astype(np.float64) - grid.offset) / grid.step).astype(np.int32)
    if cloud.colors is not None:
        for name, channel in zip(COLOR_NAMES, cloud.colors.reshape(-1, 3).T, strict=True):
            record[name] = channel.astype(np.uint16) * _WHITE_RATIO
    for name, value in _UNUSED.items():
        record[name] = np.full(len(points), value, np.uint8)
    for name, values in fields.items():
        record[name] = values
    stream = BytesIO()
    with laspy.open(stream, mode="w", header=header, do_compress=suffix == ".laz", closefd=False) as writer:
        writer.write_points(record)
    return stream.getvalue()


def _point_format(cloud: Cloud) -> int:
    """Number of the smallest point format of LAS 1.4 that holds the cloud's colours."""
    if cloud.colors is None:
        return 6
    return 8 if "nir" in cloud.columns and cloud.columns["nir"].dtype == np.uint16 else 7


def _fits(column: NDArray[np.generic], dimension: Any) -> bool:
    """Whether a column has the type of a dimension of the point format, and its numbers fit into the bits of that."""
    if dimension.name in ("X", "Y", "Z", *COLOR_NAMES):
        return False
    if dimension.kind.name != "BitField":
        return bool(column.dtype == dimension.dtype)
    return bool(column.dtype == np.uint8 and int(column.max(initial=0)) <= dimension.max)


def _safe_name(name: str, room: int) -> str:
    """The name in printable ASCII without blanks, cut so that `room` more characters fit."""
    return re.sub(r"[^!-~]", "_", name)[: _MAX_NAME - room] or "_"


class Grid(NamedTuple):
    """Grid of the coordinates of a LAS file along an axis: int32 numbers times the step, plus the offset."""

    step: float
    offset: float


def _grid(values: NDArray[np.floating]) -> Grid:
    """The coarsest decimal grid that has all coordinates of an axis; else one with the steps of `encode_las`."""
    if not len(values):
        return Grid(_COARSEST_STEP, 0.0)
    low, high = float(values.min()), float(values.max())
    rounding = float(np.spacing(values.dtype.type(max(abs(low), abs(high)))))
    middle = float(np.rint(0.5 * low + 0.5 * high))
    for offset in (middle, low):
        for step in _GRIDS:
            fits = step > _FINE_ENOUGH * rounding and max(high - offset, offset - low) <= _MAX_STEPS * step
            if fits and all(_on_grid(part, Grid(step, offset), rounding) for part in (values[:_SAMPLE], values)):
                return Grid(step, offset)
    finest = max((high - low) / _STEPS_PER_EXTENT, float(np.finfo(np.float64).tiny))
    step = _power_of_ten(min(_COARSEST_STEP, finest), np.floor)
    reach = max(high - middle, middle - low)
    if reach > _MAX_STEPS * step:
        step = _power_of_ten(reach / _MAX_STEPS, np.ceil)
        if step > max(rounding, _COARSEST_STEP):
            raise CloudWriteError(
                f"expected coordinates within {2.0 * _MAX_STEPS * _COARSEST_STEP / 1000:.0f} km of each other, as LAS "
                f"has 32 bits for each, got {low:g} to {high:g}: leave out points far away, or write .ply or .npz"
            )
    return Grid(step, middle)


def _on_grid(values: NDArray[np.floating], grid: Grid, rounding: float) -> bool:
    away = values.astype(np.float64) - grid.offset
    return bool((np.abs(away - np.rint(away / grid.step) * grid.step) <= 2.0 * rounding).all())


def _power_of_ten(value: float, rounded: Callable[[float], float]) -> float:
    return float(10.0 ** rounded(np.log10(value)))


LAS = Format("las", (".las", ".laz"), lambda file: read_las(file.content), encode_las)
COPC = Format("copc", (".copc.laz",), lambda file: read_las(file.content))
"""Files of this name are LAZ files whose points lie in an octree, which is not written."""
