# SPDX-License-Identifier: Apache-2.0
"""Absorption inside glass, water and clear plastics, by Beer and Lambert's law.

A body that refracts light (`dielectric`, `roughdielectric`) may be filled with a medium that absorbs and does not
scatter. Light that runs a distance d inside keeps exp(-sigma_a d) of itself. The ray stays straight there, so a path
needs one number more: the absorption coefficient along its ray. At the surface of such a body, the side to which light
leaves decides on the next one, as in Mitsuba's `volpath`: against the normal it is that of the interior medium, along
the normal that of the exterior one. All other surfaces leave it as it is.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.scattering import Medium
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.media import is_boundary, medium_numbers

ENDLESS = 1e30
"""Metres to where a ray that meets no surface ends."""
UNCHANGED = -1.0
"""Stands in the table for surfaces that bound no absorbing medium."""


class Absorbers:
    """The absorption coefficients (1/m) on both sides of each surface of a scene.

    Parameters
    ----------
    scene : mitsuba.Scene, whose media `rangesim.scene.load_scene` has checked.
    sides : (shapes, 2) float, inside and outside; `UNCHANGED` for surfaces that bound no absorbing medium.
    """

    def __init__(self, scene: Any, sides: np.ndarray) -> None:
        self.table = mi.Float(aligned(table_of(scene, sides), np.float32))

    def transmittance(self, sigma_a: Any, distance: Any, inside: Medium | None = None) -> Any:
        """Fraction of the light left after a distance in metres; 1 in a scattering medium `inside` the absorbing body,
        which has its own extinction."""
        if inside is not None:
            sigma_a = dr.select(inside.sigma_t > 0, 0, sigma_a)
        return dr.exp(-sigma_a * distance)

    def beyond(self, si: Any, direction: Any, sigma_a: Any, active: Any) -> Any:
        """Absorption coefficient of what light enters that leaves the surface `si` in a direction; `sigma_a` is that
        of what it came through."""
        outside = dr.select(dr.dot(direction, si.n) > 0, mi.UInt32(1), mi.UInt32(0))
        found = dr.gather(mi.Float, self.table, 2 * number_of(si.shape) + outside, active)
        return dr.select(active & (found >= 0), found, sigma_a)


def absorbers_of(scene: Any) -> Absorbers | None:
    """The absorbing bodies of a mitsuba.Scene; None where there are none, and nothing of this module is in the
    kernels."""
    sides = np.array([_sides(shape) for shape in scene.shapes()])
    return Absorbers(scene, sides) if (sides > 0).any() else None


def _sides(shape: Any) -> tuple[float, float]:
    """Inside and outside of a shape, 1/m. A scattering medium inside is not this module's; if nothing is said of what
    lies around it, that is what light came through."""
    if not shape.is_medium_transition():
        return UNCHANGED, UNCHANGED
    untold = UNCHANGED if is_boundary(shape) else 0.0
    inside = untold if is_boundary(shape) else _sigma_a(shape.interior_medium(), untold)
    return inside, _sigma_a(shape.exterior_medium(), untold)


def _sigma_a(medium: Any, untold: float) -> float:
    return untold if medium is None else medium_numbers(medium)[0]
