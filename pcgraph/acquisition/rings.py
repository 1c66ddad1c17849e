# SPDX-License-Identifier: Apache-2.0
"""The rings of a turning scanner, which tell its place and its axis to a hundredth of the ranges or better.

A beam sweeps a cone about the axis. So its elevation does not change along a ring, whatever the ring crosses, and noise
of the ranges leaves its points on the cone. A list of points does not say which of them lie on one ring. But if beams
lie farther apart than the points of each, the two nearest neighbours of a point lie on its own ring.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.rounding import TINY
from pcgraph.voxels.spacing import Rows


@dataclass(frozen=True)
class RingThresholds:
    """Conditions for rows of points to lie on the rings of one scanner. Chosen by eye; none was varied.

    The steepness of rows against their cones is the mean of g^2 / (g^2 + s^2), where g is the slope of a row and s a
    scale: about the fraction of the rows that are steeper than s.
    """

    min_rows: int = 40  # rows of points: with fewer no scanner is looked for
    first_rows: int = 256  # rows with which a search starts
    max_rows: int = 512  # rows that are looked at, at most
    min_spread: float = 0.15  # of the rows' squares, along their second principal direction: else they are parallel
    coarse: float = 0.2  # radians, the scale s by which places are judged before a search
    middle: float = 0.1  # radians, the scale of a search with the first rows
    fine: float = 0.02  # radians, the scale of a search with all rows, and of their noise
    max_steepness_of_start: float = 0.6  # steepness by the coarse scale: with more no search starts there
    max_steepness: float = 0.3  # steepness by the other two scales: with more the rows are no rings
    max_uncertainty: float = 0.05  # median ranges, standard deviation of the place
    max_condition: float = 1e4  # condition of the derivatives: with more, some line of places fits as well
    near: float = 0.2  # median ranges: rows nearer to a place seem to tell it wherever it is, and do not count
    min_cosine: float = 1e-3  # cosine of an elevation, at least: a guard at the poles
    max_evaluations: int = 15  # evaluations of a search: a guard


_RINGS = RingThresholds()


class Scanner(NamedTuple):
    """A turning scanner.

    Attributes
    ----------
    place : (3,) float64, metres
    axis : (3,) float64
        Axis about which it turned, of length 1 and either sign.
    """

    place: NDArray[np.float64]
    axis: NDArray[np.float64]


def scanner_of_rings(rows: Rows, near: NDArray[np.float64]) -> Scanner | None:
    """The scanner on whose rings the rows of points lie; None if there is none, or if there are fewer than 40 rows.

    Parameters
    ----------
    rows : Rows
        In an order as good as random: the first 512 are looked at.
    near : (k, 3) float64
        Places from which to search, the best first. They may be off by half of the median range.

    Notes
    -----
    With d the ray to a point, u the direction of its row and a the axis, the slope of the row against its cone is
    (u . a - (u . d) (a . d)) / cos(elevation). It is zero along rings. Place and axis are those of least slopes, by a
    Cauchy loss, as some rows join neighbours on different rings.
    """
    rows = Rows(*(column[: _RINGS.max_rows] for column in rows))
    if len(rows.points) < _RINGS.min_rows:
        return None
    squares, frame = np.linalg.eigh(rows.directions.T @ rows.directions)  # the axis first, as rings are nearly level
    if squares[1] < _RINGS.min_spread * len(rows.points):  # as the rows of an image are, which tell no place
        return None
    low, high = rows.points.min(axis=0), rows.points.max(axis=0)
    middle, reach = (low + high) / 2.0, float((high - low).max()) / 2.0
    if reach == 0.0:
        return None
    rows = rows._replace(points=(rows.points - middle) / reach)
    some = Rows(*(column[: _RINGS.first_rows] for column in rows))
    starts = np.column_stack(((near - middle) / reach, np.zeros((len(near), 2))))
    steepness = np.array([_steepness(some, frame, start, _RINGS.coarse) for start in starts])
    n_near = np.count_nonzero(steepness <= _RINGS.max_steepness_of_start)
    for start in starts[np.argsort(steepness, kind="stable")[:n_near]]:
        unknown = _flattest(some, frame, start, _RINGS.middle)
        if _steepness(some, frame, unknown, _RINGS.middle) > _RINGS.max_steepness:
            continue
        unknown = _flattest(rows, frame, unknown, _RINGS.fine)
        if _steepness(rows, frame, unknown, _RINGS.fine) <= _RINGS.max_steepness and _is_certain(rows, frame, unknown):
            return Scanner(middle + reach * unknown[:3], _axis(frame, unknown)[0])
    return None


def _is_certain(rows: Rows, frame: NDArray[np.float64], unknown: NDArray[np.float64]) -> bool:
    """Whether the slopes tell the place to a fraction of the ranges.

    Those of level circles about one axis do not: they tell only that the place lies on the axis.
    """
    slopes, derivatives = _slopes(rows, frame, unknown)
    ranges = np.linalg.norm(rows.points - unknown[:3], axis=1)
    typical = float(np.median(ranges))
    far = ranges > _RINGS.near * typical  # rows beside a place seem to tell it, wherever it is
    trusted = derivatives[far] / np.hypot(1.0, slopes[far] / _RINGS.fine)[:, None]
    if np.linalg.cond(trusted) > _RINGS.max_condition:
        return False
    variance = np.linalg.eigvalsh(np.linalg.inv(trusted.T @ trusted)[:3, :3])[-1]
    return bool(_RINGS.fine * np.sqrt(variance) <= _RINGS.max_uncertainty * typical)


def _flattest(rows: Rows, frame: NDArray[np.float64], start: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Place and tilts of the axis, (5,), of least slopes near a start, by a Cauchy loss of a scale."""
    slopes, derivatives = (partial(_either, rows, frame, which) for which in (0, 1))
    from scipy.optimize import least_squares

    return least_squares(slopes, start, derivatives, loss="cauchy", f_scale=scale, max_nfev=_RINGS.max_evaluations).x


