# SPDX-License-Identifier: Apache-2.0
"""Camera matrices: composition, both decompositions, projection and back-projection, compared with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_scenes import rigid
from scipy.spatial.transform import Rotation

from rangesim.geometry import (
    back_project,
    calibration_matrix,
    centre,
    decompose,
    decompose_zero_skew,
    depth,
    ideal_pixels,
    lens_pixels,
    project,
    projection_matrix,
    rays,
)
from rangesim.rig import Intrinsics

CAMERA = Intrinsics(640, 480, 800, 790, 322, 236, (-0.2, 0.05, 1e-3, -2e-3))


def random_camera(random: np.random.Generator, skew: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A random K, a random pose and their P, with a random scale and sign."""
    K = np.array([[random.uniform(300, 2000), skew, 320], [0, random.uniform(300, 2000), 240], [0, 0, 1]])
    T = rigid(Rotation.random(rng=random).as_rotvec(), random.normal(0, 2, 3))
    return K, T, random.normal() * 3 * projection_matrix(K, T)


@pytest.mark.parametrize("skew", [0.0, 12.0])
def test_decomposition_gives_back_the_parts(skew: float) -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        K, T, P = random_camera(random, skew)
        for take_apart in (decompose,) if skew else (decompose, decompose_zero_skew):
            parts = take_apart(P)
            np.testing.assert_allclose(parts.K, K, atol=1e-8)
            np.testing.assert_allclose(parts.T_camera_world, T, atol=1e-9)
            np.testing.assert_allclose(parts.centre, -T[:3, :3].T @ T[:3, 3], atol=1e-8)
            assert parts.skew == pytest.approx(skew, abs=1e-8)


def test_decomposition_agrees_with_opencv() -> None:
    random = np.random.default_rng(1)
    for _ in range(20):
        _, _, P = random_camera(random, 3.0)
        P *= np.sign(np.linalg.det(P[:, :3]))
        K, R, C, *_ = cv2.decomposeProjectionMatrix(P)
        parts = decompose(P)
        np.testing.assert_allclose(parts.K, K / K[2, 2], atol=1e-7)
        np.testing.assert_allclose(parts.T_camera_world[:3, :3], R, atol=1e-9)
        np.testing.assert_allclose(parts.centre, (C[:3] / C[3]).ravel(), atol=1e-7)


def test_zero_skew_is_the_closed_form_of_the_textbook() -> None:
    """K from A = P3 P3^T normalised to A33 = 1: x0 = A13, y0 = A23, fx = sqrt(A11 - x0^2), fy = sqrt(A22 - y0^2)."""
    K, T, P = random_camera(np.random.default_rng(2))
    A = P[:, :3] @ P[:, :3].T
    A /= A[2, 2]
    parts = decompose_zero_skew(P)
    found = parts.K[0, 2], parts.K[1, 2], parts.K[0, 0], parts.K[1, 1]
    np.testing.assert_allclose(
        found, (A[0, 2], A[1, 2], np.sqrt(A[0, 0] - A[0, 2] ** 2), np.sqrt(A[1, 1] - A[1, 2] ** 2))
    )
    np.testing.assert_allclose(
        projection_matrix(parts.K, parts.T_camera_world), projection_matrix(K, T), rtol=1e-7, atol=1e-7
    )


def test_the_pose_has_six_parameters() -> None:
    """P has eleven degrees of freedom: five of K and six of the pose."""

    def camera(v: np.ndarray) -> np.ndarray:
        P = projection_matrix([[v[0], v[1], v[2]], [0, v[3], v[4]], [0, 0, 1]], rigid(v[5:8], v[8:]))
        return np.asarray(P / np.linalg.norm(P)).ravel()

    at = np.array([2.0, 0.1, 0.3, 1.8, 0.2, 0.1, -0.2, 0.3, 0.5, 0.4, 3.0])
    columns = [(camera(at + h) - camera(at - h)) / 2e-6 for h in 1e-6 * np.eye(11)]
    assert np.linalg.matrix_rank(np.stack(columns), tol=1e-6) == 11
    assert np.linalg.matrix_rank(np.stack(columns[5:]), tol=1e-6) == 6


