# SPDX-License-Identifier: Apache-2.0
"""Sums of powers up to the fourth order, and how they move to another origin and unit."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Row t stands for x^a y^b z^c; ascending in order a + b + c: 1, 3, 6, 10 and 15 rows of order 0, 1, 2, 3 and 4.
EXPONENTS = np.array(
    [(a, b, order - a - b) for order in range(5) for a in range(order, -1, -1) for b in range(order - a, -1, -1)],
    dtype=np.int64,
)
N_POWERS = len(EXPONENTS)
_ROW = np.full((5, 5, 5), -1, np.int64)
_ROW[EXPONENTS[:, 0], EXPONENTS[:, 1], EXPONENTS[:, 2]] = np.arange(N_POWERS)
_CHOOSE = np.array([[1, 0, 0, 0, 0], [1, 1, 0, 0, 0], [1, 2, 1, 0, 0], [1, 3, 3, 1, 0], [1, 4, 6, 4, 1]], np.float64)


def tensor(powers: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """Sums of all products of `order` coordinates, (k, 3, ..., 3), from their (k, 35) sums of powers."""
    axes = np.indices((3,) * order).reshape(order, -1)
    exponents = np.stack([(axes == axis).sum(axis=0) for axis in range(3)])
    return powers[:, _ROW[tuple(exponents)]].reshape(len(powers), *(3,) * order)


@njit(cache=True, nogil=True)
def sums_of_powers(
    points: NDArray[np.float64], groups: NDArray[np.int32], centers: NDArray[np.float64], scales: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sums of x^a y^b z^c over the points of each of k groups, (k, 35), dimensionless.

    Parameters
    ----------
    points : (n, 3) float64, metres
    groups : (n,) int32, 0..k - 1
    centers : (k, 3) float64, metres
        Origin of each group's coordinates.
    scales : (k,) float64, metres
        Unit of each group's coordinates.
    """
    sums = np.zeros((len(centers), N_POWERS))
    ladder = np.ones((3, 5))
    for i in range(len(points)):
        s = groups[i]
        for axis in range(3):
            x = (points[i, axis] - centers[s, axis]) / scales[s]
            for order in range(1, 5):
                ladder[axis, order] = ladder[axis, order - 1] * x
        for t in range(N_POWERS):
            sums[s, t] += ladder[0, EXPONENTS[t, 0]] * ladder[1, EXPONENTS[t, 1]] * ladder[2, EXPONENTS[t, 2]]
    return sums


@njit(cache=True, nogil=True)
def add_moved(
    target: NDArray[np.float64], source: NDArray[np.float64], offset: NDArray[np.float64], ratio: float
) -> None:
    """Nothing; `target` gains the points that `source` sums, in the target's coordinates.

    Parameters
    ----------
    target, source : (35,) float64
        Sums of powers; the target's are changed.
    offset : (3,) float64
        The source's origin in the target's coordinates.
    ratio : float
        The source's unit in the target's.

    Notes
    -----
    By the binomial theorem, hence exact but for rounding.
    """
    ladder = np.ones((3, 5))
    units = np.ones(5)
    for order in range(1, 5):
        units[order] = units[order - 1] * ratio
        for axis in range(3):
            ladder[axis, order] = ladder[axis, order - 1] * offset[axis]
    for t in range(N_POWERS):
        a, b, c = EXPONENTS[t]
        for i in range(a + 1):
            for j in range(b + 1):
                for k in range(c + 1):
                    ways = _CHOOSE[a, i] * _CHOOSE[b, j] * _CHOOSE[c, k]
                    shift = ladder[0, a - i] * ladder[1, b - j] * ladder[2, c - k]
                    target[t] += ways * shift * units[i + j + k] * source[_ROW[i, j, k]]
