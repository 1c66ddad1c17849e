# SPDX-License-Identifier: Apache-2.0
"""Structure from motion from tracks alone, and bundle adjustment online."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from many_views import aligned, around, centres, perturbed, position_error, walk
from scipy.spatial.transform import Rotation
from tiers import to_validate

from rangesim.errors import RangesimWarning
from rangesim.multiview import Tracks, adjust_online, bundle_adjust, structure_from_motion


def test_without_noise_everything_is_found_up_to_a_similarity() -> None:
    scene = around(6, 60, fraction=0.8, noise=0.0)
    found = structure_from_motion(scene.tracks, scene.camera, noise_px=0.1)
    np.testing.assert_allclose(aligned(found.points, scene.X), scene.X, atol=1e-7)
    np.testing.assert_allclose(found.T_camera_world[0], np.eye(4), atol=1e-9)
    places = -np.einsum("nji,nj->ni", found.T_camera_world[:, :3, :3], found.T_camera_world[:, :3, 3])
    assert np.linalg.norm(places, axis=1).max() == pytest.approx(1, abs=1e-6)
    assert found.inliers.all()


@pytest.mark.validation
def test_wrong_observations_are_found_and_the_rest_is_as_good_as_without_them() -> None:
    scene = around(8, 120, fraction=0.6)
    random = np.random.default_rng(3)
    pixels = scene.tracks.pixels.copy()
    bad = random.random(len(pixels)) < 0.07
    pixels[bad] += random.uniform(40, 200, (bad.sum(), 2)) * random.choice([-1, 1], (bad.sum(), 2))
    found = structure_from_motion(
        Tracks(scene.tracks.image, scene.tracks.point, pixels, 8, 120), scene.camera, noise_px=0.5
    )
    assert not (found.inliers & bad).any()
    assert (found.inliers | bad).mean() > 0.97
    assert found.noise_px == pytest.approx(0.5, rel=0.1)
    known = np.isfinite(found.points).all(axis=1)
    assert known.mean() > 0.9
    best = bundle_adjust(scene.tracks, scene.camera, scene.T, scene.X)  # from the truth, without wrong ones
    error, least = (
        np.sqrt(((aligned(X[known], scene.X[known]) - scene.X[known]) ** 2).mean()) for X in (found.points, best.points)
    )
    assert error < 1.3 * least


def test_degenerate_motion_is_refused() -> None:
    scene = around(5, 60)
    random = np.random.default_rng(0)
    camera = scene.camera

    def tracks(T: np.ndarray, X: np.ndarray) -> Tracks:
        pixels = np.stack([camera.project(X @ P[:3, :3].T + P[:3, 3]) for P in T])
        return Tracks.from_dense(pixels + random.normal(0, 0.5, pixels.shape))

    with pytest.raises(ValueError, match="at least two images"):
        structure_from_motion(scene.tracks.of_images([0]), camera)
    turned = np.repeat(scene.T[:1], 5, axis=0)
    with pytest.raises(ValueError, match=r"parallax"):  # one view again and again
        structure_from_motion(tracks(turned, scene.X), camera, noise_px=0.5)
    turned[:, :3] = Rotation.from_rotvec(random.normal(0, 0.05, (5, 3))).as_matrix() @ turned[:, :3]
    with pytest.raises(ValueError, match=r"parallax"):  # a camera that only rotates
        structure_from_motion(tracks(turned, scene.X), camera, noise_px=0.5)
    with pytest.raises(ValueError, match=r"parallax"):  # all points on a plane
        structure_from_motion(tracks(scene.T, scene.X * [1, 1, 0.0]), camera, noise_px=0.5)
    with pytest.raises(ValueError, match="share no point"):
        structure_from_motion(
            scene.tracks.keep((scene.tracks.image < 2) == (scene.tracks.point < 30)), camera, noise_px=0.5
        )
    with pytest.raises(ValueError, match="at least 12 points"):
        structure_from_motion(scene.tracks.keep(scene.tracks.point < 8), camera, noise_px=0.5)
    few = scene.tracks.keep((scene.tracks.image != 4) | (scene.tracks.point < 4))
    with pytest.raises(ValueError, match="cannot be placed, such as image 4"):
        structure_from_motion(few, camera, noise_px=0.5)
    far = scene.tracks.pixels.copy()
    far[0] = 1e5
    with pytest.raises(ValueError, match="fold"):
        structure_from_motion(Tracks(scene.tracks.image, scene.tracks.point, far), camera)


@pytest.mark.validation
def test_a_view_that_comes_twice_does_no_harm() -> None:
    scene = around(5, 60)
    twice = Tracks.from_dense(scene.tracks.dense()[[0, 0, 1, 2, 2, 3, 4]])
    found = structure_from_motion(twice, scene.camera, noise_px=0.5)
    assert np.sqrt(((aligned(found.points, scene.X) - scene.X) ** 2).mean()) < 0.01


@pytest.mark.validation
@pytest.mark.parametrize("life", [10, 25])
def test_online_is_within_a_fifth_of_offline(life: int) -> None:
    squares = []
    for seed in range(2):
        scene = walk(30, 300, life, seed=seed)
        start = perturbed(scene, 0.002, 0.002, 0.0)[0][:6]
        found = adjust_online(scene.tracks, scene.camera, start, window=10, noise_px=0.5)
        offline = bundle_adjust(scene.tracks, scene.camera, found.T_camera_world, found.points)
        squares.append([position_error(T, scene.T) ** 2 for T in (found.T_camera_world, offline.T_camera_world)])
    online, offline_square = np.mean(squares, axis=0)
    assert np.sqrt(online / offline_square) < 1.2


def test_a_window_over_everything_is_offline() -> None:
    scene = walk(8, 120, 8)
    start = perturbed(scene, 0.002, 0.002, 0.0)[0][:4]
    found = adjust_online(scene.tracks, scene.camera, start, window=8, noise_px=0.5)
    offline = bundle_adjust(scene.tracks, scene.camera, found.T_camera_world, found.points)
    np.testing.assert_allclose(found.T_camera_world, offline.T_camera_world, atol=1e-4)


@pytest.mark.parametrize(("points", "life", "first"), [(150, 25, 2), (300, 10, 3)])
@pytest.mark.parametrize("seed", [0, 2])
def test_online_keeps_the_scale_of_its_start(points: int, life: int, first: int, seed: int) -> None:
    """Metres of the start are metres of the path; each new image had moved the scale, to paths 4 to 9 % shorter."""
    scene = walk(20, points, life, seed=seed)
    found = adjust_online(scene.tracks, scene.camera, scene.T[:first], window=10, noise_px=0.5)
    offline = bundle_adjust(scene.tracks, scene.camera, scene.T, scene.X)
    assert np.abs(found.T_camera_world[0] - scene.T[0]).max() < 1e-9
    (of_start, online), (offline_start, at_once), (true, _) = (
        np.linalg.norm(centres(T)[[first - 1, -1]] - centres(T)[0], axis=1)
        for T in (found.T_camera_world, offline.T_camera_world, scene.T)
    )
    assert of_start == pytest.approx(true, rel=5e-3)
    assert online == pytest.approx(at_once * true / offline_start, rel=0.02)


@pytest.mark.parametrize("scale", [0.01, 1000.0])
def test_online_follows_the_unit_of_its_start(scale: float) -> None:
    scene = walk(14, 120, 8)
    start = scene.T[:3].copy()
    start[:, :3, 3] *= scale
    metres = adjust_online(scene.tracks, scene.camera, scene.T[:3], window=5, noise_px=0.5)
    other = adjust_online(scene.tracks, scene.camera, start, window=5, noise_px=0.5)
    np.testing.assert_allclose(centres(other.T_camera_world) / scale, centres(metres.T_camera_world), atol=1e-5)
    np.testing.assert_allclose(other.points / scale, metres.points, rtol=1e-4)


def test_online_takes_nothing_from_the_future() -> None:
    """Poses that have left the window are the same, whatever comes later."""
    scene = walk(16, 150, 10)
    changed = scene.tracks.pixels.copy()
    changed[scene.tracks.image >= 13] += 0.7
    later = Tracks(scene.tracks.image, scene.tracks.point, changed, 16, 150)
    start = scene.T[:4]
    one, two = (adjust_online(t, scene.camera, start, window=4, noise_px=0.5) for t in (scene.tracks, later))
    np.testing.assert_array_equal(one.T_camera_world[:9], two.T_camera_world[:9])
    np.testing.assert_array_equal(one.T_at_arrival[:13], two.T_at_arrival[:13])
    assert np.abs(one.T_camera_world[13:] - two.T_camera_world[13:]).max() > 1e-5


def test_what_cannot_be_placed_online_is_refused() -> None:
    scene = walk(12, 150, 10)
    gap = scene.tracks.keep((scene.tracks.image != 8) | (np.arange(len(scene.tracks)) % 40 == 0))
    few = gap.keep((gap.image != 8) | (np.cumsum(gap.image == 8) <= 2))
    with pytest.raises(ValueError, match="in image 8"):
        adjust_online(few, scene.camera, scene.T[:4], noise_px=0.5)
    with pytest.raises(ValueError, match="window of at least two"):
        adjust_online(scene.tracks, scene.camera, scene.T[:4], window=1)
    with pytest.raises(ValueError, match="T_start"):
        adjust_online(scene.tracks, scene.camera, scene.T[:1])


@pytest.mark.parametrize("wrong", ["lens", *to_validate("noise", "tracks")])
def test_a_misfit_is_told(wrong: str) -> None:
    """A noise stated ten times too small, a focal length twice too long, most observations wrong."""
    scene = around(5, 60)
    pixels, camera = scene.tracks.pixels.copy(), scene.camera
    if wrong == "lens":
        camera = replace(camera, fx=2 * camera.fx, fy=2 * camera.fy)
    if wrong == "tracks":
        random = np.random.default_rng(0)
        bad = random.random(len(pixels)) < 0.6
        pixels[bad] = random.uniform(0, 960, (bad.sum(), 2))
    tracks = Tracks(scene.tracks.image, scene.tracks.point, pixels, 5, 60)
    with pytest.warns(RangesimWarning, match="noise_px or the lens is stated wrongly, or most tracks are wrong"):
        structure_from_motion(tracks, camera, noise_px=0.05 if wrong == "noise" else 0.5)


@pytest.mark.validation
def test_a_lens_off_by_two_per_cent_bends_the_shape_little_and_shows_in_the_noise() -> None:
    scene = around(6, 100)
    camera = replace(scene.camera, fx=1.02 * scene.camera.fx, fy=1.02 * scene.camera.fy)
    found = structure_from_motion(scene.tracks, camera, noise_px=0.5)
    assert np.sqrt(((aligned(found.points, scene.X) - scene.X) ** 2).sum(axis=1).mean()) < 0.01
    assert found.noise_px > 0.52
    points, T = found.points, found.T_camera_world
    freed = bundle_adjust(scene.tracks, camera, T, points, free=["fx", "fy"])
    assert abs(freed.camera.fx - scene.camera.fx) < 4 * freed.lens_deviations[0]
    assert freed.noise_px == pytest.approx(0.5, rel=0.08)
