# SPDX-License-Identifier: Apache-2.0
"""Holes in surfaces (`mask`, `null`), through which light passes as if nothing were there.

Light through a hole goes straight, so next-event estimation looks for the projector through holes.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.surfaces import Surfaces, number_of, ray_to_emitter, table_of
from rangesim.scene.materials import holes
from rangesim.scene.media import is_boundary

MAX_CUTOUTS = 8
"""Number of holes in a row through which a camera ray is followed to the first surface, so that the time per pixel is
bounded. If there are more, the ground truth shows a surface at one of its holes."""


class Cutouts:
    """The holes of a scene's surfaces, by shape.

    Parameters
    ----------
    scene : mitsuba.Scene
    surfaces : the scene itself or its `Surfaces`, to intersect rays with.
    components : (shapes,) int. Bit i of a number says that component i of the shape's BSDF is a hole
        (`rangesim.scene.materials.holes`).

    Attributes
    ----------
    exist : bool, whether any hole is not the boundary of a medium.
    """

    def __init__(self, scene: mi.Scene, surfaces: mi.Scene | Surfaces, components: list[int]) -> None:
        self.surfaces, self.table = surfaces, mi.UInt32(table_of(scene, np.array(components, np.uint32)))
        is_hole = [bool(of) and not is_boundary(shape) for of, shape in zip(components, scene.shapes(), strict=True)]
        self.exist, self.holes = any(is_hole), mi.Bool(table_of(scene, is_hole))

    def passed(self, si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f, active: mi.Bool) -> mi.Bool:
        """Whether the BSDF sample `bs` at the surface `si` went through a hole."""
        components = dr.gather(mi.UInt32, self.table, number_of(si.shape), active)
        return mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null) & ((components >> bs.sampled_component) & 1 == 1)

    def openness(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Fraction of the light that passes the surface through holes; 0 for boundaries of media."""
        has_holes = active & dr.gather(mi.Bool, self.holes, number_of(si.shape), active)
        return dr.select(has_holes, _openness(si, has_holes), 0)

    @dr.syntax
    def transmittance(self, si: mi.SurfaceInteraction3f, emitter: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Fraction of the light that goes straight from `si` to an emitter through holes; 1 if nothing is between."""
        ray, fraction, going = mi.Ray3f(ray_to_emitter(si, emitter)), dr.select(active, mi.Float(1), 0), mi.Bool(active)
        while going:
            found = self.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=going)
            hit = going & found.is_valid()
            fraction *= dr.select(hit, self.openness(found, hit), 1)
            ray = ray_to_emitter(found, emitter)
            going = hit & (fraction > 0)
        return fraction


def cutouts_of(scene: mi.Scene, surfaces: mi.Scene | Surfaces) -> Cutouts | None:
    """The holes of a mitsuba.Scene. None if it has none: no kernel then has code of this module."""
    components = [holes(shape.bsdf()) for shape in scene.shapes()]
    return Cutouts(scene, surfaces, components) if any(components) else None


def first_surface(surfaces: mi.Scene | Surfaces, ray: mi.Ray3f, has_cutouts: bool) -> mi.SurfaceInteraction3f:
    """The first surface on the ray that stops at least half of the light.

    `has_cutouts` says whether any surface of the scene has holes.
    """
    si = surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    for _ in range(MAX_CUTOUTS if has_cutouts else 0):
        passes = si.is_valid() & (_openness(si, si.is_valid()) > 0.5)
        passes &= ~si.shape.is_medium_transition()  # a translucent object begins at its boundary
        behind = surfaces.ray_intersect(si.spawn_ray(ray.d), mi.RayFlags.All, coherent=True, active=passes)
        si = dr.select(passes, behind, si)
    return si


def _openness(si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
    """Fraction of the light that passes the surface through holes.

    It is the fraction that passes unchanged at grazing incidence. Thin glass also passes light unchanged, but reflects
    all of it at grazing incidence.
    """
    grazing = mi.SurfaceInteraction3f(si)
    grazing.wi = mi.Vector3f(1, 0, 0)
    return mono(si.bsdf().eval_null_transmission(grazing, active))
