# SPDX-License-Identifier: Apache-2.0
"""Two views of a scene: fundamental and essential matrix, epipolar lines, relative pose.

Corresponding pixels x (first view) and x' (second view) satisfy x'^T F x = 0. The fundamental matrix F has rank 2 and
7 degrees of freedom. l' = F x and l = F^T x' are the epipolar lines; F e = 0 and F^T e' = 0 give the epipoles. If the
calibration matrices are known, the essential matrix E = K'^T F K = [t]_x R has 5 degrees of freedom: the rotation and
the direction of the translation of T_second_first, which maps coordinates of the first camera to those of the second.
Source: Hartley, Zisserman: "Multiple View Geometry in Computer Vision", 2nd edition 2004 (HZ), chapters 9 to 11.

Pixels are those of a pinhole: remove lens distortion first (`camera_matrix.ideal_pixels`).

Degenerate pairs of views raise ValueError. The functions recognise them by the noise of the data
(`consensus.simpler_model_suffices`):

- Points of one plane, a camera that only rotates, and the same view twice are mapped by a homography, which is
  consistent with infinitely many F.
- A camera that only rotates has no translation, and a plane has two relative poses with nearly the same images. For a
  known plane, find the pose by `camera_pose`.
- Points on a ruled quadric through both centres have up to three F (HZ 22.2). They are refused where the noise does not
  distinguish these F.

Used by: rangesim.geometry.two_view_triangulation and uncalibrated_rectification;
rangesim.multiview.incremental_reconstruction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rangesim.geometry import consensus
from rangesim.geometry.camera_matrix import centre, projection_matrix, rays
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
from rangesim.geometry.homography import (
    HOMOGRAPHY_PARAMETERS,
    homography_error,
    largest_plane,
    nearest_homography,
    rotation_homography_error,
)
from rangesim.geometry.least_squares import Minimum, minimise
from rangesim.geometry.projective_plane import homogeneous
from rangesim.rig import pose

FUNDAMENTAL_PARAMETERS = 7
"""Number of degrees of freedom of F: 9 entries less the scale and the rank condition; source: HZ 9.2.4."""

RELATIVE_POSE_PARAMETERS = 5
"""Number of degrees of freedom of a relative pose: 3 of the rotation and 2 of the direction of t; source: HZ 9.6."""

ROTATION_PARAMETERS = 3
"""Number of degrees of freedom of a rotation in space."""

MIN_IMAGE_EXTENT = 0.05
"""Least size of image coordinates by which `_checked_F` scales F. F may be given for pixels or for coordinates in units
of the focal length, so the size is guessed from F itself. The guess lies between this value (a lens of about 6 degrees
in units of its focal length) and `MAX_IMAGE_EXTENT`."""

MAX_IMAGE_EXTENT = 1e5
"""Largest size of image coordinates, in pixels, by which `_checked_F` scales F, because no image is larger; see
`MIN_IMAGE_EXTENT`."""

SINGLE_ROUNDING = 1e-6
"""Largest ratio of the border of F to its upper left block at which the border is only rounding. It is the relative
error of a few operations in single precision, because other programs may have computed F in single precision."""

MIN_SECOND_SINGULAR = 1e-12
"""Ratio of the second singular value of F to the first below which F has rank 1, so that it is refused. It lies well
above the rounding of double precision, 2e-16."""

MAX_THIRD_SINGULAR = 1e-6
"""Largest ratio of the third singular value of F to the first at which F has rank 2. It is the rounding of single
precision, because other programs may have computed F in single precision."""

MAX_ESSENTIAL_ERROR = 1e-3
"""Largest error of the singular values of an essential matrix, as a ratio to the first one. It bounds the difference of
the first two, and the third. It is so large because other programs may have estimated the matrix without this
constraint or written it with four digits; the nearest essential matrix is then used."""

MAX_OFF_PLANE_LINES = 5
"""Number of points off a plane whose lines are searched for other epipoles: the points with the largest parallax,
because their lines are known best. Each point costs 90 evaluations of all pairs."""

EPIPOLES_PER_LINE = 90
"""Number of epipoles tried along such a line: one every 2 degrees of its directions in normalised coordinates, so that
none of the families of F falls between two of them. The time grows with the number."""

DIFFERENT_F = 0.02
"""Smallest difference of an entry of F, as a ratio to the norm of F in normalised coordinates, at which two minima are
different matrices. Descents that end in the same minimum differ far less and must not count as two. A larger value
could miss that the points allow two matrices."""

MAX_STANDARD_DEVIATION = 0.3
"""Largest standard deviation of F, as a ratio to its norm in normalised coordinates. At a ratio of 1, F is unknown;
beyond a third, the noise determines F more than the points do. Nobody measured a closer limit."""


# ------------------------------------------------------------------------------------------- from cameras


def fundamental_from_cameras(first: ArrayLike, second: ArrayLike) -> Array:
    """(3, 3) float64 F of two camera matrices (3, 4), with unit norm.

    F = [P' C]_x P' P^+, where C is the centre of the first camera P and P^+ the pseudo-inverse of P (HZ 9.1).

    Raises
    ------
    ValueError
        Both cameras have the same centre: a homography relates the views, and there is no F.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import translation
    >>> K = np.diag([800.0, 800.0, 1.0])
    >>> F = fundamental_from_cameras(projection_matrix(K), projection_matrix(K, translation(-0.1, 0, 0)))
    >>> (F * np.sqrt(2)).round(6) + 0.0  # the cameras are parallel: epipolar lines are rows
    array([[ 0.,  0.,  0.],
           [ 0.,  0.,  1.],
           [ 0., -1.,  0.]])
    """
    p, q, origin = centred_cameras(
        *(checked_array(name, P, 3, 4) for name, P in (("first", first), ("second", second)))
    )
    C = centre(p)
    epipole = q @ C
    rounding = SHIFT_ROUNDING * np.linalg.norm(q[:, :3]) * np.linalg.norm(origin) * abs(C[3])
    if np.linalg.norm(epipole) <= 1e-12 * np.linalg.norm(q) * np.linalg.norm(C) + rounding:
        raise ValueError("expected two cameras that stand apart, got two with the same centre: there is no epipole.")
    return unit_norm(_cross_matrix(epipole / np.linalg.norm(epipole)) @ q @ np.linalg.pinv(p))


def centred_cameras(p: Array, q: Array) -> tuple[Array, Array, Array]:
    """Two camera matrices (3, 4) for a world whose origin is the centre of the first, and that centre (3,) in metres.

    At map coordinates the last columns are so large that the distance between the cameras is lost in rounding. So
    points and epipoles are computed with the origin at the first camera, and points are moved back. If the first camera
    is affine and has no centre, the matrices stay as they are and the centre is 0.
    """
    rows = np.linalg.norm(p[..., :3], axis=-1)  # brings rows in pixels and the row in metres to one size
    if p.ndim != 2 or q.ndim != 2 or not rows.all():
        return p, q, np.zeros(3)
    block = p[:, :3] / rows[:, None]
    if abs(np.linalg.det(block)) <= ROUNDING**1.5:
        return p, q, np.zeros(3)
    origin = np.linalg.solve(block, -p[:, 3] / rows)
    moved = [np.hstack([P[:, :3], (P[:, 3] + P[:, :3] @ origin)[:, None]]) for P in (p, q)]
    return moved[0], moved[1], origin


SHIFT_ROUNDING = 64 * float(np.finfo(np.float64).eps)
"""Rounding of the last column of a camera matrix, as a ratio to the distance from the origin to the camera. It is 64
times the rounding unit of double precision. This covers the rounding of the column as given and of the operations that
move it. With a larger value, two cameras that stand close together at map coordinates count as one."""


def essential_from_pose(T_second_first: ArrayLike) -> Array:
    """(3, 3) float64 essential matrix E = [t]_x R of a relative pose, with t scaled to unit length.

    Parameters
    ----------
    T_second_first : (4, 4), maps coordinates of the first camera to those of the second.

    Raises
    ------
    ValueError
        The translation is 0, or the pose is not rigid.

    Examples
    --------
    >>> from rangesim.rig import translation
    >>> essential_from_pose(translation(2, 0, 0)) + 0.0
    array([[ 0.,  0.,  0.],
           [ 0.,  0., -1.],
           [ 0.,  1.,  0.]])
    """
    T = pose(T_second_first, "T_second_first")
    return _cross_matrix(_direction(T[:3, 3])) @ T[:3, :3]


def fundamental_from_pose(K_first: ArrayLike, K_second: ArrayLike, T_second_first: ArrayLike) -> Array:
    """(3, 3) float64 fundamental matrix F = K'^-T [t]_x R K^-1 of a relative pose, with unit norm.

    Parameters
    ----------
    K_first, K_second : (3, 3) calibration matrices in pixels.
    T_second_first : (4, 4), maps coordinates of the first camera to those of the second.

    Raises
    ------
    ValueError
        The translation is 0, or the pose is not rigid.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import translation
    >>> K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> F = fundamental_from_pose(K, K, translation(-0.1, 0, 0))
    >>> lines_in_second(F, [[100, 200]]).round(6) + 0.0  # the row y = 200
    array([[   0.,    1., -200.]])
    """
    first, second = (np.linalg.inv(checked_array("K", K, 3, 3)) for K in (K_first, K_second))
    return unit_norm(second.T @ essential_from_pose(T_second_first) @ first)


# ------------------------------------------------------------------------------------------- lines and epipoles


class Epipoles(NamedTuple):
    """The epipoles of two views: the images of the other camera's centre.

    Attributes
    ----------
    first, second : (3,) float64 homogeneous pixels of the epipole in each view, unit norm.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import translation
    >>> forward = epipoles(fundamental_from_pose(np.eye(3), np.eye(3), translation(0, 0, -1)))
    >>> (forward.first / forward.first[2]).round(6) + 0.0
    array([0., 0., 1.])
    """

    first: Array
    second: Array


def epipoles(F: ArrayLike) -> Epipoles:
    """The epipoles e and e' of F (3, 3), with F e = 0 and F^T e' = 0.

    The last entry is 0 for an epipole at infinity.

    Examples
    --------
    >>> abs(epipoles([[0, 0, 0], [0, 0, -1], [0, 1, 0]]).first)  # parallel cameras
    array([1., 0., 0.])
    """
    left, _, right = np.linalg.svd(_checked_F(F))
    return Epipoles(right[2], left[:, 2])


def lines_in_second(F: ArrayLike, first: ArrayLike) -> Array:
    """(n, 3) float64 epipolar lines l' = F x in the second view of pixels (n, 2) of the first.

    Lines (a, b, c) have a^2 + b^2 = 1, so that l'^T x' is a distance in pixels. The epipole has no line: NaN.

    Examples
    --------
    >>> lines_in_second([[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[100, 200]]) + 0.0  # the row y = 200
    array([[   0.,   -1.,  200.]])
    """
    return _normalised_lines(homogeneous(first) @ _checked_F(F).T)


def lines_in_first(F: ArrayLike, second: ArrayLike) -> Array:
    """(n, 3) float64 epipolar lines l = F^T x' in the first view of pixels (n, 2) of the second.

    Lines (a, b, c) have a^2 + b^2 = 1, so that l^T x is a distance in pixels. The epipole has no line: NaN.

    Examples
    --------
    >>> lines_in_first([[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[60, 200]]) + 0.0  # the row y = 200
    array([[   0.,    1., -200.]])
    """
    return _normalised_lines(homogeneous(second) @ _checked_F(F))


def sampson_distance(F: ArrayLike, first: ArrayLike, second: ArrayLike) -> Array:
    """(n,) float64 signed Sampson distances of pairs from the epipolar geometry, pixels.

    The distance is x'^T F x divided by the norm of its gradient. Its square is, to first order, the least
    |dx|^2 + |dx'|^2 that makes the pair satisfy x'^T F x = 0 (HZ 11.4.3). It is NaN where both points are the epipoles.

    Parameters
    ----------
    F : (3, 3), rank 2; any multiple is the same geometry.
    first, second : (n, 2) corresponding pixels.

    Examples
    --------
    >>> F = [[0, 0, 0], [0, 0, -1], [0, 1, 0]]  # parallel cameras: rows must match
    >>> abs(sampson_distance(F, [[100, 200]], [[60, 203]])).round(4)  # 3 px shared by two views: 3 / sqrt(2)
    array([2.1213])
    """
    return _sampson(_checked_F(F), homogeneous(first), homogeneous(second))[0]


# ------------------------------------------------------------------------------------------- F from points


@dataclass(frozen=True, eq=False)
class FundamentalMatrix:
    """The fundamental matrix F of two views, with its covariance.

    Attributes
    ----------
    matrix : (3, 3) float64, F with rank 2 and unit norm.
    covariance : (9, 9) float64, covariance of the entries of `matrix`, row by row; rank 7. NaN if the noise is unknown.
    noise_px : standard deviation of one coordinate, as given or estimated from the residuals.
    inliers : (n,) bool, the pairs that agree with F.

    Examples
    --------
    `fit_fundamental` and `find_fundamental` return one; here it is made by hand:

    >>> import numpy as np
    >>> F = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)
    >>> found = FundamentalMatrix(F, np.zeros((9, 9)), noise_px=0.5, inliers=np.ones(20, dtype=bool))
    >>> int(np.linalg.matrix_rank(found.matrix))
    2
    """

    matrix: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray


def seven_point(first: ArrayLike, second: ArrayLike) -> Array:
    """(k, 3, 3) float64, the one to three F that fit seven pairs exactly, with rank 2 and unit norm (HZ 11.1.2).

    They solve det(a F1 + (1 - a) F2) = 0, where F1 and F2 span the null space of the seven equations.

    Parameters
    ----------
    first, second : (7, 2) corresponding pixels.

    Raises
    ------
    ValueError
        There are not seven different pairs, or their equations depend on each other, as those of coplanar points do.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import project
    >>> from rangesim.rig import translation
    >>> P, Q = (projection_matrix(np.diag([800.0, 800.0, 1.0]), T) for T in (np.eye(4), translation(-1, 0.2, 0.1)))
    >>> points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (7, 3))
    >>> found = seven_point(project(P, points), project(Q, points))
    >>> true = fundamental_from_cameras(P, Q)
    >>> bool(min(np.linalg.norm(F - sign * true) for F in found for sign in (1, -1)) < 1e-6)
    True
    """
    a, b = checked_pairs(first, second, 7, "the seven-point algorithm")
    if len(a) != 7:
        raise ValueError(f"expected seven pairs of points, got {len(a)}; use eight_point or fit_fundamental.")
    from_a, from_b = normalising_transform(a), normalising_transform(b)
    values, axes = right_singular_vectors(_design(apply_similarity(from_a, a), apply_similarity(from_b, b)))
    if values[6] <= ROUNDING * values[0]:
        raise ValueError(_DEPENDENT.format(n=7))
    found = _singular_members(axes[7].reshape(3, 3), axes[8].reshape(3, 3))
    return unit_norm(from_b.T @ np.stack([_rank_two(F) for F in found]) @ from_a)


def eight_point(first: ArrayLike, second: ArrayLike) -> Array:
    """(3, 3) float64 F by the normalised eight-point algorithm (Hartley 1997; HZ 11.2), with rank 2 and unit norm.

    Parameters
    ----------
    first, second : (n, 2) corresponding pixels, n >= 8.

    Raises
    ------
    ValueError
        There are fewer than eight different pairs, or they are exactly degenerate: coplanar points, a rotation alone,
        one view twice. Degenerate pairs with noise pass here; `fit_fundamental` refuses them.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import project
    >>> from rangesim.rig import translation
    >>> P, Q = (projection_matrix(np.diag([800.0, 800.0, 1.0]), T) for T in (np.eye(4), translation(-1, 0.2, 0.1)))
    >>> points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (20, 3))
    >>> F = eight_point(project(P, points), project(Q, points))
    >>> bool(abs(sampson_distance(F, project(P, points), project(Q, points))).max() < 1e-6)
    True
    """
    a, b = checked_pairs(first, second, 8, "the eight-point algorithm")
    from_a, from_b = normalising_transform(a), normalising_transform(b)
    values, axes = right_singular_vectors(_design(apply_similarity(from_a, a), apply_similarity(from_b, b)))
    if values[7] <= ROUNDING * values[0]:
        raise ValueError(_DEPENDENT.format(n=len(a)))
    return unit_norm(from_b.T @ _rank_two(axes[8].reshape(3, 3)) @ from_a)


def fit_fundamental(first: ArrayLike, second: ArrayLike, *, noise_px: float | None = None) -> FundamentalMatrix:
    """The maximum-likelihood F for Gaussian noise in both views, with its covariance; all pairs must be correct.

    It minimises the sum of squared Sampson distances, which is to first order the reprojection error of HZ algorithm
    11.3. It starts from `eight_point` and descends by Levenberg-Marquardt over the 7 dimensions of matrices with rank 2
    and unit norm: for F = U D V^T, steps have the form U [A, b; c^T, 0] V^T, followed by the nearest matrix of rank 2.

    Parameters
    ----------
    first, second : (n, 2) corresponding pixels, n >= 8.
    noise_px : standard deviation of one coordinate; None estimates it from the residuals. More than eight pairs are
        then needed to make sure that the data are not degenerate.

    Raises
    ------
    ValueError
        `eight_point` refuses the pairs; a homography explains them within their noise (a plane, a rotation alone, one
        view twice); a homography explains all but a few, which leave the epipole open (one point off a plane); two F
        explain them; or the residuals are over three times the stated noise.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import project
    >>> from rangesim.rig import translation
    >>> P, Q = (projection_matrix(np.diag([800.0, 800.0, 1.0]), T) for T in (np.eye(4), translation(-1, 0.2, 0.1)))
    >>> random = np.random.default_rng(0)
    >>> points = random.uniform([-1, -1, 3], [1, 1, 5], (40, 3))
    >>> first, second = (project(camera, points) + random.normal(0, 0.3, (40, 2)) for camera in (P, Q))
    >>> found = fit_fundamental(first, second)
    >>> 0.2 < found.noise_px < 0.4
    True
    """
    a, b = checked_pairs(first, second, 8, "a fundamental matrix")
    check_noise(noise_px)
    from_a, from_b = normalising_transform(a), normalising_transform(b)
    unit_a, unit_b = apply_similarity(from_a, a), apply_similarity(from_b, b)
    start = np.linalg.inv(from_b).T @ eight_point(a, b) @ np.linalg.inv(from_a)
    # both views are scaled differently, so the Sampson distance weights each by the size of its pixel
    scale = float(np.sqrt(from_a[0, 0] * from_b[0, 0]))
    weights = (from_a[0, 0] / scale, from_b[0, 0] / scale)
    xa, xb = homogeneous(unit_a), homogeneous(unit_b)

    def residuals(F: Array) -> tuple[Array, Array]:
        distances, by_matrix = _sampson(F, xa, xb, weights)
        return distances, by_matrix @ _tangent(F)

    def step(F: Array, delta: Array) -> Array:
        return unit_norm(_rank_two(F + (_tangent(F) @ delta).reshape(3, 3)))

    found = minimise(residuals, step, unit_norm(start))
    _, axes = right_singular_vectors(_design(unit_a, unit_b))
    members = _singular_members(axes[7].reshape(3, 3), axes[8].reshape(3, 3))
    minima = [minimise(residuals, step, unit_norm(_rank_two(F))) for F in members]
    found = min([found, *minima], key=lambda minimum: minimum.cost)
    consensus.refuse_misfit(found.cost / scale**2, len(a) - FUNDAMENTAL_PARAMETERS, noise_px, "an epipolar geometry")
    noise = found.noise(FUNDAMENTAL_PARAMETERS) / scale if noise_px is None else noise_px
    _refuse_homography(a, b, found.cost / scale**2, FUNDAMENTAL_PARAMETERS, noise_px)
    rounding = consensus.rounding_of(np.concatenate([a, b]))
    for other in minima:
        apart = min(np.abs(other.state - sign * found.state).max() for sign in (1, -1))
        costs = other.cost / scale**2, found.cost / scale**2
        freedom = len(a) - FUNDAMENTAL_PARAMETERS
        if apart > DIFFERENT_F and consensus.is_as_likely(*costs, freedom, noise_px, rounding):
            raise ValueError(
                f"expected points with one fundamental matrix, got {len(a)} pairs that two such matrices explain "
                "within their noise: the points lie on a surface that contains both centres, or are few; add points at "
                "other depths."
            )
    _refuse_open_epipole(a, b, from_a, from_b, found, scale, max(noise, rounding))
    in_tangent = found.covariance(max(noise * scale, 1e-300))
    tangent = _tangent(found.state)
    normal = tangent @ in_tangent @ tangent.T
    if not np.sqrt(np.trace(normal)) <= MAX_STANDARD_DEVIATION:
        raise ValueError(
            "expected points that determine the fundamental matrix, got some that do not at a noise of "
            f"{noise:.3g} px: near a plane, near a surface that contains both centres, or with too small a baseline; "
            "add points at other depths."
        )
    to_pixels = np.kron(from_b.T, from_a.T)
    covariance = covariance_of_unit_norm(found.state, to_pixels, normal)
    return FundamentalMatrix(
        unit_norm(from_b.T @ found.state @ from_a), covariance, float(noise), np.ones(len(a), dtype=bool)
    )


def find_fundamental(first: ArrayLike, second: ArrayLike, noise_px: float = 1.0, *, seed: int = 0) -> FundamentalMatrix:
    """The F that most pairs agree with, although some pairs are wrong; with its covariance.

    OpenCV's USAC proposes inliers. `fit_fundamental` is then fitted to the inliers, and the inliers are chosen again,
    until they no longer change. The same seed gives the same result.

    Parameters
    ----------
    first, second : (n, 2) corresponding pixels, n >= 9.
    noise_px : standard deviation of one coordinate of a correct pair. A pair is an inlier if its Sampson distance is
        below the 99 % quantile of those that this noise causes.
    seed : state of the random numbers that USAC draws samples with.

    Raises
    ------
    ValueError
        `fit_fundamental` refuses the inliers; no more pairs agree than chance explains; or the pairs off the best
        homography agree only by chance, so that the scene may be a plane, or the camera may only rotate.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import project
    >>> from rangesim.rig import translation
    >>> P, Q = (projection_matrix(np.diag([800.0, 800.0, 1.0]), T) for T in (np.eye(4), translation(-1, 0.2, 0.1)))
    >>> random = np.random.default_rng(0)
    >>> points = random.uniform([-1, -1, 3], [1, 1, 5], (60, 3))
    >>> first, second = (project(camera, points) + random.normal(0, 0.3, (60, 2)) for camera in (P, Q))
    >>> second[:10] = random.uniform(-300, 300, (10, 2))  # wrong pairs
    >>> int(find_fundamental(first, second, noise_px=0.3).inliers[:10].sum()) <= 1  # one may lie on its line by chance
    True
    """
    import cv2

    a, b = checked_pairs(first, second, 9, "a robust fundamental matrix")
    check_noise(noise_px)
    threshold = consensus.inlier_threshold(noise_px, 1)
    found, mask = cv2.findFundamentalMat(a, b, consensus.usac(threshold, seed))
    _refuse_chance(0 if found is None else int(mask.sum()), a, b, threshold, FUNDAMENTAL_PARAMETERS)

    def fit(chosen: np.ndarray) -> FundamentalMatrix:
        return fit_fundamental(a[chosen], b[chosen], noise_px=noise_px)

    def error(model: FundamentalMatrix) -> Array:
        return np.abs(sampson_distance(model.matrix, a, b))

    chosen = mask.ravel() > 0
    model, inliers = consensus.consistent_set(chosen, threshold, fit, error, least=9)
    _refuse_chance(int(inliers.sum()), a, b, threshold, FUNDAMENTAL_PARAMETERS)
    _refuse_plane_with_outliers(a, b, inliers, noise_px)
    noise = _noise_of(sampson_distance(model.matrix, a[inliers], b[inliers]), FUNDAMENTAL_PARAMETERS)
    return replace(model, inliers=inliers, noise_px=noise, covariance=model.covariance * (noise / noise_px) ** 2)


# ------------------------------------------------------------------------------------------- pose from points


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The relative pose of two cameras, up to the length of the baseline, with its covariance.

    Attributes
    ----------
    T_second_first : (4, 4) float64, maps coordinates of the first camera to those of the second. |t| = 1, because
        images do not determine the length of the baseline.
    covariance : (5, 5) float64, covariance of (rotation vector applied after R, rad; turns of t about two axes
        orthogonal to it, rad). NaN if the noise is unknown.
    noise_px : standard deviation of one coordinate, as given or estimated from the residuals.
    inliers : (n,) bool, the pairs that agree with the pose.

    Examples
    --------
    `fit_relative_pose` and `find_relative_pose` return one; here it is made by hand:

    >>> import numpy as np
    >>> from rangesim.rig import translation
    >>> pose = RelativePose(translation(1, 0, 0), np.zeros((5, 5)), noise_px=0.5, inliers=np.ones(20, dtype=bool))
    >>> pose.essential + 0.0
    array([[ 0.,  0.,  0.],
           [ 0.,  0., -1.],
           [ 0.,  1.,  0.]])
    """

    T_second_first: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray

    @property
    def essential(self) -> Array:
        """(3, 3) float64 essential matrix E = [t]_x R."""
        return essential_from_pose(self.T_second_first)


