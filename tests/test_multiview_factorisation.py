# SPDX-License-Identifier: Apache-2.0
"""Factorisation: exact without noise, at the Cramer-Rao bound with it, and no answer where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from many_views import around, deforming, observed
from scipy.spatial.transform import Rotation

from rangesim.multiview import Tracks, factorisation, factorise_affine, factorise_orthographic, factorise_projective
from rangesim.rig import Intrinsics

PINHOLE = Intrinsics(1280, 960, 1200, 1205, 640, 480)


def rigid(seed: int, noise: float = 0.0, missing: float = 0.0, scale: bool = False):  # type: ignore[no-untyped-def]
    return deforming(seed, images=8, points=40, basis=1, noise=noise, missing=missing, scale=scale)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_affine_factorisation_without_noise_is_the_singular_value_decomposition(missing: float) -> None:
    true = rigid(0, missing=missing)
    found = factorise_affine(true.tracks)
    np.testing.assert_allclose(
        np.einsum("nar,pr->npa", found.M, found.points) + found.t[:, None], true.exact, atol=1e-9
    )
    matrix = (true.exact - true.exact.mean(axis=1, keepdims=True)).transpose(0, 2, 1).reshape(16, 40)
    if not missing:
        values = np.linalg.svd(matrix, compute_uv=False)[:3] / np.sqrt(8 * 40)
        np.testing.assert_allclose(found.singular_values, values, rtol=1e-10)


def test_a_second_start_confirms_the_minimum_where_observations_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A first descent into a wrong minimum agrees with nothing: another start has to reach its cost."""
    costs = []
    descent = factorisation._affine_descent

    def ends_high_first(*arguments):  # type: ignore[no-untyped-def]
        found, cost = descent(*arguments)
        costs.append(cost + (0 if costs else 1e6))
        return (found, costs[-1]) if len(costs) > 1 else (found._replace(M=0 * found.M), costs[-1])

    monkeypatch.setattr(factorisation, "_affine_descent", ends_high_first)
    true = rigid(0, noise=0.5, missing=0.3)
    found = factorise_affine(true.tracks)
    assert len(costs) == 3  # the wrong one, the right one, and one that agrees with it
    readings = np.einsum("nar,pr->npa", found.M, found.points) + found.t[:, None]
    assert np.abs(readings - true.exact).max() < 5.0  # pixels; ten standard deviations of the noise


@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_orthographic_factorisation_is_exact_up_to_the_reversal(scale: bool, missing: float) -> None:
    true = rigid(1, missing=missing, scale=scale)
    found = factorise_orthographic(true.tracks, has_scale=scale)
    errors = []
    for answer in (found, found.reversed):
        turned = answer.scale[:, None, None] * np.einsum("nab,pb->npa", answer.R_camera_world, answer.points)
        errors.append(np.abs(turned - true.seen).max())
        flat = turned[..., :2] + answer.t[:, None]
        np.testing.assert_allclose(flat[true.tracks.seen()], true.exact[true.tracks.seen()], atol=1e-8)
    assert min(errors) < 1e-8 < 1 < max(errors)
    np.testing.assert_allclose(np.linalg.det(found.R_camera_world), 1)
    np.testing.assert_allclose(found.R_camera_world[0], np.eye(3), atol=1e-12)


@pytest.mark.parametrize(("scale", "missing"), [(False, 0.0), (False, 0.2), (True, 0.2)])
def test_orthographic_factorisation_reaches_the_bound(scale: bool, missing: float) -> None:
    """Of predicted pixels, whose bound is noise^2 times the number of parameters: no gauge touches them."""
    ratios = []
    for seed in range(20):
        true = rigid(seed, 0.5, missing, scale)
        found = factorise_orthographic(true.tracks, has_scale=scale)
        turned = np.einsum("nad,pd->npa", found.R_camera_world[:, :2], found.points)
        off = found.scale[:, None, None] * turned + found.t[:, None] - true.exact
        ratios.append((off[true.tracks.seen()] ** 2).sum() / 0.25 / (8 * (5 + scale) + 3 * 40 - 6 - scale))
    assert 0.8 < np.mean(ratios) < 1.2


@pytest.mark.parametrize(("scale", "missing"), [(False, 0.2), (True, 0.0)])
def test_the_deviation_of_an_orthographic_shape_is_that_of_its_errors(scale: bool, missing: float) -> None:
    off, stated = [], []
    for seed in range(20):
        true = rigid(seed, 0.5, missing, scale)
        found = factorise_orthographic(true.tracks, has_scale=scale)
        first = true.seen[0] - true.seen[0].mean(axis=0)
        off.append(min(((answer.points - first) ** 2).mean() for answer in (found, found.reversed)))
        stated.append((found.shape_deviation_px**2).mean())
    assert 0.7 < np.mean(off) / np.mean(stated) < 1.4


def turned_little(seed: int, turn: float, noise: float) -> tuple[np.ndarray, Tracks]:
    """The points in the frame of the first camera, about their mean, 58 px in each coordinate, and tracks of 8 images
    that turn by `turn` rad in each direction."""
    random = np.random.default_rng(seed)
    X = random.uniform(-100, 100, (40, 3))
    R = Rotation.from_rotvec(random.normal(0, turn, (8, 3))).as_matrix()
    return (X - X.mean(axis=0)) @ R[0].T, tracks_of(R, X, noise)


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_turns_too_small_to_tell_depths_are_refused(noise: float) -> None:
    """Depths of a third or a thousand times the true ones came from these, and no deviation."""
    for seed in range(8):
        _, tracks = turned_little(seed, 0.005, noise)
        with pytest.raises(ValueError, match=r"depths|turn"):
            factorise_orthographic(tracks)


