# SPDX-License-Identifier: Apache-2.0
"""Stereo with two calibrated cameras: rectification, matching along rows, depth from disparity and its error.

Two pinholes with parallel axes, one focal length f and a baseline b along x see a point at depth z on the same row,
with the disparity d = x - x' = f b / z. Their fundamental matrix is F = [0, 0, 0; 0, 0, -1; 0, 1, 0], and their
epipoles lie at infinity, (1, 0, 0). `rectify` brings any two calibrated cameras into this arrangement by rotating them
about their centres (Fusiello, Trucco, Verri: "A compact algorithm for rectification of stereo pairs", 2000).

Pixel centres lie at integer + 0.5 here and at integers in OpenCV. `RectifiedPair.warp` is the only place in this module
that converts between the two.

Used by: rangesim.decoding and rangesim.sensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.camera_matrix import calibration_matrix
from rangesim.geometry.correspondences import Array, checked_array
from rangesim.rig import Intrinsics, pose

MAX_GROWTH = 4.0
"""Largest ratio of the pixels of a rectified image to those of the larger original. With a field of view of 44 degrees
it is exceeded where both cameras turn inwards by more than 25 degrees, or both look more than 40 degrees away from
straight across the baseline (measured). The ratio grows without limit from there, and so does the distortion."""

MIN_ACROSS = 1e-3
"""Least length of the part of the sum of both optical axes (unit vectors) that is orthogonal to the baseline. Below it
there is no direction for the common axis. The value hardly matters, because such cameras exceed `MAX_GROWTH` long
before."""

BORDER_POINTS = 33
"""Number of points per side of an image whose rays say how far the rectified image reaches. Distortion bends the border
between two points; with so many points, at most a fraction of a pixel is cut off there."""

ROUNDING_PX = 1e-6
"""Pixels by which rounding may widen the field of view of a rectified image. Without it, cameras that are parallel
already could get an image one pixel wider than theirs."""

STEPS_PER_PIXEL = 16
"""Number of steps per pixel in OpenCV's disparities, which are integers with four fractional bits (source:
StereoSGBM)."""

DISPARITY_MULTIPLE = 16
"""The range of disparities must be a multiple of this number of pixels; source: OpenCV's StereoSGBM,
numDisparities."""


@dataclass(frozen=True)
class ParallelCameras:
    """Two parallel cameras with one focal length, for depth from disparity.

    Attributes
    ----------
    focal_px : focal length f, pixels.
    baseline_m : baseline b, metres, positive; the second camera stands at x = b in the coordinates of the first.

    Examples
    --------
    >>> cameras = ParallelCameras(focal_px=800, baseline_m=0.1)
    >>> cameras.depth([80, 40, 0])
    array([ 1.,  2., nan])
    >>> cameras.disparity([1, 2])
    array([80., 40.])
    >>> cameras.depth_error(2, disparity_error_px=0.5)
    array(0.025)
    """

    focal_px: float
    baseline_m: float

    def __post_init__(self) -> None:
        if not (self.focal_px > 0 and self.baseline_m > 0):
            raise ValueError(
                f"expected a positive focal length and baseline, got {self.focal_px!r} px and {self.baseline_m!r} m."
            )

    def disparity(self, z_m: ArrayLike) -> Array:
        """Disparities d = f b / z in pixels, float64, for depths z in metres; NaN where z is not positive."""
        return self._over(z_m)

    def depth(self, disparity_px: ArrayLike) -> Array:
        """Depths z = f b / d in metres, float64, for disparities d in pixels; NaN where d is not positive.

        A point with d <= 0 lies at infinity or behind the cameras.
        """
        return self._over(disparity_px)

    def depth_error(self, z_m: ArrayLike, disparity_error_px: ArrayLike) -> Array:
        """Error of the depth in metres, z^2 / (f b) times the error of the disparity in pixels, to first order."""
        z = np.asarray(z_m, dtype=np.float64)
        return np.asarray(z**2 / (self.focal_px * self.baseline_m) * np.asarray(disparity_error_px, dtype=np.float64))

    def _over(self, values: ArrayLike) -> Array:
        value = np.asarray(values, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            return np.asarray(self.focal_px * self.baseline_m / np.where(value > 0, value, np.nan))


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Two cameras rotated to be parallel, with the maps of their images and pixels.

    Attributes
    ----------
    first, second : Intrinsics of the real cameras.
    camera : Intrinsics of both rectified cameras: a pinhole whose image holds all that either camera sees.
    R_rectified_first, R_rectified_second : (3, 3) float64, map camera coordinates to rectified camera coordinates.
    baseline_m : metres; the second rectified camera stands at this x in the coordinates of the first.

    Examples
    --------
    >>> from rangesim.rig import Intrinsics, translation
    >>> camera = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> pair = rectify(camera, camera, translation(-0.1, 0, 0))
    >>> pair.parallel
    ParallelCameras(focal_px=800.0, baseline_m=0.1)
    >>> pair.pixels_of_first([[100, 200]]) - pair.pixels_of_second([[60, 200]])
    array([[40.,  0.]])
    """

    first: Intrinsics
    second: Intrinsics
    camera: Intrinsics
    R_rectified_first: Array
    R_rectified_second: Array
    baseline_m: float

    @property
    def parallel(self) -> ParallelCameras:
        """Focal length and baseline of the rectified cameras, which convert disparity to depth."""
        return ParallelCameras(self.camera.fx, self.baseline_m)

    @property
    def H_first(self) -> Array:
        """(3, 3) float64 homography K_rect R K^-1 of undistorted pixels of the first camera to rectified pixels."""
        return _homography(self.first, self.camera, self.R_rectified_first)

    @property
    def H_second(self) -> Array:
        """(3, 3) float64 homography of undistorted pixels of the second camera to rectified pixels."""
        return _homography(self.second, self.camera, self.R_rectified_second)

    def pixels_of_first(self, pixels: ArrayLike) -> Array:
        """(..., 2) float64 rectified pixels of distorted pixels (..., 2) of the first camera."""
        return self.camera.project(self.first.directions(pixels) @ self.R_rectified_first.T)

    def pixels_of_second(self, pixels: ArrayLike) -> Array:
        """(..., 2) float64 rectified pixels of distorted pixels (..., 2) of the second camera."""
        return self.camera.project(self.second.directions(pixels) @ self.R_rectified_second.T)

    def warp(
        self, first: np.ndarray, second: np.ndarray, interpolation: Literal["linear", "spline"] = "linear"
    ) -> tuple[Array, Array]:
        """The images (h, w) of both cameras as the rectified cameras see them, float32, in the unit of the images.

        Pixels that a camera does not see are NaN.

        Parameters
        ----------
        interpolation : "linear" (OpenCV's remap, which rounds places to 1/32 pixel), or "spline", cubic B-splines,
            which blur fine texture less, and not more at half pixels than at whole ones.
        """
        warped = _warped if interpolation == "linear" else _warped_by_splines
        return (
            warped(self.first, self.camera, self.R_rectified_first, first),
            warped(self.second, self.camera, self.R_rectified_second, second),
        )

    def points(self, disparity_px: np.ndarray) -> Array:
        """(h, w, 3) float64 points in metres, in the coordinates of the real first camera; NaN without a disparity.

        Parameters
        ----------
        disparity_px : (h, w) disparities of the first rectified image in pixels, as `match_rows` returns.
        """
        rays = self.camera.directions(self.camera.pixel_centres())
        return np.asarray(rays * self.parallel.depth(disparity_px)[..., None] @ self.R_rectified_first)


