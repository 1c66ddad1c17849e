# SPDX-License-Identifier: Apache-2.0
"""Pinhole cameras: that which sees some points at some pixels, its place and its axis."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_TINY = float(np.finfo(np.float64).tiny)
_FAR_PIXEL = 2.0**40 + 0.5
_BLOCK = 720  # rows: of more at once LAPACK wakes threads that keep a core busy for longer than this takes
_NOWHERE = 1e-6  # of a camera whose rows are one plane, on which all points are, so that none has a depth
_FAR_OFF = 1000.0  # extents of what it sees: a place so far off is that of no camera
_PARALLEL = 1e-9  # depths that differ by less than that fraction are the same
NO_PLANE = 1e-4
"""The last but one singular value over the largest, at least, of points that are no plane."""


class PinholeCamera(NamedTuple):
    """What maps points to pixels.

    Attributes
    ----------
    matrix : (3, 4) float64
        To w (row, column, 1) from (x, y, z, 1), metres; w is the depth along the axis, whose first three numbers are of
        unit length, up to the sign. Of a camera infinitely far off those are 0.
    """

    matrix: NDArray[np.float64]

    def pixels(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Row and column, (n, 2), at which n points are seen, (n, 3) metres, and their w, (n,).

        Of those beside the camera, at w = 0, and wherever it is more than 2**40, either is 2**40 and a half.
        """
        seen = np.einsum("ij,kj->ik", points, self.matrix[:, :3]) + self.matrix[:, 3]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            at = seen[:, :2] / seen[:, 2:]
            return np.where(np.abs(at) < _FAR_PIXEL, at, _FAR_PIXEL), seen[:, 2]

    def place(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Where it stands, (3,) metres; None if that is more than a thousand extents off what it sees, a box."""
        middle, scale = (low + high) / 2.0, max(float((high - low).max()) / 2.0, _TINY)
        about = np.column_stack((self.matrix[:, :3] * scale, self.matrix[:, :3] @ middle + self.matrix[:, 3]))
        centre = np.linalg.svd(about / np.abs(about).max(axis=1, keepdims=True).clip(_TINY))[2][-1]
        if not np.linalg.norm(centre[:3]) <= _FAR_OFF * abs(centre[3]):
            return None
        return middle + scale * centre[:3] / centre[3]


def resection(points: NDArray[np.float64], pixels: NDArray[np.float64], least: float = 0.0) -> PinholeCamera | None:
    """The camera that sees n points, (n, 3) metres, at their rows and columns, (n, 2); n >= 6.

    None if the last but one singular value is no more than so much of the largest, as of a plane, which many cameras
    see so, or if what solves the equations sees no point at any depth.

    Notes
    -----
    By the direct linear transform (Hartley and Zisserman 2004, 7.1), both sides normalised. Noise of a depth camera is
    along the rays, so it does not move the pixels.
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
    if np.abs(places @ matrix[2]).max() <= _NOWHERE:
        return None
    if np.linalg.norm(matrix[2, :3]) <= _PARALLEL * abs(matrix[2, 3]):
        matrix[2, :3] = 0.0
    matrix = np.array([[pitch, 0.0, of_pixels[0]], [0.0, pitch, of_pixels[1]], [0.0, 0.0, 1.0]]) @ matrix
    matrix = np.column_stack((matrix[:, :3] / scale, matrix[:, 3] - matrix[:, :3] @ middle / scale))
    length = math.hypot(*matrix[2, :3])  # whatever the unit
    return PinholeCamera(matrix / (length if length > 0.0 else matrix[2, 3]))


def is_far_off(low: NDArray[np.float64], high: NDArray[np.float64]) -> bool:
    """Whether the origin lies too far off a box, lowest and highest corner (3,), to be the place of a camera."""
    return float(np.abs(low + high).max()) / 2.0 > _FAR_OFF * float((high - low).max()) > 0.0


def _frame(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Middle and half of the largest extent of some places."""
    low, high = values.min(axis=0), values.max(axis=0)
    return (low + high) / 2.0, max(float((high - low).max()) / 2.0, _TINY)
