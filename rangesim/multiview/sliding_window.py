# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment while the images come in: a window of the newest images is adjusted, what lies before it is held.

Each new image is placed by the points that are known, its new points are triangulated, and the poses of the last
`window` images are adjusted with all points that they see. Older images that see these points take part as *anchors*:
with all their observations, but in the poses they left the window with. So no observation of a point that is still
seen is lost, and there is no information to marginalise; what is neglected is that the anchors are known as well as
they are, and no better. (Marginalising them instead keeps that, linearised at a state that has moved on since.
Mouragnon et al.: "Real time localization and 3D reconstruction", CVPR 2006, hold them as here.)

A pose is final once it has left the window: the future beyond does not mend it, as it does offline
(`bundle_adjust`).
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


@dataclass(frozen=True, eq=False)
class OnlineAdjustment:
    """T_camera_world : (n_images, 4, 4), each as it left the window. T_at_arrival : (n_images, 4, 4), each as it was
    adjusted when it came in, without the future; those of the start as they were adjusted together. points :
    (n_points, 3) world, from all images; NaN where the tracks do not tell. largest : the most images, anchors included,
    that an adjustment took."""

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
    """Poses of images in the order they come, each step with a window of the newest and no image that is yet to come.

    Parameters
    ----------
    tracks : of images in the order of time; wrong observations taken out (`structure_from_motion` finds them).
    T_start : (k, 4, 4) poses of the first k >= 2 images, T_camera_world, such as of a relative pose: they are adjusted
        together first, in the gauge of `bundle_adjust`. The pose of the first image stays. Until a second image has
        left the window, its distance from the farthest one of the start stays too, then the poses that have left do:
        so the path has the scale of the start. A longer start tells the scale of the rest better.
    window : images that are free, at least two.
    noise_px : standard deviation of a coordinate.

    Raises
    ------
    ValueError
        Too small a window; a start of fewer than two images; an image that sees fewer than four known points; or tracks
        that do not determine the poses of a window.
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
        T[image] = _placed(past, camera, X, image)
        T[: image + 1], X, used = _adjusted(past, camera, T[: image + 1], X, window, noise_px, k)
        arrival[image] = T[image]
        largest = max(largest, used)
    X = triangulate_many(tracks, camera, T, noise_px=noise_px).points
    return OnlineAdjustment(T, arrival, X, largest)


def _placed(past: Tracks, camera: Intrinsics, X: Array, image: int) -> Array:
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
    """Poses and points after an adjustment of the window, and how many images took part.

    starting : number of images of the start, which set the scale.
    """
    newest = max(past.n_images - window, 1)  # the first image is the gauge
    current = np.zeros(past.n_points, dtype=bool)
    current[past.point[past.image >= newest]] = True
    live = past.keep(current[past.point])
    images = np.flatnonzero(live.points_per_image > 0)
    some = live.of_images(images)
    anew = triangulate_many(some, camera, T[images], noise_px=noise_px)
    sound = np.asarray(np.isfinite(anew.points).all(axis=1))  # in front of all, and not too far to tell
    known = np.where(sound[:, None], anew.points, np.nan)
    some = some.keep(sound[some.point])
    used = images[some.points_per_image > 0]
    some = live.keep(sound[live.point]).of_images(used)
    held = [i for i, image in enumerate(used) if image < newest]
    found = adjusted_views(some, camera, T[used], known, held=held, noise_px=noise_px)
    moved, points = found.T_camera_world, found.points
    if len(held) < 2:  # two that are held fix the scale
        moved, points = _with_scale(moved, points, T[used], _image_of_scale(used, T, starting))
    T, X = T.copy(), X.copy()
    T[used] = moved
    X[current] = points[current]
    return T, X, len(used)


def _image_of_scale(used: np.ndarray, T: Array, starting: int) -> int:
    """Place in `used` of the image whose distance from the first of `used` keeps the scale: the farthest of the start.

    Where fewer than two of the start take part, the farthest of the others that were adjusted before: all but the
    newest, whose place is estimated from its points alone.
    """
    of_start = int((used < starting).sum())
    end = of_start if of_start > 1 else max(len(used) - 1, 2)
    centres = _centres(T[used[:end]])
    return int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))


def _with_scale(T: Array, X: Array, before: Array, other: int) -> tuple[Array, Array]:
    """Poses and points scaled about the first image so that the image `other` is as far from it as before."""
    was, now = (np.linalg.norm(np.subtract(*_centres(some[[other, 0]]))) for some in (before, T))
    if not (was > 0 and now > 0):
        return T, X
    scale, centre = was / now, _centres(T[:1])[0]
    moved = T.copy()
    places = centre + scale * (_centres(T) - centre)
    moved[:, :3, 3] = -np.einsum("nij,nj->ni", T[:, :3, :3], places)
    return moved, centre + scale * (X - centre)


def _centres(T: Array) -> Array:
    """(n, 3) world, the places of cameras."""
    return np.asarray(-np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3]))
