# SPDX-License-Identifier: Apache-2.0
"""The camera matrix P = K [R | t]: composition, decomposition, projection, back-projection, and lens distortion.

x = P X holds for homogeneous world points X and pixels x. T_camera_world = [R | t] maps world coordinates to camera
coordinates, in metres, with the axes of OpenCV: x right, y down, z forward. P does not contain lens distortion:
`ideal_pixels` removes it from measured pixels and `lens_pixels` applies it. Both use `rangesim.rig.Intrinsics`, the
only place that knows the distortion model. Source: Hartley, Zisserman: "Multiple View Geometry in Computer Vision",
2nd edition 2004 (HZ), chapter 6.

Used by: rangesim.geometry.camera_pose, stereo, two_view and two_view_triangulation; rangesim.calibration.opencv_files;
rangesim.multiview.incremental_reconstruction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import ROUNDING, Array, checked_array
from rangesim.rig import Intrinsics, pose

MAX_SKEW = 1e-6
"""Ratio of skew to fx up to which a camera matrix counts as one without skew. Rounding of P leaves less than 1e-15 in
double and 1e-7 in single precision (measured with 2000 random poses). A ratio of 1e-6 is a skew of 0.001 px at
fx = 1000 px, too small to matter."""


@dataclass(frozen=True, eq=False)
class CameraParts:
    """The parts of a camera matrix P = scale K [R | t].

    Attributes
    ----------
    K : (3, 3) float64, calibration matrix [fx, skew, cx; 0, fy, cy; 0, 0, 1] in pixels: upper triangular, positive
        diagonal, K33 = 1.
    T_camera_world : (4, 4) float64, [R | t; 0, 1], maps world coordinates to camera coordinates, metres.
    centre : (3,) float64, position of the camera in world coordinates, -R^T t, metres.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import decompose, projection_matrix
    >>> parts = decompose(projection_matrix([[800, 2, 320], [0, 810, 240], [0, 0, 1]]))
    >>> round(parts.skew, 6)
    2.0
    """

    K: Array
    T_camera_world: Array
    centre: Array

    @property
    def skew(self) -> float:
        """Skew K12 in pixels; 0 if the rows and columns of the sensor are orthogonal."""
        return float(self.K[0, 1])

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """The same K as `Intrinsics` of an image of that size in pixels, without distortion.

        Raises
        ------
        ValueError
            K has skew, which `Intrinsics` cannot hold.
        """
        if abs(self.skew) > MAX_SKEW * self.K[0, 0]:
            raise ValueError(f"expected a camera matrix of zero skew, got a skew of {self.skew:.3g} px.")
        fx, fy, cx, cy = (float(self.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Intrinsics(width, height, fx, fy, cx, cy)


def calibration_matrix(intrinsics: Intrinsics) -> Array:
    """(3, 3) float64 K = [fx, 0, cx; 0, fy, cy; 0, 0, 1] in pixels, without the lens distortion.

    Examples
    --------
    >>> from rangesim import Intrinsics
    >>> calibration_matrix(Intrinsics(640, 480, fx=800, fy=810, cx=320, cy=240))
    array([[800.,   0., 320.],
           [  0., 810., 240.],
           [  0.,   0.,   1.]])
    """
    return np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1.0]])


def projection_matrix(camera: Intrinsics | ArrayLike, T_camera_world: ArrayLike | None = None) -> Array:
    """(3, 4) float64 camera matrix P = K [R | t].

    Parameters
    ----------
    camera : Intrinsics, whose distortion is ignored, or K (3, 3) in pixels.
    T_camera_world : (4, 4), maps world coordinates to camera coordinates, metres; None means the identity. For the
        camera of a `Rig` it is the inverse of `T_world_camera`.

    Raises
    ------
    ValueError
        The pose is not rigid, or K is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> projection_matrix(np.diag([800.0, 800.0, 1.0]))
    array([[800.,   0.,   0.,   0.],
           [  0., 800.,   0.,   0.],
           [  0.,   0.,   1.,   0.]])
    """
    K = calibration_matrix(camera) if isinstance(camera, Intrinsics) else checked_array("K", camera, 3, 3)
    T = np.eye(4) if T_camera_world is None else pose(T_camera_world, "T_camera_world")
    return np.asarray(K @ T[:3])


def decompose(P: ArrayLike) -> CameraParts:
    """K, pose and centre of a camera matrix of any scale, by RQ decomposition of its left block (HZ 6.2.4).

    Parameters
    ----------
    P : (3, 4), of any scale and sign.

    Raises
    ------
    ValueError
        The left 3 x 3 block is singular: P is an affine camera, whose centre lies at infinity, or no camera at all.

    Examples
    --------
    >>> P = 5 * projection_matrix([[800, 2, 320], [0, 810, 240], [0, 0, 1]])
    >>> decompose(P).K.round(6)
    array([[800.,   2., 320.],
           [  0., 810., 240.],
           [  0.,   0.,   1.]])
    """
    p = _finite_camera(P)
    from scipy.linalg import rq  # takes long to load, and sensors load this module

    upper, rotation = rq(p[:, :3])
    signs = np.where(np.diag(upper) < 0, -1.0, 1.0)
    upper, rotation = upper * signs, signs[:, None] * rotation  # det M > 0, so this is a rotation
    return _parts(upper / upper[2, 2], rotation, p)


def decompose_zero_skew(P: ArrayLike) -> CameraParts:
    """K, pose and centre of a camera matrix without skew, in closed form.

    Let P3 be the left 3 x 3 block of P. A = P3 P3^T, divided by A33, equals K K^T. So x0 = A13, y0 = A23,
    fx = sqrt(A11 - x0^2) and fy = sqrt(A22 - y0^2); [R | t] is K^-1 P up to scale.

    Parameters
    ----------
    P : (3, 4), of any scale and sign.

    Raises
    ------
    ValueError
        `decompose` refuses P; or A12 differs from x0 y0, which means that P has skew: use `decompose`.

    Examples
    --------
    >>> P = projection_matrix([[800, 0, 320], [0, 810, 240], [0, 0, 1]])
    >>> decompose_zero_skew(P).centre.round(6) + 0.0
    array([0., 0., 0.])
    """
    p = _finite_camera(P)
    a = p[:, :3] @ p[:, :3].T
    a = a / a[2, 2]
    x0, y0 = a[0, 2], a[1, 2]
    fx, fy = np.sqrt(a[0, 0] - x0**2), np.sqrt(a[1, 1] - y0**2)
    skew = (a[0, 1] - x0 * y0) / fy
    if not abs(skew) <= MAX_SKEW * fx:
        raise ValueError(f"expected a camera matrix of zero skew, got a skew of {skew:.3g} px; use decompose.")
    K = np.array([[fx, 0, x0], [0, fy, y0], [0, 0, 1.0]])
    rotation = np.linalg.solve(K, p[:, :3])
    return _parts(K, rotation / np.cbrt(np.linalg.det(rotation)), p)


def centre(P: ArrayLike) -> Array:
    """(..., 4) float64 homogeneous centre C of camera matrices P (..., 3, 4), with P C = 0 and unit norm.

    The last entry is 0 for an affine camera, whose centre lies at infinity.

    Raises
    ------
    ValueError
        P has a rank below 3.

    Examples
    --------
    >>> import numpy as np
    >>> P = np.hstack([np.eye(3), [[-1.0], [-2.0], [-3.0]]])  # a camera at (1, 2, 3)
    >>> C = centre(P)
    >>> (C[:3] / C[3]).round(6)
    array([1., 2., 3.])
    """
    _, values, axes = np.linalg.svd(checked_array("P", P, 3, 4))
    if np.any(values[..., 2] <= 1e-14 * values[..., 0]):
        raise ValueError("expected a camera matrix of rank 3, got one of lower rank.")
    return np.asarray(axes[..., 3, :])


def depth(P: ArrayLike, points: ArrayLike) -> Array:
    """(..., n) float64 depth z along the optical axis in metres of world points (..., n, 3); z <= 0 behind the camera.

    z = sign(det M) (P X)_3 / |m3|, where M is the left 3 x 3 block of P (..., 3, 4) and m3 its third row (HZ 6.15).
    This holds for any scale and sign of P.

    Examples
    --------
    >>> import numpy as np
    >>> depth(-2 * np.eye(3, 4), [[0, 0, 4], [0, 0, -1]])
    array([ 4., -1.])
    """
    p, X = checked_array("P", P, 3, 4), checked_array("points", points, None, 3)
    block = p[..., :3]
    scale = np.sign(np.linalg.det(block)) / np.linalg.norm(block[..., 2, :], axis=-1)
    return np.asarray(((X * block[..., None, 2, :]).sum(-1) + p[..., 2, 3, None]) * scale[..., None])


def project(P: ArrayLike, points: ArrayLike) -> Array:
    """(..., n, 2) float64 pixels of world points (..., n, 3) in metres; NaN for points that are not in front.

    Parameters
    ----------
    P : (..., 3, 4) camera matrices.
    points : (..., n, 3) metres, world coordinates.

    Examples
    --------
    >>> P = projection_matrix([[800, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> project(P, [[0.1, 0, 2], [0, 0, -1]])
    array([[360., 240.],
           [ nan,  nan]])
    """
    p, X = checked_array("P", P, 3, 4), checked_array("points", points, None, 3)
    image = X @ np.swapaxes(p[..., :3], -1, -2) + p[..., None, :, 3]
    w = np.where(depth(p, X) > 0, image[..., 2], np.nan)
    return np.asarray(image[..., :2] / w[..., None])


def rays(P: ArrayLike, pixels: ArrayLike) -> Array:
    """(..., n, 3) float64 directions in world coordinates of the rays through pixels (..., n, 2), with depth z = 1.

    The point at depth z on a ray is centre + z direction. The direction is M^-1 (x, y, 1), scaled to unit depth, where
    M is the left 3 x 3 block of P (..., 3, 4).

    Raises
    ------
    ValueError
        P is an affine camera, whose rays are parallel.

    Examples
    --------
    >>> P = projection_matrix([[800, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> rays(P, [[360, 240]])
    array([[0.05, 0.  , 1.  ]])
    """
    p, x = checked_array("P", P, 3, 4), checked_array("pixels", pixels, None, 2)
    block = p[..., :3]
    _check_invertible(block)
    xyw = np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
    directions = xyw @ np.swapaxes(np.linalg.inv(block), -1, -2)
    # (M d)_3 = 1, and depth is sign(det M) (M d)_3 / |m3|
    to_unit = np.sign(np.linalg.det(block)) * np.linalg.norm(block[..., 2, :], axis=-1)
    return np.asarray(directions * to_unit[..., None, None])


def back_project(P: ArrayLike, pixels: ArrayLike, depths: ArrayLike) -> Array:
    """(..., n, 3) float64 world points, metres, at given depths on the rays through pixels.

    Parameters
    ----------
    P : (..., 3, 4) camera matrices.
    pixels : (..., n, 2).
    depths : (..., n) depth z along the optical axis, metres.

    Examples
    --------
    >>> P = projection_matrix([[800, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> back_project(P, [[360, 240]], [2.0])
    array([[0.1, 0. , 2. ]])
    """
    C = centre(P)
    along = rays(P, pixels) * checked_array("depths", depths, None)[..., None]
    return np.asarray(C[..., None, :3] / C[..., None, 3:] + along)


def ideal_pixels(camera: Intrinsics, pixels: ArrayLike) -> Array:
    """(..., 2) float64 undistorted pixels: where a pinhole with the same K sees what the lens shows at `pixels`.

    Parameters
    ----------
    pixels : (..., 2) pixels of the distorted image. Pixels beyond the fold of the distortion give NaN.

    Examples
    --------
    >>> from rangesim import Intrinsics
    >>> camera = Intrinsics(640, 480, 800, 800, 320, 240, distortion=(-0.1, 0.02))
    >>> ideal_pixels(camera, [[600, 400]]).round(2)
    array([[604.62, 402.64]])
    """
    return np.asarray(camera.normalise(pixels) * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def lens_pixels(camera: Intrinsics, ideal: ArrayLike) -> Array:
    """(..., 2) float64 distorted pixels: where the lens shows what a pinhole with the same K sees at `ideal`.

    This is the inverse of `ideal_pixels`.

    Parameters
    ----------
    ideal : (..., 2) pixels of the pinhole.

    Examples
    --------
    >>> from rangesim import Intrinsics
    >>> camera = Intrinsics(640, 480, 800, 800, 320, 240, distortion=(-0.1, 0.02))
    >>> lens_pixels(camera, ideal_pixels(camera, [[600, 400]])).round(6)
    array([[600., 400.]])
    """
    xy = (np.asarray(ideal, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return camera.project(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1))


def _finite_camera(P: ArrayLike) -> Array:
    """P (3, 4) with the sign that makes the determinant of its left block positive."""
    p = checked_array("P", P, 3, 4)
    if p.ndim != 2:
        raise ValueError(f"expected P of shape (3, 4), got {p.shape}.")
    _check_invertible(p[:, :3])
    return p * np.sign(np.linalg.det(p[:, :3]))


def _check_invertible(block: Array) -> None:
    rows = block / np.maximum(np.linalg.norm(block, axis=-1, keepdims=True), 1e-300)  # P mixes pixels and metres
    if np.any(np.abs(np.linalg.det(rows)) <= ROUNDING**1.5):
        raise ValueError(
            "expected a finite camera, got P with a singular left 3 x 3 block: its centre lies at infinity (an "
            "affine camera), and K, R and t do not exist."
        )


def _parts(K: Array, rotation: Array, p: Array) -> CameraParts:
    T = np.eye(4)
    T[:3, :3] = rotation
    scale = np.cbrt(np.linalg.det(p[:, :3]) / np.linalg.det(K))
    T[:3, 3] = np.linalg.solve(K, p[:, 3]) / scale
    return CameraParts(K, T, -rotation.T @ T[:3, 3])
