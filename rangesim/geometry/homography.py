# SPDX-License-Identifier: Apache-2.0
"""Homographies x' = H x from corresponding points: linear, of maximum likelihood, robust; with covariance.

Each pair gives two equations, x' cross H x = 0, and H has 8 degrees of freedom: four pairs with no three collinear.
Hartley, Zisserman: "Multiple View Geometry in Computer Vision", 2nd edition 2004 (HZ), chapters 4 and 5.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rangesim.geometry import consensus
from rangesim.geometry.correspondences import (
    ROUNDING,
    Array,
    apply_similarity,
    check_noise,
    checked_array,
    checked_pairs,
    covariance_of_unit_norm,
    normalising_transform,
    right_singular_vectors,
    unit_norm,
)
from rangesim.geometry.least_squares import Minimum, minimise

PARAMETERS = 8
COLLINEAR = 1e-7
"""Distance from a line, relative to the spread of the points, that is rounding."""
Noisy = Literal["second", "both"]


@dataclass(frozen=True, eq=False)
class Homography:
    """A homography x' = H x and how well it is known.

    matrix : (3, 3) float64, Frobenius norm 1, determinant positive. covariance : (9, 9) float64 of `matrix`, row by
    row, rank 8 (its scale is fixed); NaN if the noise is unknown. noise_px : standard deviation of one coordinate of
    the points, as given, or as the residuals say; NaN with four pairs, which leave none. inliers : (n,) bool.
    """

    matrix: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray

    def transfer_covariance(self, points: ArrayLike) -> Array:
        """(n, 2, 2) covariance in px^2 of where `points` (n, 2) are mapped to, by the uncertainty of H alone (HZ
        5.12)."""
        first = checked_array("points", points, None, 2)
        _, by_matrix, _ = _transfer(self.matrix, first)
        return np.asarray(by_matrix @ self.covariance @ np.swapaxes(by_matrix, -1, -2))


def homography_dlt(first: ArrayLike, second: ArrayLike) -> Array:
    """(..., 3, 3) homographies of unit norm by the normalised direct linear transform (HZ algorithm 4.2), batched.

    Minimises |A h| with two rows of A for each pair, in coordinates with mean distance sqrt(2) from the centroid.

    Parameters
    ----------
    first, second : (..., n, 2) corresponding points, n >= 4.

    Raises
    ------
    ValueError
        Fewer than four pairs, NaN, or a set that does not determine H: repeated points, three of four collinear.
    """
    a, b = checked_array("first", first, None, 2), checked_array("second", second, None, 2)
    if a.shape != b.shape:
        raise ValueError(f"expected first and second as corresponding points (..., n, 2), got {a.shape} and {b.shape}.")
    if a.shape[-2] < 4:
        raise ValueError(
            "expected at least 4 pairs of points for a homography, two equations each for 8 degrees of freedom, got "
            f"{a.shape[-2]}."
        )
    from_a, from_b = normalising_transform(a), normalising_transform(b)
    h, values = _null_vector(apply_similarity(from_a, a), apply_similarity(from_b, b))
    # rank 8, and a map of the plane onto the plane
    weak = (values[..., 7] <= ROUNDING * values[..., 0]) | (np.abs(np.linalg.det(h)) <= ROUNDING)
    if np.any(weak):
        where = "" if a.ndim == 2 else f" in {np.count_nonzero(weak)} of {weak.size} sets"
        raise ValueError(f"expected four points with no three collinear in both images, got fewer{where}; add points.")
    return _oriented(np.linalg.inv(from_b) @ h @ from_a)


def fit_homography(
    first: ArrayLike, second: ArrayLike, *, noisy: Noisy = "both", noise_px: float | None = None
) -> Homography:
    """The homography of maximum likelihood for Gaussian noise, all pairs being right, and its covariance.

    "second": minimises the transfer error sum |x' - H x|^2, for exact points `first` such as those of a printed board.
    "both": noise in both images; minimises sum e^T (I + A A^T)^-1 e with e = x' - H x and A = d(H x)/dx, which is
    Sampson's first-order form of the reprojection error (HZ 4.2.6). Levenberg-Marquardt from `homography_dlt`, over
    the 8 dimensions that a matrix of unit norm has. The covariance is noise^2 (J^T J)^-1, taken to the 9 entries.

    Parameters
    ----------
    first, second : (n, 2) pixels, n >= 4.
    noise_px : standard deviation of one coordinate; None: from the residuals, which takes five pairs.

    Raises
    ------
    ValueError
        As `homography_dlt`; or all points but one lie on a line to their noise; or the residuals are over three times
        the stated noise.
    """
    a, b = checked_pairs(first, second, 4, "a homography")
    check_noise(noise_px)
    if noisy not in ("second", "both"):
        raise ValueError(f"expected noisy to be 'second' or 'both', got {noisy!r}.")
    for name, points in (("first", a), ("second", b)):
        _refuse_collinear(name, points, 0.0)
    from_a, from_b = normalising_transform(a), normalising_transform(b)
    start = from_b @ homography_dlt(a, b) @ np.linalg.inv(from_a)
    found = _maximum_likelihood(
        start, apply_similarity(from_a, a), apply_similarity(from_b, b), from_b[0, 0] / from_a[0, 0], noisy
    )
    scale = from_b[0, 0]  # normalised units per pixel of the second image
    consensus.refuse_misfit(found.cost / scale**2, 2 * len(a) - PARAMETERS, noise_px, "a homography")
    noise = found.noise(PARAMETERS) / scale if noise_px is None else noise_px
    to_pixels = np.kron(np.linalg.inv(from_b), from_a.T)  # of row-major vectors: vec(B^-1 H A)
    covariance = np.full((9, 9), np.nan)
    if np.isfinite(noise):
        for name, points in (("first", a), ("second", b)):
            if (name, noisy) != ("first", "second"):
                _refuse_collinear(name, points, float(noise))
        tangent = _tangent(found.state)
        in_tangent = found.covariance(max(noise * scale, 1e-300))
        covariance = covariance_of_unit_norm(found.state, to_pixels, tangent @ in_tangent @ tangent.T)
    matrix = _oriented(np.linalg.inv(from_b) @ found.state @ from_a)
    return Homography(matrix, covariance, float(noise), np.ones(len(a), dtype=bool))


def find_homography(
    first: ArrayLike, second: ArrayLike, noise_px: float = 1.0, *, noisy: Noisy = "both", seed: int = 0
) -> Homography:
    """The homography that most pairs agree with: OpenCV's USAC, then `fit_homography` to its inliers until they stay.

    A pair is an inlier where its error is below the 99 % quantile of its distribution at `noise_px`. `noise_px` of the
    result is that of the inliers. The same seed gives the same result.

    Parameters
    ----------
    first, second : (n, 2) pixels, n >= 5.
    noise_px : standard deviation of one coordinate of a right pair.

    Raises
    ------
    ValueError
        As `fit_homography`, or no more pairs agree than chance would let.
    """
    a, b = checked_pairs(first, second, 5, "a robust homography")
    check_noise(noise_px)
    threshold = consensus.inlier_threshold(noise_px, 2)
    chosen = largest_plane(a, b, noise_px, noisy, seed)
    _refuse_chance(int(chosen.sum()), b, threshold)

    def fit(chosen: np.ndarray) -> Homography:
        return fit_homography(a[chosen], b[chosen], noisy=noisy, noise_px=noise_px)

    def error(model: Homography) -> Array:
        return transfer_error(model.matrix, a, b, noisy)

    model, inliers = consensus.consistent_set(chosen, threshold, fit, error, least=5)
    _refuse_chance(int(inliers.sum()), b, threshold)
    residuals = error(model)[inliers]
    noise = float(np.sqrt(residuals @ residuals / (2 * len(residuals) - PARAMETERS)))
    return replace(model, inliers=inliers, noise_px=noise, covariance=model.covariance * (noise / noise_px) ** 2)


def largest_plane(first: Array, second: Array, noise_px: float, noisy: Noisy = "both", seed: int = 0) -> np.ndarray:
    """(n,) bool: the pairs of the homography that OpenCV's USAC finds most to agree with; none where it finds none."""
    import cv2

    # OpenCV measures in the second image alone, where the noise of both adds up
    threshold = consensus.inlier_threshold(noise_px, 2) * (1.0 if noisy == "second" else np.sqrt(2))
    found, mask = cv2.findHomography(first, second, consensus.usac(threshold, seed))
    return np.zeros(len(first), dtype=bool) if found is None else np.asarray(mask.ravel() > 0)


