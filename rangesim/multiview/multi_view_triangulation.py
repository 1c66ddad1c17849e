# SPDX-License-Identifier: Apache-2.0
"""Points in space from any number of images whose cameras are known.

Linear first: the least eigenvector of the equations x (T X)_3 - (T X)_1 = 0, y (T X)_3 - (T X)_2 = 0 of all images on
the plane z = 1 (Hartley, Zisserman 2004, 12.2), then Gauss-Newton steps to the least reprojection error. Of two images,
`rangesim.geometry.triangulate_optimal` finds the same minimum in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import Array
from rangesim.multiview.bundle_adjustment import (
    MAX_RELATIVE_DEVIATION,
    Views,
    normal_equations,
    reprojection_errors,
)
from rangesim.multiview.schur_complement import Sizes
from rangesim.multiview.tracks import Tracks
from rangesim.rig import Intrinsics, check_rigid

GAUSS_NEWTON_STEPS = 5
MAX_DROPS = 20
"""Rounds in which the worst observation of a point is left out."""
MAX_WRONG = 0.5
"""Fraction of a point's observations that may be."""


@dataclass(frozen=True, eq=False)
class ManyViewPoints:
    """points : (n_points, 3) world; NaN of points that fewer than two images see, whose rays are parallel to the noise,
    or that lie behind a camera. deviation : (n_points,) standard deviation, root of the sum over the coordinates, given
    the cameras. agrees : (m,) bool, observations of points that are known within the largest error allowed."""

    points: Array
    deviation: Array
    agrees: np.ndarray


def triangulate_many(
    tracks: Tracks,
    camera: Intrinsics,
    T_camera_world: ArrayLike,
    *,
    noise_px: float = 1.0,
    max_error_px: float = np.inf,
) -> ManyViewPoints:
    """Points of least reprojection error in the images that see them.

    Parameters
    ----------
    T_camera_world : (n_images, 4, 4); NaN of images whose pose is not known, which are left out.
    noise_px : standard deviation of a coordinate, for the deviations.
    max_error_px : distance of a projected from a seen pixel; the worst observation of a point with a larger one is
        left out, then the next, and the point if half of its observations do not agree.

    Raises
    ------
    ValueError
        Poses of another shape, or not rigid; fewer than two images with a pose.
    """
    T = np.asarray(T_camera_world, dtype=np.float64)
    if T.shape != (tracks.n_images, 4, 4):
        raise ValueError(f"expected T_camera_world of shape ({tracks.n_images}, 4, 4), got {T.shape}.")
    known = np.asarray(np.isfinite(T).all(axis=(1, 2)))
    if known.sum() < 2:
        raise ValueError(f"expected at least two images with a pose, got {int(known.sum())}.")
    T = np.where(known[:, None, None], T, np.eye(4))
    check_rigid(T, "T_camera_world")
    # the linear equations mix directions and places: they need an origin near the cameras, as map coordinates have not
    origin = -np.einsum("nji,nj->ni", T[known, :3, :3], T[known, :3, 3]).mean(axis=0)
    T[known, :3, 3] += T[known, :3, :3] @ origin
    rays = np.full((len(tracks), 2), np.nan)
    rays[known[tracks.image]] = camera.normalise(tracks.pixels[known[tracks.image]])
    agrees = np.isfinite(rays).all(axis=1)
    points, deviation = np.full((tracks.n_points, 3), np.nan), np.full(tracks.n_points, np.nan)
    total = np.bincount(tracks.point[agrees], minlength=tracks.n_points)
    todo = np.ones(tracks.n_points, dtype=bool)
    for drop in range(MAX_DROPS + 1):
        chosen = np.flatnonzero(agrees & todo[tracks.point])
        if not len(chosen):
            break
        some = tracks.keep(chosen)
        X, spread = _solved(some, rays[chosen], camera, T, noise_px)
        points[todo], deviation[todo] = X[todo], spread[todo]
        error = np.full(len(tracks), -1.0)
        error[chosen] = np.linalg.norm(reprojection_errors(Views(camera, T, X), some), axis=1)
        error[np.isnan(error) & np.isfinite(X[tracks.point]).all(axis=1)] = np.inf
        worst = np.zeros(tracks.n_points)
        np.fmax.at(worst, tracks.point, error)
        todo = worst > max_error_px
        if not todo.any():
            break
        kept = np.bincount(tracks.point[chosen], minlength=tracks.n_points) - 1
        hopeless = todo & ((kept < (1 - MAX_WRONG) * total) | (drop == MAX_DROPS))
        points[hopeless], deviation[hopeless] = np.nan, np.nan
        todo &= ~hopeless
        order = np.lexsort((error, tracks.point))
        last = order[np.flatnonzero(np.diff(tracks.point[order], append=-1))]  # the worst of each point
        agrees[last[todo[tracks.point[last]]]] = False
    agrees &= np.isfinite(points[tracks.point]).all(axis=1)
    return ManyViewPoints(points + origin, deviation, agrees)


