# SPDX-License-Identifier: Apache-2.0
"""Tasks of the worker processes: they segment a cloud, and write files that answer requests about a segmentation.

Every task is a function of plain values, because they come as JSON, and returns a dictionary that becomes JSON.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud
from pcgraph.detection.boxes import boxes_of_labels
from pcgraph.detection.objects import objects_on
from pcgraph.detection.plane_detection import find_planes
from pcgraph.errors import CloudReadError
from pcgraph.families import members
from pcgraph.io import decode_cloud, encode_cloud, read_cloud
from pcgraph.labelling import labelled_cloud
from pcgraph.plausibility import CloudWarning
from pcgraph.saved_segmentation import load_segmentation
from pcgraph.scan import segment
from pcgraph.segmentation import Segmentation
from pcgraph.service.problems import Problem

Stage = Callable[[str], None]
"""Function that a task calls with its current stage in words."""


# ---- Segmenting ----------------------------------------------------------------------------------------------------


def segment_upload(
    stage: Stage,
    upload: str,
    name: str | None,
    saved: str,
    max_points: int,
    color: bool,
    columns: Sequence[str] | None,
    method: str,
    linkage: str,
    **parameters: Any,
) -> dict[str, Any]:
    """Segment an upload, save the segmentation, and return its summary.

    Parameters
    ----------
    stage : callable
    upload : str
        Path of the upload, whose name says nothing; its metadata may lie beside it.
    name : str, or None
        Name that the user gave the file, whose end tells the format; None: the upload is JSON.
    saved : str
        Path for the saved segmentation.
    max_points : int
    color : bool
        Whether colours shape the supervoxels.
    columns : names of the columns of a text file without a header, or None
    method, linkage : str
        Names of members of their families. No file of the user's is run.
    parameters
        Of `pcgraph.segment`, as the user gave them.
    """
    start = time.perf_counter()
    stage("reading")
    cloud = _cloud_of_json(Path(upload)) if name is None else _cloud_of_file(Path(upload), name, columns)
    n_points = cloud.points.size // 3
    if n_points > max_points:
        raise Problem(
            413, f"expected a cloud of at most {max_points} points, got {n_points}: send a part or a thinned one"
        )
    stage("segmenting")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = segment(
            cloud if color else replace(cloud, colors=None),
            method=members("SupervoxelMethod")[method](),
            linkage=members("Linkage")[linkage](),
            **parameters,
        )
    stage("saving")
    result.save(saved, cloud)
    return {
        "points": n_points,
        **result.summary(),
        "object_altitude": result.object_altitude,
        "seconds": round(time.perf_counter() - start, 3),
        "warnings": [str(warning.message) for warning in caught if issubclass(warning.category, CloudWarning)],
    }


def _cloud_of_file(path: Path, name: str, columns: Sequence[str] | None) -> Cloud:
    """Cloud of a file that the user calls `name`, with the second file beside it if that was sent, too."""
    if not path.with_suffix(".json").exists():
        return decode_cloud(path.read_bytes(), name, columns)
    path = path.rename(path.with_suffix(Path(name).suffix))
    try:
        return read_cloud(path, columns=columns)
    except CloudReadError as error:
        raise CloudReadError(str(error).replace(str(path), name)) from None


def _cloud_of_json(path: Path) -> Cloud:
    """Cloud of JSON that is a `pcgraph.service.models.Points`."""
    given = json.loads(path.read_bytes())
    arrays = {name: np.array(rows, np.float64) for name, rows in given.items() if rows is not None}
    points, colors, normals = (arrays.get(name) for name in ("points", "colors", "normals"))
    assert points is not None
    if any(rows is not None and len(rows) != len(points) for rows in (colors, normals)):
        raise ValueError(f"expected as many colors and normals as points, {len(points)}")
    return Cloud(points, None if colors is None else colors.astype(np.uint8), normals)


# ---- Answers about a saved segmentation ----------------------------------------------------------------------------

_opened: dict[str, tuple[Cloud, Segmentation]] = {}
"""The segmentation of the last request, because most requests about one segmentation follow each other."""


def _open(segmentation_id: str, saved: str) -> tuple[Cloud, Segmentation]:
    if segmentation_id not in _opened:
        _opened.clear()
        try:
            _opened[segmentation_id] = read_cloud(saved), load_segmentation(saved)
        except CloudReadError as error:
            raise Problem(500, f"the service cannot read its own file: {error}") from None
    return _opened[segmentation_id]


def _cut(result: Segmentation, n: int | None, altitude: float | None, min_size: int) -> tuple[bool, NDArray[np.int32]]:
    """Whether a cut is the default one, and its labels; without `n` and `altitude` it is at the objects' altitude."""
    if n is None and altitude is None:
        if min_size == 1:
            return True, result.labels
        altitude = result.object_altitude
    return False, result.cut(n, altitude, min_size)


