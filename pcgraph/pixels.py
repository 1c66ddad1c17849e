# SPDX-License-Identifier: Apache-2.0
"""Lists of points that are a camera's image: which pixel each of them is, told by their rays alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import CleanCloud, Pixels
from pcgraph.voxels.outliers import MIN_POINTS

_SOME, _LEAST = 4096, 2e-5  # values that are looked at first; steps below so much of all they span are rounding
_ADJACENT = 0.1  # quantile of the steps that is one between neighbours
_OFF = 0.1  # pixels by which a ray may be off its own
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
            others = [i for i in (2, 1, 0) if i != axis]  # y in rows, x in columns
            rays = [points[:, i] / points[:, axis] for i in others]
            grids = [_grid(ray) for ray in rays]
            if None not in grids and any(_grid(points[:, i]) is None for i in others):
                return _in_order(cloud, *grids)  # type: ignore[arg-type]
    return cloud


class _Grid(NamedTuple):
    """Which row, or column, each of n points is in, (n,) int64, and how many there are."""

    at: NDArray[np.int64]
    number: int


def _grid(values: NDArray[np.float64]) -> _Grid | None:
    """Values as whole numbers of one step from the least of them; None if they are not even."""
    some = values if len(values) <= _SOME else values[np.random.default_rng(0).integers(len(values), size=_SOME)]
    step = _step(np.sort(some))
    if step <= 0.0 or not _is_even((some - some[0]) / step):
        return None
    low, high = float(values.min()), float(values.max())
    at = (values - low) / step
    if not _is_even(at):
        return None
    return _Grid(np.rint(at).astype(np.int64), round((high - low) / step) + 1)


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


def _in_order(cloud: CleanCloud, rows: _Grid, columns: _Grid) -> CleanCloud:
    """The cloud in the order of pixels; as it is if two points are in one, or few in any."""
    shape = (rows.number, columns.number)
    n = len(cloud.points)
    if min(shape) < _NARROWEST or n < _FILLED * shape[0] * shape[1]:
        return cloud
    pixels = rows.at * columns.number + columns.at
    order = np.argsort(pixels, kind="stable")
    pixels = pixels[order]
    return cloud if (pixels[1:] == pixels[:-1]).any() else cloud.as_image(order, Pixels(shape, pixels))
