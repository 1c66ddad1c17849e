# SPDX-License-Identifier: Apache-2.0
"""Surfaces that send light on instead of scattering it all around, and rays that meet them first.

They have delta interactions (glass, mirrors, thin panes, coats, holes), or scatter into narrow lobes alone (polished
metal).
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import PrimaryRay
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.materials import is_near_specular
from rangesim.scene.media import is_boundary


def has_delta(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction. Without one there are no caustics."""
    return any(map(_is_delta, scene.shapes()))


def is_thrower(shape: mi.Shape) -> bool:
    """Whether the surface of a shape scatters light into narrow lobes alone, which throw it onto other surfaces."""
    return is_near_specular(shape.bsdf())


def has_throwers(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene scatters into narrow lobes alone."""
    return any(map(is_thrower, scene.shapes()))


def sends_on(shape: mi.Shape) -> bool:
    """Whether light that meets the surface of a shape may go on to other surfaces as part of a caustic."""
    return _is_delta(shape) or is_thrower(shape)


def _is_delta(shape: mi.Shape) -> bool:
    """Whether the surface of a shape has a delta interaction, and is not the boundary of a medium."""
    return bool(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)) and not is_boundary(shape)


def meets_delta(
    scene: mi.Scene,
    count: int,
    rays_of: Callable[[int, int], PrimaryRay],
    counts: Callable[[mi.Shape], bool] = _is_delta,
) -> tuple[np.ndarray, np.ndarray]:
    """Whether the first surface that each of `count` rays meets has a delta interaction, or `counts` otherwise.

    Parameters
    ----------
    rays_of : function that returns the rays from one number up to another, such as those through pixels' centres.

    Returns
    -------
    meets : (count,) bool, whether it has one.
    exists : (count,) bool, whether the lens sends such a ray at all.
    """
    launches, meets, exists = Launches(), np.zeros(count, dtype=bool), np.ones(count, dtype=bool)
    table = mi.Bool(table_of(scene, list(map(counts, scene.shapes()))))
    for begin, end in launches.ranges(count):
        rays = rays_of(begin, end)
        found = scene.ray_intersect_preliminary(mi.Ray3f(rays.origin, rays.direction))
        delta = dr.gather(mi.Bool, table, number_of(found.shape), found.is_valid())
        launches.evaluate([delta, rays.exists], end - begin)
        meets[begin:end] = delta.numpy()
        if rays.exists is not None:  # a distorted lens
            exists[begin:end] = rays.exists.numpy()
    return meets, exists
