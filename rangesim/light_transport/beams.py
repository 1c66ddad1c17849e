# SPDX-License-Identifier: Apache-2.0
"""The emitter of a scanner as kernels see it: while a pixel measures, one beam lights one spot.

With a, b the tangents of the angles between a ray of the beam and its axis, along x and y, the radiant power per da db
is P p(a, b), where p is the profile with the integral 1. The radiant intensity is P p(a, b) / cos^3 of the angle to the
axis.

Almost no vertex of a camera path lies in the spot by chance, so light paths are found in three ways (see
`rangesim.light_transport.strategies`):

1. The first vertex lies in the spot of its own beam. It is connected straight to the emitter.
2. If the camera path came to its first vertex by delta interactions, the beam came the same way. Its irradiance follows
   from how the way spreads a pencil of rays (`Pencil`; Igehy, Tracing ray differentials, SIGGRAPH 1999).
   If it comes back to the emitter itself, as from a mirror, this is glint.
3. Every vertex is connected to a point of the spot (`Spot`), which a ray of the beam finds, by delta interactions if
   these are on its way (one light vertex of bidirectional path tracing: Veach 1997, chapter 10).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import Connection, Device, lit_from
from rangesim.light_transport.cutouts import Cutouts
from rangesim.light_transport.ray_tables import GAUSSIAN_FULL_WIDTH, VectorTable
from rangesim.light_transport.scattering import Media, Medium
from rangesim.rig import Beam, Rig

State = TypeVar("State", "Spot", "Pencil")
GAUSSIAN_REACH = 1.5
"""Angle to the axis, in full widths of a Gaussian beam at 1/e^2, beyond which there is no light: the intensity there is
exp(-18) of that on the axis. With a larger reach, more shadow rays are traced for no light."""
MIN_SPREAD_M2 = 1e-10
"""Smallest area, in m2 per steradian of the beam, over which a pencil of rays spreads: that of a point at 0.01 mm from
the emitter. At the focus of a curved mirror the area would be 0 and the irradiance infinite."""


def emitter_device(rig: Rig) -> Device | BeamDevice:
    """The rig's emitter as kernels see it."""
    return BeamDevice(rig, rig.projector) if isinstance(rig.projector, Beam) else Device.projector(rig)


class BeamAxis(NamedTuple):
    """The beams of some lanes.

    origin : Point3f, world, metres, the emitter.
    direction, right, down : Vector3f, world, unit, the axis of the beam, and its x and y axes.
    """

    origin: mi.Point3f
    direction: mi.Vector3f
    right: mi.Vector3f
    down: mi.Vector3f

    def tangents_of(self, direction: mi.Vector3f) -> tuple[mi.Point2f, mi.Float]:
        """Tangents of the angles of a direction to the axis, along x and y, and the cosine of its whole angle."""
        cosine = dr.dot(direction, self.direction)
        return mi.Point2f(dr.dot(direction, self.right), dr.dot(direction, self.down)) / cosine, cosine


def selected(where: mi.Bool, one: State, other: State) -> State:
    """A structure with the fields of `one` on the lanes of the mask `where`, and those of the other elsewhere."""
    names = (f.name for f in fields(one))
    return type(one)(*(dr.select(where, getattr(one, name), getattr(other, name)) for name in names))


@dataclass
class Spot:
    """A ray of the beam that ends in the spot. Loops of Dr.Jit carry it, so it is not frozen.

    origin, direction : Point3f and Vector3f, the last segment of the ray; world, metres and unit.
    length : Float, metres, optical length from the emitter to `origin`.
    ior : Float, refractive index along the segment.
    weight : Float, fraction of the beam's power that is under way along the segment, in the mean over the samples; 0
        where the ray went astray.
    u, v : Float, place within the beam, see `BeamDevice.uv`.
    """

    origin: mi.Point3f
    direction: mi.Vector3f
    length: mi.Float
    ior: mi.Float
    weight: mi.Float
    u: mi.Float
    v: mi.Float

    @classmethod
    def none(cls, lanes: int) -> Spot:
        """No ray on any lane."""
        zero = [dr.zeros(mi.Float, lanes) for _ in range(5)]
        return cls(dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes), *zero)

    def replaced(self, where: mi.Bool, other: Spot) -> Spot:
        """The other spot on the lanes of the mask `where`."""
        return selected(where, other, self)


