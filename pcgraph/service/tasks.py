# SPDX-License-Identifier: Apache-2.0
"""What worker processes do: segment a cloud, and answer questions about a finished segmentation, into files.

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud
from pcgraph.detection.objects import objects_on
from pcgraph.detection.plane_detection import find_planes
from pcgraph.families import members
from pcgraph.io import decode_cloud, encode_cloud, labelled_cloud, read_cloud
from pcgraph.io.saved_segmentations import load_segmentation
from pcgraph.plausibility import CloudWarning
from pcgraph.scan import segment
from pcgraph.segmentation import Segmentation
from pcgraph.service.problems import Problem

Stage = Callable[[str], None]
"""Told in words what a task has come to."""

SAVED = "segmentation.npz"
"""Name of the saved segmentation in the folder of each."""
ARRAYS = {"points": 2, "colors": 2, "normals": 2}
"""Keys of a cloud in JSON, and the dimensions of their arrays."""


# ---- Segmenting ----------------------------------------------------------------------------------------------------


def segment_upload(
    stage: Stage,
    upload: str,
    name: str | None,
    folder: str,
    max_points: int,
    color: bool,
    columns: Sequence[str] | None,
    method: str,
    linkage: str,
    **parameters: Any,
) -> dict[str, Any]:
    """Segment an upload, save the segmentation in a folder, and say what came of it.

    Parameters
    ----------
    stage : callable
    upload : str
        Path of the upload; its name says nothing.
    name : str, or None
        Name that the user gave the file, whose end tells the format; None: the upload is JSON.
    folder : str
        Folder for the saved segmentation.
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
    content = Path(upload).read_bytes()
    cloud = _cloud_of_json(content) if name is None else decode_cloud(content, name, columns=columns)
    del content
    n_points = cloud.points.size // 3
    if n_points > max_points:
        raise Problem(413, f"expected a cloud of at most {max_points} points, got {n_points}: send a part or a thinned one")
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
    result.save(Path(folder) / SAVED, cloud)
    return {
        "points": n_points,
        "segmented": int(np.count_nonzero(result.supervoxels >= 0)),
        "outliers": int(np.count_nonzero(result.outliers)),
        "acquisition": result.acquisition.in_words,
        "voxel_size": result.voxel_size,
        "seed_size": result.seed_size,
        "supervoxels": result.tree.n_leaves,
        "edges": len(result.graph.edges),
        "objects": len(np.unique(result.objects)),
        "object_altitude": result.object_altitude,
        "seconds": round(time.perf_counter() - start, 3),
        "warnings": [str(warning.message) for warning in caught if issubclass(warning.category, CloudWarning)],
    }


def _cloud_of_json(content: bytes) -> Cloud:
    """Cloud of ``{"points": [[x, y, z], ...], "colors": ..., "normals": ...}``."""
    try:
        given = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected JSON such as {{\"points\": [[0, 0, 1]]}}: {str(error)[:100]}") from None
    if not isinstance(given, dict) or "points" not in given or not set(given) <= set(ARRAYS):
        found = ", ".join(sorted(given))[:100] if isinstance(given, dict) else type(given).__name__
        raise ValueError(f"expected a JSON object with points and, if there are any, colors and normals, got {found}")
    arrays = {key: _rows_of_json(key, rows) for key, rows in given.items()}
    colors = arrays.get("colors")
    if colors is not None:
        if not ((colors >= 0) & (colors <= 255) & (colors == np.rint(colors))).all():
            raise ValueError("expected colors as whole numbers from 0 to 255")
        arrays["colors"] = colors.astype(np.uint8)
    if len({len(array) for array in arrays.values()}) > 1:
        raise ValueError(f"expected as many colors and normals as points, {len(arrays['points'])}")
    return Cloud(**arrays)


def _rows_of_json(key: str, rows: object) -> NDArray[Any]:
    try:
        array = np.array(rows)
    except ValueError:  # rows of several lengths
        array = np.empty(0, object)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iuf":
        raise ValueError(f"expected {key} as a list of rows of three numbers each")
    return array.astype(np.float64)


# ---- Answers about a saved segmentation ----------------------------------------------------------------------------

_opened: dict[str, tuple[Cloud, Segmentation]] = {}
"""The segmentation that was asked about last: questions about one mostly follow each other."""


def _open(segmentation_id: str, folder: str) -> tuple[Cloud, Segmentation]:
    if segmentation_id not in _opened:
        _opened.clear()
        path = Path(folder) / SAVED
        _opened[segmentation_id] = read_cloud(path), load_segmentation(path)
    return _opened[segmentation_id]


def write_labels(
    stage: Stage,
    segmentation_id: str,
    folder: str,
    file_format: str,
    n: int | None,
    altitude: float | None,
    min_size: int,
    colorize: bool,
) -> dict[str, Any]:
    """Write the labels of a cut, or the cloud with its labels, to a file of a folder.

    Formats npz and json hold the labels alone, in the input's shape; all others hold the cloud with its own columns,
    and ours: object, part, supervoxel, and, if a cut was asked for, segment.
    """
    cloud, result = _open(segmentation_id, folder)
    is_default = n is None and altitude is None and min_size == 1
    level = result.object_altitude if n is None and altitude is None else altitude
    labels = result.labels if is_default else result.cut(n, level, min_size)
    path = Path(folder) / f"labels.{file_format}"
    if file_format == "json":
        path.write_text(json.dumps({"labels": labels.tolist(), "segments": int(labels.max(initial=-1)) + 1}))
    elif file_format == "npz":
        stream = BytesIO()
        np.savez_compressed(stream, labels=labels, supervoxels=result.supervoxels)
        path.write_bytes(stream.getvalue())
    else:
        shown = labelled_cloud(cloud, result, colorize=colorize)
        if not is_default:
            shown = replace(shown, columns={**shown.columns, "segment": labels})
        path.write_bytes(encode_cloud(shown, path.name))
    return {"file": path.name}


def write_objects(stage: Stage, segmentation_id: str, folder: str) -> dict[str, Any]:
    """Write the objects on the largest horizontal plane, with their boxes and shapes, as JSON."""
    cloud, result = _open(segmentation_id, folder)
    planes = find_planes(result)
    level = np.flatnonzero(planes.roles == "horizontal")
    support = None
    if len(level):
        plane = int(level[0])
        support = {"normal": planes.normals[plane].tolist(), "centroid": planes.centroids[plane].tolist()}
    found = objects_on(result, planes, points=cloud.points)
    return _write_json(folder, "objects.json", {"support": support, "objects": [one.to_dict() for one in found]})


def write_tree(stage: Stage, segmentation_id: str, folder: str) -> dict[str, Any]:
    """Write the segmentation tree as JSON."""
    _, result = _open(segmentation_id, folder)
    return _write_json(folder, "tree.json", result.tree.to_dict())


def write_view(stage: Stage, segmentation_id: str, folder: str, title: str) -> dict[str, Any]:
    """Write the viewer page of a segmentation, one HTML file that works offline."""
    from pcgraph.viewer import view_page

    cloud, result = _open(segmentation_id, folder)
    path = Path(folder) / "view.html"
    path.write_text(view_page(cloud, result, title), encoding="utf-8")
    return {"file": path.name}


def _write_json(folder: str, name: str, content: dict[str, Any]) -> dict[str, Any]:
    (Path(folder) / name).write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    return {"file": name}


TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    function.__name__: function for function in (segment_upload, write_labels, write_objects, write_tree, write_view)
}
"""Tasks by their names."""
