# SPDX-License-Identifier: Apache-2.0
"""Translucent objects: light that walks through a homogeneous participating medium behind an index-matched boundary.

Inside, light travels exponentially distributed distances between scattering events, 1 / sigma_t on average. At each
event it keeps the fraction `albedo`, and turns by an angle that follows the phase function of Henyey and Greenstein
(1941); g = 0 is isotropic. The boundary neither reflects nor refracts, so the way to the projector is straight. Along
it, the fraction exp(-sigma_t times the distance inside) of the light is left (Beer-Lambert). See docs/subsurface.md.
Media that only absorb, inside bodies that refract, are in `rangesim.light_transport.absorption`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.cutouts import Cutouts
from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.media import is_boundary, medium_numbers

MAX_EVENTS = 1 << 14
"""Number of scattering events and crossed boundaries per path after which it is cut off, so that its time is bounded.
In whole milk, the throughput of a walk falls to `ROULETTE_BELOW` after some 4000 events."""
ROULETTE_BELOW = 0.2
"""Throughput, a fraction of the light, below which Russian roulette may end a walk inside a medium, so that walks end
in time. A smaller fraction makes less noise and longer walks."""
OPAQUE = 30.0
"""Optical thickness, dimensionless, that counts as a wall, because exp(-30) = 1e-13 is below the rounding of single
precision."""


@dataclass
class Medium:
    """The medium along a ray. Loops of Dr.Jit carry it, so it is not frozen.

    sigma_t : Float, 1/m, extinction coefficient, the inverse of the mean free path; 0 where there is no medium.
    albedo : Float, sigma_s / sigma_t.
    g : Float, mean cosine of the angle by which light turns.
    """

    sigma_t: mi.Float
    albedo: mi.Float
    g: mi.Float

    def replaced(self, where: mi.Bool, other: Medium) -> Medium:
        """This medium, or the other one on the lanes of the mask `where`."""
        return Medium(
            dr.select(where, other.sigma_t, self.sigma_t),
            dr.select(where, other.albedo, self.albedo),
            dr.select(where, other.g, self.g),
        )

    def free_flight(self, xi: mi.Float) -> mi.Float:
        """Distance to the next scattering event in metres; infinite where there is no medium.

        `xi` is uniform in [0, 1).
        """
        return dr.select(self.sigma_t > 0, -dr.log(1 - xi) / self.sigma_t, dr.inf)

    def phase(self, cosine: mi.Float) -> mi.Float:
        """Density (1/sr) with which light scatters by an angle of that cosine."""
        base = 1 + dr.square(self.g) - 2 * self.g * cosine
        return dr.inv_four_pi * (1 - dr.square(self.g)) / (base * dr.sqrt(base))

    def scattered(self, direction: mi.Vector3f, xi: mi.Point2f) -> mi.Vector3f:
        """Unit direction after a scattering event, drawn from the phase function.

        `direction` is the one before; `xi` is uniform in the unit square.
        """
        g = dr.select(dr.abs(self.g) < 1e-3, 1e-3, self.g)  # the inverse function would be 0 / 0 at g = 0
        way = (1 - dr.square(g)) / (1 - g + 2 * g * xi.x)
        cosine = dr.clip((1 + dr.square(g) - dr.square(way)) / (2 * g), -1, 1)
        cosine = dr.select(dr.abs(self.g) < 1e-3, 1 - 2 * xi.x, cosine)
        sine, (s, c) = dr.safe_sqrt(1 - dr.square(cosine)), dr.sincos(2 * dr.pi * xi.y)
        return dr.normalize(mi.Frame3f(direction).to_world(mi.Vector3f(sine * c, sine * s, cosine)))


class Media:
    """The media that scatter in a scene, by the shape that each of them fills.

    Parameters
    ----------
    scene : mitsuba.Scene, whose boundaries `rangesim.scene.load_scene` has checked.
    """

    def __init__(self, scene: mi.Scene) -> None:
        none = (0.0,) * len(fields(Medium))
        media = [medium_numbers(s.interior_medium()) if is_boundary(s) else none for s in scene.shapes()]
        table = table_of(scene, np.array(media, np.float32))
        self.table = tuple(mi.Float(aligned(column, np.float32)) for column in table.T)

    def none(self, lanes: int) -> Medium:
        """No medium, on every lane."""
        return Medium(*(dr.zeros(mi.Float, lanes) for _ in fields(Medium)))

    def bounded_by(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Whether the surface is the boundary of a medium."""
        return dr.gather(mi.Float, self.table[0], number_of(si.shape), active) > 0

    def beyond(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> Medium:
        """The medium that light enters when it crosses the boundary `si` in a direction."""
        enters = active & (dr.dot(direction, si.n) < 0)
        shape = number_of(si.shape)
        return Medium(*(dr.gather(mi.Float, column, shape, enters) for column in self.table))

    def event(
        self,
        inside: Medium,
        previous: mi.Point3f,
        direction: mi.Vector3f,
        si: mi.SurfaceInteraction3f,
        hit: mi.Bool,
        xi: mi.Float,
    ) -> tuple[mi.Bool, mi.Bool]:
        """Whether light scatters on its way to a surface, and whether it crosses the boundary of a medium there.

        Where it scatters, the position of `si` becomes that of the event, and its normal 0, so that rays start exactly
        there.

        Parameters
        ----------
        inside : Medium, along the way.
        previous, direction : start and direction of the way.
        si : SurfaceInteraction3f, where the way ends; changed in place.
        xi : Float, uniform in [0, 1).
        """
        flight = inside.free_flight(xi)
        scatters = hit & (flight < dr.norm(si.p - previous))
        crosses = hit & ~scatters & self.bounded_by(si, hit)
        si.p = dr.select(scatters, dr.fma(direction, flight, previous), si.p)
        si.n = dr.select(scatters, 0, si.n)
        return scatters, crosses

    @dr.syntax
    def transmittance(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        target: mi.Point3f,
        inside: Medium,
        active: mi.Bool,
        around: mi.Float = None,
        cutouts: Cutouts | None = None,
        ray_to: Callable[[mi.SurfaceInteraction3f, mi.Point3f], mi.Ray3f] | None = None,
    ) -> tuple[mi.Float, mi.Bool]:
        """Transmittance of the straight way from `si` to `target`, and whether the way crosses a boundary.

        The transmittance is 0 where any surface other than the boundary of a medium or a hole stands in between.

        Parameters
        ----------
        inside : Medium, in which the way starts.
        around : Float, 1/m, absorption coefficient outside the media that scatter; None: 0.
        cutouts : Cutouts, holes that the way may go through; None: it goes through none.
        ray_to : function that returns the ray from a surface to the target; None: Mitsuba's, for one on a surface.
        """
        start = mi.Point3f(si.p)
        ray_to = ray_to or mi.SurfaceInteraction3f.spawn_ray_to
        ray = mi.Ray3f(ray_to(si, target))
        sigma_t, thickness = mi.Float(inside.sigma_t), dr.zeros(mi.Float, dr.width(active))
        if dr.hint(around is not None, mode="scalar"):
            sigma_t = dr.select(sigma_t > 0, sigma_t, around)
        free, crossed, going = mi.Bool(active), dr.zeros(mi.Bool, dr.width(active)), mi.Bool(active)
        fraction = dr.ones(mi.Float, dr.width(active)) if cutouts is not None else mi.Float(1)
        while going:
            if dr.hint(cutouts is not None, mode="scalar"):
                assert cutouts is not None
                found = cutouts.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=going)
            else:
                found = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False, active=going)
            hit = going & found.is_valid()
            crosses = hit & self.bounded_by(found, hit)
            passes = mi.Bool(crosses)
            if dr.hint(cutouts is not None, mode="scalar"):
                assert cutouts is not None
                openness = cutouts.openness(found, hit)
                fraction *= dr.select(openness > 0, openness, 1)
                passes |= openness > 0
            free &= ~hit | passes
            end = dr.select(hit, found.p, target)
            thickness += dr.select(going, sigma_t * dr.norm(end - start), 0)
            sigma_t = dr.select(crosses, self.beyond(found, ray.d, crosses).sigma_t, sigma_t)
            if dr.hint(around is not None, mode="scalar"):
                sigma_t = dr.select(crosses & (sigma_t == 0), around, sigma_t)
            crossed |= crosses
            start = dr.select(passes, found.p, start)
            ray = ray_to(found, target)
            going = passes & (thickness < OPAQUE)
        return dr.select(free & (thickness < OPAQUE), fraction * dr.exp(-thickness), 0), crossed


def media_of(scene: mi.Scene) -> Media | None:
    """The media of a mitsuba.Scene that scatter. None if it has none: no kernel then has code of this module."""
    return Media(scene) if any(map(is_boundary, scene.shapes())) else None


def bounded(media: Media | None, si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether the surface `si` is the boundary of a medium; false in scenes without media."""
    return mi.Bool(False) if media is None else media.bounded_by(si, si.is_valid())
