# SPDX-License-Identifier: Apache-2.0
"""The camera of a scene: Mitsuba's sensor in OpenCV's terms."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from rangesim.errors import FileFormatError, warn
from rangesim.rig import Intrinsics

# Mitsuba's camera looks along +z with x to the left and y up; ours has x to the right and y down.
MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])

UNSTATED_CLIP = {"near_clip": 0.01, "far_clip": 1e4}
"""Metres, of a sensor that states none: it asks for nothing to be hidden."""
MAX_BLUR_PX = 0.1
"""Diameter of a lens' blur beyond which leaving it out is warned of."""


def camera_of(sensor: Any, label: str) -> tuple[Intrinsics, np.ndarray]:
    """Intrinsics and T_world_camera (4, 4) of a `perspective` or `thinlens` sensor, as of a sharp pinhole.

    A film's crop window becomes the image. Mitsuba's principal point offset moves the image, hence the minus.

    Raises
    ------
    FileFormatError
        Another kind of sensor, or one whose `to_world` mirrors.
    """
    params = dict(mi.traverse(sensor))
    if "x_fov" not in params:
        raise FileFormatError(f"expected the sensor of {label} to be perspective, got {sensor.class_name()}.")
    width, height = (int(n) for n in sensor.film().size())
    crop_width, crop_height = (int(n) for n in sensor.film().crop_size())
    left, top = (int(n) for n in sensor.film().crop_offset())
    f = float(0.5 * width / np.tan(np.radians(_number(params["x_fov"])) / 2))
    x, y = (_number(params.get(f"principal_point_offset_{axis}", 0.0)) for axis in "xy")
    camera = Intrinsics(crop_width, crop_height, f, f, width * (0.5 - x) - left, height * (0.5 - y) - top)
    matrix = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4) @ MITSUBA_FROM_OPENCV
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)  # a scaled to_world scales no camera
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise FileFormatError(f"the sensor of {label} is mirrored; remove the negative scale from its to_world.")
    return camera, matrix


def warn_of_aperture(sensor: Any, camera: Intrinsics, distance_m: float, label: str) -> None:
    """Warn if a `thinlens` sensor would blur what is out of focus by more than `MAX_BLUR_PX`: here it is a pinhole.

    distance_m : metres, depth of what the camera sees.
    """
    params = dict(mi.traverse(sensor))
    if "aperture_radius" not in params:
        return
    radius, focus = (_number(params[name]) for name in ("aperture_radius", "focus_distance"))
    blur = 2 * radius * camera.fx / min(focus, distance_m)  # pixels, of what is far off
    if blur > MAX_BLUR_PX:
        warn(
            f"{label}: the camera's aperture of {radius:g} m is left out, so the image is sharp everywhere; state it "
            f"in the rig: camera_lens=Lens(aperture_radius_m={radius:g}, focus_m={focus:g})."
        )


def warn_of_clipping(sensor: Any, z: np.ndarray, label: str) -> None:
    """Warn if the sensor's near_clip or far_clip would hide surfaces from the camera: here it sees them.

    z : (n,) metres, depth of what some of its rays meet first; NaN where they meet nothing.
    """
    near, far = float(sensor.near_clip()), float(sensor.far_clip())
    for name, at, hidden in (("near_clip", near, z < near), ("far_clip", far, z > far)):
        if hidden.any() and not np.isclose(at, UNSTATED_CLIP[name]):
            warn(
                f"{label}: the camera's {name} of {at:g} m is left out, so it sees what that hides in Mitsuba, on "
                f"{100 * hidden.mean():.0f} % of its image; take these surfaces out of the scene."
            )


def _number(value: Any) -> float:
    return float(np.array(value).item())