def poses_from_essential(E: ArrayLike) -> Array:
    """(4, 4, 4) float64, the four T_second_first with E = [t]_x R up to scale and sign, and |t| = 1 (HZ 9.6.2).

    Only one of them has the points in front of both cameras (`in_front`).

    Parameters
    ----------
    E : (3, 3) essential matrix.

    Raises
    ------
    ValueError
        E is not an essential matrix: its singular values are not (s, s, 0), to 1e-3 of s.

    Examples
    --------
    >>> from rangesim.rig import translation
    >>> abs(poses_from_essential(essential_from_pose(translation(1, 0, 0)))[:, :3, 3]).round(6) + 0.0
    array([[1., 0., 0.],
           [1., 0., 0.],
           [1., 0., 0.],
           [1., 0., 0.]])
    """
    matrix = checked_array("E", E, 3, 3)
    values = np.linalg.svd(matrix, compute_uv=False)
    allowed = MAX_ESSENTIAL_ERROR * values[0]
    if not (values[0] > 0 and values[0] - values[1] <= allowed and values[2] <= allowed):
        raise ValueError(f"expected an essential matrix with singular values (s, s, 0), got {values.tolist()}.")
    return _poses_of(matrix)


def _poses_of(E: Array) -> Array:
    """(4, 4, 4) float64, the four poses of the essential matrix that is nearest to E (3, 3)."""
    u, _, vt = np.linalg.svd(E)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    result = np.tile(np.eye(4), (4, 1, 1))
    for k, (turn, sign) in enumerate(((quarter, 1), (quarter, -1), (quarter.T, 1), (quarter.T, -1))):
        result[k, :3, :3], result[k, :3, 3] = u @ turn @ vt, sign * u[:, 2]
    return result


