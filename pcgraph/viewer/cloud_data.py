# SPDX-License-Identifier: Apache-2.0
"""A cloud as the page holds it: positions in steps of its box, and columns in steps of their range."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud
from pcgraph.segmentation import Segmentation
from pcgraph.viewer.node_colors import distinct_colors
from pcgraph.viewer.packing import pack
from pcgraph.viewer.tree_data import tree_data
from pcgraph.voxels.spacing import median_spacing

POSITION_STEPS = 65535
"""Steps along each axis of the box of the points: the most that uint16 counts."""
VALUE_STEPS = 65534
"""Steps of a column's range, count: as many as uint16 has beside 0, which means that there is no value."""
TAIL = 0.001
"""Fraction of the points that may lie outside at either end of each axis when the extent of the cloud is taken. Chosen
by eye; not varied."""
MAX_REACH = 2.0
"""Distance from the extent, in lengths of its longest side, beyond which points are not drawn.

They are readings of mirrors and dust; one of them at a kilometre would make the steps of all others centimetres. Chosen
by eye; not varied.
"""
SHOWN_TAIL = 0.01
"""Fraction of a column's values beyond either end of its colour bar, so that single ones do not take all colours.
Chosen by eye; not varied."""
MAX_CATEGORIES = 32
"""Count of different whole numbers up to which a column is shown as categories: ASPRS classes are 19, rings 16 to 128.
Chosen by eye; not varied."""
CATEGORY_NAMES = ("label", "labels", "class", "classification", "instance", "semantic", "object", "part", "supervoxel")
"""Names of columns of whole numbers that are categories however many there are."""
MAX_COLUMNS = 32
"""Count of columns that a page holds, the file's first; each takes 2 bytes per point. Splats have up to 62. Chosen by
eye; not varied."""


class Drawn(NamedTuple):
    """The points that a page shows.

    rows : (n,) int64, their flat indices in the input. points : (n, 3) float64, metres, the file's frame.
    far : number of points that lie too far away to be shown.
    """

    rows: NDArray[np.int64]
    points: NDArray[np.float64]
    far: int


