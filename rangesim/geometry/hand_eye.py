# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration: the pose of a camera on a robot's gripper, or beside the robot, from A X = X B.

The camera sees a target in n poses of the robot. If the camera is on the gripper (eye in hand), T_base_gripper X
T_camera_target = T_base_target is the same in all poses. If the camera stands beside the robot and the target is on the
gripper (eye to hand), T_gripper_base X T_camera_target = T_gripper_target is the same. Between two poses this gives
A X = X B. The start is that of Park, Martin: "Robot sensor calibration: solving AX = XB on the Euclidean group", 1994;
then all residuals are minimised together. The Python interface of OpenCV 4 has `calibrateHandEye`, but that of OpenCV 5
does not, so the method is written here.

Used by: no other module of rangesim; it is for users alone.
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
"""Largest rotation, in radians, of the motions that the start uses. Near 180 degrees, noise flips the direction of the
axis. The value leaves 10 degrees for the noise; a smaller one would waste motions."""

MIN_TURN_RAD = 1e-6
"""Root-mean-square rotation about an axis, in radians, up to which the robot did not turn about it at all. It is far
above rounding, 1e-16, and far below the repeatability of any robot, so that only poses without noise are judged by
it."""

MIN_TURN_OVER_NOISE = 5.0
"""Smallest ratio of the rotation about the second axis to the noise of the rotation vectors; with a smaller one, poses
are refused. Noise alone hardly reaches five standard deviations; with a smaller limit, the position along the axis
would be guessed from noise."""

DERIVATIVE_STEP = 1e-6
"""Step of the numerical derivatives, in radians or metres. Chosen so that, with central differences of numbers about 1,
rounding leaves a relative error of only 1e-10 and the third derivative one of 1e-12."""

MIN_NOISE = 1e-12
"""Least noise, in radians or metres, that residuals are weighted by, so that exact poses do not divide by 0."""

