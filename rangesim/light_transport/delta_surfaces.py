# SPDX-License-Identifier: Apache-2.0
"""Surfaces that have delta interactions (glass, mirrors, thin panes, coats, holes), and rays that meet them first."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import PrimaryRay
from rangesim.light_transport.cutouts import Cutouts
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.media import is_boundary


def has_delta(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction."""
    return any(map(_is_delta, scene.shapes()))


def throws_caustics(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction that is no hole. Without one there are no
    caustics."""
    return any(map(_deflects, scene.shapes()))


def _is_delta(shape: mi.Shape) -> bool:
    """Whether the surface of a shape has a delta interaction, and is not the boundary of a medium."""
    return bool(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)) and not is_boundary(shape)


def _deflects(shape: mi.Shape) -> bool:
    """Whether the surface of a shape has a delta interaction that is no hole; thin glass reflects as well."""
    lobes = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission
    return any(mi.has_flag(shape.bsdf().flags(), lobe) for lobe in lobes)


def meets_delta(
    scene: mi.Scene, count: int, rays_of: Callable[[int, int], PrimaryRay], cutouts: Cutouts | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Whether the first surface that each of `count` rays meets has a delta interaction.

    Parameters
    ----------
    rays_of : function that returns the rays from one number up to another, such as those through pixels' centres.
    cutouts : holes through which the rays go on. None: a hole is a delta interaction as any other.

    Returns
    -------
    meets : (count,) bool, whether it has one.
    exists : (count,) bool, whether the lens sends such a ray at all.
    """
    launches, meets, exists = Launches(), np.zeros(count, dtype=bool), np.ones(count, dtype=bool)
    goes_on = cutouts is not None and cutouts.exist
    table = mi.Bool(table_of(scene, list(map(_deflects if goes_on else _is_delta, scene.shapes()))))
    for begin, end in launches.ranges(count):
        rays = rays_of(begin, end)
        if goes_on and cutouts is not None:
            delta = _meets_behind_holes(cutouts, mi.Ray3f(rays.origin, rays.direction), table)
        else:
            found = scene.ray_intersect_preliminary(mi.Ray3f(rays.origin, rays.direction))
            delta = dr.gather(mi.Bool, table, number_of(found.shape), found.is_valid())
        launches.evaluate([delta, rays.exists], end - begin)
        meets[begin:end] = delta.numpy()
        if rays.exists is not None:  # a distorted lens
            exists[begin:end] = rays.exists.numpy()
    return meets, exists


@dr.syntax
def _meets_behind_holes(cutouts: Cutouts, ray: mi.Ray3f, table: mi.Bool) -> mi.Bool:
    """Whether the first surface that is in the table, or has no holes, is in the table."""
    ray = mi.Ray3f(ray)
    meets, going = dr.zeros(mi.Bool, dr.width(ray.d)), dr.full(mi.Bool, True, dr.width(ray.d))
    while going:
        si = cutouts.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=going)
        hit = going & si.is_valid()
        meets |= dr.gather(mi.Bool, table, number_of(si.shape), hit)
        going = hit & ~meets & dr.gather(mi.Bool, cutouts.holes, number_of(si.shape), hit)
        ray = si.spawn_ray(ray.d)
    return meets
