# SPDX-License-Identifier: Apache-2.0
"""The image of points through a lens, and its derivatives by the points, the pose and the lens, in closed form.

Every adjustment of cameras is built from these functions: one pose (`camera_pose`), calibration boards
(`rangesim.calibration.bundle`) and many views (`rangesim.multiview.bundle_adjustment`). A step of a pose is a rotation
vector w and a translation v, both applied after the pose: [R | t] becomes exp([w]_x) [R | t] + [0 | v].

Used by: rangesim.geometry.camera_pose; rangesim.calibration.bundle, rig_calibration and zhang;
rangesim.multiview.bundle_adjustment.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.geometry.correspondences import Array
from rangesim.rig import Intrinsics
from rangesim.rig.camera_model import appears, distort, to_pixel

LENS = 9
"""Number of parameters of a device, as in OpenCV's camera model: fx, fy, cx, cy, k1, k2, p1, p2 and k3."""

POSE = 6
"""Number of parameters of a step of a pose: three of a rotation vector, applied after the rotation, and three of a
translation."""

MIN_FOCAL_PX = 1.0
"""Least focal length in pixels that a step of an adjustment can leave, so that no step turns the image over. Real
devices have some hundred pixels and never come near it at the end."""


class Reprojection(NamedTuple):
    """The image of points, with its derivatives.

    Attributes
    ----------
    pixels : (m, 2) float64.
    by_point : (m, 2, 3) float64, derivatives of the pixels by the points, px / m, device coordinates.
    appears : (m,) bool, whether a point lies in front of the device and within the fold of its distortion. Where it
        does not, pixels and derivatives have no meaning.
    """

    pixels: Array
    by_point: Array
    appears: np.ndarray


def reproject(device: Intrinsics, X: Array) -> Reprojection:
    """The image of points X (m, 3), in device coordinates and metres, with its derivatives."""
    z = X[:, 2]
    x, y, one = X[:, 0] / z, X[:, 1] / z, 1.0 / z
    image = distort(device.coefficients, x, y)
    is_seen = (z > 0) & appears(device.model, x, y, image)
    by_point = np.empty((len(X), 2, 3))
    for k, (focal, by_x, by_y) in enumerate(((device.fx, image.xx, image.xy), (device.fy, image.xy, image.yy))):
        by_point[:, k, 0], by_point[:, k, 1] = focal * by_x * one, focal * by_y * one
        by_point[:, k, 2] = -(by_point[:, k, 0] * x + by_point[:, k, 1] * y)
    pixels = np.stack(to_pixel(device.model, image.x, image.y), axis=-1)
    return Reprojection(pixels, by_point, is_seen)


def by_lens(device: Intrinsics, X: Array) -> Array:
    """(m, 2, 9) float64 derivatives of the image of points X (m, 3) by the parameters of the device, as in `LENS`."""
    x, y = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]
    image = distort(device.coefficients, x, y)
    r2 = x * x + y * y
    result = np.zeros((len(X), 2, LENS))
    result[:, 0, 0], result[:, 1, 1] = image.x, image.y
    result[:, 0, 2] = result[:, 1, 3] = 1.0
    columns = (
        (4, x * r2, y * r2),
        (5, x * r2**2, y * r2**2),
        (6, 2 * x * y, r2 + 2 * y * y),
        (7, r2 + 2 * x * x, 2 * x * y),
        (8, x * r2**3, y * r2**3),
    )
    for column, along_x, along_y in columns:
        result[:, 0, column], result[:, 1, column] = device.fx * along_x, device.fy * along_y
    return result


def by_pose(X: Array) -> Array:
    """(m, 3, 6) float64 derivatives of points by a step of their pose; X (m, 3) metres are the points after it."""
    result = np.zeros((len(X), 3, POSE))
    result[:, 0, 1], result[:, 0, 2] = X[:, 2], -X[:, 1]
    result[:, 1, 0], result[:, 1, 2] = -X[:, 2], X[:, 0]
    result[:, 2, 0], result[:, 2, 1] = X[:, 1], -X[:, 0]
    result[:, :, 3:] = np.eye(3)
    return result


def moved_pose(T: Array, delta: Array) -> Array:
    """Poses (..., 4, 4) moved by steps (..., 6): a rotation vector, rad, and a translation, metres."""
    turn = Rotation.from_rotvec(delta[..., :3]).as_matrix()
    moved = T.copy()
    moved[..., :3, :] = turn @ T[..., :3, :]
    moved[..., :3, 3] += delta[..., 3:]
    return moved


def with_all_coefficients(device: Intrinsics) -> Intrinsics:
    """The same device with all five coefficients of distortion, those that were left out as 0."""
    return replace(device, distortion=device.coefficients)


def moved_lens(device: Intrinsics, delta: Array) -> Intrinsics:
    """The device after a step of its first len(delta) parameters, in the order of `LENS`."""
    moved = np.zeros(LENS)
    moved[: len(delta)] = delta
    fx, fy, cx, cy = (float(v) for v in np.array([device.fx, device.fy, device.cx, device.cy]) + moved[:4])
    coefficients = tuple(float(v) for v in np.array(device.coefficients) + moved[4:])
    return Intrinsics(device.width, device.height, max(fx, MIN_FOCAL_PX), max(fy, MIN_FOCAL_PX), cx, cy, coefficients)
