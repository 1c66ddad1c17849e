# SPDX-License-Identifier: Apache-2.0
"""Eigen-decomposition of one symmetric 3 x 3 matrix, for use inside compiled loops."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

_MAX_ROTATIONS = 30


@njit(cache=True)
def symmetric_eigen(matrix: NDArray[np.float64], vectors: NDArray[np.float64]) -> None:
    """Nothing; `matrix` becomes diagonal (unsorted eigenvalues), `vectors` its eigenvectors as columns.

    Parameters
    ----------
    matrix : (3, 3) float64
        Symmetric; overwritten.
    vectors : (3, 3) float64
        Overwritten.

    Notes
    -----
    Jacobi's method with the largest off-diagonal element first: unlike the closed form by cosines it keeps
    full precision when eigenvalues (nearly) coincide, which perfectly flat and collinear clouds make the
    normal case.
    """
    vectors[:] = 0.0
    for i in range(3):
        vectors[i, i] = 1.0
    for _ in range(_MAX_ROTATIONS):
        p, q = 0, 1
        if abs(matrix[0, 2]) > abs(matrix[p, q]):
            p, q = 0, 2
        if abs(matrix[1, 2]) > abs(matrix[p, q]):
            p, q = 1, 2
        off = matrix[p, q]
        if abs(off) <= 1e-16 * (abs(matrix[0, 0]) + abs(matrix[1, 1]) + abs(matrix[2, 2])):
            return
        theta = (matrix[q, q] - matrix[p, p]) / (2.0 * off)
        t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
        if theta < 0.0:
            t = -t
        c = 1.0 / np.sqrt(t * t + 1.0)
        s = t * c
        r = 3 - p - q
        matrix[p, p] -= t * off
        matrix[q, q] += t * off
        matrix[p, q] = matrix[q, p] = 0.0
        rp, rq = matrix[r, p], matrix[r, q]
        matrix[r, p] = matrix[p, r] = c * rp - s * rq
        matrix[r, q] = matrix[q, r] = s * rp + c * rq
        for i in range(3):
            ip, iq = vectors[i, p], vectors[i, q]
            vectors[i, p] = c * ip - s * iq
            vectors[i, q] = s * ip + c * iq
