# SPDX-License-Identifier: Apache-2.0
"""Cameras that are no pinhole: fisheye and telecentric lenses, and tables of rays."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from rangesim.rig.cameras import Acceptance, Camera, PixelRays, finite_array, rays_by, tangents, unit_directions
from rangesim.rig.intrinsics import FocalLength, PrincipalPoint
from rangesim.rig.poses import Array
from rangesim.rig.scan_patterns import ScanRays
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, Metres, check_fields, whole
from rangesim.settings.config import shown

FieldAngle = Annotated[float, Bounds("an angle in radians", 1e-9, np.pi)]
"""Full width of a pixel's field of view along one axis, radians; the lower bound only excludes zero."""
FISHEYE_STEPS = 20
"""Number of Newton steps that invert the polynomial of a fisheye lens. From the undistorted angle, ten reach double
precision for the lenses of OpenCV's examples; ten more are a reserve for other lenses."""
MAX_FISHEYE_MISS_RAD = 1e-6
"""Largest error, in radians, with which the angle found for a pixel may be distorted back onto it. Where it is larger,
the polynomial has no inverse, and the pixel has no ray. After Newton's method the error is far below it or above."""


def _check_size(width: int, height: int) -> None:
    limits.check("pixels", width * height, f"pixels, not {shown(width)} x {shown(height)}")


