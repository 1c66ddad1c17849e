# SPDX-License-Identifier: Apache-2.0
"""Two views: laws of F and E, estimates compared with OpenCV, scikit-image and the bound, degenerate views."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from geometry_scenes import FIRST, SECOND, T_SECOND_FIRST, K, alike, cramer_rao, efficiency, points, rigid
from scipy.spatial.transform import Rotation
from skimage.transform import FundamentalMatrixTransform
from tiers import to_validate

from rangesim.geometry import (
    eight_point,
    epipoles,
    essential_from_pose,
    find_fundamental,
    find_relative_pose,
    fit_fundamental,
    fit_relative_pose,
    fundamental_from_cameras,
    fundamental_from_pose,
    homogeneous,
    in_front,
    lines_in_first,
    lines_in_second,
    poses_from_essential,
    project,
    projection_matrix,
    sampson_distance,
    seven_point,
)

F = fundamental_from_cameras(FIRST, SECOND)
NOISE = 0.3


def views(
    random: np.random.Generator, n: int, noise: float = 0.0, plane: bool = False, T: np.ndarray = T_SECOND_FIRST
) -> tuple[np.ndarray, np.ndarray]:
    X = points(random, n, plane)
    a, b = project(FIRST, X), project(projection_matrix(K, T), X)
    return a + random.normal(0, 1, a.shape) * noise, b + random.normal(0, 1, b.shape) * noise


# ------------------------------------------------------------------------------------- laws


def test_f_has_rank_two_and_its_lines_and_epipoles_hold() -> None:
    a, b = views(np.random.default_rng(0), 30)
    x, y = homogeneous(a), homogeneous(b)
    assert np.linalg.svd(F, compute_uv=False)[2] < 1e-15
    np.testing.assert_allclose((y * (x @ F.T)).sum(-1), 0, atol=1e-12)  # x'^T F x = 0
    assert np.abs((lines_in_second(F, a) * y).sum(-1)).max() < 1e-9  # on l' = F x, in pixels
    assert np.abs((lines_in_first(F, b) * x).sum(-1)).max() < 1e-9  # on l = F^T x'
    np.testing.assert_allclose(np.linalg.norm(lines_in_second(F, a)[:, :2], axis=-1), 1)
    e, e_ = epipoles(F)
    np.testing.assert_allclose(F @ e, 0, atol=1e-15)
    np.testing.assert_allclose(F.T @ e_, 0, atol=1e-15)
    # they are the images of the other's centre, and all lines go through them
    second_centre = -T_SECOND_FIRST[:3, :3].T @ T_SECOND_FIRST[:3, 3]
    np.testing.assert_allclose(e / e[2], K @ second_centre / second_centre[2], rtol=1e-9)
    np.testing.assert_allclose(lines_in_first(F, b) @ e, 0, atol=1e-9)


def at(P: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The camera matrix for world points that are moved by an offset."""
    return np.hstack([P[:, :3], (P[:, 3] - P[:, :3] @ offset)[:, None]])


@pytest.mark.parametrize("metres", [30.0, 1000.0, 5e5])
@pytest.mark.parametrize("baseline", [1.0, 0.01])
def test_f_of_cameras_does_not_depend_on_where_they_stand(metres: float, baseline: float) -> None:
    """It does not depend on which camera is first either, and cameras with one centre are refused there too."""
    offset = metres * np.array([1.0, -0.7, 0.1])
    other = projection_matrix(K, rigid((0.1, 0.2, 0.3), (0.3 * baseline, 0.1 * baseline, -0.05 * baseline)))
    for first, second in ((FIRST, other), (other, FIRST)):
        near, far = (
            fundamental_from_cameras(first, second),
            fundamental_from_cameras(at(first, offset), at(second, offset)),
        )
        np.testing.assert_allclose(alike(far, near), near, atol=1e-14 * metres / baseline + 1e-12)
    turned = projection_matrix(K, rigid((0.1, 0.2, 0.3), (0, 0, 0)))
    with pytest.raises(ValueError, match="same centre"):
        fundamental_from_cameras(at(FIRST, offset), at(turned, offset))


