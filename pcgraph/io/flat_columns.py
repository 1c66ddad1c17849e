# SPDX-License-Identifier: Apache-2.0
"""Columns of a cloud as fields of one number per point, with names that a format allows, and back to the cloud.

Formats of laser scanners hold one number per point and field, under short names. The writer keeps a description in the
file, a JSON object with the column that each field belongs to; other programs skip it. Fields that it does not name,
for example those that another program added, become columns of their own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import COLOR_NAMES, NORMAL_NAMES, Cloud, cloud_from_columns

Arrays = dict[str, NDArray[np.generic]]
NORMALS = ("NormalX", "NormalY", "NormalZ")
"""Fields of normals, under the names that CloudCompare gives them in LAS files."""
LABEL = "label"
_VIEWPOINTS = ("vp_x", "vp_y", "vp_z")
"""Fields of viewpoints, one for each point, as in PCL's PointWithViewpoint."""
_STORED = {"b1": "u1", "f2": "f4", "f16": "f8"}
"""Types that no such format has, and the types that are stored instead. Only float128 (``f16``) loses digits."""


def flatten(
    cloud: Cloud, kept: Collection[str], taken: Collection[str], safe_name: Callable[[str, int], str]
) -> tuple[Arrays, bytes]:
    """Fields, (n,) each, of a cloud's columns, normals, labels and viewpoints, and their description.

    Parameters
    ----------
    cloud : Cloud
    kept : names of columns
        Columns that go into fields of the format itself, which have the same names.
    taken : names of fields
        Names, in upper or lower case, that the fields of other columns must not have.
    safe_name : (name, room) -> str
        Function that turns any name into one that the format allows, with room for that many more characters.
    """
    fields: Arrays = {}
    used = {name.lower() for name in (*taken, *kept, *NORMALS, *_VIEWPOINTS, LABEL)}

    def add(name: str, values: NDArray[np.generic]) -> str:
        endings = ("", *(f"_{number}" for number in range(2, len(used) + 3)))
        stored = next(s for s in (safe_name(name, len(end)) + end for end in endings) if s.lower() not in used)
        used.add(stored.lower())
        fields[stored] = values.astype(_STORED.get(values.dtype.str[1:], values.dtype))
        return stored

    parts: dict[str, str | list[str]] = {}
    for name, column in cloud.columns.items():
        if name in kept:
            fields[name], parts[name] = column.reshape(-1), name
        elif column.ndim == cloud.points.ndim - 1:
            parts[name] = add(name, column.reshape(-1))
        else:
            rows = column.reshape(cloud.points.size // 3, column.shape[-1])
            parts[name] = [add(f"{name}_{i}", rows[:, i]) for i in range(rows.shape[1])]
    description: dict[str, Any] = {"columns": parts}
    if cloud.normals is not None:
        fields |= dict(zip(NORMALS, cloud.normals.reshape(-1, 3).T, strict=True))
    if cloud.labels is not None:
        fields[LABEL] = cloud.labels.reshape(-1)
    if cloud.viewpoint is not None and cloud.viewpoint.ndim == 1:
        description["viewpoint"] = cloud.viewpoint.tolist()
    elif cloud.viewpoint is not None:
        fields |= dict(zip(_VIEWPOINTS, cloud.viewpoint.reshape(-1, 3).T, strict=True))
        description["viewpoint"] = list(_VIEWPOINTS)
    return fields, json.dumps(description).encode()


def described(text: bytes | None) -> dict[str, Any] | None:
    """The description that `flatten` wrote; None if it is missing or damaged."""
    if text is None:
        return None
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) and isinstance(found.get("columns"), dict) else None


def unflatten(
    points: NDArray[np.floating],
    colors: NDArray[np.generic] | None,
    fields: Arrays,
    description: dict[str, Any] | None,
    viewpoint: NDArray[np.float64] | None = None,
) -> Cloud:
    """Cloud of points and fields; `cloud_from_columns` interprets the fields that the description does not name.

    Parameters
    ----------
    points, colors : (n, 3)
        Colours uint8, or uint16 where white is 65535.
    fields : dict of name to (n,) or (n, c) array
    description : dict, or None
        As `described` returns it.
    viewpoint : (3,) or (n, 3) float64, metres, or None
        Position of the sensor as the file itself states it.
    """
    left = dict(fields)
    columns: Arrays = {}
    if description is not None:
        for name, stored in description["columns"].items():
            values = _taken(left, stored)
            if values is not None:
                columns[name] = values
        viewpoint = _viewpoint(left, description.get("viewpoint")) if viewpoint is None else viewpoint
    normals = _taken(left, list(NORMALS))
    coordinates: Arrays = dict(zip("xyz", points.T, strict=True))
    if colors is not None:
        coordinates |= dict(zip(COLOR_NAMES, colors.T, strict=True))
    if normals is not None:
        coordinates |= dict(zip(NORMAL_NAMES[1], normals.T, strict=True))
    cloud = cloud_from_columns({**left, **coordinates}, (len(points),), viewpoint)
    return replace(cloud, columns=columns | {n: column for n, column in cloud.columns.items() if n not in columns})


def _taken(fields: Arrays, stored: object) -> NDArray[np.generic] | None:
    """The field of a name, or those of a list of names as (n, c), removed from `fields`; None if one is missing."""
    if isinstance(stored, str):
        return fields.pop(stored, None)
    if not (isinstance(stored, list) and stored and all(isinstance(name, str) and name in fields for name in stored)):
        return None
    if len(set(stored)) < len(stored) or any(fields[name].ndim != 1 for name in stored):
        return None
    return np.stack([fields.pop(name) for name in stored], axis=1)


def _viewpoint(fields: Arrays, stored: object) -> NDArray[np.float64] | None:
    """Viewpoint of a description, (3,), or of the fields that it names, (n, 3)."""
    if isinstance(stored, list) and len(stored) == 3 and all(isinstance(value, float) for value in stored):
        return np.array(stored)
    values = _taken(fields, stored)
    return None if values is None or values.ndim != 2 or values.shape[1] != 3 else values.astype(np.float64)
