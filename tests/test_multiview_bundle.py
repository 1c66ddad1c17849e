# SPDX-License-Identifier: Apache-2.0
"""Tracks, triangulation and bundle adjustment: against SciPy with OpenCV's projection, and the Cramer-Rao bound."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_scenes import cramer_rao
from many_views import Scene, aligned, around, perturbed
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tiers import to_validate

from rangesim.errors import RangesimWarning
from rangesim.geometry import calibration_matrix, projection_matrix, triangulate_optimal
from rangesim.geometry.reprojection import moved_pose
from rangesim.multiview import Tracks, bundle_adjust, triangulate_many
from rangesim.rig import Intrinsics, look_at


def test_dense_and_sparse_tracks_are_the_same() -> None:
    dense = np.random.default_rng(0).uniform(0, 100, (3, 5, 2))
    dense[0, 1] = dense[2, 3] = np.nan
    tracks = Tracks.from_dense(dense)
    np.testing.assert_array_equal(tracks.dense(), dense)
    shuffled = np.random.default_rng(1).permutation(len(tracks))
    again = Tracks(tracks.image[shuffled], tracks.point[shuffled], tracks.pixels[shuffled])
    np.testing.assert_array_equal(again.dense(), dense)
    assert len(tracks) == 13
    assert tracks.images_per_point.tolist() == [3, 2, 3, 2, 3]
    assert tracks.points_per_image.tolist() == [4, 5, 4]
    common = tracks.common(0, 2)
    assert common.point.tolist() == [0, 2, 4]
    np.testing.assert_array_equal(common.second, dense[2, [0, 2, 4]])
    np.testing.assert_array_equal(tracks.of_images([2, 0]).dense(), dense[[2, 0]])


@pytest.mark.parametrize(
    ("image", "point", "pixels", "message"),
    [
        ([0, 0], [1, 1], np.zeros((2, 2)), "at most once"),
        ([0, -1], [0, 1], np.zeros((2, 2)), "numbers of images"),
        ([0.0, 1.0], [0, 1], np.zeros((2, 2)), "integers"),
        ([0, 1], [0, 1], np.full((2, 2), np.inf), "finite"),
        ([0, 1, 2], [0, 1], np.zeros((2, 2)), "integers"),
    ],
)
def test_tracks_that_are_none_are_refused(image: list, point: list, pixels: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Tracks(np.array(image), np.array(point), pixels)


def test_half_a_pixel_coordinate_is_refused() -> None:
    dense = np.zeros((2, 3, 2))
    dense[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match="both coordinates"):
        Tracks.from_dense(dense)
    dense[1, 2] = np.inf
    with pytest.raises(ValueError, match="infinite"):
        Tracks.from_dense(dense)


def small(noise: float = 0.5, seed: int = 0) -> Scene:
    return around(5, 20, fraction=0.8, noise=noise, seed=seed)


@pytest.mark.parametrize("loss", ["cauchy", *to_validate("linear", "huber", "soft_l1")])
def test_the_minimum_is_that_of_scipy(loss: str) -> None:
    """Over camera vectors and points, the first pose held, its residual function written out by OpenCV's projection."""
    scene = small()
    pixels = scene.tracks.pixels.copy()
    pixels[::17] += 20  # wrong ones, for the loss to matter
    tracks = Tracks(scene.tracks.image, scene.tracks.point, pixels, 5, 20)
    T, X = perturbed(scene, 0.005, 0.02, 0.02)
    found = bundle_adjust(tracks, scene.camera, T, X, held=[0], loss=loss, loss_scale_px=1.5)  # type: ignore[arg-type]
    K, lens = calibration_matrix(scene.camera), np.array(scene.camera.coefficients)

    def residuals(vector: np.ndarray) -> np.ndarray:
        poses = np.concatenate([first, vector[:24]]).reshape(5, 6)
        points = vector[24:].reshape(20, 3)
        off = np.empty((len(tracks), 2))
        for i in range(5):
            mine = tracks.image == i
            seen, _ = cv2.projectPoints(points[tracks.point[mine]], poses[i, :3], poses[i, 3:], K, lens)
            off[mine] = seen[:, 0] - tracks.pixels[mine]
        # vectors whose squares are the loss: a smooth problem of plain least squares
        return (off * np.sqrt(rho(off) / (off**2).sum(axis=1))[:, None]).ravel()

    def rho(off: np.ndarray) -> np.ndarray:
        z = (off**2).sum(axis=1) / 1.5**2
        return (
            1.5**2
            * {
                "linear": z,
                "huber": np.where(z <= 1, z, 2 * np.sqrt(z) - 1),
                "cauchy": np.log1p(z),
                "soft_l1": 2 * (np.sqrt(1 + z) - 1),
            }[loss]
        )

    vectors = [np.concatenate([Rotation.from_matrix(P[:3, :3]).as_rotvec(), P[:3, 3]]) for P in T]
    first = vectors[0]
    start = np.concatenate([*vectors[1:], X.ravel()])
    other = least_squares(residuals, start, x_scale="jac", ftol=1e-10, xtol=1e-10, gtol=1e-10)
    assert rho(found.residuals_px).sum() == pytest.approx(2 * other.cost, rel=1e-6)
    np.testing.assert_allclose(aligned(found.points, scene.X), aligned(other.x[24:].reshape(20, 3), scene.X), atol=3e-4)