def transfer_error(H: ArrayLike, first: ArrayLike, second: ArrayLike, noisy: Noisy = "both") -> Array:
    """(n,) pixels: |x' - H x|, or of both points together to their nearest exact pair (Sampson); see
    `fit_homography`."""
    residuals = _residuals(
        checked_array("H", H, 3, 3),
        checked_array("first", first, None, 2),
        checked_array("second", second, None, 2),
        1.0,
        noisy,
    )
    return np.linalg.norm(residuals, axis=-1)


def homography_error(first: Array, second: Array) -> float:
    """Least sum of squared errors in px^2 of any homography between pairs (n, 2) with noise in both views."""
    return nearest_homography(first, second)[1]


def nearest_homography(first: Array, second: Array) -> tuple[Array, float]:
    """(3, 3) the homography of maximum likelihood for noise in both views, of pairs (n, 2) in px that need not
    determine it, and its sum of squared errors in px^2."""
    from_a, from_b = normalising_transform(first), normalising_transform(second)
    a, b = apply_similarity(from_a, first), apply_similarity(from_b, second)
    found = _maximum_likelihood(_null_vector(a, b)[0], a, b, from_b[0, 0] / from_a[0, 0], "both")
    return np.linalg.inv(from_b) @ found.state @ from_a, found.cost / from_b[0, 0] ** 2


