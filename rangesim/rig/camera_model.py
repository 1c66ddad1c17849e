# SPDX-License-Identifier: Apache-2.0
"""The camera model: a pinhole with Brown-Conrady distortion (OpenCV's k1, k2, p1, p2, k3), and its inverse.

A ray (x, y, 1) in camera coordinates meets the image plane z = 1 at (x, y). The distortion moves this point to
(x', y'), and the pixel coordinates are u = fx x' + cx, v = fy y' + cy.

The functions use arithmetic and comparisons only, so the same lines run on Python numbers, on NumPy arrays, on the
renderer's arrays (Dr.Jit) and in compiled loops (numba). `rangesim.rig.Intrinsics` is their interface for users.
`unproject` in `rangesim/report/sensor_views.js` repeats the pinhole without distortion, because it runs in a browser.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

NEWTON_STEPS = 12
"""Number of Newton steps of `undistort`. For k1 = -0.3, k2 = 0.1 the fourth step reaches double precision over a field
of view of 80 degrees. Next to a fold each step only halves the error: for k1 = -0.45, 12 steps reach double precision
everywhere except in a rim along the fold of 0.1 % of the radius. With more steps this rim would be thinner, and the
time longer in proportion."""


class CameraModel(NamedTuple):
    """Parameters of a camera, as kernels take them; made by `rangesim.rig.Intrinsics.model`.

    fx, fy, cx, cy : focal lengths and principal point, pixels.
    coefficients : k1, k2, p1, p2, k3, dimensionless.
    fold_radius2 : squared radius on the image plane, dimensionless, beyond which the lens shows nothing; see
        `fold_radius2`.
    """

    fx: Any
    fy: Any
    cx: Any
    cy: Any
    coefficients: Sequence[Any]
    fold_radius2: Any


class Distorted(NamedTuple):
    """The point where a lens shows the ray (x, y, 1), and the derivative of that point.

    x, y : distorted coordinates on the image plane.
    xx, xy, yy : entries of the symmetric Jacobian d(distorted x, y) / d(undistorted x, y).
    jacobian : its determinant: distorted area per undistorted area. It is not positive where the image is folded.
    """

    x: Any
    y: Any
    xx: Any
    xy: Any
    yy: Any
    jacobian: Any


def distort(coefficients: Sequence[Any], x: Any, y: Any) -> Distorted:
    """The distorted image of rays (x, y, 1), in closed form.

    coefficients : k1, k2, p1, p2, k3; all five.

    Examples
    --------
    >>> image = distort((-0.1, 0, 0, 0, 0), 0.5, 0.0)
    >>> image.x, image.y
    (0.4875, 0.0)
    """
    k1, k2, p1, p2, k3 = coefficients
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3)))
    by_xx = radial + xx * slope + 2 * p1 * y + 6 * p2 * x
    by_xy = xy * slope + 2 * (p1 * x + p2 * y)
    by_yy = radial + yy * slope + 6 * p1 * y + 2 * p2 * x
    return Distorted(
        x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx),
        y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy,
        by_xx,
        by_xy,
        by_yy,
        by_xx * by_yy - by_xy * by_xy,
    )


def undistort(coefficients: Sequence[Any], x: Any, y: Any) -> tuple[Any, Any]:
    """Undistorted coordinates of the distorted point (x, y) on the image plane, by Newton's method.

    Where no ray leads to the point, the result is arbitrary. `unproject` detects this: it distorts the result again
    and compares it with the point.
    """
    u, v = x, y
    for _ in range(NEWTON_STEPS):
        at = distort(coefficients, u, v)
        off_x, off_y, scale = at.x - x, at.y - y, 1 / at.jacobian
        u = u - (at.yy * off_x - at.xy * off_y) * scale
        v = v - (at.xx * off_y - at.xy * off_x) * scale
    return u, v


# ---- From rays to pixels, and back ---------------------------------------------------------------------------------


def appears(model: CameraModel, x: Any, y: Any, image: Distorted) -> Any:
    """Whether the lens shows the ray (x, y, 1), whose distorted image is given. The lens shows rays within the fold."""
    return (x * x + y * y < model.fold_radius2) & (image.jacobian > 0)


def to_pixel(model: CameraModel, x: Any, y: Any) -> tuple[Any, Any]:
    """Pixel coordinates (u, v) of a point (x, y) of the image plane. If the lens distorts, give the distorted point."""
    return x * model.fx + model.cx, y * model.fy + model.cy


def from_pixel(model: CameraModel, u: Any, v: Any) -> tuple[Any, Any]:
    """The point (x, y) of the image plane at pixel coordinates (u, v). If the lens distorts, the point is distorted."""
    return (u - model.cx) / model.fx, (v - model.cy) / model.fy


def project(model: CameraModel, x: Any, y: Any) -> tuple[Any, Any, Any]:
    """Pixel coordinates (u, v) of the ray (x, y, 1) through a lens that distorts, and whether the lens shows it.

    Without distortion, `to_pixel` gives the same in less time.
    """
    image = distort(model.coefficients, x, y)
    u, v = to_pixel(model, image.x, image.y)
    return u, v, appears(model, x, y, image)


def unproject(model: CameraModel, u: Any, v: Any, tolerance_px: float) -> tuple[Any, Any, Any]:
    """The ray (x, y, 1) that a lens with distortion shows at pixel coordinates (u, v), and whether there is one.

    Without distortion, `from_pixel` gives the same in less time.

    tolerance_px : pixels by which the ray may miss (u, v) when it is projected again.
    """
    target_x, target_y = from_pixel(model, u, v)
    x, y = undistort(model.coefficients, target_x, target_y)
    image = distort(model.coefficients, x, y)
    off_x, off_y = (image.x - target_x) * model.fx, (image.y - target_y) * model.fy
    is_near = off_x * off_x + off_y * off_y <= tolerance_px * tolerance_px
    return x, y, is_near & appears(model, x, y, image)


# ---- Where the image folds ------------------------------------------------------------------------------------------

NEGLIGIBLE = 1e-100
"""Magnitude below which a coefficient counts as 0, because it bends no ray, and dividing by it would overflow double
precision."""


@lru_cache(maxsize=64)  # a fit calls this at every step
def fold_radius2(coefficients: tuple[float, ...]) -> float:
    """Squared radius on the image plane at which the radial polynomial turns round: it stops growing and falls.

    It is the first positive root in r^2 of d/dr r (1 + k1 r^2 + k2 r^4 + k3 r^6) = 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6,
    and infinity if there is none. The image ends there: a farther point would appear at the same place as a nearer one.
    """
    k1, k2, _, _, k3 = coefficients
    slope = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])
    roots = np.roots(np.where(np.abs(slope) < NEGLIGIBLE, 0.0, slope))
    folds = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(folds.min(initial=np.inf))
