# SPDX-License-Identifier: Apache-2.0
"""Where a camera sits on a robot's hand, or beside the robot, from poses of both: A X = X B.

The camera sees a target from n poses of the robot. On the hand, T_base_gripper X T_camera_target = T_base_target is
the same for all; beside it, the target on the hand, T_gripper_base X T_camera_target = T_gripper_target is. Between
two poses that is A X = X B. Park, Martin: "Robot sensor calibration: solving AX = XB on the Euclidean group", 1994,
for the start; then all residuals at once. (OpenCV 4 has `calibrateHandEye`, the Python of OpenCV 5 no longer.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rangesim.geometry.correspondences import Array
from rangesim.geometry.least_squares import minimise
from rangesim.rig import pose

MAX_TURN_RAD = np.radians(170)
"""Of the motions that are used for the start: near 180 degrees the sense of an axis is open."""
MIN_TURN_RAD = 1e-6
ABOVE_NOISE = 5.0
"""Times the noise of the rotation vectors that turns about a second axis must have."""
DIFFERENCE = 1e-6
"""Step of numerical derivatives, radians or metres."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """What a hand-eye calibration finds.

    T_mount_camera : (4, 4), maps camera coordinates to those of what the camera is mounted on: the gripper
    (`eye_in_hand`) or the robot's base (`eye_to_hand`). T_other_target : (4, 4), maps target coordinates to the other
    of the two. rotation_rms_rad, translation_rms_m : of the poses of the target, which should all be one, per axis.
    covariance : (12, 12) of (rotation vector applied after R, rad; translation, metres) of T_mount_camera, then of
    T_other_target.
    """

    T_mount_camera: Array
    T_other_target: Array
    rotation_rms_rad: float
    translation_rms_m: float
    covariance: Array


def eye_in_hand(T_base_gripper: ArrayLike, T_camera_target: ArrayLike) -> HandEye:
    """T_gripper_camera of a camera on the robot's hand that sees a target which stands still; and T_base_target.

    Minimises the differences of T_base_gripper X T_camera_target from one T_base_target, rotation and translation
    each weighted by its own noise, which is found along with them.

    Parameters
    ----------
    T_base_gripper : (n, 4, 4), n >= 3, where the robot says its hand is. T_camera_target : (n, 4, 4), where the
        camera sees the target, as `camera_pose` finds it.

    Raises
    ------
    ValueError
        Fewer than three poses, matrices that are not rigid, or turns about one axis only (all axes parallel), for
        which the place along that axis is open: turn the hand about two axes, by 30 degrees or more.
    """
    hand, seen = _poses("T_base_gripper", T_base_gripper), _poses("T_camera_target", T_camera_target)
    return _solved(hand, seen)


def eye_to_hand(T_base_gripper: ArrayLike, T_camera_target: ArrayLike) -> HandEye:
    """T_base_camera of a camera beside the robot that sees a target on its hand; and T_gripper_target.

    Parameters and errors are those of `eye_in_hand`.
    """
    hand, seen = _poses("T_base_gripper", T_base_gripper), _poses("T_camera_target", T_camera_target)
    return _solved(np.linalg.inv(hand), seen)


def _poses(name: str, values: ArrayLike) -> Array:
    matrices = np.asarray(values, dtype=np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or len(matrices) < 3:
        raise ValueError(f"expected {name} of shape (n, 4, 4) with at least three poses, got {matrices.shape}.")
    return np.stack([pose(T, f"{name}[{k}]") for k, T in enumerate(matrices)])


def _solved(hand: Array, seen: Array) -> HandEye:
    """X and Z of hand_i X seen_i = Z."""
    if len(hand) != len(seen):
        raise ValueError(f"expected as many poses of the robot as of the target, got {len(hand)} and {len(seen)}.")
    X = _start(hand, seen)
    Z = _mean(hand @ X @ seen)
    weights = np.ones(2)
    for _ in range(3):
        scale = np.repeat(weights, 3)

        def residuals(state: tuple[Array, Array], scale: Array = scale) -> tuple[Array, Array]:
            values = (_differences(*state, hand, seen) * scale).ravel()
            columns = []
            for axis in DIFFERENCE * np.eye(12):
                up, down = (_differences(*_moved(state, s * axis), hand, seen) for s in (1, -1))
                columns.append(((up - down) * scale).ravel() / (2 * DIFFERENCE))
            return values, np.stack(columns, axis=-1)

        found = minimise(residuals, _moved, (X, Z))
        X, Z = found.state
        off = _differences(X, Z, hand, seen)
        freedom = 3 * len(hand) - 6
        noise = np.sqrt((off.reshape(-1, 2, 3) ** 2).sum(axis=(0, 2)) / freedom)
        weights = 1 / np.maximum(noise, 1e-12)
    rms = np.sqrt((off.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2)))
    return HandEye(X, Z, float(rms[0]), float(rms[1]), found.covariance(1.0))


def _start(hand: Array, seen: Array) -> Array:
    """X of A X = X B for all pairs of poses: the rotation that takes B's axes to A's, then the translation, linear."""
    i, j = np.triu_indices(len(hand), 1)
    A, B = np.linalg.inv(hand[j]) @ hand[i], seen[j] @ np.linalg.inv(seen[i])
    a, b = (Rotation.from_matrix(M[:, :3, :3]).as_rotvec() for M in (A, B))
    turns = np.linalg.norm(a, axis=-1)
    use = (turns < MAX_TURN_RAD) & (np.linalg.norm(b, axis=-1) < MAX_TURN_RAD)
    axes = np.linalg.svd(a[use], compute_uv=False) / np.sqrt(max(use.sum(), 1)) if use.sum() > 1 else np.zeros(3)
    if not axes[0] > MIN_TURN_RAD:
        raise ValueError(_PARALLEL.format(what="no turns at all, or none but half turns"))
    if not axes[1] > MIN_TURN_RAD:
        raise ValueError(_PARALLEL.format(what="turns about one axis, all parallel"))
    R, distance = Rotation.align_vectors(a[use], b[use])
    noise = distance / np.sqrt(3 * use.sum())
    if not axes[1] > ABOVE_NOISE * noise:
        second, off = np.degrees(axes[1]), np.degrees(noise)
        what = f"turns of {second:.2g} degrees about a second axis, with a noise of {off:.2g} degrees"
        raise ValueError(_PARALLEL.format(what=what))
    X = np.eye(4)
    X[:3, :3] = R.as_matrix()
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ X[:3, :3].T - A[:, :3, 3]).ravel()
    X[:3, 3] = np.linalg.lstsq(left, right, rcond=None)[0]
    return X


_PARALLEL = (
    "expected robot poses that turn about two different axes, got {what}: the camera's place along the axis is open; "
    "turn the hand by 30 degrees or more about a second axis."
)


def _mean(T: Array) -> Array:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    result[:3, 3] = T[:, :3, 3].mean(axis=0)
    return result


def _differences(X: Array, Z: Array, hand: Array, seen: Array) -> Array:
    """(n, 6) rotation vector and translation of Z^-1 hand X seen."""
    off = np.linalg.inv(Z) @ hand @ X @ seen
    return np.hstack([Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]])


def _moved(state: tuple[Array, Array], delta: Array) -> tuple[Array, Array]:
    result = []
    for T, d in zip(state, (delta[:6], delta[6:]), strict=True):
        moved = T.copy()
        moved[:3, :3] = Rotation.from_rotvec(d[:3]).as_matrix() @ T[:3, :3]
        moved[:3, 3] = T[:3, 3] + d[3:]
        result.append(moved)
    return result[0], result[1]
