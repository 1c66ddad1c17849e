# SPDX-License-Identifier: Apache-2.0
"""Specular chains: light on its way through glass, off mirrors, through thin panes, coats and holes.

Delta interactions scatter nothing, so they do not count towards `max_depth`. They have a limit of their own, a number
of surfaces in a row. The light of caustics, camera paths and glint share the limit, and walk with the same `RayState`.

Mitsuba's `spawn_ray` starts rays a little off a surface, along its normal: about 0.1 mm at 1 m. So an oblique ray runs
beside its true line, at a distance of a twentieth of a projector pixel or more, and mirrors and glass pass the error
on. If a ray started on its true line, it would miss faces beside edges. So this module leaves the ray where it is, and
corrects the point where it ends (`corrected_point`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from rangesim.light_transport.absorption import ENDLESS_M
from rangesim.light_transport.scattering import Medium
from rangesim.light_transport.traced_scene import TracedScene

MAX_CHAIN = 128
"""Number of delta interactions in a row after which light is cut off, so that time is bounded. A pane has two faces, a
hollow glass four. Of the light that enters a cut diamond of n = 2.4, 0.2 % is cut off (with a limit of 16, it was 5.8
%)."""
ROULETTE_AFTER = 8
"""Number of delta interactions in a row after which Russian roulette may end the light, so that light through a few
panes or two hollow glasses gets no noise from it. With a larger number, scenes with metals take more time."""
CLEARANCE = 0.1
"""Distance at which rays start from a delta surface, as a fraction of Mitsuba's own: 0.009 mm at 1 m. Glass thinner
than this distance loses its far face; a smaller fraction comes near the rounding of single precision."""
MIN_COSINE = 0.05
"""Smallest cosine of the angle between ray and normal at which a point is corrected, because at a flatter angle the
corrected point may be far off. With a larger value, more points would keep Mitsuba's rounding."""


@dataclass
class RayState:
    """Start, optical length and surroundings of a ray of light. Loops of Dr.Jit carry it, so it is not frozen.

    previous : Point3f, world, metres, the point that the ray left.
    length : Float, metres, optical length up to there.
    ior : Float, refractive index along the ray; None if no surface of the scene changes it.
    inside : Medium, along the ray, that scatters; None in scenes without such media.
    sigma_a : Float, 1/m, absorption coefficient along the ray; None in scenes without absorbing bodies.
    """

    previous: mi.Point3f
    length: mi.Float
    ior: mi.Float | None
    inside: Medium | None = None
    sigma_a: mi.Float = None

    @classmethod
    def start(cls, traced: TracedScene, lanes: int, refracts: bool = True) -> RayState:
        """The state of light in air whose optical length is 0."""
        return cls(
            dr.zeros(mi.Point3f, lanes),
            dr.zeros(mi.Float, lanes),
            dr.ones(mi.Float, lanes) if refracts else None,
            None if traced.media is None else traced.media.none(lanes),
            None if traced.absorbers is None else dr.zeros(mi.Float, lanes),
        )

    def restarted(self, where: mi.Bool, origin: mi.Point3f, length: mi.Float) -> RayState:
        """The state after the ray starts anew at `origin`, on the lanes of the mask `where`; surroundings are kept."""
        return replace(
            self, previous=dr.select(where, origin, self.previous), length=dr.select(where, length, self.length)
        )

    def length_to(self, point: mi.Point3f, hit: mi.Bool) -> mi.Float:
        """Optical length up to the point that the ray meets, in metres; on lanes without a `hit`, up to the start of
        the ray.

        `si.t` would be wrong, because rays start off the surface.
        """
        return dr.select(hit, self.further(dr.norm(point - self.previous), self.length), self.length)

    def further(self, distance: mi.Float, length: mi.Float) -> mi.Float:
        """Optical length at a distance along the ray, in metres, if it is `length` at the start of the ray."""
        return length + distance if self.ior is None else dr.fma(self.ior, distance, length)

    def power(self, throughput: mi.Float) -> mi.Float:
        """Fraction of a path's light that is left: radiance over the square of the refractive index."""
        return throughput if self.ior is None else throughput * dr.square(self.ior)

    def unabsorbed(self, traced: TracedScene, point: mi.Point3f, hit: mi.Bool) -> mi.Float:
        """Fraction of the light that absorption leaves on the way to the point; without a `hit` the ray is endless."""
        assert traced.absorbers is not None
        distance = dr.select(hit, dr.norm(point - self.previous), ENDLESS_M)
        return traced.absorbers.transmittance(self.sigma_a, distance, self.inside)

    def refracted(self, bs: mi.BSDFSample3f, where: mi.Bool) -> RayState:
        """The state with the refractive index beyond the surface at which `bs` was sampled."""
        if self.ior is None:
            return self
        is_transmitted = where & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission)
        return replace(self, ior=dr.select(is_transmitted, self.ior * bs.eta, self.ior))

    def entering(
        self,
        traced: TracedScene,
        si: mi.SurfaceInteraction3f,
        direction: mi.Vector3f,
        where: mi.Bool,
        crosses: mi.Bool,
    ) -> RayState:
        """The state with the media along a ray that leaves the surface `si` in a direction.

        Parameters
        ----------
        where : Bool, whether the ray leaves a surface at all.
        crosses : Bool, whether the surface is the boundary of a medium that scatters.
        """
        inside, sigma_a = self.inside, self.sigma_a
        if inside is not None and traced.media is not None:
            inside = inside.replaced(crosses, traced.media.beyond(si, direction, crosses))
        if sigma_a is not None and traced.absorbers is not None:
            sigma_a = traced.absorbers.beyond(si, direction, sigma_a, where)
        return replace(self, inside=inside, sigma_a=sigma_a)

    def reset(self, traced: TracedScene, where: mi.Bool) -> RayState:
        """The state of light in air whose optical length is 0, on the lanes of the mask `where`, whose paths end."""
        inside = self.inside
        if inside is not None and traced.media is not None:
            inside = inside.replaced(where, traced.media.none(dr.width(where)))
        sigma_a = None if self.sigma_a is None else dr.select(where, 0, self.sigma_a)
        ior = None if self.ior is None else dr.select(where, 1, self.ior)
        return RayState(self.previous, dr.select(where, 0, self.length), ior, inside, sigma_a)


def survival(chain: mi.UInt32, fraction: mi.Float) -> mi.Float:
    """Probability with which light goes on after `chain` delta interactions that left `fraction` of it.

    Callers divide the light that goes on by this probability. Lossless glass keeps all light, so its paths go on to
    the limit. Light that metals absorb ends in time.
    """
    return dr.select(chain > ROULETTE_AFTER, dr.minimum(fraction, 1), 1)


def corrected_point(si: mi.SurfaceInteraction3f, origin: mi.Point3f, direction: mi.Vector3f) -> mi.Point3f:
    """The point where the true line of a ray, from `origin`, meets the tangent plane of the surface `si` that the ray
    met."""
    slope = dr.dot(direction, si.n)
    along = dr.dot(si.p - origin, si.n) / slope
    return dr.select(dr.abs(slope) > MIN_COSINE, mi.Point3f(origin + direction * along), si.p)


def spawn_specular_ray(si: mi.SurfaceInteraction3f, met: mi.Point3f, direction: mi.Vector3f) -> mi.Ray3f:
    """The ray that leaves a delta surface in a direction; it starts closer to the surface than Mitsuba's.

    `met` is the point where the previous ray met the surface. It is not corrected, so that it lies on the safe side of
    edges.
    """
    ray = si.spawn_ray(direction)
    ray.o = met + CLEARANCE * (ray.o - si.p)
    return ray