def in_front(
    K_first: ArrayLike, K_second: ArrayLike, T_second_first: ArrayLike, first: ArrayLike, second: ArrayLike
) -> np.ndarray:
    """(n,) bool, whether the point of each pair lies in front of both cameras (cheirality).

    The point is where the rays through both pixels come nearest to each other.

    Parameters
    ----------
    K_first, K_second : (3, 3) calibration matrices in pixels.
    T_second_first : (4, 4), maps coordinates of the first camera to those of the second.
    first, second : (n, 2) corresponding pixels.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import translation
    >>> K = np.diag([800.0, 800.0, 1.0])
    >>> in_front(K, K, translation(-0.1, 0, 0), [[10, 0], [10, 0]], [[2, 0], [18, 0]])
    array([ True, False])
    """
    T = np.asarray(T_second_first, dtype=np.float64)
    d = rays(projection_matrix(K_first), first) @ T[:3, :3].T
    e = rays(projection_matrix(K_second), second)
    t = T[:3, 3]
    # depths z, z' on the rays d, e solve z d + t = z' e in the least-squares sense
    dd, de, ee = (d * d).sum(-1), (d * e).sum(-1), (e * e).sum(-1)
    dt, et = d @ t, e @ t
    determinant = dd * ee - de**2
    return np.asarray((de * et - ee * dt > 0) & (dd * et - de * dt > 0) & (determinant > 0))


