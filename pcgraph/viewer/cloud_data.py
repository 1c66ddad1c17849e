# SPDX-License-Identifier: Apache-2.0
"""A cloud as the page holds it: positions in steps of its box, and columns in steps of their range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud
from pcgraph.errors import visible
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.segmentation import Segmentation, check_segmentation
from pcgraph.viewer.node_colors import distinct_colors
from pcgraph.viewer.packing import pack
from pcgraph.viewer.tree_data import ShownTree, tree_data
from pcgraph.voxels.spacing import median_spacing

POSITION_STEPS = 65535
"""Steps along each axis of the box of the points: the most that uint16 counts."""
VALUE_STEPS = 65534
"""Steps of a column's range, count: as many as uint16 has beside 0, which means that there is no value."""
TAIL = 0.001
"""Fraction of the points that may lie outside at either end of each axis when the extent of the cloud is taken. Chosen
by eye; not varied."""
FIRST_VIEW_TAIL = 0.02
"""The same fraction for the extent that the first view shows: sweeps of a LiDAR have a few points far ahead. Chosen by
eye; not varied."""
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


@dataclass(frozen=True, eq=False)
class Categories(ShortRepr):
    """What the whole numbers of a column stand for.

    Attributes
    ----------
    names : sequence of str
        Of 0, 1 and so on.
    colors : (c, 3) uint8, red green blue
        One for each name.

    Examples
    --------
    >>> import numpy as np
    >>> from pcgraph.viewer import Categories
    >>> Categories(["ground", "tree"], np.array([[120, 90, 60], [40, 160, 60]], np.uint8)).names
    ['ground', 'tree']
    """

    names: Sequence[str]
    colors: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Shown(ShortRepr):
    """What one entry of a page's chooser shows.

    Attributes
    ----------
    name : str
    cloud : Cloud
    tree : ShownTree, optional
        Of this very cloud.
    outliers : (n,) or (h, w) bool, optional
        Which points were noise.
    camera : bool, optional
        Whether x points right, y down and z ahead. Default: whether an organised cloud lies ahead of z = 0.
    categories : mapping of a column's name to Categories, optional
    units : mapping of a column's name to its unit, optional

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> from pcgraph.viewer import Shown, views_page
    >>> cloud = pcgraph.Cloud(np.zeros((2, 3)), columns={"speed": np.array([1.0, 2.0])})
    >>> '"unit": "m/s"' in views_page([Shown("two points", cloud, units={"speed": "m/s"})], "Speeds")
    True
    """

    name: str
    cloud: Cloud
    tree: ShownTree | None = None
    outliers: NDArray[np.bool_] | None = None
    camera: bool | None = None
    categories: Mapping[str, Categories] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, cloud: Cloud, segmentation: Segmentation | None) -> Shown:
        """A cloud and its segmentation, if there is one.

        Raises
        ------
        ValueError
            The cloud or the segmentation is none, or the segmentation is that of another cloud.
        """
        if not isinstance(cloud, Cloud):
            raise ValueError(f"expected a Cloud, as pcgraph.read_cloud returns it, got {type(cloud).__name__}")
        if segmentation is None:
            return cls(name, cloud)
        check_segmentation(segmentation)
        if segmentation.labels.shape != cloud.points.shape[:-1]:
            raise ValueError(
                f"expected the segmentation of this cloud, of {cloud.points.shape[:-1]} points, "
                f"got one of {segmentation.labels.shape}"
            )
        outliers = segmentation.outliers if segmentation.outliers.any() else None
        return cls(name, cloud, ShownTree.of(segmentation), outliers, segmentation.camera or None)


