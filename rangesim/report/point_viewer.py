# SPDX-License-Identifier: Apache-2.0
"""Measurements packed for the viewer in the browser: arrays of small integers, deflated, in base64."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pcgraph.viewer.node_colors import node_colors
from pcgraph.viewer.packing import pack
from rangesim.report import palette
from rangesim.report.panorama import panorama
from rangesim.results.experiment_results import Measurement, Segmentation
from rangesim.rig import Camera, Intrinsics

NO_ERROR = -32768
"""Value of a packed error where there is no reading or no true surface: the smallest int16."""
ERROR_STEP_M = 1e-5
"""Unit of packed errors, in metres, chosen so that int16 reaches 0.33 m, which is more than the error scale shows."""
MIN_PIXEL_RAD = 1e-5
"""Smallest angle between rays, radians, by which the size of points is chosen; parallel rays have none."""
FAR_FACTOR = 1.5
"""Multiple of the farthest true depth, beyond which points are not drawn.

Such points are readings of mirrors and of wrong periods, far behind the scene. With a larger ratio more of them are
drawn, and all depths are packed in coarser steps; other values were not measured.
"""


def packed_measurement(m: Measurement, title: str, view: int, far_m: float) -> dict[str, Any]:
    """Data of one instrument for the viewer.

    Parameters
    ----------
    title : name of the instrument in the page.
    view : number of the camera, from 0; instruments of the same number share their pixels.
    far_m : metres, depth from which points are not drawn.

    Returns
    -------
    z : uint16, 0 without a point, else the reading = nearM + (value - 1) * stepM: z of a pinhole, the range of others.
    error : int16, in units of `ERROR_STEP_M`, clipped; `NO_ERROR` where it is not known.
    intensity, status, cause : uint8.
    segmentation : supervoxels as uint16 or uint32, 0 without a point, else index + 1; and their tree. None: no points.
    """
    camera, reading = m.camera, m.image.reading_m
    drawn = m.image.valid & (reading < far_m)
    near = float(reading[drawn].min()) if drawn.any() else 0.0
    step = max((far_m - near) / 65534, 1e-6)
    z = np.where(drawn, 1 + np.rint((np.where(drawn, reading, near) - near) / step), 0).astype(np.uint16)
    return {
        "title": title,
        "width": camera.width,
        "height": camera.height,
        "camera": _pinhole(camera),
        "rays": None if isinstance(camera, Intrinsics) else _packed_rays(camera),
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


def _pinhole(camera: Camera) -> list[float]:
    """Focal lengths and principal point, pixels, with which points are drawn as large as pixels are."""
    if isinstance(camera, Intrinsics):
        return [camera.fx, camera.fy, camera.cx, camera.cy]
    pixels_per_radian = 1 / max(camera.angle_of(1), MIN_PIXEL_RAD)
    return [pixels_per_radian, pixels_per_radian, camera.width / 2, camera.height / 2]


def _packed_rays(camera: Camera) -> dict[str, Any]:
    """Rays of a camera that is no pinhole, and the picture in which its pixels are shown.

    Returns
    -------
    directions : int16, three for each pixel, in units of 1 / 32767: 0.03 mm per metre.
    origins : float32, three for each pixel, metres; None: all 0.
    surrounds : whether some rays lead backwards, so that the points lie all around the camera.
    columns, rows, pixel : size of the picture, and int32, flat index of the pixel that each place shows; -1 for none.
    """
    rays, shown = camera.rays, panorama(camera).pixel
    directions = np.nan_to_num(rays.directions)
    return {
        "directions": pack(np.rint(32767 * directions).astype(np.int16)),
        "origins": pack(np.nan_to_num(rays.origins).astype(np.float32)) if rays.origins.any() else None,
        "surrounds": bool((directions[..., 2] < 0).any()),
        "columns": shown.shape[1],
        "rows": shown.shape[0],
        "pixel": pack(shown),
    }


def far_limit(measurements: Sequence[Measurement]) -> float:
    """Depth, in metres, from which points are not drawn, for measurements that share a camera."""
    depths = [float(np.nanmax(m.true_m)) for m in measurements if np.isfinite(m.true_m).any()]
    return FAR_FACTOR * max(depths, default=1.0)


def _error(m: Measurement) -> np.ndarray:
    """(h, w) int16 errors of the readings, as `packed_measurement` says."""
    error = m.image.reading_m - m.true_m
    known = np.isfinite(error)
    steps = np.clip(np.rint(np.where(known, error, 0) / ERROR_STEP_M), -32767, 32767)
    return np.where(known, steps, NO_ERROR).astype(np.int16)


def _intensity(m: Measurement) -> np.ndarray:
    """(h, w) uint8 intensity for display, with gamma 2.2; the 98th percentile of the readings is white."""
    value = np.nan_to_num(m.image.intensity)
    white = float(np.percentile(value[m.image.valid], 98)) if m.image.valid.any() else 1.0
    return np.rint(255 * np.clip(value / max(white, 1e-30), 0, 1) ** (1 / 2.2)).astype(np.uint8)


def _packed_tree(s: Segmentation) -> dict[str, Any]:
    """Supervoxels and their tree for the viewer, with a colour for each node.

    The altitudes ascend, so that the first k merges of the tree are a cut.
    """
    leaves = (len(s.parents) + 1) // 2
    sizes = np.bincount(s.supervoxels[s.supervoxels >= 0], minlength=leaves)
    wide = leaves >= 65535
    return {
        "leaves": leaves,
        "wide": wide,
        "supervoxel": pack((s.supervoxels + 1).astype(np.uint32 if wide else np.uint16)),
        "parents": pack(s.parents.astype(np.int32)),
        "altitudes": pack(s.altitudes.astype(np.float32)),
        "colors": pack(node_colors(s.parents, sizes)),
        "objects": int(s.labels.max()) + 1,
    }
