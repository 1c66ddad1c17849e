# SPDX-License-Identifier: Apache-2.0
"""The camera of a scene: a Mitsuba sensor described in OpenCV's conventions."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from rangesim.errors import FileFormatError, warn
from rangesim.rig import Intrinsics

MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
"""(4, 4) transform from camera coordinates as here (OpenCV: x right, y down, z forward) to those of Mitsuba (x left, y
up, z forward)."""
UNSTATED_CLIP = {"near_clip": 0.01, "far_clip": 1e4}
"""Clipping distances in metres that Mitsuba 3.9 gives a sensor whose file states none. They cause no warning, because
nobody asked for them."""
MAX_BLUR_PX = 0.1
"""Largest diameter of a defocus blur, in pixels, that is left out without a warning. It is far below one pixel, so
nothing shows; a larger value would hide blur that widens edges."""


def camera_of(sensor: Any, label: str) -> tuple[Intrinsics, np.ndarray]:
    """Intrinsics and T_world_camera (4, 4) of a `perspective` or `thinlens` sensor, taken as a pinhole.

    If the film has a crop window, this window is the image.

    Parameters
    ----------
    sensor : mitsuba.Sensor. label : name of the scene, for messages.

    Raises
    ------
    FileFormatError
        The sensor is of another kind, or its `to_world` mirrors.
    """
    params = dict(mi.traverse(sensor))
    if "x_fov" not in params:
        raise FileFormatError(f"expected the sensor of {label} to be perspective, got {sensor.class_name()}.")
    width, height = (int(n) for n in sensor.film().size())
    crop_width, crop_height = (int(n) for n in sensor.film().crop_size())
    left, top = (int(n) for n in sensor.film().crop_offset())
    f = float(0.5 * width / np.tan(np.radians(_number(params["x_fov"])) / 2))
    # Mitsuba's offset moves the image relative to the principal point, hence the minus
    x, y = (_number(params.get(f"principal_point_offset_{axis}", 0.0)) for axis in "xy")
    camera = Intrinsics(crop_width, crop_height, f, f, width * (0.5 - x) - left, height * (0.5 - y) - top)
    matrix = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4) @ MITSUBA_FROM_OPENCV
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)  # the scale of a to_world does not concern a camera
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise FileFormatError(f"the sensor of {label} is mirrored; remove the negative scale from its to_world.")
    return camera, matrix


def warn_of_aperture(sensor: Any, camera: Intrinsics, distance_m: float, label: str) -> None:
    """Warn if a `thinlens` sensor, which is taken as a pinhole here, would blur by more than `MAX_BLUR_PX`.

    distance_m : typical depth of what the camera sees, metres.
    """
    params = dict(mi.traverse(sensor))
    if "aperture_radius" not in params:
        return
    radius, focus = (_number(params[name]) for name in ("aperture_radius", "focus_distance"))
    blur = 2 * radius * camera.fx / min(focus, distance_m)  # pixels, at infinity
    if blur > MAX_BLUR_PX:
        warn(
            f"{label}: the camera's aperture of {radius:g} m is ignored, so the image is sharp everywhere; state it "
            f"in the rig: camera_lens=Lens(aperture_radius_m={radius:g}, focus_m={focus:g})."
        )


def warn_of_clipping(sensor: Any, z: np.ndarray, label: str) -> None:
    """Warn if near_clip or far_clip of the sensor would hide surfaces in Mitsuba, because our camera sees them.

    z : (n,) depths of the surfaces that some rays of the camera meet first, metres; NaN where they meet none.
    """
    near, far = float(sensor.near_clip()), float(sensor.far_clip())
    for name, at, hidden in (("near_clip", near, z < near), ("far_clip", far, z > far)):
        if hidden.any() and not np.isclose(at, UNSTATED_CLIP[name]):
            warn(
                f"{label}: the camera's {name} of {at:g} m is ignored, so it sees surfaces that Mitsuba hides, on "
                f"{100 * hidden.mean():.0f} % of its image; remove these surfaces from the scene."
            )


def _number(value: Any) -> float:
    return float(np.array(value).item())