@pytest.mark.parametrize(
    ("off", "focal", "single"),
    [(off, focal, False) for off in (0.0, 1e-17, 1e-12, 1e-7, 1e-4, 1e-2) for focal in (1.0, 30.0, 1000.0, 5000.0)]
    + [(off, 1.0, True) for off in (0.0, 1e-17, 1e-12, 1e-7, 1e-2)],
)
def test_f_and_e_of_forward_motion_are_accepted_and_their_epipoles_are_right(
    off: float, focal: float, single: bool
) -> None:
    calibration = np.diag([focal, focal, 1.0])  # the principal point is the origin
    for seed in range(20):
        random = np.random.default_rng(seed)
        turn = [0, 0, random.uniform(-3, 3)]
        T = rigid(turn, [*(off * random.uniform(0.5, 1, 2)), random.uniform(0.1, 10)])
        inverse = K @ np.linalg.inv(calibration)
        matrix = inverse.T @ fundamental_from_pose(K, K, T) @ inverse  # rounded where entries are 0
        matrix = matrix.astype(np.float32) if single else matrix
        e, e_ = epipoles(matrix)
        truth, truth_ = (calibration @ v for v in (T[:3, :3].T @ T[:3, 3] / T[2, 3], T[:3, 3] / T[2, 3]))
        digits = 1e-5 if single else 1e-9
        np.testing.assert_allclose(e / e[2], truth, rtol=0, atol=digits * focal)
        np.testing.assert_allclose(e_ / e_[2], truth_, rtol=0, atol=digits * focal)
        seen = random.uniform(-1, 1, (5, 2)) * focal
        assert np.isfinite(lines_in_second(matrix, seen)).all()


def test_f_with_a_border_of_rounding_is_accepted_and_rank_three_is_refused() -> None:
    for rounding in (0.0, 1e-17, 1e-12, 1e-8):
        for last in (0.0, 1e-17, 1e-12):
            e, e_ = epipoles([[0, -1, 0], [1, 0, rounding], [0, 0, last]])
            np.testing.assert_allclose(np.abs([e, e_]), [[0, 0, 1]] * 2, atol=2 * rounding)
        for last in (1e-3, 1.0, 1e3):
            with pytest.raises(ValueError, match="rank 2"):
                epipoles([[0, -1, 0], [1, 0, rounding], [0, 0, last]])
    for unit in (3e-3, 1.0, 1000.0):  # metres on a sensor, focal lengths, pixels
        scale = np.diag([1 / unit, 1 / unit, 1.0])
        for seed in range(20):
            with pytest.raises(ValueError, match="rank 2"):
                epipoles(scale @ np.random.default_rng(seed).normal(size=(3, 3)) @ scale)


def test_f_has_seven_degrees_of_freedom_and_e_five() -> None:
    def from_camera(v: np.ndarray) -> np.ndarray:
        return alike(fundamental_from_cameras(FIRST, v.reshape(3, 4)), F).ravel()

    def from_pose(v: np.ndarray) -> np.ndarray:
        E = essential_from_pose(rigid(v[:3], v[3:]))
        return np.asarray(E / np.linalg.norm(E)).ravel()

    for f, at, freedom in ((from_camera, SECOND.ravel(), 7), (from_pose, np.array([0.1, 0.2, 0.3, 0.3, 0.1, 0.2]), 5)):
        h = 1e-6 * np.maximum(np.abs(at), 1)
        jacobian = np.stack([(f(at + d) - f(at - d)) / (2 * d.max()) for d in np.diag(h)])
        jacobian /= np.linalg.norm(jacobian, axis=1, keepdims=True).clip(1e-12)
        assert np.linalg.matrix_rank(jacobian, tol=1e-4) == freedom


