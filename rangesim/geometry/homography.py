# SPDX-License-Identifier: Apache-2.0
"""Homographies x' = H x from corresponding points: linear, maximum-likelihood and robust estimates, with covariance.

Each pair gives two equations, x' cross H x = 0, and H has 8 degrees of freedom. So four pairs with no three collinear
points determine H. Source: Hartley, Zisserman: "Multiple View Geometry in Computer Vision", 2nd edition 2004 (HZ),
chapters 4 and 5.

Used by: rangesim.geometry.two_view; rangesim.calibration.rig_calibration and zhang.
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

HOMOGRAPHY_PARAMETERS = 8
"""Number of degrees of freedom of a homography: 9 entries of H less its scale; source: HZ table 2.4."""

COLLINEAR_FRACTION = 1e-7
"""Distance from a line, as a fraction of the spread of the points, up to which a point without noise lies on it. It is
far above the rounding of pixels in double precision, 1e-16, and far below any noise of measured points, which is tested
by chi^2 instead."""

Noisy = Literal["second", "both"]
"""The images whose points have noise."""


@dataclass(frozen=True, eq=False)
class Homography:
    """A homography x' = H x, with its covariance.

    Attributes
    ----------
    matrix : (3, 3) float64, H with Frobenius norm 1 and positive determinant.
    covariance : (9, 9) float64, covariance of the entries of `matrix`, row by row; rank 8, because its norm is fixed.
        NaN if the noise is unknown.
    noise_px : standard deviation of one coordinate of the points, given or estimated from the residuals. NaN with four
        pairs, because they leave no residuals.
    inliers : (n,) bool, the pairs that agree with H.

    Examples
    --------
    >>> found = fit_homography([[0, 0], [9, 0], [9, 9], [0, 9]], [[1, 2], [19, 2], [19, 20], [1, 20]], noise_px=0.1)
    >>> (found.matrix / found.matrix[2, 2]).round(6) + 0.0
    array([[2., 0., 1.],
           [0., 2., 2.],
           [0., 0., 1.]])
    """

    matrix: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray

    def transfer_covariance(self, points: ArrayLike) -> Array:
        """(n, 2, 2) float64 covariance in px^2 of the images of `points` (n, 2) due to the covariance of H (HZ 5.12).

        The noise of the points themselves is not included.
        """
        first = checked_array("points", points, None, 2)
        _, by_matrix, _ = _transfer(self.matrix, first)
        return np.asarray(by_matrix @ self.covariance @ np.swapaxes(by_matrix, -1, -2))


def homography_dlt(first: ArrayLike, second: ArrayLike) -> Array:
    """(..., 3, 3) float64 homographies of unit norm by the normalised direct linear transform (HZ algorithm 4.2).

    It minimises |A h|, where each pair gives two rows of A, in coordinates whose mean distance from the centroid is
    sqrt(2). Leading dimensions are a batch of independent sets.

    Parameters
    ----------
    first, second : (..., n, 2) corresponding points, n >= 4.

    Raises
    ------
    ValueError
        There are fewer than four pairs, a coordinate is NaN, or a set does not determine H: points are repeated, or
        three of four are collinear.

    Examples
    --------
    >>> H = homography_dlt([[0, 0], [9, 0], [9, 9], [0, 9]], [[1, 2], [19, 2], [19, 20], [1, 20]])
    >>> (H / H[2, 2]).round(6) + 0.0
    array([[2., 0., 1.],
           [0., 2., 2.],
           [0., 0., 1.]])
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
    # H must be determined (rank 8 of A) and map the plane onto the whole plane (rank 3 of H)
    weak = (values[..., 7] <= ROUNDING * values[..., 0]) | (np.abs(np.linalg.det(h)) <= ROUNDING)
    if np.any(weak):
        where = "" if a.ndim == 2 else f" in {np.count_nonzero(weak)} of {weak.size} sets"
        raise ValueError(f"expected four points with no three collinear in both images, got fewer{where}; add points.")
    return _oriented(np.linalg.inv(from_b) @ h @ from_a)


