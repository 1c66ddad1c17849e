# SPDX-License-Identifier: Apache-2.0
"""Rectification by F alone: matching rows, OpenCV's implementation, matching of images, invalid input."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from geometry_scenes import rigid
from test_geometry_stereo import LEFT, RIGHT, photograph, scene_points

from rangesim.geometry import (
    find_fundamental,
    fundamental_from_pose,
    homogeneous,
    map_points,
    match_rows,
    projection_matrix,
    rectify_uncalibrated,
)
from rangesim.rig import Intrinsics

SIZE = (320, 240)
PINHOLES = replace(LEFT, distortion=()), replace(RIGHT, distortion=())
PARALLEL_ROWS = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0.0]])
"""Fundamental matrix of rectified cameras."""


def views(T, cameras=PINHOLES, n=200, seed=1, noise=0.0):
    random = np.random.default_rng(seed)
    X = scene_points(random, n)
    pixels = [cameras[0].project(X), cameras[1].project(X @ T[:3, :3].T + T[:3, 3])]
    inside = np.all([((p > 0) & (p < SIZE)).all(axis=-1) for p in pixels], axis=0)
    F = fundamental_from_pose(*(projection_matrix(c)[:, :3] for c in cameras), T)
    return F, *(p[inside] + random.normal(0, noise, p[inside].shape) for p in pixels)


@pytest.mark.parametrize(
    ("turn", "move"),
    [
        ((0.06, 0.12, -0.03), (-0.15, 0.01, 0.02)),
        ((0.0, 0.0, 0.0), (-0.15, 0.0, 0.0)),  # rectified already: the epipoles lie at infinity
        ((0.0, 0.0, 0.0), (0.15, 0.0, 0.0)),  # the first camera on the right
        ((0.05, -0.02, 0.4), (0.02, 0.16, 0.01)),  # one above the other, rolled
        ((-0.08, -0.1, 0.1), (-0.15, -0.1, 0.03)),
    ],
)
def test_epipolar_lines_become_rows_with_the_same_number(turn, move):
    F, a, b = views(rigid(turn, move))
    assert len(a) > 20
    pair = rectify_uncalibrated(F, a, b, SIZE)
    rectified = np.linalg.inv(pair.H_second).T @ F @ np.linalg.inv(pair.H_first)
    rectified = rectified / rectified[2, 1]
    assert np.allclose(rectified, PARALLEL_ROWS, atol=1e-6 * max(pair.width, pair.height))
    assert pair.row_error_px < 1e-6
    assert np.allclose(map_points(pair.H_first, a)[:, 1], map_points(pair.H_second, b)[:, 1], atol=1e-6)
    # nothing is mirrored, torn or cut off
    border = np.array([[0, 0], [320, 0], [320, 240], [0, 240.0]])
    for H in (pair.H_first, pair.H_second):
        assert ((homogeneous(border) @ H[2]) * H[2, 2] > 0).all()
        corners = map_points(H, border)
        assert (corners > -1e-6).all()
        assert (corners < np.array([pair.width, pair.height]) + 1e-6).all()
        assert np.linalg.det(H) * H[2, 2] > 0


def test_rows_are_those_of_opencv():
    """OpenCV's implementation gives the same rows up to their offset."""
    F, a, b = views(rigid((0.06, 0.12, -0.03), (-0.15, 0.01, 0.02)))
    ours = rectify_uncalibrated(F, a, b, SIZE)
    found, H_first, H_second = cv2.stereoRectifyUncalibrated(a - 0.5, b - 0.5, _opencv(F), SIZE)
    assert found
    for H, own, pixels in ((H_first, ours.H_first, a), (H_second, ours.H_second, b)):
        theirs, mine = map_points(H, pixels - 0.5)[:, 1], map_points(own, pixels)[:, 1]
        line = np.polyfit(mine, theirs, 1)
        assert np.abs(np.polyval(line, mine) - theirs).max() < 1e-3
        assert abs(abs(line[0]) - 1) < 1e-3
    disparity = map_points(H_first, a - 0.5)[:, 0] - map_points(H_second, b - 0.5)[:, 0]
    assert np.std(ours.disparity_px) <= np.std(disparity) * 1.001