def rotation_homography_error(first: Array, second: Array, K_first: Array, K_second: Array) -> float:
    """The same of the homographies K' R K^-1 of cameras that only rotate."""
    inverse = np.linalg.inv(K_first)

    def matrix(R: Rotation) -> Array:
        return np.asarray(K_second @ R.as_matrix() @ inverse)

    def residuals(R: Rotation) -> tuple[Array, Array]:
        h = matrix(R)
        mapped, by_matrix, by_point = _transfer(h, first)
        whitening = _whitening(by_point, 1.0, "both")
        turns = np.cross(np.eye(3)[:, None, :], R.as_matrix().T[None]).transpose(0, 2, 1)
        by_turn = np.stack([(K_second @ turn @ inverse).ravel() for turn in turns], axis=-1)
        values = (whitening @ (second - mapped)[:, :, None])[..., 0]
        return values.ravel(), -(whitening @ by_matrix @ by_turn).reshape(-1, 3)

    def step(R: Rotation, delta: Array) -> Rotation:
        return Rotation.from_rotvec(delta) * R

    rays = [
        np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.linalg.inv(K).T
        for points, K in ((first, K_first), (second, K_second))
    ]
    rays = [directions / np.linalg.norm(directions, axis=1, keepdims=True) for directions in rays]
    with warnings.catch_warnings():  # of collinear rays, of which any rotation will do
        warnings.simplefilter("ignore", UserWarning)
        start, _ = Rotation.align_vectors(rays[1], rays[0])
    return minimise(residuals, step, start).cost


def _refuse_collinear(name: str, points: Array, noise_px: float) -> None:
    """Raise ValueError unless two of the points (n, 2) lie off every line through the others, to their noise.

    One point off a line is no fourth in general position. For each point, the smallest eigenvalue of the scatter of
    the others is the sum of squared distances from their best line; over the variance it follows chi^2 if that is
    noise.
    """
    n, size = len(points), consensus.spread(points)
    unit = (points - points.mean(axis=0)) / size
    scatter = unit.T @ unit - n / (n - 1) * unit[:, :, None] * unit[:, None, :]
    half, product = scatter[:, [0, 1], [0, 1]].sum(-1) / 2, np.linalg.det(scatter)
    least = half - np.sqrt(np.maximum(half**2 - product, 0))
    allowed = (noise_px / size) ** 2 * consensus.chi2_limit(n - 3)
    odd = int(np.argmin(least))
    if least[odd] <= max(allowed, COLLINEAR**2 * n):
        others = np.delete(np.arange(n), odd).tolist()
        which = f"points {others} of {name}" if n == 4 else f"{n - 1} of the {n} points of {name}, or all,"
        raise ValueError(
            f"expected four points with no three collinear, got {which} on one line to their noise of {noise_px:.3g} "
            "px; add points away from it."
        )


