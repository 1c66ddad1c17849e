# SPDX-License-Identifier: Apache-2.0
"""PLY files (Stanford polygon format 1.0) in ascii and in either binary byte order; only the vertices are read."""

from __future__ import annotations

import struct
import warnings
from collections import deque
from dataclasses import dataclass, field
from io import BytesIO
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import (
    Cloud,
    cloud_from_columns,
    columns_of_cloud,
    native,
)
from pcgraph.errors import CloudReadError
from pcgraph.io.format import MAX_HEADER_BYTES, Format, check_words, field_name, field_word
from pcgraph.io.text_numbers import columns_from_text, columns_of_rows, numbers_of_words

Columns = dict[str, NDArray[np.generic]]

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_NAMES = {kind: name for name, kind in _TYPES.items() if name.isalpha()}
_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}
"""Format characters of Python's module struct for the types of list lengths."""
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_VERTICES = ("vertex", "vertices", "point", "points")
"""Names of the element that holds the points: first that of the standard, then those that other programs write."""
_INSTEAD = {"i8": "f8", "u8": "f8", "f2": "f4", "b1": "u1"}
"""Types that PLY does not have, and the types that are written instead."""


class PlyProperty(NamedTuple):
    """A property of an element: its name, its type, and for a list the type of its length, else ""."""

    name: str
    kind: str
    count_kind: str = ""


@dataclass
class PlyElement:
    """One element of a PLY header: its name, its count and its properties in file order."""

    name: str
    count: int
    properties: list[PlyProperty] = field(default_factory=list)

    @property
    def has_list(self) -> bool:
        """Whether a property is a list, so that rows may differ in length."""
        return any(one.count_kind for one in self.properties)


def read_ply(content: bytes) -> Cloud:
    """Cloud of the vertices of a PLY file, given the file's bytes, with colours, normals and labels.

    The element of the vertices may also be called ``vertices``, ``point`` or ``points``. A list property of the
    vertices, such as the views of a point, becomes a column (n, c) if all lists have the same length c. Else it is left
    out, because the rows of a column must have one length.

    Raises
    ------
    CloudReadError
        The header is damaged, vertices have no coordinates, the data are shorter than the header says, or a row of text
        has more or fewer numbers than the header has properties.
    """
    code, elements, body = _parse_header(content)
    vertices = _vertices(elements)
    for element in elements[: elements.index(vertices)]:
        body = _skip(element, code, body)
    names = [one.name for one in vertices.properties]
    if len(set(names)) != len(names) or not names:
        raise CloudReadError(f"expected distinct vertex properties, got {names}")
    if code == "ascii":
        first_line = content.count(b"\n", 0, len(content) - len(body)) + 1
        read = _listed_rows if vertices.has_list else _ascii_columns
        columns = read(vertices, body, first_line)
    else:
        columns = _binary_columns(vertices, _ORDERS[code], body)
    return cloud_from_columns(columns, (vertices.count,))


def encode_ply(columns: Columns) -> bytes:
    """Bytes of a binary little-endian PLY file with one vertex property per column.

    Parameters
    ----------
    columns : mapping of property name to (n,) array
        The types must be those of PLY: integers of up to 32 bits, float32 or float64.
    """
    record = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    n_points = len(next(iter(columns.values())))
    rows = np.empty(n_points, record)
    lines = [b"ply", b"format binary_little_endian 1.0", b"element vertex %d" % n_points]
    for name, column in columns.items():
        rows[name] = column
        lines.append(b"property %s %s" % (_NAMES[column.dtype.str[1:]].encode(), field_word(name)))
    return b"\n".join([*lines, b"end_header", b""]) + rows.tobytes()


def _encode(cloud: Cloud, suffix: str) -> bytes:
    parts: list[tuple[str, NDArray[np.generic]]] = []
    for name, column in columns_of_cloud(cloud).items():
        values = _for_ply(name, column)
        parts += [(name, values)] if values.ndim == 1 else [(f"{name}_{i}", part) for i, part in enumerate(values.T)]
    check_words([name for name, _ in parts])
    return encode_ply(dict(parts))


