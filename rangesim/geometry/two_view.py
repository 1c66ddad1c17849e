# SPDX-License-Identifier: Apache-2.0
"""Two views of a scene: fundamental and essential matrix, from cameras and from points; epipolar lines; relative pose.

Corresponding pixels x (first view) and x' (second view) satisfy x'^T F x = 0. F has rank 2 and 7 degrees of freedom;
l' = F x and l = F^T x' are the epipolar lines, F e = 0 and F^T e' = 0 the epipoles. With known K the essential matrix
E = K'^T F K = [t]_x R has 5: the rotation and the direction of the translation of T_second_first, which maps
coordinates of the first camera to those of the second. Hartley, Zisserman: "Multiple View Geometry in Computer
Vision", 2nd edition 2004 (HZ), chapters 9 to 11.

Pixels are those of a pinhole: take lens distortion out first (`camera_matrix.ideal_pixels`).

Degenerate pairs of views raise ValueError, judged by the noise of the data (`consensus.simpler_model_suffices`):
points of one plane and a camera that only rotates map by a homography, which infinitely many F contain; the same view
twice is one of these. For the relative pose a rotation alone has no translation, and a plane has two poses that
differ little in what is seen: find the pose of a known plane by `camera_pose`. Points on a ruled quadric that contains
both centres have up to three F (HZ 22.2): they are looked for, and refused where the noise does not tell them apart.
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

PARAMETERS = 7
OF_POSE = 5
OF_ROTATION = 3
MAX_PIXELS = 1e5
"""Coordinates of images, about."""
MAX_LINES = 5
"""Number of pairs off a plane, those of the largest parallax, along whose lines other epipoles are looked for."""
EPIPOLES_PER_LINE = 90
"""Number of epipoles tried along such a line, one every 2 degrees of its directions in normalised coordinates."""
MIN_EXTENT = 0.05
"""Coordinates of the smallest images, roughly: a lens of 6 degrees in units of its focal length."""
SINGLE_ROUNDING = 1e-6
"""Relative error of a few operations in single precision, in which matrices of other programs come."""
ANOTHER = 0.02
"""Difference of an entry of F, at unit norm in normalised coordinates, from which on it is another one."""
MAX_STANDARD_DEVIATION = 0.3
"""Of F at unit norm in normalised coordinates, 1 at most: beyond, the noise determines it and not the points."""


# ------------------------------------------------------------------------------------------- from cameras


def fundamental_from_cameras(first: ArrayLike, second: ArrayLike) -> Array:
    """(3, 3) F of two camera matrices (3, 4): [P' C]_x P' P^+, C the centre of the first (HZ 9.1); unit norm.

    Raises
    ------
    ValueError
        Both have one centre: the views are related by a homography, and there is no F.
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
    """Two camera matrices (3, 4) for a world whose origin is the first one's centre, and that centre (3,) in metres.

    At map coordinates the last column is so large that the distance of the cameras is rounding beside it; points and
    epipoles are solved for here, and points moved back. An affine camera, which has no centre, changes nothing.
    """
    rows = np.linalg.norm(p[..., :3], axis=-1)  # pixels against 1
    if p.ndim != 2 or q.ndim != 2 or not rows.all():
        return p, q, np.zeros(3)
    block = p[:, :3] / rows[:, None]
    if abs(np.linalg.det(block)) <= ROUNDING**1.5:
        return p, q, np.zeros(3)
    origin = np.linalg.solve(block, -p[:, 3] / rows)
    moved = [np.hstack([P[:, :3], (P[:, 3] + P[:, :3] @ origin)[:, None]]) for P in (p, q)]
    return moved[0], moved[1], origin


SHIFT_ROUNDING = 64 * float(np.finfo(np.float64).eps)
"""Error of the last column, of the given one and of the move, relative to the distance it was moved by."""


def essential_from_pose(T_second_first: ArrayLike) -> Array:
    """(3, 3) E = [t]_x R of the relative pose (4, 4), t at unit length; ValueError if t is 0."""
    T = pose(T_second_first, "T_second_first")
    return _cross_matrix(_direction(T[:3, 3])) @ T[:3, :3]


def fundamental_from_pose(K_first: ArrayLike, K_second: ArrayLike, T_second_first: ArrayLike) -> Array:
    """(3, 3) F = K'^-T [t]_x R K^-1 at unit norm; ValueError if t is 0."""
    first, second = (np.linalg.inv(checked_array("K", K, 3, 3)) for K in (K_first, K_second))
    return unit_norm(second.T @ essential_from_pose(T_second_first) @ first)


# ------------------------------------------------------------------------------------------- lines and epipoles


class Epipoles(NamedTuple):
    """first, second : (3,) homogeneous pixels, where each view has the other's centre; unit norm."""

    first: Array
    second: Array


def epipoles(F: ArrayLike) -> Epipoles:
    """The null vectors F e = 0 and F^T e' = 0; their last entry is 0 where the epipole lies at infinity."""
    left, _, right = np.linalg.svd(_checked_F(F))
    return Epipoles(right[2], left[:, 2])


def lines_in_second(F: ArrayLike, first: ArrayLike) -> Array:
    """(n, 3) epipolar lines l' = F x in the second view of pixels (n, 2) of the first; a^2 + b^2 = 1, so that l' x'
    is a distance in pixels. The epipole itself has none: NaN."""
    return _normalised_lines(homogeneous(first) @ _checked_F(F).T)


def lines_in_first(F: ArrayLike, second: ArrayLike) -> Array:
    """(n, 3) epipolar lines l = F^T x' in the first view of pixels (n, 2) of the second; see `lines_in_second`."""
    return _normalised_lines(homogeneous(second) @ _checked_F(F))


def sampson_distance(F: ArrayLike, first: ArrayLike, second: ArrayLike) -> Array:
    """(n,) signed pixels: x'^T F x / |its gradient|, to first order how far x and x' together are from an exact pair.

    Its square is the least |dx|^2 + |dx'|^2 (HZ 11.4.3). NaN where both points are the epipoles.
    """
    return _sampson(_checked_F(F), homogeneous(first), homogeneous(second))[0]


# ------------------------------------------------------------------------------------------- F from points


@dataclass(frozen=True, eq=False)
class FundamentalMatrix:
    """F of two views and how well it is known.

    matrix : (3, 3) float64, rank 2, unit norm. covariance : (9, 9) of `matrix`, row by row, rank 7; NaN if the noise is
    unknown. noise_px : standard deviation of a coordinate, as given or from the residuals. inliers : (n,) bool.
    """

    matrix: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray


def seven_point(first: ArrayLike, second: ArrayLike) -> Array:
    """(k, 3, 3) the one to three F that seven pairs (7, 2) allow, rank 2, unit norm (HZ 11.1.2).

    det(a F1 + (1 - a) F2) = 0 in the two-dimensional null space of the seven equations.

    Raises
    ------
    ValueError
        Not seven different pairs, or such that their equations depend on each other, as those of coplanar points do.
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
    """(3, 3) F by the normalised eight-point algorithm (Hartley 1997; HZ 11.2), rank 2 enforced, unit norm.

    Raises
    ------
    ValueError
        Fewer than eight different pairs, or exactly degenerate ones: coplanar points, a rotation alone, one view twice.
        With noise they do not look exact here; `fit_fundamental` tells.
    """
    a, b = checked_pairs(first, second, 8, "the eight-point algorithm")
    from_a, from_b = normalising_transform(a), normalising_transform(b)
    values, axes = right_singular_vectors(_design(apply_similarity(from_a, a), apply_similarity(from_b, b)))
    if values[7] <= ROUNDING * values[0]:
        raise ValueError(_DEPENDENT.format(n=len(a)))
    return unit_norm(from_b.T @ _rank_two(axes[8].reshape(3, 3)) @ from_a)


def fit_fundamental(first: ArrayLike, second: ArrayLike, *, noise_px: float | None = None) -> FundamentalMatrix:
    """F of maximum likelihood for Gaussian noise in both views, all pairs being right, and its covariance.

    Minimises the sum of squared Sampson distances, to first order the reprojection error of HZ algorithm 11.3, over the
    7 dimensions of matrices of rank 2 and unit norm: steps U [A, b; c^T, 0] V^T, with F = U D V^T, then the nearest
    matrix of rank 2. From `eight_point` by Levenberg-Marquardt.

    Parameters
    ----------
    first, second : (n, 2) pixels, n >= 8.
    noise_px : standard deviation of a coordinate; None: from the residuals, which takes more than eight pairs to be
        sure that data are not degenerate.

    Raises
    ------
    ValueError
        As `eight_point`; or a homography explains the points to their noise: a plane, a rotation alone, one view twice;
        or it explains all but a few, which leave the epipole open, as one point off a plane does; or the residuals are
        over three times the stated noise.
    """
    a, b = checked_pairs(first, second, 8, "a fundamental matrix")
    check_noise(noise_px)
    from_a, from_b = normalising_transform(a), normalising_transform(b)
    unit_a, unit_b = apply_similarity(from_a, a), apply_similarity(from_b, b)
    start = np.linalg.inv(from_b).T @ eight_point(a, b) @ np.linalg.inv(from_a)
    # one pixel is as long in both views only if both are scaled alike, which is what the Sampson distance weighs
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
    consensus.refuse_misfit(found.cost / scale**2, len(a) - PARAMETERS, noise_px, "an epipolar geometry")
    noise = found.noise(PARAMETERS) / scale if noise_px is None else noise_px
    _refuse_homography(a, b, found.cost / scale**2, PARAMETERS, noise_px)
    rounding = consensus.rounding_of(np.concatenate([a, b]))
    for other in minima:
        apart = min(np.abs(other.state - sign * found.state).max() for sign in (1, -1))
        costs = other.cost / scale**2, found.cost / scale**2
        if apart > ANOTHER and consensus.is_as_likely(*costs, len(a) - PARAMETERS, noise_px, rounding):
            raise ValueError(
                f"expected points with one fundamental matrix, got {len(a)} pairs that two explain to their noise: "
                "the points lie on a surface that contains both centres, or are few; add points at other depths."
            )
    _refuse_open_epipole(a, b, from_a, from_b, found, scale, max(noise, rounding))
    in_tangent = found.covariance(max(noise * scale, 1e-300))
    tangent = _tangent(found.state)
    normal = tangent @ in_tangent @ tangent.T
    if not np.sqrt(np.trace(normal)) <= MAX_STANDARD_DEVIATION:
        raise ValueError(
            "expected points that determine the fundamental matrix, got some that leave it open at a noise of "
            f"{noise:.3g} px: near to a plane, to a surface that contains both centres, or with too small a baseline; "
            "add points at other depths."
        )
    to_pixels = np.kron(from_b.T, from_a.T)
    covariance = covariance_of_unit_norm(found.state, to_pixels, normal)
    return FundamentalMatrix(
        unit_norm(from_b.T @ found.state @ from_a), covariance, float(noise), np.ones(len(a), dtype=bool)
    )


def find_fundamental(first: ArrayLike, second: ArrayLike, noise_px: float = 1.0, *, seed: int = 0) -> FundamentalMatrix:
    """F that most pairs agree with: OpenCV's USAC, then `fit_fundamental` to its inliers until they stay.

    Parameters
    ----------
    first, second : (n, 2) pixels, n >= 9.
    noise_px : standard deviation of a coordinate of a right pair; an inlier's Sampson distance is below its 99 %
        quantile.

    Raises
    ------
    ValueError
        As `fit_fundamental`; no more pairs agree than chance lets; or those off the best homography do so by chance,
        which would hide a plane or a rotation with some wrong pairs.
    """
    import cv2

    a, b = checked_pairs(first, second, 9, "a robust fundamental matrix")
    check_noise(noise_px)
    threshold = consensus.inlier_threshold(noise_px, 1)
    found, mask = cv2.findFundamentalMat(a, b, consensus.usac(threshold, seed))
    _refuse_chance(0 if found is None else int(mask.sum()), a, b, threshold, PARAMETERS)

    def fit(chosen: np.ndarray) -> FundamentalMatrix:
        return fit_fundamental(a[chosen], b[chosen], noise_px=noise_px)

    def error(model: FundamentalMatrix) -> Array:
        return np.abs(sampson_distance(model.matrix, a, b))

    chosen = mask.ravel() > 0
    model, inliers = consensus.consistent_set(chosen, threshold, fit, error, least=9)
    _refuse_chance(int(inliers.sum()), a, b, threshold, PARAMETERS)
    _refuse_plane_with_outliers(a, b, inliers, noise_px)
    noise = _noise_of(sampson_distance(model.matrix, a[inliers], b[inliers]), PARAMETERS)
    return replace(model, inliers=inliers, noise_px=noise, covariance=model.covariance * (noise / noise_px) ** 2)


# ------------------------------------------------------------------------------------------- pose from points


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Where the second camera stands as seen from the first, up to the length of the baseline.

    T_second_first : (4, 4), maps coordinates of the first camera to the second's; |t| = 1, for points alone do not
    know it. covariance : (5, 5) of (rotation vector applied after R, rad; two orthogonal turns of t, rad); NaN if the
    noise is unknown. noise_px : standard deviation of a coordinate. inliers : (n,) bool.
    """

    T_second_first: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray

    @property
    def essential(self) -> Array:
        """(3, 3) E = [t]_x R."""
        return essential_from_pose(self.T_second_first)


def poses_from_essential(E: ArrayLike) -> Array:
    """(4, 4, 4) the four T_second_first with E = [t]_x R up to scale and sign, |t| = 1 (HZ 9.6.2).

    Raises
    ------
    ValueError
        The singular values are not (s, s, 0), to 1e-3: it is no essential matrix.
    """
    matrix = checked_array("E", E, 3, 3)
    values = np.linalg.svd(matrix, compute_uv=False)
    if not (values[0] > 0 and values[0] - values[1] <= 1e-3 * values[0] and values[2] <= 1e-3 * values[0]):
        raise ValueError(f"expected an essential matrix with singular values (s, s, 0), got {values.tolist()}.")
    return _poses_of(matrix)


def _poses_of(E: Array) -> Array:
    """(4, 4, 4) the same of the essential matrix nearest to E."""
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
    """(n,) bool: the rays through pixels (n, 2) come nearest to each other in front of both cameras (cheirality)."""
    T = np.asarray(T_second_first, dtype=np.float64)
    d = rays(projection_matrix(K_first), first) @ T[:3, :3].T
    e = rays(projection_matrix(K_second), second)
    t = T[:3, 3]
    # z d + t = z' e in the least-squares sense
    dd, de, ee = (d * d).sum(-1), (d * e).sum(-1), (e * e).sum(-1)
    dt, et = d @ t, e @ t
    determinant = dd * ee - de**2
    return np.asarray((de * et - ee * dt > 0) & (dd * et - de * dt > 0) & (determinant > 0))


def fit_relative_pose(
    first: ArrayLike, second: ArrayLike, K_first: ArrayLike, K_second: ArrayLike, *, noise_px: float | None = None
) -> RelativePose:
    """The relative pose of maximum likelihood for Gaussian noise, all pairs being right, and its covariance.

    Minimises the squared Sampson distances in pixels over rotation and direction of translation, 5 parameters, from
    several solutions of the five-point algorithm (Nister 2004, by OpenCV), each in the one of its four poses that has
    the points in front.

    Parameters
    ----------
    first, second : (n, 2) pixels, n >= 6.
    K_first, K_second : (3, 3).

    Raises
    ------
    ValueError
        Fewer than six different pairs; a rotation alone (also: the same view twice) or a plane explains them to their
        noise; two poses explain them alike; no pose has them in front of both cameras; or the
        residuals are over three times the stated noise.
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
    _refuse_homography(a, b, least, OF_POSE, noise_px)
    if not minima:
        raise ValueError(
            "expected points in front of both cameras, got pairs that no pose puts there: the camera only rotates, "
            "the pairs are wrong, or K is."
        )
    best, freedom = minima[0], len(a) - OF_POSE
    rounding = consensus.rounding_of(np.concatenate([a, b]))
    for other in minima[1:]:
        if consensus.is_as_likely(other.cost, best.cost, freedom, noise_px, rounding):
            angle = np.degrees(_angle(other.state[:3, :3] @ best.state[:3, :3].T))
            raise ValueError(
                f"expected points with one relative pose, got two that explain them to their noise, {angle:.1f} "
                "degrees apart: they lie on a plane, or are few; add points off it."
            )
    consensus.refuse_misfit(best.cost, freedom, noise_px, "a relative pose")
    noise = best.noise(OF_POSE) if noise_px is None else noise_px
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
    """The relative pose that most pairs agree with: OpenCV's USAC, then `fit_relative_pose` until the inliers stay.

    Parameters and errors are those of `fit_relative_pose`, with n >= 8; also ValueError if no more pairs agree than
    chance would let.
    """
    import cv2

    a, b = checked_pairs(first, second, 8, "a robust relative pose")
    check_noise(noise_px)
    kf, ks = checked_array("K_first", K_first, 3, 3), checked_array("K_second", K_second, 3, 3)
    threshold = consensus.inlier_threshold(noise_px, 1)
    none = np.zeros(5)
    found, mask = cv2.findEssentialMat(a, b, kf, ks, none, none, consensus.usac(threshold, seed))
    _refuse_chance(0 if found is None else int(mask.sum()), a, b, threshold, OF_POSE)

    def fit(chosen: np.ndarray) -> RelativePose:
        return fit_relative_pose(a[chosen], b[chosen], kf, ks, noise_px=noise_px)

    def error(model: RelativePose) -> Array:
        F = fundamental_from_pose(kf, ks, model.T_second_first)
        apart = np.abs(sampson_distance(F, a, b))
        return np.where(in_front(kf, ks, model.T_second_first, a, b), apart, np.inf)

    model, inliers = consensus.consistent_set(mask.ravel() > 0, threshold, fit, error, least=8)
    _refuse_chance(int(inliers.sum()), a, b, threshold, OF_POSE)
    _refuse_plane_with_outliers(a, b, inliers, noise_px)
    F = fundamental_from_pose(kf, ks, model.T_second_first)
    noise = _noise_of(sampson_distance(F, a[inliers], b[inliers]), OF_POSE)
    return replace(model, inliers=inliers, noise_px=noise, covariance=model.covariance * (noise / noise_px) ** 2)


# ------------------------------------------------------------------------------------------- degenerate views

_DEPENDENT = (
    "expected pairs that determine the fundamental matrix, got {n} whose equations depend on each other: points of "
    "one plane, a camera that only rotates, one view twice, or repeated points; add points at other depths or move "
    "the camera."
)
MIN_IN_FRONT = 0.75
"""Fraction of the points; the others may be so far that the noise decides on which side of infinity they are."""


def _refuse_homography(a: Array, b: Array, cost: float, parameters: int, noise_px: float | None) -> None:
    """Raise ValueError if a homography explains the pairs to their noise, as a model of `parameters` with `cost`
    does."""
    n, rounding = len(a), consensus.rounding_of(np.concatenate([a, b]))
    simple = homography_error(a, b), 2 * n - HOMOGRAPHY_PARAMETERS
    if consensus.simpler_model_suffices(simple, (cost, n - parameters), noise_px, rounding):
        apart = float(np.sqrt(simple[0] / simple[1]))
        same = np.sqrt(((a - b) ** 2).mean()) <= 3 * max(noise_px or 0.0, apart, rounding)
        what = "one view twice" if same else "points of one plane or a camera that only rotates"
        hint = "" if noise_px is not None or n > 12 else " With so few pairs, state noise_px if you know it."
        raise ValueError(
            f"expected two views with parallax, got {n} pairs that a homography maps to each other within {apart:.3g} "
            f"px: {what}; it leaves the epipoles open, or two poses. Add points at other depths or move the "
            f"camera.{hint}"
        )


def _refuse_open_epipole(
    a: Array, b: Array, from_a: Array, from_b: Array, found: Minimum[Array], scale: float, noise_px: float
) -> None:
    """Raise ValueError if a plane has most of the pairs and those off it leave the epipole open.

    A plane with the homography H allows F = [e']_x H with any e'. A pair off it puts e' on the line (H x) x x'. One
    such line leaves a family of F, and so do several that noise does not tell apart. The curvature at one minimum does
    not show it: it takes the noise of the plane's points for parallax. So e' moves along these lines, and the sum of
    squares of all pairs says which F of the family they admit.

    Parameters
    ----------
    from_a, from_b : (3, 3) similarities from pixels to the coordinates of `found`. scale : of these, per pixel.
    """
    plane = largest_plane(a, b, noise_px)
    off = np.flatnonzero(~plane)
    if 2 * len(off) >= len(a):
        return
    unit_a, unit_b = homogeneous(apply_similarity(from_a, a)), homogeneous(apply_similarity(from_b, b))
    H = from_b @ nearest_homography(a[plane], b[plane])[0] @ np.linalg.inv(from_a)
    mapped = unit_a[off] @ H.T
    parallax = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - unit_b[off, :2], axis=-1)
    farthest = np.argsort(-parallax)[:MAX_LINES]
    weights = (from_a[0, 0] / scale, from_b[0, 0] / scale)
    # the noise of the plane's points alone sets the sums of two members apart by 2 sqrt(n), as two chi^2 of n
    rise = consensus.chi2_limit(PARAMETERS) + 2 * np.sqrt(len(a))
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
                    f"{len(off)} lie on one plane: these leave the epipole open at a noise of {noise_px:.3g} px, and a "
                    "family of matrices explains all pairs; add points off the plane."
                )


def _refuse_rotation(a: Array, b: Array, K_first: Array, K_second: Array, cost: float, noise_px: float | None) -> None:
    """Raise ValueError if a rotation alone explains the pairs as well as a pose with `cost` in px^2, to their noise."""
    n, rounding = len(a), consensus.rounding_of(np.concatenate([a, b]))
    simple = rotation_homography_error(a, b, K_first, K_second), 2 * n - OF_ROTATION
    if consensus.simpler_model_suffices(simple, (cost, n - OF_POSE), noise_px, rounding):
        apart = float(np.sqrt(simple[0] / simple[1]))
        raise ValueError(
            f"expected a camera that moved, got {n} pairs that a rotation alone explains within {apart:.3g} px: there "
            "is no direction of translation; move the camera sideways."
        )


def _refuse_plane_with_outliers(a: Array, b: Array, inliers: np.ndarray, noise_px: float) -> None:
    """Raise ValueError if the pairs that agree with F but not with the largest plane agree by chance.

    A plane and any two pairs off it determine some F, wrong pairs too (Chum, Werner, Matas: "Two-view geometry
    estimation unaffected by a dominant plane", CVPR 2005); here those that agree with it are counted.
    """
    off = ~largest_plane(a, b, 2 * noise_px)  # twice as wide: no straggler of the plane counts as off it
    threshold = consensus.inlier_threshold(noise_px, 1)
    _refuse_chance(int((inliers & off).sum()), a[off], b[off], threshold, minimal=2, plane=True)


def _refuse_chance(agreeing: int, a: Array, b: Array, threshold: float, minimal: int, plane: bool = False) -> None:
    """Raise ValueError if the pairs that agree with an epipolar geometry are no more than chance lets.

    A wrong pair does if it lies within `threshold` of its epipolar line, in the area that the points span.
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
        "chance; the pairs are wrong, or noise_px is."
    )


# ------------------------------------------------------------------------------------------- the pieces


def _checked_F(F: ArrayLike) -> Array:
    matrix = checked_array("F", F, 3, 3)
    if matrix.ndim != 2:
        raise ValueError(f"expected F of shape (3, 3), got {matrix.shape}.")
    # pixels against ones: in units of some hundred pixels the blocks of F are of one size
    block, border = np.linalg.norm(matrix[:2, :2]), max(np.linalg.norm(matrix[2, :2]), np.linalg.norm(matrix[:2, 2]))
    # an epipole at the origin, as of forward motion, leaves a border that is rounding and tells no unit
    has_unit = block > 0 and border > SINGLE_ROUNDING * block
    unit = min(max(border / block, MIN_EXTENT), MAX_PIXELS) if has_unit else 1.0
    values = np.linalg.svd(matrix * np.outer([unit, unit, 1], [unit, unit, 1]), compute_uv=False)
    if not (values[1] > 1e-12 * values[0] and values[2] <= 1e-6 * values[0]):
        raise ValueError(f"expected F of rank 2, got singular values {values.tolist()} after scaling.")
    return matrix


def _noise_of(residuals: Array, parameters: int) -> float:
    return float(np.sqrt(residuals @ residuals / (len(residuals) - parameters)))


def _design(a: Array, b: Array) -> Array:
    """(n, 9) rows x' (x) x of the equations x'^T F x = 0."""
    return np.asarray((homogeneous(b)[:, :, None] * homogeneous(a)[:, None, :]).reshape(len(a), 9))


def _singular_members(one: Array, two: Array) -> list[Array]:
    """The one to three matrices two + s one, or one, whose determinant is 0."""
    # the cubic through four of its values; where its highest term vanishes, `one` itself is singular
    places = np.array([-1.0, 0.0, 1.0, 2.0])
    cubic = np.polyfit(places, [np.linalg.det(two + s * one) for s in places], 3)
    negligible = np.abs(cubic) < 1e-14 * np.abs(cubic).max()
    roots = np.roots(np.where(negligible, 0.0, cubic))
    found = [two + s * one for s in roots.real[np.abs(roots.imag) <= 1e-6 * (1 + np.abs(roots))]]
    return [*found, one] if negligible[0] else found


def _rank_two(F: Array) -> Array:
    """The nearest matrix of rank 2."""
    u, values, vt = np.linalg.svd(F)
    return np.asarray((u[:, :2] * values[:2]) @ vt[:2])


def _tangent(F: Array) -> Array:
    """(9, 7) orthonormal directions in which a matrix of rank 2 and unit norm can change: U M V^T, M33 = 0, not along
    F."""
    u, values, vt = np.linalg.svd(F)
    basis = np.kron(u, vt.T)[:, :8]  # columns vec(u_i v_j^T), the last of which, (3, 3), is left out
    along = np.zeros((1, 8))
    along[0, [0, 4]] = values[:2]
    return np.asarray(basis @ np.linalg.svd(along)[2][1:].T)


def _sampson(F: Array, a: Array, b: Array, weights: tuple[float, float] = (1.0, 1.0)) -> tuple[Array, Array]:
    """(n,) Sampson distances of homogeneous points (n, 3), and (n, 9) their derivatives by F.

    weights : how large a pixel of each view is in these coordinates.
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
    norms = np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)
    return np.asarray(lines / np.where(norms > 0, norms, np.nan))


def _cross_matrix(t: Array) -> Array:
    """(3, 3) [t]_x with [t]_x v = t x v."""
    return np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])


def _direction(t: Array) -> Array:
    length = np.linalg.norm(t)
    if not length > 0:
        raise ValueError("expected two cameras that stand apart, got a translation of 0.")
    return np.asarray(t / length)


def _angle(rotation: Array) -> float:
    return float(Rotation.from_matrix(rotation).magnitude())


def _is_same(T: Array, other: Array) -> bool:
    """Whether two minima are one, found twice."""
    return bool(_angle(T[:3, :3] @ other[:3, :3].T) < 1e-3 and T[:3, 3] @ other[:3, 3] > 1 - 1e-4)


def _turns(t: Array) -> Array:
    """(2, 3) orthonormal axes orthogonal to t, about which a direction can turn."""
    return np.linalg.svd(t[None])[2][1:]


def _moved(T: Array, delta: Array) -> Array:
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(delta[:3]).as_matrix() @ T[:3, :3]
    result[:3, 3] = Rotation.from_rotvec(delta[3:] @ _turns(T[:3, 3])).as_matrix() @ T[:3, 3]
    return result


def _pose_residuals(T: Array, inverses: tuple[Array, Array], a: Array, b: Array) -> tuple[Array, Array]:
    """(n,) Sampson distances in pixels, and (n, 5) their derivatives by the step of `_moved`."""
    R, t = T[:3, :3], T[:3, 3]
    first, second = inverses
    across = _cross_matrix(t)
    changes = [across @ _cross_matrix(axis) @ R for axis in np.eye(3)]
    changes += [_cross_matrix(np.cross(axis, t)) @ R for axis in _turns(t)]
    distances, by_matrix = _sampson(second.T @ across @ R @ first, a, b)
    return distances, by_matrix @ np.stack([(second.T @ change @ first).ravel() for change in changes], axis=-1)


def _facing(T: Array, K_first: Array, K_second: Array, a: Array, b: Array) -> Array | None:
    """Of the four poses with the same E, the one with the points in front of both cameras; None if there is none."""
    poses = poses_from_essential(essential_from_pose(T))
    counts = [np.count_nonzero(in_front(K_first, K_second, other, a, b)) for other in poses]
    best = int(np.argmax(counts))
    return poses[best] if counts[best] >= MIN_IN_FRONT * len(a) else None


def _starting_poses(a: Array, b: Array, K_first: Array, K_second: Array) -> list[Array]:
    """Poses (4, 4) near which the right one may be: the best of the five-point algorithm."""
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
        T = _poses_of(E)[0]  # the solver's are essential to some digits only; a start need not be exact
        if all(
            np.abs(essential_from_pose(T) - s * essential_from_pose(other)).max() > 0.02
            for other in starts
            for s in (1, -1)
        ):
            starts.append(T)
        if len(starts) == STARTS:
            break
    return starts


SAMPLES, STARTS = 20, 4
"""Minimal samples that are solved, and the best solutions that are refined."""
