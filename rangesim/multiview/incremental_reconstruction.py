# SPDX-License-Identifier: Apache-2.0
"""Cameras and points from tracks alone: a pair of images, then image after image, each adjusted with all before.

1. The pair with many common points seen from different sides, by `find_relative_pose`.
2. Its points, triangulated; then the image that sees most of the known points, by `find_camera_pose`; its new points.
3. Bundle adjustment, often at first and then whenever a fifth more images are in; wrong observations, by their
   reprojection error, are left out.

Snavely, Seitz, Szeliski: "Photo tourism", SIGGRAPH 2006; Schoenberger, Frahm: "Structure-from-motion revisited", CVPR
2016. Images do not know the size of a scene: the first image is the world, and the camera farthest from it is 1 away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangesim.errors import warn
from rangesim.geometry import consensus
from rangesim.geometry.camera_matrix import calibration_matrix, ideal_pixels
from rangesim.geometry.camera_pose import find_camera_pose
from rangesim.geometry.correspondences import Array, check_noise
from rangesim.geometry.two_view import RelativePose, find_relative_pose
from rangesim.multiview.bundle_adjustment import (
    BundleAdjustment,
    adjusted_views,
    bundle_adjust,
    check_connected,
)
from rangesim.multiview.multi_view_triangulation import triangulate_many
from rangesim.multiview.tracks import Tracks
from rangesim.rig import Intrinsics

MIN_COMMON = 12
"""Points that a pair must share, at least."""
MIN_KNOWN = 6
"""Known points that an image must see to be placed."""
CANDIDATES = 12
"""Pairs that are tried as the first."""
WIDE_RAD = np.radians(10)
"""Angle between the rays of a point beyond which a wider one is no better."""
GROWTH = 1.2
MAX_EXCESS = 1.5
"""Times the stated noise that observations that agree may be off."""
MIN_AGREEING = 0.5
"""Fraction of the observations of points in several images below which the answer comes with a warning."""
FINAL_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class StructureFromMotion:
    """Cameras and points, in the frame of the first image, the camera farthest from it at distance 1.

    T_camera_world : (n_images, 4, 4) maps world coordinates to each camera's. points : (n_points, 3) world; NaN where
    the tracks do not tell. inliers : (m,) bool, observations that agree. first_pair : the images it started from.
    adjustment : BundleAdjustment at the end, over the inliers, with covariance.
    """

    T_camera_world: Array
    points: Array
    inliers: np.ndarray
    first_pair: tuple[int, int]
    adjustment: BundleAdjustment

    @property
    def noise_px(self) -> float:
        """Standard deviation of a pixel's coordinate, from the residuals of the inliers."""
        return self.adjustment.noise_px


def structure_from_motion(
    tracks: Tracks, camera: Intrinsics, *, noise_px: float = 1.0, seed: int = 0
) -> StructureFromMotion:
    """Cameras and points of maximum likelihood, from tracks of which some may be wrong.

    Parameters
    ----------
    tracks : of at least two images, linked by shared points; 12 or more for the first pair, 6 for each other image.
    camera : the lens of all images, distortion included.
    noise_px : standard deviation of a coordinate of a right observation; one is wrong that is off by more than its
        99 % quantile three times over while poses are rough, and by more than four standard deviations at the end.
    seed : of the robust estimators.

    Raises
    ------
    ValueError
        Fewer than two images; images that share no points, or too few to be placed; no pair with parallax: the same
        view again, a camera that only rotates, points on one plane; a shape that stays open (`bundle_adjust`); pixels
        that no ray of the lens reaches.

    Warns
    -----
    RangesimWarning
        Most observations are left out as wrong, or the others are off by half more than the stated noise: the lens or
        the noise is another, or most tracks are wrong. Or the last descent did not end (`bundle_adjust`).
    """
    check_noise(noise_px)
    if tracks.n_images < 2:
        raise ValueError(f"expected at least two images, got {tracks.n_images}: one image has no depth.")
    beyond = int(np.count_nonzero(~np.isfinite(camera.normalise(tracks.pixels)).all(axis=1)))
    if beyond:
        raise ValueError(
            f"expected pixels that a ray through the lens reaches, got {beyond} beyond its fold; leave them out."
        )
    check_connected(tracks)
    (first, second), pose = _first_pair(tracks, camera, noise_px, seed)
    T = np.full((tracks.n_images, 4, 4), np.nan)
    T[first], T[second] = np.eye(4), pose.T_second_first
    rough = 3 * consensus.inlier_threshold(noise_px, 2)
    T, X = _adjusted(tracks, camera, T, noise_px, rough, (first,))
    adjusted = 2
    while True:
        waiting = np.flatnonzero(~np.isfinite(T).all(axis=(1, 2)))
        if not len(waiting):
            break
        T = _with_next(tracks, camera, T, X, waiting, noise_px, seed)
        placed = tracks.n_images - len(waiting) + 1
        if placed >= GROWTH * adjusted or placed == tracks.n_images:
            T, X = _adjusted(tracks, camera, T, noise_px, rough, (first,))
            adjusted = placed
        else:
            X = triangulate_many(tracks, camera, T, noise_px=noise_px, max_error_px=rough).points
    found = _finished(tracks, camera, T, noise_px, (first, second))
    _warn_of_misfit(tracks, found, noise_px)
    return found


def _warn_of_misfit(tracks: Tracks, found: StructureFromMotion, noise_px: float) -> None:
    linked = tracks.images_per_point[tracks.point] > 1  # a point in one image agrees with anything
    agreeing = float(found.inliers[linked].mean())
    if found.noise_px > MAX_EXCESS * noise_px or agreeing < MIN_AGREEING:
        warn(
            f"expected most observations to agree to the stated noise of {noise_px:.3g} px, got {agreeing:.0%} that "
            f"agree, off by {found.noise_px:.3g} px: noise_px or the lens is another, or most tracks are wrong; state "
            "the noise, calibrate the lens, or free it in bundle_adjust."
        )


