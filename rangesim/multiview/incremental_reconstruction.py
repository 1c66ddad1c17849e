# SPDX-License-Identifier: Apache-2.0
"""Incremental structure from motion: cameras and points from tracks alone, one image after another.

1. The method starts with a pair of images that share many points and see them from different sides.
   `find_relative_pose` finds their poses.
2. The points of the pair are triangulated. The image that sees most of the known points comes next: `find_camera_pose`
   finds its pose, and its new points are triangulated. This is repeated for the other images.
3. Bundle adjustment runs each time the number of images has grown by a fifth. Observations with a large reprojection
   error are left out as wrong.

Snavely, Seitz, Szeliski: "Photo tourism", SIGGRAPH 2006; Schoenberger, Frahm: "Structure-from-motion revisited", CVPR
2016. Images do not determine the size of a scene. World coordinates are those of the first image, and the camera
farthest from it is at distance 1.

Used by: no module of rangesim; it is for users alone.
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
"""Smallest number of points that the images of the first pair share. It is larger than the five points of a relative
pose, so that some can be wrong and the others can test the pose."""
MIN_KNOWN_POINTS = 6
"""Smallest number of known points that an image must see before its pose is found. A pose needs three points, and a
fourth one to be unique; with six, two may be wrong."""
MAX_PAIRS = 12
"""Largest number of pairs tried as the first one, a count. More pairs take longer, and may find a pair with more
parallax. Other values were not measured."""
WIDE_RAD = np.radians(10)
"""Angle between the two rays of a point, radians, above which a wider angle makes a pair no better. The depth deviation
is inversely proportional to the angle, but at wide angles matches become rarer. Nobody measured the value."""
ADJUSTMENT_GROWTH = 1.2
"""Growth of the number of images, a ratio, after which all of them are adjusted again. Measured with 5 scenes of 16
views, 5 or 20 % of the observations wrong: 1.0 to 3.0 end at the same result, and 1.2 takes 0.6 to 0.8 times the time
of 1.0. With 1.2 the number of adjustments grows as the logarithm of the number of images."""
MAX_NOISE_RATIO = 1.5
"""Largest ratio of the noise found to the noise stated; above it the result comes with a warning, because the noise or
the lens is then stated wrongly, or most tracks are wrong. A smaller ratio would warn of a noise that is stated only
roughly; a larger one would say nothing about a lens that is slightly wrong."""
MIN_AGREEING = 0.5
"""Smallest fraction of observations that agree, among those of points in several images; below it the result comes with
a warning, because most tracks are then wrong."""
FINAL_ROUNDS = 4
"""Largest number of rounds of bundle adjustment and outlier removal at the end, a count. They end earlier if the
inliers do not change. Measured in the scenes of `ADJUSTMENT_GROWTH`: two rounds are enough."""


@dataclass(frozen=True, eq=False)
class StructureFromMotion:
    """The cameras and points that `structure_from_motion` found, in the frame of the first image.

    The unit of length is the distance from the first camera to the camera farthest from it.

    T_camera_world : (n_images, 4, 4) float64, maps world coordinates to those of each camera.
    points : (n_points, 3) float64, world; NaN for a point that the tracks do not determine.
    inliers : (m,) bool, whether an observation agrees with the cameras and points.
    first_pair : numbers of the two images of the start.
    adjustment : BundleAdjustment of the inliers at the end, with the covariance.

    Examples
    --------
    See `structure_from_motion`.
    """

    T_camera_world: Array
    points: Array
    inliers: np.ndarray
    first_pair: tuple[int, int]
    adjustment: BundleAdjustment

    @property
    def noise_px(self) -> float:
        """Standard deviation of a pixel's coordinate, estimated from the residuals of the inliers."""
        return self.adjustment.noise_px


