# SPDX-License-Identifier: Apache-2.0
"""Triangulation of two views: the global minimum compared with OpenCV's polynomial, and the Cramer-Rao bound."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_scenes import FIRST, SECOND, T_SECOND_FIRST, K, cramer_rao, efficiency, points, rigid

from rangesim.geometry import (
    correct_pixels,
    fundamental_from_cameras,
    point_covariance,
    project,
    projection_matrix,
    sampson_distance,
    triangulate_linear,
    triangulate_midpoint,
    triangulate_optimal,
)

FORWARD = projection_matrix(K, rigid((0, 0, 0), (0.02, 0.01, -0.5)))
ASIDE = projection_matrix(K, rigid((0, -0.1, 0), (0.5, 0, 0)))
METHODS = {"linear": triangulate_linear, "midpoint": triangulate_midpoint, "optimal": triangulate_optimal}


def noisy_pixels(other: np.ndarray, n: int, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    X = points(random, n)
    a, b = project(FIRST, X), project(other, X)
    return X, a + random.normal(0, noise, a.shape), b + random.normal(0, noise, b.shape)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1.0, -3.0])
def test_exact_pixels_give_the_point(method: str, scale: float) -> None:
    """This holds for any scale and sign of the camera matrices."""
    X, a, b = noisy_pixels(SECOND, 200, 0.0)
    found = METHODS[method](FIRST, scale * SECOND, a, b)
    np.testing.assert_allclose(found.points, X, atol=1e-8)
    np.testing.assert_allclose(found.error_px, 0, atol=1e-8)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("other", [SECOND, ASIDE, FORWARD], ids=["second", "aside", "forward"])
@pytest.mark.parametrize("metres", [30.0, 1000.0, 5e5])
def test_far_from_the_origin_the_points_are_the_same(method: str, other: np.ndarray, metres: float) -> None:
    """Cameras at an offset give the points at the origin, moved by the offset, with the same errors."""
    _, a, b = noisy_pixels(other, 200, 0.3)
    offset = metres * np.array([1.0, -0.7, 0.1])
    moved = [np.hstack([P[:, :3], (P[:, 3] - P[:, :3] @ offset)[:, None]]) for P in (FIRST, other)]
    near, far = METHODS[method](FIRST, other, a, b), METHODS[method](*moved, a, b)
    firm = ~(np.linalg.norm(near.points, axis=1) > 50)  # points almost at infinity are not determined
    assert firm.mean() > 0.8
    np.testing.assert_allclose((far.points - offset)[firm], near.points[firm], atol=1e-8 + 1e-11 * metres)
    np.testing.assert_allclose(far.error_px[firm], near.error_px[firm], atol=1e-7 + 1e-11 * metres)
    turned = projection_matrix(K, rigid((0.1, 0.2, 0.3), (0, 0, 0)))
    together = np.hstack([turned[:, :3], -(turned[:, :3] @ offset)[:, None]])
    with pytest.raises(ValueError, match="same centre"):
        METHODS[method](moved[0], together, a, b)


@pytest.mark.parametrize("other", [SECOND, ASIDE, FORWARD], ids=["second", "aside", "forward"])
@pytest.mark.parametrize("noise", [0.1, 2.0, 30.0])
def test_optimal_is_the_global_minimum_and_never_worse_than_the_others(other: np.ndarray, noise: float) -> None:
    _, a, b = noisy_pixels(other, 4000, noise)
    F = fundamental_from_cameras(FIRST, other)
    corrected = correct_pixels(F, a, b)
    assert np.abs(sampson_distance(F, *corrected)).max() < 1e-8  # they satisfy the constraint
    cost = ((corrected.first - a) ** 2 + (corrected.second - b) ** 2).sum(-1)
    u, v = cv2.correctMatches(F, a[None], b[None])  # Hartley and Sturm's polynomial
    exact = ((u[0] - a) ** 2 + (v[0] - b) ** 2).sum(-1)
    fails = ~np.isfinite(exact)
    assert fails.mean() < 0.01
    assert (cost[~fails] <= exact[~fails] * (1 + 1e-6) + 1e-9).all()
    assert (cost >= sampson_distance(F, a, b) ** 2 * 0.2).all()
    optimal = triangulate_optimal(FIRST, other, a, b)
    np.testing.assert_allclose(optimal.error_px, np.sqrt(cost), rtol=1e-9, atol=1e-12)
    for method in (triangulate_linear, triangulate_midpoint):
        theirs = method(FIRST, other, a, b).error_px
        known = np.isfinite(theirs)
        assert known.mean() > 0.6
        assert (optimal.error_px[known] <= theirs[known] + 1e-6).all()
    # and the points reproject to the corrected pixels
    sound = np.isfinite(optimal.points).all(axis=-1)
    for P, pixels in ((FIRST, corrected.first), (other, corrected.second)):
        np.testing.assert_allclose(project(P, optimal.points[sound]), pixels[sound], atol=1e-5)


@pytest.mark.parametrize("seed", [4, 12, 19, 43, 50, 51])
def test_points_near_an_epipole_get_the_best_of_several_minima(seed: int) -> None:
    """With epipoles within the images and a random map of the lines through them, no line of many gives less."""
    random = np.random.default_rng(seed)
    e, e_ = random.uniform(0, 600, (2, 2))
    A = random.normal(size=(2, 2)) * 10 ** random.uniform(-1, 1, (2, 1))
    from_e, from_e_ = (np.hstack([np.eye(2), -pole[:, None]]) for pole in (e, e_))
    size = 10 ** random.uniform(-1, 2)
    a, b = e + random.normal(0, size, (1000, 2)), e_ + random.normal(0, size * 10 ** random.uniform(-1, 1), (1000, 2))
    corrected = correct_pixels(from_e_.T @ A @ from_e, a, b)
    cost = ((corrected.first - a) ** 2 + (corrected.second - b) ** 2).sum(-1)
    angles = np.linspace(0, np.pi, 3001)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    normal = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    other = along @ A.T  # normals of the lines in the second view
    other /= np.linalg.norm(other, axis=-1, keepdims=True)
    least = (((a - e) @ normal.T) ** 2 + ((b - e_) @ other.T) ** 2).min(axis=1)
    assert (cost <= least * (1 + 1e-6) + 1e-9 * size**2).all()


def test_optimal_reaches_the_bound_and_midpoint_does_not_beat_it() -> None:
    X, noise, trials = np.array([[0.4, -0.5, 3.5]]), 0.5, 4000
    random = np.random.default_rng(2)
    a, b = (np.repeat(project(P, X), trials, axis=0) + random.normal(0, noise, (trials, 2)) for P in (FIRST, FORWARD))

    def predict(v: np.ndarray) -> np.ndarray:
        return np.concatenate([project(P, v[None]).ravel() for P in (FIRST, FORWARD)])

    bound = cramer_rao(predict, lambda v: v, X[0], noise)
    ours = point_covariance(FIRST, FORWARD, X, noise, noise)[0]
    np.testing.assert_allclose(ours, bound, rtol=1e-4)
    reached = {name: efficiency(m(FIRST, FORWARD, a, b).points - X, bound, rank=3) for name, m in METHODS.items()}
    assert 0.8 < reached["optimal"] < 1.2
    assert reached["optimal"] <= min(reached.values()) + 0.01


def test_covariance_takes_noise_in_every_form() -> None:
    X = points(np.random.default_rng(3), 5)
    plain = point_covariance(FIRST, SECOND, X, 0.5, 0.25)
    full = point_covariance(FIRST, SECOND, X, 0.25 * np.eye(2), np.full(5, 0.25))
    np.testing.assert_allclose(plain, full)
    np.testing.assert_allclose(point_covariance(FIRST, -SECOND, X, 1.0, 0.5), 4 * plain)
    behind = point_covariance(FIRST, SECOND, [(0, 0, -1.0), (np.nan, 0, 1)])
    assert np.isnan(behind).all()


def test_the_error_of_depth_is_that_of_the_formula() -> None:
    """Parallel cameras: sigma_z = z^2 sigma_d / (f b) with sigma_d = sqrt(2) sigma."""
    first, second = (
        projection_matrix(np.diag([800, 800, 1])),
        projection_matrix(np.diag([800, 800, 1]), rigid((0, 0, 0), (-0.2, 0, 0))),
    )
    for z in (1.0, 4.0):
        C = point_covariance(first, second, [(0.1, 0, z)], 0.1, 0.1)[0]
        assert np.sqrt(C[2, 2]) == pytest.approx(z**2 * np.sqrt(2) * 0.1 / (800 * 0.2), rel=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_rays_that_do_not_meet_in_front_give_nan(method: str) -> None:
    parallel = projection_matrix(K, rigid((0, 0, 0), (-0.2, 0, 0)))
    pixel, shift = np.array([(320.0, 240.0)] * 3), np.array([(10.0, 0), (0, 0), (-10, 0)])
    found = METHODS[method](FIRST, parallel, pixel, pixel - shift)
    assert found.points[0, 2] == pytest.approx(800 * 0.2 / 10)
    assert np.isnan(found.points[1:]).all()  # parallel; they diverge, and meet behind


def test_two_million_points_a_second() -> None:
    """One core does 5 million; the limit only guards against a return to loops in Python."""
    import time

    _, a, b = noisy_pixels(SECOND, 200_000, 1.0)
    triangulate_optimal(FIRST, SECOND, a[:10], b[:10])
    start = time.process_time()
    triangulate_optimal(FIRST, SECOND, a, b)
    assert len(a) / (time.process_time() - start) > 5e5


@pytest.mark.parametrize("method", METHODS)
def test_invalid_input_is_refused(method: str) -> None:
    pixel = np.array([(320.0, 240.0)])
    turned = projection_matrix(K, rigid((0, 0.1, 0), (0, 0, 0)))
    for arguments, message in (
        ((FIRST, turned, pixel, pixel), "same centre"),
        ((FIRST, SECOND, pixel, np.repeat(pixel, 2, 0)), "corresponding points"),
        ((FIRST, SECOND, pixel, [(np.nan, 0)]), "1 NaN"),
        ((FIRST, K, pixel, pixel), r"P_second of shape \(\.\.\., 3, 4\)"),
        ((FIRST[None], SECOND, pixel, pixel), r"shape \(3, 4\)"),
    ):
        with pytest.raises(ValueError, match=message):
            METHODS[method](*arguments)
    for noise in (0.0, -np.eye(2), np.ones((3, 3))):
        with pytest.raises(ValueError, match="noise_first_px"):
            point_covariance(FIRST, SECOND, [(0, 0, 3.0)], noise)
    with pytest.raises(ValueError, match="rank 2"):
        correct_pixels(np.eye(3), pixel, pixel)
    assert T_SECOND_FIRST.shape == (4, 4)
