# SPDX-License-Identifier: Apache-2.0
"""Sources of point clouds: files, arrays, ROS messages, and the clouds of other libraries."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import COLOR_NAMES, Cloud, cloud_from_array, cloud_from_columns, native
from pcgraph.errors import CloudReadError, library_reason

_MESSAGE_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of the numbers in a PointField, by its `datatype`. Source: sensor_msgs of ROS."""


def as_cloud(source: Any) -> Cloud:
    """Cloud of an array, a file, a ROS message, or a cloud or mesh of another library.

    Parameters
    ----------
    source : one of

        - a `Cloud`, which is returned unchanged
        - the path of a file, for `read_cloud`
        - an array (n, 3) or (h, w, 3) of numbers, whose type stays. Further columns of an array (n, 4) and so on become
          the cloud's columns ``column_3``, ``column_4`` and so on
        - a structured array of NumPy with the fields ``x``, ``y`` and ``z``, such as
          ``sensor_msgs_py.point_cloud2.read_points`` returns. Colours, normals and labels are found by their names
        - a message such as ``sensor_msgs/PointCloud2``, with ``fields``, ``data``, ``point_step`` and so on
        - a table of pandas or Polars, whose columns are named like the fields of a structured array
        - an Open3D cloud, legacy or tensor. ``covariances``, and attributes of a tensor cloud, become columns
        - a trimesh cloud, or a trimesh mesh, whose vertices are the points

        Colours that are floats of at most 1 become uint8; their alpha is not read. Masked numbers become NaN.

    Raises
    ------
    CloudReadError
        `source` is the path of a file that cannot be read.
    ValueError
        `source` is none of these, or its arrays do not fit together.

    Examples
    --------
    >>> import numpy as np
    >>> rows = np.array([(0, 0, 1, 7), (0, 1, 1, 9)], [("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2")])
    >>> as_cloud(rows).points.shape, as_cloud(rows).columns["ring"].tolist()
    ((2, 3), [7, 9])
    """
    if isinstance(source, Cloud):
        return source
    if isinstance(source, (str, PathLike)):
        from pcgraph.io import read_cloud

        return read_cloud(source)
    for attributes, convert in _KINDS.items():
        if all(hasattr(source, name) for name in attributes):
            return convert(source)
    if not isinstance(source, (np.ndarray, Sequence)) and _plain_array(source).dtype == object:
        kinds = "an array (n, 3) or (h, w, 3), a pcgraph.Cloud or what pcgraph.as_cloud takes"
        hint = "; pass its .points (and .colors)" if hasattr(source, "points") else ""
        if hasattr(source, "to_point_cloud"):
            hint = "; pass its to_point_cloud().points"
        raise ValueError(f"expected points as {kinds}, got {type(source).__name__}{hint}")
    return cloud_from_array(source)


def _plain_array(source: Any) -> NDArray[Any]:
    try:
        return np.asarray(source)
    except Exception as error:  # noqa: BLE001 - what its own conversion raises, as that of tensors on a GPU
        kind = type(source).__name__
        raise ValueError(f"expected points that NumPy can take, but {kind} refuses: {library_reason(error)}") from None


def _of_message(message: Any) -> Cloud:
    """Cloud of a PointCloud2, whose points are `point_step` bytes apart, in rows of `row_step` bytes."""
    names = [one.name for one in message.fields]
    unknown = [one for one in message.fields if one.datatype not in _MESSAGE_TYPES]
    if unknown or len(set(names)) < len(names):
        raise ValueError(f"expected fields of distinct names and datatypes 1 to 8, got {', '.join(names)[:200]}")
    order = ">" if message.is_bigendian else "<"
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    try:
        record = np.dtype(
            {
                "names": names,
                "formats": [(order + _MESSAGE_TYPES[one.datatype], max(1, int(one.count))) for one in message.fields],
                "offsets": [int(one.offset) for one in message.fields],
                "itemsize": step,
            }
        )
    except ValueError as error:
        raise ValueError(f"expected fields within a point_step of {step} bytes: {error}") from None
    data = np.frombuffer(bytes(message.data), np.uint8)  # it may be bytes, an array of them, or a list
    row_step = int(message.row_step) or width * step
    if min(height, width) < 0 or row_step < width * step or len(data) < height * row_step:
        raise ValueError(
            f"expected {height} rows of {width} points of {step} bytes, got {len(data)} bytes in rows of {row_step}"
        )
    rows = np.ascontiguousarray(data[: height * row_step].reshape(height, row_step)[:, : width * step])
    points = rows.reshape(-1).view(record).reshape(height, width)
    columns = {name: points[name].reshape(height * width, *points[name].shape[2:]) for name in names}
    return _from_columns(columns, (height, width) if height > 1 else (height * width,))


