# SPDX-License-Identifier: Apache-2.0
"""The camera matrix P = K [R | t]: made, taken apart, applied, inverted; and the lens in front of it.

x = P X for homogeneous world points X and pixels x; T_camera_world = [R | t] maps world to camera coordinates,
metres, axes as OpenCV's. P knows no lens distortion: `ideal_pixels` takes it out of measured pixels and `lens_pixels`
puts it in, both by `rangesim.rig.Intrinsics`, which alone knows the model. Hartley, Zisserman: "Multiple View
Geometry in Computer Vision", 2nd edition 2004 (HZ), chapter 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import rq

from rangesim.geometry.correspondences import ROUNDING, Array, checked_array
from rangesim.rig import Intrinsics, pose


@dataclass(frozen=True, eq=False)
class CameraParts:
    """What a camera matrix is made of, P = scale K [R | t].

    K : (3, 3) upper triangular, positive diagonal, K33 = 1: [fx, skew, cx; 0, fy, cy; 0, 0, 1], pixels.
    T_camera_world : (4, 4), [R | t], metres. centre : (3,) where the camera stands, world, -R^T t.
    """

    K: Array
    T_camera_world: Array
    centre: Array

    @property
    def skew(self) -> float:
        """K12 in pixels; 0 if rows and columns of the sensor are orthogonal."""
        return float(self.K[0, 1])

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """The same K for an image of that size; ValueError if it has skew, which `Intrinsics` has no place for."""
        if abs(self.skew) > 1e-6 * self.K[0, 0]:
            raise ValueError(f"expected a camera matrix of zero skew, got a skew of {self.skew:.3g} px.")
        fx, fy, cx, cy = (float(self.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Intrinsics(width, height, fx, fy, cx, cy)


def calibration_matrix(intrinsics: Intrinsics) -> Array:
    """(3, 3) K = [fx, 0, cx; 0, fy, cy; 0, 0, 1] in pixels, the lens distortion left out."""
    return np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1.0]])


def projection_matrix(camera: Intrinsics | ArrayLike, T_camera_world: ArrayLike | None = None) -> Array:
    """(3, 4) P = K [R | t].

    Parameters
    ----------
    camera : Intrinsics, of which the distortion is left out, or K (3, 3).
    T_camera_world : (4, 4) maps world to camera coordinates; None: the identity. Of a `Rig`'s camera it is the
        inverse of `T_world_camera`.

    Raises
    ------
    ValueError
        The pose is not rigid, or K not finite.
    """
    K = calibration_matrix(camera) if isinstance(camera, Intrinsics) else checked_array("K", camera, 3, 3)
    T = np.eye(4) if T_camera_world is None else pose(T_camera_world, "T_camera_world")
    return np.asarray(K @ T[:3])


def decompose(P: ArrayLike) -> CameraParts:
    """K, pose and centre of a camera matrix of any scale, by RQ decomposition of its left block (HZ 6.2.4).

    Parameters
    ----------
    P : (3, 4)

    Raises
    ------
    ValueError
        The left 3 x 3 block is singular: an affine camera, whose centre lies at infinity, or no camera at all.
    """
    p = _finite_camera(P)
    upper, rotation = rq(p[:, :3])
    signs = np.where(np.diag(upper) < 0, -1.0, 1.0)
    upper, rotation = upper * signs, signs[:, None] * rotation  # det M > 0, so this is a rotation
    return _parts(upper / upper[2, 2], rotation, p)


def decompose_zero_skew(P: ArrayLike) -> CameraParts:
    """K, pose and centre of a camera matrix without skew, in closed form.

    With A = P3 P3^T (P3 the left 3 x 3 block) divided by A33, A = K K^T: x0 = A13, y0 = A23, fx = sqrt(A11 - x0^2),
    fy = sqrt(A22 - y0^2), then [R | t] = K^-1 P up to scale.

    Raises
    ------
    ValueError
        As `decompose`; or A12 differs from x0 y0, as with skew: use `decompose`.
    """
    p = _finite_camera(P)
    a = p[:, :3] @ p[:, :3].T
    a = a / a[2, 2]
    x0, y0 = a[0, 2], a[1, 2]
    fx, fy = np.sqrt(a[0, 0] - x0**2), np.sqrt(a[1, 1] - y0**2)
    skew = (a[0, 1] - x0 * y0) / fy
    if not abs(skew) <= 1e-6 * fx:
        raise ValueError(f"expected a camera matrix of zero skew, got a skew of {skew:.3g} px; use decompose.")
    K = np.array([[fx, 0, x0], [0, fy, y0], [0, 0, 1.0]])
    rotation = np.linalg.solve(K, p[:, :3])
    return _parts(K, rotation / np.cbrt(np.linalg.det(rotation)), p)


def centre(P: ArrayLike) -> Array:
    """(..., 4) homogeneous camera centre of P (..., 3, 4): P C = 0, unit norm; the last entry is 0 of an affine
    camera."""
    _, values, axes = np.linalg.svd(checked_array("P", P, 3, 4))
    if np.any(values[..., 2] <= 1e-14 * values[..., 0]):
        raise ValueError("expected a camera matrix of rank 3, got one of lower rank.")
    return np.asarray(axes[..., 3, :])


def depth(P: ArrayLike, points: ArrayLike) -> Array:
    """(..., n) depth z along the optical axis in metres of world points (..., n, 3); not positive behind the camera.

    sign(det M) (P X)_3 / |m3|, with M the left block of P and m3 its third row (HZ 6.15): right for any scale of P.
    """
    p, X = checked_array("P", P, 3, 4), checked_array("points", points, None, 3)
    block = p[..., :3]
    scale = np.sign(np.linalg.det(block)) / np.linalg.norm(block[..., 2, :], axis=-1)
    return np.asarray(((X * block[..., None, 2, :]).sum(-1) + p[..., 2, 3, None]) * scale[..., None])


def project(P: ArrayLike, points: ArrayLike) -> Array:
    """(..., n, 2) pixels of world points (..., n, 3), metres; NaN of points that are not in front of the camera."""
    p, X = checked_array("P", P, 3, 4), checked_array("points", points, None, 3)
    image = X @ np.swapaxes(p[..., :3], -1, -2) + p[..., None, :, 3]
    w = np.where(depth(p, X) > 0, image[..., 2], np.nan)
    return np.asarray(image[..., :2] / w[..., None])


def rays(P: ArrayLike, pixels: ArrayLike) -> Array:
    """(..., n, 3) directions in world coordinates of the rays through pixels (..., n, 2), scaled to depth z = 1.

    The point at depth z is centre + z direction: M^-1 (x, y, 1), of the positive multiple with unit depth.

    Raises
    ------
    ValueError
        P is that of an affine camera, whose rays are parallel.
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
    """(..., n, 3) world points, metres, at depth z (..., n) on the rays through pixels (..., n, 2)."""
    C = centre(P)
    along = rays(P, pixels) * checked_array("depths", depths, None)[..., None]
    return np.asarray(C[..., None, :3] / C[..., None, 3:] + along)


def ideal_pixels(camera: Intrinsics, pixels: ArrayLike) -> Array:
    """(..., 2) where a pinhole with the same K would see what the lens shows at `pixels` (..., 2); NaN beyond its
    fold."""
    return np.asarray(camera.normalise(pixels) * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def lens_pixels(camera: Intrinsics, ideal: ArrayLike) -> Array:
    """(..., 2) where the lens shows what a pinhole sees at `ideal` (..., 2): the inverse of `ideal_pixels`."""
    xy = (np.asarray(ideal, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return camera.project(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1))


def _finite_camera(P: ArrayLike) -> Array:
    """P (3, 4), of the sign with which the determinant of the left block is positive."""
    p = checked_array("P", P, 3, 4)
    if p.ndim != 2:
        raise ValueError(f"expected P of shape (3, 4), got {p.shape}.")
    _check_invertible(p[:, :3])
    return p * np.sign(np.linalg.det(p[:, :3]))


def _check_invertible(block: Array) -> None:
    rows = block / np.maximum(np.linalg.norm(block, axis=-1, keepdims=True), 1e-300)  # pixels against metres
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