def _either(rows: Rows, frame: NDArray[np.float64], which: int, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slopes if `which` is 0, else their derivatives."""
    return _slopes(rows, frame, unknown)[which]


def _slopes(
    rows: Rows, frame: NDArray[np.float64], unknown: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes of rows against the cones about a scanner, (m,), and their derivatives by the unknowns, (m, 5).

    The unknowns, (5,), are the scanner's place and the tilts of its axis from the frame's first column to the others.
    """
    axis, length = _axis(frame, unknown)
    rays = rows.points - unknown[:3]
    ranges = np.maximum(np.linalg.norm(rays, axis=1), TINY)[:, None]
    rays = rays / ranges
    along, sines = np.einsum("ij,ij->i", rows.directions, rays)[:, None], (rays @ axis)[:, None]
    cosines = np.sqrt(np.maximum(1.0 - sines * sines, _RINGS.min_cosine**2))
    across = rows.directions - along * rays
    slopes = (across @ axis)[:, None] / cosines
    by_cosine = slopes * sines / cosines**2
    by_ray = by_cosine * axis - (sines * rows.directions + along * axis) / cosines
    by_place = (np.einsum("ij,ij->i", by_ray, rays)[:, None] * rays - by_ray) / ranges
    by_axis = across / cosines + by_cosine * rays
    by_tilt = (by_axis - (by_axis @ axis)[:, None] * axis) @ frame[:, 1:] / length
    return slopes[:, 0], np.hstack((by_place, by_tilt))


def _axis(frame: NDArray[np.float64], unknown: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The axis that the unknowns tell, (3,) of length 1, and its length before normalisation."""
    axis = frame[:, 0] + frame[:, 1:] @ unknown[3:]
    length = float(np.linalg.norm(axis))
    return axis / length, length


def _steepness(rows: Rows, frame: NDArray[np.float64], unknown: NDArray[np.float64], scale: float) -> float:
    """Steepness of rows against their cones by a scale, 0..1; see `RingThresholds`."""
    slopes = _slopes(rows, frame, unknown)[0]
    return float(np.mean(slopes**2 / (slopes**2 + scale**2)))
