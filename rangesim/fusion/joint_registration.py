# SPDX-License-Identifier: Apache-2.0
"""Joint registration: the poses of many views are refined together, from all their readings at once.

In the usual registration of two clouds that overlap in part, a point outside the overlap finds its partner on the
border of the other cloud, and pulls the borders together. This module instead projects a point p of view i into view j
to find its partner (Blais, Levine 1995). There the border of the readings is known. One system of equations fits all
pairs of views, point to plane (Neugebauer 1997):

    minimise  sum over i, j, p  rho( n_j . (T_j^-1 T_i p - q_j) )

over T_2 .. T_n, with q_j the reading of view j in the pixel of T_j^-1 T_i p, and n_j its normal. The method is
Gauss-Newton with Tukey's weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.decoding.range_image import RangeImage
from rangesim.fusion.sdf import camera_and_pose, depth_at
from rangesim.fusion.virtual_cameras import local_views
from rangesim.point_cloud import lattice_normals
from rangesim.rig import Array, Intrinsics
from rangesim.robust_scale import sigma_from_median

POINTS_PER_VIEW = 4000
"""Number of random readings of each view that the fit uses. Twice as many take twice the time, and divide the error of
a pose by the root of two."""
BORDER_PX = 3
"""Distance in pixels from a border or a failed pixel within which readings are not used, because normals and
interpolated depths are wrong there."""
MIN_COSINE = 0.3
"""Smallest cosine (a ratio) of the angle between the normals of two partners, and of the angle of incidence. It is the
cosine of 73 degrees, because readings at larger angles of incidence are inaccurate, and partners with a larger angle
between them lie on different surfaces."""
TUKEY = 4.685
"""Standard deviations beyond which a residual has the weight 0: the standard value, which gives 95 % efficiency for
normally distributed errors (Holland, Welsch 1977)."""
MAX_ROUNDS = 30
"""Largest number of Gauss-Newton steps. The fit normally ends earlier, see `CONVERGED`; the count is limited so that a
fit whose poses go to and fro ends, too."""
CONVERGED = 1e-7
"""Largest entry of a step at which the fit ends: radians, and metres as a fraction of the size of the scene. It is far
below the errors of the poses, because a larger value would save only a step or two."""


class _DepthImage(NamedTuple):
    """A depth image of a view, prepared for the fit; the view of a camera that is no pinhole has several.

    camera : Intrinsics.
    T : (4, 4) float64, metres, pose of this image in coordinates of the view.
    z : (h, w) float64, metres, depth; NaN without a reading.
    normals : (h, w, 3) float64, coordinates of this image; NaN near borders and on slanted surfaces.
    """

    camera: Intrinsics
    T: Array
    z: Array
    normals: Array

    @classmethod
    def of(cls, image: RangeImage) -> _DepthImage:
        """The depth image of a range image of a pinhole camera, whose pose is that in the view."""
        from scipy.ndimage import binary_erosion

        camera, T = camera_and_pose(image)
        rays = camera.directions(camera.pixel_centres())
        z = image.z.astype(np.float64)
        normals = lattice_normals(z, rays)
        cosine = -(normals * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
        size = 2 * BORDER_PX + 1
        inner = binary_erosion(np.isfinite(z) & (cosine > MIN_COSINE), np.ones((size, size)))  # False with NaN
        normals[~inner] = np.nan
        return cls(camera, T, z, normals)

    def readings(self) -> tuple[Array, Array]:
        """Points (n, 3), metres, and normals (n, 3), coordinates of the view, where the image has normals."""
        y, x = np.nonzero(np.isfinite(self.normals[..., 0]))
        points = self.camera.directions(self.camera.pixel_centres())[y, x] * self.z[y, x, None]
        return points @ self.T[:3, :3].T + self.T[:3, 3], self.normals[y, x] @ self.T[:3, :3].T


class _View(NamedTuple):
    """One view, prepared for the fit.

    depth_images : what the view measured.
    points, point_normals : (n, 3) float64, metres and unit vectors, coordinates of the view, a random part of the
        readings.
    """

    depth_images: list[_DepthImage]
    points: Array
    point_normals: Array

    @classmethod
    def of(cls, image: RangeImage, random: np.random.Generator) -> _View:
        """The view of a range image."""
        depth_images = [_DepthImage.of(view) for view in local_views(image)]
        nothing = np.zeros((0, 3)), np.zeros((0, 3))
        found = zip(nothing, *(d.readings() for d in depth_images), strict=True)
        points, normals = (np.concatenate(arrays) for arrays in found)
        few = random.permutation(len(points))[:POINTS_PER_VIEW]
        return cls(depth_images, points[few], normals[few])


def refine_jointly(images: Sequence[RangeImage], poses: Array, reach_m: float, seed: int = 0) -> Array:
    """Poses that fit all readings of all views best: (n, 4, 4) float64, T_world_camera; the first one is kept.

    Parameters
    ----------
    images : the views; their own poses are not used.
    poses : (n, 4, 4), metres, T_world_camera, first guess.
    reach_m : metres, largest distance between the surfaces of two views under the first guess.
    seed : seed of the random readings that are fitted; the same seed gives the same poses.

    Raises
    ------
    ValueError
        The readings do not determine the poses: surfaces slide on each other, or no other view has partners of a view.

    Examples
    --------
    `align` calls it as its last step. To improve poses that are known to some millimetres:

    >>> from rangesim.fusion import refine_jointly
    >>> better = refine_jointly(scan.images, scan.poses, reach_m=0.005)  # doctest: +SKIP
    """
    random = np.random.default_rng(seed)
    views = [_View.of(image, random) for image in images]
    T = np.array(poses, dtype=np.float64)
    size = float(np.median([np.median(np.linalg.norm(v.points, axis=1)) for v in views if len(v.points)]))
    scale = reach_m / 3
    for _ in range(MAX_ROUNDS):
        normal, right, residuals = _equations(views, T, reach_m, scale, size)
        values = np.linalg.eigvalsh(normal[6:, 6:])
        if not values[0] > 1e-8 * values[-1]:
            raise ValueError(
                "expected readings that fix the poses of all views, but some views slide on the others, or do not "
                "overlap them."
            )
        step = np.concatenate([np.zeros(6), -np.linalg.solve(normal[6:, 6:], right[6:])]).reshape(-1, 6)
        for k, twist in enumerate(step):
            move = np.eye(4)
            move[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
            move[:3, 3] = size * twist[3:]
            T[k] = move @ T[k]
        scale = max(0.7 * scale, 1e-9) if sigma_from_median(residuals) < 0.7 * scale else scale
        if np.abs(step).max() < CONVERGED:
            break
    return T


def _equations(views: list[_View], T: Array, reach_m: float, scale: float, size: float) -> tuple[Array, Array, Array]:
    """Normal equations of all pairs of views: matrix (6n, 6n), right side (6n,), and residuals in metres.

    Translations are in units of `size` metres, so that the matrix is well conditioned.
    """
    n = len(views)
    normal, right, residuals = np.zeros((n, 6, n, 6)), np.zeros((n, 6)), [np.zeros(0)]
    for i, source in enumerate(views):
        world = source.points @ T[i, :3, :3].T + T[i, :3, 3]
        facing = source.point_normals @ T[i, :3, :3].T
        for j, target in ((j, d) for j, view in enumerate(views) for d in view.depth_images):
            if i == j or not len(world):
                continue
            T_target = T[j] @ target.T
            local = (world - T_target[:3, 3]) @ T_target[:3, :3]
            pixels = target.camera.project(local)
            z = depth_at(pixels, target.z, "bilinear")
            x, y = (np.nan_to_num(pixels[:, k]).astype(int).clip(0, m - 1) for k, m in enumerate(target.z.shape[::-1]))
            n_j = target.normals[y, x] @ T_target[:3, :3].T
            # The reading is on the ray of the point, so the two differ along the ray only
            along = local / local[:, 2:] * (local[:, 2] - z)[:, None] @ T_target[:3, :3].T
            r = (along * n_j).sum(axis=-1)
            fits = (np.abs(r) < min(reach_m, TUKEY * scale)) & ((n_j * facing).sum(axis=-1) > MIN_COSINE)
            if not fits.any():
                continue
            rows = np.hstack([np.cross(world[fits], n_j[fits]), size * n_j[fits]])
            weight = (1 - (r[fits] / (TUKEY * scale)) ** 2) ** 2
            block, vector = rows.T @ (weight[:, None] * rows), rows.T @ (weight * r[fits])
            normal[i, :, i] += block
            normal[j, :, j] += block
            normal[i, :, j] -= block
            normal[j, :, i] -= block
            right[i] += vector
            right[j] -= vector
            residuals.append(r[fits])
    return normal.reshape(6 * n, 6 * n), right.ravel(), np.concatenate(residuals)
