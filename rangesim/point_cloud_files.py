# SPDX-License-Identifier: Apache-2.0
"""Point clouds as binary PLY and PCD files.

Fields: x y z, and where present normals, intensity, colour and confidence, under the names that Open3D, PCL
and MeshLab know. The frame goes into a comment line.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from pathlib import Path

import numpy as np

from rangesim.errors import FileFormatError
from rangesim.point_cloud import FRAMES, PointCloud

_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short",
              "u4": "uint", "i4": "int"}  # fmt: skip
_PLY_DTYPES = {name: code for code, name in _PLY_TYPES.items()} | {"float32": "f4", "float64": "f8", "uint8": "u1"}


def save_point_cloud(cloud: PointCloud, path: str | Path) -> None:
    """Write a cloud by the suffix of `path`: `.ply` (finite points only) or `.pcd` (organised, NaN kept).

    The file appears only when it is complete.

    Raises
    ------
    ValueError
        The suffix is neither, or the cloud has no finite point.
    """
    path = Path(path)
    if path.suffix.lower() not in (".ply", ".pcd"):
        raise ValueError(f"expected a file name ending in .ply or .pcd, got {path.name!r}.")
    if not cloud.valid.any():
        raise ValueError(f"expected at least one finite point to write to {path.name}, got none.")
    data = _ply_bytes(cloud.finite()) if path.suffix.lower() == ".ply" else _pcd_bytes(cloud)
    handle, staging = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(staging, 0o644)
        os.replace(staging, path)
    finally:
        Path(staging).unlink(missing_ok=True)


def load_point_cloud(path: str | Path) -> PointCloud:
    """A cloud from a binary little-endian PLY or uncompressed binary PCD of scalar fields, such as `save`
    writes.

    Raises
    ------
    FileFormatError
        The file is missing, of another kind, cut short, or has no x, y, z.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected a point cloud (.ply or .pcd).")
    try:
        readers = {".ply": _read_ply, ".pcd": _read_pcd}
        return readers[path.suffix.lower()](path.read_bytes())
    except (KeyError, IndexError, ValueError) as error:
        raise FileFormatError(f"{path} is no binary PLY or PCD cloud of this kind: {error}.") from error


def _table(cloud: PointCloud, pcd: bool) -> np.ndarray:
    """(n,) structured array of the cloud's fields, under the names of the format."""
    columns = {axis: cloud.points[..., i] for i, axis in enumerate("xyz")}
    if cloud.normals is not None:
        names = ("normal_x", "normal_y", "normal_z") if pcd else ("nx", "ny", "nz")
        columns |= {name: cloud.normals[..., i] for i, name in enumerate(names)}
    if cloud.colors is not None and pcd:
        r, g, b = (cloud.colors[..., i].astype(np.uint32) for i in range(3))
        columns["rgb"] = ((r << 16) | (g << 8) | b).view(np.float32)
    elif cloud.colors is not None:
        columns |= {name: cloud.colors[..., i] for i, name in enumerate(("red", "green", "blue"))}
    for name in ("intensity", "confidence"):
        if name in cloud.attributes():
            columns[name] = cloud.attributes()[name]
    kinds = [(name, "u1" if v.dtype == np.uint8 else "<f4") for name, v in columns.items()]
    table = np.empty(cloud.points.size // 3, dtype=kinds)
    for name, values in columns.items():
        table[name] = values.ravel()
    return table


def _ply_bytes(cloud: PointCloud) -> bytes:
    table = _table(cloud, pcd=False)
    assert table.dtype.fields is not None
    lines = ["ply", "format binary_little_endian 1.0", f"comment frame {cloud.frame}, metres"]
    lines.append(f"element vertex {len(table)}")
    lines += [f"property {_PLY_TYPES[kind.str[1:]]} {name}" for name, (kind, *_) in table.dtype.fields.items()]
    return "\n".join([*lines, "end_header\n"]).encode() + table.tobytes()


def _pcd_bytes(cloud: PointCloud) -> bytes:
    table = _table(cloud, pcd=True)
    shape = cloud.points.shape[:-1]
    height, width = shape if len(shape) == 2 else (1, shape[0])
    names = table.dtype.names or ()
    lines = [
        f"# .PCD v0.7 - frame {cloud.frame}, metres",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join("4" for _ in names),
        "TYPE " + " ".join("F" for _ in names),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(table)}",
        "DATA binary\n",
    ]
    return "\n".join(lines).encode() + table.tobytes()


def _read_ply(data: bytes) -> PointCloud:
    header, body = _split(data, b"end_header")
    words = [line.split() for line in header]
    if ["format", "binary_little_endian", "1.0"] not in words:
        raise ValueError("expected a header with 'format binary_little_endian 1.0'")
    elements = [w for w in words if w[0] == "element"]
    if not elements or elements[0][1] != "vertex":
        raise ValueError("expected vertices as the first element")
    end = words.index(elements[1]) if len(elements) > 1 else len(words)
    kinds = [(w[2], "<" + _PLY_DTYPES[w[1]]) for w in words[:end] if w[0] == "property"]
    table = np.frombuffer(body, dtype=np.dtype(kinds), count=int(elements[0][2]))
    return _cloud(table, (len(table),), _frame(header))


def _read_pcd(data: bytes) -> PointCloud:
    header, body = _split(data, b"DATA binary")
    fields = {line.split()[0]: line.split()[1:] for line in header}
    kinds = [
        (name, f"<{kind.lower()}{size}")
        for name, kind, size in zip(fields["FIELDS"], fields["TYPE"], fields["SIZE"], strict=True)
    ]
    height, width = int(fields["HEIGHT"][0]), int(fields["WIDTH"][0])
    table = np.frombuffer(body, dtype=np.dtype(kinds), count=height * width)
    return _cloud(table, (height, width) if height > 1 else (width,), _frame(header))


def _split(data: bytes, last: bytes) -> tuple[list[str], bytes]:
    """Header lines, and the bytes after the line `last`."""
    start = data.find(last + b"\n")
    if start < 0:
        raise ValueError(f"expected a header that ends with {last.decode()!r}")
    lines = data[:start].decode("ascii").splitlines()
    return [line for line in lines if line.strip()], data[start + len(last) + 1 :]


def _frame(header: list[str]) -> str:
    words = " ".join(header).replace(",", " ").split()
    named = [b for a, b in itertools.pairwise(words) if a == "frame" and b in FRAMES]
    return named[0] if named else "camera"


def _cloud(table: np.ndarray, shape: tuple[int, ...], frame: str) -> PointCloud:
    names = table.dtype.names or ()

    def stack(*fields: str) -> np.ndarray | None:
        if not all(f in names for f in fields):
            return None
        return np.stack([table[f] for f in fields], axis=-1).reshape(*shape, len(fields))

    points = stack("x", "y", "z")
    if points is None:
        raise ValueError(f"expected fields x, y, z, got {', '.join(names)}")
    colors = stack("red", "green", "blue")
    if "rgb" in names:
        packed = np.ascontiguousarray(table["rgb"]).view(np.uint32).reshape(shape)
        colors = np.stack([packed >> 16, packed >> 8, packed], axis=-1).astype(np.uint8)
    normals = stack("nx", "ny", "nz")
    single = {n: np.array(table[n]).reshape(shape) for n in ("intensity", "confidence") if n in names}
    return PointCloud(
        points.astype(np.float32),
        frame,
        normals=stack("normal_x", "normal_y", "normal_z") if normals is None else normals,
        intensity=single.get("intensity"),
        colors=colors,
        confidence=single.get("confidence"),
    )