def _of_open3d(cloud: Any) -> Cloud:
    """Cloud of an open3d.geometry.PointCloud, in which an empty array means no colours or no normals."""
    points, colors, normals = (np.asarray(values) for values in (cloud.points, cloud.colors, cloud.normals))
    columns = _columns_of(points, colors if len(colors) else None, normals if len(normals) else None)
    if len(cloud.covariances):
        columns["covariances"] = np.asarray(cloud.covariances)
    return _from_columns(columns, points.shape[:1])


def _of_open3d_tensor(cloud: Any) -> Cloud:
    """Cloud of an open3d.t.geometry.PointCloud on any device."""
    arrays = {name: values.cpu().numpy() for name, values in cloud.point.items()}
    if "positions" not in arrays:
        raise ValueError("expected an Open3D cloud with positions, got an empty one")
    points = arrays.pop("positions")
    columns = _columns_of(points, arrays.pop("colors", None), arrays.pop("normals", None))
    clash = sorted(columns.keys() & arrays.keys())
    if clash:
        raise ValueError(f"expected attributes of other names than {', '.join(clash)}, which positions have: rename")
    return _from_columns(columns | arrays, points.shape[:1])


def _of_frame(frame: Any) -> Cloud:
    """Cloud of a DataFrame of pandas or Polars; columns without names are taken like those of an array."""
    if all(isinstance(name, int) for name in frame.columns):
        return cloud_from_array(frame.to_numpy())
    columns = {str(name): np.asarray(frame[name]) for name in frame.columns}
    wrong = [name for name, values in columns.items() if values.ndim != 1 or values.dtype.kind not in "fiub"]
    if wrong or len(columns) < len(frame.columns):
        got = f"{columns[wrong[0]].dtype} in {wrong[0]!r}" if wrong else ", ".join(map(str, frame.columns))[:200]
        raise ValueError(f"expected columns of numbers under distinct names, got {got}")
    return _from_columns(columns, (len(frame),))


def _of_trimesh(mesh: Any) -> Cloud:
    """Cloud of a trimesh.PointCloud, or of the vertices of a trimesh.Trimesh with their normals."""
    points = np.asarray(mesh.vertices)
    colors = np.asarray(mesh.visual.vertex_colors) if mesh.visual.kind == "vertex" else np.empty(0)
    columns = _columns_of(
        points,
        colors[:, :3] if len(colors) else None,
        np.asarray(mesh.vertex_normals) if hasattr(mesh, "vertex_normals") else None,  # clouds have none
    )
    return _from_columns(columns | getattr(mesh, "vertex_attributes", {}), points.shape[:1])


def _columns_of(
    points: NDArray[np.generic], colors: NDArray[np.generic] | None, normals: NDArray[np.generic] | None
) -> dict[str, NDArray[np.generic]]:
    """Points, colours and normals, (n, 3) each, as columns."""
    columns: dict[str, NDArray[np.generic]] = {}
    for names, rows in (("xyz", points), (COLOR_NAMES, colors), (("nx", "ny", "nz"), normals)):
        if rows is not None:
            columns |= dict(zip(names, rows.T, strict=True))
    return columns


def _from_columns(columns: dict[str, NDArray[np.generic]], shape: tuple[int, ...]) -> Cloud:
    """Cloud of columns (n,), or (n, ...) with several numbers for each point; (n, 1) becomes (n,)."""
    rows = {name: native(values).reshape(len(values), math.prod(values.shape[1:])) for name, values in columns.items()}
    columns = {name: values[:, 0] if values.shape[1] == 1 else values for name, values in rows.items()}
    try:
        return cloud_from_columns(columns, shape)
    except CloudReadError as error:
        raise ValueError(str(error)) from None


_KINDS: dict[tuple[str, ...], Callable[[Any], Cloud]] = {
    ("fields", "data", "point_step", "row_step"): _of_message,
    ("points", "colors", "normals", "has_points"): _of_open3d,
    ("point", "is_cpu", "is_cuda"): _of_open3d_tensor,
    ("vertices", "visual"): _of_trimesh,
    ("columns", "dtypes", "to_numpy"): _of_frame,
}
"""Converters by the attributes that identify a class, so that its library need not be imported for that."""