def test_without_noise_it_ends_at_the_truth_in_the_gauge_of_the_start() -> None:
    scene = small(noise=0.0)
    T, X = perturbed(scene, 0.01, 0.03, 0.05)
    found = bundle_adjust(scene.tracks, scene.camera, T, X)
    assert found.has_converged
    assert found.rms_px < 1e-6
    np.testing.assert_allclose(aligned(found.points, scene.X), scene.X, atol=1e-8)
    np.testing.assert_allclose(found.T_camera_world[0], T[0], atol=1e-12)  # the first camera stays
    place = -np.einsum("nji,nj->ni", found.T_camera_world[:, :3, :3], found.T_camera_world[:, :3, 3])
    start = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    far = np.argmax(np.linalg.norm(start - start[0], axis=1))
    assert np.linalg.norm(place[far] - place[0]) == pytest.approx(np.linalg.norm(start[far] - start[0]))


def test_the_covariance_is_the_cramer_rao_bound_by_numerical_derivatives() -> None:
    """Of the rotations, the first pose and the scale held by the gauge."""
    scene = small(noise=0.0)
    found = bundle_adjust(scene.tracks, scene.camera, scene.T, scene.X, noise_px=0.5)
    tracks = scene.tracks

    def predict(vector: np.ndarray) -> np.ndarray:
        steps = vector - 1  # the derivative's steps are relative
        T = np.concatenate([scene.T[:1], moved_pose(scene.T[1:], steps[:24].reshape(4, 6))])
        X = scene.X + steps[24:].reshape(-1, 3)
        seen = np.einsum("mab,mb->ma", T[tracks.image, :3, :3], X[tracks.point]) + T[tracks.image, :3, 3]
        return scene.camera.project(seen).ravel()

    bound = cramer_rao(predict, lambda v: v[:24].reshape(4, 6)[:, :3].ravel(), np.ones(24 + 60), 0.5)
    mine = np.stack([np.diag(C)[:3] for C in found.covariance[1:]]).ravel()
    np.testing.assert_allclose(mine, np.diag(bound), rtol=1e-4)
    np.testing.assert_array_equal(found.covariance[0], 0)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    squares = []
    for seed in range(25):
        scene = around(6, 40, seed=seed)
        found = bundle_adjust(scene.tracks, scene.camera, scene.T, scene.X, noise_px=0.5)
        turned = found.T_camera_world[:, :3, :3] @ np.swapaxes(scene.T[:, :3, :3], 1, 2)
        for vector, C in zip(Rotation.from_matrix(turned[1:]).as_rotvec(), found.covariance[1:], strict=True):
            squares.append(vector @ np.linalg.solve(C[:3, :3], vector) / 3)
    assert 0.8 < np.mean(squares) < 1.2


