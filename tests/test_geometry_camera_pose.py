# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera from known points: OpenCV, the Cramer-Rao bound, planes with two poses, invalid input."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_scenes import cramer_rao, efficiency, rigid
from scipy.spatial.transform import Rotation

from rangesim.geometry import calibration_matrix, find_camera_pose, fit_camera_pose
from rangesim.rig import Intrinsics

CAMERA = Intrinsics(640, 480, 800, 805, 321, 242, (-0.2, 0.05, 1e-3, -1e-3))
TRUE = rigid((0.3, -0.4, 0.2), (0.1, 0.05, 2.5))
NOISE = 0.3


def target(random: np.random.Generator, n: int, plane: bool = False, size: float = 1.0) -> np.ndarray:
    X = random.uniform(-0.5, 0.5, (n, 3)) * size
    if plane:
        X[:, 2] = 0
    return X


def seen(X: np.ndarray, T: np.ndarray = TRUE) -> np.ndarray:
    return CAMERA.project(X @ T[:3, :3].T + T[:3, 3])


def difference(T: np.ndarray, other: np.ndarray = TRUE) -> np.ndarray:
    """(6,) rotation vector, rad, and translation, metres, between two poses."""
    return np.concatenate([Rotation.from_matrix(T[:3, :3] @ other[:3, :3].T).as_rotvec(), T[:3, 3] - other[:3, 3]])


@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize("n", [4, 6, 30])
def test_exact_pixels_give_the_pose_through_a_distorted_lens(n: int, plane: bool) -> None:
    random = np.random.default_rng(0)
    for _ in range(3):
        X = target(random, n, plane)
        found = fit_camera_pose(X, seen(X), CAMERA, noise_px=1e-6)
        assert np.abs(difference(found.T_camera_object)).max() < 1e-4


@pytest.mark.parametrize("metres", [30.0, 1000.0, 5e5])
@pytest.mark.parametrize(("n", "plane"), [(6, False), (30, False), (12, True)])
@pytest.mark.parametrize("fit", [fit_camera_pose, find_camera_pose])
def test_the_pose_is_the_same_far_from_the_origin(fit, metres: float, n: int, plane: bool) -> None:  # type: ignore[no-untyped-def]
    """Points at an offset give the pose at the origin, moved by the offset, with the covariance moved too."""
    random = np.random.default_rng(n)
    X = target(random, n, plane)
    x = seen(X) + random.normal(0, 0.1, (n, 2))
    offset = metres * np.array([1.0, -0.7, 0.1])
    near, far = fit(X, x, CAMERA, noise_px=0.1), fit(X + offset, x, CAMERA, noise_px=0.1)
    moved = far.T_camera_object.copy()
    moved[:3, 3] += moved[:3, :3] @ offset
    np.testing.assert_allclose(moved[:3, :3], near.T_camera_object[:3, :3], atol=1e-8)
    np.testing.assert_allclose(moved[:3, 3], near.T_camera_object[:3, 3], atol=1e-8 + 1e-15 * metres)
    np.testing.assert_array_equal(far.inliers, near.inliers)
    np.testing.assert_allclose(far.covariance[:3, :3], near.covariance[:3, :3], rtol=1e-5, atol=1e-14)
    # that of the translation: by t = t_near - R offset, of draws of the pose at the origin
    draws = random.multivariate_normal(np.zeros(6), near.covariance, 20000)
    R = near.T_camera_object[:3, :3]
    t = draws[:, 3:] - Rotation.from_rotvec(draws[:, :3]).apply(R @ offset)
    np.testing.assert_allclose(far.covariance[3:, 3:], np.cov(t.T), atol=0.04 * np.trace(np.cov(t.T)))


def test_the_pose_agrees_with_opencv() -> None:
    random = np.random.default_rng(1)
    for _ in range(10):
        X = target(random, 15)
        x = seen(X) + random.normal(0, NOISE, (15, 2))
        _, vector, t = cv2.solvePnP(X, x, calibration_matrix(CAMERA), np.array(CAMERA.distortion))
        theirs = rigid(vector.ravel(), t.ravel())
        ours = fit_camera_pose(X, x, CAMERA).T_camera_object
        assert np.abs(difference(ours, theirs)).max() < 1e-4
        cost = [((seen(X, T) - x) ** 2).sum() for T in (ours, theirs)]
        assert cost[0] <= cost[1] * (1 + 1e-9)


