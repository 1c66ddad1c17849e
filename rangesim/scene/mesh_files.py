# SPDX-License-Identifier: Apache-2.0
"""Checks of the PLY and serialized files that a scene names, before Mitsuba reads them.

Mitsuba 3.9 computes vertex normals while it loads a mesh. A face with the index of a missing vertex makes it read and
write outside of its arrays, and it takes a negative index for vertex 0.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from pcgraph.plumbing.plain_files import read_file
from rangesim.errors import FileFormatError
from rangesim.settings import limits
from rangesim.settings.config import brief, shown

_TYPES = (
    {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "long": "i8", "ulong": "u8"}
    | {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
    | {"half": "f2", "float": "f4", "double": "f8", "float16": "f2", "float32": "f4", "float64": "f8"}
)
"""NumPy's name of each type that a property of a PLY file may have for Mitsuba."""
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
"""NumPy's letter of the byte order for each format of a PLY file; empty for text."""
_MAX_HEADER = 1 << 20
"""Largest size of a header in bytes. A header is a few lines of text; without a limit, a huge file without an end of
header would be searched completely."""
_MAGIC = 0x041C
"""Number in the first two bytes of a serialized file, from the format of Mitsuba."""
_DOUBLE = 0x2000
"""Flag in a serialized file that its numbers are of double precision, from the format of Mitsuba."""
_NUMBERS_PER_VERTEX = {0x1: 3, 0x2: 2, 0x8: 3}
"""Count of numbers per vertex that each flag of a serialized file adds to the position: for a normal, texture
coordinates, and a colour."""
_CORNERS = 3
"""Count of entries in each list of a PLY face, because Mitsuba takes every face for a triangle."""


@dataclass
class _Element:
    """An element of a PLY file, such as "vertex" or "face".

    count : number of its records. types : NumPy type of each field of a record. corners : indices of the fields that
    are entries of a list.
    """

    name: str
    count: int
    types: list[str] = field(default_factory=list)
    corners: list[int] = field(default_factory=list)

    def add(self, words: list[str]) -> None:
        """Add the property that a line of the header states."""
        if words[1] == "list":
            start = len(self.types) + 1
            self.types += [_TYPES[words[2]]] + [_TYPES[words[3]]] * _CORNERS
            self.corners += range(start, start + _CORNERS)
        else:
            self.types.append(_TYPES[words[1]])
            if self.name == "face" and words[2] in ("i0", "i1", "i2"):  # Mitsuba's names for the entries of a list
                raise ValueError(f"a property named {words[2]}")


def check_ply(path: Path) -> None:
    """Raise FileFormatError if the file is no PLY file, or a triangle has the index of a missing vertex."""
    content = read_file(path, FileFormatError)
    try:
        order, elements, start = _header(content)
        indices = _indices(content, order, elements, start)
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from error
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise FileFormatError(f"{path} cannot be read as a PLY file of triangles: {brief(error)}.") from error
    _check_indices(indices, sum(element.count for element in elements if element.name == "vertex"), path)


def check_serialized(path: Path, index: int) -> None:
    """Raise FileFormatError as `check_ply` does, for mesh `index` of a file in Mitsuba's serialized format (3 or 4)."""
    content = read_file(path, FileFormatError)
    try:
        count, indices = _unpacked(content, index)
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from error
    except (ValueError, IndexError, OverflowError, struct.error, zlib.error) as error:
        raise FileFormatError(f"{path} cannot be read as a serialized mesh: {brief(error)}.") from error
    _check_indices(indices, count, path)


def _check_indices(indices: np.ndarray, count: int, path: Path) -> None:
    wrong = indices[~((indices >= 0) & (indices < count))]
    if wrong.size:
        raise FileFormatError(
            f"{path}: expected faces of its {count} vertices, 0 to {count - 1}, got vertex {wrong[0]:.15g}; "
            "repair the mesh first."
        )


