# SPDX-License-Identifier: Apache-2.0
"""Triangulation of points from any number of images whose camera poses are known.

The linear solution comes first. For each image, with (x, y) the ray on the plane z = 1, it has the equations
x (T X)_3 - (T X)_1 = 0 and y (T X)_3 - (T X)_2 = 0, and X is the eigenvector of the smallest eigenvalue of all these
equations together (Hartley, Zisserman 2004, 12.2). Gauss-Newton steps then lead to the least reprojection error. For
two images, `rangesim.geometry.triangulate_optimal` finds the same minimum in closed form.

Used by: `incremental_reconstruction` and `sliding_window` of `rangesim.multiview`; no other module of rangesim.
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
"""Number of Gauss-Newton steps after the linear solution. Measured with 5 cameras around 200 points at 5 m and 5 px of
noise: one step leaves a point at most 2e-4 m from the minimum, two steps 2e-6 m, five steps 5e-12 m."""
MAX_DROPS = 20
"""Largest number of rounds. Each leaves out the worst observation of every point that still has an error above the
limit. A point that still has such an error after the last round is NaN. More rounds only matter for points with more
than 20 wrong observations, and each costs one triangulation of such points."""
MAX_WRONG = 0.5
"""Largest fraction of a point's observations that may be left out; a point that needs more is NaN. With half of them
wrong or more, the wrong ones could outvote the right ones."""


@dataclass(frozen=True, eq=False)
class ManyViewPoints:
    """The points that `triangulate_many` found, their standard deviations, and which observations agree with them.

    points : (n_points, 3) float64, world, in the unit of the poses. NaN for a point that fewer than two images see,
        whose rays are parallel within the noise, that lies behind a camera that sees it, or of which too many
        observations disagree.
    deviation : (n_points,) float64, standard deviation of a point if the poses are exact, in the unit of the poses: the
        square root of the sum of the variances of its three coordinates. NaN where the point is NaN.
    agrees : (m,) bool, whether the point of an observation was found and projects within `max_error_px` of its pixel.

    Examples
    --------
    See `triangulate_many`.
    """

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
    """The points with the least reprojection error in the images that see them.

    Parameters
    ----------
    tracks : which image sees which point at which pixel.
    camera : the lens of all images.
    T_camera_world : (n_images, 4, 4), maps world coordinates to those of each camera. An image with NaN has no known
        pose and is left out.
    noise_px : standard deviation of a pixel's coordinate; `ManyViewPoints.deviation` is proportional to it.
    max_error_px : largest distance between the projection of a point and the pixel where it was seen. While a point has
        a larger one, its worst observation is left out and the point is found again. If fewer than half of the
        observations of a point remain, the point is NaN.

    Raises
    ------
    ValueError
        The poses have another shape or are not rigid, or fewer than two images have a pose.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.multiview import Tracks
    >>> from rangesim.rig import Intrinsics
    >>> camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    >>> T = np.tile(np.eye(4), (3, 1, 1))
    >>> T[:, 0, 3] = [0.0, -0.5, -1.0]  # three cameras at x = 0, 0.5 and 1 m, which look along z
    >>> world = np.array([[0.0, 0.0, 5.0], [0.4, -0.2, 6.0]])
    >>> tracks = Tracks.from_dense(np.stack([camera.project(world + pose[:3, 3]) for pose in T]))
    >>> found = triangulate_many(tracks, camera, T, noise_px=0.5)
    >>> np.allclose(found.points, world)
    True
    >>> found.deviation.round(3)  # metres
    array([0.036, 0.051])
    """
    T = np.asarray(T_camera_world, dtype=np.float64)
    if T.shape != (tracks.n_images, 4, 4):
        raise ValueError(f"expected T_camera_world of shape ({tracks.n_images}, 4, 4), got {T.shape}.")
    known = np.asarray(np.isfinite(T).all(axis=(1, 2)))
    if known.sum() < 2:
        raise ValueError(f"expected at least two images with a pose, got {int(known.sum())}.")
    T = np.where(known[:, None, None], T, np.eye(4))
    check_rigid(T, "T_camera_world")
    # The linear equations mix directions and positions, so they lose precision far from the origin, as in map
    # coordinates. Move the origin to the mean of the cameras.
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
        last = order[np.flatnonzero(np.diff(tracks.point[order], append=-1))]  # the worst observation of each point
        agrees[last[todo[tracks.point[last]]]] = False
    agrees &= np.isfinite(points[tracks.point]).all(axis=1)
    return ManyViewPoints(points + origin, deviation, agrees)


def _solved(tracks: Tracks, rays: Array, camera: Intrinsics, T: Array, noise_px: float) -> tuple[Array, Array]:
    """Points (n_points, 3), NaN where none was found, and their standard deviations (n_points,).

    rays : (m, 2) positions of the observations on the plane z = 1 of their cameras.
    """
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
    """(n_points,) sum of squared errors of each point, px^2; infinite for a point behind a camera that sees it."""
    square = (reprojection_errors(views, tracks) ** 2).sum(axis=1)
    return np.asarray(
        np.bincount(tracks.point, np.nan_to_num(square, nan=np.inf), minlength=tracks.n_points), dtype=np.float64
    )


def _in_front(tracks: Tracks, camera: Intrinsics, T: Array, X: Array) -> Array:
    """The points (n_points, 3), with NaN for a point that lies behind a camera that sees it."""
    seen = np.isfinite(reprojection_errors(Views(camera, T, X), tracks)).all(axis=1)
    behind = np.bincount(tracks.point, ~seen, minlength=tracks.n_points) > 0
    return np.where(behind[:, None], np.nan, X)