def test_projection_and_back_projection_undo_each_other() -> None:
    random = np.random.default_rng(3)
    for _ in range(20):
        _, _, P = random_camera(random)
        pixels, z = random.uniform(0, 640, (30, 2)), random.uniform(0.5, 5, 30)
        X = back_project(P, pixels, z)
        np.testing.assert_allclose(project(P, X), pixels, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(depth(P, X), z)
        C = centre(P)
        np.testing.assert_allclose(P @ C, 0, atol=1e-9)
        np.testing.assert_allclose(C[:3] / C[3] + rays(P, pixels) * z[:, None], X, atol=1e-8)


def test_batches_of_cameras() -> None:
    random = np.random.default_rng(4)
    P = np.stack([random_camera(random)[2] for _ in range(3)])
    pixels = random.uniform(0, 640, (3, 7, 2))
    X = back_project(P, pixels, np.full((3, 7), 2.0))
    np.testing.assert_allclose(project(P, X), pixels, rtol=1e-7)
    np.testing.assert_allclose(X[1], back_project(P[1], pixels[1], np.full(7, 2.0)))


def test_points_behind_the_camera_have_no_image() -> None:
    P = -2 * projection_matrix(CAMERA)
    X = np.array([(0.1, 0.2, 2.0), (0.1, 0.2, -2.0), (0.1, 0.2, 0.0)])
    np.testing.assert_allclose(depth(P, X), (2, -2, 0))
    assert np.isfinite(project(P, X)).all(axis=1).tolist() == [True, False, False]


def test_projection_agrees_with_the_rig_and_with_opencv() -> None:
    X = np.random.default_rng(5).uniform((-1, -1, 2), (1, 1, 5), (40, 3))
    T = rigid((0.1, 0.2, -0.1), (0.1, 0, 0.2))
    ideal = project(projection_matrix(CAMERA, T), X)
    shown = lens_pixels(CAMERA, ideal)
    np.testing.assert_allclose(shown, CAMERA.project(X @ T[:3, :3].T + T[:3, 3]), atol=1e-9)
    theirs, _ = cv2.projectPoints(
        X,
        Rotation.from_matrix(T[:3, :3]).as_rotvec(),
        T[:3, 3],
        calibration_matrix(CAMERA),
        np.array(CAMERA.distortion),
    )
    np.testing.assert_allclose(shown, theirs[:, 0], atol=1e-9)
    np.testing.assert_allclose(ideal_pixels(CAMERA, shown), ideal, atol=1e-6)


def test_parts_become_intrinsics_unless_skewed() -> None:
    assert decompose(projection_matrix(CAMERA)).intrinsics(640, 480).fx == pytest.approx(800)
    _, _, P = random_camera(np.random.default_rng(6), skew=5.0)
    with pytest.raises(ValueError, match="zero skew"):
        decompose(P).intrinsics(640, 480)
    with pytest.raises(ValueError, match=r"zero skew.*use decompose"):
        decompose_zero_skew(P)


AFFINE = np.array([[1.0, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: decompose(AFFINE), "centre lies at infinity"),
        (lambda: decompose_zero_skew(AFFINE), "centre lies at infinity"),
        (lambda: rays(AFFINE, [(1, 2)]), "centre lies at infinity"),
        (lambda: centre(np.zeros((3, 4))), "rank 3"),
        (lambda: decompose(np.eye(3)), r"shape \(\.\.\., 3, 4\)"),
        (lambda: decompose(np.full((3, 4), np.inf)), "12 NaN or infinite"),
        (lambda: projection_matrix(CAMERA, np.diag([2, 1, 1, 1])), "rigid"),
    ],
)
def test_invalid_cameras_are_refused(call, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        call()
    # an affine camera has a centre, at infinity
    assert centre(AFFINE)[3] == 0