def write_labels(
    stage: Stage,
    segmentation_id: str,
    saved: str,
    file_format: str,
    n: int | None,
    altitude: float | None,
    min_size: int,
    colorize: bool,
) -> dict[str, Any]:
    """Write the labels of a cut, or the cloud with its labels, to a file beside the saved segmentation.

    Formats npz and json hold the labels alone, in the input's shape. All others hold the cloud with its own columns and
    the columns object, part, supervoxel, and segment if the request is for a cut.
    """
    cloud, result = _open(segmentation_id, saved)
    is_default, labels = _cut(result, n, altitude, min_size)
    path = Path(saved).with_name(f"labels.{file_format}")
    if file_format == "json":
        path.write_text(json.dumps({"labels": labels.tolist(), "segments": int(labels.max(initial=-1)) + 1}))
    elif file_format == "npz":
        stream = BytesIO()
        np.savez_compressed(stream, labels=labels, supervoxels=result.supervoxels)
        path.write_bytes(stream.getvalue())
    else:
        shown = labelled_cloud(cloud, result, colorize=colorize)
        if not is_default:
            taken = {column.lower() for column in shown.columns}
            own = "segment" if "segment" not in taken else "pcgraph_segment"
            shown = replace(shown, columns={**shown.columns, own: labels})
        path.write_bytes(encode_cloud(shown, path.name))
    return {"file": path.name}


def write_boxes(
    stage: Stage, segmentation_id: str, saved: str, n: int | None, altitude: float | None, min_size: int
) -> dict[str, Any]:
    """Write the oriented box around each segment of a cut as JSON."""
    cloud, result = _open(segmentation_id, saved)
    _, labels = _cut(result, n, altitude, min_size)
    found = boxes_of_labels(cloud.points, labels)
    boxes = [{"segment": label, **box.to_dict()} for label, box in found.items()]
    return _write_json(saved, "boxes.json", {"boxes": boxes})


def write_objects(stage: Stage, segmentation_id: str, saved: str) -> dict[str, Any]:
    """Write the objects on the largest horizontal plane, with their boxes and shapes, as JSON."""
    cloud, result = _open(segmentation_id, saved)
    planes = find_planes(result)
    level = np.flatnonzero(planes.roles == "horizontal")
    support = None
    if len(level):
        plane = int(level[0])
        support = {"normal": planes.normals[plane].tolist(), "centroid": planes.centroids[plane].tolist()}
    found = objects_on(result, planes, points=cloud.points)
    objects = [{"labels": np.unique(result.objects[one.supervoxels]).tolist(), **one.to_dict()} for one in found]
    return _write_json(saved, "objects.json", {"support": support, "objects": objects})


def write_tree(stage: Stage, segmentation_id: str, saved: str) -> dict[str, Any]:
    """Write the segmentation tree as JSON."""
    _, result = _open(segmentation_id, saved)
    return _write_json(saved, "tree.json", result.tree.to_dict())


def write_view(stage: Stage, segmentation_id: str, saved: str, title: str) -> dict[str, Any]:
    """Write the viewer page of a segmentation, one HTML file that works offline."""
    from pcgraph.viewer import view_page

    cloud, result = _open(segmentation_id, saved)
    path = Path(saved).with_name("view.html")
    path.write_text(view_page(cloud, result, title), encoding="utf-8")
    return {"file": path.name}


def _write_json(saved: str, name: str, content: dict[str, Any]) -> dict[str, Any]:
    Path(saved).with_name(name).write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    return {"file": name}


def warm_up() -> None:
    """Run every task once on a small cloud of a box on a table, so that all kernels are compiled and loaded."""
    x, y = np.meshgrid(*2 * [np.linspace(0.0, 1.0, 40)])
    on_box = (abs(x - 0.5) < 0.2) & (abs(y - 0.5) < 0.2)
    cloud = Cloud(np.stack((x, y, np.where(on_box, 1.2, 1.0)), axis=-1))
    for linkage in members("Linkage").values():
        result = segment(cloud, viewpoint=(0.5, 0.5, 3.0), linkage=linkage())
    for method in members("SupervoxelMethod").values():
        segment(cloud, camera=True, method=method(), n_supervoxels=20)
    with TemporaryDirectory(prefix="pcgraph-") as folder:
        saved = f"{folder}/box.npz"
        result.save(saved, cloud)
        about: dict[str, Any] = {"stage": str, "segmentation_id": folder, "saved": saved}
        write_labels(**about, file_format="ply", n=2, altitude=None, min_size=5, colorize=True)
        write_boxes(**about, n=2, altitude=None, min_size=1)
        write_objects(**about)
        write_tree(**about)
        write_view(**about, title="box")
    _opened.clear()


TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    function.__name__: function
    for function in (segment_upload, write_labels, write_boxes, write_objects, write_tree, write_view)
}
"""Tasks by their names."""