def fit_homography(
    first: ArrayLike, second: ArrayLike, *, noisy: Noisy = "both", noise_px: float | None = None
) -> Homography:
    """The maximum-likelihood homography for Gaussian noise, with its covariance; all pairs must be correct.

    It starts from `homography_dlt` and descends by Levenberg-Marquardt over the 8 dimensions of matrices of unit norm.
    The covariance is noise^2 (J^T J)^-1, converted to the 9 entries.

    Parameters
    ----------
    first, second : (n, 2) corresponding points in pixels, n >= 4.
    noisy : "second" if the points `first` are exact, such as those of a printed board. It minimises the transfer error
        sum |x' - H x|^2. "both" if both images have noise of the same size. It minimises
        sum e^T (I + A A^T)^-1 e with e = x' - H x and A = d(H x)/dx, which is Sampson's first-order form of the
        reprojection error (HZ 4.2.6).
    noise_px : standard deviation of one coordinate; None estimates it from the residuals, which needs five pairs.

    Raises
    ------
    ValueError
        `homography_dlt` refuses the pairs; or all points, or all but one, lie on a line within their noise; or the
        residuals are over three times the stated noise.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import map_points
    >>> board = np.array([[x, y] for x in range(5) for y in range(4)])  # exact, in metres
    >>> pixels = map_points([[90, 5, 200], [-4, 88, 150], [0.01, 0.02, 1]], board)
    >>> found = fit_homography(board, pixels, noisy="second", noise_px=0.1)
    >>> bool(transfer_error(found.matrix, board, pixels, "second").max() < 1e-6)
    True
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
    consensus.refuse_misfit(found.cost / scale**2, 2 * len(a) - HOMOGRAPHY_PARAMETERS, noise_px, "a homography")
    noise = found.noise(HOMOGRAPHY_PARAMETERS) / scale if noise_px is None else noise_px
    to_pixels = np.kron(np.linalg.inv(from_b), from_a.T)  # vec(B^-1 H A) of row-major vectors
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
    """The homography that most pairs agree with, although some pairs are wrong; with its covariance.

    OpenCV's USAC proposes inliers. `fit_homography` is then fitted to the inliers, and the inliers are chosen again,
    until they no longer change. A pair is an inlier if its error is below the 99 % quantile of the errors that
    `noise_px` causes. The `noise_px` of the result is estimated from the inliers. The same seed gives the same result.

    Parameters
    ----------
    first, second : (n, 2) corresponding points in pixels, n >= 5.
    noise_px : standard deviation of one coordinate of a correct pair.
    noisy : the images whose points have noise, as for `fit_homography`.
    seed : state of the random numbers that USAC draws samples with.

    Raises
    ------
    ValueError
        `fit_homography` refuses the inliers, or no more pairs agree than chance explains.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import map_points
    >>> random = np.random.default_rng(0)
    >>> first = random.uniform(0, 640, (60, 2))
    >>> second = map_points([[1.1, 0.1, 5], [-0.05, 0.9, 8], [1e-4, 0, 1]], first) + random.normal(0, 0.5, (60, 2))
    >>> second[:15] = random.uniform(0, 640, (15, 2))  # wrong pairs
    >>> int(find_homography(first, second, noise_px=0.5).inliers[:15].sum())
    0
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
    noise = float(np.sqrt(residuals @ residuals / (2 * len(residuals) - HOMOGRAPHY_PARAMETERS)))
    return replace(model, inliers=inliers, noise_px=noise, covariance=model.covariance * (noise / noise_px) ** 2)


def largest_plane(first: Array, second: Array, noise_px: float, noisy: Noisy = "both", seed: int = 0) -> np.ndarray:
    """(n,) bool, the pairs that agree with the homography that OpenCV's USAC finds; all False if it finds none."""
    import cv2

    # OpenCV measures errors in the second image alone, where the noise of both images adds up
    threshold = consensus.inlier_threshold(noise_px, 2) * (1.0 if noisy == "second" else np.sqrt(2))
    found, mask = cv2.findHomography(first, second, consensus.usac(threshold, seed))
    return np.zeros(len(first), dtype=bool) if found is None else np.asarray(mask.ravel() > 0)


