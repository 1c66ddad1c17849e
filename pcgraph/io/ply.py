# SPDX-License-Identifier: Apache-2.0
"""PLY files (Stanford polygon format 1.0), ascii and both binary byte orders; only vertices are read."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from io import BytesIO
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import MAX_HEADER_BYTES, Cloud, cloud_from_columns, columns_from_text, numbers_from_text
from pcgraph.errors import CloudReadError
from pcgraph.io.format import Format

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {kind: name for name, kind in _TYPES.items() if name.isalpha()}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}


@dataclass
class PlyElement:
    """One element of a PLY header: its name, its count and its scalar properties in file order."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read_ply(content: bytes) -> Cloud:
    """Cloud of the vertices of a PLY file, given the file's bytes, with colours, normals and labels.

    Raises
    ------
    CloudReadError
        The header is broken, vertices have no coordinates, the data are shorter than the header says, or a row of text
        has more or fewer numbers than the header has properties.
    """
    code, elements, body = _parse_header(content)
    for element in elements:
        if element.has_list and (element.name == "vertex" or code != "ascii"):
            raise CloudReadError(f"expected scalar properties up to the vertices, but {element.name!r} has a list")
        if element.name == "vertex":
            break
        body = _skip(element, code, body)
    else:
        raise CloudReadError("expected a PLY element called vertex, but the header names none")
    names = [name for name, _ in element.properties]
    if len(set(names)) != len(names) or not names:
        raise CloudReadError(f"expected distinct vertex properties, got {names}")
    if code == "ascii":
        columns = _ascii_columns(element, body, first_line=content.count(b"\n", 0, len(content) - len(body)) + 1)
    else:
        columns = _binary_columns(element, code, body)
    return cloud_from_columns(columns, (element.count,))


def encode_ply(columns: dict[str, NDArray[np.generic]], comment: str = "") -> bytes:
    """Bytes of a binary little-endian PLY file with one vertex property per column.

    Parameters
    ----------
    columns : mapping of property name to (n,) array
        Names are words of Latin-1. Types are those of PLY: integers of up to 32 bits, float32 or float64.
    comment : str
        A line of the header; none if empty.
    """
    record = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    n_points = len(next(iter(columns.values())))
    rows = np.empty(n_points, record)
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment {comment}"] if comment else []),
        f"element vertex {n_points}",
    ]
    for name, column in columns.items():
        rows[name] = column
        lines.append(f"property {_NAMES[column.dtype.str[1:]]} {name}")
    return ("\n".join([*lines, "end_header"]) + "\n").encode("latin-1") + rows.tobytes()


def _parse_header(content: bytes) -> tuple[str, list[PlyElement], bytes]:
    end = content.find(b"\nend_header", 0, MAX_HEADER_BYTES)
    newline = content.find(b"\n", end + 1)
    if not content.startswith(b"ply") or end < 0 or newline < 0:
        raise CloudReadError("expected a PLY header from 'ply' to 'end_header', but found none")
    code = ""
    elements: list[PlyElement] = []
    # Of bytes, because str has line ends and blanks that are parts of letters in UTF-8.
    for line in content[:end].split(b"\n")[1:]:
        words = [word.decode("latin-1") for word in line.split()]
        if words[:1] == ["format"] and len(words) == 3:
            if code:
                raise CloudReadError(f"expected one format line in the PLY header, got {code!r} and {words[1]!r}")
            code = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
            elements.append(PlyElement(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            _add_property(elements[-1], words)
        elif words and words[0] not in ("comment", "obj_info"):
            raise CloudReadError(f"PLY header line not understood: {' '.join(words)[:80]!r}")
    vertices = [element.count for element in elements if element.name == "vertex"]
    if len(vertices) > 1:
        counts = " and ".join(map(str, vertices[:2]))
        raise CloudReadError(f"expected one element called vertex in the PLY header, got {len(vertices)}, of {counts}")
    if code not in _ORDERS:
        raise CloudReadError(f"expected PLY format {', '.join(_ORDERS)}, got {code!r}")
    return code, elements, content[newline + 1 :]


def _add_property(element: PlyElement, words: list[str]) -> None:
    if len(words) == 5 and words[1] == "list":
        element.has_list = True
    elif len(words) == 3 and words[1] in _TYPES:
        element.properties.append((words[2], _TYPES[words[1]]))
    else:
        raise CloudReadError(f"PLY property not understood: {' '.join(words)[:80]!r}")


def _record(element: PlyElement, code: str) -> np.dtype[np.void]:
    return np.dtype([(name, _ORDERS[code] + kind) for name, kind in element.properties])


def _skip(element: PlyElement, code: str, body: bytes) -> bytes:
    """The bytes after an element; of a text, the lines after its rows, where empty lines are no rows."""
    if code == "ascii":
        lines = BytesIO(body)
        rows = (line for line in lines if line.strip())
        has_rows = element.has_list or bool(element.properties)
        deque(islice(rows, element.count if has_rows else 0), maxlen=0)
        return body[lines.tell() :]
    size = sum(int(kind[1]) for _, kind in element.properties)
    return body[element.count * size :]


def _ascii_columns(element: PlyElement, body: bytes, first_line: int) -> dict[str, NDArray[np.generic]]:
    table = numbers_from_text(body, element.count, len(element.properties), first_line)
    return columns_from_text(table, ((name, kind, 1) for name, kind in element.properties))


def _binary_columns(element: PlyElement, code: str, body: bytes) -> dict[str, NDArray[np.generic]]:
    record = _record(element, code)
    needed = element.count * record.itemsize
    if len(body) < needed:
        raise CloudReadError(
            f"the PLY header promises {element.count} vertices ({needed} bytes), but only {len(body)} bytes follow"
        )
    rows = np.frombuffer(body, record, count=element.count)
    return {name: rows[name].astype(kind, copy=False) for name, kind in element.properties}


PLY = Format("ply", (".ply",), lambda file: read_ply(file.content))
