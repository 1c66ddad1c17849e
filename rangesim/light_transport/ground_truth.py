# SPDX-License-Identifier: Apache-2.0
"""Ground truth: what lies behind each pixel centre, found with one camera ray and one shadow ray."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.device import Device, connect
from rangesim.light_transport.launches import Launches
from rangesim.light_transport.loop import mono
from rangesim.light_transport.shapes import number_of, table_of
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.scene.materials import MATERIAL_CLASSES
from rangesim.signals import GroundTruth

MOST_CUTOUTS = 8
"""Holes behind each other that a camera ray is followed through."""


def ground_truth(scene: Scene, rig: Rig, surfaces: Any) -> GroundTruth:
    """First surface along the ray through each pixel centre; see `rangesim.signals.GroundTruth`."""
    h, w = rig.camera.height, rig.camera.width
    camera, projector = Device.camera(rig), Device.projector(rig)
    launches, shapes = Launches(), scene.mitsuba.shapes()
    index_of = mi.Int32(table_of(scene.mitsuba, np.arange(len(shapes), dtype=np.int32)))
    transmits = [bool(mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Transmission)) for s in shapes]
    transmits_of = mi.Bool(table_of(scene.mitsuba, transmits))
    parts = []
    for begin, end in launches.ranges(h * w):
        part = _truth(scene, surfaces, camera, projector, index_of, transmits_of, begin, end)
        launches.evaluate(part, end - begin)
        parts.append([np.asarray(x.numpy()) for x in part])
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    hit, index, z, distance, visible, u, v, *normal = (column.reshape(h, w) for column in columns)
    masked = lambda x: np.where(hit, x, np.float32(np.nan))  # noqa: E731
    instance = np.where(hit, index, -1).astype(np.int32)
    materials = np.array([MATERIAL_CLASSES.index(i.material) for i in scene.instances], dtype=np.int32)
    return GroundTruth(
        z=masked(z),
        range_m=masked(distance),
        normal=np.stack([masked(x) for x in normal], axis=-1),
        instance=instance,
        material=np.where(instance >= 0, materials[instance], -1).astype(np.int32),
        projector_uv=np.stack([masked(u), masked(v)], axis=-1),
        projector_visible=visible,
        instance_names=tuple(i.name for i in scene.instances),
        material_names=MATERIAL_CLASSES,
    )


def _truth(
    scene: Scene,
    surfaces: Any,
    camera: Device,
    projector: Device,
    index_of: Any,
    transmits_of: Any,
    begin: int,
    end: int,
) -> list[Any]:
    """Of a range of pixels: hit, index of the shape, z, range, visibility, u, v, and three of the normal."""
    ray = camera.centre_rays(begin, end)
    si = _first_surface(scene, surfaces, mi.Ray3f(ray.origin, ray.direction))
    hit = si.is_valid() if ray.exists is None else si.is_valid() & ray.exists
    to_camera = camera.centre - mi.Vector3f(si.p)
    normal = dr.select(dr.dot(si.n, to_camera) < 0, -si.n, si.n)
    link = connect(scene.mitsuba, projector, si, hit)
    uv = link.uv
    shape = number_of(si.shape)
    transmits = dr.gather(mi.Bool, transmits_of, shape, hit)
    visible = link.lit & (transmits | (dr.dot(normal, link.direction) > 0))
    z, distance = -dr.dot(to_camera, camera.z), dr.norm(to_camera)
    index = dr.gather(mi.Int32, index_of, shape, hit)
    return [hit, index, z, distance, visible, uv.x, uv.y, normal.x, normal.y, normal.z]


def _first_surface(scene: Scene, surfaces: Any, ray: Any) -> Any:
    """Where the ray meets the first surface that lets less than half of the light pass unchanged."""
    flags = mi.RayFlags.All if scene.has_cutouts else mi.RayFlags.Minimal
    si = surfaces.ray_intersect(ray, flags, coherent=True)
    for _ in range(MOST_CUTOUTS if scene.has_cutouts else 0):
        bsdf = si.bsdf()
        is_glass = mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection)
        passes = si.is_valid() & ~is_glass & (mono(bsdf.eval_null_transmission(si)) > 0.5)
        passes &= ~si.shape.is_medium_transition()  # a translucent object begins at its boundary
        behind = surfaces.ray_intersect(si.spawn_ray(ray.d), mi.RayFlags.All, coherent=True, active=passes)
        si = dr.select(passes, behind, si)
    return si
