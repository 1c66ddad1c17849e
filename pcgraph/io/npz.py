# SPDX-License-Identifier: Apache-2.0
"""NumPy's files: archives (.npz) with the arrays of a cloud, and single arrays (.npy).

An archive has the key ``points`` (n, 3) or (h, w, 3), or Open3D's ``positions``, and the keys ``colors``, ``normals``,
``labels`` and ``viewpoint`` if the cloud has these. Every other array with the points' leading shape is a column; its
key is the name. The file of a saved segmentation has the cloud below ``cloud/``: ``cloud/points`` and so on, the
columns as ``cloud/columns/<name>``. Pickled objects are never loaded.
"""

from __future__ import annotations

import ast
import io
import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from typing import IO, NamedTuple

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pcgraph.cloud import (
    Cloud,
    are_labels,
    cloud_from_array,
    cloud_from_columns,
    color_bytes,
    columns_of_cloud,
    float_points,
    native,
)
from pcgraph.errors import CloudReadError
from pcgraph.io.format import MAX_HEADER_BYTES, Format

MAX_BYTES = 1 << 32
"""Largest size of all arrays that are read from one file, decompressed, bytes. A limit is needed because an archive of
4 MB can promise as much. 4 GiB are 100 million points of 40 bytes. `pcgraph.segment` needs 3.7 GB for 20 million
points, and would need some 18 GB for these."""
_MAX_MEMBERS = 4096
"""Largest count of arrays in an archive: far more than clouds have columns. Chosen by eye; not varied."""
_MAX_RATIO = 1040
"""Largest ratio of the bytes of data to those of the deflated file: the format cannot exceed 1032 (Deutsch 1996), and
some are for the frame. A member that promises more is damaged."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1
"""Bit of a member's flags that marks it as encrypted. Source: PKWARE's APPNOTE, section 4.4.4."""
_OWN = ("points", "colors", "normals", "labels", "viewpoint")
_CLOUD = "cloud/"
_COLUMNS = "columns/"
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, NotImplementedError, RuntimeError),
    *(ValueError, OverflowError, TypeError, SyntaxError, MemoryError, LookupError),
)
"""What zipfile, ast and NumPy raise for damaged files."""


# ---- Reading -------------------------------------------------------------------------------------------------------


def read_npz(content: bytes) -> Cloud:
    """Cloud of an .npz archive, given the file's bytes.

    Colours of other types become uint8, as in `cloud_from_columns`. Labels that int32 cannot hold stay a column.
    Matrices of each point become vectors, for example (n, 3, 3) becomes (n, 9). Arrays whose leading shape is not that
    of the points are not read.

    Raises
    ------
    CloudReadError
        The archive is damaged, has no points, or is larger than `MAX_BYTES`.

    Warns
    -----
    UserWarning
        An array with a row for each point is left out, because it holds texts, dates or other things than numbers.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return _cloud(_arrays(_members(archive), archive))
    except _BROKEN as error:
        raise CloudReadError(f"the .npz archive cannot be read: {str(error)[:200] or type(error).__name__}") from None


