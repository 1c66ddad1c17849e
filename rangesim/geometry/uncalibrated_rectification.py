# SPDX-License-Identifier: Apache-2.0
"""Rectification of two images without calibration, by their fundamental matrix and corresponding points.

The second image is rotated about its middle until its epipole lies on the x axis, at (r, 0, w). Then
G = [1, 0, 0; 0, 1, 0; -w / r, 0, 1] moves the epipole to infinity; about the middle G is nearly the identity. This
determines the matching rows of the first image, but not the position of a point along its row. The function fits
the three parameters of that position to the pairs, so that disparities are as small as possible (Hartley: "Theory and
practice of projective rectification", IJCV 1999).

The rows of both images then match, as `match_rows` needs them. Depths in metres need calibrated cameras (`rectify`).

Used by: no other module of rangesim; it is for users alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import Array, checked_array, checked_pairs
from rangesim.geometry.projective_plane import homogeneous, map_points
from rangesim.geometry.two_view import epipoles

MIN_PAIRS = 3
"""Least number of pairs of points: as many as there are parameters of the position along a row, so that the pairs
determine them."""

MIN_CORNER_SCALE = 0.2
"""Least scale of the projective part at a corner of the image, as a ratio to its scale in the middle; the inverse of
this value is the largest ratio allowed. Near an epipole the scale goes to 0 or infinity and the image is torn. Five
times is strong but usable; a smaller ratio accepts epipoles nearer to the image."""

MAX_GROWTH = 4.0
"""Largest ratio of the pixels of a rectified image to those of the original, the same as in `stereo`. A poorly known F
shears images without limit; a larger value only delays that refusal."""


@dataclass(frozen=True, eq=False)
class UncalibratedPair:
    """Two rectified images without calibration: corresponding points lie on the same row.

    Attributes
    ----------
    H_first, H_second : (3, 3) float64 homographies of pixels to rectified pixels.
    width, height : size of the rectified images, pixels.
    size : (width, height) of the original images, pixels.
    disparity_px : (n,) float64, x - x' of the rectified pairs, pixels.
    row_error_px : root mean square of y - y' of the rectified pairs, pixels.

    Examples
    --------
    `rectify_uncalibrated` returns such a pair; here it is made by hand, with the identity as both homographies:

    >>> pair = UncalibratedPair(np.eye(3), np.eye(3), 4, 3, size=(4, 3), disparity_px=np.zeros(2), row_error_px=0.0)
    >>> first, second = pair.warp(np.ones((3, 4)), np.zeros((3, 4)))
    >>> first.shape, float(first.min()), float(second.max())
    ((3, 4), 1.0, 0.0)
    """

    H_first: Array
    H_second: Array
    width: int
    height: int
    size: tuple[int, int]
    disparity_px: Array
    row_error_px: float

    def warp(self, first: np.ndarray, second: np.ndarray) -> tuple[Array, Array]:
        """Both images (h, w) rectified, float32, in the unit of the images; NaN outside of an image."""
        return self._warped("first", self.H_first, first), self._warped("second", self.H_second, second)

    def _warped(self, name: str, H: Array, image: np.ndarray) -> Array:
        """One image (h, w) rectified by H (3, 3), float32; NaN outside of it."""
        import cv2

        pixels = checked_array(name, image, None, None)
        if pixels.shape != self.size[::-1]:
            raise ValueError(f"expected {name} as an image of shape {self.size[::-1]}, got {pixels.shape}.")
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        source = map_points(np.linalg.inv(H), np.stack([x, y], axis=-1).reshape(-1, 2))
        inside = ((source >= 0) & (source <= self.size)).all(axis=-1).reshape(self.height, self.width)
        at = (source - 0.5).astype(np.float32).reshape(self.height, self.width, 2)  # OpenCV's centres lie at integers
        warped = cv2.remap(pixels.astype(np.float32), at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        warped[~inside] = np.nan
        return np.asarray(warped)


def rectify_uncalibrated(F: ArrayLike, first: ArrayLike, second: ArrayLike, size: tuple[int, int]) -> UncalibratedPair:
    """Homographies of two images that turn epipolar lines into rows with the same number in both images.

    Parameters
    ----------
    F : (3, 3), x'^T F x = 0, as `find_fundamental` returns it.
    first, second : (n, 2) pixels of the pairs that agree with F, n >= 3, not on a line. They should be those of a
        pinhole, because this function does not remove lens distortion, which bends the rows.
    size : (width, height) of both images, pixels.

    Raises
    ------
    ValueError
        An epipole lies in an image or near it, as for a camera that moves forward, so that no homography brings it to
        infinity without tearing the image; or the pairs lie on a line, or do not fit F.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.geometry import fundamental_from_cameras, project, projection_matrix
    >>> from rangesim.rig import translation
    >>> K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> P, Q = projection_matrix(K), projection_matrix(K, translation(-0.1, 0.02, 0))
    >>> points = np.random.default_rng(0).uniform([-1, -0.7, 3], [1, 0.7, 5], (30, 3))
    >>> found = rectify_uncalibrated(fundamental_from_cameras(P, Q), project(P, points), project(Q, points), (640, 480))
    >>> bool(found.row_error_px < 1e-6)
    True
    """
    a, b = checked_pairs(first, second, MIN_PAIRS, "rectification")
    width, height = size
    if not (width >= 1 and height >= 1):
        raise ValueError(f"expected size as (width, height) in pixels, got {size!r}.")
    # coordinates about the middle of the image in units of half its larger side: all matrices then have similar sizes
    unit = max(width, height) / 2
    to_unit = np.array([[1 / unit, 0, -width / 2 / unit], [0, 1 / unit, -height / 2 / unit], [0, 0, 1.0]])
    from_unit = np.linalg.inv(to_unit)
    F_unit = from_unit.T @ checked_array("F", F, 3, 3) @ from_unit
    F_unit = F_unit / np.linalg.norm(F_unit)
    corners = homogeneous(map_points(to_unit, [[0, 0], [width, 0], [width, height], [0, height]]))

    x, y, w = epipoles(F_unit).second
    if np.hypot(x, y) < 1e-12:
        raise ValueError(_NEAR.format(which="second"))
    direction = np.array([x, y]) if x >= 0 else -np.array([x, y])
    c, s = direction / np.linalg.norm(direction)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    r = c * x + s * y
    to_infinity = np.array([[1, 0, 0], [0, 1, 0], [-w / r, 0, 1.0]])
    H_second = to_infinity @ turn
    _check_scale(corners @ H_second[2], "second")

    # the last two rows of H_first are those of H_second [e']x F, up to a common factor; its sign is chosen here
    rows = (H_second @ _cross(x, y, w) @ F_unit)[1:]
    rows = rows / np.abs(rows[1, 2] if abs(rows[1, 2]) > 1e-12 else np.linalg.norm(rows[1]))
    rows = rows * (1.0 if rows[1, 2] > 0 else -1.0)
    _check_scale(corners @ rows[1], "first")
    X, wanted = homogeneous(map_points(to_unit, a)), map_points(H_second, map_points(to_unit, b))
    design = X / (X @ rows[1])[:, None]
    along, _, rank, _ = np.linalg.lstsq(design, wanted[:, 0], rcond=1e-6)
    if rank < MIN_PAIRS:
        raise ValueError("expected pairs that do not lie on a line, got some that do: they do not say how rows match.")
    H_first = np.stack([along, *rows])
    if np.linalg.det(H_first) <= 0:
        raise ValueError(
            "expected pairs that F maps without a reflection, got some that mirror the first image: check F and the "
            "pairs."
        )
    both = np.concatenate([map_points(H, corners[:, :2]) for H in (H_first, H_second)]) * unit
    low, high = both.min(axis=0), both.max(axis=0)
    out_width, out_height = (int(n) for n in np.ceil(high - low))
    if out_width * out_height > MAX_GROWTH * width * height:
        raise ValueError(
            f"expected pairs from all over the image, got some that lead to rectified images of {out_width} x "
            f"{out_height} pixels: F belongs to cameras far apart, or is not known well."
        )
    place = np.array([[unit, 0, -low[0]], [0, unit, -low[1]], [0, 0, 1.0]])
    H_first, H_second = (place @ H @ to_unit for H in (H_first, H_second))
    off = map_points(H_first, a) - map_points(H_second, b)
    return UncalibratedPair(
        H_first,
        H_second,
        out_width,
        out_height,
        (width, height),
        off[:, 0],
        float(np.sqrt(np.mean(np.square(off[:, 1])))),
    )


_NEAR = (
    "expected epipoles outside the images and far from them, got one in the {which} image or near it, as for a camera "
    "that moves forward: match along epipolar lines instead."
)


def _check_scale(denominators: Array, which: str) -> None:
    """Raise ValueError if a homography tears the image.

    Parameters
    ----------
    denominators : (4,) values of the homography's last row at the corners of the image; it is 1 in the middle.
    which : name of the image for the message.
    """
    if not denominators.min() > MIN_CORNER_SCALE or not denominators.max() < 1 / MIN_CORNER_SCALE:
        raise ValueError(_NEAR.format(which=which))


def _cross(x: float, y: float, z: float) -> Array:
    """(3, 3) matrix [t]_x of t = (x, y, z), with [t]_x v = t x v."""
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