def cloud_data(name: str, cloud: Cloud, segmentation: Segmentation | None) -> dict[str, Any]:
    """A cloud, with its segmentation if there is one, as JSON takes it; arrays are text of `pack`.

    Returns
    -------
    low, step : metres, three each: a position is low + step * (whole number)
    positions : uint16, all x, then all y, then all z
    colors, normals : uint8, 3 per point, or None; 0..255 of a normal means -1..1
    columns : list of `_column`
    tree : `tree_data`, or None
    """
    drawn = _drawn(cloud)
    low = drawn.points.min(axis=0) if len(drawn.points) else np.zeros(3)
    span = np.ptp(drawn.points, axis=0) if len(drawn.points) else np.zeros(3)
    step = np.where(span > 0.0, span / POSITION_STEPS, 1.0)
    steps = np.rint((drawn.points - low) / step).astype(np.uint16)
    begin, end = _extent(drawn.points)
    columns = _columns(cloud, segmentation)
    return {
        "name": name,
        "count": len(drawn.rows),
        "unmeasured": int(cloud.points.size // 3 - len(drawn.rows) - drawn.far),
        "far": drawn.far,
        "width": cloud.points.shape[1] if cloud.organised else 0,
        "low": low.tolist(),
        "step": step.tolist(),
        "middle": ((begin + end) / 2).tolist(),
        "radius": max(float(np.linalg.norm(end - begin)) / 2, 1e-6),
        "spacing": median_spacing(drawn.points) if len(drawn.points) > 1 else 0.01,
        "camera": _is_of_a_camera(cloud, segmentation, drawn.points),
        "index": None if len(drawn.rows) == cloud.points.size // 3 else pack(drawn.rows.astype(np.uint32)),
        "positions": pack(steps.T),
        "colors": None if cloud.colors is None else pack(cloud.colors.reshape(-1, 3)[drawn.rows]),
        "normals": None if cloud.normals is None else pack(_direction_bytes(cloud.normals.reshape(-1, 3)[drawn.rows])),
        "columns": [_column(title, values[drawn.rows]) for title, values in columns[:MAX_COLUMNS]],
        "columnsLeftOut": max(len(columns) - MAX_COLUMNS, 0),
        "tree": None if segmentation is None else tree_data(segmentation, drawn.rows, drawn.points),
    }


def _drawn(cloud: Cloud) -> Drawn:
    """The measured points, without those far outside the extent."""
    flat = cloud.points.reshape(-1, 3)
    measured = np.flatnonzero(np.isfinite(flat).all(axis=1))
    points = flat[measured].astype(np.float64)
    begin, end = _extent(points)
    reach = MAX_REACH * float((end - begin).max())
    near = (
        ((points >= begin - reach) & (points <= end + reach)).all(axis=1) if reach > 0.0 else np.ones(len(points), bool)
    )
    return Drawn(measured[near], points[near], int((~near).sum()))


def _extent(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ends of the box of nearly all points, metres."""
    if not len(points):
        return np.zeros(3), np.zeros(3)
    ends = np.quantile(points, [TAIL, 1.0 - TAIL], axis=0)
    return ends[0], ends[1]


def _is_of_a_camera(cloud: Cloud, segmentation: Segmentation | None, points: NDArray[np.float64]) -> bool:
    """Whether the axes are those of a camera, x right, y down, z ahead: an image all of which lies ahead."""
    if segmentation is not None and segmentation.camera:
        return True
    return cloud.organised and bool(len(points)) and bool((points[:, 2] >= 0.0).all())


def _direction_bytes(normals: NDArray[np.floating]) -> NDArray[np.uint8]:
    clipped = np.clip(np.nan_to_num(normals.astype(np.float64)), -1.0, 1.0)
    return np.rint(127.5 + 127.5 * clipped).astype(np.uint8)


def _columns(cloud: Cloud, segmentation: Segmentation | None) -> list[tuple[str, NDArray[np.generic]]]:
    """Names and values, one number per point, of all columns; those of several numbers are split."""
    given: list[tuple[str, NDArray[np.generic]]] = [] if cloud.labels is None else [("label", cloud.labels.reshape(-1))]
    if segmentation is not None and segmentation.outliers.any():
        given.append(("outlier", segmentation.outliers.reshape(-1)))
    count = cloud.points.size // 3
    for name, column in cloud.columns.items():
        table = column.reshape(count, -1)
        given += [(name if table.shape[1] == 1 else f"{name}_{i}", table[:, i]) for i in range(table.shape[1])]
    return given


def _column(name: str, values: NDArray[np.generic]) -> dict[str, Any]:
    """One column: categories, or numbers in steps.

    Returns
    -------
    name : str
    values, colors, keys : of categories, their numbers as text, a colour each, and per point 1 + the place of its own
    low, step, shown, keys : of numbers, value = low + step * (key - 1), 0 for none; ends of the colour bar
    whole : whether the numbers are whole
    """
    kind = values.dtype.kind
    if kind in "iub":
        found, keys = np.unique(values, return_inverse=True)
        is_named = name.lower() in CATEGORY_NAMES or name.lower().startswith("level_")
        if kind == "b" or len(found) <= MAX_CATEGORIES or is_named:
            said = ["no" if not v else "yes" for v in found] if kind == "b" else [str(v) for v in found]
            wide = len(found) > VALUE_STEPS
            packed = pack((keys.ravel() + 1).astype(np.uint32 if wide else np.uint16))
            return {
                "name": name,
                "values": said,
                "colors": pack(distinct_colors(len(found))),
                "wide": wide,
                "keys": packed,
            }
    numbers = values.astype(np.float64)
    finite = np.isfinite(numbers)
    known = numbers[finite] if finite.any() else np.zeros(1)
    low, high = float(known.min()), float(known.max())
    step = (high - low) / VALUE_STEPS if high > low else 1.0
    keys = np.where(finite, 1 + np.rint((np.where(finite, numbers, low) - low) / step), 0).astype(np.uint16)
    shown = np.quantile(known, [SHOWN_TAIL, 1.0 - SHOWN_TAIL]).tolist()
    if shown[0] == shown[1]:
        shown = [low, high]
    return {"name": name, "low": low, "step": step, "shown": shown, "whole": kind in "iu", "keys": pack(keys)}
