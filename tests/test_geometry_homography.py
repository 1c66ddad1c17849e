# SPDX-License-Identifier: Apache-2.0
"""Homographies: OpenCV, scikit-image, the Cramer-Rao bound, and sets of points that do not determine one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_scenes import alike, cramer_rao, efficiency
from scipy import stats
from skimage.transform import ProjectiveTransform

from rangesim.geometry import consensus, find_homography, fit_homography, homography_dlt, map_points, transfer_error

TRUE = np.array([[1.1, 0.1, 30], [-0.05, 0.9, 20], [1e-4, 2e-4, 1]])
UNIT = TRUE / np.linalg.norm(TRUE)
NOISE = 0.5


def pairs(random: np.random.Generator, n: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    a = random.uniform(0, 640, (n, 2))
    b = map_points(TRUE, a)
    return a + random.normal(0, 1, a.shape) * noise, b + random.normal(0, 1, b.shape) * noise


@pytest.mark.parametrize("n", [4, 5, 30])
def test_exact_pairs_give_the_exact_map(n: int) -> None:
    a, b = pairs(np.random.default_rng(0), n)
    for H in (homography_dlt(a, b), fit_homography(a, b).matrix):
        np.testing.assert_allclose(H, UNIT, atol=1e-10)
        assert np.linalg.norm(H) == pytest.approx(1)


def test_two_equations_for_each_pair() -> None:
    """Four pairs determine the 8 degrees of freedom; three pairs leave two of them undetermined."""
    a, b = pairs(np.random.default_rng(1), 4)
    rows = []
    for (x, y), (u, v) in zip(a, b, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    assert [np.linalg.matrix_rank(rows[: 2 * n]) for n in (1, 2, 3, 4)] == [2, 4, 6, 8]
    with pytest.raises(ValueError, match="at least 4 pairs"):
        homography_dlt(a[:3], b[:3])


def test_sets_of_a_batch_are_independent() -> None:
    sets = [pairs(np.random.default_rng(k), 6, NOISE) for k in range(5)]
    a, b = (np.stack([s[k] for s in sets]) for k in (0, 1))
    together = homography_dlt(a, b)
    assert together.shape == (5, 3, 3)
    for one, (x, y) in zip(together, sets, strict=True):
        np.testing.assert_allclose(one, homography_dlt(x, y), atol=1e-12)


def test_it_agrees_with_opencv_and_scikit_image() -> None:
    """OpenCV minimises the error in the second image; scikit-image has the normalised linear method."""
    random = np.random.default_rng(2)
    for _ in range(20):
        a, b = pairs(random, 15, NOISE)
        theirs = alike(cv2.findHomography(a, b)[0], UNIT)
        ours = fit_homography(a, b, noisy="second").matrix
        assert np.abs(map_points(ours, a) - map_points(theirs, a)).max() < 2e-3
        assert transfer_error(ours, a, b, "second") @ transfer_error(ours, a, b, "second") <= (
            transfer_error(theirs, a, b, "second") @ transfer_error(theirs, a, b, "second") * (1 + 1e-9)
        )
        linear = ProjectiveTransform.from_estimate(a, b).params
        np.testing.assert_allclose(homography_dlt(a, b), alike(linear, UNIT), atol=1e-6)


@pytest.mark.validation
@pytest.mark.parametrize("noisy", ["second", "both"])
def test_estimates_reach_the_bound_and_state_their_covariance(noisy) -> None:  # type: ignore[no-untyped-def]
    random, n = np.random.default_rng(3), 20
    a = random.uniform(0, 640, (n, 2))
    b = map_points(TRUE, a)

    def predict(parameters: np.ndarray) -> np.ndarray:
        H, x = parameters[:9].reshape(3, 3), parameters[9:].reshape(-1, 2)
        image = map_points(H, x if noisy == "both" else a)
        return np.concatenate([x.ravel(), image.ravel()]) if noisy == "both" else image.ravel()

    def quantity(parameters: np.ndarray) -> np.ndarray:
        return np.asarray(parameters[:9] / np.linalg.norm(parameters[:9]))

    parameters = np.concatenate([UNIT.ravel(), a.ravel()])
    bound = cramer_rao(predict, quantity, parameters, NOISE)
    fits = []
    for _ in range(200):
        x = a + random.normal(0, NOISE, a.shape) * (noisy == "both")
        fits.append(fit_homography(x, b + random.normal(0, NOISE, b.shape), noisy=noisy))
    errors = np.stack([alike(fit.matrix, UNIT).ravel() - UNIT.ravel() for fit in fits])
    assert 0.8 < efficiency(errors, bound, rank=8) < 1.2
    # and the covariance that comes along is the bound
    assert np.median([fit.noise_px for fit in fits]) == pytest.approx(NOISE, rel=0.05)
    ours = fit_homography(a, b, noisy=noisy, noise_px=NOISE).covariance
    np.testing.assert_allclose(ours, bound, atol=1e-3 * np.abs(bound).max())
    values = np.linalg.eigvalsh(ours / np.sqrt(np.outer(np.diag(ours), np.diag(ours))))
    assert np.count_nonzero(values > 1e-9) == 8


@pytest.mark.validation
def test_transfer_covariance_is_the_scatter_of_mapped_points() -> None:
    random = np.random.default_rng(4)
    at, off, sigma = np.array([(100.0, 300.0)]), [], []
    for _ in range(200):
        fit = fit_homography(*pairs(random, 12, NOISE))
        off.append((map_points(fit.matrix, at) - map_points(TRUE, at))[0])
        sigma.append(fit.transfer_covariance(at)[0])
    np.testing.assert_allclose(np.cov(np.transpose(off)), np.mean(sigma, axis=0), atol=0.35 * np.max(sigma[0]))


@pytest.mark.parametrize("noisy", ["second", "both"])
def test_wrong_pairs_are_left_out(noisy) -> None:  # type: ignore[no-untyped-def]
    random = np.random.default_rng(5)
    a, b = pairs(random, 100)
    a, b = a + random.normal(0, NOISE, a.shape) * (noisy == "both"), b + random.normal(0, NOISE, b.shape)
    b[:50] = random.uniform(0, 640, (50, 2))
    found = find_homography(a, b, NOISE, noisy=noisy)
    assert found.inliers[50:].mean() > 0.9
    assert not found.inliers[:50].any()
    corners = np.array([(0, 0), (640, 0), (640, 640), (0, 640.0)])
    assert np.abs(map_points(found.matrix, corners) - map_points(TRUE, corners)).max() < 1.5
    assert found.noise_px == pytest.approx(NOISE, rel=0.2)
    again = find_homography(a, b, NOISE, noisy=noisy)
    np.testing.assert_array_equal(found.matrix, again.matrix)


LINE = np.stack([np.linspace(0, 600, 8), 0.3 * np.linspace(0, 600, 8) + 10], axis=-1)
SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 1.0)]) * 100


@pytest.mark.parametrize(
    ("first", "message"),
    [
        (SQUARE[:3], "at least 4"),
        (np.array([(0, 0), (1, 0), (2, 0), (0, 1.0)]) * 100, r"points \[0, 1, 2\] of first on one line"),
        (LINE, "7 of the 8 points of first, or all, on one line"),
        (np.concatenate([LINE, [(50, 400)]]), "no three collinear"),
        (SQUARE[[0, 1, 2, 2]], "4 different points.*3 different"),
        (np.repeat(SQUARE[:2], 5, axis=0), "4 different points.*2 different"),
        (np.where(np.arange(8).reshape(4, 2) == 3, np.nan, SQUARE), "1 NaN"),
    ],
)
def test_sets_that_do_not_determine_a_homography_are_refused(first: np.ndarray, message: str) -> None:
    second = np.where(np.isfinite(first), first, 0) @ TRUE[:2, :2].T + 5
    with pytest.raises(ValueError, match=message):
        fit_homography(first, second)
    with pytest.raises(ValueError, match=r"at least 4|no three collinear|1 NaN"):
        homography_dlt(first, second)


def test_the_second_image_may_be_degenerate_too() -> None:
    for fit in (fit_homography, homography_dlt):
        with pytest.raises(ValueError, match="no three collinear"):
            fit(np.random.default_rng(6).uniform(0, 600, (8, 2)), LINE)


@pytest.mark.parametrize("beside", [0, 1])
@pytest.mark.parametrize("known", [True, False])
def test_points_on_a_line_within_their_noise_are_refused(beside: int, known: bool) -> None:
    """They are refused with one point beside the line too; with two there are four in general position."""
    random = np.random.default_rng(7)
    for _ in range(20):
        exact = np.concatenate([LINE, np.array([(100, 400), (500, -300)])[:beside]])
        a, b = (x + random.normal(0, NOISE, x.shape) for x in (exact, map_points(TRUE, exact)))
        with pytest.raises(ValueError, match=r"no three collinear.*on one line within their noise"):
            fit_homography(a, b, noise_px=NOISE if known else None)
    exact = np.concatenate([LINE, [(100, 400), (500, -300)]])
    fit_homography(exact + random.normal(0, NOISE, exact.shape), map_points(TRUE, exact))


def test_random_pairs_are_refused() -> None:
    random = np.random.default_rng(8)
    for n in (6, 40, 200):
        with pytest.raises(ValueError, match="no more than chance"):
            find_homography(random.uniform(0, 640, (n, 2)), random.uniform(0, 640, (n, 2)), NOISE)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noise_px": 0.0}, "noise_px"),
        ({"noise_px": np.nan}, "noise_px"),
        ({"noisy": "first"}, "'second' or 'both'"),
    ],
)
def test_settings_are_checked(arguments: dict, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(ValueError, match=message):
        fit_homography(*pairs(np.random.default_rng(9), 6), **arguments)
    with pytest.raises(ValueError, match="corresponding points"):
        fit_homography(SQUARE, LINE)


@pytest.mark.parametrize("freedom", [0, 1, 2, 7, 400])
def test_limits_of_chance_agree_with_scipy_stats(freedom: int) -> None:
    """Geometry uses scipy.special instead, because the import of scipy.stats takes longer than all of geometry."""
    limits = consensus.chi2_limit(freedom), consensus._f_limit(freedom, 30)
    distributions = stats.chi2(freedom), stats.f(freedom, 30)
    np.testing.assert_allclose(limits, [one.isf(consensus.SIGNIFICANCE) for one in distributions], rtol=1e-9)