def transfer_error(H: ArrayLike, first: ArrayLike, second: ArrayLike, noisy: Noisy = "both") -> Array:
    """(n,) float64 errors of pairs under a homography, pixels.

    For "second" the error is |x' - H x|. For "both" it is, to first order, the distance of the pair (x, x') from the
    nearest pair that H maps exactly (Sampson); see `fit_homography`.

    Parameters
    ----------
    H : (3, 3), x' = H x; any multiple is the same homography.
    first, second : (n, 2) corresponding points in pixels.
    noisy : "second" or "both".

    Examples
    --------
    >>> import numpy as np
    >>> transfer_error(np.eye(3), [[10, 20]], [[13, 24]], "second")
    array([5.])
    """
    residuals = _residuals(
        checked_array("H", H, 3, 3),
        checked_array("first", first, None, 2),
        checked_array("second", second, None, 2),
        1.0,
        noisy,
    )
    return np.linalg.norm(residuals, axis=-1)


def homography_error(first: Array, second: Array) -> float:
    """The least sum of squared errors, in px^2, of any homography between pairs (n, 2) with noise in both views."""
    return nearest_homography(first, second)[1]


def nearest_homography(first: Array, second: Array) -> tuple[Array, float]:
    """(3, 3) float64 homography of maximum likelihood for noise in both views, and its sum of squared errors in px^2.

    The pairs (n, 2) in pixels need not determine the homography: one of those that fit best is returned.
    """
    from_a, from_b = normalising_transform(first), normalising_transform(second)
    a, b = apply_similarity(from_a, first), apply_similarity(from_b, second)
    found = _maximum_likelihood(_null_vector(a, b)[0], a, b, from_b[0, 0] / from_a[0, 0], "both")
    return np.linalg.inv(from_b) @ found.state @ from_a, found.cost / from_b[0, 0] ** 2


def rotation_homography_error(first: Array, second: Array, K_first: Array, K_second: Array) -> float:
    """The least sum of squared errors, in px^2, of the homographies K' R K^-1 of a camera that only rotates.

    Parameters
    ----------
    first, second : (n, 2) pixels with noise in both views.
    K_first, K_second : (3, 3) calibration matrices K and K', pixels.
    """
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
    with warnings.catch_warnings():  # SciPy warns of collinear rays; any of their rotations will do as a start
        warnings.simplefilter("ignore", UserWarning)
        start, _ = Rotation.align_vectors(rays[1], rays[0])
    return minimise(residuals, step, start).cost


def _refuse_collinear(name: str, points: Array, noise_px: float) -> None:
    """Raise ValueError if all points (n, 2), or all but one, lie on a line within their noise.

    A homography needs four points with no three collinear, so one point beside a line is not enough. Each point is
    left out in turn. The smaller eigenvalue of the scatter of the others is the sum of their squared distances from
    their best line; divided by the variance of the noise, it follows chi^2 if these distances are noise.
    """
    n, size = len(points), consensus.spread(points)
    unit = (points - points.mean(axis=0)) / size
    scatter = unit.T @ unit - n / (n - 1) * unit[:, :, None] * unit[:, None, :]
    half, product = scatter[:, [0, 1], [0, 1]].sum(-1) / 2, np.linalg.det(scatter)
    least = half - np.sqrt(np.maximum(half**2 - product, 0))
    allowed = (noise_px / size) ** 2 * consensus.chi2_limit(n - 3)
    odd = int(np.argmin(least))
    if least[odd] <= max(allowed, COLLINEAR_FRACTION**2 * n):
        others = np.delete(np.arange(n), odd).tolist()
        which = f"points {others} of {name}" if n == 4 else f"{n - 1} of the {n} points of {name}, or all,"
        raise ValueError(
            f"expected four points with no three collinear, got {which} on one line within their noise of "
            f"{noise_px:.3g} px; add points away from it."
        )


