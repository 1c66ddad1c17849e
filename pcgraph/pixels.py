# SPDX-License-Identifier: Apache-2.0
"""Lists of points that are a camera's image: which pixel each of them is, told by their rays alone."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import CleanCloud, Pixels
from pcgraph.parallel import in_blocks, inlined, kernel
from pcgraph.voxels.outliers import MIN_POINTS

_SOME, _LEAST = 4096, 2e-5  # values that are looked at first; steps below so much of all they span are rounding
_ADJACENT = 0.1  # quantile of the steps that is one between neighbours
_OFF = 0.1  # pixels by which a ray may be off its own
_NOTHING = -1  # to divide by
_FILLED, _NARROWEST = 0.2, 8  # of an image at least, by points; and pixels, rows and columns


def with_pixels(cloud: CleanCloud) -> CleanCloud:
    """The cloud, in the order of its pixels if it is a list that a pinhole camera at the origin took, along any axis.

    That a list is such an image is exact: in the camera's frame x/z and y/z of all points are whole multiples of one
    over the focal length, up to a shift, as rays of pixels are; single precision leaves a thousandth of a pixel of it.
    No two points are one pixel, and at least a fifth of the pixels in rows and columns between the first and the last
    are points. A grid of points at one height is not said to be one, as it is as even without a division.
    """
    if cloud.image is not None or len(cloud.points) < MIN_POINTS:
        return cloud
    points = cloud.points
    low, high = cloud.bounds
    for axis in (2, 0, 1):
        if low[axis] > 0.0 or high[axis] < 0.0:
            across = [i for i in (2, 1, 0) if i != axis]  # y, in rows, and x of one that looks along z
            rows, columns = (even_steps(points, i, axis) for i in across)
            if rows is not None and columns is not None and None in (even_steps(points, i, _NOTHING) for i in across):
                return _in_order(cloud, rows, columns)
    return cloud


class Steps(NamedTuple):
    """Which row, or column, each of n points is in, (n,) int64, and how many there are."""

    at: NDArray[np.int64]
    number: int


def even_steps(points: NDArray[np.float64], axis: int, over: int) -> Steps | None:
    """Coordinates of points, (n, 3), over those along another axis (-1: over 1) as whole numbers of one step.

    None if they are not even.
    """
    n = len(points)
    some = points if n <= _SOME else points[np.random.default_rng(0).integers(n, size=_SOME)]
    with np.errstate(over="ignore", invalid="ignore"):  # of points in the camera
        values = np.sort(some[:, axis] if over == _NOTHING else some[:, axis] / some[:, over])
        step = _step(values)
    if step <= 0.0 or not _is_even((values - values[0]) / step):
        return None
    ends = np.array(in_blocks(_ends, n, points, axis, over))
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    at = np.empty(n, np.int64)
    if not all(in_blocks(_count_steps, n, points, axis, over, low, step, at)):
        return None
    return Steps(at, round((high - low) / step) + 1)


@kernel
def _ends(start: int, stop: int, points: NDArray[np.float64], axis: int, over: int) -> tuple[float, float]:
    """Least and largest of the coordinates of some points."""
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
    """Set how many steps from the least the coordinates of some points are; whether all are even."""
    for i in range(start, stop):
        steps = (_coordinate(points, i, axis, over) - low) / step
        at[i] = np.int64(np.rint(steps))
        if not abs(steps - np.rint(steps)) <= _OFF:
            return False
    return True


@inlined
def _coordinate(points: NDArray[np.float64], i: int, axis: int, over: int) -> float:
    return points[i, axis] if over == _NOTHING else points[i, axis] / points[i, over]


def _step(ascending: NDArray[np.float64]) -> float:
    """The distance between neighbours, if values are even: the mean, once known by how many each is from the last."""
    span = float(ascending[-1] - ascending[0])
    steps = np.diff(ascending)
    steps = steps[steps > _LEAST * span]
    if len(steps) < _NARROWEST - 1:
        return 0.0
    return span / float(np.rint(steps / np.quantile(steps, _ADJACENT)).sum())


def _is_even(values: NDArray[np.float64]) -> bool:
    return bool((np.abs(values - np.rint(values)) <= _OFF).all())


def _in_order(cloud: CleanCloud, rows: Steps, columns: Steps) -> CleanCloud:
    """The cloud in the order of pixels; as it is if two points are in one, or few in any."""
    shape = (rows.number, columns.number)
    n = len(cloud.points)
    if min(shape) < _NARROWEST or n < _FILLED * shape[0] * shape[1]:
        return cloud
    pixels = rows.at * columns.number + columns.at
    if (np.diff(pixels) > 0).all():
        return replace(cloud, image=Pixels(shape, pixels))
    point_of_pixel = np.full(shape[0] * shape[1], -1)
    point_of_pixel[pixels] = np.arange(n)
    order = point_of_pixel[point_of_pixel >= 0]
    return cloud if len(order) < n else cloud.as_image(order, Pixels(shape, pixels[order]))