def fit_relative_pose(
    first: ArrayLike, second: ArrayLike, K_first: ArrayLike, K_second: ArrayLike, *, noise_px: float | None = None
) -> RelativePose:
    """The maximum-likelihood relative pose for Gaussian noise, with its covariance; all pairs must be correct.

    It minimises the squared Sampson distances in pixels over 5 parameters: the rotation and the direction of the
    translation. It starts from several solutions of the five-point algorithm (Nister 2004, by OpenCV). Each has four
    poses, of which the one with the points in front of both cameras is used.

    Parameters
    ----------
    first, second : (n, 2) corresponding pixels, n >= 6.
    K_first, K_second : (3, 3) calibration matrices in pixels.
    noise_px : standard deviation of one coordinate; None estimates it from the residuals.

    Raises
    ------
    ValueError
        There are fewer than six different pairs; a rotation alone (or the same view twice) or a plane explains the
        pairs within their noise; two poses explain them; no pose has the points in front of both cameras; or the
        residuals are over three times the stated noise.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import project
    >>> from rangesim.rig import translation
    >>> K, T = np.diag([800.0, 800.0, 1.0]), translation(-0.8, 0.6, 0)
    >>> points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (30, 3))
    >>> first, second = project(projection_matrix(K), points), project(projection_matrix(K, T), points)
    >>> fit_relative_pose(first, second, K, K, noise_px=0.1).T_second_first[:3, 3].round(6) + 0.0
    array([-0.8,  0.6,  0. ])
    """
    a, b = checked_pairs(first, second, 6, "a relative pose")
    check_noise(noise_px)
    kf, ks = checked_array("K_first", K_first, 3, 3), checked_array("K_second", K_second, 3, 3)
    inverses = np.linalg.inv(kf), np.linalg.inv(ks)
    xa, xb = homogeneous(a), homogeneous(b)

    def residuals(T: Array) -> tuple[Array, Array]:
        return _pose_residuals(T, inverses, xa, xb)

    minima: list[Minimum[Array]] = []
    for start in _starting_poses(a, b, kf, ks):
        facing = _facing(minimise(residuals, _moved, start).state, kf, ks, a, b)
        if facing is not None and not any(_is_same(facing, other.state) for other in minima):
            minima.append(minimise(residuals, _moved, facing))
    minima.sort(key=lambda minimum: minimum.cost)
    least = minima[0].cost if minima else np.inf
    _refuse_rotation(a, b, kf, ks, least, noise_px)
    _refuse_homography(a, b, least, RELATIVE_POSE_PARAMETERS, noise_px)
    if not minima:
        raise ValueError(
            "expected points in front of both cameras, got pairs that no pose puts there: the camera only rotates, or "
            "the pairs or K are wrong."
        )
    best, freedom = minima[0], len(a) - RELATIVE_POSE_PARAMETERS
    rounding = consensus.rounding_of(np.concatenate([a, b]))
    for other in minima[1:]:
        if consensus.is_as_likely(other.cost, best.cost, freedom, noise_px, rounding):
            angle = np.degrees(_angle(other.state[:3, :3] @ best.state[:3, :3].T))
            raise ValueError(
                "expected points with one relative pose, got two poses that explain them within their noise, "
                f"{angle:.1f} degrees apart: they lie on a plane, or are few; add points off it."
            )
    consensus.refuse_misfit(best.cost, freedom, noise_px, "a relative pose")
    noise = best.noise(RELATIVE_POSE_PARAMETERS) if noise_px is None else noise_px
    return RelativePose(best.state, best.covariance(max(noise, 1e-300)), float(noise), np.ones(len(a), dtype=bool))


