# SPDX-License-Identifier: Apache-2.0
"""Measurements packed for the viewer in the browser: small integers, deflated, base64."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from rangesim.report import palette
from rangesim.results.run_files import Measurement, Segmentation

NO_ERROR = -32768
ERROR_STEP_M = 1e-5
DEFLATE_LEVEL = 4
"""The default, 6, makes a page of 7 MB 1 % smaller, in twice the time."""
FAR = 1.5
"""Points beyond this multiple of the farthest true depth are not drawn."""


def pack(array: np.ndarray) -> str:
    """Base64 of the deflated bytes of an array, little-endian, row by row."""
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return base64.b64encode(zlib.compress(little.tobytes(), DEFLATE_LEVEL)).decode("ascii")


def packed_measurement(m: Measurement, title: str, view: int, far_m: float) -> dict[str, Any]:
    """Data of one instrument for the viewer.

    Parameters
    ----------
    view : number of the camera, from 0; instruments of the same number share their pixels.
    far_m : metres, z from which points are not drawn.

    Returns
    -------
    z : uint16, 0 for none, else near_m + (value - 1) step_m. error : int16, in 10 µm, clipped.
    intensity, status, cause : uint8. supervoxel : uint16 or uint32, 0 for none, else index + 1.
    """
    camera = m.image.camera
    assert camera is not None  # every measurement of an experiment has its rig
    drawn = m.image.valid & (m.image.z < far_m)
    near = float(m.image.z[drawn].min()) if drawn.any() else 0.0
    step = max((far_m - near) / 65534, 1e-6)
    z = np.where(drawn, 1 + np.rint((np.where(drawn, m.image.z, near) - near) / step), 0).astype(np.uint16)
    return {
        "title": title,
        "width": camera.width,
        "height": camera.height,
        "camera": [camera.fx, camera.fy, camera.cx, camera.cy],
        "nearM": near,
        "stepM": step,
        "view": view,
        "hidden": int((m.image.valid & ~drawn).sum()),
        "lightPass": m.light_pass - 1,
        "z": pack(z),
        "error": pack(_error(m)),
        "intensity": pack(_intensity(m)),
        "status": pack(m.image.status.astype(np.uint8)),
        "cause": pack(palette.outcomes(m)),
        "segmentation": _packed_tree(m.segmentation) if m.segmentation else None,
    }


def far_limit(measurements: Sequence[Measurement]) -> float:
    """Metres, z from which no points of these measurements, which share a camera, are drawn."""
    depths = [float(np.nanmax(m.truth.z)) for m in measurements if np.isfinite(m.truth.z).any()]
    return FAR * max(depths, default=1.0)


def _error(m: Measurement) -> np.ndarray:
    error = m.image.z - m.truth.z
    known = np.isfinite(error)
    steps = np.clip(np.rint(np.where(known, error, 0) / ERROR_STEP_M), -32767, 32767)
    return np.where(known, steps, NO_ERROR).astype(np.int16)


def _intensity(m: Measurement) -> np.ndarray:
    value = np.nan_to_num(m.image.intensity)
    white = float(np.percentile(value[m.image.valid], 98)) if m.image.valid.any() else 1.0
    return np.rint(255 * np.clip(value / max(white, 1e-30), 0, 1) ** (1 / 2.2)).astype(np.uint8)


def _packed_tree(s: Segmentation) -> dict[str, Any]:
    """Supervoxels, the tree in ascending order (so that its first k merges are a cut), and a colour per node."""
    leaves = (len(s.parents) + 1) // 2
    sizes = np.bincount(s.supervoxels[s.supervoxels >= 0], minlength=leaves)
    wide = leaves >= 65535
    return {
        "leaves": leaves,
        "wide": wide,
        "supervoxel": pack((s.supervoxels + 1).astype(np.uint32 if wide else np.uint16)),
        "parents": pack(s.parents.astype(np.int32)),
        "altitudes": pack(s.altitudes.astype(np.float32)),
        "colors": pack(_colors(s.parents, sizes)),
        "objects": int(s.labels.max()) + 1,
    }


def _colors(parents: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(k, 3) uint8: a node has the colour of its largest child, so refining a cut recolours only what splits off."""
    leaves, nodes = len(sizes), len(parents)
    total, largest, chief = np.zeros(nodes, np.int64), np.zeros(nodes, np.int64), np.arange(nodes)
    total[:leaves] = sizes
    for node in range(nodes - 1):  # children come before parents, the root is last
        parent = parents[node]
        total[parent] += total[node]
        if total[node] > largest[parent]:
            largest[parent], chief[parent] = total[node], chief[node]
    return _distinct(leaves)[chief]


def _distinct(count: int) -> np.ndarray:
    """(count, 3) uint8, colours whose neighbours in the list are far apart in hue."""
    from matplotlib.colors import hsv_to_rgb

    i = np.arange(count)
    hue = (i * 0.618033988749895) % 1
    hsv = np.stack([hue, 0.45 + 0.35 * ((i * 0.754877666) % 1), 0.62 + 0.33 * ((i * 0.569840296) % 1)], axis=-1)
    return np.rint(255 * hsv_to_rgb(hsv)).astype(np.uint8)