@dataclass(frozen=True)
class Fisheye(Camera):
    """A fisheye lens: the distance from the principal point grows with the angle to the axis, up to beyond 90 degrees.

    The model is that of OpenCV's module `fisheye` (Kannala and Brandt, IEEE TPAMI 28, 2006): a ray at the angle theta
    appears at the radius f (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9). Without coefficients it is the
    equidistant projection.

    Parameters
    ----------
    width, height : int, size of the image, pixels.
    fx, fy : float, focal lengths, pixels per radian on the axis.
    cx, cy : float, principal point, pixels.
    distortion : tuple of 0 to 4 floats, k1 to k4; missing ones are 0.
    max_angle_rad : float, radians, largest angle to the axis; pixels beyond it see nothing.

    Raises
    ------
    ValueError
        A value out of its bounds, more than four coefficients, or too many pixels.

    Examples
    --------
    >>> camera = Fisheye(180, 180, fx=90 / (np.pi / 2), fy=90 / (np.pi / 2), cx=90, cy=90)  # 180 degrees wide
    >>> camera.project([1.0, 0.0, 1.0])
    array([135.,  90.])
    """

    width: Annotated[int, whole(1)]
    height: Annotated[int, whole(1)]
    fx: FocalLength
    fy: FocalLength
    cx: PrincipalPoint
    cy: PrincipalPoint
    distortion: tuple[Annotated[float, Bounds("a coefficient", -1e6, 1e6)], ...] = ()
    max_angle_rad: FieldAngle = np.pi / 2

    type_name: ClassVar[str] = "fisheye"

    def __post_init__(self) -> None:
        check_fields(self)
        _check_size(self.width, self.height)
        if len(self.distortion) > 4:
            raise ValueError(f"expected at most 4 distortion coefficients, got {shown(self.distortion)}.")

    def pixel_rays(self) -> PixelRays:
        """Rays through the pixel centres; NaN for pixels that are not wholly within `max_angle_rad`, and where the
        polynomial has no inverse."""
        rays = rays_by(self._unit_rays, self)
        rays.directions[~np.isfinite(rays.steps).all(axis=(-2, -1))] = np.nan
        return rays

    @property
    def is_forward(self) -> bool:
        return self.max_angle_rad <= np.pi / 2 or super().is_forward  # the angle tells it without a million rays

    def project(self, points: ArrayLike) -> Array:
        """(..., 2) float64, pixel coordinates of points (..., 3) in coordinates of this camera, metres.

        NaN beyond `max_angle_rad`.
        """
        x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
        across = np.hypot(x, y)
        theta = np.where(np.arctan2(across, z) <= self.max_angle_rad, np.arctan2(across, z), np.nan)
        scale = self._radius(theta)[0] / np.where(across > 0, across, 1.0)
        return np.stack([self.fx * scale * x + self.cx, self.fy * scale * y + self.cy], axis=-1)

    def cropped(self, top: int, bottom: int, left: int, right: int) -> Fisheye:
        return replace(self, width=right - left, height=bottom - top, cx=self.cx - left, cy=self.cy - top)

    def _radius(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radius in units of the focal length at angles theta, and its derivative."""
        k = (*self.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
        t2 = theta**2
        radius = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        return radius, 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))

    def _unit_rays(self, pixels: Array) -> Array:
        x, y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        radius = np.hypot(x, y)
        theta = radius.copy()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(FISHEYE_STEPS if any(self.distortion) else 0):  # without distortion, the radius is the angle
                at, slope = self._radius(theta)
                theta = theta - (at - radius) / slope
            at, slope = self._radius(theta)
            exists = (np.abs(at - radius) < MAX_FISHEYE_MISS_RAD) & (slope > 0) & (theta <= self.max_angle_rad)
        theta = np.where(exists, theta, np.nan)
        scale = np.sin(theta) / np.where(radius > 0, radius, 1.0)
        return np.stack([scale * x, scale * y, np.cos(theta)], axis=-1)


@dataclass(frozen=True)
class Orthographic(Camera):
    """A telecentric lens: parallel rays along z, one for each square of the plane z = 0.

    Parameters
    ----------
    width, height : int, size of the image, pixels.
    pixel_pitch_m : float, metres, side of the square of the scene that a pixel sees.
    numerical_aperture : float, sine of the half angle of the light that a pixel takes in. It decides on the
        brightness; the image is sharp everywhere.

    Raises
    ------
    ValueError
        A value out of its bounds, or too many pixels.

    Examples
    --------
    >>> Orthographic(4, 2, pixel_pitch_m=0.01, numerical_aperture=0.02).pixel_rays().origins[0, 0]
    array([-0.015, -0.005,  0.   ])
    """

    width: Annotated[int, whole(1)]
    height: Annotated[int, whole(1)]
    pixel_pitch_m: Metres
    numerical_aperture: Annotated[float, Bounds("between 0 and 1", 1e-6, 1.0)] = 0.02

    type_name: ClassVar[str] = "orthographic"

    def __post_init__(self) -> None:
        check_fields(self)
        _check_size(self.width, self.height)

    def pixel_rays(self) -> PixelRays:
        """Parallel rays through the pixel centres."""
        shape, origins = (self.height, self.width), np.zeros((self.height, self.width, 3))
        origins[..., :2] = (self.pixel_centres() - [self.width / 2, self.height / 2]) * self.pixel_pitch_m
        along = self.pixel_pitch_m * np.eye(2, 3)
        directions = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (*shape, 3))
        return PixelRays(origins, directions, np.zeros((*shape, 2, 3)), np.broadcast_to(along, (*shape, 2, 3)))

    def project(self, points: ArrayLike) -> Array:
        """(..., 2) float64, pixel coordinates of points (..., 3) in coordinates of this camera, metres.

        NaN behind the plane z = 0.
        """
        points = np.asarray(points, dtype=np.float64)
        pixels = points[..., :2] / self.pixel_pitch_m + [self.width / 2, self.height / 2]
        return np.asarray(np.where(points[..., 2:] > 0, pixels, np.nan))

    def angle_of(self, pixels: float) -> float:
        """Angle at which that many pixels appear from 1 m away, radians: parallel rays have no angle of their own."""
        return pixels * self.pixel_pitch_m

    def solid_angle_sr(self) -> float:
        return float(np.pi * self.numerical_aperture**2)

    def etendue_m2sr(self, aperture_radius_m: float) -> float:
        """Area of the scene that a pixel sees times the solid angle of its light; the aperture plays no part."""
        return self.pixel_pitch_m**2 * self.solid_angle_sr()


class ScanningCamera(Camera):
    """A camera whose rays all have the same angular field: a table of rays, or a scanner of any pattern.

    Subclasses have the fields `field_rad` and `acceptance`, and say their `scan_rays`.

    field_rad : (along x, along y) float, radians, full widths of the field of a ray: of its box, or the 1/e^2 widths
        of its Gaussian.
    """

    field_rad: tuple[float, float]

    def __post_init__(self) -> None:
        check_fields(self)
        self.scan_rays()  # checks what belongs together

    @abstractmethod
    def scan_rays(self) -> ScanRays:
        """Directions, origins and times of the rays."""

    @property
    def times_s(self) -> Array | None:
        return self.scan_rays().times_s

    def cropped(self, top: int, bottom: int, left: int, right: int) -> RayTable:
        return RayTable.of(self, self.field_rad).cropped(top, bottom, left, right)

    def pixel_rays(self) -> PixelRays:
        """The rays of the table; their fields are upright: y of a field is downwards where the ray is level."""
        directions, origins, _ = self.scan_rays()
        steps = np.stack(tangents(directions), axis=-2) * np.asarray(self.field_rad)[:, None]
        return PixelRays(np.zeros(directions.shape) if origins is None else origins, directions, steps)


@dataclass(frozen=True, eq=False)
class RayTable(ScanningCamera):
    """A camera whose pixels have any rays, such as those of a calibrated scanner.

    Parameters
    ----------
    directions : (h, w, 3) float64, directions of the rays, camera coordinates; they are scaled to unit length.
    origins : (h, w, 3) float64, metres, camera coordinates, where the rays start; None: at the camera's origin.
    field_rad : (along x, along y) float, radians, full widths of the field of each ray.
    acceptance : "box" or "gaussian"; `field_rad` of a Gaussian are its widths at 1/e^2.
    times : (h, w) float64, seconds from the start of the image; None: all rays at once.
    has_neighbours : whether pixels beside each other see places beside each other.

    Raises
    ------
    ValueError
        Arrays of other shapes, directions of length 0, numbers that are not finite, or too many rays.

    Examples
    --------
    >>> table = RayTable(np.array([[[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]]]), field_rad=(1e-3, 1e-3))
    >>> table.height, table.width, table.pixel_rays().directions[0, 0]
    (1, 2, array([0., 0., 1.]))
    """

    directions: np.ndarray
    origins: np.ndarray | None = None
    field_rad: tuple[FieldAngle, FieldAngle] = (1e-3, 1e-3)
    acceptance: Acceptance = "box"
    times: np.ndarray | None = None
    has_neighbours: bool = True  # type: ignore[misc]

    type_name: ClassVar[str] = "ray-table"

    def __post_init__(self) -> None:
        check_fields(self)
        directions = unit_directions(self.directions)
        h, w = directions.shape[:2]
        _check_size(w, h)
        object.__setattr__(self, "directions", directions)
        for name, shape in (("origins", (h, w, 3)), ("times", (h, w))):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, finite_array(getattr(self, name), name, shape))

    @property
    def width(self) -> int:  # type: ignore[override]
        return int(self.directions.shape[1])

    @property
    def height(self) -> int:  # type: ignore[override]
        return int(self.directions.shape[0])

    def scan_rays(self) -> ScanRays:
        return ScanRays(self.directions, self.origins, self.times)

    def cropped(self, top: int, bottom: int, left: int, right: int) -> RayTable:
        return self._part((slice(top, bottom), slice(left, right)))

    def _part(self, at: Any) -> RayTable:
        """The rays at an index of the table."""
        origins, times = (None if a is None else a[at] for a in (self.origins, self.times))
        return replace(self, directions=self.directions[at], origins=origins, times=times)

    def thinned(self, width: int, height: int) -> RayTable:
        """A table of at most width x height of these rays, which are spread evenly over the table.

        Examples
        --------
        >>> from rangesim.rig import Intrinsics
        >>> RayTable.of(Intrinsics.from_fov(8, 6, fov_x_deg=60.0)).thinned(4, 2).directions.shape
        (2, 4, 3)
        """
        rows, columns = (
            np.linspace(0, n - 1, min(n, m)).round().astype(int)
            for n, m in ((self.height, height), (self.width, width))
        )
        return self._part(np.ix_(rows, columns))

    @classmethod
    def of(cls, camera: Camera, field_rad: tuple[float, float] | None = None) -> RayTable:
        """The table of the rays of another camera.

        field_rad : field of each ray, radians; None: the median field of the camera's pixels.

        Examples
        --------
        >>> from rangesim.rig import Intrinsics
        >>> RayTable.of(Intrinsics.from_fov(4, 3, fov_x_deg=60.0)).directions.shape
        (3, 4, 3)
        """
        rays = camera.rays
        if field_rad is None:
            x, y = np.nanmedian(np.linalg.norm(rays.steps, axis=-1), axis=(0, 1))
            field_rad = float(x), float(y)
        return cls(rays.directions, rays.origins, field_rad, camera.acceptance, camera.times_s, camera.has_neighbours)
