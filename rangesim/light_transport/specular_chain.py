# SPDX-License-Identifier: Apache-2.0
"""Specular chains: light on its way through glass, off mirrors, through thin panes, coats and holes.

Delta interactions scatter nothing, so they do not count towards `max_depth`; they have a limit of their own, of
surfaces in a row. Photons, camera paths and glint share it, and walk with the same `RayState`.

Mitsuba's `spawn_ray` starts rays a little off a surface, along its normal: about 0.1 mm at 1 m. So an oblique ray runs
beside its true line, by a twentieth of a projector pixel or more, and mirrors and glass pass the error on. Starting
the ray on its line instead would have it miss faces beside edges. So the ray is left where it is, and the point where
it ends is corrected (`corrected_point`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from rangesim.light_transport.absorption import ENDLESS
from rangesim.light_transport.traced_scene import TracedScene

MAX_CHAIN = 128
"""Delta interactions in a row, after which light is cut off. A pane has two faces, a hollow glass four."""
ROULETTE_AFTER = 8
"""Delta interactions in a row, after which Russian roulette may end the light."""
CLEARANCE = 0.1
"""Fraction of Mitsuba's own offset with which rays leave a delta surface, so that thin glass keeps its far face."""
MIN_COSINE = 0.05
"""At more grazing incidence the correction of a point would be worse than the error."""


@dataclass
class RayState:
    """What light carries along its ray. Not frozen, so that it can be the state of a loop of Dr.Jit.

    previous : Point3f, the vertex that the ray left. length : Float, metres, optical length up to there.
    ior : Float, refractive index along the ray.
    inside : Medium that scatters along the ray; None in scenes without any.
    sigma_a : Float, 1/m, absorption coefficient along the ray; None in scenes without absorbing bodies.
    """

    previous: Any
    length: Any
    ior: Any
    inside: Any = None
    sigma_a: Any = None

    @classmethod
    def start(cls, traced: TracedScene, lanes: int) -> RayState:
        """Light in air that has gone no way yet."""
        return cls(
            dr.zeros(mi.Point3f, lanes),
            dr.zeros(mi.Float, lanes),
            dr.ones(mi.Float, lanes),
            None if traced.media is None else traced.media.none(lanes),
            None if traced.absorbers is None else dr.zeros(mi.Float, lanes),
        )

    def restarted(self, where: Any, origin: Any, length: Any) -> RayState:
        """With a new start of the ray `where` it says so; what lies around it is kept."""
        return replace(
            self, previous=dr.select(where, origin, self.previous), length=dr.select(where, length, self.length)
        )

    def length_to(self, point: Any, hit: Any) -> Any:
        """Optical length up to the point that the ray meets, where it does. Not `si.t`: rays start off the surface."""
        return dr.select(hit, dr.fma(self.ior, dr.norm(point - self.previous), self.length), self.length)

    def unabsorbed(self, traced: TracedScene, point: Any, hit: Any) -> Any:
        """Fraction of the light that absorption leaves on the way to the point; without one the ray is endless."""
        distance = dr.select(hit, dr.norm(point - self.previous), ENDLESS)
        return traced.absorbers.transmittance(self.sigma_a, distance, self.inside)

    def refracted(self, bs: Any, where: Any) -> RayState:
        """With the refractive index beyond the surface at which `bs` was sampled."""
        is_transmitted = where & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission)
        return replace(self, ior=dr.select(is_transmitted, self.ior * bs.eta, self.ior))

    def entering(self, traced: TracedScene, si: Any, direction: Any, where: Any, crosses: Any) -> RayState:
        """With the media that light enters which leaves the surface in a direction; `crosses` : boundaries of media
        that scatter."""
        inside, sigma_a = self.inside, self.sigma_a
        if inside is not None:
            inside = inside.replaced(crosses, traced.media.beyond(si, direction, crosses))
        if sigma_a is not None:
            sigma_a = traced.absorbers.beyond(si, direction, sigma_a, where)
        return replace(self, inside=inside, sigma_a=sigma_a)

    def reset(self, traced: TracedScene, where: Any) -> RayState:
        """In air again, without a length, `where` a path ends."""
        inside = None if self.inside is None else self.inside.replaced(where, traced.media.none(dr.width(where)))
        sigma_a = None if self.sigma_a is None else dr.select(where, 0, self.sigma_a)
        length, ior = dr.select(where, 0, self.length), dr.select(where, 1, self.ior)
        return RayState(self.previous, length, ior, inside, sigma_a)


def survival(chain: Any, fraction: Any) -> Any:
    """Probability of light to go on after `chain` delta interactions that left `fraction` of it; survivors are divided
    by it.

    Lossless glass keeps all: its paths go on to the limit. Light that fades off metals ends in time.
    """
    return dr.select(chain > ROULETTE_AFTER, dr.minimum(fraction, 1), 1)


def corrected_point(si: Any, origin: Any, direction: Any) -> Any:
    """The point where the line from `origin` meets the tangent plane of the surface met beside it, `si`."""
    slope = dr.dot(direction, si.n)
    along = dr.dot(si.p - origin, si.n) / slope
    return dr.select(dr.abs(slope) > MIN_COSINE, mi.Point3f(origin + direction * along), si.p)


def spawn_specular_ray(si: Any, met: Any, direction: Any) -> Any:
    """The ray that leaves a delta surface close by; `met` is where the ray before met it, on the safe side of edges."""
    ray = si.spawn_ray(direction)
    ray.o = met + CLEARANCE * (ray.o - si.p)
    return ray