def cloud_data(shown: Shown) -> dict[str, Any]:
    """A cloud, with its segmentation if there is one, as JSON takes it; arrays are text of `pack`.

    Returns
    -------
    low, step : metres, three each: a position is low + step * (whole number)
    positions : uint16, all x, then all y, then all z
    colors, normals : uint8, 3 per point, or None; 0..255 of a normal means -1..1
    columns : list of `_column`
    tree : `tree_data`, or None
    """
    cloud = shown.cloud
    drawn = _drawn(cloud)
    low = drawn.points.min(axis=0) if len(drawn.points) else np.zeros(3)
    span = np.ptp(drawn.points, axis=0) if len(drawn.points) else np.zeros(3)
    step = np.where(span > 0.0, span / POSITION_STEPS, 1.0)
    steps = np.rint((drawn.points - low) / step).astype(np.uint16)
    begin, end = _extent(drawn.points, FIRST_VIEW_TAIL)
    columns = _columns(shown)
    return {
        "name": visible(shown.name),
        "count": len(drawn.rows),
        "unmeasured": int(cloud.points.size // 3 - len(drawn.rows) - drawn.far),
        "far": drawn.far,
        "width": cloud.points.shape[1] if cloud.organised else 0,
        "low": low.tolist(),
        "step": step.tolist(),
        "middle": ((begin + end) / 2).tolist(),
        "radius": max(float(np.linalg.norm(end - begin)) / 2, 1e-6),
        "spacing": median_spacing(drawn.points) if len(drawn.points) > 1 else 0.01,
        "camera": _is_ahead(cloud, drawn.points) if shown.camera is None else shown.camera,
        "index": None if len(drawn.rows) == cloud.points.size // 3 else pack(drawn.rows.astype(np.uint32)),
        "positions": pack(steps.T),
        "colors": None if cloud.colors is None else pack(cloud.colors.reshape(-1, 3)[drawn.rows]),
        "normals": None if cloud.normals is None else pack(_direction_bytes(cloud.normals.reshape(-1, 3)[drawn.rows])),
        "columns": [_column(shown, name, values[drawn.rows]) for name, values in columns[:MAX_COLUMNS]],
        "columnsLeftOut": max(len(columns) - MAX_COLUMNS, 0),
        "tree": None if shown.tree is None else tree_data(shown.tree, drawn.rows, drawn.points),
    }


def _drawn(cloud: Cloud) -> Drawn:
    """The measured points, without those far outside the extent."""
    flat = cloud.points.reshape(-1, 3)
    measured = np.flatnonzero(np.isfinite(flat).all(axis=1))
    points = flat[measured].astype(np.float64)
    begin, end = _extent(points, TAIL)
    reach = MAX_REACH * float((end - begin).max())
    near = (
        ((points >= begin - reach) & (points <= end + reach)).all(axis=1) if reach > 0.0 else np.ones(len(points), bool)
    )
    return Drawn(measured[near], points[near], int((~near).sum()))


def _extent(points: NDArray[np.float64], tail: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ends of a box, metres, that a fraction of the points lies outside of at either end of each axis."""
    if not len(points):
        return np.zeros(3), np.zeros(3)
    ends = np.quantile(points, [tail, 1.0 - tail], axis=0)
    return ends[0], ends[1]


def _is_ahead(cloud: Cloud, points: NDArray[np.float64]) -> bool:
    """Whether this is an image of what lies ahead along z, as clouds in the axes of a camera are."""
    return cloud.organised and bool(len(points)) and bool((points[:, 2] >= 0.0).all())


def _direction_bytes(normals: NDArray[np.floating]) -> NDArray[np.uint8]:
    clipped = np.clip(np.nan_to_num(normals.astype(np.float64)), -1.0, 1.0)
    return np.rint(127.5 + 127.5 * clipped).astype(np.uint8)


def _columns(shown: Shown) -> list[tuple[str, NDArray[np.generic]]]:
    """Names and values, one number per point, of all columns; those of several numbers are split."""
    cloud = shown.cloud
    given: list[tuple[str, NDArray[np.generic]]] = []
    if cloud.labels is not None:
        given.append(("label", cloud.labels.reshape(-1)))
    if shown.outliers is not None:
        given.append(("outlier", shown.outliers.reshape(-1)))
    count = cloud.points.size // 3
    for name, column in cloud.columns.items():
        table = column.reshape(count, -1)
        given += [(name if table.shape[1] == 1 else f"{name}_{i}", table[:, i]) for i in range(table.shape[1])]
    return given


def _column(shown: Shown, name: str, values: NDArray[np.generic]) -> dict[str, Any]:
    """One column: categories, or numbers in steps.

    Returns
    -------
    name, unit : str
    values, colors, keys : of categories, their texts, a colour each, and per point 1 + the place of its own
    low, step, shown, keys : of numbers, value = low + step * (key - 1), 0 for none; ends of the colour bar
    whole : whether the numbers are whole
    """
    about = {"name": visible(name), "unit": shown.units.get(name, "")}
    if _are_categories(name, values) or name in shown.categories:
        return {**about, **_categories(values, shown.categories.get(name))}
    return {**about, **_numbers(values)}


def _are_categories(name: str, values: NDArray[np.generic]) -> bool:
    if values.dtype.kind not in "iub":
        return False
    is_named = name.lower() in CATEGORY_NAMES or name.lower().startswith("level_")
    return is_named or len(np.unique(values)) <= MAX_CATEGORIES


def _categories(values: NDArray[np.generic], known: Categories | None) -> dict[str, Any]:
    found, keys = np.unique(values, return_inverse=True)
    if known is not None:
        texts, colors = [known.names[k] for k in found.tolist()], known.colors[found.astype(np.int64)]
    elif values.dtype.kind == "b":
        texts, colors = ["yes" if value else "no" for value in found], distinct_colors(len(found))
    else:
        texts, colors = [str(value) for value in found], distinct_colors(len(found))
    wide = len(found) > VALUE_STEPS
    packed = pack((keys.ravel() + 1).astype(np.uint32 if wide else np.uint16))
    return {"values": texts, "colors": pack(colors), "wide": wide, "keys": packed}


def _numbers(values: NDArray[np.generic]) -> dict[str, Any]:
    numbers = values.astype(np.float64)
    finite = np.isfinite(numbers)
    known = numbers[finite] if finite.any() else np.zeros(1)
    low, high = float(known.min()), float(known.max())
    step = (high - low) / VALUE_STEPS if high > low else 1.0
    keys = np.where(finite, 1 + np.rint((np.where(finite, numbers, low) - low) / step), 0).astype(np.uint16)
    ends = np.quantile(known, [SHOWN_TAIL, 1.0 - SHOWN_TAIL]).tolist()
    if ends[0] == ends[1]:
        ends = [low, high]
    return {"low": low, "step": step, "shown": ends, "whole": values.dtype.kind in "iu", "keys": pack(keys)}