def rectify(first: Intrinsics, second: Intrinsics, T_second_first: ArrayLike) -> RectifiedPair:
    """The pair of cameras, rotated so that epipolar lines are rows and corresponding rows have the same number.

    The common x axis is the baseline, from the first to the second camera. The common z axis is the mean of both
    optical axes, made orthogonal to the baseline. So the first camera becomes the left one: if it stands on the right
    or below, the rectified images are turned by 180 or 90 degrees. The focal length is the mean of all four. The
    rectified image holds the whole field of view of each camera.

    Parameters
    ----------
    first, second : Intrinsics of both cameras.
    T_second_first : (4, 4), maps coordinates of the first camera to those of the second, metres.

    Raises
    ------
    ValueError
        The cameras have one centre, look in opposite directions, or look along their baseline. A camera that moves
        forward has its epipole in the image, and no rotation brings it to infinity.

    Examples
    --------
    >>> from rangesim.rig import Intrinsics, translation
    >>> camera = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> pair = rectify(camera, camera, translation(-0.1, 0, 0))
    >>> pair.baseline_m, pair.camera.width, pair.camera.height
    (0.1, 640, 480)
    """
    T = pose(T_second_first, "T_second_first")
    R, t = T[:3, :3], T[:3, 3]
    towards = -R.T @ t
    baseline = float(np.linalg.norm(towards))
    if not baseline > 0:
        raise ValueError("expected two cameras that stand apart, got a baseline of 0.")
    x = towards / baseline
    looking = np.array([0.0, 0.0, 1.0]) + R[2]  # the sum of both optical axes, in coordinates of the first camera
    z = looking - (looking @ x) * x
    if np.linalg.norm(z) < MIN_ACROSS:
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
    width, height = (int(n) for n in np.ceil(high - low - ROUNDING_PX))
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
    """(h, w) float32 disparities d = x - x' in pixels for the first image of a rectified pair, in steps of 1/16 pixel.

    Pixels without a reliable match are NaN. The method is OpenCV's semi-global matching (Hirschmueller, PAMI 2008) with
    all eight directions and the penalties that OpenCV recommends. The match back from the second image must agree
    within one pixel.

    Parameters
    ----------
    first, second : (h, w) images in any unit, NaN where there is no image, as `RectifiedPair.warp` returns. Both should
        have the same exposure.
    disparities_px : least and largest disparity to look for: `ParallelCameras.disparity` of the largest and the least
        depth.
    block_px : side of the blocks that are compared, odd.

    Raises
    ------
    ValueError
        The images differ in shape or have no contrast, the range is empty or wider than the image, or the block is
        even.

    Examples
    --------
    >>> import numpy as np
    >>> texture = np.random.default_rng(0).uniform(size=(60, 120))
    >>> found = match_rows(texture[:, :100], texture[:, 8:108], (4, 12))
    >>> float(np.nanmedian(found))
    8.0
    """
    import cv2

    a, b = checked_images(first, second, disparities_px)
    least, largest = disparities_px
    if block_px < 1 or block_px % 2 == 0:
        raise ValueError(f"expected block_px odd and positive, got {block_px!r}.")
    known = np.isfinite(a)
    grey = _eight_bits(a, b)
    start = int(np.floor(least))
    count = int(np.ceil((np.ceil(largest) - start + 1) / DISPARITY_MULTIPLE)) * DISPARITY_MULTIPLE
    # the matcher leaves out as many columns at the left as its range is wide, so images get a margin of that width
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
    found = matcher.compute(*images)[:, room : room + a.shape[1]].astype(np.float32) / STEPS_PER_PIXEL
    found[(found < start) | (found > np.ceil(largest)) | ~known] = np.nan
    # a match must lie where the second camera has an image
    y, x = np.nonzero(np.isfinite(found))
    other = np.rint(x - found[y, x]).astype(int)
    inside = (other >= 0) & (other < a.shape[1])
    seen = inside.copy()
    seen[inside] = np.isfinite(b[y[inside], other[inside]])
    found[y[~seen], x[~seen]] = np.nan
    return found