def find_relative_pose(
    first: ArrayLike,
    second: ArrayLike,
    K_first: ArrayLike,
    K_second: ArrayLike,
    noise_px: float = 1.0,
    *,
    seed: int = 0,
) -> RelativePose:
    """The relative pose that most pairs agree with, although some pairs are wrong; with its covariance.

    OpenCV's USAC proposes inliers. `fit_relative_pose` is then fitted to the inliers, and the inliers are chosen again,
    until they no longer change. The same seed gives the same result.

    Parameters
    ----------
    first, second : (n, 2) corresponding pixels, n >= 8.
    K_first, K_second : (3, 3) calibration matrices in pixels.
    noise_px : standard deviation of one coordinate of a correct pair.
    seed : state of the random numbers that USAC draws samples with.

    Raises
    ------
    ValueError
        `fit_relative_pose` refuses the inliers, or no more pairs agree than chance explains.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import project
    >>> from rangesim.rig import translation
    >>> K, T = np.diag([800.0, 800.0, 1.0]), translation(-0.8, 0.6, 0)
    >>> random = np.random.default_rng(0)
    >>> points = random.uniform([-1, -1, 3], [1, 1, 5], (60, 3))
    >>> first, second = project(projection_matrix(K), points), project(projection_matrix(K, T), points)
    >>> second[:10] = random.uniform(-300, 300, (10, 2))  # wrong pairs
    >>> find_relative_pose(first, second, K, K, noise_px=0.3).T_second_first[:3, 3].round(1) + 0.0
    array([-0.8,  0.6,  0. ])
    """
    import cv2

    a, b = checked_pairs(first, second, 8, "a robust relative pose")
    check_noise(noise_px)
    kf, ks = checked_array("K_first", K_first, 3, 3), checked_array("K_second", K_second, 3, 3)
    threshold = consensus.inlier_threshold(noise_px, 1)
    none = np.zeros(5)
    found, mask = cv2.findEssentialMat(a, b, kf, ks, none, none, consensus.usac(threshold, seed))
    _refuse_chance(0 if found is None else int(mask.sum()), a, b, threshold, RELATIVE_POSE_PARAMETERS)

    def fit(chosen: np.ndarray) -> RelativePose:
        return fit_relative_pose(a[chosen], b[chosen], kf, ks, noise_px=noise_px)

    def error(model: RelativePose) -> Array:
        F = fundamental_from_pose(kf, ks, model.T_second_first)
        apart = np.abs(sampson_distance(F, a, b))
        return np.where(in_front(kf, ks, model.T_second_first, a, b), apart, np.inf)

    model, inliers = consensus.consistent_set(mask.ravel() > 0, threshold, fit, error, least=8)
    _refuse_chance(int(inliers.sum()), a, b, threshold, RELATIVE_POSE_PARAMETERS)
    _refuse_plane_with_outliers(a, b, inliers, noise_px)
    F = fundamental_from_pose(kf, ks, model.T_second_first)
    noise = _noise_of(sampson_distance(F, a[inliers], b[inliers]), RELATIVE_POSE_PARAMETERS)
    return replace(model, inliers=inliers, noise_px=noise, covariance=model.covariance * (noise / noise_px) ** 2)