def _for_ply(name: str, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """The values in a type that PLY has; only whole numbers beyond 2**53 are rounded."""
    instead = _INSTEAD.get(values.dtype.str[1:], "f8" if values.dtype.itemsize > 8 else None)
    if instead is None:
        return values
    with np.errstate(over="ignore"):
        written = values.astype(instead)
    if values.dtype.kind in "iu" and int(np.abs(written).max(initial=0)) > 1 << 53:
        warnings.warn(
            f"PLY rounds the column {name!r} to doubles, as it has no integers of 64 bits; .pcd and .npz keep them",
            stacklevel=2,
        )
    return written


# ---- Header --------------------------------------------------------------------------------------------------------


def _parse_header(content: bytes) -> tuple[str, list[PlyElement], bytes]:
    content = content.removeprefix(b"\xef\xbb\xbf")  # of UTF-8, as editors on Windows put it there
    if content[:4] == b"ply\r" and content[4:5] != b"\n":
        content = _with_line_feeds(content)
    end = content.find(b"\nend_header", 0, MAX_HEADER_BYTES)
    newline = content.find(b"\n", end + 1)
    if content[:3].lower() != b"ply" or end < 0 or newline < 0:
        raise CloudReadError("expected a PLY header from 'ply' to 'end_header', but found none")
    code = ""
    elements: list[PlyElement] = []
    # Of bytes, because str has line ends and blanks that are parts of letters in UTF-8.
    for line in content[:end].split(b"\n")[1:]:
        words = [field_name(word) for word in line.split()]
        if words[:1] == ["format"] and len(words) == 3:
            if code:
                raise CloudReadError(f"expected one format line in the PLY header, got {code!r} and {words[1]!r}")
            code = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
            elements.append(PlyElement(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(words))
        elif words and words[0] not in ("comment", "obj_info"):
            raise CloudReadError(f"PLY header line not understood: {' '.join(words)[:80]!r}")
    if code not in _ORDERS:
        raise CloudReadError(f"expected PLY format {', '.join(_ORDERS)}, got {code!r}")
    return code, elements, content[newline + 1 :]


def _with_line_feeds(content: bytes) -> bytes:
    """The content of a file from old Macintosh systems with line feeds for carriage returns; binary data stay."""
    end = content.find(b"\r", content.find(b"\rend_header", 0, MAX_HEADER_BYTES) + 1) + 1
    header, body = content[:end].replace(b"\r", b"\n"), content[end:]
    return header + (body.replace(b"\r", b"\n") if b"\nformat ascii" in header else body)


def _property(words: list[str]) -> PlyProperty:
    if len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES:
        count_kind = _TYPES[words[2]]
        if count_kind[0] != "f":
            return PlyProperty(words[4], _TYPES[words[3]], count_kind)
    elif len(words) == 3 and words[1] in _TYPES:
        return PlyProperty(words[2], _TYPES[words[1]])
    raise CloudReadError(f"PLY property not understood: {' '.join(words)[:80]!r}")


def _vertices(elements: list[PlyElement]) -> PlyElement:
    """The element that holds the points."""
    for name in _VERTICES:
        found = [element for element in elements if element.name.lower() == name]
        if len(found) > 1:
            counts = " and ".join(str(element.count) for element in found[:2])
            raise CloudReadError(f"expected one element called {name} in the PLY header, got {len(found)}, of {counts}")
        if found:
            return found[0]
    raise CloudReadError("expected a PLY element called vertex, but the header names none")


# ---- Ascii data ----------------------------------------------------------------------------------------------------


def _ascii_columns(element: PlyElement, body: bytes, first_line: int) -> Columns:
    return columns_of_rows(body, element.count, [(one.name, one.kind, 1) for one in element.properties], first_line)


def _listed_rows(element: PlyElement, body: bytes, first_line: int) -> Columns:
    """Columns of text rows with lists; the length of a list stands before its numbers."""
    if element.count * len(element.properties) > len(body):
        raise CloudReadError(f"the PLY header promises {element.count} vertices, but only {len(body)} bytes follow")
    lines = ((number, line) for number, line in enumerate(BytesIO(body), first_line) if line.strip())
    values: list[list[list[float]]] = [[] for _ in element.properties]
    n_rows = 0
    for number, line in islice(lines, element.count):
        numbers, at = numbers_of_words(line.split(), line, number), 0
        for one, rows in zip(element.properties, values, strict=True):
            length = 1
            if one.count_kind:
                length, at = _length(numbers[at : at + 1], number), at + 1
            rows.append(numbers[at : at + length])
            at += length
        if at != len(numbers):
            raise CloudReadError(
                f"expected {at} numbers in line {number}, as its lists tell, got {len(numbers)}: correct the line"
            )
        n_rows += 1
    if n_rows < element.count:
        raise CloudReadError(f"the header promises {element.count} points, but {n_rows} rows of numbers follow")
    columns: Columns = {}
    for one, rows in zip(element.properties, values, strict=True):
        lengths = {len(row) for row in rows}
        if len(lengths) == 1 and (length := lengths.pop()):
            table = np.array(rows, np.float64).reshape(n_rows, length)
            columns |= columns_from_text(table, [(one.name, one.kind, length)])
        elif not one.count_kind:
            columns[one.name] = np.empty(0, one.kind)
    return columns


def _length(word: list[float], number: int) -> int:
    """Length of a list from the number before it; raises CloudReadError if that is not a length."""
    if word and word[0] >= 0 and word[0].is_integer():
        return int(word[0])
    raise CloudReadError(f"expected the length of a list in line {number}, got {word[0] if word else 'nothing'}")


# ---- Binary data ---------------------------------------------------------------------------------------------------


def _skip(element: PlyElement, code: str, body: bytes) -> bytes:
    """The bytes after the rows of an element; empty lines of a text are not rows."""
    if code == "ascii":
        lines = BytesIO(body)
        rows = (line for line in lines if line.strip())
        deque(islice(rows, element.count if element.properties else 0), maxlen=0)
        return body[lines.tell() :]
    record = _common_record(element, _ORDERS[code], body)
    size = element.count * record.itemsize if record is not None else _scattered(element, _ORDERS[code], body).end
    return body[size:]


def _binary_columns(element: PlyElement, order: str, body: bytes) -> Columns:
    record = _common_record(element, order, body)
    if record is None:
        columns = _scattered(element, order, body).columns(element, order, body)
    else:
        needed = element.count * record.itemsize
        if len(body) < needed:
            raise CloudReadError(
                f"the PLY header promises {element.count} vertices ({needed} bytes), but only {len(body)} bytes follow"
            )
        rows = np.frombuffer(body, record, count=element.count)
        columns = {one.name: native(rows[f"value {i}"]) for i, one in enumerate(element.properties)}
    return {
        name: column[:, 0] if column.shape[1:] == (1,) else column
        for name, column in columns.items()
        if column.shape[1:] != (0,)
    }


def _common_record(element: PlyElement, order: str, body: bytes) -> np.dtype[np.void] | None:
    """The record type of all rows of an element; None if lists differ in length, or if the data end too soon to tell.

    It has the fields ``length i`` and ``value i`` of each property i.
    """
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for i, one in enumerate(element.properties):
        if not one.count_kind:
            fields.append((f"value {i}", order + one.kind))
            continue
        fields.append((f"length {i}", order + one.count_kind))
        first = np.dtype(fields)
        length = 0
        if element.count:
            if first.itemsize > len(body):
                return None
            length = int(np.frombuffer(body, first, 1)[f"length {i}"][0])
        if not 0 <= length <= len(body):
            return None
        fields.append((f"value {i}", order + one.kind, (length,)))
    record = np.dtype(fields)  # type: ignore[arg-type]
    if not element.has_list or not element.count:
        return record
    if element.count * record.itemsize > len(body):
        return None
    rows = np.frombuffer(body, record, element.count)
    counts = [rows[f"length {i}"] for i, one in enumerate(element.properties) if one.count_kind]
    return record if all((count == count[0]).all() for count in counts) else None


class _Scattered(NamedTuple):
    """Byte offsets of the numbers in rows of different lengths.

    Attributes
    ----------
    starts : (n, p) int64
        Offset of the first number of each row and property.
    lengths : (n, p) int64
        Count of the numbers of each row and property; 1 if the property is not a list.
    end : int
        Offset after the last row.
    """

    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    end: int

    def columns(self, element: PlyElement, order: str, body: bytes) -> Columns:
        """Columns of the properties that have the same length in all rows."""
        content = np.frombuffer(body, np.uint8)
        columns: Columns = {}
        for one, starts, lengths in zip(element.properties, self.starts.T, self.lengths.T, strict=True):
            if (lengths == lengths[0]).all():
                kind = np.dtype(order + one.kind)
                places = starts[:, None] + np.arange(int(lengths[0]) * kind.itemsize)
                values = native(content[places].view(kind))
                columns[one.name] = values if one.count_kind else values[:, 0]
        return columns


def _scattered(element: PlyElement, order: str, body: bytes) -> _Scattered:
    """Byte offsets of an element's numbers, found row by row."""
    sizes = [np.dtype(one.kind).itemsize for one in element.properties]
    counts = [struct.Struct(order + _LETTERS[one.count_kind]) if one.count_kind else None for one in element.properties]
    least = sum(size if count is None else count.size for size, count in zip(sizes, counts, strict=True))
    promise = f"the PLY header promises {element.count} rows of {element.name!r}"
    if element.count * least > len(body):
        raise CloudReadError(f"{promise} ({element.count * least} bytes), but only {len(body)} bytes follow")
    starts = np.empty((element.count, len(sizes)), np.int64)
    lengths = np.ones((element.count, len(sizes)), np.int64)
    at = 0
    for row in range(element.count):
        for i, (size, count) in enumerate(zip(sizes, counts, strict=True)):
            length = 1
            if count is not None:
                if at + count.size > len(body):
                    raise CloudReadError(f"{promise}, but the data end in row {row + 1}")
                length, at = count.unpack_from(body, at)[0], at + count.size
                lengths[row, i] = length
            starts[row, i] = at
            at += length * size
            if length < 0 or at > len(body):
                raise CloudReadError(f"{promise}, but the data end in row {row + 1}, or its list is damaged")
    return _Scattered(starts, lengths, at)


PLY = Format("ply", (".ply",), lambda file: read_ply(file.content), _encode)
