# SPDX-License-Identifier: Apache-2.0
"""Pinhole cameras: the camera that sees given points at given pixels, its place and its axis."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.rounding import TINY

_FAR_PIXEL = 2.0**40 + 0.5
"""Row or column of what a camera does not see, a half so that it is at no whole pixel; else only chosen large."""
_BLOCK = 720
"""Count of rows in one QR decomposition: of more, LAPACK wakes threads, which takes longer than all else; measured."""
_MIN_DEPTH = 1e-6
"""Fraction of the extent: if the depths of all points are less, there is no camera; chosen by eye."""
_MAX_DISTANCE = 1000.0
"""Ratio of a camera's distance to the extent of what it sees, at most: a place farther off is none; chosen by eye."""
_SAME_DEPTH = 1e-9
"""Fraction of the depth by which points differ in it: with less, the camera is infinitely far off; chosen by eye."""
NO_PLANE = 1e-4
"""Ratio of the last but one singular value to the largest, at least, of points that are no plane; chosen by eye."""


class PinholeCamera(NamedTuple):
    """A camera that maps points to pixels by central projection.

    Attributes
    ----------
    matrix : (3, 4) float64
        Matrix from (x, y, z, 1), metres, to w (row, column, 1). w is the depth along the axis, up to the sign. The axis
        is the first three numbers of the last row, of unit length; they are 0 if the camera is infinitely far off.
    """

    matrix: NDArray[np.float64]

    def pixels(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Row and column, (n, 2), at which n points, (n, 3) metres, are seen, and their w, (n,).

        A row or column beyond 2**40, as of a point at w = 0, is replaced by 2**40 and a half.
        """
        seen = np.einsum("ij,kj->ik", points, self.matrix[:, :3]) + self.matrix[:, 3]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            at = seen[:, :2] / seen[:, 2:]
            return np.where(np.abs(at) < _FAR_PIXEL, at, _FAR_PIXEL), seen[:, 2]

    def place(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Its place, (3,) metres; None if that is more than a thousand extents off the box of what it sees.

        The box is given by its lowest and highest corner, (3,).
        """
        middle, scale = (low + high) / 2.0, max(float((high - low).max()) / 2.0, TINY)
        about = np.column_stack((self.matrix[:, :3] * scale, self.matrix[:, :3] @ middle + self.matrix[:, 3]))
        centre = np.linalg.svd(about / np.abs(about).max(axis=1, keepdims=True).clip(TINY))[2][-1]
        if not np.linalg.norm(centre[:3]) <= _MAX_DISTANCE * abs(centre[3]):
            return None
        return middle + scale * centre[:3] / centre[3]


def resection(points: NDArray[np.float64], pixels: NDArray[np.float64], least: float = 0.0) -> PinholeCamera | None:
    """The camera that sees n points, (n, 3) metres, at their rows and columns, (n, 2); n >= 6.

    None if many cameras do, as for points on a plane: the last but one singular value is at most `least` times the
    largest. None, too, if the solution of the equations gives no point a depth.

    Notes
    -----
    By the direct linear transform (Hartley and Zisserman 2004, 7.1) of normalised points and pixels. Noise of a depth
    camera is along the rays, so it does not move the pixels.
    """
    middle, scale = _frame(points)
    of_pixels, pitch = _frame(pixels)
    places = np.column_stack(((points - middle) / scale, np.ones(len(points))))
    at, none = (pixels - of_pixels) / pitch, np.zeros_like(places)
    rows = [np.hstack((*sides, -at[:, [i]] * places)) for i, sides in enumerate(((places, none), (none, places)))]
    rows.append(np.zeros((-2 * len(points) % _BLOCK, 12)))
    blocks: NDArray[np.float64] = np.concatenate(rows).reshape(-1, _BLOCK, 12)
    of_blocks = np.asarray(np.linalg.qr(blocks, mode="r"), np.float64).reshape(-1, 12)
    values, vectors = np.linalg.svd(np.linalg.qr(of_blocks, mode="r"))[1:]
    if values[-2] <= least * values[0]:
        return None
    matrix = vectors[-1].reshape(3, 4)
    if np.abs(places @ matrix[2]).max() <= _MIN_DEPTH:
        return None
    if np.linalg.norm(matrix[2, :3]) <= _SAME_DEPTH * abs(matrix[2, 3]):
        matrix[2, :3] = 0.0
    matrix = np.array([[pitch, 0.0, of_pixels[0]], [0.0, pitch, of_pixels[1]], [0.0, 0.0, 1.0]]) @ matrix
    matrix = np.column_stack((matrix[:, :3] / scale, matrix[:, 3] - matrix[:, :3] @ middle / scale))
    length = math.hypot(*matrix[2, :3])  # without overflow, whatever the unit
    return PinholeCamera(matrix / (length if length > 0.0 else matrix[2, 3]))


def is_far_off(low: NDArray[np.float64], high: NDArray[np.float64]) -> bool:
    """Whether the origin lies too far off a box, lowest and highest corner (3,), to be the place of a camera."""
    return float(np.abs(low + high).max()) / 2.0 > _MAX_DISTANCE * float((high - low).max()) > 0.0


def _frame(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Middle of the bounding box of some places, and half of its longest side."""
    low, high = values.min(axis=0), values.max(axis=0)
    return (low + high) / 2.0, max(float((high - low).max()) / 2.0, TINY)