def _refuse_chance(agreeing: int, second: Array, threshold: float) -> None:
    """Raise ValueError if no more pairs agree with a homography, within `threshold` pixels, than chance explains."""
    area, _ = consensus.bounding_area(second)
    if consensus.agree_by_chance(agreeing, len(second), 4, np.pi * threshold**2 / area):
        raise ValueError(
            f"expected points that a homography maps to each other, got {len(second)} pairs of which at most "
            f"{agreeing} agree, no more than chance; the scene is not a plane, or the pairs or noise_px are wrong."
        )


def _null_vector(a: Array, b: Array) -> tuple[Array, Array]:
    """(..., 3, 3) right singular vectors of the least singular value of the design matrices, and all (..., 9) values.

    The design matrix of the points a, b (..., n, 2) has two rows per pair. Singular values are sorted, largest first.
    """
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
    """Homographies (..., 3, 3) scaled to unit norm and positive determinant."""
    return np.asarray(unit_norm(h) * np.sign(np.linalg.det(h))[..., None, None])


def _transfer(h: Array, points: Array) -> tuple[Array, Array, Array]:
    """(n, 2) images of points (n, 2), with their derivatives (n, 2, 9) by the matrix and (n, 2, 2) by the points."""
    xyw = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    image = xyw @ h.T
    mapped = image[:, :2] / image[:, 2:]
    by_image = np.zeros((len(points), 2, 3))
    by_image[:, 0, 0] = by_image[:, 1, 1] = 1 / image[:, 2]
    by_image[:, :, 2] = -mapped / image[:, 2:]
    by_matrix = (by_image[:, :, :, None] * xyw[:, None, None, :]).reshape(len(points), 2, 9)
    return mapped, by_matrix, by_image @ h[:, :2]


def _whitening(by_point: Array, ratio: float, noisy: Noisy) -> Array:
    """(n, 2, 2) matrices L^-1 that whiten x' - H x, whose covariance is L L^T = I + ratio^2 A A^T.

    Parameters
    ----------
    by_point : (n, 2, 2) A, derivatives of H x by x.
    ratio : noise of the first image over noise of the second.
    """
    if noisy == "second":
        return np.broadcast_to(np.eye(2), by_point.shape)
    covariance = np.eye(2) + ratio**2 * by_point @ np.swapaxes(by_point, -1, -2)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _residuals(h: Array, a: Array, b: Array, ratio: float, noisy: Noisy) -> Array:
    """(n, 2) whitened residuals of pairs a, b (n, 2) under the homography h; see `_whitening`."""
    mapped, _, by_point = _transfer(h, a)
    return np.asarray((_whitening(by_point, ratio, noisy) @ (b - mapped)[:, :, None])[..., 0])


def _tangent(h: Array) -> Array:
    """(9, 8) orthonormal directions, orthogonal to h (3, 3), in which a matrix of unit norm can change."""
    return np.linalg.svd(h.reshape(1, 9))[2][1:].T


def _maximum_likelihood(start: Array, a: Array, b: Array, second_per_first: float, noisy: Noisy) -> Minimum[Array]:
    """The maximum-likelihood homography of pairs a, b (n, 2) in normalised coordinates, by descent from `start` (3, 3).

    Parameters
    ----------
    second_per_first : size of a pixel of the second image divided by that of the first, in normalised coordinates.
    """
    ratio = 1 / second_per_first

    def residuals(h: Array) -> tuple[Array, Array]:
        mapped, by_matrix, by_point = _transfer(h, a)
        whitening = _whitening(by_point, ratio, noisy)
        # The derivative of the whitening is left out, as in iteratively reweighted least squares. It is multiplied by
        # small residuals, so it changes the path of the descent but hardly its end.
        values = (whitening @ (b - mapped)[:, :, None])[..., 0]
        return values.ravel(), -(whitening @ by_matrix @ _tangent(h)).reshape(-1, 8)

    def step(h: Array, delta: Array) -> Array:
        return unit_norm(h + (_tangent(h) @ delta).reshape(3, 3))

    return minimise(residuals, step, unit_norm(start))