# ------------------------------------------------------------------------------------------- degenerate views

_DEPENDENT = (
    "expected pairs that determine the fundamental matrix, got {n} whose equations depend on each other: points of "
    "one plane, a camera that only rotates, one view twice, or repeated points; add points at other depths or move "
    "the camera."
)
MIN_IN_FRONT = 0.75
"""Least fraction of the points that must lie in front of both cameras. The others may be so far away that noise puts
them beyond infinity, which is behind the cameras. Below a half, another of the four poses has more points in front.
Nobody measured a closer value."""


def _refuse_homography(a: Array, b: Array, cost: float, parameters: int, noise_px: float | None) -> None:
    """Raise ValueError if a homography explains the pairs a, b (n, 2) within their noise.

    The full model explains them too. It has that number of `parameters` and the sum of squares `cost` in px^2.
    """
    n, rounding = len(a), consensus.rounding_of(np.concatenate([a, b]))
    simple = homography_error(a, b), 2 * n - HOMOGRAPHY_PARAMETERS
    if consensus.simpler_model_suffices(simple, (cost, n - parameters), noise_px, rounding):
        apart = float(np.sqrt(simple[0] / simple[1]))
        same = np.sqrt(((a - b) ** 2).mean()) <= 3 * max(noise_px or 0.0, apart, rounding)
        what = "one view twice" if same else "points of one plane or a camera that only rotates"
        hint = "" if noise_px is not None or n > 12 else " With so few pairs, state noise_px if you know it."
        raise ValueError(
            f"expected two views with parallax, got {n} pairs that a homography maps to each other within {apart:.3g} "
            f"px: {what}; the epipoles are not determined, or two poses fit. Add points at other depths or move the "
            f"camera.{hint}"
        )


def _refuse_open_epipole(
    a: Array, b: Array, from_a: Array, from_b: Array, found: Minimum[Array], scale: float, noise_px: float
) -> None:
    """Raise ValueError if most pairs lie on a plane and the others leave the epipole open.

    A plane with the homography H is consistent with F = [e']_x H for any e'. A pair off the plane puts e' on the line
    (H x) x x'. One such line leaves a family of F, and so do several lines that noise does not distinguish. The
    curvature at one minimum does not show this, because there the noise of the plane's points looks like parallax. So
    the function moves e' along these lines, and the sum of squares of all pairs shows which F of the family fit.

    Parameters
    ----------
    a, b : (n, 2) pixels.
    from_a, from_b : (3, 3) similarities from pixels to the normalised coordinates of `found`.
    found : the minimum whose state is F.
    scale : normalised units per pixel.
    noise_px : standard deviation of one coordinate.
    """
    plane = largest_plane(a, b, noise_px)
    off = np.flatnonzero(~plane)
    if 2 * len(off) >= len(a):
        return
    unit_a, unit_b = homogeneous(apply_similarity(from_a, a)), homogeneous(apply_similarity(from_b, b))
    H = from_b @ nearest_homography(a[plane], b[plane])[0] @ np.linalg.inv(from_a)
    mapped = unit_a[off] @ H.T
    parallax = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - unit_b[off, :2], axis=-1)
    farthest = np.argsort(-parallax)[:MAX_OFF_PLANE_LINES]
    weights = (from_a[0, 0] / scale, from_b[0, 0] / scale)
    # the noise of the plane's points alone makes the sums of two members differ by 2 sqrt(n), as two chi^2 of n do
    rise = consensus.chi2_limit(FUNDAMENTAL_PARAMETERS) + 2 * np.sqrt(len(a))
    allowed = found.cost + rise * (noise_px * scale) ** 2
    angles = np.linspace(0, np.pi, EPIPOLES_PER_LINE, endpoint=False)
    for line in np.cross(mapped, unit_b[off])[farthest]:
        axes = np.linalg.svd(line[None])[2][1:]
        for epipole in np.outer(np.cos(angles), axes[0]) + np.outer(np.sin(angles), axes[1]):
            F = unit_norm(_cross_matrix(epipole) @ H)
            apart = min(float(np.linalg.norm(F - sign * found.state)) for sign in (1, -1))
            if apart <= 2 * MAX_STANDARD_DEVIATION:
                continue
            distances = _sampson(F, unit_a, unit_b, weights)[0]
            if distances @ distances <= allowed:
                raise ValueError(
                    f"expected points that determine the fundamental matrix, got {len(a)} pairs of which all but "
                    f"{len(off)} lie on one plane: these do not determine the epipole at a noise of {noise_px:.3g} px; "
                    "a family of matrices explains all pairs; add points off the plane."
                )


