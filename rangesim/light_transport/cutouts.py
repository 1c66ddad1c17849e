# SPDX-License-Identifier: Apache-2.0
"""Holes in surfaces: where light passes as if nothing were there (`mask`, `null`)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.materials import holes

MAX_CUTOUTS = 8
"""Holes behind each other that a camera ray is followed through."""


class Cutouts:
    """The holes of a scene's surfaces, by shape.

    Parameters
    ----------
    scene : mitsuba.Scene
    components : per shape, bits of the components of its BSDF that are holes (`rangesim.scene.materials.holes`).
    """

    def __init__(self, scene: Any, components: list[int]) -> None:
        self.table = mi.UInt32(table_of(scene, np.array(components, np.uint32)))

    def passed(self, si: Any, bs: Any, active: Any) -> Any:
        """Whether the BSDF sample `bs` at the surface `si` went through a hole."""
        components = dr.gather(mi.UInt32, self.table, number_of(si.shape), active)
        return mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null) & ((components >> bs.sampled_component) & 1 == 1)


def cutouts_of(scene: Any) -> Cutouts | None:
    """The holes of a mitsuba.Scene; None where there are none, and nothing of this module is in the kernels."""
    components = [holes(shape.bsdf()) for shape in scene.shapes()]
    return Cutouts(scene, components) if any(components) else None


def first_surface(surfaces: Any, ray: Any, has_cutouts: bool) -> Any:
    """Where the ray meets the first surface that is less than half a hole."""
    si = surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    for _ in range(MAX_CUTOUTS if has_cutouts else 0):
        passes = si.is_valid() & (_openness(si) > 0.5)
        passes &= ~si.shape.is_medium_transition()  # a translucent object begins at its boundary
        behind = surfaces.ray_intersect(si.spawn_ray(ray.d), mi.RayFlags.All, coherent=True, active=passes)
        si = dr.select(passes, behind, si)
    return si


def _openness(si: Any) -> Any:
    """Fraction of the light that passes the surface through holes.

    It is that which passes unchanged at grazing incidence, where thin glass reflects everything.
    """
    grazing = mi.SurfaceInteraction3f(si)
    grazing.wi = mi.Vector3f(1, 0, 0)
    return mono(si.bsdf().eval_null_transmission(grazing))