def read_npy(content: bytes) -> Cloud:
    """Cloud of an .npy array, given the file's bytes; `pcgraph.cloud.cloud_from_array` lists the shapes and types.

    Raises
    ------
    CloudReadError
        The file is damaged, or the array is not a cloud.
    """
    try:
        stream = io.BytesIO(content)
        header = _header(stream)
        _check_size(header, len(content) - stream.tell(), "the array")
        cloud = cloud_from_array(_numbers(stream, header))
    except _BROKEN as error:
        raise CloudReadError(f"the .npy array cannot be read: {str(error)[:200] or type(error).__name__}") from None
    return replace(cloud, points=float_points(cloud.points))


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Members of the archive that may belong to the cloud, by key."""
    entries = archive.infolist()
    if len(entries) > _MAX_MEMBERS:
        raise CloudReadError(f"expected at most {_MAX_MEMBERS} arrays, got {len(entries)}")
    keys = {entry.filename.removesuffix(".npy"): entry for entry in entries if entry.filename.endswith(".npy")}
    if f"{_CLOUD}points" in keys:
        keys = {key.removeprefix(_CLOUD): entry for key, entry in keys.items() if key.startswith(_CLOUD)}
    if "points" not in keys and "positions" in keys:  # Open3D's name
        keys["points"] = keys.pop("positions")
    if "points" not in keys and not {"x", "y", "z"} <= set(keys):
        found = ", ".join(keys)[:150] or "none"
        raise CloudReadError(f"expected an array 'points', or 'x', 'y' and 'z', found: {found}")
    return keys


def _arrays(members: Mapping[str, zipfile.ZipInfo], archive: zipfile.ZipFile) -> dict[str, NDArray[np.generic]]:
    """The points, the arrays with one row per point, and the viewpoint, by key."""
    arrays: dict[str, NDArray[np.generic]] = {}
    shape: tuple[int, ...] | None = None
    left, no_numbers = MAX_BYTES, []
    coordinates = ("points",) if "points" in members else ("x", "y", "z")
    for key in sorted(members, key=lambda key: key != coordinates[0]):  # which tells the leading shape of all others
        entry, name = members[key], f"the array {ascii(key)[:80]}"
        if entry.flag_bits & _ENCRYPTED or entry.compress_type not in _METHODS:
            raise CloudReadError(f"expected {name} stored or deflated, as numpy.savez writes it")
        with archive.open(entry) as stream:
            header = _header(stream)
            if shape is None:
                shape = header.shape[:-1] if key == "points" else header.shape
            is_per_point = header.shape[: len(shape)] == shape
            if header.dtype.kind not in "fiub" or not (is_per_point or key in _OWN):
                if key in coordinates:
                    raise CloudReadError(f"expected {name} as numbers, got {header.dtype}")
                no_numbers += [name] if is_per_point else []
                continue
            _check_size(header, min(entry.file_size, _MAX_RATIO * entry.compress_size), name)
            left -= header.n_bytes
            if left < 0:
                raise CloudReadError(f"expected arrays of at most {MAX_BYTES} bytes in all, decompressed")
            arrays[key] = _numbers(stream, header)
            rest = header.shape[len(shape) :]
            if len(rest) > 1 and key not in _OWN:
                arrays[key] = arrays[key].reshape(*shape, math.prod(rest))
    if no_numbers:
        warnings.warn(f"left out what holds no numbers: {', '.join(no_numbers)[:200]}", stacklevel=2)
    return arrays


def _cloud(arrays: dict[str, NDArray[np.generic]]) -> Cloud:
    further = {key.removeprefix(_COLUMNS): values for key, values in arrays.items() if key not in _OWN}
    if "points" in arrays:
        base = cloud_from_array(arrays["points"])
        base = replace(base, points=float_points(base.points), columns={**base.columns, **further})
    else:
        leading = arrays["x"].shape
        if len(leading) not in (1, 2):
            raise CloudReadError(f"expected x, y and z of shape (n,) or (h, w), got {leading}")
        columns = {name: values.reshape(-1, *values.shape[len(leading) :]) for name, values in further.items()}
        base = cloud_from_columns(columns, leading)
    shape = base.points.shape
    colors, normals = _own(arrays, "colors", shape), _own(arrays, "normals", shape)
    labels, viewpoint = _own(arrays, "labels", shape[:-1]), _own(arrays, "viewpoint", (3,), shape)
    if labels is not None and not are_labels(labels):
        base, labels = replace(base, columns=base.columns | {"labels": labels}), None
    return replace(
        base,
        colors=base.colors if colors is None else color_bytes(colors),
        normals=base.normals if normals is None else float_points(normals),
        labels=base.labels if labels is None else labels.astype(np.int32, copy=False),
        viewpoint=base.viewpoint if viewpoint is None else viewpoint.astype(np.float64, copy=False),
    )


def _own(arrays: dict[str, NDArray[np.generic]], name: str, *shapes: tuple[int, ...]) -> NDArray[np.generic] | None:
    """The array of a name, which must have one of the shapes; None if it is missing or empty."""
    values = arrays.get(name)
    if values is None or values.shape in shapes:
        return values
    if not values.size:
        return None
    raise CloudReadError(f"expected {name} of shape {' or '.join(map(str, shapes))}, got {values.shape}")


# ---- Arrays of a file ----------------------------------------------------------------------------------------------


class _Header(NamedTuple):
    """Shape, order and type of an array, from the header of an .npy file."""

    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype[np.generic]

    @property
    def n_bytes(self) -> int:
        """Bytes of the array's numbers."""
        return math.prod(self.shape) * self.dtype.itemsize


