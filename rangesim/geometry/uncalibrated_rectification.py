# SPDX-License-Identifier: Apache-2.0
"""Rectification of two images of which nothing is known but corresponding points: by the fundamental matrix alone.

The second image is turned about its middle until its epipole lies on the x axis, at (r, 0, w), and G = [1, 0, 0; 0, 1,
0; -w / r, 0, 1] moves that to infinity; about the middle G is nearly the identity. Rows of the first image that match
these are then determined, but for where along a row a point comes to lie: the three numbers of that are fitted to the
pairs, so that disparities are least (Hartley: "Theory and practice of projective rectification", IJCV 1999).

Rows then match, as `match_rows` wants them; what disparities mean in metres needs cameras (`rectify`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import Array, checked_array, checked_pairs
from rangesim.geometry.projective_plane import homogeneous, map_points
from rangesim.geometry.two_view import epipoles

MIN_PAIRS = 3
LEAST_SCALE = 0.2
"""Of the middle, how far the projective part may shrink a corner of an image; beyond, the epipole is near."""
MAX_GROWTH = 4.0
"""Times the pixels of an image that a rectified one may have."""


@dataclass(frozen=True, eq=False)
class UncalibratedPair:
    """Two images brought to common rows.

    H_first, H_second : (3, 3) homographies of pixels to rectified ones. width, height : of the rectified images. size :
    (width, height) of the images. disparity_px : (n,) x - x' of the pairs, rectified. row_error_px : root mean square
    of y - y' of the pairs, rectified.
    """

    H_first: Array
    H_second: Array
    width: int
    height: int
    size: tuple[int, int]
    disparity_px: Array
    row_error_px: float

    def warp(self, first: np.ndarray, second: np.ndarray) -> tuple[Array, Array]:
        """Both images (h, w) rectified, float32; NaN where an image has nothing."""
        return self._warped("first", self.H_first, first), self._warped("second", self.H_second, second)

    def _warped(self, name: str, H: Array, image: np.ndarray) -> Array:
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
    """Homographies that make epipolar lines rows, the same in both images.

    Parameters
    ----------
    F : (3, 3), x'^T F x = 0, as `find_fundamental` finds it. first, second : (n, 2) its pairs, n >= 3, not on a line;
        of pinholes: a lens's distortion stays in and bends rows.
    size : (width, height) of both images, pixels.

    Raises
    ------
    ValueError
        An epipole lies in an image or near it, as of a camera that moves forward: no homography brings it to infinity
        without tearing the image; or the pairs lie on a line.
    """
    a, b = checked_pairs(first, second, MIN_PAIRS, "rectification")
    width, height = size
    if not (width >= 1 and height >= 1):
        raise ValueError(f"expected size as (width, height) in pixels, got {size!r}.")
    # about the middle, half the larger side for unit: all matrices are then of one size
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

    # the rows of the first: y and scale are those of H_second [e']x F, which knows them up to one sign
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
            "expected pairs that one F explains from one side, got some that mirror the first image: check F and the "
            "pairs."
        )
    both = np.concatenate([map_points(H, corners[:, :2]) for H in (H_first, H_second)]) * unit
    low, high = both.min(axis=0), both.max(axis=0)
    out_width, out_height = (int(n) for n in np.ceil(high - low))
    if out_width * out_height > MAX_GROWTH * width * height:
        raise ValueError(
            f"expected pairs from all over the image, got some that lead to rectified images of {out_width} x "
            f"{out_height} pixels: F is that of cameras far apart, or is not well known."
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
    "expected epipoles outside the images and far from them, got one in the {which} image or near it, as of a camera "
    "that moves forward: match along epipolar lines instead."
)


def _check_scale(denominators: Array, which: str) -> None:
    """Raise ValueError if a homography of the last row's values at the corners, 1 in the middle, tears the image."""
    if not denominators.min() > LEAST_SCALE or not denominators.max() < 1 / LEAST_SCALE:
        raise ValueError(_NEAR.format(which=which))


def _cross(x: float, y: float, z: float) -> Array:
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
