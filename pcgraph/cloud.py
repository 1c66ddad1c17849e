# SPDX-License-Identifier: Apache-2.0
"""The point cloud as files hold it, and its making from the files' named columns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from pcgraph.errors import CloudReadError
from pcgraph.plumbing.short_repr import ShortRepr

Columns = Mapping[str, NDArray[np.generic]]
"""One array per field of a file."""

TextField = tuple[str, DTypeLike, int]
"""A field of a text file: its name, its type, and the count of its numbers for each point."""

MAX_HEADER_BYTES = 1 << 16
"""Bytes in which the header of a file must end: far more than headers have, so that a file without one is refused
before all of it is searched. Chosen by eye; not varied."""

NORMAL_NAMES = (("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))
PACKED_NAMES = ("rgb", "rgba")
COLOR_NAMES = ("red", "green", "blue")
LABEL_NAMES = ("label", "labels")


@dataclass(frozen=True, eq=False)
class Cloud(ShortRepr):
    """Points, and the columns that a file has for them.

    Attributes
    ----------
    points : (n, 3) or (h, w, 3) float32 or float64, metres, the file's frame
        Organised if the file is (PCD with HEIGHT > 1). NaN where the sensor saw nothing. They are float64 if the file
        has float64, integers of 64 bits, or whole numbers beyond 2**24, which float32 would round.
    colors : same leading shape + (3,), uint8, 0..255, or None
        Red, green, blue. Black where a text file has nan for a packed colour; None if it has nothing else.
    normals : same leading shape + (3,), float32 or float64, or None
        As stored; not checked for unit length.
    labels : same leading shape, int32, or None
        The file's own ``label`` or ``labels`` field, for example ground truth. Labels of unsigned 32 bits keep their
        bits: 4294967295, as PCL stores -1, is -1. A field of 64 bits that int32 does not hold stays in `columns`.
    viewpoint : (3,) float64, metres, or None
        Position of the sensor, from the PCD header; None if the format has none.
    columns : dict of name to array of the same leading shape, or that + (c,), of any dtype of numbers
        All other fields of the file, as stored: intensity, ring, time, classification and the like.
        `pcgraph.segment` takes them as `features` by name; `write_segmentation` writes them back.
    """

    points: NDArray[np.floating]
    colors: NDArray[np.uint8] | None = None
    normals: NDArray[np.floating] | None = None
    labels: NDArray[np.int32] | None = None
    viewpoint: NDArray[np.float64] | None = None
    columns: dict[str, NDArray[np.generic]] = field(default_factory=dict)

    @property
    def organised(self) -> bool:
        """Whether the points lie on an image lattice."""
        return self.points.ndim == 3


def cloud_from_columns(columns: Columns, shape: tuple[int, ...], viewpoint: NDArray[np.float64] | None = None) -> Cloud:
    """Cloud built from one array per field.

    Parameters
    ----------
    columns : mapping of field name to (n,) or (n, c) array
        Must hold ``x``, ``y``, ``z``. Colours (``rgb``/``rgba`` packed, or ``red``/``green``/``blue``), normals and
        labels are found under the names that PCL, Open3D and MeshLab write, in upper or lower case. White is 65535 in
        unsigned 16 bits, 1 in floats of at most 1, else 255. All other fields, and those of several numbers for each
        point, are kept as they are, but for ``_``, the name of padding in PCD files.
    shape : (n,) or (h, w)
        Leading shape of the result.
    viewpoint : (3,) float64, metres, optional

    Raises
    ------
    CloudReadError
        A coordinate is missing, or is not one number for each point.
    """
    stored, names = columns, _names_by_lower_case(columns)
    columns = {lower: stored[name] for lower, name in names.items() if stored[name].ndim == 1}
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        vectors = [name for name in missing if name in names]
        if vectors:
            count = stored[names[vectors[0]]].shape[1]
            raise CloudReadError(f"expected one number for each point in the field {vectors[0]!r}, got {count}")
        raise CloudReadError(
            f"expected the fields x, y and z, but {', '.join(missing)} is missing; found: {', '.join(columns)[:200]}"
        )
    of_colors, of_normals, of_labels = _color_names(columns), _normal_names(columns), _label_name(columns)
    used = {"_", *(names[lower] for lower in ("x", "y", "z", *of_colors, *of_normals, *of_labels))}
    return Cloud(
        points=_stack(columns, ("x", "y", "z"), shape),
        colors=_colors(columns, of_colors, shape),
        normals=_stack(columns, of_normals, shape) if of_normals else None,
        labels=columns[of_labels[0]].astype(np.int32).reshape(shape) if of_labels else None,
        viewpoint=viewpoint,
        columns={name: _kept(column, shape) for name, column in stored.items() if name not in used},
    )


def _stack(columns: Columns, names: tuple[str, ...], shape: tuple[int, ...]) -> NDArray[np.floating]:
    dtype = np.float64 if any(_is_wide(columns[name]) for name in names) else np.float32
    stacked = np.empty((*shape, len(names)), dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate(names):
            stacked[..., axis] = columns[name].reshape(shape)
    return stacked


def _is_wide(column: NDArray[np.generic]) -> bool:
    """Whether float32 would round the column: because of its type, or of whole numbers beyond 2**24."""
    if column.dtype.itemsize > 4:
        return True
    return column.dtype.kind in "iu" and max(abs(int(column.min(initial=0))), int(column.max(initial=0))) > 1 << 24


def _color_names(columns: Columns) -> tuple[str, ...]:
    for name in PACKED_NAMES:
        if name in columns and columns[name].dtype.itemsize == 4:
            return (name,)
    return COLOR_NAMES if all(name in columns for name in COLOR_NAMES) else ()


def _colors(columns: Columns, names: tuple[str, ...], shape: tuple[int, ...]) -> NDArray[np.uint8] | None:
    if len(names) == 1:
        bits = np.ascontiguousarray(columns[names[0]]).view(np.uint32)
        channels = [(bits >> shift) & 0xFF for shift in (16, 8, 0)]
        return np.stack(channels, axis=-1).astype(np.uint8).reshape(*shape, 3)
    if not names:
        return None
    stored = [columns[name] for name in names]
    if all(channel.dtype == np.uint8 for channel in stored):
        return np.stack(stored, axis=-1).astype(np.uint8).reshape(*shape, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.stack(stored, axis=-1).astype(np.float64)
        scaled = np.rint(values * (255.0 / _white(stored, values)))
    return np.clip(np.nan_to_num(scaled), 0, 255).astype(np.uint8).reshape(*shape, 3)


def _white(stored: list[NDArray[np.generic]], values: NDArray[np.float64]) -> float:
    """The number that means white: 65535 in unsigned 16 bits, 1 in floats of at most 1, else 255."""
    if all(channel.dtype.kind == "u" and channel.dtype.itemsize == 2 for channel in stored):
        return 65535.0
    floats = all(channel.dtype.kind == "f" for channel in stored)
    return 1.0 if floats and values.max(initial=0.0, where=np.isfinite(values)) <= 1.0 else 255.0


def _normal_names(columns: Columns) -> tuple[str, ...]:
    return next((names for names in NORMAL_NAMES if all(name in columns for name in names)), ())


def _label_name(columns: Columns) -> tuple[str, ...]:
    return tuple(name for name in LABEL_NAMES if name in columns and _are_labels(columns[name]))[:1]


def _are_labels(column: NDArray[np.generic]) -> bool:
    """Whether a column holds whole numbers that stay distinct as int32."""
    if column.dtype.kind not in "iu" or column.dtype.itemsize <= 4:
        return column.dtype.kind in "iu"
    limits = np.iinfo(np.int32)
    return limits.min <= int(column.min(initial=0)) and int(column.max(initial=0)) <= limits.max


def _names_by_lower_case(columns: Columns) -> dict[str, str]:
    """Names of columns by their lower-case forms; if two names have one form, the lower-case name counts."""
    found: dict[str, str] = {}
    for name in sorted(columns, key=lambda name: name != name.lower()):
        found.setdefault(name.lower(), name)
    return found


def _kept(column: NDArray[np.generic], shape: tuple[int, ...]) -> NDArray[np.generic]:
    """A copy of a column in a shape, so that the file's bytes need not stay in memory."""
    return column.reshape(*shape, *column.shape[1:]).copy()


