# SPDX-License-Identifier: Apache-2.0
"""Point clouds written as binary PLY and PCD files.

The fields are x, y and z, and normals, intensity, colours and confidence if the cloud has them, under the names that
Open3D, PCL and MeshLab know. The numbers have single precision; points have the precision of the cloud. Clouds of
scanning instruments also have time (seconds, double precision), ring and return_number (whole numbers). A comment
line names the coordinate frame. `pcgraph.read_cloud` reads both formats.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcgraph.plumbing.plain_files import write_file
from rangesim.errors import FileFormatError
from rangesim.point_cloud import PointCloud

_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short",
              "u4": "uint", "i4": "int"}  # fmt: skip
"""Names of number types in PLY files, by NumPy's codes."""


_PCD_TYPES = {"f": "F", "u": "U", "i": "I"}
"""Names of kinds of numbers in PCD files, by NumPy's codes."""
_SCAN_FIELDS = {"time_s": ("time", "<f8"), "ring": ("ring", "<u2"), "return_number": ("return_number", "u1")}
"""Names of the fields of scanning instruments in both formats and their types in PCD, by the names of the arrays."""
_PLY_KINDS = {"<u2": "<i4"}
"""Types in PLY that differ from those in PCD: Open3D skips a property of 16 bits in PLY, and warns."""


def save_point_cloud(cloud: PointCloud, path: str | Path) -> None:
    """Write a point cloud in the format that the suffix of `path` names.

    `.ply` holds the finite points only; `.pcd` keeps the organisation of the image, with NaN where there is no point.
    The file appears only when it is complete.

    Raises
    ------
    ValueError
        The path has another suffix, or the cloud has no finite point.
    FileFormatError
        The place cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".ply", ".pcd"):
        raise ValueError(f"expected a file name ending in .ply or .pcd, got {path.name!r}.")
    if not cloud.valid.any():
        raise ValueError(f"expected at least one finite point to write to {path.name}, got none.")
    content = _ply_bytes(cloud.finite()) if path.suffix.lower() == ".ply" else _pcd_bytes(cloud)
    write_file(path, content, FileFormatError, make_parents=True)


def _table(cloud: PointCloud, pcd: bool) -> np.ndarray:
    """(n,) structured array of the cloud's fields, under the names of the format (PCD if `pcd`, else PLY)."""
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
    place = "<f8" if cloud.points.dtype == np.float64 else "<f4"
    kinds = [
        (name, place if name in ("x", "y", "z") else "u1" if v.dtype == np.uint8 else "<f4")
        for name, v in columns.items()
    ]
    for array, (name, kind) in _SCAN_FIELDS.items():
        if array in cloud.attributes():
            columns[name] = cloud.attributes()[array]
            kinds.append((name, kind if pcd else _PLY_KINDS.get(kind, kind)))
    table = np.empty(cloud.points.size // 3, dtype=kinds)
    for name, values in columns.items():
        table[name] = values.ravel()
    return table


def _ply_bytes(cloud: PointCloud) -> bytes:
    """Content of a PLY file of a cloud."""
    table = _table(cloud, pcd=False)
    assert table.dtype.fields is not None
    lines = ["ply", "format binary_little_endian 1.0", f"comment coordinates {cloud.coordinates}, metres"]
    lines.append(f"element vertex {len(table)}")
    lines += [f"property {_PLY_TYPES[kind.str[1:]]} {name}" for name, (kind, *_) in table.dtype.fields.items()]
    return "\n".join([*lines, "end_header\n"]).encode() + table.tobytes()


def _pcd_bytes(cloud: PointCloud) -> bytes:
    """Content of a PCD file of a cloud."""
    table = _table(cloud, pcd=True)
    shape = cloud.points.shape[:-1]
    height, width = shape if len(shape) == 2 else (1, shape[0])
    names = table.dtype.names or ()
    kinds = [table.dtype[name] for name in names]
    lines = [
        f"# .PCD v0.7 - coordinates {cloud.coordinates}, metres",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE " + " ".join(_PCD_TYPES[kind.kind] for kind in kinds),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(table)}",
        "DATA binary\n",
    ]
    return "\n".join(lines).encode() + table.tobytes()
