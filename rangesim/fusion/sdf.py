# SPDX-License-Identifier: Apache-2.0
"""Signed distances from depth maps, their weights, and their average: the formulas, in plain NumPy.

Let a view have the depths d, let P be the projection to its camera, and [.] the pixel that a projection falls into. At
a point X in space, the view measures the signed distance

    sdf(X) = (P X)_3 - d([P X])

It is negative in front of the surface, zero on it, and positive behind it. Open3D, KinectFusion, and Curless and Levoy
have the opposite sign, d - z. The distance is taken along the camera's axis and not to the nearest point. So it is
exact on the surface, and too large beside a slanted surface.

Distances of several views are averaged within a truncation distance t (Curless, Levoy: "A volumetric method for
building complex models from range images", SIGGRAPH 1996; Newcombe et al.: "KinectFusion", ISMAR 2011):

    D(X) = sum w_i r_i max(-t, sdf_i(X)) / sum w_i r_i       over the views with sdf_i(X) <= t
    r_i = min(1, (t - sdf_i(X)) / (t - h))

A view says nothing about points more than t behind its surface, because they are hidden. The ramp r is that of Bylow
et al. ("Real-time camera tracking and 3D reconstruction using signed distance functions", RSS 2013). The weight
decreases from one voxel h behind the surface on. Without the ramp, a view would push the far side of an object outward
near its silhouette, although it does not see the far side. Points more than t in front of the surface are free and
count as -t. So views that look through a ghost of another view outvote it.

`rangesim.fusion.fuse` computes the same on sparse blocks of voxels and is tested against this module, which is meant
for small grids.
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
"""Name of a rule for the weights of readings, see `reading_weights`."""
Lookup = Literal["bilinear", "nearest"]
"""Name of a rule for the depth between pixels, see `depth_at`."""
MAX_DEPTH_STEP = 0.02
"""Largest difference of depth, as a fraction of the depth, between four neighbouring pixels of one surface. Depth is
interpolated only between such pixels, because values between the two sides of an edge lie on neither surface. A smaller
step interpolates less on slanted surfaces."""
MEDIAN_READINGS = 20_000
"""Approximate number of readings of a view from which the median weight is taken. More would only cost time: the median
of 20 000 readings is known to a percent of their spread."""
MIN_INCIDENCE_COSINE = 0.1
"""Smallest cosine of the angle of incidence, no unit: readings beyond 84 degrees get the weight 0, because there, small
errors of pixel or depth cause large errors of the surface."""


def signed_distance(
    points: ArrayLike, image: RangeImage, T_world_camera: ArrayLike | None = None, *, lookup: Lookup = "nearest"
) -> np.ndarray:
    """Signed distance of points from the surface in one range image, along the camera's axis: (...) float64, metres.

    It is sdf(X) = (P X)_3 - d([P X]): negative in front of the surface, positive behind it. It is NaN where the view
    has no reading: behind the camera, outside its image, or on a failed pixel.

    Parameters
    ----------
    points : (..., 3), metres, world.
    image : the view.
    T_world_camera : (4, 4), metres, pose of the view; None: the image's own pose.
    lookup : rule for the depth between pixels, see `depth_at`.

    Raises
    ------
    ValueError
        The image has no pinhole camera (see `pinhole_views`), the pose is not rigid, or points are not (..., 3).

    Examples
    --------
    A camera looks along z at a wall 1 m away:

    >>> import numpy as np
    >>> from rangesim import Intrinsics, RangeImage
    >>> from rangesim.fusion import signed_distance
    >>> camera, z = Intrinsics.from_fov(32, 24, 40.0), np.ones((24, 32), np.float32)
    >>> range_m = z * np.linalg.norm(camera.directions(camera.pixel_centres()), axis=-1)
    >>> wall = RangeImage(z, range_m, 0.5 * z, np.zeros(z.shape, np.uint8), z, camera, np.eye(4))
    >>> signed_distance([[0.0, 0.0, 0.9], [0.0, 0.0, 1.25], [0.0, 0.0, -1.0]], wall).round(3).tolist()
    [-0.1, 0.25, nan]
    """
    camera, T = camera_and_pose(image, T_world_camera)
    X = np.asarray(points, dtype=np.float64)
    if X.shape[-1:] != (3,):
        raise ValueError(f"expected points of shape (..., 3), got {X.shape}.")
    local = (X - T[:3, 3]) @ T[:3, :3]
    return np.asarray(local[..., 2] - depth_at(camera.project(local), image.z, lookup))


def depth_at(pixels: np.ndarray, z: np.ndarray, lookup: Lookup = "nearest") -> np.ndarray:
    """Depth of an image at pixel coordinates: (...) float64, metres; NaN outside the image and without a reading.

    Parameters
    ----------
    pixels : (..., 2) pixel coordinates; pixel centres are at integer + 0.5.
    z : (h, w), metres, depth image.
    lookup : "nearest" takes the pixel that contains the coordinates. "bilinear" interpolates 1/z between the four
        nearest pixel centres, which is exact on planes. It does so if all four have a reading and their depths differ
        by 2 % at most; else it takes the nearest pixel.
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
    within &= four.max(axis=0) - four.min(axis=0) <= MAX_DEPTH_STEP * four.min(axis=0)  # False with NaN
    fractions = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    with np.errstate(divide="ignore", invalid="ignore"):
        between = 1 / (fractions / four).sum(axis=0)
    return np.where(within, between, depth)