def columns_from_text(table: NDArray[np.float64], fields: Iterable[TextField]) -> dict[str, NDArray[np.generic]]:
    """One array per field of a text file, in the types that the header names.

    A packed colour of nan means no colour, because a text does not keep the bits of a nan. It becomes 0, black; a field
    with no other colours is left out. Packed colours in whole numbers of 32 bits may have a sign or not, whatever the
    header says.

    Parameters
    ----------
    table : (n, m) float64
        Numbers of the text, row by row.
    fields : (name, dtype, count) of each field; the counts add up to m

    Returns
    -------
    dict of field name to (n,) array, (n, c) where the count is above 1

    Raises
    ------
    CloudReadError
        A field of integers has a number that is not whole, or out of the range of its type.
    """
    columns: dict[str, NDArray[np.generic]] = {}
    end = 0
    for name, dtype, count in fields:
        first, end = end, end + count
        numbers = table[:, first] if count == 1 else table[:, first:end]
        kind = np.dtype(dtype)
        is_packed = name.lower() in PACKED_NAMES and kind.itemsize == 4
        if is_packed and (none := np.isnan(numbers)).any():
            if none.all():
                continue
            numbers = np.where(none, 0.0, numbers)
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            least, most = (-(1 << 31), (1 << 32) - 1) if is_packed else (int(limits.min), int(limits.max))
            _check_whole(name, numbers, least, most)
        if is_packed and kind.kind in "iu":
            numbers = numbers.astype(np.int64)
        with np.errstate(over="ignore", invalid="ignore"):
            columns[name] = numbers.astype(kind)
    return columns