def test_f_of_cameras_is_f_of_pose_and_e() -> None:
    np.testing.assert_allclose(alike(fundamental_from_pose(K, K, T_SECOND_FIRST), F), F, atol=1e-12)
    E = essential_from_pose(T_SECOND_FIRST)
    np.testing.assert_allclose(alike(K.T @ F @ K, E), E / np.linalg.norm(E), atol=1e-10)
    poses = poses_from_essential(-3 * E)
    for T in poses:
        np.testing.assert_allclose(np.abs(alike(essential_from_pose(T), E)), np.abs(E / np.linalg.norm(E)), atol=1e-9)
    a, b = views(np.random.default_rng(1), 20)
    counts = [in_front(K, K, T, a, b).sum() for T in poses]
    assert sorted(counts)[-1] == 20
    assert sorted(counts)[-2] < 20
    right = poses[int(np.argmax(counts))]
    np.testing.assert_allclose(right[:3, :3], T_SECOND_FIRST[:3, :3], atol=1e-9)
    np.testing.assert_allclose(right[:3, 3], T_SECOND_FIRST[:3, 3] / np.linalg.norm(T_SECOND_FIRST[:3, 3]), atol=1e-9)


def test_epipolar_lines_are_those_of_opencv() -> None:
    a, b = views(np.random.default_rng(2), 10)
    for ours, theirs in (
        (lines_in_second(F, a), cv2.computeCorrespondEpilines(a[:, None], 1, F)),
        (lines_in_first(F, b), cv2.computeCorrespondEpilines(b[:, None], 2, F)),
    ):
        np.testing.assert_allclose(np.abs(ours), np.abs(theirs[:, 0]), rtol=1e-4, atol=1e-4)


def test_the_sampson_distance_is_the_reprojection_error_to_first_order() -> None:
    a, b = views(np.random.default_rng(3), 50, noise=0.1)
    u, v = cv2.correctMatches(F, a[None], b[None])
    exact = np.sqrt(((u[0] - a) ** 2 + (v[0] - b) ** 2).sum(-1))
    np.testing.assert_allclose(np.abs(sampson_distance(F, a, b)), exact, rtol=1e-3, atol=1e-6)


# ------------------------------------------------------------------------------------- F from points


def test_seven_pairs_give_the_truth_among_at_most_three() -> None:
    random = np.random.default_rng(4)
    for _ in range(30):
        a, b = views(random, 7)
        found = seven_point(a, b)
        assert 1 <= len(found) <= 3
        assert np.abs(np.linalg.det(found / np.linalg.norm(found, axis=(1, 2), keepdims=True))).max() < 1e-9
        assert min(np.abs(alike(one, F) - F).max() for one in found) < 1e-6
        theirs, _ = cv2.findFundamentalMat(a, b, cv2.FM_7POINT)
        for one in theirs.reshape(-1, 3, 3):
            assert min(np.abs(alike(ours, one) - one / np.linalg.norm(one)).max() for ours in found) < 1e-4


def test_the_eight_point_algorithm_is_that_of_scikit_image() -> None:
    a, b = views(np.random.default_rng(5), 20, NOISE)
    theirs = FundamentalMatrixTransform.from_estimate(a, b).params
    np.testing.assert_allclose(
        alike(eight_point(a, b), F), alike(theirs, F), atol=5e-6
    )  # its distances are root mean squares
    assert np.linalg.svd(eight_point(a, b), compute_uv=False)[2] < 1e-15


@pytest.mark.validation
def test_f_reaches_the_bound_and_states_its_covariance() -> None:
    random, n = np.random.default_rng(6), 25
    X = points(random, n)
    a, b = project(FIRST, X), project(SECOND, X)

    def predict(v: np.ndarray) -> np.ndarray:
        Y = v[12:].reshape(-1, 3)
        return np.concatenate([project(FIRST, Y).ravel(), project(v[:12].reshape(3, 4), Y).ravel()])

    def quantity(v: np.ndarray) -> np.ndarray:
        return alike(fundamental_from_cameras(FIRST, v[:12].reshape(3, 4)), F).ravel()

    bound = cramer_rao(predict, quantity, np.concatenate([SECOND.ravel(), X.ravel()]), NOISE)
    fits = [
        fit_fundamental(a + random.normal(0, NOISE, a.shape), b + random.normal(0, NOISE, b.shape)) for _ in range(80)
    ]
    errors = np.stack([alike(fit.matrix, F).ravel() - F.ravel() for fit in fits])
    assert 0.8 < efficiency(errors, bound, rank=7) < 1.2
    assert np.mean([fit.noise_px for fit in fits]) == pytest.approx(NOISE, rel=0.05)
    ours = fit_fundamental(a, b, noise_px=NOISE).covariance
    np.testing.assert_allclose(ours, bound, atol=1e-3 * np.abs(bound).max())
    linear = np.stack(
        [
            alike(eight_point(a + random.normal(0, NOISE, a.shape), b + random.normal(0, NOISE, b.shape)), F).ravel()
            - F.ravel()
            for _ in range(80)
        ]
    )
    assert efficiency(linear, bound, rank=7) > efficiency(errors, bound, rank=7)