def _refuse_chance(agreeing: int, second: Array, threshold: float) -> None:
    area, _ = consensus.bounding_area(second)
    if consensus.agree_by_chance(agreeing, len(second), 4, np.pi * threshold**2 / area):
        raise ValueError(
            f"expected points that a homography maps to each other, got {len(second)} pairs of which at most "
            f"{agreeing} agree, no more than chance; the scene is not a plane, the pairs are wrong, or noise_px is."
        )


def _null_vector(a: Array, b: Array) -> tuple[Array, Array]:
    """(..., 3, 3) least right singular vectors of the design matrices, and their (..., 9) singular values."""
    x, y, u, v = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = [
        np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=-1),
        np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=-1),
    ]
    values, axes = right_singular_vectors(np.concatenate(rows, axis=-2))
    missing = 9 - values.shape[-1]
    if missing > 0:
        values = np.concatenate([values, np.zeros((*values.shape[:-1], missing))], axis=-1)
    return axes[..., 8, :].reshape(*a.shape[:-2], 3, 3), values


def _oriented(h: Array) -> Array:
    """At unit norm, with positive determinant."""
    return np.asarray(unit_norm(h) * np.sign(np.linalg.det(h))[..., None, None])


def _transfer(h: Array, points: Array) -> tuple[Array, Array, Array]:
    """(n, 2) mapped points, (n, 2, 9) their derivatives by the matrix, (n, 2, 2) by the points."""
    xyw = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    image = xyw @ h.T
    mapped = image[:, :2] / image[:, 2:]
    by_image = np.zeros((len(points), 2, 3))
    by_image[:, 0, 0] = by_image[:, 1, 1] = 1 / image[:, 2]
    by_image[:, :, 2] = -mapped / image[:, 2:]
    by_matrix = (by_image[:, :, :, None] * xyw[:, None, None, :]).reshape(len(points), 2, 9)
    return mapped, by_matrix, by_image @ h[:, :2]


def _whitening(by_point: Array, ratio: float, noisy: Noisy) -> Array:
    """(n, 2, 2) L^-1 with L L^T = I + ratio^2 A A^T, the covariance of x' - H x. ratio : of the noises, first /
    second."""
    if noisy == "second":
        return np.broadcast_to(np.eye(2), by_point.shape)
    covariance = np.eye(2) + ratio**2 * by_point @ np.swapaxes(by_point, -1, -2)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _residuals(h: Array, a: Array, b: Array, ratio: float, noisy: Noisy) -> Array:
    mapped, _, by_point = _transfer(h, a)
    return np.asarray((_whitening(by_point, ratio, noisy) @ (b - mapped)[:, :, None])[..., 0])


def _tangent(h: Array) -> Array:
    """(9, 8) orthonormal, orthogonal to the matrix: the directions in which one of unit norm can change."""
    return np.linalg.svd(h.reshape(1, 9))[2][1:].T


def _maximum_likelihood(start: Array, a: Array, b: Array, second_per_first: float, noisy: Noisy) -> Minimum[Array]:
    """In normalised coordinates. second_per_first : how much larger a pixel is there in the second image."""
    ratio = 1 / second_per_first

    def residuals(h: Array) -> tuple[Array, Array]:
        mapped, by_matrix, by_point = _transfer(h, a)
        whitening = _whitening(by_point, ratio, noisy)
        # the derivative of the whitening, a product with small residuals, changes the path and not the end noticeably:
        # the step is that of iteratively reweighted least squares
        values = (whitening @ (b - mapped)[:, :, None])[..., 0]
        return values.ravel(), -(whitening @ by_matrix @ _tangent(h)).reshape(-1, 8)

    def step(h: Array, delta: Array) -> Array:
        return unit_norm(h + (_tangent(h) @ delta).reshape(3, 3))

    return minimise(residuals, step, unit_norm(start))