def _first_pair(tracks: Tracks, camera: Intrinsics, noise_px: float, seed: int) -> tuple[tuple[int, int], RelativePose]:
    """The pair with the most points seen under wide angles, of those that promise most."""
    seen = tracks.seen().astype(np.int64)
    shared = seen @ seen.T
    pairs = [(i, j) for i, j in np.argwhere(np.triu(shared, 1) >= MIN_COMMON)]
    if not pairs:
        raise ValueError(
            f"expected two images that share at least {MIN_COMMON} points, got {int(np.triu(shared, 1).max())} at "
            "most; track more points."
        )
    K = calibration_matrix(camera)
    ideal = replace(tracks, pixels=ideal_pixels(camera, tracks.pixels))
    dense = ideal.dense()

    def promise(pair: tuple[int, int]) -> float:
        i, j = pair
        apart = np.linalg.norm(dense[i] - dense[j], axis=1)
        return float(shared[i, j] * min(np.nanmedian(apart) / (2 * WIDE_RAD * camera.fx), 1.0))

    pairs.sort(key=promise, reverse=True)
    best: tuple[float, tuple[int, int], RelativePose] | None = None
    refusal = ""
    for i, j in pairs[:CANDIDATES]:
        common = ideal.common(i, j)
        try:
            found = find_relative_pose(common.first, common.second, K, K, noise_px, seed=seed)
        except ValueError as error:  # this pair is degenerate, another may not be
            refusal = str(error)
            continue
        angle = np.median(_ray_angles(K, found.T_second_first, common.first, common.second)[found.inliers])
        score = float(found.inliers.sum() * min(angle / WIDE_RAD, 1.0))
        if best is None or score > best[0]:
            best = score, (int(i), int(j)), found
    if best is None:
        raise ValueError(
            f"expected a pair of images with parallax to start from, got none among the {min(len(pairs), CANDIDATES)} "
            f"most promising; of the last: {refusal}"
        )
    return best[1], best[2]


def _ray_angles(K: Array, T: Array, first: Array, second: Array) -> Array:
    """(n,) radians between the rays of pixels (n, 2) of two cameras."""
    inverse = np.linalg.inv(K).T
    a = np.concatenate([first, np.ones((len(first), 1))], axis=1) @ inverse @ T[:3, :3].T
    b = np.concatenate([second, np.ones((len(second), 1))], axis=1) @ inverse
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))


def _with_next(
    tracks: Tracks, camera: Intrinsics, T: Array, X: Array, waiting: np.ndarray, noise_px: float, seed: int
) -> Array:
    """The poses with that of one more image: of those that wait, the one that sees most known points."""
    known = np.asarray(np.isfinite(X).all(axis=1))
    counts = np.bincount(tracks.image[known[tracks.point]], minlength=tracks.n_images)
    refusal = ""
    for image in waiting[np.argsort(-counts[waiting], kind="stable")]:
        mine = np.flatnonzero((tracks.image == image) & known[tracks.point])
        if len(mine) < MIN_KNOWN:
            break
        try:
            found = find_camera_pose(X[tracks.point[mine]], tracks.pixels[mine], camera, 2 * noise_px, seed=seed)
        except ValueError as error:  # this image cannot be placed yet, another may
            refusal = str(error)
            continue
        T = T.copy()
        T[image] = found.T_camera_object
        return T
    raise ValueError(
        f"expected images that see at least {MIN_KNOWN} points of the others, from several depths, got {len(waiting)} "
        f"that cannot be placed, such as image {waiting[0]} with {counts[waiting[0]]} known points"
        f"{'; of the last tried: ' + refusal if refusal else '; track points through more images.'}"
    )


def _adjusted(
    tracks: Tracks, camera: Intrinsics, T: Array, noise_px: float, limit: float, held: tuple[int, ...]
) -> tuple[Array, Array]:
    """Poses and points after triangulation, bundle adjustment of what agrees, and triangulation."""
    placed = np.flatnonzero(np.isfinite(T).all(axis=(1, 2)))
    found = triangulate_many(tracks, camera, T, noise_px=noise_px, max_error_px=limit)
    some = tracks.keep(found.agrees).of_images(placed)
    held_now = [int(np.flatnonzero(placed == i)[0]) for i in held]
    adjusted = adjusted_views(
        some,
        camera,
        T[placed],
        found.points,
        held=held_now,
        loss="huber",
        loss_scale_px=2 * noise_px,
        noise_px=noise_px,
    )
    T = T.copy()
    T[placed] = adjusted.T_camera_world
    return T, triangulate_many(tracks, camera, T, noise_px=noise_px, max_error_px=limit).points


def _finished(
    tracks: Tracks, camera: Intrinsics, T: Array, noise_px: float, pair: tuple[int, int]
) -> StructureFromMotion:
    T = T @ np.linalg.inv(T[0])
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    T[:, :3, 3] /= np.linalg.norm(centres, axis=1).max()
    limit = 4 * noise_px * np.sqrt(2)
    inliers = np.zeros(len(tracks), dtype=bool)
    for _ in range(FINAL_ROUNDS):
        found = triangulate_many(tracks, camera, T, noise_px=noise_px, max_error_px=limit)
        adjusted = bundle_adjust(tracks.keep(found.agrees), camera, T, found.points)
        T = adjusted.T_camera_world
        before, inliers = inliers, found.agrees
        if (before == inliers).all():
            break
    points = adjusted.points
    return StructureFromMotion(T, points, inliers, pair, adjusted)
