# SPDX-License-Identifier: Apache-2.0
"""Eigenvalues and eigenvectors of one symmetric 3 x 3 matrix, for use inside compiled loops."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import kernel, routine

SYMMETRIC_INDICES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column, one pair per stored element of a symmetric matrix, as in all moments: xx, yy, zz, xy, xz, yz."""

_MAX_ROTATIONS = 30
"""Count of rotations, at most: a guard. 20 000 random matrices, some nearly singular, took at most 10, as measured."""
_WIDE_GAP = 1e-4
"""Fraction of the trace between the least eigenvalue and the others, from which on the closed form is exact enough."""
_OF_HALF_ANGLE = np.array(
    [
        *(-0.766044443118978, -0.24740906632285306, 0.015509188436486476, -0.002466352815086729, 5.041246911241806e-4),
        *(-1.1642545294365808e-4, 2.8919936445771657e-05, -7.541078577128976e-06, 2.0358689527851317e-06),
        *(-5.641512226589075e-07, 1.595454044312633e-07, -4.5859787294391664e-08, 1.3345168217715474e-08),
        *(-3.930442656063793e-09, 1.188025128273651e-09, -3.56609708429545e-10, 9.128302558281121e-11),
        *(-2.7491853238359454e-11, 1.608801980523822e-11, -4.9852566519348326e-12),
    ]
)
"""Coefficients of the powers of 2 s - 1 in a polynomial equal to cos(2/3 arcsin s + 2/3 pi), dimensionless.

It interpolates at Chebyshev's nodes of 0..1, with so many powers that its error is that of rounding.
"""


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
    """Least eigenvalue if it is well apart from the others, else -1; `normal` receives its unit eigenvector.

    Parameters
    ----------
    scatter : (6,) float64
        xx, yy, zz, xy, xz, yz of a positive semi-definite matrix.
    normal : (3,) float64
        Overwritten; meaningless where the result is -1, which calls for `symmetric_eigen`.

    Notes
    -----
    The eigenvalue is found by the cosine formula (Smith 1961; `least_root`), its vector as the longest cross product of
    two rows of A - lambda I. That takes a tenth of the time of rotations. For a plane, whose gap is wide, it is as
    exact.
    """
    trace = scatter[0] + scatter[1] + scatter[2]
    if not trace > 0.0:
        return -1.0
    xx, yy, zz = scatter[0] / trace - 1.0 / 3.0, scatter[1] / trace - 1.0 / 3.0, scatter[2] / trace - 1.0 / 3.0
    xy, xz, yz = scatter[3] / trace, scatter[4] / trace, scatter[5] / trace
    spread, least = _spread_and_least(xx, yy, zz, xy, xz, yz)
    if spread < _WIDE_GAP:
        return -1.0
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

    By the cosine formula (Smith 1961), which loses half of the digits only if the two smaller eigenvalues coincide.
    """
    trace = xx + yy + zz
    if not trace > 0.0:
        return 0.0
    scale = 1.0 / trace
    xx, yy, zz = xx * scale - 1.0 / 3.0, yy * scale - 1.0 / 3.0, zz * scale - 1.0 / 3.0
    xy, xz, yz = xy * scale, xz * scale, yz * scale
    return max(_spread_and_least(xx, yy, zz, xy, xz, yz)[1] + 1.0 / 3.0, 0.0) * trace


@routine
def _spread_and_least(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> tuple[float, float]:
    """Spread and least eigenvalue of a matrix with trace 0; the spread is the root of a sixth of its sum of squares."""
    spread = np.sqrt((xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread == 0.0:
        return 0.0, 0.0
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return spread, 2.0 * spread * least_root(determinant / (2.0 * spread**3))


@kernel
def least_root(r: float) -> float:
    """Least root t of 4 t^3 - 3 t = r, to 2e-16: cos((arccos r + 2 pi) / 3). Values of r beyond -1..1 are clipped.

    With s = sin(arccos(r) / 2), the root is a smooth function of s over 0..1. A polynomial gives it with less error
    than the rounding of cos and arccos, in a third of their time.
    """
    x = 2.0 * np.sqrt(0.5 * (1.0 - min(max(r, -1.0), 1.0))) - 1.0
    square, even, odd = x * x, 0.0, 0.0
    for power in range(len(_OF_HALF_ANGLE) - 2, -1, -2):
        even = even * square + _OF_HALF_ANGLE[power]
        odd = odd * square + _OF_HALF_ANGLE[power + 1]
    return even + x * odd