def checked_images(first: np.ndarray, second: np.ndarray, disparities_px: tuple[float, float]) -> tuple[Array, Array]:
    """Both images of a rectified pair as (h, w) float64.

    Raises
    ------
    ValueError
        The images differ in shape, or the range of disparities is empty or wider than the image.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape:
        raise ValueError(f"expected two images of one shape (h, w), got {a.shape} and {b.shape}.")
    least, largest = disparities_px
    if not (np.isfinite([least, largest]).all() and least < largest and largest - least < a.shape[1]):
        raise ValueError(
            f"expected disparities (least, largest) within an image {a.shape[1]} pixels wide, got {disparities_px!r}."
        )
    return a, b


def contrast_limits(image: np.ndarray) -> tuple[float, float]:
    """Quantiles of 0.5 % and 99.5 % of an image (h, w), between which the matcher sees contrast; NaN for no image."""
    known = image[~np.isnan(image)]
    low, high = np.quantile(known, [0.005, 0.995]) if known.size else (np.nan, np.nan)
    return float(low), float(high)


def _eight_bits(first: Array, second: Array) -> tuple[np.ndarray, np.ndarray]:
    """Both images (h, w) as 8-bit integers on one scale, from the 0.5 % to the 99.5 % quantile of the first.

    Pixels without an image become 0.
    """
    low, high = contrast_limits(first)
    if not high > low:
        raise ValueError("expected images with contrast, got a first image of one value.")
    result = [
        np.nan_to_num(np.clip((image - low) / (high - low), 0, 1) * 255).astype(np.uint8) for image in (first, second)
    ]
    return result[0], result[1]


def _homography(real: Intrinsics, rectified: Intrinsics, rotation: Array) -> Array:
    """(3, 3) homography of undistorted pixels of a real camera to pixels of the rectified one."""
    return np.asarray(calibration_matrix(rectified) @ rotation @ np.linalg.inv(calibration_matrix(real)))


def _border(camera: Intrinsics) -> Array:
    """(4 BORDER_POINTS, 2) pixels along the border of the image."""
    s = np.linspace(0, 1, BORDER_POINTS)
    zero, one = np.zeros_like(s), np.ones_like(s)
    around = [np.stack(side, axis=-1) for side in ((s, zero), (s, one), (zero, s), (one, s))]
    return np.concatenate(around) * [camera.width, camera.height]


def _warped(real: Intrinsics, rectified: Intrinsics, rotation: Array, image: np.ndarray) -> Array:
    """The image (h, w) of a real camera as the rectified one sees it, float32; NaN where the real one sees nothing."""
    import cv2

    pixels = checked_array("image", image, None, None)
    source, outside = _sources(real, rectified, rotation, pixels)
    source[outside] = -10
    warped = cv2.remap(
        pixels.astype(np.float32), source.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    warped[outside] = np.nan
    return np.asarray(warped)


def _warped_by_splines(real: Intrinsics, rectified: Intrinsics, rotation: Array, image: np.ndarray) -> Array:
    """The image as `_warped` gives it, interpolated by cubic B-splines."""
    from scipy.ndimage import map_coordinates

    pixels = np.asarray(image, dtype=np.float64)
    source, outside = _sources(real, rectified, rotation, pixels)
    known = np.isfinite(pixels)
    filled = np.where(known, pixels, float(pixels[known].mean()) if known.any() else 0.0)
    source[outside] = 0
    x, y = source[..., 0], source[..., 1]
    warped = map_coordinates(filled, [y, x], order=3, mode="mirror").astype(np.float32)
    at = np.rint(y).astype(int).clip(0, real.height - 1), np.rint(x).astype(int).clip(0, real.width - 1)
    warped[outside | ~known[at]] = np.nan
    return np.asarray(warped)


def _sources(real: Intrinsics, rectified: Intrinsics, rotation: Array, pixels: np.ndarray) -> tuple[Array, np.ndarray]:
    """The place (x, y) in an image (h, w) of each rectified pixel, counted from the centre of the first pixel as in
    OpenCV, and where the image does not reach (bool)."""
    if pixels.shape != (real.height, real.width):
        raise ValueError(f"expected an image of shape {(real.height, real.width)}, got {pixels.shape}.")
    rays = rectified.directions(rectified.pixel_centres()) @ rotation
    source = real.project(rays) - 0.5
    outside = ~((source >= -0.5) & (source <= np.array([real.width, real.height]) - 0.5)).all(axis=-1)
    return source, np.asarray(outside)