def test_wrong_pairs_are_left_out() -> None:
    random = np.random.default_rng(7)
    a, b = views(random, 120, NOISE)
    b[:40] = random.uniform(0, 480, (40, 2))
    found = find_fundamental(a, b, NOISE)
    assert found.inliers[40:].mean() > 0.95
    assert found.inliers[:40].mean() < 0.1
    clean, other = views(random, 50)
    assert np.abs(sampson_distance(found.matrix, clean, other)).max() < 2
    np.testing.assert_array_equal(found.matrix, find_fundamental(a, b, NOISE).matrix)
    pose = find_relative_pose(a, b, K, K, NOISE)
    assert pose.inliers[40:].mean() > 0.95
    assert np.degrees(turn_between(pose.T_second_first)) < 0.5


# ------------------------------------------------------------------------------------- pose


def turn_between(T: np.ndarray) -> float:
    return float(Rotation.from_matrix(T_SECOND_FIRST[:3, :3] @ T[:3, :3].T).magnitude())


@pytest.mark.validation
def test_the_relative_pose_reaches_the_bound() -> None:
    random, n = np.random.default_rng(8), 20
    X = points(random, n)
    a, b = project(FIRST, X), project(SECOND, X)
    R, t = T_SECOND_FIRST[:3, :3], T_SECOND_FIRST[:3, 3]

    def moved(v: np.ndarray) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(v[:3]).as_matrix() @ R, t + v[3:6]
        return T

    def predict(v: np.ndarray) -> np.ndarray:
        Y = v[6:].reshape(-1, 3)
        return np.concatenate([project(FIRST, Y).ravel(), project(projection_matrix(K, moved(v)), Y).ravel()])

    def quantity(v: np.ndarray) -> np.ndarray:
        return np.concatenate([v[:3], (t + v[3:6]) / np.linalg.norm(t + v[3:6])])

    bound = cramer_rao(predict, quantity, np.concatenate([np.zeros(6), X.ravel()]), NOISE)
    errors = []
    for _ in range(40):
        fit = fit_relative_pose(
            a + random.normal(0, NOISE, a.shape), b + random.normal(0, NOISE, b.shape), K, K, noise_px=NOISE
        )
        turn = Rotation.from_matrix(fit.T_second_first[:3, :3] @ R.T).as_rotvec()
        errors.append(np.concatenate([turn, fit.T_second_first[:3, 3] - t / np.linalg.norm(t)]))
    assert 0.75 < efficiency(np.stack(errors), bound, rank=5) < 1.25
    np.testing.assert_allclose(fit.covariance[:3, :3], bound[:3, :3], atol=0.1 * np.abs(bound[:3, :3]).max())


def test_the_pose_agrees_with_opencv_on_exact_pairs() -> None:
    a, b = views(np.random.default_rng(9), 30)
    E, _ = cv2.findEssentialMat(a, b, K)
    _, R, t, _ = cv2.recoverPose(E, a, b, K)
    T = fit_relative_pose(a, b, K, K).T_second_first
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], t.ravel(), atol=1e-5)