def _opencv(F):
    """F (3, 3) for pixels whose centres lie at integers, as in OpenCV."""
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return shift.T @ F @ shift


def test_from_noisy_pairs_rows_match_to_the_noise():
    _, a, b = views(rigid((0.06, 0.12, -0.03), (-0.15, 0.01, 0.02)), noise=0.2, n=400)
    found = find_fundamental(a, b, noise_px=0.2)
    pair = rectify_uncalibrated(found.matrix, a[found.inliers], b[found.inliers], SIZE)
    assert 0.2 < pair.row_error_px < 0.35  # sqrt(2) 0.2


def test_images_match_along_the_rows():
    T = rigid((0.06, 0.12, -0.03), (-0.15, 0.01, 0.02))
    F, a, b = views(T)
    pair = rectify_uncalibrated(F, a, b, SIZE)
    images = [photograph(camera, pose)[0] for camera, pose in zip(PINHOLES, (np.eye(4), T), strict=True)]
    warped = pair.warp(*images)
    assert warped[0].shape == warped[1].shape == (pair.height, pair.width)
    # the wall of the images, not the points of the pairs: its disparities are known by its depth
    z = photograph(PINHOLES[0], np.eye(4))[1]
    X = PINHOLES[0].directions(PINHOLES[0].pixel_centres()) * z[..., None]
    there = map_points(pair.H_second, PINHOLES[1].project(X @ T[:3, :3].T + T[:3, 3]).reshape(-1, 2))
    here = map_points(pair.H_first, PINHOLES[0].pixel_centres().reshape(-1, 2))
    true = here[:, 0] - there[:, 0]
    found = match_rows(*warped, (np.nanmin(true) - 2, np.nanmax(true) + 2))
    at = np.floor(here).astype(int).clip(0, [pair.width - 1, pair.height - 1])
    off = found[at[:, 1], at[:, 0]] - true
    assert np.isfinite(off).mean() > 0.6
    assert np.nanmedian(np.abs(off)) < 0.2


@pytest.mark.parametrize("forward", [0.5, 0.15])
def test_cameras_that_look_along_their_baseline_are_refused(forward):
    F, a, b = views(rigid((0, 0, 0), (0.02, 0.01, -forward)))
    with pytest.raises(ValueError, match="epipole"):
        rectify_uncalibrated(F, a, b, SIZE)


def test_invalid_input_is_refused():
    F, a, b = views(rigid((0.06, 0.12, -0.03), (-0.15, 0.01, 0.02)))
    with pytest.raises(ValueError, match="at least 3"):
        rectify_uncalibrated(F, a[:2], b[:2], SIZE)
    with pytest.raises(ValueError, match="rank 2"):
        rectify_uncalibrated(np.eye(3), a, b, SIZE)
    with pytest.raises(ValueError, match="size"):
        rectify_uncalibrated(F, a, b, (0, 240))
    line = a[:5].copy()
    line[:, 1] = 2 * line[:, 0] + 3
    with pytest.raises(ValueError, match="on a line"):
        rectify_uncalibrated(F, line, b[:5], SIZE)
    pair = rectify_uncalibrated(F, a, b, SIZE)
    with pytest.raises(ValueError, match="shape"):
        pair.warp(np.zeros((240, 321)), np.zeros((240, 320)))


def test_principal_points_may_lie_anywhere():
    cameras = (Intrinsics(320, 240, 300, 302, 100, 60), Intrinsics(320, 240, 280, 285, 220, 190))
    F, a, b = views(rigid((0.06, 0.12, -0.03), (-0.15, 0.01, 0.02)), cameras, n=800)
    assert len(a) > 10
    assert rectify_uncalibrated(F, a, b, SIZE).row_error_px < 1e-6
