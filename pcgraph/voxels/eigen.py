# SPDX-License-Identifier: Apache-2.0
"""Eigenvalues and eigenvectors of one symmetric 3 x 3 matrix, for use inside compiled loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import kernel, routine

AXES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Rows and columns of a symmetric matrix, in the order of the six numbers that stand for it."""

_MAX_ROTATIONS = 30
_WIDE_GAP = 1e-4  # of the trace: the least eigenvalue stands this far apart, so the closed form is exact


@kernel
def symmetric_eigen(matrix: NDArray[np.float64], vectors: NDArray[np.float64]) -> None:
    """Diagonalise `matrix` in place (unsorted eigenvalues); `vectors` receives its eigenvectors as columns.

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


@kernel
def plane_normal(scatter: NDArray[np.float64], normal: NDArray[np.float64]) -> float:
    """Least eigenvalue, if it stands well apart from the others, else -1; `normal` receives its unit eigenvector.

    Parameters
    ----------
    scatter : (6,) float64
        xx, yy, zz, xy, xz, yz of a positive semi-definite matrix.
    normal : (3,) float64
        Overwritten; meaningless where the result is -1, which calls for `symmetric_eigen`.

    Notes
    -----
    Eigenvalues by the cosine formula (Smith 1961), the vector as the longest cross product of two rows of
    A - lambda I: a tenth of the time of rotations, and for a plane, where the gap is wide, as exact.
    """
    trace = scatter[0] + scatter[1] + scatter[2]
    if not trace > 0.0:
        return -1.0
    xx, yy, zz = scatter[0] / trace - 1.0 / 3.0, scatter[1] / trace - 1.0 / 3.0, scatter[2] / trace - 1.0 / 3.0
    xy, xz, yz = scatter[3] / trace, scatter[4] / trace, scatter[5] / trace
    spread = np.sqrt((xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread < _WIDE_GAP:
        return -1.0
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    angle = np.arccos(min(max(determinant / (2.0 * spread**3), -1.0), 1.0)) / 3.0
    least = 2.0 * spread * np.cos(angle + 2.0 * np.pi / 3.0)
    middle = -0.5 * (least + np.sqrt(max(3.0 * (4.0 * spread * spread - least * least), 0.0)))  # of the quadratic left
    if middle - least < _WIDE_GAP:
        return -1.0
    xx, yy, zz = xx - least, yy - least, zz - least
    longest = 0.0
    for pair in range(3):
        if pair == 0:
            x, y, z = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy
        elif pair == 1:
            x, y, z = xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz
        else:
            x, y, z = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz
        length = x * x + y * y + z * z
        if length > longest:
            longest = length
            normal[0], normal[1], normal[2] = x, y, z
    length = np.sqrt(longest)
    normal[0], normal[1], normal[2] = normal[0] / length, normal[1] / length, normal[2] / length
    return max(least + 1.0 / 3.0, 0.0) * trace


@routine
def least_eigenvalue(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> float:
    """Least eigenvalue of a positive semi-definite matrix, to 1e-8 of its trace (of a plane to 1e-15).

    The cosine formula (Smith 1961), which loses half of the digits only where the two smaller eigenvalues coincide.
    """
    trace = xx + yy + zz
    if not trace > 0.0:
        return 0.0
    xx, yy, zz = xx / trace - 1.0 / 3.0, yy / trace - 1.0 / 3.0, zz / trace - 1.0 / 3.0
    xy, xz, yz = xy / trace, xz / trace, yz / trace
    spread = np.sqrt((xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread == 0.0:
        return trace / 3.0
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    angle = np.arccos(min(max(determinant / (2.0 * spread**3), -1.0), 1.0)) / 3.0
    return max(2.0 * spread * np.cos(angle + 2.0 * np.pi / 3.0) + 1.0 / 3.0, 0.0) * trace