def _header(stream: IO[bytes]) -> _Header:
    """Header of an .npy file, versions 1 to 3; the stream is then at the first number."""
    magic = stream.read(8)
    if magic[:6] != b"\x93NUMPY" or magic[6:7] not in (b"\x01", b"\x02", b"\x03"):
        raise CloudReadError("expected an .npy array, but its first bytes are not those of version 1, 2 or 3")
    length = struct.Struct("<H" if magic[6] == 1 else "<I")
    (size,) = length.unpack(stream.read(length.size))
    if size > MAX_HEADER_BYTES:
        raise CloudReadError(f"expected the header of an array in {MAX_HEADER_BYTES} bytes, got {size}")
    told = ast.literal_eval(stream.read(size).decode("utf-8" if magic[6] == 3 else "latin-1").strip())
    if not isinstance(told, dict) or set(told) != {"descr", "fortran_order", "shape"}:
        raise CloudReadError("expected descr, fortran_order and shape in the header of an array")
    shape, dtype = told["shape"], npy_format.descr_to_dtype(told["descr"])
    if not isinstance(shape, tuple) or not all(type(length) is int and length >= 0 for length in shape):
        raise CloudReadError(f"expected the shape of an array, got {ascii(shape)[:80]}")
    if dtype.hasobject or not dtype.itemsize:
        raise CloudReadError(f"expected an array of numbers, got {dtype}; files with objects are never unpickled")
    return _Header(shape, told["fortran_order"] is True, dtype)


def _check_size(header: _Header, available: int, name: str) -> None:
    """Raise CloudReadError if the header promises more than the file holds, before memory is allocated."""
    if header.n_bytes > available:
        raise CloudReadError(f"the header of {name} promises {header.n_bytes} bytes, but only {available} can follow")


def _numbers(stream: IO[bytes], header: _Header) -> NDArray[np.generic]:
    content = stream.read(header.n_bytes)
    if len(content) < header.n_bytes:
        raise CloudReadError(f"an array is cut off: {len(content)} of {header.n_bytes} bytes are there")
    flat = np.frombuffer(content, header.dtype).copy()  # so that it can be written to
    return native(flat.reshape(header.shape, order="F" if header.is_fortran else "C"))


# ---- Writing -------------------------------------------------------------------------------------------------------


def encode_npz(cloud: Cloud) -> bytes:
    """Bytes of an .npz archive of the cloud's arrays, not compressed.

    The key of a column is its name, or ``columns/<name>`` if the name would be taken for another array of the cloud.
    """
    arrays: dict[str, NDArray[np.generic] | None] = {name: getattr(cloud, name) for name in _OWN}
    for name, column in cloud.columns.items():
        is_free = name not in _OWN and not name.startswith((_COLUMNS, _CLOUD))
        arrays[name if is_free else f"{_COLUMNS}{name}"] = column
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, values in arrays.items():
            if values is not None:
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                    npy_format.write_array(member, values, allow_pickle=False)
    return stream.getvalue()


def encode_npy(cloud: Cloud) -> bytes:
    """Bytes of an .npy file: the points if the cloud has nothing else, or a structured array of all columns."""
    columns = columns_of_cloud(cloud)
    shape = cloud.points.shape[:-1]
    table = np.empty(shape, [(name, column.dtype, column.shape[1:]) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column.reshape(*shape, *column.shape[1:])
    stream = io.BytesIO()
    if len(columns) == 3:
        npy_format.write_array(stream, cloud.points, allow_pickle=False)
    else:
        npy_format.write_array(stream, table, (3, 0), allow_pickle=False)  # names of fields in UTF-8
    return stream.getvalue()


NPZ = Format("npz", (".npz",), lambda file: read_npz(file.content), lambda cloud, _: encode_npz(cloud), organised=True)
NPY = Format("npy", (".npy",), lambda file: read_npy(file.content), lambda cloud, _: encode_npy(cloud), organised=True)
