# SPDX-License-Identifier: Apache-2.0
"""The rings of a turning scanner: they tell its place and its axis, to a hundredth of the ranges or better.

A beam sweeps a cone about the axis. So along a ring the beam's elevation does not change, whatever the ring crosses,
and noise of the ranges leaves its points on the cone. A list of points does not say which lie on one ring; but where
beams lie farther apart than the points of each, the two nearest of a point are its neighbours on its ring.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_MIN_ROWS, _SOME_ROWS, _MAX_ROWS = 40, 256, 512  # that are looked at: at first, and at last
_NOT_PARALLEL = 0.15  # of the rows' squares, along the second of their principal directions
_COARSE, _MIDDLE, _FINE = 0.2, 0.1, 0.02  # slopes of rows against their cones, radians
_TOO_STEEP = 0.6  # mean of g^2 / (g^2 + s^2), g being slopes and s the coarse one: no place from which to search
_MAX_STEEPNESS = 0.3  # the same with the finer ones: no rings
_MAX_UNCERTAINTY = 0.05  # standard deviation of the place, in ranges
_SINGULAR = 1e4  # condition of the derivatives: with more, some line of places does as well
_NEAR = 0.2  # median ranges
_MIN_COSINE = 1e-3  # of an elevation
_STEPS = 15  # of a search


class Rows(NamedTuple):
    """Points between two others, their nearest, (m, 3), and the unit directions along these, (m, 3), either way."""

    points: NDArray[np.float64]
    directions: NDArray[np.float64]


class Scanner(NamedTuple):
    """Where a scanner stood, (3,), and the axis about which it turned, (3,) of length 1, either way."""

    place: NDArray[np.float64]
    axis: NDArray[np.float64]


def scanner_of_rings(rows: Rows, near: NDArray[np.float64]) -> Scanner | None:
    """The scanner on whose rings rows of points lie; None if they lie on no scanner's, or are fewer than 40.

    Parameters
    ----------
    rows : Rows
        In an order as good as random: the first 512 are looked at.
    near : (k, 3) float64
        Places from which to search, the best first: half the median range off will do.

    Notes
    -----
    With d the ray to a point, u the direction of its row and a the axis, (u . a - (u . d) (a . d)) / cos(elevation) is
    the slope of the row against its cone, and zero along rings. Place and axis are those of least slopes, by a Cauchy
    loss, as neighbours on different rings are no row.
    """
    rows = Rows(*(column[:_MAX_ROWS] for column in rows))
    if len(rows.points) < _MIN_ROWS:
        return None
    squares, frame = np.linalg.eigh(rows.directions.T @ rows.directions)  # the axis first, as rings are nearly level
    if squares[1] < _NOT_PARALLEL * len(rows.points):  # as rows of an image are, which tell no place
        return None
    low, high = rows.points.min(axis=0), rows.points.max(axis=0)
    middle, reach = (low + high) / 2.0, float((high - low).max()) / 2.0
    if reach == 0.0:
        return None
    rows = rows._replace(points=(rows.points - middle) / reach)
    some = Rows(*(column[:_SOME_ROWS] for column in rows))
    starts = np.column_stack(((near - middle) / reach, np.zeros((len(near), 2))))
    steepness = np.array([_steepness(some, frame, start, _COARSE) for start in starts])
    for start in starts[np.argsort(steepness, kind="stable")[: np.count_nonzero(steepness <= _TOO_STEEP)]]:
        unknown = _flattest(some, frame, start, _MIDDLE)
        if _steepness(some, frame, unknown, _MIDDLE) > _MAX_STEEPNESS:
            continue
        unknown = _flattest(rows, frame, unknown, _FINE)
        if _steepness(rows, frame, unknown, _FINE) <= _MAX_STEEPNESS and _is_certain(rows, frame, unknown):
            return Scanner(middle + reach * unknown[:3], _axis(frame, unknown)[0])
    return None


def _is_certain(rows: Rows, frame: NDArray[np.float64], unknown: NDArray[np.float64]) -> bool:
    """Whether the slopes tell the place, and not only that it lies on some line, as those of level circles do."""
    slopes, derivatives = _slopes(rows, frame, unknown)
    ranges = np.linalg.norm(rows.points - unknown[:3], axis=1)
    typical = float(np.median(ranges))
    far = ranges > _NEAR * typical  # rows beside any place that is asked about seem to tell it
    trusted = derivatives[far] / np.hypot(1.0, slopes[far] / _FINE)[:, None]
    if np.linalg.cond(trusted) > _SINGULAR:
        return False
    variance = np.linalg.eigvalsh(np.linalg.inv(trusted.T @ trusted)[:3, :3])[-1]
    return bool(_FINE * np.sqrt(variance) <= _MAX_UNCERTAINTY * typical)


def _flattest(rows: Rows, frame: NDArray[np.float64], start: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Place and tilts of the axis, (5,), of the least slopes in reach of some others."""
    from scipy.optimize import least_squares

    slopes, derivatives = (partial(_either, rows, frame, which) for which in (0, 1))
    return least_squares(slopes, start, derivatives, loss="cauchy", f_scale=scale, max_nfev=_STEPS).x


def _either(rows: Rows, frame: NDArray[np.float64], which: int, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slopes or their derivatives."""
    return _slopes(rows, frame, unknown)[which]


def _slopes(
    rows: Rows, frame: NDArray[np.float64], unknown: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes of rows against the cones about a scanner, (m,), and their derivatives, (m, 5).

    The unknown are the scanner's place, (3,), and how far its axis is tilted from a frame's first column to the others.
    """
    axis, length = _axis(frame, unknown)
    rays = rows.points - unknown[:3]
    ranges = np.maximum(np.linalg.norm(rays, axis=1), np.finfo(float).tiny)[:, None]
    rays = rays / ranges
    along, sines = np.einsum("ij,ij->i", rows.directions, rays)[:, None], (rays @ axis)[:, None]
    cosines = np.sqrt(np.maximum(1.0 - sines * sines, _MIN_COSINE**2))
    across = rows.directions - along * rays
    slopes = (across @ axis)[:, None] / cosines
    by_cosine = slopes * sines / cosines**2
    by_ray = by_cosine * axis - (sines * rows.directions + along * axis) / cosines
    by_place = (np.einsum("ij,ij->i", by_ray, rays)[:, None] * rays - by_ray) / ranges
    by_axis = across / cosines + by_cosine * rays
    by_tilt = (by_axis - (by_axis @ axis)[:, None] * axis) @ frame[:, 1:] / length
    return slopes[:, 0], np.hstack((by_place, by_tilt))


def _axis(frame: NDArray[np.float64], unknown: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The axis, (3,) of length 1, and its length before that was made 1."""
    axis = frame[:, 0] + frame[:, 1:] @ unknown[3:]
    length = float(np.linalg.norm(axis))
    return axis / length, length


def _steepness(rows: Rows, frame: NDArray[np.float64], unknown: NDArray[np.float64], scale: float) -> float:
    """Mean of g^2 / (g^2 + s^2) of slopes g, 0..1: about the fraction of rows that are steeper than a scale s."""
    slopes = _slopes(rows, frame, unknown)[0]
    return float(np.mean(slopes**2 / (slopes**2 + scale**2)))
