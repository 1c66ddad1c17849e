# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera from points with known positions (perspective-n-point), with covariance and ambiguity.

A pose has 6 parameters and each point gives two equations. Three points leave up to four poses, so four points are
needed. A second, mirrored tilt can explain the image of a plane nearly as well (Schweighofer, Pinz: "Robust pose
estimation from a planar target", PAMI 2006). So the result names every pose that the noise does not distinguish from
the best one.

Used by: rangesim.calibration.zhang and time_of_flight; rangesim.multiview.incremental_reconstruction and
sliding_window.
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

POSE_PARAMETERS = 6
"""Number of parameters of a pose: three of the rotation and three of the translation."""

MAX_PLANAR_FRACTION = 1e-3
"""Largest ratio of the third principal extent of the points to the first at which they are also treated as a plane. The
solver for planes then adds starts, and the other solvers still run, so that a larger value costs only time and a
smaller one may miss the second tilt of a target that is not quite flat."""

MAX_ROTATION_DEVIATION = 0.3
"""Largest standard deviation of the rotation, in radians; a pose that is known less well is refused. At 17 degrees the
linear covariance no longer holds. Closer limits were not measured."""

TRIPLES = 20
"""Number of triples of points that P3P solves to find starts, so that there is a start even if the other solvers fail
and noise spoils some of the triples. More triples cost time; of a few, noise may spoil all."""

STARTS = 6
"""Number of different starts from which the reprojection error is minimised: those with the smallest error. P3P has up
to four solutions and a plane two, so that six leave room for both."""

SAME_POSE = 1e-3
"""Difference in radians, and as a ratio to the distance, up to which two minima count as the same pose, because
descents to one minimum end much nearer to each other. A larger value could take two poses for one."""

SAME_START = 0.03
"""Difference in radians, and as a ratio to the distance, up to which two starts count as one, because the descents from
both usually end in the same minimum."""


@dataclass(frozen=True, eq=False)
class CameraPose:
    """The pose of a camera, with its covariance and the other poses that explain the same image.

    Attributes
    ----------
    T_camera_object : (4, 4) float64, maps object coordinates, those of the points, to camera coordinates, metres.
    covariance : (6, 6) float64, covariance of (rotation vector applied after R, rad; t, metres).
    noise_px : standard deviation of one coordinate of a pixel, as given or estimated from the residuals.
    inliers : (n,) bool, the pairs that agree with the pose.
    others : other poses (4, 4) that the noise does not distinguish from this one, the best first; often empty.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim import Intrinsics
    >>> camera = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5], [0.5, 0, 1]])
    >>> pose = fit_camera_pose(points, camera.project(points + [0, 0, 5]), camera, noise_px=0.1)
    >>> pose.T_camera_object[:3, 3].round(6) + 0.0, pose.is_ambiguous
    (array([0., 0., 5.]), False)
    """

    T_camera_object: Array
    covariance: Array
    noise_px: float
    inliers: np.ndarray
    others: tuple[Array, ...]

    @property
    def is_ambiguous(self) -> bool:
        """Whether another pose explains the image within the noise."""
        return len(self.others) > 0


def fit_camera_pose(
    points: ArrayLike, pixels: ArrayLike, camera: Intrinsics, *, noise_px: float | None = None
) -> CameraPose:
    """The maximum-likelihood pose for Gaussian noise of the pixels, with its covariance; all pairs must be correct.

    It minimises the reprojection error through the lens, with distortion, by Levenberg-Marquardt over the 6 parameters.
    The starts come from OpenCV's SQPNP (Terzakis, Lourakis 2020), from P3P of triples, and for planes from IPPE
    (Collins, Bartoli 2014), which gives both tilts. The best of the different minima is the pose. Minima with posterior
    odds above 1e-5 are its `others`.

    Parameters
    ----------
    points : (n, 3) object coordinates, metres, n >= 4. They may lie far from the origin, as map coordinates do.
    pixels : (n, 2) pixels of the distorted image.
    camera : Intrinsics of the camera.
    noise_px : standard deviation of one coordinate of a pixel; None estimates it from the residuals.

    Raises
    ------
    ValueError
        There are fewer than four different points; the points lie on one line, or so nearly that the noise decides; no
        ray through the lens reaches a pixel; no pose has the points in front of the camera; or the residuals are over
        three times the stated noise.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim import Intrinsics
    >>> camera = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> board = np.array([[x, y, 0] for x in (0, 0.1, 0.2) for y in (0, 0.1)])  # metres
    >>> pose = fit_camera_pose(board, camera.project(board + [0, 0, 1]), camera, noise_px=0.2)
    >>> pose.T_camera_object[:3, 3].round(6) + 0.0
    array([0., 0., 1.])
    """
    X, x = _checked(points, pixels, camera, 4)
    check_noise(noise_px)
    middle = X.mean(axis=0)
    return _from_middle(_fitted(X - middle, x, camera, noise_px), middle)


def find_camera_pose(
    points: ArrayLike, pixels: ArrayLike, camera: Intrinsics, noise_px: float = 1.0, *, seed: int = 0
) -> CameraPose:
    """The pose that most pairs agree with, although some pairs are wrong; with its covariance.

    OpenCV's USAC with P3P proposes inliers. `fit_camera_pose` is then fitted to the inliers, and the inliers are chosen
    again, until they no longer change. A pair is an inlier if its point lies in front of the camera and its error is
    below the 99 % quantile of the errors that `noise_px` causes. The same seed gives the same result.

    Parameters
    ----------
    points : (n, 3) object coordinates, metres, n >= 6.
    pixels : (n, 2) pixels of the distorted image.
    camera : Intrinsics of the camera.
    noise_px : standard deviation of one coordinate of a correct pixel.
    seed : state of the random numbers that USAC draws samples with.

    Raises
    ------
    ValueError
        `fit_camera_pose` refuses the inliers, or no more pairs agree than chance explains.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim import Intrinsics
    >>> camera = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> random = np.random.default_rng(0)
    >>> points = random.uniform(-1, 1, (40, 3))
    >>> pixels = camera.project(points + [0, 0, 6]) + random.normal(0, 0.5, (40, 2))
    >>> pixels[:8] = random.uniform(0, 480, (8, 2))  # wrong pairs
    >>> int(find_camera_pose(points, pixels, camera, noise_px=0.5).inliers[:8].sum())
    0
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
    noise = float(np.sqrt(residuals @ residuals / (2 * len(residuals) - POSE_PARAMETERS)))
    covariance = model.covariance * (noise / noise_px) ** 2
    return _from_middle(replace(model, inliers=inliers, noise_px=noise, covariance=covariance), middle)


def _fitted(X: Array, x: Array, camera: Intrinsics, noise_px: float | None) -> CameraPose:
    """The result of `fit_camera_pose` for points X (n, 3) near the origin and pixels x (n, 2)."""
    extents = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if extents[1] <= ROUNDING * extents[0]:
        raise ValueError(
            f"expected points that are not on one line, got {len(X)} that are: the rotation about that line is not "
            "determined; add points beside it."
        )
    minima: list[Minimum[Array]] = []
    for start in _starting_poses(X, x, camera, is_planar=extents[2] <= MAX_PLANAR_FRACTION * extents[0]):
        found = minimise(lambda T: _residuals(T, X, x, camera), _moved, start)
        if not any(_is_same(found.state, other.state, SAME_POSE) for other in minima):
            minima.append(found)
    if not minima:
        raise ValueError(
            "expected points in front of the camera, got pairs that no pose puts there; check the pairs and the camera."
        )
    minima.sort(key=lambda minimum: minimum.cost)
    best, freedom = minima[0], 2 * len(X) - POSE_PARAMETERS
    consensus.refuse_misfit(best.cost, freedom, noise_px, "one pose")
    noise = best.noise(POSE_PARAMETERS) if noise_px is None else noise_px
    covariance = best.covariance(max(noise, 1e-300))
    if not np.sqrt(np.trace(covariance[:3, :3])) <= MAX_ROTATION_DEVIATION:
        raise ValueError(
            "expected points that determine a pose, got some that do not determine its rotation at a noise of "
            f"{noise:.3g} px: they are nearly on one line, too near to each other, or paired wrongly; add points, or "
            "check the pairs."
        )
    rounding = consensus.rounding_of(x)
    others = tuple(
        other.state
        for other in minima[1:]
        if consensus.odds_are_open(other.cost, best.cost, freedom, noise_px, rounding)
    )
    return CameraPose(best.state, covariance, float(noise), np.ones(len(X), dtype=bool), others)


def _from_middle(found: CameraPose, middle: Array) -> CameraPose:
    """The pose for the points as given, from the pose that was found for points moved by -middle (3,), metres."""

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
    """Points (n, 3) and pixels (n, 2) as float64; ValueError unless `least` of each differ and the lens shows all."""
    X, x = checked_array("points", points, None, 3), checked_array("pixels", pixels, None, 2)
    if X.ndim != 2 or x.shape != (len(X), 2):
        raise ValueError(f"expected points (n, 3) and as many pixels (n, 2), got {X.shape} and {x.shape}.")
    for name, values in (("points", X), ("pixels", x)):
        check_distinct(name, values, least, "a camera's pose (three leave up to four poses)")
    beyond = int(np.count_nonzero(~np.isfinite(camera.normalise(x)).all(axis=-1)))
    if beyond:
        raise ValueError(
            f"expected pixels that a ray through the lens reaches, got {beyond} beyond its fold, where the distortion "
            "turns back; leave them out."
        )
    return X, x


def _refuse_chance(agreeing: int, pixels: Array, threshold: float) -> None:
    """Raise ValueError if no more pairs agree with one pose, within `threshold` pixels, than chance explains."""
    area, _ = consensus.bounding_area(pixels)
    if consensus.agree_by_chance(agreeing, len(pixels), 3, np.pi * threshold**2 / area):
        raise ValueError(
            f"expected the image of points in one pose, got {len(pixels)} pairs of which at most {agreeing} agree, no "
            "more than chance; the pairs, the camera or noise_px are wrong."
        )


def _moved(T: Array, delta: Array) -> Array:
    """The pose T (4, 4) moved by a step (6,): a rotation vector applied after R, rad, and a translation, metres."""
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(delta[:3]).as_matrix() @ T[:3, :3]
    result[:3, 3] = T[:3, 3] + delta[3:]
    return result


def _residuals(T: Array, X: Array, x: Array, camera: Intrinsics) -> tuple[Array, Array]:
    """(2n,) reprojection errors in pixels and their (2n, 6) derivatives by the step of `_moved`.

    Points that do not appear in the image have an infinite error.
    """
    turned = X @ T[:3, :3].T
    pixels, by_point, appears = reproject(camera, turned + T[:3, 3])
    off = pixels - x
    by_turn = np.cross(turned[:, None, :], by_point)  # p . (w x q) = w . (q x p)
    jacobian = np.concatenate([by_turn, by_point], axis=-1)
    off[~appears] = np.inf
    return off.ravel(), jacobian.reshape(-1, 6)


def _errors(T: Array, X: Array, x: Array, camera: Intrinsics) -> Array:
    """(n,) reprojection errors in pixels; infinite for points behind the camera."""
    with np.errstate(invalid="ignore", over="ignore"):
        errors = np.linalg.norm(camera.project(X @ T[:3, :3].T + T[:3, 3]) - x, axis=-1)
    return np.nan_to_num(errors, copy=False, nan=np.inf, posinf=np.inf)


def _is_same(T: Array, other: Array, tolerance: float) -> bool:
    """Whether two poses differ by less than the tolerance, in radians and as a ratio to the distance."""
    apart = np.linalg.norm(T[:3, 3] - other[:3, 3]) / np.linalg.norm(other[:3, 3])
    turned = np.linalg.norm(T[:3, :3] - other[:3, :3])  # Frobenius: 2 sqrt(2) sin(angle / 2)
    return bool(turned < math.sqrt(8) * math.sin(tolerance / 2) and apart < tolerance)


def _starting_poses(X: Array, x: Array, camera: Intrinsics, is_planar: bool) -> list[Array]:
    """Poses (4, 4) with all points in front of the camera: the best `STARTS` that OpenCV's solvers find."""
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
        if not any(_is_same(T, other, SAME_START) for other in starts):
            starts.append(T)
        if len(starts) == STARTS:
            break
    return starts
