# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera with distortion, which is also the model of projectors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from rangesim.rig import camera_model
from rangesim.rig.camera_model import CameraModel, fold_radius2
from rangesim.rig.cameras import Camera, PixelRays, rays_by
from rangesim.rig.poses import Array
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields, check_number, whole
from rangesim.settings.config import shown

RESIDUAL_PX = 1e-3
"""Pixels by which a ray may miss its pixel when it is projected again; if it misses by more, the pixel has no ray.
After Newton's method the miss is far below this value where the lens model has an inverse, and far above it
elsewhere."""
FocalLength = Annotated[float, Bounds("positive and finite", 1e-3, 1e9)]
"""A focal length in pixels; the bounds only exclude nonsense."""
PrincipalPoint = Annotated[float, Bounds("a pixel coordinate", -1e9, 1e9)]
"""A coordinate of the principal point in pixels; it may lie outside the image, so the bounds only exclude nonsense."""
Coefficient = Annotated[float, Bounds("a coefficient", -1e6, 1e6)]
"""A coefficient of distortion, dimensionless; the bounds only exclude nonsense."""


@dataclass(frozen=True)
class Intrinsics(Camera, untagged=True):
    """Intrinsics of a camera or projector: a pinhole with Brown-Conrady distortion, the model of OpenCV.

    Pixel coordinates (x, y) begin at the upper left corner of the image. Pixel centres lie at integer + 0.5 (OpenCV has
    them at integers), so the middle of the image is (width / 2, height / 2).

    Parameters
    ----------
    width, height : int, size of the image, pixels.
    fx, fy : float, focal lengths, pixels.
    cx, cy : float, principal point, pixels.
    distortion : tuple of 0 to 5 floats, the coefficients k1, k2, p1, p2, k3 in OpenCV's order; missing ones are 0.

    Raises
    ------
    ValueError
        A value out of its bounds, more than five coefficients, or more pixels than `rangesim.settings.limits` allows.

    Examples
    --------
    >>> camera = Intrinsics(640, 480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> camera.project([0.1, 0.0, 1.0])
    array([370., 240.])
    >>> camera.directions([370.0, 240.0])
    array([0.1, 0. , 1. ])
    """

    width: Annotated[int, whole(1)]
    height: Annotated[int, whole(1)]
    fx: FocalLength
    fy: FocalLength
    cx: PrincipalPoint
    cy: PrincipalPoint
    distortion: tuple[Coefficient, ...] = ()

    is_pinhole: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_fields(self)
        limits.check("pixels", self.width * self.height, f"pixels, not {shown(self.width)} x {shown(self.height)}")
        if len(self.distortion) > 5:
            raise ValueError(f"expected at most 5 distortion coefficients, got {shown(self.distortion)}.")

    @classmethod
    def from_fov(cls, width: int, height: int, fov_x_deg: float) -> Intrinsics:
        """Intrinsics with square pixels, the principal point in the middle, and no distortion.

        fov_x_deg : horizontal field of view, degrees.

        Examples
        --------
        >>> round(Intrinsics.from_fov(640, 480, fov_x_deg=90.0).fx, 6)
        320.0
        """
        check_number("fov_x_deg", fov_x_deg, Bounds("degrees between 0 and 180", 1e-6, 180 - 1e-6))
        for name, value in (("width", width), ("height", height)):
            check_number(name, value, whole(1))
        f = 0.5 * width / np.tan(np.radians(fov_x_deg) / 2)
        return cls(width, height, float(f), float(f), width / 2, height / 2)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Intrinsics of the same lens with another number of pixels.

        The horizontal field of view and the shape of the pixels stay the same.
        """
        for name, value in (("width", width), ("height", height)):
            check_number(name, value, whole(1, "pixels"))
        scale = width / self.width
        cx, cy = (self.cx - self.width / 2) * scale + width / 2, (self.cy - self.height / 2) * scale + height / 2
        return Intrinsics(width, height, self.fx * scale, self.fy * scale, cx, cy, self.distortion)

    def cropped(self, top: int, bottom: int, left: int, right: int) -> Intrinsics:
        return replace(self, width=right - left, height=bottom - top, cx=self.cx - left, cy=self.cy - top)

    def normalise(self, pixels: ArrayLike) -> Array:
        """(..., 2) float64, undistorted coordinates x/z, y/z on the image plane of pixel coordinates (..., 2).

        NaN where the distortion has no inverse, that is beyond the radius at which its polynomial stops growing.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        u, v = pixels[..., 0], pixels[..., 1]
        if not any(self.distortion):
            return np.stack(camera_model.from_pixel(self.model, u, v), axis=-1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y, exists = camera_model.unproject(self.model, u, v, RESIDUAL_PX)
        result = np.stack([x, y], axis=-1)
        result[~exists] = np.nan
        return result

    def project(self, points: ArrayLike) -> Array:
        """(..., 2) float64, pixel coordinates of points (..., 3) in coordinates of this device, metres.

        NaN behind the device, and beyond the radius at which the polynomial of the distortion stops growing.
        """
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        x, y = points[..., 0] / z, points[..., 1] / z
        if not any(self.distortion):
            return np.stack(camera_model.to_pixel(self.model, x, y), axis=-1)
        u, v, appears = camera_model.project(self.model, x, y)
        result = np.stack([u, v], axis=-1)
        result[~appears] = np.nan
        return result

    def directions(self, pixels: ArrayLike) -> Array:
        """(..., 3) float64, directions of the rays through pixel coordinates (..., 2), scaled to z = 1.

        NaN where `normalise` has NaN.
        """
        xy = self.normalise(pixels)
        result = np.ones((*xy.shape[:-1], 3))
        result[..., :2] = xy
        return result

    def pixel_rays(self) -> PixelRays:
        """Rays through the pixel centres; NaN where `normalise` has NaN."""
        return rays_by(lambda pixels: _unit(self.directions(pixels)), self)

    def angle_of(self, pixels: float) -> float:
        """Angle of that many pixels in a row, radians, on the axis."""
        return pixels / self.fx

    def solid_angle_sr(self) -> float:
        """Solid angle of a pixel on the axis, steradians. `Lens.vignetting` says how the light falls off beside it."""
        return 1 / (self.fx * self.fy)

    def etendue_m2sr(self, aperture_radius_m: float) -> float:
        return float(np.pi * aperture_radius_m**2 / (self.fx * self.fy))

    def rays_beside(self, at: Any) -> Callable[[ArrayLike], tuple[Array, Array]]:
        centres = self.pixel_centres()[at]

        def through(offset: ArrayLike) -> tuple[Array, Array]:
            directions = self.directions(centres + np.asarray(offset, dtype=np.float64))
            return np.zeros(directions.shape), directions

        return through

    def z_of(self, range_m: np.ndarray, rows: slice = slice(None)) -> Array:
        directions = self.directions(self.pixel_centres(rows))
        return np.asarray(range_m / np.linalg.norm(directions, axis=-1))

    @property
    def coefficients(self) -> tuple[float, float, float, float, float]:
        """All five coefficients k1, k2, p1, p2, k3; missing ones are 0."""
        return (*self.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]  # type: ignore[return-value]

    @property
    def fold_radius2(self) -> float:
        """Squared radius on the image plane at which the distortion folds the image; infinity if it does not."""
        return fold_radius2(self.coefficients)

    @property
    def model(self) -> CameraModel:
        """The parameters as `rangesim.rig.camera_model` and kernels take them."""
        fx, fy, cx, cy, *coefficients = map(float, (self.fx, self.fy, self.cx, self.cy, *self.coefficients))
        return CameraModel(fx, fy, cx, cy, tuple(coefficients), self.fold_radius2)


def _unit(vectors: Array) -> Array:
    """The vectors (..., 3) at unit length."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