@dataclass
class Pencil:
    """Spread of the beam's rays around a camera ray, and the fraction of their light that is left.

    a_point, b_point : Vector3f, metres, derivatives of the place on the ray by the tangents a and b at the emitter.
    a_direction, b_direction : Vector3f, derivatives of its direction.
    fraction : Float, fraction of the light that the delta interactions so far sent this way.
    intensity : Float, the beam's power per da db along the ray, as a fraction of all its power.
    u, v : Float, place within the beam, see `BeamDevice.uv`.
    """

    a_point: mi.Vector3f
    b_point: mi.Vector3f
    a_direction: mi.Vector3f
    b_direction: mi.Vector3f
    fraction: mi.Float
    intensity: mi.Float
    u: mi.Float
    v: mi.Float

    @classmethod
    def none(cls, lanes: int) -> Pencil:
        """No light on any lane."""
        vectors, numbers = ([dr.zeros(kind, lanes) for _ in range(4)] for kind in (mi.Vector3f, mi.Float))
        return cls(*vectors, *numbers)

    def replaced(self, where: mi.Bool, other: Pencil) -> Pencil:
        """The other pencil on the lanes of the mask `where`."""
        return selected(where, other, self)

    def arrived(self, ray: mi.Vector3f, distance: mi.Float, normal: mi.Vector3f) -> Pencil:
        """The pencil where it meets a surface after a distance in metres, along the unit direction `ray`.

        normal : Vector3f, unit, the surface's.
        """
        points = []
        for point, direction in ((self.a_point, self.a_direction), (self.b_point, self.b_direction)):
            moved = point + direction * distance
            points.append(moved - ray * (dr.dot(moved, normal) / dr.dot(ray, normal)))
        return replace(self, a_point=points[0], b_point=points[1])

    def turned(self, ray: mi.Vector3f, si: mi.SurfaceInteraction3f, out: mi.Vector3f, eta: mi.Float) -> Pencil:
        """The pencil after a reflection or refraction at the surface `si` that it has met.

        ray, out : Vector3f, unit, directions before and after.
        eta : Float, refractive index after the surface over that before; 1 for a reflection, and for what does not
            bend light.
        """
        normal = mi.Vector3f(si.sh_frame.n)
        cosine_in, cosine_out = dr.dot(ray, normal), dr.dot(out, normal)
        goes_on = cosine_in * cosine_out > 0
        ratio = dr.select(goes_on, dr.rcp(eta), 1)
        along = ratio * cosine_in - cosine_out  # out = ratio * ray - along * normal
        slope = dr.select(goes_on, ratio - dr.square(ratio) * cosine_in / cosine_out, 2)
        directions = []
        for point, direction in ((self.a_point, self.a_direction), (self.b_point, self.b_direction)):
            turn = _normal_change(si, point)
            change = dr.dot(direction, normal) + dr.dot(ray, turn)
            directions.append(ratio * direction - along * turn - slope * change * normal)
        return replace(self, a_direction=directions[0], b_direction=directions[1])

    def connection(self, where: mi.Bool, ray: mi.Vector3f, length: mi.Float, other: Connection) -> Connection:
        """The connection by the way that the pencil came, on the lanes of the mask `where`; elsewhere the other one.

        Parameters
        ----------
        ray : Vector3f, unit, world, direction of the camera path's last segment.
        length : Float, metres, optical length of the camera path.
        """
        geometry = self.irradiance(ray)
        return Connection(
            dr.select(where, mi.Point2f(self.u, self.v), other.uv),
            dr.select(where, -ray, other.direction),
            dr.select(where, length, other.distance),
            dr.select(where, geometry, other.geometry),
            dr.select(where, geometry > 0, other.lit),
        )

    def irradiance(self, ray: mi.Vector3f) -> mi.Float:
        """Irradiance, in W/m2 per watt of the beam, on a surface that faces the ray where the pencil has arrived."""
        area = dr.abs(dr.dot(dr.cross(self.a_point, self.b_point), ray))
        return self.fraction * self.intensity / dr.maximum(area, MIN_SPREAD_M2)