REWEIGHTINGS = 3
"""Number of times that the residuals are minimised; before each time but the first, rotations and translations are
weighted anew by their own noise. More times change little, because the noise hardly depends on the weights."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """The result of a hand-eye calibration.

    Attributes
    ----------
    T_mount_camera : (4, 4) float64, maps camera coordinates to the coordinates of the mount, metres. The mount is the
        gripper for `eye_in_hand` and the robot's base for `eye_to_hand`.
    T_other_target : (4, 4) float64, maps target coordinates to those of the part that is not the mount: the robot's
        base for `eye_in_hand` and the gripper for `eye_to_hand`, metres.
    rotation_rms_rad, translation_rms_m : root mean square, per axis, of the differences between the n poses of the
        target, which should all be equal.
    covariance : (12, 12) float64, covariance of (rotation vector applied after R, rad; translation, metres) of
        T_mount_camera and then of T_other_target.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> gripper = np.tile(np.eye(4), (4, 1, 1))
    >>> gripper[:, :3, :3] = Rotation.from_rotvec([[0, 0, 0], [0.6, 0, 0], [0, 0.6, 0], [0, 0, 0.6]]).as_matrix()
    >>> found = eye_in_hand(gripper, np.linalg.inv(gripper))  # a camera in the gripper, the target in the robot's base
    >>> bool(found.translation_rms_m < 1e-9), found.covariance.shape
    (True, (12, 12))
    """

    T_mount_camera: Array
    T_other_target: Array
    rotation_rms_rad: float
    translation_rms_m: float
    covariance: Array


def eye_in_hand(T_base_gripper: ArrayLike, T_camera_target: ArrayLike) -> HandEye:
    """T_gripper_camera of a camera on the gripper that sees a fixed target, and T_base_target.

    It minimises the differences of T_base_gripper X T_camera_target from one T_base_target. Rotations and translations
    are each weighted by their own noise, which is estimated too.

    Parameters
    ----------
    T_base_gripper : (n, 4, 4), n >= 3, poses of the gripper as the robot reports them; they map gripper coordinates to
        base coordinates, metres.
    T_camera_target : (n, 4, 4), poses of the target as the camera sees them (see `fit_camera_pose`); they map target
        coordinates to camera coordinates, metres.

    Raises
    ------
    ValueError
        There are fewer than three poses, a matrix is not rigid, or all turns have parallel axes. The position of the
        camera along that axis is then open: turn the gripper about two axes, by 30 degrees or more.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from rangesim.rig import translation
    >>> gripper = np.tile(np.eye(4), (4, 1, 1))  # poses of the robot's gripper
    >>> gripper[:, :3, :3] = Rotation.from_rotvec([[0, 0, 0], [0.6, 0, 0], [0, 0.6, 0], [0, 0, 0.6]]).as_matrix()
    >>> true, target = translation(0, 0.05, 0.1), translation(0.5, 0, 1)
    >>> seen = np.linalg.inv(gripper @ true) @ target
    >>> eye_in_hand(gripper, seen).T_mount_camera[:3, 3].round(6) + 0.0
    array([0.  , 0.05, 0.1 ])
    """
    hand, seen = _poses("T_base_gripper", T_base_gripper), _poses("T_camera_target", T_camera_target)
    return _solved(hand, seen)


def eye_to_hand(T_base_gripper: ArrayLike, T_camera_target: ArrayLike) -> HandEye:
    """T_base_camera of a fixed camera beside the robot that sees a target on the gripper, and T_gripper_target.

    Parameters and errors are those of `eye_in_hand`.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from rangesim.rig import translation
    >>> gripper = np.tile(np.eye(4), (4, 1, 1))
    >>> gripper[:, :3, :3] = Rotation.from_rotvec([[0, 0, 0], [0.6, 0, 0], [0, 0.6, 0], [0, 0, 0.6]]).as_matrix()
    >>> true, target = translation(1, 0.5, 2), translation(0, 0, 0.1)
    >>> seen = np.linalg.inv(true) @ gripper @ target
    >>> eye_to_hand(gripper, seen).T_mount_camera[:3, 3].round(6) + 0.0
    array([1. , 0.5, 2. ])
    """
    hand, seen = _poses("T_base_gripper", T_base_gripper), _poses("T_camera_target", T_camera_target)
    return _solved(np.linalg.inv(hand), seen)


def _poses(name: str, values: ArrayLike) -> Array:
    """(n, 4, 4) float64 rigid poses; ValueError if there are fewer than three or one is not rigid."""
    matrices = np.asarray(values, dtype=np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or len(matrices) < 3:
        raise ValueError(f"expected {name} of shape (n, 4, 4) with at least three poses, got {matrices.shape}.")
    return np.stack([pose(T, f"{name}[{k}]") for k, T in enumerate(matrices)])


def _solved(hand: Array, seen: Array) -> HandEye:
    """The calibration from X and Z with hand_i X seen_i = Z for all poses hand, seen (n, 4, 4)."""
    if len(hand) != len(seen):
        raise ValueError(f"expected as many poses of the robot as of the target, got {len(hand)} and {len(seen)}.")
    X = _start(hand, seen)
    Z = _mean(hand @ X @ seen)
    weights = np.ones(2)
    for _ in range(REWEIGHTINGS):
        scale = np.repeat(weights, 3)

        def residuals(state: tuple[Array, Array], scale: Array = scale) -> tuple[Array, Array]:
            values = (_differences(*state, hand, seen) * scale).ravel()
            columns = []
            for axis in DERIVATIVE_STEP * np.eye(12):
                up, down = (_differences(*_moved(state, s * axis), hand, seen) for s in (1, -1))
                columns.append(((up - down) * scale).ravel() / (2 * DERIVATIVE_STEP))
            return values, np.stack(columns, axis=-1)

        found = minimise(residuals, _moved, (X, Z))
        X, Z = found.state
        off = _differences(X, Z, hand, seen)
        freedom = 3 * len(hand) - 6
        noise = np.sqrt((off.reshape(-1, 2, 3) ** 2).sum(axis=(0, 2)) / freedom)
        weights = 1 / np.maximum(noise, MIN_NOISE)
    rms = np.sqrt((off.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2)))
    return HandEye(X, Z, float(rms[0]), float(rms[1]), found.covariance(1.0))


def _start(hand: Array, seen: Array) -> Array:
    """X (4, 4) of A X = X B over all pairs of poses, by the method of Park and Martin.

    The rotation of X takes the rotation axes of B to those of A. The translation is then linear.
    """
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
    if not axes[1] > MIN_TURN_OVER_NOISE * noise:
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
    "expected robot poses that turn about two different axes, got {what}: the camera's position along the axis is not "
    "determined; turn the gripper by 30 degrees or more about a second axis."
)


def _mean(T: Array) -> Array:
    """(4, 4) mean of poses (n, 4, 4): the mean rotation and the mean translation."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    result[:3, 3] = T[:, :3, 3].mean(axis=0)
    return result


def _differences(X: Array, Z: Array, hand: Array, seen: Array) -> Array:
    """(n, 6) rotation vector, rad, and translation, metres, of Z^-1 hand X seen; all 0 where the poses agree."""
    off = np.linalg.inv(Z) @ hand @ X @ seen
    return np.hstack([Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]])


def _moved(state: tuple[Array, Array], delta: Array) -> tuple[Array, Array]:
    """X and Z moved by a step (12,), each by a rotation vector applied after its rotation and a translation."""
    result = []
    for T, d in zip(state, (delta[:6], delta[6:]), strict=True):
        moved = T.copy()
        moved[:3, :3] = Rotation.from_rotvec(d[:3]).as_matrix() @ T[:3, :3]
        moved[:3, 3] = T[:3, 3] + d[3:]
        result.append(moved)
    return result[0], result[1]
