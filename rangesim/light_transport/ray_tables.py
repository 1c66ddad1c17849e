# SPDX-License-Identifier: Apache-2.0
"""Cameras that are no pinhole, as kernels see them: a table with the ray of each pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import Device, PrimaryRay
from rangesim.light_transport.sampling import aligned
from rangesim.rig import Intrinsics, Rig

GAUSSIAN_FULL_WIDTH = 4.0
"""Ratio of the 1/e^2 width of a Gaussian to its standard deviation."""
MAX_PLACE = 1 - 1e-6
"""Largest place within a pixel, as a fraction of the pixel, that becomes an angle of a Gaussian field: 5 standard
deviations. At 1 the angle would be infinite."""


def camera_device(rig: Rig) -> Device | RayTableDevice:
    """The rig's camera as kernels see it, without its vignetting, which the exposure applies."""
    return Device.camera(rig) if isinstance(rig.camera, Intrinsics) else RayTableDevice(rig)


class VectorTable:
    """A vector for each pixel, on the device that runs the kernels.

    Parameters
    ----------
    vectors : (..., 3) float, as many as there are pixels.
    """

    def __init__(self, vectors: np.ndarray) -> None:
        columns = np.moveaxis(np.asarray(vectors, dtype=np.float64).reshape(-1, 3), -1, 0)
        self.components = [mi.Float(aligned(np.ascontiguousarray(column), np.float32)) for column in columns]

    def at(self, pixel: mi.UInt32) -> mi.Vector3f:
        """The vectors of these pixels."""
        return mi.Vector3f(*(dr.gather(mi.Float, column, pixel) for column in self.components))


class RayTableDevice:
    """A camera with any rays as kernels see it.

    It has the attributes and methods of `rangesim.light_transport.camera_rays.Device` that kernels need of a camera. A
    ray within a pixel is linear in its place there.

    Parameters
    ----------
    rig : Rig, whose camera is no pinhole.
    """

    has_lens = False

    def __init__(self, rig: Rig) -> None:
        camera, T = rig.camera, rig.T_world_camera
        rays, opaque = camera.rays, lambda x: dr.opaque(mi.Float, float(x))
        self.size = mi.Vector2f(opaque(camera.width), opaque(camera.height))
        self.z, self.centre = (mi.Vector3f(*map(opaque, T[:3, column])) for column in (2, 3))
        exists = np.asarray(np.isfinite(rays.directions).all(axis=-1) & np.isfinite(rays.steps).all(axis=(-2, -1)))
        directions = np.where(exists[..., None], rays.directions, [0.0, 0.0, 1.0]) @ T[:3, :3].T
        steps = np.where(exists[..., None, None], rays.steps, 0.0) @ T[:3, :3].T
        self.directions = VectorTable(directions)
        self.steps = [VectorTable(steps[..., axis, :]) for axis in (0, 1)]
        self._directions, self._origins = directions, rays.origins @ T[:3, :3].T + T[:3, 3]
        self._reach = np.linalg.norm(steps, axis=-1).max(axis=-1)  # radians, twice the half width of the field
        has_origins = bool(np.any(rays.origins)) or rays.origin_steps is not None
        self.origins = VectorTable(self._origins) if has_origins else None
        self.origin_steps: list[VectorTable] = []
        if rays.origin_steps is not None:
            turned = rays.origin_steps @ T[:3, :3].T
            self.origin_steps = [VectorTable(turned[..., axis, :]) for axis in (0, 1)]
        self.exists = None if exists.all() else mi.Bool(exists.ravel())
        self.is_gaussian = camera.acceptance == "gaussian"
        self.pixels = camera.width * camera.height

    def looks_at(self, point: np.ndarray) -> np.ndarray:
        """(pixels,) bool, whether a point (3,), metres, world, lies within the field of a pixel, or just beside it."""
        to_point = point - self._origins
        distance = np.linalg.norm(to_point, axis=-1)
        sine = np.linalg.norm(np.cross(to_point, self._directions), axis=-1) / np.where(distance > 0, distance, 1.0)
        ahead = np.sum(to_point * self._directions, axis=-1) > 0
        return np.asarray(ahead & (sine <= self._reach)).ravel()

    def centre_rays(self, begin: int, end: int) -> PrimaryRay:
        """Rays through the centres of the pixels `begin` to `end` - 1, row by row."""
        index = dr.arange(mi.UInt32, end - begin) + dr.opaque(mi.UInt32, begin)
        return self._rays(index, mi.Point2f(0))

    def ray_in(self, corner: mi.Point2f, place: mi.Point2f, lens: mi.Point2f | None = None) -> PrimaryRay:
        """The ray through a place within a pixel, see `Device.ray_in`."""
        index = mi.UInt32(corner.x) + mi.UInt32(corner.y) * mi.UInt32(self.size.x)
        across = place - 0.5
        if self.is_gaussian:
            across = mi.Point2f(_normal(place.x), _normal(place.y)) / GAUSSIAN_FULL_WIDTH
        return self._rays(index, across)

    def _rays(self, index: mi.UInt32, across: mi.Point2f) -> PrimaryRay:
        """Rays of these pixels; `across` is the place relative to the centre, in widths of the pixel."""
        direction = dr.normalize(
            self.directions.at(index) + self.steps[0].at(index) * across.x + self.steps[1].at(index) * across.y
        )
        origin = mi.Point3f(self.centre) if self.origins is None else mi.Point3f(self.origins.at(index))
        if self.origin_steps:
            origin += self.origin_steps[0].at(index) * across.x + self.origin_steps[1].at(index) * across.y
        exists = None if self.exists is None else dr.gather(mi.Bool, self.exists, index)
        return PrimaryRay(origin, direction, mi.Float(0), exists)


def _normal(fraction: mi.Float) -> mi.Float:
    """The quantile of the standard normal distribution at a fraction, 0..1."""
    return float(np.sqrt(2)) * dr.erfinv(dr.clip(2 * fraction - 1, -MAX_PLACE, MAX_PLACE))