def _unpacked(content: bytes, index: int) -> tuple[int, np.ndarray]:
    """Number of vertices of a mesh of a serialized file, and its (3 * number of faces,) uint32 indices."""
    magic, version = struct.unpack_from("<HH", content)
    if magic != _MAGIC or version not in (3, 4):
        raise ValueError("expected version 3 or 4 of the format")
    start = 0
    if index:
        (meshes,) = struct.unpack_from("<I", content, len(content) - 4)
        if not 0 < index < meshes:
            raise ValueError(f"expected a shape_index from 0 to {meshes - 1}, got {index}")
        place = 4 + 8 * (meshes - index) if version == 4 else 4 * (meshes - index + 1)
        if place > len(content):
            raise ValueError("it ends early")
        (start,) = struct.unpack_from("<Q" if version == 4 else "<I", content, len(content) - place)
    stream = zlib.decompressobj()
    head = stream.decompress(content[start + 4 :], _MAX_HEADER)
    (flags,) = struct.unpack_from("<I", head)
    place = head.index(b"\0", 4) + 1 if version == 4 else 4  # after the name of the mesh
    vertices, faces = struct.unpack_from("<QQ", head, place)
    limits.check("points", max(vertices, faces), "vertices or faces", FileFormatError)
    numbers = 3 + sum(size for flag, size in _NUMBERS_PER_VERTEX.items() if flags & flag)
    place += 16 + vertices * numbers * (8 if flags & _DOUBLE else 4)
    missing = place + 12 * faces - len(head)
    body = head + stream.decompress(stream.unconsumed_tail, missing) if missing > 0 else head
    return vertices, np.frombuffer(body, "<u4", 3 * faces, place) if faces else np.zeros(0, np.uint32)


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """NumPy's letter of the byte order (empty for text), the elements, and the byte at which their records start."""
    order, elements, start = None, list[_Element](), 0
    while True:
        end = content.find(b"\n", start, _MAX_HEADER)
        if end < 0:
            raise ValueError("its header has no end_header")
        words = content[start:end].decode("latin-1").split()
        start = end + 1
        kind = words[0] if words else ""
        if kind == "end_header":
            break
        if kind == "format":
            order = _FORMATS[words[1]]
        elif kind == "element":
            if not (words[2].isascii() and words[2].isdigit()):
                raise ValueError(f"expected a count of {words[1][:100]}, got {shown(words[2])}")
            elements.append(_Element(words[1], int(words[2])))
            limits.check("points", elements[-1].count, f"records of {words[1][:100]!r}", FileFormatError)
        elif kind == "property":
            elements[-1].add(words)
    names = [element.name for element in elements]
    for name in ("vertex", "face"):
        if names.count(name) > 1:
            raise ValueError(f"it has {names.count(name)} elements {name!r}")
    if order is None:
        raise ValueError("its header states no format")
    return order, elements, start


def _indices(content: bytes, order: str, elements: list[_Element], start: int) -> np.ndarray:
    """(k,) array of the vertex indices of all faces, in the type that the file has."""
    found = np.zeros(0, np.int64)
    words = iter(content[start:].split() if order == "" else ())
    for element in elements:
        if order == "":
            columns = _of_text(element, list(islice(words, element.count * len(element.types))))
        else:
            record = np.dtype([(f"p{i}", order + kind) for i, kind in enumerate(element.types)])
            size = element.count * record.itemsize
            if start + size > len(content):
                raise ValueError("it ends early")
            table = np.frombuffer(content, record, element.count if size else 0, start)
            columns = [table[f"p{i}"] for i in element.corners]
            start += size
        if element.name == "face" and columns:
            found = np.concatenate(columns)
    return found


def _of_text(element: _Element, words: list[bytes]) -> list[np.ndarray]:
    """The list entries of an element in a text file; ValueError if a word is no number of the type of its field."""
    width = len(element.types)
    if len(words) < element.count * width:
        raise ValueError("it ends early")
    columns = {}
    for i, kind in enumerate(element.types):
        read = float if kind.startswith("f") else int
        columns[i] = np.array([read(word) for word in words[i::width]], np.float64)
    return [columns[i] for i in element.corners]
