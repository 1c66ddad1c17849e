# SPDX-License-Identifier: Apache-2.0
"""Pixels of lists of points that are a camera's image, found from the rays of the points alone."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.pixel_lattice import (
    MAX_OFF_PIXEL,
    MAX_PIXELS,
    MIN_LINES,
    are_whole,
    likely_cameras,
    step_between,
)
from pcgraph.acquisition.resection import PinholeCamera, is_far_off
from pcgraph.inputs import CleanCloud, ImageView, Pixels
from pcgraph.parallel import in_blocks, inlined, kernel
from pcgraph.voxels.outliers import MIN_POINTS

_SAMPLE = 4096
"""Values of which it is asked first whether they are even; chosen by eye, for the time's sake."""
_NOTHING = -1
"""Value of the axis to divide by where there is none: the axes are 0, 1 and 2."""
_MIN_FILLED = 0.2
"""Fraction of an image's pixels that are points, at least: with less, accidents are likelier; chosen by eye."""


def with_pixels(cloud: CleanCloud) -> CleanCloud:
    """The cloud, with the pixels of its points if it is a list that a pinhole camera took.

    The test is sharp: seen from the camera, all points lie in rows and columns to a thousandth of a pixel, the rounding
    of single precision. No two points share a pixel, and at least a fifth of the pixels between the first and last rows
    and columns are points. A grid of points at one height is no image, as its coordinates are even without a division.
    """
    if cloud.image is not None or len(cloud.points) < MIN_POINTS:
        return cloud
    image = _image_in_own_frame(cloud) or _image_in_any_frame(cloud)
    return cloud if image is None else replace(cloud, image=image)


def _image_in_own_frame(cloud: CleanCloud) -> Pixels | None:
    """The pixels, if the camera is at the origin and looks along an axis; else None.

    Then x/z and y/z (or the same of other axes) are whole multiples of one over the focal length, up to a shift.
    """
    low, high = cloud.bounds
    forwards = [axis for axis in (2, 0, 1) if low[axis] > 0.0 or high[axis] < 0.0]
    if not forwards or is_far_off(low, high):
        return None
    points, some = cloud.points, cloud.sample[:_SAMPLE]
    for axis in forwards:
        across = [i for i in (2, 1, 0) if i != axis]  # y tells rows and x columns, if it looks along z
        rows, columns = (even_steps(points, some, i, axis) for i in across)
        if rows is None or columns is None:
            continue
        if any(even_steps(points, some, i, _NOTHING) is None for i in across):
            return _pixels(rows, columns, ImageView(np.zeros(3), np.sign(low[axis]) * np.eye(3)[axis]))
    return None


def _image_in_any_frame(cloud: CleanCloud) -> Pixels | None:
    """The pixels, if a patch of the points tells the camera; else None."""
    images = (_image_by(camera, cloud) for camera in likely_cameras(cloud.points, cloud.sample))
    return next((image for image in images if image is not None), None)


def _image_by(camera: PinholeCamera, cloud: CleanCloud) -> Pixels | None:
    """The pixels at which a camera sees the points of a cloud; None if some are off a pixel, or it has no place."""
    (low, high), n = cloud.bounds, len(cloud.points)
    place = camera.place(low, high)
    if place is None:
        return None
    at = np.empty((2, n), np.int64)
    ahead = np.array(in_blocks(_find_pixels, n, cloud.points, camera.matrix, at))
    if ahead.min() < 0 or ahead.sum() not in (0, n):
        return None
    first, last = at.min(axis=1), at.max(axis=1)
    rows, columns = (
        Steps(line - start, int(end - start) + 1) for line, start, end in zip(at, first, last, strict=True)
    )
    return _pixels(rows, columns, ImageView(place, camera.matrix[2, :3] * (1.0 if ahead.any() else -1.0)))


@kernel
def _find_pixels(
    start: int, stop: int, points: NDArray[np.float64], camera: NDArray[np.float64], at: NDArray[np.int64]
) -> int:
    """Set row and column, (2, n), at which a camera, (3, 4), sees points.

    Return the number of points on its positive side, or -1 if any is off its pixel.
    """
    ahead = 0
    for i in range(start, stop):
        x, y, z = points[i]
        depth = camera[2, 0] * x + camera[2, 1] * y + camera[2, 2] * z + camera[2, 3]
        for line in range(2):
            steps = (camera[line, 0] * x + camera[line, 1] * y + camera[line, 2] * z + camera[line, 3]) / depth
            if not (abs(steps - np.rint(steps)) <= MAX_OFF_PIXEL and abs(steps) <= MAX_PIXELS):
                return -1
            at[line, i] = np.int64(np.rint(steps))
        ahead += depth > 0.0
    return ahead


class Steps(NamedTuple):
    """Rows, or columns, of n points.

    Attributes
    ----------
    at : (n,) int64
        Row, or column, of each point.
    number : int
        Number of rows, or columns.
    """

    at: NDArray[np.int64]
    number: int


def even_steps(points: NDArray[np.float64], some: NDArray[np.float64], axis: int, over: int) -> Steps | None:
    """Coordinates of points, (n, 3), over those along another axis (-1: over 1), as whole numbers of one step.

    None if they are no whole multiples of a step. That is asked of some of the points first, (m, 3).
    """
    n = len(points)
    with np.errstate(over="ignore", invalid="ignore"):  # points in the camera
        values = np.sort(some[:, axis] if over == _NOTHING else some[:, axis] / some[:, over])
        step = step_between(values)
        if step <= 0.0 or not are_whole((values - values[0]) / step):
            return None
    ends = np.array(in_blocks(_ends, n, points, axis, over))
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    at = np.empty(n, np.int64)
    if not all(in_blocks(_count_steps, n, points, axis, over, low, step, at)):
        return None
    return Steps(at, round((high - low) / step) + 1)


@kernel
def _ends(start: int, stop: int, points: NDArray[np.float64], axis: int, over: int) -> tuple[float, float]:
    """Least and largest value of some points, as `_coordinate` gives it."""
    low, high = np.inf, -np.inf
    for i in range(start, stop):
        value = _coordinate(points, i, axis, over)
        low, high = min(low, value), max(high, value)
    return low, high


@kernel
def _count_steps(
    start: int,
    stop: int,
    points: NDArray[np.float64],
    axis: int,
    over: int,
    low: float,
    step: float,
    at: NDArray[np.int64],
) -> bool:
    """Set the number of steps from the least value to that of each point; return whether all are whole."""
    for i in range(start, stop):
        steps = (_coordinate(points, i, axis, over) - low) / step
        if not (abs(steps - np.rint(steps)) <= MAX_OFF_PIXEL and steps <= MAX_PIXELS):
            return False
        at[i] = np.int64(np.rint(steps))
    return True


@inlined
def _coordinate(points: NDArray[np.float64], i: int, axis: int, over: int) -> float:
    """Coordinate of a point, over that along another axis unless this is `_NOTHING`."""
    return points[i, axis] if over == _NOTHING else points[i, axis] / points[i, over]


def _pixels(rows: Steps, columns: Steps, view: ImageView) -> Pixels | None:
    """The pixels of points, given their rows and columns; None if two points share one, or if few pixels are points."""
    shape, n = (rows.number, columns.number), len(rows.at)
    if min(shape) < MIN_LINES or n < _MIN_FILLED * shape[0] * shape[1]:
        return None
    pixels = Pixels(shape, rows.at * columns.number + columns.at, view)
    return None if len(pixels.order) < n else pixels
