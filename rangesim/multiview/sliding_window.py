# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment while the images come in: the newest images are adjusted, and older poses are held.

The known points give the pose of each new image. Then its new points are triangulated, and the poses of the last
`window` images are adjusted together with all points that they see. Older images that see these points take part as
*anchors*: they keep all their observations, and their poses stay as they were when they left the window. So no
observation of a point in the window is lost, and nothing has to be marginalised. The method neglects one thing: the
poses of the anchors are uncertain themselves. Marginalisation would keep this uncertainty, but in a form that is
linearised at an older state. Mouragnon et al.: "Real time localization and 3D reconstruction", CVPR 2006, hold the
older poses, too.

A pose is final when it leaves the window. Later images do not improve it; in an adjustment of all images
(`bundle_adjust`) they do.

Used by: no module of rangesim; it is for users alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.camera_pose import fit_camera_pose
from rangesim.geometry.correspondences import Array, check_noise
from rangesim.multiview.bundle_adjustment import adjusted_views, bundle_adjust
from rangesim.multiview.multi_view_triangulation import triangulate_many
from rangesim.multiview.tracks import Tracks
from rangesim.rig import Intrinsics

MIN_KNOWN = 4
"""Smallest number of known points that a new image must see. Four points give one pose in general; three leave up to
four poses (perspective-three-point)."""


@dataclass(frozen=True, eq=False)
class OnlineAdjustment:
    """The poses and points that `adjust_online` found.

    T_camera_world : (n_images, 4, 4), maps world coordinates to those of each camera: the pose when the image left the
        window.
    T_at_arrival : (n_images, 4, 4), the pose of each image right after its arrival, before any later image. The images
        of the start were adjusted together, and have the poses found there.
    points : (n_points, 3) world, triangulated from all images at the end; NaN where the tracks do not determine a
        point.
    largest : largest number of images, anchors included, in one adjustment.

    Examples
    --------
    See `adjust_online`.
    """

    T_camera_world: Array
    T_at_arrival: Array
    points: Array
    largest: int


def adjust_online(
    tracks: Tracks,
    camera: Intrinsics,
    T_start: ArrayLike,
    *,
    window: int = 10,
    noise_px: float = 1.0,
) -> OnlineAdjustment:
    """The poses of images in the order of time. Each pose is found from its image and the earlier ones.

    Parameters
    ----------
    tracks : observations in images that are numbered in the order of time, without wrong ones (`structure_from_motion`
        finds these).
    camera : the lens of all images.
    T_start : (k, 4, 4), T_camera_world of the first k >= 2 images, for example from a relative pose. They are adjusted
        together first, in the gauge of `bundle_adjust`. The pose of the first image stays, and the path has the scale
        of the start: until a second image has left the window, the distance from the first image to the farthest one
        of the start is kept; after that the poses that have left the window keep the scale. A longer start determines
        the scale better.
    window : number of newest images whose poses are free, at least two.
    noise_px : standard deviation of a pixel's coordinate.

    Raises
    ------
    ValueError
        The window or the start has fewer than two images, an image sees fewer than four known points, or the tracks do
        not determine the poses of a window.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.multiview import Tracks
    >>> from rangesim.rig import Intrinsics
    >>> camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    >>> world = np.random.default_rng(0).uniform([-2, -1, 4], [3, 1, 7], (40, 3))
    >>> T = np.tile(np.eye(4), (6, 1, 1))
    >>> T[:, 0, 3] = -0.3 * np.arange(6)  # a camera that moves along x by 0.3 m from image to image
    >>> tracks = Tracks.from_dense(np.stack([camera.project(world + pose[:3, 3]) for pose in T]))
    >>> found = adjust_online(tracks, camera, T[:3], window=3)
    >>> np.allclose(found.T_camera_world, T, atol=1e-6), found.largest
    (True, 6)
    """
    check_noise(noise_px)
    start = np.asarray(T_start, dtype=np.float64)
    if not isinstance(window, (int, np.integer)) or window < 2:
        raise ValueError(f"expected a window of at least two images, got {window!r}.")
    if start.ndim != 3 or start.shape[1:] != (4, 4) or not 2 <= len(start) <= tracks.n_images:
        raise ValueError(
            f"expected T_start as (k, 4, 4) poses of 2 to {tracks.n_images} first images, got {start.shape}."
        )
    k = len(start)
    first = tracks.of_images(np.arange(k))
    X = triangulate_many(first, camera, start, noise_px=noise_px).points
    adjusted = bundle_adjust(first, camera, start, X, noise_px=noise_px)
    T = np.full((tracks.n_images, 4, 4), np.nan)
    T[:k], X = adjusted.T_camera_world, adjusted.points
    arrival, largest = T.copy(), k
    for image in range(k, tracks.n_images):
        past = tracks.of_images(np.arange(image + 1))
        T[image] = _pose_of(image, past, camera, X)
        T[: image + 1], X, used = _adjusted(past, camera, T[: image + 1], X, window, noise_px, k)
        arrival[image] = T[image]
        largest = max(largest, used)
    X = triangulate_many(tracks, camera, T, noise_px=noise_px).points
    return OnlineAdjustment(T, arrival, X, largest)


