# SPDX-License-Identifier: Apache-2.0
"""Stereo on parallel cameras: rectification, matching along rows, disparity to depth and its error.

Two pinholes with parallel axes and one focal length f, a baseline b apart along x, see a point at depth z with the
disparity d = x - x' = f b / z on the same row: F = [0, 0, 0; 0, 0, -1; 0, 1, 0], and the epipoles lie at infinity,
(1, 0, 0). `rectify` makes any two calibrated cameras so by turning them about their centres (Fusiello, Trucco, Verri:
"A compact algorithm for rectification of stereo pairs", 2000).

Here images meet coordinates. Pixel centres lie at integer + 0.5, OpenCV's at integers: `warp` converts, nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.camera_matrix import calibration_matrix
from rangesim.geometry.correspondences import Array, checked_array
from rangesim.rig import Intrinsics, pose

MAX_GROWTH = 4.0
"""Times the pixels of the larger image that a rectified one may have: beyond, the cameras look along their baseline."""
BORDER_POINTS = 33
"""Of each side of an image, which say how far it reaches when it is turned."""
LEVELS = 16
"""Steps per pixel of OpenCV's disparities, and the multiple in which their range is counted."""


@dataclass(frozen=True)
class ParallelCameras:
    """What two parallel cameras measure. focal_px : f. baseline_m : b, positive: the second camera stands at x = b."""

    focal_px: float
    baseline_m: float

    def __post_init__(self) -> None:
        if not (self.focal_px > 0 and self.baseline_m > 0):
            raise ValueError(
                f"expected a positive focal length and baseline, got {self.focal_px!r} px and {self.baseline_m!r} m."
            )

    def disparity(self, z_m: ArrayLike) -> Array:
        """d = f b / z in pixels, of depths in metres; NaN where z is not positive."""
        return self._over(z_m)

    def depth(self, disparity_px: ArrayLike) -> Array:
        """z = f b / d in metres; NaN where d is not positive (at infinity, or behind the cameras)."""
        return self._over(disparity_px)

    def depth_error(self, z_m: ArrayLike, disparity_error_px: ArrayLike) -> Array:
        """z^2 / (f b) times the error of the disparity: that of the depth in metres, to first order."""
        z = np.asarray(z_m, dtype=np.float64)
        return np.asarray(z**2 / (self.focal_px * self.baseline_m) * np.asarray(disparity_error_px, dtype=np.float64))

    def _over(self, values: ArrayLike) -> Array:
        value = np.asarray(values, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            return np.asarray(self.focal_px * self.baseline_m / np.where(value > 0, value, np.nan))


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Two cameras turned to be parallel, and how their images and pixels get there.

    first, second : Intrinsics of the real cameras. camera : Intrinsics of both rectified ones, a pinhole, the image
    large enough for all that either sees. R_rectified_first, R_rectified_second : (3, 3), turn camera coordinates
    into rectified ones. baseline_m : metres; the second rectified camera stands there on the x axis of the first.
    """

    first: Intrinsics
    second: Intrinsics
    camera: Intrinsics
    R_rectified_first: Array
    R_rectified_second: Array
    baseline_m: float

    @property
    def parallel(self) -> ParallelCameras:
        """Focal length and baseline: disparity to depth."""
        return ParallelCameras(self.camera.fx, self.baseline_m)

    @property
    def H_first(self) -> Array:
        """(3, 3) K_rect R K^-1: the homography of pixels of the first camera, lens distortion taken out."""
        return _homography(self.first, self.camera, self.R_rectified_first)

    @property
    def H_second(self) -> Array:
        """(3, 3) the same of the second camera."""
        return _homography(self.second, self.camera, self.R_rectified_second)

    def pixels_of_first(self, pixels: ArrayLike) -> Array:
        """(..., 2) rectified pixels of pixels (..., 2) as the first camera shows them, distortion included."""
        return self.camera.project(self.first.directions(pixels) @ self.R_rectified_first.T)

    def pixels_of_second(self, pixels: ArrayLike) -> Array:
        """(..., 2) the same of the second camera."""
        return self.camera.project(self.second.directions(pixels) @ self.R_rectified_second.T)

    def warp(self, first: np.ndarray, second: np.ndarray) -> tuple[Array, Array]:
        """The images (h, w) of both cameras as the rectified ones see them, float32; NaN where a camera sees
        nothing."""
        return (
            _warped(self.first, self.camera, self.R_rectified_first, first),
            _warped(self.second, self.camera, self.R_rectified_second, second),
        )

    def points(self, disparity_px: np.ndarray) -> Array:
        """(h, w, 3) float64 points, metres, coordinates of the first camera as it really stands; NaN where there is
        none.

        Parameters
        ----------
        disparity_px : (h, w), of the first rectified image, as `match_rows` returns.
        """
        rays = self.camera.directions(self.camera.pixel_centres())
        return np.asarray(rays * self.parallel.depth(disparity_px)[..., None] @ self.R_rectified_first)


def rectify(first: Intrinsics, second: Intrinsics, T_second_first: ArrayLike) -> RectifiedPair:
    """The pair of cameras turned so that epipolar lines are rows, and corresponding rows have one number.

    The common x axis is the baseline, from the first to the second camera; z is the mean of both optical axes made
    orthogonal to it. So the first camera is the left one: where it stands on the right, or below, images come out
    turned by 180 or 90 degrees. The focal length is the mean of all; the image holds both cameras' whole fields.

    Parameters
    ----------
    T_second_first : (4, 4) maps coordinates of the first camera to the second's, metres.

    Raises
    ------
    ValueError
        The cameras stand in one place, look in opposite directions, or one sees the other, or nearly so: a camera that
        moves forward has its epipole in the image, and no turn brings it to infinity.
    """
    T = pose(T_second_first, "T_second_first")
    R, t = T[:3, :3], T[:3, 3]
    towards = -R.T @ t
    baseline = float(np.linalg.norm(towards))
    if not baseline > 0:
        raise ValueError("expected two cameras that stand apart, got a baseline of 0.")
    x = towards / baseline
    looking = np.array([0.0, 0.0, 1.0]) + R[2]  # both optical axes, coordinates of the first camera
    z = looking - (looking @ x) * x
    if np.linalg.norm(z) < 1e-3:
        raise ValueError(_ALONG_BASELINE.format(why="both look along it, or in opposite directions"))
    z = z / np.linalg.norm(z)
    turned = np.stack([x, np.cross(z, x), z])
    rotations = turned, turned @ R.T
    focal = float(np.mean([first.fx, first.fy, second.fx, second.fy]))
    corners = []
    for camera, rotation in zip((first, second), rotations, strict=True):
        border = camera.directions(_border(camera)) @ rotation.T
        if not (border[np.isfinite(border).all(axis=-1), 2] > 0).all() or not np.isfinite(border).any():
            raise ValueError(_ALONG_BASELINE.format(why="the image reaches beyond 90 degrees from the common axis"))
        corners.append(focal * border[:, :2] / border[:, 2:])
    low, high = np.nanmin(np.concatenate(corners), axis=0), np.nanmax(np.concatenate(corners), axis=0)
    width, height = (int(n) for n in np.ceil(high - low))
    pixels = max(first.width * first.height, second.width * second.height)
    if width * height > MAX_GROWTH * pixels:
        raise ValueError(_ALONG_BASELINE.format(why=f"the rectified image would have {width} x {height} pixels"))
    common = Intrinsics(width, height, focal, focal, float(-low[0]), float(-low[1]))
    return RectifiedPair(first, second, common, *rotations, baseline)


_ALONG_BASELINE = (
    "expected cameras that look across their baseline, got ones that look along it: {why}; move the camera sideways, "
    "or match along epipolar lines without rectification."
)


def match_rows(
    first: np.ndarray, second: np.ndarray, disparities_px: tuple[float, float], block_px: int = 5
) -> np.ndarray:
    """(h, w) float32 disparities d = x - x' of the first image of a rectified pair, to 1/16 pixel; NaN where none is
    sure.

    OpenCV's semi-global matching (Hirschmueller, PAMI 2008; all eight directions), its usual penalties for steps of one
    pixel and more, with the check that the match back from the second image agrees within one pixel.

    Parameters
    ----------
    first, second : (h, w) images, any unit; NaN where there is none, as `RectifiedPair.warp` returns. The second
        should be exposed as the first.
    disparities_px : least and largest that is looked for: `ParallelCameras.disparity` of the largest and least depth.
    block_px : odd, side of the blocks that are compared.

    Raises
    ------
    ValueError
        Images that are not of one size or have no contrast, a range that is empty or wider than the image, an even
        block.
    """
    import cv2

    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape:
        raise ValueError(f"expected two images of one shape (h, w), got {a.shape} and {b.shape}.")
    least, largest = disparities_px
    if not (np.isfinite([least, largest]).all() and least < largest and largest - least < a.shape[1]):
        raise ValueError(
            f"expected disparities (least, largest) within an image {a.shape[1]} pixels wide, got {disparities_px!r}."
        )
    if block_px < 1 or block_px % 2 == 0:
        raise ValueError(f"expected block_px odd and positive, got {block_px!r}.")
    known = np.isfinite(a)
    grey = _eight_bits(a, b)
    start = int(np.floor(least))
    count = int(np.ceil((np.ceil(largest) - start + 1) / LEVELS)) * LEVELS
    # the matcher leaves out the columns where its range of disparities begins: give it room
    room = max(0, start + count)
    images = [cv2.copyMakeBorder(image, 0, 0, room, room, cv2.BORDER_REPLICATE) for image in grey]
    matcher = cv2.StereoSGBM_create(
        minDisparity=start,
        numDisparities=count,
        blockSize=block_px,
        P1=8 * block_px**2,
        P2=32 * block_px**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    found = matcher.compute(*images)[:, room : room + a.shape[1]].astype(np.float32) / LEVELS
    found[(found < start) | (found > np.ceil(largest)) | ~known] = np.nan
    # a match must lie where the second camera sees something
    y, x = np.nonzero(np.isfinite(found))
    other = np.rint(x - found[y, x]).astype(int)
    inside = (other >= 0) & (other < a.shape[1])
    seen = inside.copy()
    seen[inside] = np.isfinite(b[y[inside], other[inside]])
    found[y[~seen], x[~seen]] = np.nan
    return found


def _eight_bits(first: Array, second: Array) -> tuple[np.ndarray, np.ndarray]:
    """Both images on one scale of 8 bits, from the 0.5 % to the 99.5 % quantile of the first; 0 where there is none."""
    low, high = np.nanquantile(first, [0.005, 0.995])
    if not high > low:
        raise ValueError("expected images with contrast, got a first image of one value.")
    result = [
        np.nan_to_num(np.clip((image - low) / (high - low), 0, 1) * 255).astype(np.uint8) for image in (first, second)
    ]
    return result[0], result[1]


def _homography(real: Intrinsics, rectified: Intrinsics, rotation: Array) -> Array:
    return np.asarray(calibration_matrix(rectified) @ rotation @ np.linalg.inv(calibration_matrix(real)))


def _border(camera: Intrinsics) -> Array:
    """(4 BORDER_POINTS, 2) pixels along the edge of the image."""
    s = np.linspace(0, 1, BORDER_POINTS)
    zero, one = np.zeros_like(s), np.ones_like(s)
    around = [np.stack(side, axis=-1) for side in ((s, zero), (s, one), (zero, s), (one, s))]
    return np.concatenate(around) * [camera.width, camera.height]


def _warped(real: Intrinsics, rectified: Intrinsics, rotation: Array, image: np.ndarray) -> Array:
    import cv2

    pixels = checked_array("image", image, None, None)
    if pixels.shape != (real.height, real.width):
        raise ValueError(f"expected an image of shape {(real.height, real.width)}, got {pixels.shape}.")
    rays = rectified.directions(rectified.pixel_centres()) @ rotation
    source = real.project(rays) - 0.5  # OpenCV's pixel centres lie at integers
    outside = ~((source >= -0.5) & (source <= np.array([real.width, real.height]) - 0.5)).all(axis=-1)
    source[outside] = -10
    warped = cv2.remap(
        pixels.astype(np.float32), source.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    warped[outside] = np.nan
    return np.asarray(warped)
