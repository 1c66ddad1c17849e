# SPDX-License-Identifier: Apache-2.0
"""PCD files, PCL's Point Cloud Data format: versions 0.5 to 0.7 in ascii, binary and binary_compressed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import (
    COLOR_NAMES,
    NORMAL_NAMES,
    PACKED_NAMES,
    Cloud,
    cloud_from_columns,
    columns_of_cloud,
)
from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.io.format import MAX_HEADER_BYTES, Format, check_words, field_name, field_word
from pcgraph.io.text_numbers import columns_of_rows

_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_INSTEAD = {"f2": "f4", "b1": "u1"}
"""Types that PCD does not have, and the types that are written instead."""
_MAX_NUMBER = 10**15
"""Largest whole number of a header, such as the count of points: no file holds as many, and NumPy still takes it as the
length of an array of no bytes. Chosen by eye; not varied."""


@dataclass(frozen=True, eq=False)
class PcdHeader:
    """The fields, size and coding of a PCD file, as its header says.

    Attributes
    ----------
    names, dtypes, counts : tuples with an entry for each field
        Name, little-endian scalar type, and count of numbers per point.
    width, height : int
        Size of the lattice; an unorganised cloud has the height 1.
    viewpoint : (3,) float64, metres, or None
        Position of the sensor. None if it is missing, damaged, or (0, 0, 0), which PCL writes for an unknown position.
    data : str
        ``ascii``, ``binary`` or ``binary_compressed``.
    n_lines : int
        Number of lines of the header.
    """

    names: tuple[str, ...]
    dtypes: tuple[np.dtype[np.generic], ...]
    counts: tuple[int, ...]
    width: int
    height: int
    viewpoint: NDArray[np.float64] | None
    data: str
    n_lines: int

    @property
    def n_points(self) -> int:
        """Number of points, width x height."""
        return self.width * self.height

    @property
    def shape(self) -> tuple[int, ...]:
        """Leading shape of the cloud: (n,), or (h, w) when organised."""
        return (self.n_points,) if self.height == 1 else (self.height, self.width)


def read_pcd(content: bytes) -> Cloud:
    """Cloud of a PCD file, given the file's bytes, with organisation, NaN, colours, normals and labels.

    Headers of older versions are understood as PCL does: ``COLUMNS`` means FIELDS, numbers without SIZE and TYPE are
    float32, and a cloud without HEIGHT is a list. The orientation in VIEWPOINT and the alpha of ``rgba`` are not read.

    Raises
    ------
    CloudReadError
        The header is incomplete or contradicts itself, the data are shorter than the header says, or a row of text has
        more or fewer numbers than the header has fields.
    """
    header, body = _parse_header(content)
    readers = {"ascii": _ascii_columns, "binary": _binary_columns, "binary_compressed": _compressed_columns}
    if header.data not in readers:
        raise CloudReadError(f"expected DATA ascii, binary or binary_compressed, got {header.data!r}")
    return cloud_from_columns(readers[header.data](header, body), header.shape, header.viewpoint)


def _parse_header(content: bytes) -> tuple[PcdHeader, bytes]:
    entries: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in entries:
        end = content.find(b"\n", position, MAX_HEADER_BYTES)
        if end < 0:
            raise CloudReadError("expected a PCD header that ends in a DATA line, but found none")
        words = [field_name(word) for word in content[position:end].split()]  # str.split knows more blanks
        position = end + 1
        if words and not words[0].startswith("#"):
            key = words[0].upper()
            key = "FIELDS" if key == "COLUMNS" else key
            if key in entries:
                raise CloudReadError(f"expected one {key[:20]} line in the PCD header, got two")
            entries[key] = words[1 : words.index("#") if "#" in words else None]
    if "WIDTH" not in entries and "HEIGHT" not in entries and "POINTS" in entries:
        entries["WIDTH"] = entries["POINTS"]
    missing = [key for key in ("FIELDS", "WIDTH", "DATA") if not entries.get(key)]
    if missing:
        raise CloudReadError(f"expected PCD header lines FIELDS, WIDTH and DATA; missing: {', '.join(missing)}")
    return _checked_header(entries, content.count(b"\n", 0, position)), content[position:]


def _checked_header(entries: dict[str, list[str]], n_lines: int) -> PcdHeader:
    names = tuple(entries["FIELDS"])
    counts = _integers(entries, "COUNT", default=[1] * len(names))
    sizes = _integers(entries, "SIZE", default=[4] * len(names))
    kinds = [kind.upper() for kind in entries.get("TYPE", ["F"] * len(names))]
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise CloudReadError(
            f"expected as many SIZE, TYPE and COUNT entries as FIELDS ({len(names)}), "
            f"got {len(sizes)}, {len(kinds)} and {len(counts)}"
        )
    fields = [name for name in names if name != "_"]  # there may be padding in several places
    if len(set(fields)) != len(fields):
        raise CloudReadError(f"expected distinct FIELDS in the PCD header, got {' '.join(names)[:80]}")
    dtypes = []
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        if kind not in _KINDS or size not in _SIZES[kind] or not 1 <= count <= 4096:
            raise CloudReadError(f"field {name!r}: TYPE {kind}, SIZE {size}, COUNT {count} is not a PCD number type")
        dtypes.append(np.dtype(f"<{_KINDS[kind]}{size}"))
    width, height = _integers(entries, "WIDTH")[0], _integers(entries, "HEIGHT", default=[1])[0]
    points = _integers(entries, "POINTS")[0] if entries.get("POINTS") else width * height
    if min(width, height) < 0 or points != width * height:
        raise CloudReadError(f"expected POINTS = WIDTH x HEIGHT, got {points} != {width} x {height}")
    viewpoint = _viewpoint(entries.get("VIEWPOINT", []))
    return PcdHeader(names, tuple(dtypes), tuple(counts), width, height, viewpoint, entries["DATA"][0].lower(), n_lines)


def _integers(entries: dict[str, list[str]], key: str, default: list[int] | None = None) -> list[int]:
    words = entries.get(key)
    if words is None and default is not None:
        return default
    try:
        numbers = [int(word) for word in words or ["none"]]
    except ValueError:
        numbers = [_MAX_NUMBER + 1]
    if max(map(abs, numbers), default=0) > _MAX_NUMBER:
        got = " ".join(words or [])[:80]
        raise CloudReadError(f"expected whole numbers up to {_MAX_NUMBER} after {key} in the PCD header, got {got}")
    return numbers


def _viewpoint(words: list[str]) -> NDArray[np.float64] | None:
    try:
        position = np.array([float(word) for word in words[:3]])
    except ValueError:
        return None
    return position if position.shape == (3,) and np.isfinite(position).all() and position.any() else None


def _ascii_columns(header: PcdHeader, body: bytes) -> dict[str, NDArray[np.generic]]:
    fields = list(zip(header.names, header.dtypes, header.counts, strict=True))
    return columns_of_rows(body, header.n_points, fields, header.n_lines + 1)


def _binary_columns(header: PcdHeader, body: bytes) -> dict[str, NDArray[np.generic]]:
    fields = zip(header.dtypes, header.counts, strict=True)
    record = np.dtype([(f"f{i}", dtype, (count,)) for i, (dtype, count) in enumerate(fields)])
    _check_length(len(body), header.n_points * record.itemsize, header)
    rows = np.frombuffer(body, record, count=header.n_points)
    return {name: _without_axis(rows[f"f{i}"]) for i, name in enumerate(header.names)}


def _compressed_columns(header: PcdHeader, body: bytes) -> dict[str, NDArray[np.generic]]:
    per_point = sum(dtype.itemsize * count for dtype, count in zip(header.dtypes, header.counts, strict=True))
    if len(body) < 8:
        raise CloudReadError("the compressed PCD data is cut off before its two sizes")
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", count=2))
    _check_length(unpacked, header.n_points * per_point, header)
    # LZF shrinks at most 264 bytes to 3. No memory is allocated for a size above that, which must be wrong.
    if packed > len(body) - 8 or unpacked > 88 * packed + 264:
        raise CloudReadError(f"the PCD data promises {packed} compressed bytes, but {len(body) - 8} are left")
    target = np.empty(unpacked, np.uint8)
    if lzf_decompressor()(np.frombuffer(body, np.uint8, count=packed, offset=8), target) != unpacked:
        raise CloudReadError("the compressed PCD data is damaged and cannot be unpacked")
    columns: dict[str, NDArray[np.generic]] = {}
    start = 0
    for name, dtype, count in zip(header.names, header.dtypes, header.counts, strict=True):
        end = start + header.n_points * dtype.itemsize * count
        columns[name] = _without_axis(target[start:end].view(dtype).reshape(header.n_points, count))
        start = end
    return columns


def _without_axis(values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Values of a field: (n, c) unchanged, but (n, 1) as (n,)."""
    return values[:, 0] if values.shape[1] == 1 else values


