# SPDX-License-Identifier: Apache-2.0
"""Absorption inside glass, water and clear plastics, by Beer and Lambert's law.

A body that refracts light (`dielectric`, `roughdielectric`) may be filled with a medium that absorbs and does not
scatter. Of light that travels a distance d inside, the fraction exp(-sigma_a d) is left. The ray stays straight there,
so a path needs one more number: the absorption coefficient along its ray. At the surface of such a body, the side on
which light leaves the surface decides which coefficient comes next, as in Mitsuba's `volpath`. Light that leaves
against the normal gets the coefficient of the interior medium; light that leaves along the normal gets that of the
exterior medium. All other surfaces do not change the coefficient.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.scattering import Medium
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.media import is_boundary, medium_numbers

ENDLESS_M = 1e30
"""Length in metres of a ray that meets no surface. It stands for infinity, because infinity times a coefficient of 0
would be NaN."""
UNCHANGED = -1.0
"""Coefficient, in 1/m, of surfaces that bound no absorbing medium: that along the ray stays. It is negative, so that
no real coefficient is the same."""


class Absorbers:
    """The absorption coefficients (1/m) on both sides of each surface of a scene.

    Parameters
    ----------
    scene : mitsuba.Scene, whose media `rangesim.scene.load_scene` has checked.
    sides : (shapes, 2) float, inside and outside; `UNCHANGED` for surfaces that bound no absorbing medium.
    """

    def __init__(self, scene: mi.Scene, sides: np.ndarray) -> None:
        self.table = mi.Float(aligned(table_of(scene, sides), np.float32))

    def transmittance(self, sigma_a: mi.Float, distance: mi.Float, inside: Medium | None = None) -> mi.Float:
        """Fraction of the light that is left after a distance in metres.

        It is 1 where the medium along the ray, `inside`, scatters, because such a medium has its own extinction.
        """
        if inside is not None:
            sigma_a = dr.select(inside.sigma_t > 0, 0, sigma_a)
        return dr.exp(-sigma_a * distance)

    def beyond(
        self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, sigma_a: mi.Float, active: mi.Bool
    ) -> mi.Float:
        """Absorption coefficient (1/m) along a ray that leaves the surface `si` in a direction.

        `sigma_a` is the coefficient along the ray that met the surface.
        """
        outside = dr.select(dr.dot(direction, si.n) > 0, mi.UInt32(1), mi.UInt32(0))
        found = dr.gather(mi.Float, self.table, 2 * number_of(si.shape) + outside, active)
        return dr.select(active & (found >= 0), found, sigma_a)


def absorbers_of(scene: mi.Scene) -> Absorbers | None:
    """The absorbing bodies of a mitsuba.Scene. None if it has none: no kernel then has code of this module."""
    sides = np.array([_sides(shape) for shape in scene.shapes()])
    return Absorbers(scene, sides) if (sides > 0).any() else None


def _sides(shape: mi.Shape) -> tuple[float, float]:
    """Absorption coefficients inside and outside of a shape, 1/m.

    If the medium inside scatters, `rangesim.light_transport.scattering` handles it. If the scene says nothing about
    what lies around such a medium, the coefficient along the ray stays as it is.
    """
    if not shape.is_medium_transition():
        return UNCHANGED, UNCHANGED
    untold = UNCHANGED if is_boundary(shape) else 0.0
    inside = untold if is_boundary(shape) else _sigma_a(shape.interior_medium(), untold)
    return inside, _sigma_a(shape.exterior_medium(), untold)


def _sigma_a(medium: mi.Medium | None, untold: float) -> float:
    """Absorption coefficient of a medium, 1/m; `untold` if there is no medium."""
    return untold if medium is None else medium_numbers(medium)[0]
