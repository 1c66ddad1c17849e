# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of one or two devices that see the same boards: lenses, poses of the boards, pose of the second.

Reprojection errors through the lens, distortion included, are minimised over everything at once, with Jacobians in
closed form; the inverse of J^T J at the minimum is the covariance (Triggs et al. 2000: "Bundle adjustment - a modern
synthesis"). A projector is a camera that is told what it sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.geometry.correspondences import Array
from rangesim.geometry.least_squares import Minimum, minimise
from rangesim.rig import Intrinsics
from rangesim.rig.distortion import distort

LENS = 9
"""Parameters of a device: fx, fy, cx, cy, k1, k2, p1, p2, k3."""
POSE = 6
"""Of a pose: a rotation vector applied after the rotation, and a translation."""

REWEIGHTINGS = 8


@dataclass(frozen=True, eq=False)
class Observation:
    """Points of one board as one device sees them.

    device : 0 or 1. view : which pose of the board. points : (m, 3) metres, board coordinates. pixels : (m, 2).
    noise_px : standard deviation of a coordinate, by which the errors are divided, where devices differ in it.
    """

    device: int
    view: int
    points: Array
    pixels: Array
    noise_px: float = 1.0


@dataclass(frozen=True, eq=False)
class Bundle:
    """Devices and boards.

    devices : one or two. T_second_first : (4, 4) maps coordinates of the first device to the second's; the identity if
    there is but one. T_first_board : (k, 4, 4) maps each board's coordinates to the first device's.
    """

    devices: tuple[Intrinsics, ...]
    T_second_first: Array
    T_first_board: Array

    def project(self, seen: Observation) -> Array:
        """(m, 2) pixels where the points should be seen; NaN behind the device."""
        T = self.T_first_board[seen.view]
        if seen.device:
            T = self.T_second_first @ T
        return self.devices[seen.device].project(seen.points @ T[:3, :3].T + T[:3, 3])


def adjust(start: Bundle, observations: Sequence[Observation], coefficients: int = 5) -> Minimum[Bundle]:
    """The bundle of least squared reprojection error, from `start` downwards.

    Parameters
    ----------
    coefficients : how many of k1, k2, p1, p2, k3 are free, in that order; the others stay as they are.

    The step's parameters, in the order of the covariance: `LENS` of each device less the fixed ones, then `POSE` of
    T_second_first if there are two devices, then `POSE` of each board.
    """
    start = replace(start, devices=tuple(_complete(device) for device in start.devices))
    n_devices, n_views = len(start.devices), len(start.T_first_board)
    lens = 4 + coefficients
    between = n_devices * lens
    boards = between + POSE * (n_devices - 1)
    size = boards + POSE * n_views

    def residuals(bundle: Bundle) -> tuple[Array, Array]:
        values, jacobians = [], []
        for seen in observations:
            device = bundle.devices[seen.device]
            T = bundle.T_first_board[seen.view]
            X = seen.points @ T[:3, :3].T + T[:3, 3]
            by_board = _by_pose(X)
            by_second = None
            if seen.device:
                R = bundle.T_second_first[:3, :3]
                X = X @ R.T + bundle.T_second_first[:3, 3]
                by_board, by_second = R @ by_board, _by_pose(X)
            pixels, by_point, by_lens = projection(device, X)
            jacobian = np.zeros((len(X), 2, size))
            jacobian[:, :, seen.device * lens : (seen.device + 1) * lens] = by_lens[:, :, :lens]
            if by_second is not None:
                jacobian[:, :, between:boards] = by_point @ by_second
            first = boards + POSE * seen.view
            jacobian[:, :, first : first + POSE] = by_point @ by_board
            values.append((pixels - seen.pixels).ravel() / seen.noise_px)
            jacobians.append(jacobian.reshape(-1, size) / seen.noise_px)
        return np.concatenate(values), np.concatenate(jacobians)

    def step(bundle: Bundle, delta: Array) -> Bundle:
        devices = tuple(
            _moved_lens(device, delta[d * lens : (d + 1) * lens]) for d, device in enumerate(bundle.devices)
        )
        second = bundle.T_second_first
        if n_devices == 2:
            second = _moved_pose(second, delta[between:boards])
        views = delta[boards:].reshape(-1, POSE)
        poses = [_moved_pose(T, part) for T, part in zip(bundle.T_first_board, views, strict=True)]
        return Bundle(devices, second, np.stack(poses))

    return minimise(residuals, step, start)


def reweighted(start: Bundle, observations: Sequence[Observation], coefficients: int) -> Bundle:
    """The bundle when each view of each device is weighed by its own scatter, again and again.

    One view that contradicts the others bends the solution of least squares until all have errors; here it is left
    with them, so that it can be told which it is.
    """
    bundle = start
    for _ in range(REWEIGHTINGS):
        scatter = np.array([np.sqrt(np.square(bundle.project(o) - o.pixels).mean()) for o in observations])
        for device in range(len(start.devices)):
            of_device = np.array([o.device == device for o in observations])
            scatter[of_device] = np.maximum(scatter[of_device], np.median(scatter[of_device]))
        weighed = [replace(o, noise_px=max(float(s), 1e-9)) for o, s in zip(observations, scatter, strict=True)]
        bundle = adjust(bundle, weighed, coefficients).state
    return bundle


def _complete(device: Intrinsics) -> Intrinsics:
    return replace(device, distortion=device.coefficients)


def _moved_lens(device: Intrinsics, delta: Array) -> Intrinsics:
    moved = np.zeros(LENS)
    moved[: len(delta)] = delta
    fx, fy, cx, cy = (float(v) for v in np.array([device.fx, device.fy, device.cx, device.cy]) + moved[:4])
    coefficients = tuple(float(v) for v in np.array(device.coefficients) + moved[4:])
    return Intrinsics(device.width, device.height, max(fx, 1.0), max(fy, 1.0), cx, cy, coefficients)


def _moved_pose(T: Array, delta: Array) -> Array:
    moved = T.copy()
    turn = Rotation.from_rotvec(delta[:3]).as_matrix()
    moved[:3, :3], moved[:3, 3] = turn @ T[:3, :3], turn @ T[:3, 3] + delta[3:]
    return moved


def _by_pose(X: Array) -> Array:
    """(m, 3, 6) derivatives of points X by a rotation vector about the origin and by a translation."""
    result = np.zeros((len(X), 3, POSE))
    result[:, 0, 1], result[:, 0, 2] = X[:, 2], -X[:, 1]
    result[:, 1, 0], result[:, 1, 2] = -X[:, 2], X[:, 0]
    result[:, 2, 0], result[:, 2, 1] = X[:, 1], -X[:, 0]
    result[:, :, 3:] = np.eye(3)
    return result


def projection(device: Intrinsics, X: Array) -> tuple[Array, Array, Array]:
    """(m, 2) pixels of points (m, 3), and their derivatives by the point (m, 2, 3) and by the lens (m, 2, 9)."""
    x, y, inverse = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2], 1.0 / X[:, 2]
    image = distort(device.coefficients, x, y)
    by_xy = np.stack(
        [
            np.stack([device.fx * image.xx, device.fx * image.xy], axis=-1),
            np.stack([device.fy * image.xy, device.fy * image.yy], axis=-1),
        ],
        axis=1,
    )
    by_X = np.zeros((len(X), 2, 3))
    by_X[:, 0, 0] = by_X[:, 1, 1] = inverse
    by_X[:, 0, 2], by_X[:, 1, 2] = -x * inverse, -y * inverse
    r2 = x * x + y * y
    by_lens = np.zeros((len(X), 2, LENS))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = image.x, image.y
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    columns = (
        (4, x * r2, y * r2),
        (5, x * r2**2, y * r2**2),
        (6, 2 * x * y, r2 + 2 * y * y),
        (7, r2 + 2 * x * x, 2 * x * y),
        (8, x * r2**3, y * r2**3),
    )
    for column, along_x, along_y in columns:
        by_lens[:, 0, column], by_lens[:, 1, column] = device.fx * along_x, device.fy * along_y
    pixels = np.stack([device.fx * image.x + device.cx, device.fy * image.y + device.cy], axis=-1)
    return pixels, by_xy @ by_X, by_lens