@pytest.mark.parametrize(("turn", "noise"), [(0.005, 1e-4), (0.03, 0.1), (0.05, 0.1), (0.1, 0.5)])
def test_small_turns_tell_depths_within_the_deviation(turn: float, noise: float) -> None:
    for seed in range(8):
        X, tracks = turned_little(seed, turn, noise)
        found = factorise_orthographic(tracks)
        off = min(np.sqrt(((answer.points - X) ** 2).mean()) for answer in (found, found.reversed))
        stated = np.sqrt((found.shape_deviation_px**2).mean())
        assert off < 3 * stated
        assert stated < 0.1 * np.sqrt((X**2).mean())


def projective(seed: int, noise: float, missing: float):  # type: ignore[no-untyped-def]
    scene = around(8, 40, fraction=1 - missing, noise=0.0, seed=seed)
    exact = observed(PINHOLE, scene.T, scene.X)
    dense = exact + np.random.default_rng(seed).normal(0, noise, exact.shape)
    dense[~scene.tracks.seen()] = np.nan
    return exact, Tracks.from_dense(dense)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_projective_factorisation_is_exact_without_noise(missing: float) -> None:
    exact, tracks = projective(0, 0.0, missing)
    found = factorise_projective(tracks)
    np.testing.assert_allclose(found.project(), exact, atol=1e-7)
    depths = np.einsum("nb,pb->np", found.P[:, 2], found.points)
    assert (depths > 0).all()


@pytest.mark.validation
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_projective_factorisation_reaches_the_bound(missing: float) -> None:
    ratios = []
    for seed in range(12):
        exact, tracks = projective(seed, 0.5, missing)
        off = factorise_projective(tracks).project() - exact
        ratios.append((off[tracks.seen()] ** 2).sum() / 0.25 / (11 * 8 + 3 * 40 - 15))
    assert 0.8 < np.mean(ratios) < 1.2


def tracks_of(R: np.ndarray, X: np.ndarray, noise: float) -> Tracks:
    pixels = np.einsum("nad,pd->npa", R[:, :2], X) + 300
    return Tracks.from_dense(pixels + np.random.default_rng(5).normal(0, noise, pixels.shape))


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_degenerate_rigid_motion_is_refused(noise: float) -> None:
    random = np.random.default_rng(0)
    X = random.uniform(-100, 100, (30, 3))
    R = Rotation.random(6, random_state=random).as_matrix()
    with pytest.raises(ValueError, match="plane"):
        factorise_orthographic(tracks_of(R, X * [1, 1, 0], noise))
    with pytest.raises(ValueError, match=r"plane|turn"):
        factorise_orthographic(tracks_of(np.repeat(R[:1], 6, axis=0), X, noise))  # one view again and again
    about_z = Rotation.from_rotvec(np.outer(np.arange(6) * 0.2, [0, 0, 1])).as_matrix()
    with pytest.raises(ValueError, match=r"plane|turn"):
        factorise_orthographic(tracks_of(about_z, X, noise))
    with pytest.raises(ValueError, match="turn"):
        factorise_orthographic(tracks_of(R[[0, 1, 0, 1, 0, 1]], X, noise))  # two views, again and again
    with pytest.raises(ValueError, match="at least 3 images"):
        factorise_orthographic(tracks_of(R[:2], X, noise))
    with pytest.raises(ValueError, match="at least 4 points"):
        factorise_orthographic(tracks_of(R, X[:3], noise))


def test_tracks_without_overlap_and_residuals_over_the_noise_are_refused() -> None:
    true = rigid(2)
    halves = (true.tracks.image < 4) == (true.tracks.point < 20)
    with pytest.raises(ValueError, match="share no point"):
        factorise_affine(true.tracks.keep(halves))
    noisy = rigid(2, noise=5.0)
    with pytest.raises(ValueError, match=r"0\.5 px"):
        factorise_orthographic(noisy.tracks, noise_px=0.5)


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_degenerate_projective_scenes_are_refused(noise: float) -> None:
    scene = around(6, 40, noise=0.0)
    random = np.random.default_rng(0)

    def seen(T: np.ndarray, X: np.ndarray) -> Tracks:
        pixels = observed(PINHOLE, T, X)
        return Tracks.from_dense(pixels + random.normal(0, noise, pixels.shape))

    with pytest.raises(ValueError, match="plane"):
        factorise_projective(seen(scene.T, scene.X * [1, 1, 0.0]))
    turns = Rotation.from_rotvec(random.normal(0, 0.05, (6, 3))).as_matrix()
    T = np.repeat(scene.T[:1], 6, axis=0)
    T[:, :3] = turns @ T[:, :3]
    with pytest.raises(ValueError, match="one place"):
        factorise_projective(seen(T, scene.X))
    with pytest.raises(ValueError, match="at least 7 points"):
        factorise_projective(seen(scene.T, scene.X[:6]))
    with pytest.raises(ValueError, match="one place"):
        factorise_projective(Tracks.from_dense(np.ones((5, 10, 2))))  # all points in one
    with pytest.raises(ValueError, match="at least 2 images"):
        factorise_projective(seen(scene.T[:1], scene.X))
