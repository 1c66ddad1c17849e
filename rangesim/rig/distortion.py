# SPDX-License-Identifier: Apache-2.0
"""Brown-Conrady lens distortion (OpenCV's k1, k2, p1, p2, k3) on the image plane z = 1, forward and inverse.

Arithmetic alone, so that NumPy and the renderer's arrays go through the same lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

ROUNDS = 12
"""Newton steps of the inverse. From the distorted point they converge at once but at the fold, where each halves the
error."""


class Distorted(NamedTuple):
    """Where a lens puts the ray (x, y, 1), and its (symmetric) Jacobian there.

    x, y : distorted image-plane coordinates.
    xx, xy, yy : d(distorted x, y) / d(undistorted x, y).
    """

    x: Any
    y: Any
    xx: Any
    xy: Any
    yy: Any

    @property
    def jacobian(self) -> Any:
        """Determinant: distorted area per undistorted area; not positive where the image is folded."""
        return self.xx * self.yy - self.xy * self.xy


def distort(coefficients: Sequence[Any], x: Any, y: Any) -> Distorted:
    """The image of rays (x, y, 1) for all five coefficients k1, k2, p1, p2, k3; closed form."""
    k1, k2, p1, p2, k3 = coefficients
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3)))
    return Distorted(
        x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx),
        y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy,
        radial + xx * slope + 2 * p1 * y + 6 * p2 * x,
        xy * slope + 2 * (p1 * x + p2 * y),
        radial + yy * slope + 6 * p1 * y + 2 * p2 * x,
    )


def undistort(coefficients: Sequence[Any], x: Any, y: Any) -> tuple[Any, Any]:
    """Image-plane coordinates whose image is (x, y), by Newton's method; anything where there are none.

    The caller checks: `distort` of the result must lead back, inside the fold.
    """
    u, v = x, y
    for _ in range(ROUNDS):
        at = distort(coefficients, u, v)
        off_x, off_y, scale = at.x - x, at.y - y, 1 / at.jacobian
        u = u - (at.yy * off_x - at.xy * off_y) * scale
        v = v - (at.xx * off_y - at.xy * off_x) * scale
    return u, v


NEGLIGIBLE = 1e-100
"""Coefficients below bend no ray, and their inverse is infinite."""


@lru_cache(maxsize=64)  # asked for at every step of a fit
def fold_radius2(coefficients: tuple[float, ...]) -> float:
    """Square of the image-plane radius at which the radial polynomial folds round; infinite if it does not.

    d/dr r (1 + k1 r^2 + k2 r^4 + k3 r^6) = 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6, and its first positive root ends the
    image: what lies beyond would appear where nearer points are already.
    """
    k1, k2, _, _, k3 = coefficients
    slope = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])
    roots = np.roots(np.where(np.abs(slope) < NEGLIGIBLE, 0.0, slope))
    folds = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(folds.min(initial=np.inf))
