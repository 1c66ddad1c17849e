# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera from points that are known in space: perspective n points, with covariance and ambiguity.

The pose has 6 parameters, each point gives two equations; three points leave up to four poses, so four are needed.
The image of a plane can be explained nearly as well by a second, mirrored tilt (Schweighofer, Pinz: "Robust pose
estimation from a planar target", PAMI 2006): every pose that the noise does not tell from the best is reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rangesim.geometry import consensus
from rangesim.geometry.camera_matrix import calibration_matrix, ideal_pixels
from rangesim.geometry.correspondences import (
    ROUNDING,
    Array,
    check_distinct,
    check_noise,
    checked_array,
    right_singular_vectors,
)
from rangesim.geometry.least_squares import Minimum, minimise
from rangesim.geometry.reprojection import reproject
from rangesim.rig import Intrinsics

PARAMETERS = 6
PLANAR = 1e-3
"""Points whose third principal extent is below this fraction of the first are also treated as a plane."""
MAX_ROTATION_DEVIATION = 0.3
"""Radians; a pose known worse than this is no pose."""
TRIPLES, STARTS = 20, 6
"""Triples of points that are solved, and the best solutions that are refined."""


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Where a camera stands.

    T_camera_object : (4, 4) float64, maps coordinates of the points to the camera's, metres. covariance : (6, 6) of
    (rotation vector applied after R, rad; t, metres). noise_px : standard deviation of a coordinate, as given or from
    the residuals. inliers : (n,) bool. others : poses (4, 4) that the noise does not tell from this one, best first;
    none if it is sure.
    """

    T_camera_object: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray
    others: tuple[Array, ...]

    @property
    def is_ambiguous(self) -> bool:
        """Whether another pose explains the points as well."""
        return len(self.others) > 0


def fit_camera_pose(
    points: ArrayLike, pixels: ArrayLike, camera: Intrinsics, *, noise_px: float | None = None
) -> CameraPose:
    """The pose of maximum likelihood for Gaussian noise of the pixels, all pairs being right, and its covariance.

    Minimises the reprojection error through the lens, distortion included, by Levenberg-Marquardt over the 6
    parameters, from OpenCV's SQPNP (Terzakis, Lourakis 2020), of planes its IPPE (Collins, Bartoli 2014), which gives
    both tilts, and P3P of triples. Of the minima that differ, the best is the pose; those with posterior odds above
    1e-5 are its `others`.

    Parameters
    ----------
    points : (n, 3) metres, coordinates of the object, n >= 4; they may lie far from its origin, as map coordinates do.
    pixels : (n, 2), as the camera shows them.
    noise_px : standard deviation of a coordinate; None: from the residuals.

    Raises
    ------
    ValueError
        Fewer than four different points; points on one line, or so nearly that the noise decides; pixels that no ray
        of the lens reaches; no pose has the points in front of the camera; or the residuals are over three times the
        stated noise.
    """
    X, x = _checked(points, pixels, camera, 4)
    check_noise(noise_px)
    middle = X.mean(axis=0)
    return _from_middle(_fitted(X - middle, x, camera, noise_px), middle)


def find_camera_pose(
    points: ArrayLike, pixels: ArrayLike, camera: Intrinsics, noise_px: float = 1.0, *, seed: int = 0
) -> CameraPose:
    """The pose that most pairs agree with: OpenCV's USAC over P3P, then `fit_camera_pose` until the inliers stay.

    A pair is an inlier where its error is below the 99 % quantile at `noise_px`, in front of the camera. The same
    seed gives the same result.

    Parameters
    ----------
    points : (n, 3) metres, n >= 6. pixels : (n, 2). noise_px : of a right pair.

    Raises
    ------
    ValueError
        As `fit_camera_pose`, or no more pairs agree than chance would let.
    """
    import cv2

    X, x = _checked(points, pixels, camera, 6)
    check_noise(noise_px)
    middle = X.mean(axis=0)
    X = X - middle
    threshold = consensus.inlier_threshold(noise_px, 2)
    ideal = ideal_pixels(camera, x)
    found = cv2.solvePnPRansac(
        X, ideal, calibration_matrix(camera), np.zeros(5), params=consensus.usac(threshold, seed)
    )
    chosen = np.zeros(len(X), dtype=bool)
    if found[0] and found[4] is not None:
        chosen[np.asarray(found[4]).ravel()] = True
    _refuse_chance(int(chosen.sum()), x, threshold)

    def fit(some: np.ndarray) -> CameraPose:
        return fit_camera_pose(X[some], x[some], camera, noise_px=noise_px)

    def error(model: CameraPose) -> Array:
        return _errors(model.T_camera_object, X, x, camera)

    model, inliers = consensus.consistent_set(chosen, threshold, fit, error, least=4)
    _refuse_chance(int(inliers.sum()), x, threshold)
    residuals = error(model)[inliers]
    noise = float(np.sqrt(residuals @ residuals / (2 * len(residuals) - PARAMETERS)))
    covariance = model.covariance * (noise / noise_px) ** 2
    return _from_middle(replace(model, inliers=inliers, noise_px=noise, covariance=covariance), middle)


def _fitted(X: Array, x: Array, camera: Intrinsics, noise_px: float | None) -> CameraPose:
    """`fit_camera_pose` of points that are near the origin."""
    extents = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if extents[1] <= ROUNDING * extents[0]:
        raise ValueError(
            f"expected points that are not on one line, got {len(X)} that are: the turn about it is open; add points "
            "beside it."
        )
    minima: list[Minimum[Array]] = []
    for start in _starting_poses(X, x, camera, is_planar=extents[2] <= PLANAR * extents[0]):
        found = minimise(lambda T: _residuals(T, X, x, camera), _moved, start)
        if not any(_is_same(found.state, other.state) for other in minima):
            minima.append(found)
    if not minima:
        raise ValueError(
            "expected points in front of the camera, got pairs that no pose puts there; check them and the camera."
        )
    minima.sort(key=lambda minimum: minimum.cost)
    best, freedom = minima[0], 2 * len(X) - PARAMETERS
    consensus.refuse_misfit(best.cost, freedom, noise_px, "one pose")
    noise = best.noise(PARAMETERS) if noise_px is None else noise_px
    covariance = best.covariance(max(noise, 1e-300))
    if not np.sqrt(np.trace(covariance[:3, :3])) <= MAX_ROTATION_DEVIATION:
        raise ValueError(
            f"expected points that determine a pose, got some that leave its rotation open at a noise of {noise:.3g} "
            "px: nearly on one line, too near to each other, or pairs that do not belong together; add points, or "
            "look at the pairs."
        )
    rounding = consensus.rounding_of(x)
    others = tuple(
        other.state
        for other in minima[1:]
        if consensus.odds_are_open(other.cost, best.cost, freedom, noise_px, rounding)
    )
    return CameraPose(best.state, covariance, float(noise), np.ones(len(X), dtype=bool), others)


def _from_middle(found: CameraPose, middle: Array) -> CameraPose:
    """The pose for the points as given, of the one for points moved by -middle (3,)."""

    def shifted(T: Array) -> Array:
        result = T.copy()
        result[:3, 3] = T[:3, 3] - T[:3, :3] @ middle
        return result

    m = found.T_camera_object[:3, :3] @ middle
    carry = np.eye(6)  # t - exp(w) R m: a turn w moves the translation by m x w
    carry[3:, :3] = np.array([[0.0, -m[2], m[1]], [m[2], 0.0, -m[0]], [-m[1], m[0], 0.0]])
    return replace(
        found,
        T_camera_object=shifted(found.T_camera_object),
        covariance=carry @ found.covariance @ carry.T,
        others=tuple(shifted(T) for T in found.others),
    )


def _checked(points: ArrayLike, pixels: ArrayLike, camera: Intrinsics, least: int) -> tuple[Array, Array]:
    X, x = checked_array("points", points, None, 3), checked_array("pixels", pixels, None, 2)
    if X.ndim != 2 or x.shape != (len(X), 2):
        raise ValueError(f"expected points (n, 3) and as many pixels (n, 2), got {X.shape} and {x.shape}.")
    for name, values in (("points", X), ("pixels", x)):
        check_distinct(name, values, least, "a camera's pose (three leave up to four poses)")
    beyond = int(np.count_nonzero(~np.isfinite(camera.normalise(x)).all(axis=-1)))
    if beyond:
        raise ValueError(
            f"expected pixels that a ray through the lens reaches, got {beyond} beyond its fold; leave them out."
        )
    return X, x


def _refuse_chance(agreeing: int, pixels: Array, threshold: float) -> None:
    area, _ = consensus.bounding_area(pixels)
    if consensus.agree_by_chance(agreeing, len(pixels), 3, np.pi * threshold**2 / area):
        raise ValueError(
            f"expected the image of points in one pose, got {len(pixels)} pairs of which at most {agreeing} agree, no "
            "more than chance; the pairs are wrong, or the camera or noise_px is."
        )


def _moved(T: Array, delta: Array) -> Array:
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(delta[:3]).as_matrix() @ T[:3, :3]
    result[:3, 3] = T[:3, 3] + delta[3:]
    return result


def _residuals(T: Array, X: Array, x: Array, camera: Intrinsics) -> tuple[Array, Array]:
    """(2n,) reprojection errors in pixels, and (2n, 6) their derivatives by the step of `_moved`."""
    turned = X @ T[:3, :3].T
    pixels, by_point, appears = reproject(camera, turned + T[:3, 3])
    off = pixels - x
    by_turn = np.cross(turned[:, None, :], by_point)  # p . (w x q) = w . (q x p)
    jacobian = np.concatenate([by_turn, by_point], axis=-1)
    off[~appears] = np.inf
    return off.ravel(), jacobian.reshape(-1, 6)


def _errors(T: Array, X: Array, x: Array, camera: Intrinsics) -> Array:
    """(n,) distances in pixels; infinite behind the camera."""
    with np.errstate(invalid="ignore", over="ignore"):
        errors = np.linalg.norm(camera.project(X @ T[:3, :3].T + T[:3, 3]) - x, axis=-1)
    return np.nan_to_num(errors, copy=False, nan=np.inf, posinf=np.inf)


def _is_same(T: Array, other: Array, tolerance: float = 1e-3) -> bool:
    """Whether two poses differ by less than the tolerance, in radians and relative to the distance."""
    apart = np.linalg.norm(T[:3, 3] - other[:3, 3]) / np.linalg.norm(other[:3, 3])
    turned = np.linalg.norm(T[:3, :3] - other[:3, :3])  # Frobenius: 2 sqrt(2) sin(angle / 2)
    return bool(turned < math.sqrt(8) * math.sin(tolerance / 2) and apart < tolerance)


def _starting_poses(X: Array, x: Array, camera: Intrinsics, is_planar: bool) -> list[Array]:
    """Poses (4, 4) with all points in front of the camera, the best of what OpenCV's solvers find."""
    import cv2

    K, none, ideal = calibration_matrix(camera), np.zeros(5), ideal_pixels(camera, x)
    found: list[tuple[Array, Array]] = []
    _, rotations, translations, _ = cv2.solvePnPGeneric(X, ideal, K, none, flags=cv2.SOLVEPNP_SQPNP)
    found += zip(rotations, translations, strict=True)
    if is_planar:
        middle = X.mean(axis=0)
        axes = right_singular_vectors(X - middle)[1]
        axes[2] *= np.sign(np.linalg.det(axes))
        flat = (X - middle) @ axes.T
        flat[:, 2] = 0
        _, rotations, translations, _ = cv2.solvePnPGeneric(flat, ideal, K, none, flags=cv2.SOLVEPNP_IPPE)
        for vector, t in zip(rotations, translations, strict=True):
            R = Rotation.from_rotvec(vector.ravel()).as_matrix() @ axes
            found.append((Rotation.from_matrix(R).as_rotvec(), t.ravel() - R @ middle))
    random = np.random.default_rng(0)
    triples = np.array([random.choice(len(X), 3, replace=False) for _ in range(TRIPLES)])
    extents = np.linalg.svd(X[triples] - X[triples].mean(axis=1, keepdims=True), compute_uv=False)
    for three in triples[extents[:, 1] > 1e-6 * extents[:, 0]]:
        _, rotations, translations = cv2.solveP3P(X[three], ideal[three], K, none, flags=cv2.SOLVEPNP_P3P)
        found += zip(rotations, translations, strict=True)
    if not found:
        return []
    poses = np.tile(np.eye(4), (len(found), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec([np.ravel(vector) for vector, _ in found]).as_matrix()
    poses[:, :3, 3] = [np.ravel(t) for _, t in found]
    cost = np.array([(_errors(T, X, x, camera) ** 2).sum() for T in poses])
    starts: list[Array] = []
    for T in poses[np.argsort(cost, kind="stable")[: np.isfinite(cost).sum()]]:
        if not any(_is_same(T, other, 0.03) for other in starts):
            starts.append(T)
        if len(starts) == STARTS:
            break
    return starts
