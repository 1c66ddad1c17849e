# SPDX-License-Identifier: Apache-2.0
"""Stereo: rectified rows, formulas of parallel cameras, and matching on a textured wall of known geometry."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_scenes import rigid

from rangesim.geometry import (
    ParallelCameras,
    epipoles,
    fundamental_from_cameras,
    fundamental_from_pose,
    homogeneous,
    lines_in_second,
    map_points,
    match_rows,
    project,
    projection_matrix,
    rectify,
)
from rangesim.rig import Intrinsics

LEFT = Intrinsics(320, 240, 300, 302, 161, 118, (-0.1, 0.02))
RIGHT = Intrinsics(320, 240, 310, 308, 158, 122, (-0.08,))
T = rigid((0.06, 0.12, -0.03), (-0.15, 0.01, 0.02))
"""T_right_left: maps coordinates of the left camera to those of the right one, which is turned inwards."""
WALL = np.array([0.1, -0.2, 1.0]), 1.2
"""Normal n and distance d of the plane n X = d in coordinates of the left camera, metres."""


def texture(X: np.ndarray) -> np.ndarray:
    """Brightness of points (n, 3) of the wall: a pattern without a period, whose finest wave is some pixels long."""
    random = np.random.default_rng(0)
    waves, phases = random.normal(0, 60, (60, 3)), random.uniform(0, 2 * np.pi, 60)
    return np.asarray(np.sin(X @ waves.T + phases).sum(axis=-1))


def photograph(camera: Intrinsics, T_camera_left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image (h, w) of the wall and its depth z (h, w) in metres for that camera."""
    back = np.linalg.inv(T_camera_left)
    rays = camera.directions(camera.pixel_centres()) @ back[:3, :3].T
    z = (WALL[1] - WALL[0] @ back[:3, 3]) / (rays @ WALL[0])
    return texture(rays * z[..., None] + back[:3, 3]), z


def scene_points(random: np.random.Generator, n: int) -> np.ndarray:
    return random.uniform((-0.3, -0.2, 1.0), (0.5, 0.3, 2.0), (n, 3))


def test_rectified_epipolar_lines_are_rows_and_epipoles_lie_at_infinity() -> None:
    pair = rectify(LEFT, RIGHT, T)
    X = scene_points(np.random.default_rng(1), 100)
    a, b = pair.pixels_of_first(LEFT.project(X)), pair.pixels_of_second(RIGHT.project(X @ T[:3, :3].T + T[:3, 3]))
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-5)
    # in homographies of the pinholes: F becomes that of a translation along x
    K = [projection_matrix(c)[:, :3] for c in (LEFT, RIGHT)]
    F = np.linalg.inv(pair.H_second).T @ fundamental_from_pose(*K, T) @ np.linalg.inv(pair.H_first)
    np.testing.assert_allclose(
        np.abs(F / np.linalg.norm(F)), np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0]]) / np.sqrt(2), atol=1e-9
    )
    for pole in epipoles(F):
        np.testing.assert_allclose(np.abs(pole), (1, 0, 0), atol=1e-9)
    lines = lines_in_second(F, a)
    np.testing.assert_allclose(np.abs(lines[:, :2]), [(0, 1)] * 100, atol=1e-9)
    # and disparity is f b / z
    in_rectified = X @ pair.R_rectified_first.T
    np.testing.assert_allclose(a[:, 0] - b[:, 0], pair.parallel.disparity(in_rectified[:, 2]), atol=1e-4)
    assert pair.baseline_m == pytest.approx(np.linalg.norm(T[:3, 3]))


def test_rotations_are_those_of_opencv_but_for_the_turn_about_the_baseline() -> None:
    pair = rectify(LEFT, RIGHT, T)
    K = [projection_matrix(c)[:, :3] for c in (LEFT, RIGHT)]
    theirs = cv2.stereoRectify(K[0], np.zeros(5), K[1], np.zeros(5), (320, 240), T[:3, :3], T[:3, 3:])
    for ours, other in ((pair.R_rectified_first, theirs[0]), (pair.R_rectified_second, theirs[1])):
        turn = ours @ other.T
        assert np.trace(turn) > 3 - 1e-3
        np.testing.assert_allclose(turn[0], (1, 0, 0), atol=1e-9)


def test_warped_images_agree_with_mapped_pixels() -> None:
    """The homography of the pinhole and the warped image agree with the mapped pixels."""
    pair = rectify(LEFT, RIGHT, T)
    from rangesim.geometry import ideal_pixels

    some = np.random.default_rng(2).uniform(0, (320, 240), (50, 2))
    np.testing.assert_allclose(
        map_points(pair.H_first, ideal_pixels(LEFT, some)), pair.pixels_of_first(some), atol=1e-6
    )
    ramp_x, ramp_y = LEFT.pixel_centres()[..., 0], LEFT.pixel_centres()[..., 1]
    at_x, _ = pair.warp(ramp_x, np.zeros((240, 320)))
    at_y, _ = pair.warp(ramp_y, np.zeros((240, 320)))
    known = np.isfinite(at_x) & (at_x > 1) & (at_x < 319) & (at_y > 1) & (at_y < 239)
    centres = pair.camera.pixel_centres()[known]
    source = np.stack([at_x[known], at_y[known]], axis=-1)
    assert np.abs(pair.pixels_of_first(source) - centres).max() < 0.08  # of bilinear maps in steps of 1/32


def test_the_whole_field_of_both_cameras_is_kept() -> None:
    pair = rectify(LEFT, RIGHT, T)
    size = np.array([pair.camera.width, pair.camera.height])
    for camera, move in ((LEFT, pair.pixels_of_first), (RIGHT, pair.pixels_of_second)):
        inside = move(camera.pixel_centres().reshape(-1, 2))
        assert (inside > -1e-6).all()
        assert (inside < size + 1e-6).all()