def _solved(tracks: Tracks, rays: Array, camera: Intrinsics, T: Array, noise_px: float) -> tuple[Array, Array]:
    """Points (n_points, 3), NaN where there are none, and their deviations."""
    poses = T[tracks.image]
    rows = rays[:, :, None] * poses[:, 2:3] - poses[:, :2]
    rows /= np.linalg.norm(rows, axis=2, keepdims=True)
    normal = np.zeros((tracks.n_points, 4, 4))
    np.add.at(normal, tracks.point, np.swapaxes(rows, 1, 2) @ rows)
    X = np.linalg.eigh(normal)[1][:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        X = X[:, :3] / X[:, 3:]
    X[(tracks.images_per_point < 2) | ~np.isfinite(X).all(axis=1)] = np.nan
    X = _in_front(tracks, camera, T, X)
    sizes = Sizes(0, tracks.n_images, 6, tracks.n_points, 3)
    held = np.zeros(tracks.n_images, dtype=bool)
    deviation = np.full(tracks.n_points, np.nan)
    for _ in range(GAUSS_NEWTON_STEPS):
        some = tracks.keep(np.isfinite(X[tracks.point]).all(axis=1))
        views = Views(camera, T, np.nan_to_num(X))
        equations = normal_equations(views, some, sizes, [], held, "linear", 1.0)
        moved = X + equations.step_of_points()
        before, after = (_costs(some, Views(camera, T, np.nan_to_num(at))) for at in (X, moved))
        better = after <= before
        X[better] = moved[better]
        covariance = equations.covariance_of_points()
        deviation = noise_px * np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    distance = np.full(tracks.n_points, np.inf)
    apart = np.linalg.norm(np.nan_to_num(X)[tracks.point] - centres[tracks.image], axis=1)
    np.minimum.at(distance, tracks.point, apart)
    with np.errstate(invalid="ignore"):
        X[~(deviation <= MAX_RELATIVE_DEVIATION * distance)] = np.nan
    deviation[np.isnan(X).any(axis=1)] = np.nan
    return X, deviation


def _costs(tracks: Tracks, views: Views) -> Array:
    """(n_points,) sums of squares; infinite behind a camera."""
    square = (reprojection_errors(views, tracks) ** 2).sum(axis=1)
    return np.asarray(
        np.bincount(tracks.point, np.nan_to_num(square, nan=np.inf), minlength=tracks.n_points), dtype=np.float64
    )


def _in_front(tracks: Tracks, camera: Intrinsics, T: Array, X: Array) -> Array:
    """The points, NaN where a camera that sees them has them behind itself."""
    seen = np.isfinite(reprojection_errors(Views(camera, T, X), tracks)).all(axis=1)
    behind = np.bincount(tracks.point, ~seen, minlength=tracks.n_points) > 0
    return np.where(behind[:, None], np.nan, X)
