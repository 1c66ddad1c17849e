# SPDX-License-Identifier: Apache-2.0
"""All shapes on the ray through each pixel's centre: those that the camera sees, and those that others hide."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.kernel_launches import Launches, raised_as_it_is
from rangesim.light_transport.ray_tables import camera_device
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.rig import Rig, Zones
from rangesim.scene import Scene

WORD = 64
"""Number of shapes that a pass over the rays tells apart: as many as an integer has bits."""
STEP = 1e-5
"""Step from a surface to the next search along the ray, as a fraction of the range. It is 80 times the rounding of
single precision, so that no surface is found twice for long; shapes that are thinner along the ray are still found,
because each of their two surfaces is looked for."""
MAX_SURFACES = 10_000
"""Largest number of surfaces that are searched along a ray, so that a ray within a surface ends, too. A hundred bodies
in a row have two hundred surfaces."""


@raised_as_it_is()
def shapes_on_rays(scene: Scene, rig: Rig) -> np.ndarray:
    """(shapes, h, w) bool, whether each shape is met anywhere on the ray through each pixel's centre.

    The masks are amodal: a shape's mask does not depend on what stands in front of it. They hold the pixels that
    `GroundTruth.instance` gives to the shape, because the rays are the same. Holes of a `mask` count as surface. A zone
    of `Zones` sees what any of its pixels sees.

    Parameters
    ----------
    scene : Scene, whose shapes are numbered as its `instances`.
    rig : Rig with the camera.
    """
    here, shapes = scene.in_renderer(rig.traced), scene.mitsuba.shapes()
    camera, launches = camera_device(here), Launches()
    index_of = mi.UInt32(table_of(scene.mitsuba, np.arange(len(shapes), dtype=np.uint32)))
    height, width = here.camera.height, here.camera.width
    met = np.zeros((len(shapes), height * width), dtype=bool)
    for first in range(0, len(shapes), WORD):
        count = min(WORD, len(shapes) - first)
        for begin, end in launches.ranges(height * width, per_item=4):
            ray = camera.centre_rays(begin, end)
            exists = dr.full(mi.Bool, True, end - begin) if ray.exists is None else mi.Bool(ray.exists)
            origin = mi.Point3f(ray.origin) + dr.zeros(mi.Point3f, end - begin)
            word = _shapes_met(scene.mitsuba, index_of, origin, ray.direction, exists, dr.opaque(mi.UInt32, first))
            launches.evaluate(word, 4 * (end - begin))
            bits = np.asarray(word.numpy(), dtype=np.uint64)
            for bit in range(count):
                met[first + bit, begin:end] = (bits >> np.uint64(bit)) & np.uint64(1)
    if isinstance(rig.camera, Zones):
        met = np.stack([rig.camera.matrix @ mask.astype(np.float64) > 0 for mask in met])
    return met.reshape(len(shapes), rig.camera.height, rig.camera.width)


@dr.syntax
def _shapes_met(
    scene: mi.Scene,
    index_of: mi.UInt32,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    active: mi.Bool,
    first: mi.UInt32,
) -> mi.UInt64:
    """Bits of the shapes `first` to `first` + 63 that each ray meets."""
    word, passed, surfaces = dr.zeros(mi.UInt64, dr.width(active)), mi.Float(0), mi.UInt32(0)
    while active:
        found = scene.ray_intersect_preliminary(mi.Ray3f(origin + direction * passed, direction), active=active)
        active &= found.is_valid() & (surfaces < MAX_SURFACES)
        index = dr.gather(mi.UInt32, index_of, number_of(found.shape), active) - first
        word |= dr.select(active & (index < WORD), mi.UInt64(1) << mi.UInt64(index), mi.UInt64(0))
        passed = dr.select(active, (passed + found.t) * (1 + STEP), passed)
        surfaces += 1
    return word
