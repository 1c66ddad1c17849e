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
from pcgraph.voxels.sampling import thinned

_SOME, _LEAST = 4096, 2e-5  # values that are looked at first; steps below so much of all they span are rounding
_ADJACENT = 0.1  # quantile of the steps that is one between neighbours
_OFF = 0.1  # pixels by which a ray may be off its own
_NOTHING = -1  # to divide by
_MOST_PIXELS = 1 << 20  # in a row or column
_FILLED, _NARROWEST = 0.2, 8  # of an image at least, by points; and pixels, rows and columns


def with_pixels(cloud: CleanCloud) -> CleanCloud:
    """The cloud, with the pixels of its points if it is a list that a pinhole camera at the origin took.

    That a list is such an image is exact: in the camera's frame x/z and y/z of all points (or those over whichever axis
    looks forwards) are whole multiples of one over the focal length, up to a shift, as rays of pixels are; single
    precision leaves a thousandth of a pixel of it. No two points are one pixel, and at least a fifth of the pixels in
    rows and columns between the first and the last are points. A grid of points at one height is not said to be one, as
    it is as even without a division.
    """
    if cloud.image is not None or len(cloud.points) < MIN_POINTS:
        return cloud
    low, high = cloud.bounds
    forwards = [axis for axis in (2, 0, 1) if low[axis] > 0.0 or high[axis] < 0.0]
    if not forwards:
        return cloud
    points, some = cloud.points, thinned(cloud.points, _SOME)
    for axis in forwards:
        across = [i for i in (2, 1, 0) if i != axis]  # y, in rows, and x of one that looks along z
        rows, columns = (even_steps(points, some, i, axis) for i in across)
        if rows is None or columns is None:
            continue
        if any(even_steps(points, some, i, _NOTHING) is None for i in across):
            return _as_image(cloud, rows, columns, np.sign(low[axis]) * np.eye(3)[axis])
    return cloud


class Steps(NamedTuple):
    """Which row, or column, each of n points is in, (n,) int64, and how many there are."""

    at: NDArray[np.int64]
    number: int


def even_steps(points: NDArray[np.float64], some: NDArray[np.float64], axis: int, over: int) -> Steps | None:
    """Coordinates of points, (n, 3), over those along another axis (-1: over 1) as whole numbers of one step.

    None if they are not even, which is asked of some of them first, (m, 3).
    """
    n = len(points)
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
        if not (abs(steps - np.rint(steps)) <= _OFF and steps <= _MOST_PIXELS):
            return False
        at[i] = np.int64(np.rint(steps))
    return True


@inlined
def _coordinate(points: NDArray[np.float64], i: int, axis: int, over: int) -> float:
    return points[i, axis] if over == _NOTHING else points[i, axis] / points[i, over]


def _step(ascending: NDArray[np.float64]) -> float:
    """The distance between neighbours, if values are even: the mean, once known by how many each is from the last."""
    span = float(ascending[-1] - ascending[0]) if len(ascending) else 0.0
    steps = np.diff(ascending)
    steps = steps[steps > _LEAST * span]
    if len(steps) < _NARROWEST - 1:
        return 0.0
    step = span / float(np.rint(steps / np.quantile(steps, _ADJACENT)).sum())
    if not span <= _MOST_PIXELS * step:
        return 0.0
    return step * int(np.gcd.reduce(np.rint((ascending - ascending[0]) / step).astype(np.int64)))  # it may be a half


def _is_even(values: NDArray[np.float64]) -> bool:
    return bool((np.abs(values - np.rint(values)) <= _OFF).all())


def _as_image(cloud: CleanCloud, rows: Steps, columns: Steps, axis: NDArray[np.float64]) -> CleanCloud:
    """The cloud with its pixels; as it is if two points are in one, or few in any."""
    shape = (rows.number, columns.number)
    n = len(cloud.points)
    if min(shape) < _NARROWEST or n < _FILLED * shape[0] * shape[1]:
        return cloud
    at = rows.at * columns.number + columns.at
    point_at = np.full(shape[0] * shape[1], -1)
    point_at[at] = np.arange(n)
    order = point_at[point_at >= 0]
    return cloud if len(order) < n else replace(cloud, image=Pixels(shape, at, order, axis))
