# SPDX-License-Identifier: Apache-2.0
"""Camera and projector on the renderer's side, and the straight connection of a surface point to the projector."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.rig import Intrinsics


class PrimaryRay(NamedTuple):
    """A ray that leaves a device.

    origin, direction : world, metres and unit.
    lead : Float, metres, what the path length from the device's centre has ahead of that from `origin`: all paths
        through a lens to a point in focus are optically as long as the one through its centre.
    """

    origin: Any
    direction: Any
    lead: Any


class Device:
    """A pinhole of the rig on the renderer's side: intrinsics, centre, axes; all opaque to the kernel cache."""

    def __init__(self, intrinsics: Intrinsics, T_world_device: np.ndarray) -> None:
        opaque = lambda x: dr.opaque(mi.Float, float(x))  # noqa: E731
        self.f = mi.Vector2f(opaque(intrinsics.fx), opaque(intrinsics.fy))
        self.c = mi.Vector2f(opaque(intrinsics.cx), opaque(intrinsics.cy))
        self.size = mi.Vector2f(opaque(intrinsics.width), opaque(intrinsics.height))
        self.x, self.y, self.z, self.centre = (
            mi.Vector3f(*map(opaque, T_world_device[:3, column])) for column in range(4)
        )

    def ray_direction(self, pixel: Any) -> Any:
        """Unit world direction through pixel coordinates."""
        p = (pixel - self.c) / self.f
        return dr.normalize(self.x * p.x + self.y * p.y + self.z)

    has_lens = False
    """Whether rays start on a lens of finite size, and `sample_ray` needs a sample; shapes the kernel."""

    def sample_ray(self, pixel: Any, lens: Any) -> PrimaryRay:
        """The ray through pixel coordinates; `lens` Point2f in the unit square, None where `has_lens` is not set."""
        return PrimaryRay(mi.Point3f(self.centre), self.ray_direction(pixel), mi.Float(0))

    def project(self, point: Any) -> tuple[Any, Any]:
        """Pixel coordinates of a world point, and its depth z in metres."""
        d = mi.Vector3f(point) - self.centre
        z = dr.dot(d, self.z)
        return mi.Point2f(dr.dot(d, self.x), dr.dot(d, self.y)) / z * self.f + self.c, z


class Connection(NamedTuple):
    """The straight segment from a surface point to the projector.

    uv : Point2f, projector pixel coordinates.
    direction : Vector3f, unit, world, towards the projector.
    distance : Float, metres.
    geometry : Float, times the irradiance at z = 1 m: the irradiance on a surface that faces the projector.
    lit : Bool, inside the projector's image and unobstructed.
    blur_px : Float, see `rangesim.response.LightPath`; None: sharp.
    """

    uv: Any
    direction: Any
    distance: Any
    geometry: Any
    lit: Any
    blur_px: Any = None


def connect(scene: Any, projector: Device, si: Any, active: Any) -> Connection:
    """Straight connection of the surface point `si` to the projector.

    The pattern is uniform per projector pixel, so the radiant intensity is E / cos^3 and falls as
    cos^2 / z^2, which leaves E / (z^2 cos).
    """
    uv, z = projector.project(si.p)
    to_projector = projector.centre - mi.Vector3f(si.p)
    distance = dr.norm(to_projector)
    to_projector /= distance
    inside = (uv.x >= 0) & (uv.x < projector.size.x) & (uv.y >= 0) & (uv.y < projector.size.y) & (z > 0)
    geometry = dr.rcp(dr.square(z) * -dr.dot(projector.z, to_projector))
    inside &= active
    shadow_ray = si.spawn_ray_to(mi.Point3f(projector.centre))
    lit = inside & ~scene.ray_test(shadow_ray, coherent=False, active=inside)
    return Connection(uv, to_projector, distance, geometry, lit)