@pytest.mark.validation
@pytest.mark.parametrize("plane", [False, True])
def test_the_pose_reaches_the_bound_and_states_its_covariance(plane: bool) -> None:
    random = np.random.default_rng(2)
    X = target(random, 20, plane)

    def predict(v: np.ndarray) -> np.ndarray:
        return seen(
            X,
            rigid((Rotation.from_rotvec(v[:3]) * Rotation.from_matrix(TRUE[:3, :3])).as_rotvec(), TRUE[:3, 3] + v[3:]),
        )

    bound = cramer_rao(predict, lambda v: v, np.zeros(6), NOISE)
    fits = [fit_camera_pose(X, seen(X) + random.normal(0, NOISE, (20, 2)), CAMERA) for _ in range(45)]
    errors = np.stack([difference(fit.T_camera_object) for fit in fits])
    assert 0.8 < efficiency(errors, bound, rank=6) < 1.2
    assert np.mean([fit.noise_px for fit in fits]) == pytest.approx(NOISE, rel=0.05)
    exact = fit_camera_pose(X, seen(X), CAMERA, noise_px=NOISE)
    np.testing.assert_allclose(exact.covariance, bound, atol=1e-4 * np.abs(bound).max())
    assert not any(fit.is_ambiguous for fit in fits)


@pytest.mark.validation
def test_a_small_plane_has_two_poses_and_both_are_reported() -> None:
    random = np.random.default_rng(3)
    reported = right = 0
    for _ in range(14):
        X = target(random, 12, plane=True, size=0.12)
        found = fit_camera_pose(X, seen(X) + random.normal(0, NOISE, (12, 2)), CAMERA, noise_px=NOISE)
        poses = [found.T_camera_object, *found.others]
        reported += found.is_ambiguous
        right += min(np.abs(difference(T)[:3]).max() for T in poses) < 0.2
    assert reported >= 11
    assert right >= 12  # one of them is the true one
    # a large one seen obliquely has one
    X = target(random, 12, plane=True)
    assert not fit_camera_pose(X, seen(X) + random.normal(0, NOISE, (12, 2)), CAMERA).is_ambiguous


def test_wrong_pairs_are_left_out() -> None:
    random = np.random.default_rng(4)
    X = target(random, 80)
    x = seen(X) + random.normal(0, NOISE, (80, 2))
    x[:40] = random.uniform(0, 480, (40, 2))
    found = find_camera_pose(X, x, CAMERA, NOISE)
    assert found.inliers[40:].mean() > 0.9
    assert not found.inliers[:40].any()
    assert np.abs(difference(found.T_camera_object)).max() < 0.02
    assert found.noise_px == pytest.approx(NOISE, rel=0.2)
    np.testing.assert_array_equal(found.T_camera_object, find_camera_pose(X, x, CAMERA, NOISE).T_camera_object)


X, RANDOM = target(np.random.default_rng(5), 12), np.random.default_rng(6)
LINE = np.linspace(-0.5, 0.5, 8)[:, None] * [1.0, 0.3, 0.2]
WIDE = Intrinsics(640, 480, 300, 300, 320, 240, (-0.9,))


def test_points_on_a_line_within_their_noise_are_refused() -> None:
    for _ in range(5):
        nearly = LINE + RANDOM.normal(0, 1e-4, LINE.shape)
        with pytest.raises(ValueError, match="do not determine its rotation"):
            fit_camera_pose(nearly, seen(LINE) + RANDOM.normal(0, NOISE, (8, 2)), CAMERA, noise_px=NOISE)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fit_camera_pose(X[:3], seen(X[:3]), CAMERA), "three leave up to four poses"),
        (lambda: fit_camera_pose(np.repeat(X[:3], 3, 0), np.repeat(seen(X[:3]), 3, 0), CAMERA), "3 different ones"),
        (lambda: fit_camera_pose(LINE, seen(LINE), CAMERA), "rotation about that line is not determined"),
        (lambda: fit_camera_pose(X, seen(X)[:5], CAMERA), "as many pixels"),
        (lambda: fit_camera_pose(X, np.full((12, 2), np.nan), CAMERA), "24 NaN"),
        (lambda: fit_camera_pose(X, seen(X), CAMERA, noise_px=0), "noise_px"),
        (lambda: fit_camera_pose(X, RANDOM.uniform(0, 600, (12, 2)), WIDE), "beyond its fold"),
        (lambda: find_camera_pose(X[:5], seen(X[:5]), CAMERA), "at least 6"),
        (lambda: find_camera_pose(target(RANDOM, 40), RANDOM.uniform(0, 480, (40, 2)), CAMERA, NOISE), "than chance"),
    ],
)
def test_invalid_input_is_refused(call, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        call()


def test_points_behind_the_camera_are_refused() -> None:
    """A projection without the test for points behind the camera mirrors their pixels, so that no pose fits."""
    T = rigid((0.3, -0.4, 0.2), (0.1, 0.05, -2.5))
    Y = X @ T[:3, :3].T + T[:3, 3]
    pixels = Y[:, :2] / Y[:, 2:] * 800 + [320, 240]
    plain = Intrinsics(640, 480, 800, 800, 320, 240)
    with pytest.raises(ValueError, match=r"within their noise of 0.3 px, got residuals"):
        fit_camera_pose(X, pixels, plain, noise_px=NOISE)
    with pytest.raises(ValueError, match="chance"):
        find_camera_pose(X, pixels, plain, NOISE)