@pytest.mark.validation
def test_a_shared_lens_is_found_with_its_deviation() -> None:
    scene = around(8, 120)
    wrong = Intrinsics(1280, 960, 1150, 1160, 650, 470)
    found = bundle_adjust(scene.tracks, wrong, scene.T, scene.X, free=("fx", "fy", "cx", "cy", "k1", "k2"))
    truth = scene.camera
    off = np.array([found.camera.fx - truth.fx, found.camera.fy - truth.fy, found.camera.cx - truth.cx])
    assert (np.abs(off) < 4 * found.lens_deviations[:3]).all()
    assert abs(found.camera.distortion[0] + 0.1) < 4 * found.lens_deviations[4] < 0.15
    assert found.noise_px == pytest.approx(0.5, rel=0.1)


def test_a_robust_loss_withstands_wrong_observations() -> None:
    scene = around(8, 80)
    pixels = scene.tracks.pixels.copy()
    bad = np.random.default_rng(0).random(len(pixels)) < 0.05
    pixels[bad] += 80
    tracks = Tracks(scene.tracks.image, scene.tracks.point, pixels, 8, 80)
    plain, robust = (
        bundle_adjust(tracks, scene.camera, scene.T, scene.X, loss=loss)  # type: ignore[arg-type]
        for loss in ("linear", "cauchy")
    )
    of_plain, of_robust = (np.abs(aligned(f.points, scene.X) - scene.X).mean() for f in (plain, robust))
    assert of_robust < 0.1 * of_plain
    assert robust.noise_px == pytest.approx(0.5, rel=0.3)


def test_unknown_points_and_points_in_one_image_are_left_out() -> None:
    scene = small()
    X = scene.X.copy()
    X[3] = np.nan
    lonely = (scene.tracks.point == 4) & (scene.tracks.image != scene.tracks.image[scene.tracks.point == 4][0])
    tracks = scene.tracks.keep(~lonely)
    found = bundle_adjust(tracks, scene.camera, scene.T, X)
    assert np.flatnonzero(np.isnan(found.points[:, 0])).tolist() == [3, 4]
    assert not found.used[np.isin(tracks.point, [3, 4])].any()
    assert np.isfinite(found.residuals_px[found.used]).all()


def test_thousands_of_points_that_nothing_observes_change_nothing() -> None:
    scene = around(6, 60)
    tracks = Tracks(scene.tracks.image, scene.tracks.point + 30_000, scene.tracks.pixels, 6, 60_000)
    X = np.zeros((60_000, 3))
    X[30_000:30_060] = scene.X
    found, plain = bundle_adjust(tracks, scene.camera, scene.T, X), bundle_adjust(scene.tracks, *scene[:3])
    np.testing.assert_allclose(found.points[30_000:30_060], plain.points, atol=1e-9)
    assert np.isnan(found.points[:30_000]).all()


def test_degenerate_bundles_are_refused() -> None:
    scene = around(6, 40)
    T, X, camera, tracks = scene.T, scene.X, scene.camera, scene.tracks
    with pytest.raises(ValueError, match="at least 2 images"):
        bundle_adjust(tracks.of_images([0]), camera, T[:1], X)
    groups = tracks.keep((tracks.image < 3) == (tracks.point < 20))
    with pytest.raises(ValueError, match="2 groups that share no point"):
        bundle_adjust(groups, camera, T, X)
    with pytest.raises(ValueError, match="got none in image 2"):
        bundle_adjust(tracks.keep(tracks.image != 2), camera, T, X)
    few = tracks.keep((tracks.image != 5) | (tracks.point < 2))
    with pytest.raises(ValueError, match="image 5"):
        bundle_adjust(few, camera, T, X)
    with pytest.raises(ValueError, match="behind them"):
        bundle_adjust(tracks, camera, T, X + np.array([20.0, 0, 0]))
    with pytest.raises(ValueError, match="shape"):
        bundle_adjust(tracks, camera, T[:3], X)
    with pytest.raises(ValueError, match="free as different names"):
        bundle_adjust(tracks, camera, T, X, free=("focal",))
    with pytest.raises(ValueError, match="a loss out of"):
        bundle_adjust(tracks, camera, T, X, loss="tukey")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="as many equations as unknowns"):
        bundle_adjust(tracks.of_images([0, 1]).keep(np.arange(8)), camera, T[:2], X)


