# SPDX-License-Identifier: Apache-2.0
"""Poses of many views refined together, from all their readings at once.

Pairs of clouds that overlap in part pull each other's borders together: a point beside the other cloud's border has its
partner on it. Here a point p of view i finds its partner by projection to view j instead (Blais, Levine 1995), where
the border is known, and all pairs are fitted in one system (Neugebauer 1997), point to plane:

    minimise  sum over i, j, p  rho( n_j . (T_j^-1 T_i p - q_j) ),     q_j the reading of view j where T_j^-1 T_i p
    falls

over T_2 .. T_n, by Gauss-Newton with Tukey's weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.decoding.range_image import RangeImage
from rangesim.fusion.sdf import camera_and_pose, depth_at
from rangesim.point_cloud import lattice_normals
from rangesim.rig import Array, Intrinsics
from rangesim.robust_scale import sigma_from_median

POINTS = 4000
"""Of each view."""
BORDER_PX = 3
"""Pixels from a border or a failed pixel within which readings are no partners."""
LEAST_COSINE = 0.3
"""Between the normals of partners, and of the angle of incidence."""
TUKEY = 4.685
"""Standard deviations beyond which a residual counts nothing."""
ROUNDS = 30
CONVERGED = 1e-7
"""Radians, and metres over the size of the scene."""


class _View(NamedTuple):
    """camera : Intrinsics. z, normals : (h, w), (h, w, 3), NaN at borders. points, point_normals : (n, 3), some of its
    readings, camera coordinates."""

    camera: Intrinsics
    z: Array
    normals: Array
    points: Array
    point_normals: Array

    @classmethod
    def of(cls, image: RangeImage, random: np.random.Generator) -> _View:
        from scipy.ndimage import binary_erosion

        camera, _ = camera_and_pose(image)
        rays = camera.directions(camera.pixel_centres())
        z = image.z.astype(np.float64)
        normals = lattice_normals(z, rays)
        cosine = -(normals * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
        size = 2 * BORDER_PX + 1
        inner = binary_erosion(np.isfinite(z) & (cosine > LEAST_COSINE), np.ones((size, size)))  # False with NaN
        normals[~inner] = np.nan
        rows, columns = np.nonzero(inner)
        few = random.permutation(len(rows))[:POINTS]
        y, x = rows[few], columns[few]
        return cls(camera, z, normals, rays[y, x] * z[y, x, None], normals[y, x])


def refine_jointly(images: Sequence[RangeImage], poses: Array, reach_m: float, seed: int = 0) -> Array:
    """(n, 4, 4) poses, T_world_camera, that fit all readings; the first is kept.

    Parameters
    ----------
    poses : (n, 4, 4) first guess. reach_m : metres, how far surfaces may be apart at first.

    Raises
    ------
    ValueError
        The readings do not hold the poses: surfaces that slide on each other, or views without partners.
    """
    random = np.random.default_rng(seed)
    views = [_View.of(image, random) for image in images]
    T = np.array(poses, dtype=np.float64)
    size = float(np.median([np.median(np.linalg.norm(v.points, axis=1)) for v in views if len(v.points)]))
    scale = reach_m / 3
    for _ in range(ROUNDS):
        normal, right, residuals = _equations(views, T, reach_m, scale, size)
        values = np.linalg.eigvalsh(normal[6:, 6:])
        if not values[0] > 1e-8 * values[-1]:
            raise ValueError(
                "expected views whose readings hold each other, got some that slide or have no partners in the others."
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
    """Normal equations of all pairs, (6n, 6n) and (6n,), translations in units of `size`; residuals in metres."""
    n = len(views)
    normal, right, residuals = np.zeros((n, 6, n, 6)), np.zeros((n, 6)), [np.zeros(0)]
    for i, source in enumerate(views):
        world = source.points @ T[i, :3, :3].T + T[i, :3, 3]
        facing = source.point_normals @ T[i, :3, :3].T
        for j, target in enumerate(views):
            if i == j or not len(world):
                continue
            local = (world - T[j, :3, 3]) @ T[j, :3, :3]
            pixels = target.camera.project(local)
            z = depth_at(pixels, target.z, "bilinear")
            x, y = (np.nan_to_num(pixels[:, k]).astype(int).clip(0, m - 1) for k, m in enumerate(target.z.shape[::-1]))
            n_j = target.normals[y, x] @ T[j, :3, :3].T
            # The reading's point lies on the point's own ray, so both differ along it alone
            along = local / local[:, 2:] * (local[:, 2] - z)[:, None] @ T[j, :3, :3].T
            r = (along * n_j).sum(axis=-1)
            fits = (np.abs(r) < min(reach_m, TUKEY * scale)) & ((n_j * facing).sum(axis=-1) > LEAST_COSINE)
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