def reading_weights(image: RangeImage, weighting: Weighting = "confidence") -> np.ndarray:
    """Weight of each reading of a range image: (h, w) float32, no unit; 0 where there is no reading.

    Parameters
    ----------
    weighting : "uniform" weighs all readings with 1. "confidence" weighs them with

            w = confidence * cos(incidence) / z^2

        The standard deviation of photon counts makes the inverse variance of a reading proportional to the confidence.
        In time of flight, the standard deviation grows with z. In triangulation it grows with z^2, and there the
        confidence has a factor 1 / z^2 of its own. The cosine is the weight of Curless and Levoy (1996) for slanted
        surfaces. Readings without a normal, such as ghosts and flying pixels, have no neighbours; they get 0.

    Only ratios of weights matter: `fuse` divides them by the median of all views and limits them to 1.

    Raises
    ------
    ValueError
        Another weighting, or the image has no camera.

    Examples
    --------
    On a wall that faces the camera, a twice as high confidence doubles the weight; a failed pixel gets 0:

    >>> import numpy as np
    >>> from rangesim import Intrinsics, RangeImage
    >>> from rangesim.fusion import reading_weights
    >>> camera, z = Intrinsics.from_fov(32, 24, 40.0), np.ones((24, 32), np.float32)
    >>> range_m = z * np.linalg.norm(camera.directions(camera.pixel_centres()), axis=-1)
    >>> confidence, status = 0.25 * z, np.zeros(z.shape, np.uint8)
    >>> confidence[12, 16], z[3, 3], status[3, 3] = 0.5, np.nan, 1
    >>> w = reading_weights(RangeImage(z, range_m, confidence, status, confidence, camera, np.eye(4)))
    >>> w[12, [15, 16]].round(2).tolist(), float(w[3, 3])
    ([0.25, 0.5], 0.0)
    """
    if weighting not in get_args(Weighting):
        valid = get_args(Weighting)
        raise ValueError(f"expected weights out of {', '.join(valid)}, got {weighting!r}{nearest(weighting, valid)}.")
    if weighting == "uniform":
        return image.valid.astype(np.float32)
    if image.camera is None:
        raise ValueError("expected a calibrated range image: without a rig it has no surface to fuse.")
    rays = image.pinhole.directions(image.pinhole.pixel_centres())
    z = image.z.astype(np.float64)
    cosine = -(lattice_normals(z, rays) * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    with np.errstate(invalid="ignore"):
        weight = np.where(cosine >= MIN_INCIDENCE_COSINE, image.confidence * cosine / z**2, 0.0)
    return np.where(image.valid, np.nan_to_num(weight), 0.0).astype(np.float32)


def relative_weights(images: Sequence[RangeImage], weighting: Weighting) -> list[np.ndarray]:
    """Weights of the readings of all images, over the median of the positive ones, and at most 1: (h, w) float32 each.

    A typical reading has the weight 1. Larger weights are limited to 1, because otherwise one view with a wrong but
    bright reading (a highlight) would outvote two others.
    """
    weights = [reading_weights(image, weighting) for image in images]
    counted = np.concatenate([np.zeros(0), *(w[w > 0][:: max(1, w.size // MEDIAN_READINGS)] for w in weights)])
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
    """Weighted truncated average D of the signed distances of several views, at the centres of a grid.

    The formula is in the docstring of this module.

    Parameters
    ----------
    images : the views, each with its pose.
    grid : the voxels; their edge is h in the formula.
    truncation_m : metres, truncation distance t.
    weights : rule for the weights of readings, see `reading_weights`.
    lookup : rule for the depth between pixels, see `depth_at`.

    Returns
    -------
    tuple
        (nx, ny, nz) float64, metres, D; NaN where no view saw the voxel. (nx, ny, nz) float64, the sum of weights.

    Raises
    ------
    ValueError
        A view without a pinhole camera (see `pinhole_views`), no readings at all, or `truncation_m` not positive.

    Examples
    --------
    Two cameras at the same place look at a wall and read 1.00 and 1.02 m; the average is zero half-way:

    >>> import numpy as np
    >>> from rangesim import Intrinsics, RangeImage
    >>> from rangesim.fusion import VoxelGrid, average_signed_distances
    >>> def wall(z_m):
    ...     camera, z = Intrinsics.from_fov(32, 24, 40.0), np.full((24, 32), z_m, np.float32)
    ...     range_m = z * np.linalg.norm(camera.directions(camera.pixel_centres()), axis=-1)
    ...     return RangeImage(z, range_m, 0.5 * z, np.zeros(z.shape, np.uint8), z, camera, np.eye(4))
    >>> grid = VoxelGrid((1, 1, 4), 0.01, (-0.005, -0.005, 0.985))
    >>> D, weight = average_signed_distances([wall(1.0), wall(1.02)], grid, 0.03, weights="uniform")
    >>> D[0, 0].round(4).tolist()
    [-0.02, -0.01, 0.0, 0.0067]
    """
    if not truncation_m > 0:
        raise ValueError(f"expected a positive truncation_m in metres, got {shown(truncation_m)}.")
    total, weight = np.zeros(grid.shape), np.zeros(grid.shape)
    centres = grid.centres()
    for image, w in zip(images, relative_weights(images, weights), strict=True):
        camera, T = camera_and_pose(image)
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


def camera_and_pose(
    image: RangeImage, T_world_camera: ArrayLike | None = None, name: str = "T_world_camera"
) -> tuple[Intrinsics, np.ndarray]:
    """Camera of a view, and its pose T_world_camera as (4, 4) float64.

    T_world_camera : (4, 4), metres, replaces the pose of the image. name : name of the pose, for error messages.

    Raises
    ------
    ValueError
        No camera or pose, a pose that is not rigid and finite, or an image of another size than its camera.
    """
    T = check_view(image, name, T_world_camera)
    return image.pinhole, T


def check_view(image: RangeImage, name: str = "T_world_camera", T_world_camera: ArrayLike | None = None) -> np.ndarray:
    """Pose of a view as (4, 4) float64; the errors are those of `camera_and_pose`, but every camera is taken."""
    T = image.T_world_camera if T_world_camera is None else T_world_camera
    if image.camera is None or T is None:
        raise ValueError("expected a calibrated range image: without a rig it has no place among other views.")
    size = (image.camera.height, image.camera.width)
    if image.z.shape != size:
        raise ValueError(f"expected a range image of its camera's {size} pixels (h, w), got {image.z.shape}.")
    return pose(T, name)


def check_lookup(lookup: str) -> None:
    """Raise ValueError if the name is not a `Lookup`."""
    if lookup not in get_args(Lookup):
        raise ValueError(f"expected lookup to be one of {', '.join(get_args(Lookup))}, got {lookup!r}.")