def test_a_camera_that_only_rotates_has_no_bundle() -> None:
    scene = around(6, 40)
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.03, (6, 3))).as_matrix()
    T = np.stack(
        [np.block([[R @ scene.T[0, :3, :3], (R @ scene.T[0, :3, 3])[:, None]], [np.zeros(3), 1.0]]) for R in turns]
    )
    pixels = np.stack([scene.camera.project(scene.X @ P[:3, :3].T + P[:3, 3]) for P in T])
    tracks = Tracks.from_dense(pixels + np.random.default_rng(1).normal(0, 0.5, pixels.shape))
    with pytest.raises(ValueError, match=r"parallax|only rotates"):
        bundle_adjust(tracks, scene.camera, T, scene.X)


# ------------------------------------------------------------------------------------------- triangulation


def test_two_views_are_triangulated_as_the_optimal_triangulation_does() -> None:
    scene = around(2, 50)
    camera = Intrinsics(1280, 960, 1200, 1205, 640, 480)
    T = np.stack([scene.T[0], moved_pose(scene.T[0], np.array([0.0, 0.3, 0.0, -1.2, 0.1, 0.2]))])
    pixels = np.stack([camera.project(scene.X @ P[:3, :3].T + P[:3, 3]) for P in T])
    pixels += np.random.default_rng(0).normal(0, 1, pixels.shape)
    found = triangulate_many(Tracks.from_dense(pixels), camera, T)
    other = triangulate_optimal(*(projection_matrix(camera, P) for P in T), *pixels)
    np.testing.assert_allclose(found.points, other.points, atol=1e-6)


def test_a_wrong_observation_is_dropped_and_the_point_kept() -> None:
    scene = around(6, 30)
    pixels = scene.tracks.pixels.copy()
    bad = np.arange(0, len(pixels), 13)
    pixels[bad] += 60
    found = triangulate_many(
        Tracks(scene.tracks.image, scene.tracks.point, pixels, 6, 30), scene.camera, scene.T, max_error_px=4.0
    )
    assert not found.agrees[bad].any()
    assert found.agrees.sum() > 0.98 * (len(pixels) - len(bad))
    assert np.linalg.norm(found.points - scene.X, axis=1).max() < 0.02


def test_a_quarter_of_wrong_observations_is_dropped_also_beside_images_without_a_pose() -> None:
    scene = around(24, 40)
    random = np.random.default_rng(2)
    bad = random.random(len(scene.tracks)) < 0.25
    pixels = scene.tracks.pixels.copy()
    pixels[bad] += random.uniform(30, 200, (bad.sum(), 2))
    T = scene.T.copy()
    T[12:] = np.nan
    found = triangulate_many(
        Tracks(scene.tracks.image, scene.tracks.point, pixels, 24, 40), scene.camera, T, max_error_px=4.0
    )
    posed = scene.tracks.image < 12
    assert not found.agrees[bad | ~posed].any()
    assert found.agrees[posed & ~bad].mean() > 0.9
    known = np.isfinite(found.points).all(axis=1)
    assert known.mean() > 0.9
    assert np.linalg.norm(found.points[known] - scene.X[known], axis=1).max() < 0.02


def test_points_whose_rays_are_parallel_are_nowhere() -> None:
    scene = around(2, 10)
    T = np.stack([scene.T[0], scene.T[0]])
    pixels = np.repeat(scene.camera.project(scene.X @ T[0, :3, :3].T + T[0, :3, 3])[None], 2, axis=0)
    pixels += np.random.default_rng(0).normal(0, 0.5, pixels.shape)
    assert np.isnan(triangulate_many(Tracks.from_dense(pixels), scene.camera, T).points).all()


# ------------------------------------------------------------------------------------------- as users come with them


