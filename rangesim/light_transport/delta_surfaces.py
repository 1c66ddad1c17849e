# SPDX-License-Identifier: Apache-2.0
"""Surfaces that send light on instead of scattering it all around, and rays that meet them first.

They have delta interactions (glass, mirrors, thin panes, coats, holes), or scatter into narrow lobes alone (polished
metal).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import PrimaryRay
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.scene.materials import is_cutout, is_near_specular
from rangesim.scene.media import is_boundary

CLEAR_GLASS = ("SmoothDielectric", "ThinDielectric")
"""Class names of BSDFs that reflect light or let it pass, and do nothing else. Wrappers and blends of them choose among
more lobes, or do not tell the probability of their choice."""
MAX_BOUNDARIES = 8
"""Number of boundaries of media in a row behind which glass is looked for, so that the time is bounded. Glass behind
more of them, such as in the fifth of five bodies of milk, throws no caustics."""


def has_delta(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction."""
    return any(map(is_delta_surface, scene.shapes()))


def throws_caustics(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction that is no hole, or scatters into narrow lobes
    alone. Without one there are no caustics."""
    return any(map(deflects, scene.shapes())) or has_throwers(scene)


def has_throwers(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene scatters into narrow lobes alone."""
    return any(map(is_thrower, scene.shapes()))


def is_thrower(shape: mi.Shape) -> bool:
    """Whether the surface of a shape scatters light into narrow lobes alone, which throw it onto other surfaces."""
    return is_near_specular(shape.bsdf())


def is_delta_surface(shape: mi.Shape) -> bool:
    """Whether the surface of a shape has a delta interaction, and is not the boundary of a medium."""
    return bool(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)) and not is_boundary(shape)


def deflects(shape: mi.Shape) -> bool:
    """Whether the surface of a shape has a delta interaction that is no hole; thin glass reflects as well."""
    lobes = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission
    return any(mi.has_flag(shape.bsdf().flags(), lobe) for lobe in lobes)


def splits_light(shape: mi.Shape) -> bool:
    """Whether light that meets the surface of a shape takes one of two ways, with probabilities that a BSDF sample
    tells exactly: off clear glass or through it."""
    return shape.bsdf().class_name() in CLEAR_GLASS and not is_boundary(shape)


def meets_delta(
    scene: mi.Scene,
    count: int,
    rays_of: Callable[[int, int], PrimaryRay],
    counts: Callable[[mi.Shape], bool] = is_delta_surface,
    through_holes: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Whether the first surface that each of `count` rays meets, boundaries of media aside, is a delta surface.

    Parameters
    ----------
    rays_of : function that returns the rays from one number up to another, such as those through pixels' centres.
    counts : whether a shape counts, if not delta surfaces do.
    through_holes : whether rays go on through surfaces whose only delta interactions are holes, as boundaries do.

    Returns
    -------
    meets : (count,) bool, whether the surface counts.
    exists : (count,) bool, whether the lens sends such a ray at all.
    """
    launches, meets, exists = Launches(), np.zeros(count, dtype=bool), np.ones(count, dtype=bool)
    table = mi.Bool(table_of(scene, list(map(counts, scene.shapes()))))
    passed = boundaries_of(scene, through_holes)
    for begin, end in launches.ranges(count):
        rays = rays_of(begin, end)
        met = first_shape(scene, mi.Ray3f(rays.origin, rays.direction), passed)
        delta = dr.gather(mi.Bool, table, met.number, met.exists)
        launches.evaluate([delta, rays.exists], end - begin)
        meets[begin:end] = delta.numpy()
        if rays.exists is not None:  # a distorted lens
            exists[begin:end] = rays.exists.numpy()
    return meets, exists


class FirstShape(NamedTuple):
    """The shape that a ray meets first, boundaries of media aside.

    number : UInt32, its number (`surfaces.number_of`). exists : Bool, whether the ray meets one.
    """

    number: mi.UInt32
    exists: mi.Bool


def boundaries_of(scene: mi.Scene, and_holes: bool = False) -> mi.Bool | None:
    """Table (`table_of`) of the shapes that are boundaries of media; None if there are none.

    `and_holes` says whether shapes whose only delta interactions are holes count as well.
    """
    passed = [is_boundary(s) or (and_holes and is_cutout(s.bsdf()) and not deflects(s)) for s in scene.shapes()]
    return mi.Bool(table_of(scene, passed)) if any(passed) else None


def first_shape(scene: mi.Scene, ray: mi.Ray3f, boundaries: mi.Bool | None) -> FirstShape:
    """The shape that each ray meets first, behind up to `MAX_BOUNDARIES` of the boundaries of media."""
    found = scene.ray_intersect_preliminary(ray, coherent=False)
    number, exists = number_of(found.shape), found.is_valid()
    for _ in range(MAX_BOUNDARIES if boundaries is not None else 0):
        passes = exists & dr.gather(mi.Bool, boundaries, number, exists)
        si = found.compute_surface_interaction(ray, mi.RayFlags.Minimal, passes)
        ray = dr.select(passes, si.spawn_ray(ray.d), ray)
        behind = scene.ray_intersect_preliminary(ray, coherent=False, active=passes)
        found = dr.select(passes, behind, found)
        number, exists = number_of(found.shape), dr.select(passes, behind.is_valid(), exists)
    return FirstShape(number, exists)