def _refuse_rotation(a: Array, b: Array, K_first: Array, K_second: Array, cost: float, noise_px: float | None) -> None:
    """Raise ValueError if a rotation alone explains the pairs a, b (n, 2) within their noise.

    The relative pose explains them too, with the sum of squares `cost` in px^2.
    """
    n, rounding = len(a), consensus.rounding_of(np.concatenate([a, b]))
    simple = rotation_homography_error(a, b, K_first, K_second), 2 * n - ROTATION_PARAMETERS
    if consensus.simpler_model_suffices(simple, (cost, n - RELATIVE_POSE_PARAMETERS), noise_px, rounding):
        apart = float(np.sqrt(simple[0] / simple[1]))
        raise ValueError(
            f"expected a camera that moved, got {n} pairs that a rotation alone explains within {apart:.3g} px: there "
            "is no direction of translation; move the camera sideways."
        )


def _refuse_plane_with_outliers(a: Array, b: Array, inliers: np.ndarray, noise_px: float) -> None:
    """Raise ValueError if the pairs that agree with F but not with the largest plane may do so by chance.

    A plane and any two pairs off it determine some F, even if these pairs are wrong (Chum, Werner, Matas: "Two-view
    geometry estimation unaffected by a dominant plane", CVPR 2005). So the function counts
    the pairs off the plane that agree with F, and compares their number with chance.
    """
    off = ~largest_plane(a, b, 2 * noise_px)  # twice the noise, so that no noisy point of the plane counts as off it
    threshold = consensus.inlier_threshold(noise_px, 1)
    _refuse_chance(int((inliers & off).sum()), a[off], b[off], threshold, minimal=2, plane=True)


def _refuse_chance(agreeing: int, a: Array, b: Array, threshold: float, minimal: int, plane: bool = False) -> None:
    """Raise ValueError if no more pairs agree with an epipolar geometry than chance explains.

    A wrong pair agrees by chance if it lies within `threshold` pixels of its epipolar line. It may lie anywhere in the
    area that the points span.

    Parameters
    ----------
    agreeing : number of the pairs a, b (n, 2) that agree.
    minimal : number of pairs that determine the geometry.
    plane : whether these are the pairs off a plane, for the message.
    """
    probability = 0.0
    for points in (a, b):
        area, diagonal = consensus.bounding_area(points) if len(points) else (1.0, 0.0)
        probability = max(probability, 2 * np.sqrt(2) * threshold * diagonal / area)
    if not consensus.agree_by_chance(agreeing, len(a), minimal, probability):
        return
    if plane:
        raise ValueError(
            "expected points at several depths, got pairs of one plane, or of a camera that only rotates, and "
            f"{len(a)} others of which {agreeing} agree with an epipolar geometry, no more than chance; add points "
            "off the plane."
        )
    raise ValueError(
        f"expected two views of one rigid scene, got {len(a)} pairs of which at most {agreeing} agree, no more than "
        "chance; the pairs or noise_px are wrong."
    )


# ------------------------------------------------------------------------------------------- the pieces


def _checked_F(F: ArrayLike) -> Array:
    """F (3, 3) as float64; ValueError unless it is finite and of rank 2."""
    matrix = checked_array("F", F, 3, 3)
    if matrix.ndim != 2:
        raise ValueError(f"expected F of shape (3, 3), got {matrix.shape}.")
    # F mixes pixels and ones: in units of the size of the image, its upper left block and its border have one size
    block, border = np.linalg.norm(matrix[:2, :2]), max(np.linalg.norm(matrix[2, :2]), np.linalg.norm(matrix[:2, 2]))
    # an epipole at the origin, as for forward motion, leaves a border of rounding only, which says nothing of the unit
    has_unit = block > 0 and border > SINGLE_ROUNDING * block
    unit = min(max(border / block, MIN_IMAGE_EXTENT), MAX_IMAGE_EXTENT) if has_unit else 1.0
    values = np.linalg.svd(matrix * np.outer([unit, unit, 1], [unit, unit, 1]), compute_uv=False)
    if not (values[1] > MIN_SECOND_SINGULAR * values[0] and values[2] <= MAX_THIRD_SINGULAR * values[0]):
        raise ValueError(f"expected F of rank 2, got singular values {values.tolist()} after scaling.")
    return matrix


def _noise_of(residuals: Array, parameters: int) -> float:
    """Standard deviation of residuals (n,) of a model with that number of parameters."""
    return float(np.sqrt(residuals @ residuals / (len(residuals) - parameters)))


def _design(a: Array, b: Array) -> Array:
    """(n, 9) design matrix of the equations x'^T F x = 0: row by row the Kronecker product of x' and x."""
    return np.asarray((homogeneous(b)[:, :, None] * homogeneous(a)[:, None, :]).reshape(len(a), 9))


def _singular_members(one: Array, two: Array) -> list[Array]:
    """The one to three singular matrices among two + s one, for real s, and one."""
    # det(two + s one) is a cubic in s, found from four of its values; if its highest term is 0, `one` is singular
    places = np.array([-1.0, 0.0, 1.0, 2.0])
    cubic = np.polyfit(places, [np.linalg.det(two + s * one) for s in places], 3)
    negligible = np.abs(cubic) < 1e-14 * np.abs(cubic).max()
    roots = np.roots(np.where(negligible, 0.0, cubic))
    found = [two + s * one for s in roots.real[np.abs(roots.imag) <= 1e-6 * (1 + np.abs(roots))]]
    return [*found, one] if negligible[0] else found


def _rank_two(F: Array) -> Array:
    """The matrix (3, 3) of rank 2 that is nearest to F."""
    u, values, vt = np.linalg.svd(F)
    return np.asarray((u[:, :2] * values[:2]) @ vt[:2])