def shifted(T: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Poses with the world's origin moved, so that X + origin is seen as X was."""
    moved = T.copy()
    moved[:, :3, 3] -= T[:, :3, :3] @ origin
    return moved


def test_nothing_depends_on_the_origin_or_the_unit() -> None:
    """Map coordinates (UTM), and millimetres: points, deviations and covariances are those of metres at home."""
    scene, origin = around(6, 60), np.array([500_000.0, 5_400_000.0, 300.0])
    T, X = perturbed(scene, 0.005, 0.02, 0.02)
    home, homes = bundle_adjust(scene.tracks, scene.camera, T, X), triangulate_many(scene.tracks, scene.camera, T)
    map_T = shifted(T, origin)
    there = bundle_adjust(scene.tracks, scene.camera, map_T, X + origin)
    np.testing.assert_allclose(there.points - origin, home.points, atol=1e-6)
    deviations = np.sqrt(np.diagonal(home.covariance[:, :3, :3], axis1=1, axis2=2))
    scale = deviations[:, :, None] * deviations[:, None, :]  # a covariance may be far less, and is rounded as these are
    assert (np.abs(there.covariance - home.covariance)[:, :3, :3] <= 1e-5 * scale + 1e-15).all()
    found = triangulate_many(scene.tracks, scene.camera, map_T)
    np.testing.assert_allclose(found.points - origin, homes.points, atol=1e-6)
    np.testing.assert_allclose(found.deviation, homes.deviation, rtol=1e-6)
    big = T.copy()
    big[:, :3, 3] *= 1000
    large = bundle_adjust(scene.tracks, scene.camera, big, 1000 * X)
    np.testing.assert_allclose(large.points, 1000 * home.points, rtol=1e-6)
    assert large.shape_deviation == pytest.approx(home.shape_deviation, rel=1e-4)


def test_the_shape_is_off_by_the_deviation_stated() -> None:
    """Over many draws of noise, after the best similarity; the median of Rayleigh-like errors lies below the rms."""
    ratios = []
    for seed in range(12):
        scene = around(4, 60, seed=seed)
        found = bundle_adjust(scene.tracks, scene.camera, scene.T, scene.X)
        extent = np.median(np.linalg.norm(scene.X - np.median(scene.X, axis=0), axis=1))
        off = aligned(found.points, scene.X) - scene.X
        ratios.append(np.sqrt(np.median((off**2).sum(axis=1))) / extent / found.shape_deviation)
    assert 0.75 < np.mean(ratios) < 1.1


@pytest.mark.parametrize("baseline", [0.01, 0.5, 2.0])
def test_a_rotating_camera_is_refused_whatever_baseline_it_starts_with(baseline: float) -> None:
    """Noise can be explained by depths, at which the covariance looks well: the F test tells."""
    scene, random = around(6, 60), np.random.default_rng(0)
    T = np.repeat(scene.T[:1], 6, axis=0)
    T[:, :3] = Rotation.from_rotvec(random.normal(0, 0.1, (6, 3))).as_matrix() @ T[:, :3]
    pixels = np.stack([scene.camera.project(scene.X @ P[:3, :3].T + P[:3, 3]) for P in T])
    tracks = Tracks.from_dense(pixels + random.normal(0, 0.5, pixels.shape))
    for seed in range(3):
        moves = np.random.default_rng(seed).normal(0, baseline, (6, 3))
        start = moved_pose(T, np.concatenate([np.zeros((6, 3)), moves], axis=1))
        with pytest.raises(ValueError, match=r"parallax|only rotates|determine the shape"):
            bundle_adjust(tracks, scene.camera, start, scene.X)


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_a_rotation_explains_what_one_saw_and_nothing_else(loss: str) -> None:
    """The sum of squares of the rotations alone is the noise of a camera that rotates, and the F test keeps cameras
    that move by a tenth of a per cent of the distance, beside wrong observations under a robust loss."""
    from rangesim.multiview.bundle_adjustment import _cost_of_rotations

    scene, random = around(6, 200), np.random.default_rng(1)
    T = np.repeat(scene.T[:1], 6, axis=0)
    T[:, :3] = Rotation.from_rotvec(random.normal(0, 0.05, (6, 3))).as_matrix() @ T[:, :3]

    def seen(T: np.ndarray) -> np.ndarray:
        pixels = np.stack([scene.camera.project(scene.X @ P[:3, :3].T + P[:3, 3]) for P in T])
        return pixels + random.normal(0, 0.5, pixels.shape)

    cost = _cost_of_rotations(scene.camera, T, Tracks.from_dense(seen(T)))
    assert cost / 0.25 == pytest.approx(2 * 6 * 200 - 3 * 6 - 2 * 200 + 3, rel=0.1)
    T[:, :3, 3] += random.normal(0, 0.15, (6, 3))
    pixels = seen(T)
    if loss == "cauchy":
        pixels[random.random((6, 200)) < 0.05] += 60
    found = bundle_adjust(Tracks.from_dense(pixels), scene.camera, T, scene.X, loss=loss)  # type: ignore[arg-type]
    assert np.isfinite(found.points).all()


@pytest.mark.validation
def test_a_narrow_lens_that_sees_no_shape_is_refused() -> None:
    """One degree of view over one degree of an arc: relief and turning are told apart by perspective alone."""
    random = np.random.default_rng(0)
    X = random.uniform(-1, 1, (100, 3))
    lens = Intrinsics(1280, 960, 73_000, 73_000, 640, 480)

    def adjusted(half: float, seed: int) -> float:
        angles = np.linspace(-half, half, 6)
        T = np.stack([np.linalg.inv(look_at((200 * np.cos(a), 200 * np.sin(a), 20), (0, 0, 0))) for a in angles])
        pixels = np.stack([lens.project(X @ P[:3, :3].T + P[:3, 3]) for P in T])
        tracks = Tracks.from_dense(pixels + np.random.default_rng(seed).normal(0, 0.5, pixels.shape))
        return bundle_adjust(tracks, lens, T, X).shape_deviation

    assert adjusted(0.5, 0) < 0.01
    for seed in range(3):
        with pytest.raises(ValueError, match=r"determine the shape"):
            adjusted(0.01, seed)  # 1.1 degrees in all


def test_a_descent_that_was_cut_short_says_so() -> None:
    scene = around(6, 60)
    with pytest.warns(RangesimWarning, match="still lowers the cost"):
        found = bundle_adjust(scene.tracks, scene.camera, *perturbed(scene, 0.02, 0.05, 0.1), max_steps=1)
    assert not found.has_converged


def test_poses_and_images_that_are_none_are_refused() -> None:
    scene = small()
    for wrong in (scene.T * 1.3, scene.T @ np.diag([1, 1, -1, 1.0])):
        with pytest.raises(ValueError, match=r"T_camera_world\[\d+\] to be rigid"):
            bundle_adjust(scene.tracks, scene.camera, wrong, scene.X)
        with pytest.raises(ValueError, match=r"T_camera_world\[\d+\] to be rigid"):
            triangulate_many(scene.tracks, scene.camera, wrong)
    for images, message in (
        ([0, 0, 1], "different images"),
        ([-1], "0 to 4"),
        ([9], "0 to 4"),
        ([0.5, 1.2], "integers"),
    ):
        with pytest.raises(ValueError, match=message):
            scene.tracks.of_images(images)
    with pytest.raises(ValueError, match="0 to 4"):
        scene.tracks.common(0, 9)
    with pytest.raises(ValueError, match="held"):
        bundle_adjust(scene.tracks, scene.camera, scene.T, scene.X, held=[0.5])  # type: ignore[list-item]


def test_what_is_masked_is_not_seen() -> None:
    pixels = np.random.default_rng(0).integers(0, 100, (3, 5, 2))
    hidden = np.zeros(pixels.shape, dtype=bool)
    hidden[1, 2] = True
    tracks = Tracks.from_dense(np.ma.masked_array(pixels, hidden))
    assert len(tracks) == 14
    assert not tracks.seen()[1, 2]
    np.testing.assert_array_equal(tracks.dense()[0], pixels[0])
