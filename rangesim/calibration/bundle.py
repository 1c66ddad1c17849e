# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of one or two devices that see the same boards.

It finds the lenses, the poses of the boards and the pose of the second device together, so that the reprojection errors
through the lenses, with their distortion, are smallest. The Jacobians have closed forms, and the inverse of J^T J at
the minimum is the covariance (Triggs et al. 2000: "Bundle adjustment - a modern synthesis"). A projector is a device
like a camera: its pixels of a point come from the decoded coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesim.geometry.correspondences import Array
from rangesim.geometry.least_squares import Minimum, minimise
from rangesim.geometry.reprojection import (
    POSE,
    by_lens,
    by_pose,
    moved_lens,
    moved_pose,
    reproject,
    with_all_coefficients,
)
from rangesim.rig import Intrinsics

REWEIGHTINGS = 8
"""Number of rounds of `reweighted`, a count of adjustments. Measured with 8 views, one of which disagrees by 1.2 px:
after two rounds the other views have only their noise, and 4 to 16 rounds change nothing. Eight leave a margin."""


@dataclass(frozen=True, eq=False)
class Observation:
    """The points of one board in one pose, as one device sees them.

    device : number of the device, 0 or 1.
    view : number of the pose of the board.
    points : (m, 3) float64, board coordinates, metres.
    pixels : (m, 2) float64, (x, y) with pixel centres at integer + 0.5.
    noise_px : standard deviation of a pixel's coordinate; the errors are divided by it. It only matters if it differs
        between the devices or the views.

    Examples
    --------
    See `adjust`.
    """

    device: int
    view: int
    points: Array
    pixels: Array
    noise_px: float = 1.0


@dataclass(frozen=True, eq=False)
class Bundle:
    """One or two devices, and the poses of the boards.

    devices : the lenses of the devices.
    T_second_first : (4, 4) float64, maps coordinates of the first device to those of the second, metres; the identity
        if there is only one device.
    T_first_board : (k, 4, 4) float64, maps the coordinates of each board to those of the first device, metres.

    Examples
    --------
    See `adjust`.
    """

    devices: tuple[Intrinsics, ...]
    T_second_first: Array
    T_first_board: Array

    def project(self, seen: Observation) -> Array:
        """(m, 2) float64, pixels to which the points of an observation project; NaN for points behind the device."""
        T = self.T_first_board[seen.view]
        if seen.device:
            T = self.T_second_first @ T
        return self.devices[seen.device].project(seen.points @ T[:3, :3].T + T[:3, 3])


def adjust(start: Bundle, observations: Sequence[Observation], coefficients: int = 5) -> Minimum[Bundle]:
    """The bundle with the least squared reprojection error, found by a descent from a start.

    Parameters
    ----------
    start : lenses and poses that the descent starts from.
    observations : what the devices see.
    coefficients : number of free coefficients of distortion, in the order k1, k2, p1, p2, k3; the others stay.

    Returns
    -------
    The minimum, with its residuals divided by `noise_px`. The parameters of its Jacobian and of its covariance are the
    free ones of each lens, then the six of T_second_first if there are two devices, then the six of each board. Each
    six are a rotation vector, radians, and a translation, metres, both applied after the pose.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.calibration import Checkerboard
    >>> from rangesim.rig import Intrinsics, look_at
    >>> board = Checkerboard(columns=9, rows=6, square_m=0.025)
    >>> true = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> places = [(0.3, 0.1, -0.5), (-0.3, 0, -0.5), (0, 0.3, -0.6)]  # three cameras, in board coordinates
    >>> T = np.stack([np.linalg.inv(look_at(place, (0.1, 0.06, 0.0), (0, -1, 0))) for place in places])
    >>> pixels = [true.project(board.points @ pose[:3, :3].T + pose[:3, 3]) for pose in T]
    >>> seen = [Observation(0, view, board.points, x) for view, x in enumerate(pixels)]
    >>> start = Bundle((Intrinsics(640, 480, 650.0, 650.0, 320.0, 240.0),), np.eye(4), T)
    >>> found = adjust(start, seen, coefficients=0)
    >>> round(found.state.devices[0].fx, 3), found.jacobian.shape  # 324 coordinates; 4 of the lens, 6 of each pose
    (600.0, (324, 22))
    """
    start = replace(start, devices=tuple(with_all_coefficients(device) for device in start.devices))
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
            by_board = by_pose(X)
            by_second = None
            if seen.device:
                R = bundle.T_second_first[:3, :3]
                X = X @ R.T + bundle.T_second_first[:3, 3]
                by_board, by_second = R @ by_board, by_pose(X)
            pixels, by_point, _ = reproject(device, X)
            jacobian = np.zeros((len(X), 2, size))
            jacobian[:, :, seen.device * lens : (seen.device + 1) * lens] = by_lens(device, X)[:, :, :lens]
            if by_second is not None:
                jacobian[:, :, between:boards] = by_point @ by_second
            first = boards + POSE * seen.view
            jacobian[:, :, first : first + POSE] = by_point @ by_board
            values.append((pixels - seen.pixels).ravel() / seen.noise_px)
            jacobians.append(jacobian.reshape(-1, size) / seen.noise_px)
        return np.concatenate(values), np.concatenate(jacobians)

    def step(bundle: Bundle, delta: Array) -> Bundle:
        devices = tuple(moved_lens(device, delta[d * lens : (d + 1) * lens]) for d, device in enumerate(bundle.devices))
        second = bundle.T_second_first
        if n_devices == 2:
            second = moved_pose(second, delta[between:boards])
        views = delta[boards:].reshape(-1, POSE)
        return Bundle(devices, second, moved_pose(bundle.T_first_board, views))

    return minimise(residuals, step, start)


def reweighted(start: Bundle, observations: Sequence[Observation], coefficients: int) -> Bundle:
    """The bundle from repeated adjustments that weigh each view of each device by the scatter of its own residuals.

    In plain least squares, one view that contradicts the others spreads its errors over all views. Here the errors stay
    with this view, so a caller can find it.
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