@pytest.mark.parametrize("seed", [478, 2917, 8796, 13017, 10711, 11617, 14164])
def test_a_poor_solution_of_the_five_point_solver_does_not_prevent_a_pose(seed: int) -> None:
    """One of the solver's matrices has singular values that differ by more than 1e-3; another one is correct."""
    random = np.random.default_rng(seed)
    focal = 10 ** random.uniform(2.2, 4.3)
    camera = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1.0]])
    turn = random.normal(size=3) * 10 ** random.uniform(-4, 0)
    T = rigid(turn, random.normal(size=3) * 10 ** random.uniform(-3, 0.5))
    n = int(random.integers(6, 40))
    z = random.uniform(2, 2 + 10 ** random.uniform(-1, 1.5), n)
    a = np.stack([random.uniform(0, 640, n), random.uniform(0, 480, n)], axis=-1)
    b = project(projection_matrix(camera, T), np.c_[(a - [320, 240]) / focal, np.ones(n)] * z[:, None])
    noise = random.choice([0, 0.1, 0.5, 2, 10])
    a, b = a + random.normal(size=a.shape) * noise, b + random.normal(size=b.shape) * noise
    found = fit_relative_pose(a, b, camera, camera, noise_px=noise or None).T_second_first
    off = 2e-3 if noise else 1e-9  # seed 10711 has noise of 0.1 px
    np.testing.assert_allclose(found[:3, :3], T[:3, :3], atol=off)
    np.testing.assert_allclose(found[:3, 3], T[:3, 3] / np.linalg.norm(T[:3, 3]), atol=5 * off)


# ------------------------------------------------------------------------------------- degenerate views

ROTATED = rigid((0.05, -0.2, 0.03), (0, 0, 0))
FITS: dict[str, Callable[..., object]] = {
    "F": fit_fundamental,
    "pose": lambda a, b, **options: fit_relative_pose(a, b, K, K, **options),
}


@pytest.mark.parametrize("known", [True, False], ids=["noise known", "noise unknown"])
@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize(("plane", "T"), [(True, T_SECOND_FIRST), (False, ROTATED), (False, np.eye(4))])
@pytest.mark.parametrize("fit", FITS)
def test_planes_rotations_and_one_view_twice_are_refused(
    fit: str, plane: bool, T: np.ndarray, noise: float, known: bool
) -> None:
    random = np.random.default_rng(10)
    tried = 0
    for n in (8, 12, 60):
        for _ in range(2):
            a, b = views(random, n, noise, plane, T)
            with pytest.raises(ValueError, match="expected"):
                FITS[fit](a, b, noise_px=noise if known and noise else None)
            tried += 1
    assert tried == 6


def test_the_messages_name_what_is_wrong() -> None:
    random = np.random.default_rng(11)
    for T, plane, noise, what in (
        (T_SECOND_FIRST, True, NOISE, "points of one plane"),
        (np.eye(4), False, NOISE, "one view twice"),
        (T_SECOND_FIRST, True, 0.0, "one plane"),
    ):
        with pytest.raises(ValueError, match=what):
            fit_fundamental(*views(random, 40, noise, plane, T))
    with pytest.raises(ValueError, match="a rotation alone"):
        fit_relative_pose(*views(random, 40, NOISE, T=ROTATED), K, K, noise_px=NOISE)
    with pytest.raises(ValueError, match="depend on each other"):
        seven_point(*views(random, 7, plane=True))


def test_a_plane_with_wrong_pairs_is_refused() -> None:
    """RANSAC finds some F there, from the plane and two of the wrong pairs."""
    random = np.random.default_rng(12)
    for T, plane in ((T_SECOND_FIRST, True), (ROTATED, False)):
        for _ in range(3):
            a, b = views(random, 100, NOISE, plane, T)
            b[:30] = random.uniform(0, 480, (30, 2))
            with pytest.raises(ValueError, match=r"off the plane|points of one plane"):
                find_fundamental(a, b, NOISE)
            with pytest.raises(ValueError, match=r"off the plane|points of one plane|rotation alone|no pose"):
                find_relative_pose(a, b, K, K, NOISE)


def test_random_pairs_are_refused() -> None:
    random = np.random.default_rng(13)
    for n in (12, 60):
        a, b = random.uniform(0, 480, (2, n, 2))
        with pytest.raises(ValueError, match="chance"):
            find_fundamental(a, b, NOISE)
        with pytest.raises(ValueError, match="chance"):
            find_relative_pose(a, b, K, K, NOISE)


def plane_and_more(seed: int, n: int, off: int) -> tuple[np.ndarray, np.ndarray]:
    """n noisy pairs (n, 2), of which all but `off` lie on one plane."""
    random = np.random.default_rng(seed)
    X = points(random, n, plane=True)
    X[:off] = points(random, off)
    a, b = project(FIRST, X), project(SECOND, X)
    return a + random.normal(0, NOISE, a.shape), b + random.normal(0, NOISE, b.shape)