def _pose_of(image: int, past: Tracks, camera: Intrinsics, X: Array) -> Array:
    """(4, 4) T_camera_world of an image, from the points X (n_points, 3) that are known."""
    mine = np.flatnonzero((past.image == image) & np.isfinite(X[past.point]).all(axis=1))
    if len(mine) < MIN_KNOWN:
        raise ValueError(
            f"expected at least {MIN_KNOWN} points in each image that earlier ones see too, got {len(mine)} in image "
            f"{image}; track points through more images."
        )
    return fit_camera_pose(X[past.point[mine]], past.pixels[mine], camera).T_camera_object


def _adjusted(
    past: Tracks, camera: Intrinsics, T: Array, X: Array, window: int, noise_px: float, starting: int
) -> tuple[Array, Array, int]:
    """Poses and points after an adjustment of the window, and the number of images that took part.

    starting : number of images of the start, which determine the scale.
    """
    newest = max(past.n_images - window, 1)  # the first image of the window; image 0 fixes the gauge and never moves
    current = np.zeros(past.n_points, dtype=bool)
    current[past.point[past.image >= newest]] = True
    live = past.keep(current[past.point])
    images = np.flatnonzero(live.points_per_image > 0)
    some = live.of_images(images)
    anew = triangulate_many(some, camera, T[images], noise_px=noise_px)
    sound = np.asarray(np.isfinite(anew.points).all(axis=1))  # in front of all cameras, and near enough
    known = np.where(sound[:, None], anew.points, np.nan)
    some = some.keep(sound[some.point])
    used = images[some.points_per_image > 0]
    some = live.keep(sound[live.point]).of_images(used)
    held = [i for i, image in enumerate(used) if image < newest]
    found = adjusted_views(some, camera, T[used], known, held=held, noise_px=noise_px)
    moved, points = found.T_camera_world, found.points
    if len(held) < 2:  # two held images would fix the scale
        moved, points = _with_scale(moved, points, T[used], _image_of_scale(used, T, starting))
    T, X = T.copy(), X.copy()
    T[used] = moved
    X[current] = points[current]
    return T, X, len(used)


def _image_of_scale(used: np.ndarray, T: Array, starting: int) -> int:
    """Index in `used` of the image whose distance from the first image of `used` keeps the scale.

    It is the image of the start that is farthest from the first one. If fewer than two images of the start take part,
    it is the farthest of all images but the newest. The newest does not count, because only its points gave its
    position.
    """
    of_start = int((used < starting).sum())
    end = of_start if of_start > 1 else max(len(used) - 1, 2)
    centres = _centres(T[used[:end]])
    return int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))


def _with_scale(T: Array, X: Array, before: Array, other: int) -> tuple[Array, Array]:
    """Poses and points, scaled about the first camera so that the camera `other` is as far from it as in `before`."""
    was, now = (np.linalg.norm(np.subtract(*_centres(some[[other, 0]]))) for some in (before, T))
    if not (was > 0 and now > 0):
        return T, X
    scale, centre = was / now, _centres(T[:1])[0]
    moved = T.copy()
    places = centre + scale * (_centres(T) - centre)
    moved[:, :3, 3] = -np.einsum("nij,nj->ni", T[:, :3, :3], places)
    return moved, centre + scale * (X - centre)


def _centres(T: Array) -> Array:
    """(n, 3) world, positions of the cameras."""
    return np.asarray(-np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3]))