def _normal_change(si: mi.SurfaceInteraction3f, step: mi.Vector3f) -> mi.Vector3f:
    """Change of the shading normal over a step along the surface, to first order."""
    uu, uv, vv = dr.dot(si.dp_du, si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.dot(si.dp_dv, si.dp_dv)
    su, sv = dr.dot(step, si.dp_du), dr.dot(step, si.dp_dv)
    determinant = uu * vv - dr.square(uv)
    inverse = dr.select(determinant > 0, dr.rcp(determinant), 0)
    return (si.dn_du * (vv * su - uv * sv) + si.dn_dv * (uu * sv - uv * su)) * inverse


class SeenEmitter(NamedTuple):
    """The emitter of a beam as a ray meets it.

    meets : Bool, whether the ray meets it at all.
    radiance : Float, 1/m2/sr, radiance per watt of the beam.
    distance : Float, metres, from the start of the ray.
    uv : Point2f, place within the beam, see `BeamDevice.uv`.
    """

    meets: mi.Bool
    radiance: mi.Float
    distance: mi.Float
    uv: mi.Point2f


class BeamDevice:
    """The beams of a rig as kernels see them, one for each pixel of the camera.

    Parameters
    ----------
    rig : Rig. beam : Beam, its emitter.
    """

    has_lens = False

    def __init__(self, rig: Rig, beam: Beam) -> None:
        rays, T = rig.camera.rays, rig.T_world_camera
        exists = np.isfinite(rays.directions).all(axis=-1, keepdims=True)
        axes, right, down, offsets = beam.frames(
            rays._replace(directions=np.where(exists, rays.directions, [0.0, 0.0, 1.0]))
        )
        rotation = T[:3, :3]
        self.origins = VectorTable((rays.origins + offsets) @ rotation.T + T[:3, 3])
        self.axes, self.right, self.down = (VectorTable(v @ rotation.T) for v in (axes, right, down))
        self.width = mi.Vector2f(*(dr.opaque(mi.Float, float(w)) for w in beam.divergence_rad))
        self.is_gaussian = beam.profile == "gaussian"
        self.aperture = dr.opaque(mi.Float, rig.projector_lens.aperture_radius_m)

    def at(self, pixel: mi.UInt32) -> BeamAxis:
        """The beams of these pixels."""
        origin = mi.Point3f(self.origins.at(pixel))
        return BeamAxis(origin, self.axes.at(pixel), self.right.at(pixel), self.down.at(pixel))

    def profile(self, place: mi.Point2f) -> mi.Float:
        """Power per da db, as a fraction of the beam's power, at the tangents (a, b) of the angles to the axis."""
        x, y = place.x / self.width.x, place.y / self.width.y
        area = self.width.x * self.width.y
        if self.is_gaussian:
            distance2 = dr.square(x) + dr.square(y)
            density = (8 / np.pi) * dr.exp(-8 * distance2)
            return dr.select(distance2 < GAUSSIAN_REACH**2, density, 0) / area
        return dr.select((dr.abs(x) <= 0.5) & (dr.abs(y) <= 0.5), 1, 0) / area

    def uv(self, place: mi.Point2f) -> mi.Point2f:
        """Place within the beam, where the interval 0..1 of each coordinate is the full width."""
        return mi.Point2f(place.x / self.width.x + 0.5, place.y / self.width.y + 0.5)

    def connect(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
        pixel: mi.UInt32,
        media: Media | None = None,
        inside: Medium | None = None,
        cutouts: Cutouts | None = None,
    ) -> Connection:
        """Straight connection of the point `si` to the emitter of the beam of its pixel, see `Device.connect`.

        The irradiance is given per watt of the beam. Holes count as delta interactions, so no connection goes through
        `cutouts`.
        """
        beam = self.at(pixel)
        to_emitter = mi.Vector3f(beam.origin) - mi.Vector3f(si.p)
        distance = dr.norm(to_emitter)
        to_emitter /= distance
        place, cosine = beam.tangents_of(-to_emitter)
        profile = self.profile(place)
        geometry = profile / (cosine * dr.square(cosine) * dr.square(distance))
        in_beam = active & (cosine > 0) & (profile > 0)
        lit, geometry = lit_from(scene, si, beam.origin, geometry, in_beam, media, inside)
        return Connection(self.uv(place), to_emitter, distance, geometry, lit)

    def glint(self, ray: mi.Ray3f, pixel: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> SeenEmitter:
        """The emitter of the pixel's own beam as a ray meets it, before the surface `si`.

        The emitter is a disc across the axis, as large as its aperture, which looks evenly bright from each direction.
        """
        beam = self.at(pixel)
        slope = -dr.dot(ray.d, beam.direction)
        distance = dr.dot(mi.Vector3f(ray.o) - mi.Vector3f(beam.origin), beam.direction) / slope
        off = dr.norm(mi.Vector3f(ray(distance)) - mi.Vector3f(beam.origin))
        place, cosine = beam.tangents_of(-ray.d)
        intensity = self.profile(place) / (cosine * dr.square(cosine))
        meets = active & (slope > 0) & (distance > 0) & (distance < si.t) & (off < self.aperture) & (intensity > 0)
        return SeenEmitter(meets, intensity / (np.pi * dr.square(self.aperture) * slope), distance, self.uv(place))

    def pencil(self, pixel: mi.UInt32, direction: mi.Vector3f) -> Pencil:
        """The pencil of the beam around rays that leave the emitter in these directions."""
        beam = self.at(pixel)
        place, cosine = beam.tangents_of(direction)
        uv, n = self.uv(place), dr.width(direction)
        # d/da of the unit vector (axis + a right + b down) cos
        across = [cosine * (axis - direction * dr.dot(axis, direction)) for axis in (beam.right, beam.down)]
        intensity = dr.select(cosine > 0, self.profile(place), 0)
        return replace(
            Pencil.none(n),
            a_direction=across[0],
            b_direction=across[1],
            fraction=dr.ones(mi.Float, n),
            intensity=intensity,
            u=uv.x,
            v=uv.y,
        )

    def sampled(self, pixel: mi.UInt32, xi: mi.Point2f) -> Spot:
        """A ray of the beam on its way, which carries all the power in the mean; `xi` is uniform in the unit square."""
        beam = self.at(pixel)
        if self.is_gaussian:
            disc = mi.warp.square_to_std_normal(xi)
            # Beyond the reach there is no light: a fraction of 2e-8 of the rays
            place = mi.Point2f(disc.x, disc.y) * self.width / GAUSSIAN_FULL_WIDTH
        else:
            place = (xi - 0.5) * mi.Point2f(self.width)
        direction = dr.normalize(beam.direction + beam.right * place.x + beam.down * place.y)
        uv, n = self.uv(place), dr.width(pixel)
        one = dr.ones(mi.Float, n)
        return Spot(mi.Point3f(beam.origin), direction, dr.zeros(mi.Float, n), one, mi.Float(one), uv.x, uv.y)