@pytest.mark.parametrize("known", [True, False], ids=["noise known", "noise unknown"])
@pytest.mark.parametrize("n", [12, 30, 80, *to_validate(400)])
def test_a_plane_and_one_point_off_it_leave_the_epipole_open(n: int, known: bool) -> None:
    """Any epipole on the line of that point fits. A fifth of such sets once passed, with epipoles 75 degrees off."""
    for seed in range(30):
        with pytest.raises(ValueError, match="expected"):
            fit_fundamental(*plane_and_more(seed, n, 1), noise_px=NOISE if known else None)


@pytest.mark.parametrize(
    ("n", "off", "fewest"), [(12, 2, 8), (80, 2, 4), (30, 3, 16), (80, 30, 30), *to_validate((400, 2, 6))]
)
def test_a_plane_and_some_points_off_it_are_as_exact_as_their_covariance_or_refused(
    n: int, off: int, fewest: int
) -> None:
    found = []
    for seed in range(30):
        try:
            fit = fit_fundamental(*plane_and_more(seed, n, off), noise_px=NOISE)
        except ValueError:
            continue
        values, axes = np.linalg.eigh(fit.covariance)
        error = (alike(fit.matrix, F) - F).ravel() @ axes[:, -7:] / np.sqrt(values[-7:])
        found.append(np.sqrt((error**2).mean()))
    assert len(found) >= fewest
    assert max(found) < 2.5
    assert np.median(found) < 1.5


def test_a_surface_through_both_centres_is_refused() -> None:
    """A ruled quadric that contains the centres and the points does not determine F (HZ 22.2)."""
    random = np.random.default_rng(14)
    c = -T_SECOND_FIRST[:3, :3].T @ T_SECOND_FIRST[:3, 3]
    # alpha x^2 + beta y^2 + gamma z^2 - z = 0 holds at the first centre, 0, and by its alpha at the second
    beta, gamma = 0.3, 0.22
    alpha = (c[2] - beta * c[1] ** 2 - gamma * c[2] ** 2) / c[0] ** 2
    assert alpha < 0  # with that it is a ruled one
    rays = np.concatenate([random.uniform(-0.25, 0.25, (40, 2)), np.ones((40, 1))], axis=1)
    X = rays / (rays**2 @ [alpha, beta, gamma])[:, None]
    a, b = project(FIRST, X), project(SECOND, X)
    with pytest.raises(ValueError, match="depend on each other"):
        fit_fundamental(a, b)
    with pytest.raises(ValueError, match="that two such matrices explain within their noise"):
        fit_fundamental(a + random.normal(0, 0.5, a.shape), b + random.normal(0, 0.5, b.shape))


A, B = views(np.random.default_rng(15), 20)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fit_fundamental(A[:7], B[:7]), "at least 8 points"),
        (lambda: fit_fundamental(np.repeat(A[:7], 2, 0), np.repeat(B[:7], 2, 0)), "8 different points.*7 different"),
        (lambda: eight_point(np.repeat(A[:4], 5, 0), B), "4 different ones among 20 in first"),
        (lambda: seven_point(A, B), "seven pairs.*got 20"),
        (lambda: seven_point(A[:6], B[:6]), "at least 7"),
        (lambda: fit_relative_pose(A[:5], B[:5], K, K), "at least 6"),
        (lambda: fit_fundamental(A, B[:5]), "corresponding points"),
        (lambda: fit_fundamental(np.full_like(A, np.nan), B), "40 NaN"),
        (lambda: fit_fundamental(A, B, noise_px=-1), "noise_px"),
        (lambda: fundamental_from_cameras(FIRST, 2 * FIRST), "same centre"),
        (lambda: essential_from_pose(ROTATED), "translation of 0"),
        (lambda: poses_from_essential(np.eye(3)), r"singular values \(s, s, 0\)"),
        (lambda: epipoles(np.eye(3)), "rank 2"),
        (lambda: epipoles(np.outer([1, 2, 3], [1, 1, 1])), "rank 2"),
    ],
)
def test_invalid_input_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