def structure_from_motion(
    tracks: Tracks, camera: Intrinsics, *, noise_px: float = 1.0, seed: int = 0
) -> StructureFromMotion:
    """The cameras and points of maximum likelihood, from tracks of which some may be wrong.

    Parameters
    ----------
    tracks : which image sees which point; at least two images that shared points link. Two images must share 12 points
        or more, and each other image must see 6 known points or more.
    camera : the lens of all images, with its distortion.
    noise_px : standard deviation of a coordinate of a correct observation. While the poses are rough, an observation
        counts as wrong if its distance from the projection is more than three times the 99 % quantile of this noise; at
        the end, if it is more than 4 sqrt(2) noise_px.
    seed : seed of the robust estimators.

    Raises
    ------
    ValueError
        There are fewer than two images, images share no points or too few, or no pair has parallax: all images show the
        same view, the camera only rotates, or all points lie on a plane. Or the shape stays open (`bundle_adjust`), or
        no ray through the lens reaches a pixel.

    Warns
    -----
    RangesimWarning
        More than half of the observations are left out as wrong, or the noise of the others is more than 1.5 times the
        stated one: the lens or the noise is stated wrongly, or most tracks are wrong. Or the last descent did not end
        (`bundle_adjust`).

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.multiview import Tracks
    >>> from rangesim.rig import Intrinsics
    >>> camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    >>> world = np.random.default_rng(0).uniform([-2, -1, 4], [3, 1, 7], (30, 3))
    >>> T = np.tile(np.eye(4), (3, 1, 1))
    >>> T[:, 0, 3] = [0.0, -0.5, -1.0]  # three cameras at x = 0, 0.5 and 1 m, which look along z
    >>> tracks = Tracks.from_dense(np.stack([camera.project(world + pose[:3, 3]) for pose in T]))
    >>> found = structure_from_motion(tracks, camera, noise_px=0.5)
    >>> np.allclose(found.T_camera_world, T, atol=1e-6)  # here the farthest camera is really at 1 m
    True
    """
    check_noise(noise_px)
    if tracks.n_images < 2:
        raise ValueError(f"expected at least two images, got {tracks.n_images}: one image has no depth.")
    beyond = int(np.count_nonzero(~np.isfinite(camera.normalise(tracks.pixels)).all(axis=1)))
    if beyond:
        raise ValueError(
            f"expected pixels that a ray through the lens reaches, got {beyond} beyond its fold; leave these out."
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
        if placed >= ADJUSTMENT_GROWTH * adjusted or placed == tracks.n_images:
            T, X = _adjusted(tracks, camera, T, noise_px, rough, (first,))
            adjusted = placed
        else:
            X = triangulate_many(tracks, camera, T, noise_px=noise_px, max_error_px=rough).points
    found = _finished(tracks, camera, T, noise_px, (first, second))
    _warn_of_misfit(tracks, found, noise_px)
    return found


def _warn_of_misfit(tracks: Tracks, found: StructureFromMotion, noise_px: float) -> None:
    """Warn if many observations disagree, or the others agree less well than the stated noise says."""
    linked = tracks.images_per_point[tracks.point] > 1  # a point in one image agrees with anything
    agreeing = float(found.inliers[linked].mean())
    if found.noise_px > MAX_NOISE_RATIO * noise_px or agreeing < MIN_AGREEING:
        warn(
            f"expected most observations to agree to the stated noise of {noise_px:.3g} px, got {agreeing:.0%} that "
            f"agree, with a noise of {found.noise_px:.3g} px: noise_px or the lens is stated wrongly, or most tracks "
            "are wrong; state the noise, calibrate the lens, or free it in bundle_adjust."
        )


def _first_pair(tracks: Tracks, camera: Intrinsics, noise_px: float, seed: int) -> tuple[tuple[int, int], RelativePose]:
    """The pair of images with the most points seen under wide angles, and its relative pose.

    Pairs are ranked by their number of points and the median distance between the pixels of a point. The best
    `MAX_PAIRS` of them are tried.
    """
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
        """Number of shared points, times a measure from 0 to 1 of the distance between their pixels in the two
        images."""
        i, j = pair
        apart = np.linalg.norm(dense[i] - dense[j], axis=1)
        return float(shared[i, j] * min(np.nanmedian(apart) / (2 * WIDE_RAD * camera.fx), 1.0))

    pairs.sort(key=promise, reverse=True)
    best: tuple[float, tuple[int, int], RelativePose] | None = None
    refusal = ""
    for i, j in pairs[:MAX_PAIRS]:
        common = ideal.common(i, j)
        try:
            found = find_relative_pose(common.first, common.second, K, K, noise_px, seed=seed)
        except ValueError as error:  # this pair is degenerate, but another one may not be
            refusal = str(error)
            continue
        angle = np.median(_ray_angles(K, found.T_second_first, common.first, common.second)[found.inliers])
        score = float(found.inliers.sum() * min(angle / WIDE_RAD, 1.0))
        if best is None or score > best[0]:
            best = score, (int(i), int(j)), found
    if best is None:
        raise ValueError(
            f"expected a pair of images with parallax to start from, got none among the {min(len(pairs), MAX_PAIRS)} "
            f"best pairs; the error of the last pair: {refusal}"
        )
    return best[1], best[2]


def _ray_angles(K: Array, T: Array, first: Array, second: Array) -> Array:
    """(n,) float64, radians between the rays of the pixels (n, 2) of two cameras.

    T : (4, 4) maps coordinates of the first camera to those of the second.
    """
    inverse = np.linalg.inv(K).T
    a = np.concatenate([first, np.ones((len(first), 1))], axis=1) @ inverse @ T[:3, :3].T
    b = np.concatenate([second, np.ones((len(second), 1))], axis=1) @ inverse
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))


def _with_next(
    tracks: Tracks, camera: Intrinsics, T: Array, X: Array, waiting: np.ndarray, noise_px: float, seed: int
) -> Array:
    """The poses (n, 4, 4), with the pose of one more image: of those `waiting`, the one that sees most known points.

    T : (n, 4, 4), NaN for an image without a pose. X : (n_points, 3), NaN for an unknown point.
    """
    known = np.asarray(np.isfinite(X).all(axis=1))
    counts = np.bincount(tracks.image[known[tracks.point]], minlength=tracks.n_images)
    refusal = ""
    for image in waiting[np.argsort(-counts[waiting], kind="stable")]:
        mine = np.flatnonzero((tracks.image == image) & known[tracks.point])
        if len(mine) < MIN_KNOWN_POINTS:
            break
        try:
            found = find_camera_pose(X[tracks.point[mine]], tracks.pixels[mine], camera, 2 * noise_px, seed=seed)
        except ValueError as error:  # this image cannot be placed yet, but another one may
            refusal = str(error)
            continue
        T = T.copy()
        T[image] = found.T_camera_object
        return T
    raise ValueError(
        f"expected images that see at least {MIN_KNOWN_POINTS} known points at several depths, got {len(waiting)} "
        f"that cannot be placed, such as image {waiting[0]} with {counts[waiting[0]]} known points"
        f"{'; the error of the last one: ' + refusal if refusal else '; track points through more images.'}"
    )


def _adjusted(
    tracks: Tracks, camera: Intrinsics, T: Array, noise_px: float, limit: float, held: tuple[int, ...]
) -> tuple[Array, Array]:
    """Poses and points after triangulation, bundle adjustment of the observations that agree, and triangulation again.

    limit : largest reprojection error of an observation that agrees, pixels. held : images whose poses stay.
    """
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
    """The result in the frame of the first image. The inliers are adjusted until they stay the same."""
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