def _check_length(available: int, needed: int, header: PcdHeader) -> None:
    if available < needed:
        raise CloudReadError(
            f"the PCD header promises {header.n_points} points ({needed} bytes), but only {available} bytes follow"
        )


# ---- LZF, the coding of binary_compressed data -----------------------------------------------------------------------


@cache
def lzf_decompressor() -> Callable[[NDArray[np.uint8], NDArray[np.uint8]], int]:
    """The compiled `decompress_lzf`; numba is imported here, so that only compressed files need it."""
    from pcgraph.kernel_cache import cached_njit

    return cached_njit()(decompress_lzf)


def decompress_lzf(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> int:
    """Decompress an LZF stream; returns the number of bytes written to `target`, or -1 if it is damaged or does not
    fit.

    Parameters
    ----------
    source : (c,) uint8
        LZF stream. A control byte below 32 is followed by control + 1 literal bytes. Any other one stands for a copy of
        ``(control >> 5) + 2`` bytes from up to 8191 bytes back; if ``control >> 5`` is 7, the next byte adds to the
        length.
    target : (u,) uint8
        Filled from the front.

    Notes
    -----
    Every read and write is checked against the bounds, and every step consumes input, so no stream can crash or hang
    it. Source of the format: the documentation of M. Lehmann's liblzf; the code is new.
    """
    read, wrote = 0, 0
    n_source, n_target = source.size, target.size
    while read < n_source:
        control = int(source[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > n_source or wrote + length > n_target:
                return -1
            for offset in range(length):  # a loop, because slices take the compiler seconds
                target[wrote + offset] = source[read + offset]
            read += length
        else:
            length = control >> 5
            if read + (2 if length == 7 else 1) > n_source:
                return -1
            if length == 7:
                length += int(source[read])
                read += 1
            start = wrote - ((control & 31) << 8) - int(source[read]) - 1
            read += 1
            length += 2
            if start < 0 or wrote + length > n_target:
                return -1
            for offset in range(length):  # byte by byte, because a copy may overlap itself
                target[wrote + offset] = target[start + offset]
        wrote += length
    return wrote


# ---- Writing ---------------------------------------------------------------------------------------------------------


def encode_pcd(cloud: Cloud) -> bytes:
    """Bytes of a binary PCD file, version 0.7.

    Colours are packed as ``rgb`` and normals are called ``normal_x`` and so on, as PCL and Open3D expect. The
    orientation of the sensor is the identity, 1 0 0 0.

    Raises
    ------
    CloudWriteError
        Two columns have the same name once blanks are underscores, or a column has numbers of more than 64 bits.
    """
    columns = columns_of_cloud(cloud, colors=(PACKED_NAMES[:1], COLOR_NAMES), normals=NORMAL_NAMES)
    check_words(list(columns))
    fields = []
    for i, (name, column) in enumerate(columns.items()):
        kind = _INSTEAD.get(column.dtype.str[1:], column.dtype.str[1:])
        if int(kind[1:]) > 8:
            raise CloudWriteError(f"expected columns of at most 64 bits, got {column.dtype} in the column {name!r}")
        fields.append((f"f{i}", f"<{kind}", column.shape[1:]))
    rows = np.empty(cloud.points[..., 0].size, fields)
    for i, column in enumerate(columns.values()):
        rows[f"f{i}"] = column
    kinds = [rows.dtype[name] for name, _, _ in fields]
    height, width = cloud.points.shape[:2] if cloud.organised else (1, len(cloud.points))
    at = cloud.viewpoint if cloud.viewpoint is not None and cloud.viewpoint.ndim == 1 else np.zeros(3)
    lines = [
        b"# .PCD v0.7 - Point Cloud Data file format",
        b"VERSION 0.7",
        b"FIELDS " + b" ".join(field_word(name) for name in columns),
        b"SIZE " + b" ".join(b"%d" % kind.base.itemsize for kind in kinds),
        b"TYPE " + b" ".join(kind.base.kind.upper().encode() for kind in kinds),
        b"COUNT " + b" ".join(b"%d" % (kind.shape or (1,))[0] for kind in kinds),
        b"WIDTH %d" % width,
        b"HEIGHT %d" % height,
        f"VIEWPOINT {' '.join(repr(float(metres)) for metres in at)} 1 0 0 0".encode(),
        b"POINTS %d" % len(rows),
        b"DATA binary",
        b"",
    ]
    return b"\n".join(lines) + rows.tobytes()


PCD = Format("pcd", (".pcd",), lambda file: read_pcd(file.content), lambda cloud, _: encode_pcd(cloud), organised=True)