def _tangent(F: Array) -> Array:
    """(9, 7) orthonormal directions in which a matrix F (3, 3) of rank 2 and unit norm can change.

    For F = U D V^T these are U M V^T with M33 = 0, orthogonal to F itself.
    """
    u, values, vt = np.linalg.svd(F)
    basis = np.kron(u, vt.T)[:, :8]  # columns vec(u_i v_j^T), the last of which, (3, 3), is left out
    along = np.zeros((1, 8))
    along[0, [0, 4]] = values[:2]
    return np.asarray(basis @ np.linalg.svd(along)[2][1:].T)


def _sampson(F: Array, a: Array, b: Array, weights: tuple[float, float] = (1.0, 1.0)) -> tuple[Array, Array]:
    """(n,) Sampson distances of homogeneous points a, b (n, 3), and their (n, 9) derivatives by F.

    Parameters
    ----------
    weights : size of a pixel of each view in these coordinates.
    """
    line_a, line_b = b @ F, a @ F.T
    algebraic = (b * line_b).sum(axis=-1)
    square_a, square_b = (weight**2 for weight in weights)
    gradient = square_a * (line_a[:, :2] ** 2).sum(-1) + square_b * (line_b[:, :2] ** 2).sum(-1)
    size = np.sqrt(np.where(gradient > 0, gradient, np.nan))
    flat = np.array([1.0, 1.0, 0.0])
    by_matrix = b[:, :, None] * a[:, None, :] / size[:, None, None]
    turn = (
        square_a * b[:, :, None] * (line_a * flat)[:, None, :] + square_b * (line_b * flat)[:, :, None] * a[:, None, :]
    )
    by_matrix = by_matrix - (algebraic / size**3)[:, None, None] * turn
    return algebraic / size, by_matrix.reshape(-1, 9)


def _normalised_lines(lines: Array) -> Array:
    """Lines (..., 3) scaled to a^2 + b^2 = 1; NaN for the line at infinity."""
    norms = np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)
    return np.asarray(lines / np.where(norms > 0, norms, np.nan))


def _cross_matrix(t: Array) -> Array:
    """(3, 3) matrix [t]_x of t (3,), with [t]_x v = t x v."""
    return np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])


def _direction(t: Array) -> Array:
    """Unit vector (3,) along t; ValueError if t is 0."""
    length = np.linalg.norm(t)
    if not length > 0:
        raise ValueError("expected two cameras that stand apart, got a translation of 0.")
    return np.asarray(t / length)


def _angle(rotation: Array) -> float:
    """Angle in radians of a rotation matrix (3, 3)."""
    return float(Rotation.from_matrix(rotation).magnitude())


def _is_same(T: Array, other: Array) -> bool:
    """Whether two minima T, other (4, 4) are the same one, found twice."""
    return bool(_angle(T[:3, :3] @ other[:3, :3].T) < 1e-3 and T[:3, 3] @ other[:3, 3] > 1 - 1e-4)


def _turns(t: Array) -> Array:
    """(2, 3) orthonormal axes orthogonal to t, about which a direction can turn."""
    return np.linalg.svd(t[None])[2][1:]


def _moved(T: Array, delta: Array) -> Array:
    """The pose T (4, 4) moved by a step (5,): a rotation vector applied after R, and turns of t about its `_turns`."""
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(delta[:3]).as_matrix() @ T[:3, :3]
    result[:3, 3] = Rotation.from_rotvec(delta[3:] @ _turns(T[:3, 3])).as_matrix() @ T[:3, 3]
    return result


def _pose_residuals(T: Array, inverses: tuple[Array, Array], a: Array, b: Array) -> tuple[Array, Array]:
    """(n,) Sampson distances in pixels and their (n, 5) derivatives by the step of `_moved`.

    Parameters
    ----------
    inverses : inverse calibration matrices (3, 3) of both cameras.
    a, b : (n, 3) homogeneous pixels.
    """
    R, t = T[:3, :3], T[:3, 3]
    first, second = inverses
    across = _cross_matrix(t)
    changes = [across @ _cross_matrix(axis) @ R for axis in np.eye(3)]
    changes += [_cross_matrix(np.cross(axis, t)) @ R for axis in _turns(t)]
    distances, by_matrix = _sampson(second.T @ across @ R @ first, a, b)
    return distances, by_matrix @ np.stack([(second.T @ change @ first).ravel() for change in changes], axis=-1)


def _facing(T: Array, K_first: Array, K_second: Array, a: Array, b: Array) -> Array | None:
    """The one of the four poses with the E of T that has the points in front of both cameras; None if there is none."""
    poses = poses_from_essential(essential_from_pose(T))
    counts = [np.count_nonzero(in_front(K_first, K_second, other, a, b)) for other in poses]
    best = int(np.argmax(counts))
    return poses[best] if counts[best] >= MIN_IN_FRONT * len(a) else None


def _starting_poses(a: Array, b: Array, K_first: Array, K_second: Array) -> list[Array]:
    """Poses (4, 4) to start from: the best `STARTS` different solutions of the five-point algorithm."""
    import cv2

    xa, xb = (np.ascontiguousarray(rays(projection_matrix(K), x)[:, :2]) for K, x in ((K_first, a), (K_second, b)))
    random = np.random.default_rng(0)
    found: list[Array] = []
    for _ in range(SAMPLES):
        five = random.choice(len(xa), 5, replace=False)
        E, _ = cv2.findEssentialMat(xa[five], xb[five], np.eye(3), cv2.RANSAC, 0.999, 1e-9)
        if E is not None:
            found += [one for one in E.reshape(-1, 3, 3) if np.isfinite(one).all()]
    ha, hb = homogeneous(xa), homogeneous(xb)
    found.sort(key=lambda E: float(np.nansum(np.minimum(_sampson(E, ha, hb)[0] ** 2, 1e-2))))
    starts: list[Array] = []
    for E in found:
        T = _poses_of(E)[0]  # the solver's E is accurate to a few digits only, which is enough for a start
        if all(
            np.abs(essential_from_pose(T) - s * essential_from_pose(other)).max() > DIFFERENT_E
            for other in starts
            for s in (1, -1)
        ):
            starts.append(T)
        if len(starts) == STARTS:
            break
    return starts


SAMPLES = 20
"""Number of minimal samples that the five-point algorithm solves to find starts. All pairs are correct here, so that
noise alone spoils a sample; more samples take more time and make the best one better."""

STARTS = 4
"""Number of different starts from which the Sampson distances are minimised. Two poses can explain the points nearly as
well and both must be found; more starts take time in proportion."""

DIFFERENT_E = 0.02
"""Difference of an entry of E, as a ratio to its norm, up to which two solutions count as one start, because descents
from both usually end in the same minimum."""