def test_matching_finds_the_wall_with_rectification_and_not_without() -> None:
    (left, _), (right, _) = photograph(LEFT, np.eye(4)), photograph(RIGHT, T)
    pair = rectify(LEFT, RIGHT, T)
    near_far = pair.parallel.disparity([2.5, 0.8])
    disparity = match_rows(*pair.warp(left, right), (near_far[0], near_far[1]))
    X = pair.points(disparity)
    found = np.isfinite(X).all(axis=-1)
    off = (X[found] @ WALL[0] - WALL[1]) / np.linalg.norm(WALL[0])
    z = X[found][:, 2]
    sigma = pair.parallel.depth_error(z, 0.1)
    assert found.sum() > 0.5 * left.size
    assert np.median(np.abs(off) / sigma) < 1.0  # a tenth of a pixel
    assert np.quantile(np.abs(off), 0.95) < 0.02
    # the rows of the unrectified images do not correspond
    raw = match_rows(left, right, (near_far[0] - 40, near_far[1]))
    a = LEFT.pixel_centres()[np.isfinite(raw)]
    b = a - np.stack([raw[np.isfinite(raw)], np.zeros(len(a))], axis=-1)
    _, depth = photograph(LEFT, np.eye(4))
    rays = LEFT.directions(a) * depth[np.isfinite(raw)][:, None]
    true = RIGHT.project(rays @ T[:3, :3].T + T[:3, 3])
    right_ones = np.linalg.norm(true - b, axis=-1) < 1
    assert right_ones.sum() < 0.1 * found.sum()


def test_disparity_depth_and_error_are_the_fronto_parallel_formulas() -> None:
    stereo = ParallelCameras(800.0, 0.1)
    z = np.array([0.5, 1.0, 4.0])
    np.testing.assert_allclose(stereo.disparity(z), 80 / z)
    np.testing.assert_allclose(stereo.depth(stereo.disparity(z)), z)
    h = 1e-5
    slope = (stereo.depth(stereo.disparity(z) + h) - stereo.depth(stereo.disparity(z) - h)) / (2 * h)
    np.testing.assert_allclose(stereo.depth_error(z, 0.1), 0.1 * np.abs(slope), rtol=1e-6)
    assert np.isnan(stereo.depth([0.0, -1.0])).all()
    # measured: a plane with noisy disparities
    noisy = stereo.depth(stereo.disparity(2.0) + np.random.default_rng(3).normal(0, 0.1, 50_000))
    assert np.std(noisy) == pytest.approx(float(stereo.depth_error(2.0, 0.1)), rel=0.03)
    # and F of such cameras has epipoles at infinity on the rows
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    F = fundamental_from_cameras(projection_matrix(K), projection_matrix(K, rigid((0, 0, 0), (-0.1, 0, 0))))
    np.testing.assert_allclose(np.abs(epipoles(F).first), (1, 0, 0), atol=1e-12)
    X = scene_points(np.random.default_rng(4), 10)
    a, b = (project(projection_matrix(K, rigid((0, 0, 0), (x, 0, 0))), X) for x in (0, -0.1))
    np.testing.assert_allclose(((homogeneous(b) @ F) * homogeneous(a)).sum(-1), 0, atol=1e-9)
    np.testing.assert_allclose(stereo.depth(a[:, 0] - b[:, 0]), X[:, 2])


@pytest.mark.parametrize(
    "move", [(-0.1, 0, 0), (0.1, 0, 0), (0, -0.1, 0), (0, 0.1, 0)], ids=["right", "left", "below", "above"]
)
def test_the_second_camera_may_stand_on_any_side(move: tuple[float, float, float]) -> None:
    there = rigid((0.02, 0.05, -0.03), move)
    pair = rectify(LEFT, LEFT, there)
    X = scene_points(np.random.default_rng(5), 20)
    a, b = (
        pair.pixels_of_first(LEFT.project(X)),
        pair.pixels_of_second(LEFT.project(X @ there[:3, :3].T + there[:3, 3])),
    )
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-5)
    assert (a[:, 0] > b[:, 0]).all()


FLAT, GREY = np.zeros((40, 60)), np.random.default_rng(6).uniform(size=(40, 60))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rectify(LEFT, RIGHT, np.eye(4)), "baseline of 0"),
        (lambda: rectify(LEFT, RIGHT, rigid((0, 0, 0), (0, 0, -0.3))), "look along it"),
        (lambda: rectify(LEFT, RIGHT, rigid((0, 0, 0), (-0.05, 0, -0.3))), "look along it"),
        (lambda: rectify(LEFT, RIGHT, rigid((0, np.pi, 0), (-0.2, 0, 0))), "opposite directions"),
        (lambda: rectify(LEFT, RIGHT, rigid((0, 2.0, 0), (-0.2, 0, 0.0))), "look along it"),
        (lambda: match_rows(GREY, GREY[:, :-1], (0, 16)), "one shape"),
        (lambda: match_rows(GREY, GREY, (16, 16)), "least, largest"),
        (lambda: match_rows(GREY, GREY, (0, 60)), "60 pixels wide"),
        (lambda: match_rows(GREY, GREY, (0, np.nan)), "least, largest"),
        (lambda: match_rows(GREY, GREY, (0, 16), block_px=4), "odd"),
        (lambda: match_rows(FLAT, GREY, (0, 16)), "contrast"),
        (lambda: rectify(LEFT, RIGHT, T).warp(GREY, GREY), r"shape \(240, 320\)"),
        (lambda: ParallelCameras(800.0, 0.0), "positive"),
    ],
)
def test_invalid_input_is_refused(call, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        call()
