# SPDX-License-Identifier: Apache-2.0
"""Path lengths to ranges, for an emitter at any pose."""

from __future__ import annotations

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.rig import Rig


def range_from_path_length(length_m: np.ndarray, directions: np.ndarray, rig: Rig) -> np.ndarray:
    """(...) range in metres along camera rays at which the path emitter -> point -> camera has this length.

    With unit ray d and emitter centre b (camera coordinates) the length is l = r + |r d - b|. Squaring (l - r)^2 =
    r^2 - 2 r d.b + b^2 leaves r linear: r = (l^2 - b^2) / (2 (l - d.b)), where the ray meets the ellipsoid
    with foci at camera and emitter. NaN where the length is not larger than the baseline |b|: no such point
    is in front.

    Parameters
    ----------
    length_m : (...) float, metres. directions : (..., 3) float, camera rays of any length, camera coordinates.
    """
    b = rig.T_camera_projector[:3, 3]
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    length = np.asarray(length_m, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        result = (length**2 - b @ b) / (2 * (length - d @ b))
        return np.asarray(np.where(length > np.linalg.norm(b), result, np.nan))


def range_image_from_path_length(
    capture: Capture,
    length_m: np.ndarray,
    *,
    status: np.ndarray,
    confidence: np.ndarray,
    intensity: np.ndarray,
) -> RangeImage:
    """Range image of decoded path lengths; lengths that lead to no point in front of the camera are
    OUT_OF_RANGE.

    Without a rig, range is half the path length and z is NaN.

    Parameters
    ----------
    length_m : (h, w) float, metres. status : (h, w) uint8. confidence, intensity : (h, w) float.
    """
    rig, status = capture.rig, status.astype(np.uint8)
    z_m, range_m = np.empty((2, *status.shape), dtype=np.float32)
    for rows in bands(len(status)):
        if rig is None:
            along_ray, z = length_m[rows] / 2, np.float64(np.nan)
        else:
            directions = rig.camera.directions(rig.camera.pixel_centres(rows))
            along_ray = range_from_path_length(length_m[rows], directions, rig)
            z = along_ray / np.linalg.norm(directions, axis=-1)
        in_front = np.nan_to_num(along_ray, nan=-1.0) > 0
        status[rows][(status[rows] == Status.OK) & ~in_front] = Status.OUT_OF_RANGE
        ok = status[rows] == Status.OK
        z_m[rows], range_m[rows] = np.where(ok, z, np.nan), np.where(ok, along_ray, np.nan)
    return RangeImage(
        z=z_m,
        range_m=range_m,
        confidence=np.clip(confidence, 0, 1).astype(np.float32),
        status=status,
        intensity=np.asarray(intensity, dtype=np.float32),
        camera=rig.camera if rig else None,
        T_world_camera=rig.T_world_camera if rig else None,
    )
