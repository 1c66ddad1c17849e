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

    The step's parameters, in the order of the covariance: those of the lens of each device less the fixed ones,
    then `POSE` of T_second_first if there are two devices, then `POSE` of each board.
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
