# SPDX-License-Identifier: Apache-2.0
"""Signed distances from depth maps, their weights, and their average: the formulas, in plain NumPy.

A view with the depths d measures at a point X of space, with P the projection to the view's camera and [.] the pixel a
projection falls in,

    sdf(X) = (P X)_3 - d([P X])

negative in front of the surface, zero on it, positive behind it. Open3D, KinectFusion and Curless and Levoy count the
other way round, d - z. It is the distance along the camera's axis, not to the nearest point: exact at the surface, too
large beside it where that is seen at a slant.

Views are averaged, weighted, within a truncation distance t (Curless, Levoy: "A volumetric method for building complex
models from range images", SIGGRAPH 1996; Newcombe et al.: "KinectFusion", ISMAR 2011):

    D(X) = sum w_i r_i max(-t, sdf_i(X)) / sum w_i r_i       over the views with sdf_i(X) <= t
    r_i = min(1, (t - sdf_i(X)) / (t - h))

What lies more than t behind a view's surface is hidden to it, and r, the ramp of Bylow et al. ("Real-time camera
tracking and 3D reconstruction using signed distance functions", RSS 2013), lets its word fade from one voxel h behind
the surface: near its silhouette a view else pushes outward the far side that it does not see. What lies more than t in
front is seen to be free: it counts as -t, and so a ghost of one view is outvoted by those that look through it.

`rangesim.fusion.fuse` does the same on sparse blocks; this is what it is tested against, and good for small grids.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from rangesim.decoding.range_image import RangeImage
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.point_cloud import lattice_normals
from rangesim.rig import Intrinsics, pose
from rangesim.settings.config import nearest, shown

Weighting = Literal["confidence", "uniform"]
"""How readings weigh: see `reading_weights`."""
Lookup = Literal["bilinear", "nearest"]
"""How the depth at a projection is read: see `depth_at`."""
SAME_SURFACE = 0.02
"""Fraction of depth within which four neighbouring pixels lie on one surface, and may be interpolated between."""
ENOUGH = 20_000
"""Readings of a view, about, that their median is taken from."""
LEAST_COSINE = 0.1
"""Of the angle of incidence: readings beyond 84 degrees weigh nothing."""


def signed_distance(
    points: ArrayLike, image: RangeImage, T_world_camera: ArrayLike | None = None, *, lookup: Lookup = "nearest"
) -> np.ndarray:
    """(...) float64, metres, sdf(X) = (P X)_3 - d([P X]) of points (..., 3), world, from one range image.

    Negative in front of the surface, positive behind it; NaN where the view has no reading: behind the camera, outside
    its image, or on a failed pixel.

    Parameters
    ----------
    T_world_camera : (4, 4) pose of the view; None: the image's own.
    lookup : see `depth_at`.

    Raises
    ------
    ValueError
        The image has no camera (uncalibrated), a pose that is not rigid, or points are not (..., 3).
    """
    camera, T = placed(image, T_world_camera)
    X = np.asarray(points, dtype=np.float64)
    if X.shape[-1:] != (3,):
        raise ValueError(f"expected points of shape (..., 3), got {X.shape}.")
    local = (X - T[:3, 3]) @ T[:3, :3]
    return np.asarray(local[..., 2] - depth_at(camera.project(local), image.z, lookup))


def depth_at(pixels: np.ndarray, z: np.ndarray, lookup: Lookup = "nearest") -> np.ndarray:
    """(...) float64, metres, depth of an image z (h, w) at pixel coordinates (..., 2), centres at integer + 0.5.

    "nearest" is the pixel that the coordinates fall in. "bilinear" is linear in 1/z between the four nearest pixel
    centres, which is exact on planes, if all have a reading and lie within 2 % of depth of each other; else the
    nearest. NaN outside the image and where there is no reading.
    """
    check_lookup(lookup)
    h, w = z.shape
    x, y = pixels[..., 0], pixels[..., 1]
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)  # False with NaN
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    depth = np.where(inside, z[y.astype(int), x.astype(int)].astype(np.float64), np.nan)
    if lookup == "nearest":
        return np.asarray(depth)
    left, top = np.floor(x - 0.5).astype(int), np.floor(y - 0.5).astype(int)
    a, b = x - 0.5 - left, y - 0.5 - top
    within = inside & (left >= 0) & (top >= 0) & (left < w - 1) & (top < h - 1)
    left, top = np.where(within, left, 0), np.where(within, top, 0)
    if h < 2 or w < 2:
        return np.asarray(depth)
    four = np.stack([z[top + i, left + j] for i in (0, 1) for j in (0, 1)]).astype(np.float64)
    within &= four.max(axis=0) - four.min(axis=0) <= SAME_SURFACE * four.min(axis=0)  # False with NaN
    shares = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    with np.errstate(divide="ignore", invalid="ignore"):
        between = 1 / (shares / four).sum(axis=0)
    return np.where(within, between, depth)


def reading_weights(image: RangeImage, weighting: Weighting = "confidence") -> np.ndarray:
    """(h, w) float32, weight of each reading; 0 where there is none.

    "uniform" is 1. "confidence" is

        w = confidence * cos(incidence) / z^2

    The noise of photon counts makes the standard deviation of a reading fall with the root of the signal, so its
    inverse variance grows with the confidence; sigma grows with z in time of flight and with z^2 in triangulation, in
    which the confidence holds a factor 1 / z^2 of its own. The cosine is the share of the surface that a pixel's
    footprint is true to (Curless, Levoy 1996). Readings without a normal (single ones, as ghosts and flying pixels are)
    weigh nothing. Only ratios matter: `fuse` divides by the median of all views, and lets
    none count for more than 1.

    Raises
    ------
    ValueError
        Another weighting, or the image has no camera.
    """
    if weighting not in get_args(Weighting):
        valid = get_args(Weighting)
        raise ValueError(f"expected weights out of {', '.join(valid)}, got {weighting!r}{nearest(weighting, valid)}.")
    if weighting == "uniform":
        return image.valid.astype(np.float32)
    if image.camera is None:
        raise ValueError("expected a calibrated range image: without a rig it has no surface to fuse.")
    rays = image.camera.directions(image.camera.pixel_centres())
    z = image.z.astype(np.float64)
    cosine = -(lattice_normals(z, rays) * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    with np.errstate(invalid="ignore"):
        weight = np.where(cosine >= LEAST_COSINE, image.confidence * cosine / z**2, 0.0)
    return np.where(image.valid, np.nan_to_num(weight), 0.0).astype(np.float32)


def relative_weights(images: Sequence[RangeImage], weighting: Weighting) -> list[np.ndarray]:
    """Weights (h, w) float32 of all images, over the median of those that are positive, and 1 at most.

    1 is a typical reading. None counts for more, or a highlight that one view mistakes would outvote two others.
    """
    weights = [reading_weights(image, weighting) for image in images]
    counted = np.concatenate([w[w > 0][:: max(1, w.size // ENOUGH)] for w in weights])
    if not counted.size:
        raise ValueError(f"expected views with readings, got {len(images)} in which no pixel measured anything.")
    return [np.minimum(w / np.median(counted), np.float32(1)) for w in weights]


def average_signed_distances(
    images: Sequence[RangeImage],
    grid: VoxelGrid,
    truncation_m: float,
    *,
    weights: Weighting = "confidence",
    lookup: Lookup = "nearest",
) -> tuple[np.ndarray, np.ndarray]:
    """The weighted truncated average D(X) (nx, ny, nz) at the centres of a grid, metres, and its weight, the sum of w.

    D is NaN where the weight is 0: no view saw the place. See the head of this module for the formula; h is the voxel.

    Raises
    ------
    ValueError
        A view without camera, no readings at all, or `truncation_m` not positive.
    """
    if not truncation_m > 0:
        raise ValueError(f"expected a positive truncation_m in metres, got {shown(truncation_m)}.")
    total, weight = np.zeros(grid.shape), np.zeros(grid.shape)
    centres = grid.centres()
    for image, w in zip(images, relative_weights(images, weights), strict=True):
        camera, T = placed(image)
        pixels = camera.project((centres - T[:3, 3]) @ T[:3, :3])
        distance = signed_distance(centres, image, lookup=lookup)
        seen = distance <= truncation_m  # False with NaN
        of_pixel = np.where(seen, np.nan_to_num(depth_at(pixels, w)), 0.0)
        behind = seen & (distance > grid.voxel_m)
        of_pixel[behind] *= (truncation_m - distance[behind]) / (truncation_m - grid.voxel_m)
        total += of_pixel * np.where(seen, np.maximum(distance, -truncation_m), 0.0)
        weight += of_pixel
    with np.errstate(invalid="ignore"):
        return total / weight, weight


def placed(
    image: RangeImage, T_world_camera: ArrayLike | None = None, name: str = "T_world_camera"
) -> tuple[Intrinsics, np.ndarray]:
    """Camera and pose (4, 4) of a view; ValueError if it has none, a pose that is not rigid and finite, or
    another size than its camera.

    name : of the pose, for the message.
    """
    T = image.T_world_camera if T_world_camera is None else T_world_camera
    if image.camera is None or T is None:
        raise ValueError("expected a calibrated range image: without a rig it has no place among other views.")
    size = (image.camera.height, image.camera.width)
    if image.z.shape != size:
        raise ValueError(f"expected a range image of its camera's {size} pixels (h, w), got {image.z.shape}.")
    return image.camera, pose(T, name)


def check_lookup(lookup: str) -> None:
    """ValueError if it is no `Lookup`."""
    if lookup not in get_args(Lookup):
        raise ValueError(f"expected lookup to be one of {', '.join(get_args(Lookup))}, got {lookup!r}.")