def _check_whole(name: str, numbers: NDArray[np.float64], least: int, most: int) -> None:
    """Raise CloudReadError if a field of integers cannot hold one of the numbers, (n,) or (n, c)."""
    wrong = ~((numbers >= float(least)) & (numbers <= float(most)) & (numbers == np.rint(numbers)))
    if wrong.any():
        row = int(np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))[0])
        got = f"{numbers[wrong][0]:.12g}"
        raise CloudReadError(
            f"the header says that {name!r} holds whole numbers from {least} to {most}, "
            f"but row {row + 1} of numbers has {got}: correct the type in the header, or the number"
        )


def numbers_from_text(body: bytes, n_rows: int, n_columns: int, first_line: int) -> NDArray[np.float64]:
    """The first `n_rows` rows of numbers in a text, one row per line; empty lines do not count.

    Parameters
    ----------
    body : bytes
        Lines that end in a line feed. Text after the last row is not read.
    n_rows, n_columns : int
    first_line : int
        Number of the body's first line in the file, from 1, for messages.

    Returns
    -------
    (n_rows, n_columns) float64
        ``nan`` and ``inf`` in any case are numbers too.

    Raises
    ------
    CloudReadError
        Too few rows, a row of more or fewer words than columns, or a word that is not a number.
    """
    needed = n_rows * n_columns
    if needed > len(body):  # a number takes at least a byte: no memory for numbers that only the header has
        raise CloudReadError(f"the header promises {needed} numbers, but only {len(body)} bytes follow")
    rows = _rows_of_text(body, n_rows, n_columns, first_line)
    # Not through an array of the words: each would take as many bytes as the longest.
    return np.fromiter(chain.from_iterable(rows), np.float64, needed).reshape(n_rows, n_columns)


def _rows_of_text(body: bytes, n_rows: int, n_columns: int, first_line: int) -> Iterator[list[float]]:
    """Numbers of each row."""
    left = n_rows
    lines = enumerate(BytesIO(body), first_line)
    while left:
        number, line = next(lines, (0, b""))
        if not number:
            raise CloudReadError(f"the header promises {n_rows} points, but {n_rows - left} rows of numbers follow")
        words = line.split(None, n_columns)
        if not words:
            continue
        if b"_" in line:  # only Python reads 1_000 as a number
            word = next((word for word in words if b"_" in word), line).decode("latin-1")
            raise CloudReadError(f"expected numbers only in the ascii data, got in line {number}: {word[:80]!r}")
        if len(words) != n_columns:
            got = f"more than {n_columns}" if len(words) > n_columns else f"{len(words)}"
            raise CloudReadError(
                f"expected {n_columns} numbers in each line, one for each field of the header, "
                f"but line {number} has {got}: correct the line or the header"
            )
        try:
            yield [float(word) for word in words]
        except ValueError as error:
            reason = str(error)[:120]
            raise CloudReadError(f"expected numbers only in the ascii data, got in line {number}: {reason}") from None
        left -= 1


def without_mask(values: ArrayLike) -> ArrayLike:
    """The numbers unchanged; a masked array becomes floats, with NaN where it is masked."""
    if not isinstance(values, np.ma.MaskedArray):
        return values
    if values.dtype.kind not in "fiu" or not np.ma.getmaskarray(values).any():
        return values.data
    return np.ma.filled(values.astype(np.result_type(values.dtype, np.float32)), np.nan)
