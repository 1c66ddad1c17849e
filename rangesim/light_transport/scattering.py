# SPDX-License-Identifier: Apache-2.0
"""Translucent objects: light that walks through a homogeneous participating medium behind an index-matched boundary.

Inside, light travels exponentially distributed ways between scattering events (mean 1 / sigma_t), keeps the fraction
`albedo` of itself at each, and turns by an angle of the phase function of Henyey and Greenstein (1941); g = 0 is
isotropic. The boundary neither reflects nor refracts, so the way to the projector is straight, and what is left of the
light along it is exp(-sigma_t times the way inside) (Beer-Lambert). See docs/subsurface.md. Media that absorb alone
inside bodies that refract are another matter: `rangesim.light_transport.absorption`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.media import is_boundary, medium_numbers

MAX_EVENTS = 1 << 14
"""Scattering events and crossed boundaries of a path, after which it is cut off; apart from `max_depth`."""
ROULETTE_BELOW = 0.2
"""Throughput below which Russian roulette may end a walk inside a medium."""
OPAQUE = 30.0
"""Optical thickness that counts as a wall: exp(-30) = 1e-13."""


@dataclass
class Medium:
    """The medium at a place; `sigma_t` 0: none. Not frozen, so that it can be the state of a loop of Dr.Jit.

    sigma_t : Float, 1/m, extinction, the inverse of the mean free path. albedo : Float, sigma_s / sigma_t.
    g : Float, mean cosine of the angle by which light turns.
    """

    sigma_t: Any = None
    albedo: Any = None
    g: Any = None

    def replaced(self, where: Any, other: Medium) -> Medium:
        """This medium, and another one `where` it says so."""
        return Medium(
            dr.select(where, other.sigma_t, self.sigma_t),
            dr.select(where, other.albedo, self.albedo),
            dr.select(where, other.g, self.g),
        )

    def free_flight(self, xi: Any) -> Any:
        """Metres to the next scattering event, for xi uniform in [0, 1); infinite where there is no medium."""
        return dr.select(self.sigma_t > 0, -dr.log(1 - xi) / self.sigma_t, dr.inf)

    def phase(self, cosine: Any) -> Any:
        """Density per steradian of scattering into a direction at that cosine to the one before."""
        base = 1 + dr.square(self.g) - 2 * self.g * cosine
        return dr.inv_four_pi * (1 - dr.square(self.g)) / (base * dr.sqrt(base))

    def scattered(self, direction: Any, xi: Any) -> Any:
        """Unit direction after a scattering event, by the phase function; xi Point2f uniform in the unit square."""
        g = dr.select(dr.abs(self.g) < 1e-3, 1e-3, self.g)  # the inverse has no value at g = 0
        way = (1 - dr.square(g)) / (1 - g + 2 * g * xi.x)
        cosine = dr.clip((1 + dr.square(g) - dr.square(way)) / (2 * g), -1, 1)
        cosine = dr.select(dr.abs(self.g) < 1e-3, 1 - 2 * xi.x, cosine)
        sine, (s, c) = dr.safe_sqrt(1 - dr.square(cosine)), dr.sincos(2 * dr.pi * xi.y)
        return dr.normalize(mi.Frame3f(direction).to_world(mi.Vector3f(sine * c, sine * s, cosine)))


class Media:
    """The media of a scene, by the shape that each fills.

    Parameters
    ----------
    scene : mitsuba.Scene, whose boundaries `rangesim.scene.load_scene` has checked.
    """

    def __init__(self, scene: Any) -> None:
        none = (0.0,) * len(fields(Medium))
        media = [medium_numbers(s.interior_medium()) if is_boundary(s) else none for s in scene.shapes()]
        table = table_of(scene, np.array(media, np.float32))
        self.table = tuple(mi.Float(aligned(column, np.float32)) for column in table.T)

    def none(self, lanes: int) -> Medium:
        """No medium, on every lane."""
        return Medium(*(dr.zeros(mi.Float, lanes) for _ in fields(Medium)))

    def bounded_by(self, si: Any, active: Any) -> Any:
        """Whether the surface is the boundary of a medium."""
        return dr.gather(mi.Float, self.table[0], number_of(si.shape), active) > 0

    def beyond(self, si: Any, direction: Any, active: Any) -> Medium:
        """The medium that light enters in a direction across the boundary `si`."""
        enters = active & (dr.dot(direction, si.n) < 0)
        shape = number_of(si.shape)
        return Medium(*(dr.gather(mi.Float, column, shape, enters) for column in self.table))

    def event(self, inside: Medium, previous: Any, direction: Any, si: Any, hit: Any, xi: Any) -> tuple[Any, Any]:
        """Whether light scatters on its way from `previous` to the surface `si`, or crosses a boundary there.

        Where it scatters, position and normal of `si` become those of the event: rays then start there itself.
        """
        flight = inside.free_flight(xi)
        scatters = hit & (flight < dr.norm(si.p - previous))
        crosses = hit & ~scatters & self.bounded_by(si, hit)
        si.p = dr.select(scatters, dr.fma(direction, flight, previous), si.p)
        si.n = dr.select(scatters, 0, si.n)
        return scatters, crosses

    @dr.syntax
    def transmittance(
        self, scene: Any, si: Any, target: Any, inside: Medium, active: Any, around: Any = None
    ) -> tuple[Any, Any]:
        """Fraction of the light that reaches `target` straight from `si`, which lies in the medium `inside`; 0 behind
        any other surface. And whether the way crosses a boundary. `around`: absorption coefficient outside the
        media."""
        start = mi.Point3f(si.p)
        ray = mi.Ray3f(si.spawn_ray_to(target))
        sigma_t, thickness = mi.Float(inside.sigma_t), dr.zeros(mi.Float, dr.width(active))
        if dr.hint(around is not None, mode="scalar"):
            sigma_t = dr.select(sigma_t > 0, sigma_t, around)
        free, crossed, going = mi.Bool(active), dr.zeros(mi.Bool, dr.width(active)), mi.Bool(active)
        while going:
            found = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False, active=going)
            hit = going & found.is_valid()
            crosses = hit & self.bounded_by(found, hit)
            free &= ~hit | crosses
            end = dr.select(hit, found.p, target)
            thickness += dr.select(going, sigma_t * dr.norm(end - start), 0)
            sigma_t = dr.select(crosses, self.beyond(found, ray.d, crosses).sigma_t, sigma_t)
            if dr.hint(around is not None, mode="scalar"):
                sigma_t = dr.select(crosses & (sigma_t == 0), around, sigma_t)
            crossed |= crosses
            start = dr.select(crosses, found.p, start)
            ray = found.spawn_ray_to(target)
            going = crosses & (thickness < OPAQUE)
        return dr.select(free & (thickness < OPAQUE), dr.exp(-thickness), 0), crossed


def media_of(scene: Any) -> Media | None:
    """The media of a mitsuba.Scene; None where there are none, and nothing of this module is in the kernels."""
    return Media(scene) if any(map(is_boundary, scene.shapes())) else None


def bounded(media: Media | None, si: Any) -> Any:
    """Whether the surface is the boundary of a medium; False where there are none."""
    return mi.Bool(False) if media is None else media.bounded_by(si, si.is_valid())
