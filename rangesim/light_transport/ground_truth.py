# SPDX-License-Identifier: Apache-2.0
"""Ground truth: what lies behind each pixel centre, found with one camera ray and one shadow ray."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.cutouts import first_surface
from rangesim.light_transport.device import connect
from rangesim.light_transport.indirect_filter import Guides
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.loop import Lanes, PathSettings, SampleAllocation, View
from rangesim.light_transport.sampling import in_pairs
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.scene.materials import MATERIAL_CLASSES, is_matte, transmits
from rangesim.scene.media import is_boundary
from rangesim.signals import GroundTruth


def ground_truth(scene: Scene, traced: TracedScene, rig: Rig) -> tuple[GroundTruth, Guides]:
    """First surface along the ray through each pixel centre; see `rangesim.signals.GroundTruth`."""
    h, w = rig.camera.height, rig.camera.width
    launches, shapes = Launches(), scene.mitsuba.shapes()
    index_of = mi.Int32(table_of(scene.mitsuba, np.arange(len(shapes), dtype=np.int32)))
    transmits_of = mi.Bool(table_of(scene.mitsuba, [is_boundary(s) or transmits(s.bsdf()) for s in shapes]))
    matte = np.array([is_matte(s) for s in shapes])
    parts = []
    for begin, end in launches.ranges(h * w):
        part = _truth(traced, scene.has_cutouts, index_of, transmits_of, begin, end)
        launches.evaluate(part, end - begin)
        parts.append([np.asarray(x.numpy()) for x in part])
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    hit, index, z, distance, visible, u, v, *vectors = (column.reshape(h, w) for column in columns)
    normal, position, shading_normal, (reflectance,) = vectors[:3], vectors[3:6], vectors[6:9], vectors[9:]
    masked = lambda x: np.where(hit, x, np.float32(np.nan))  # noqa: E731
    instance = np.where(hit, index, -1).astype(np.int32)
    materials = np.array([MATERIAL_CLASSES.index(i.material) for i in scene.instances], dtype=np.int32)
    truth = GroundTruth(
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
    is_shared = (instance >= 0) & matte[instance] & (reflectance > 0)
    guides = Guides(
        np.where(is_shared, instance, np.int32(-1)), np.stack(position, -1), np.stack(shading_normal, -1), reflectance
    )
    return truth, guides


@dr.syntax
def mean_reflectance(view: View, settings: PathSettings, rig: Rig, has_cutouts: bool, samples: int) -> np.ndarray:
    """(h, w) float32, mean diffuse reflectance of the first surfaces behind a pixel's first samples."""
    launches, parts = Launches(), []
    surfaces, camera, shape = view.traced.surfaces, view.traced.camera, (rig.camera.height, rig.camera.width)
    count = np.full(shape[0] * shape[1], samples, np.uint32)
    allocation = SampleAllocation(np.arange(len(count)), count, count, rig.projector_irradiance)
    for begin, end in launches.ranges(len(count), samples):
        lanes = Lanes(view, settings, allocation, np.arange(begin, end))
        total, sample = dr.zeros(mi.Float, end - begin), dr.zeros(mi.UInt32, end - begin)
        most = dr.opaque(mi.UInt32, samples)
        while sample < most:
            place, lens = in_pairs(lanes.shift, lanes.lens_shift, sample, lanes.total)
            ray = camera.sample_ray(lanes.corner + place, lens)
            si = first_surface(surfaces, mi.Ray3f(ray.origin, ray.direction), has_cutouts)
            total += mono(si.bsdf().eval_diffuse_reflectance(si, si.is_valid()))
            sample += 1
        launches.evaluate(total, samples * (end - begin))
        parts.append(total.numpy() / np.float32(samples))
    return np.concatenate(parts).reshape(shape)


def _truth(traced: TracedScene, has_cutouts: bool, index_of: Any, transmits_of: Any, begin: int, end: int) -> list[Any]:
    """Of a range of pixels: hit, index of the shape, z, range, visibility, u, v, and three of each of the normal,
    the place from the camera, and the shading normal, and the diffuse reflectance."""
    camera = traced.camera
    ray = camera.centre_rays(begin, end)
    si = first_surface(traced.surfaces, mi.Ray3f(ray.origin, ray.direction), has_cutouts)
    hit = si.is_valid() if ray.exists is None else si.is_valid() & ray.exists
    to_camera = camera.centre - mi.Vector3f(si.p)
    normal = dr.select(dr.dot(si.n, to_camera) < 0, -si.n, si.n)
    link = connect(traced.scene, traced.projector, si, hit)
    uv = link.uv
    shape = number_of(si.shape)
    through = dr.gather(mi.Bool, transmits_of, shape, hit)
    visible = link.lit & (through | (dr.dot(normal, link.direction) > 0))
    z, distance = -dr.dot(to_camera, camera.z), dr.norm(to_camera)
    index = dr.gather(mi.Int32, index_of, shape, hit)
    seen = dr.normalize(si.sh_frame.n)
    reflectance = mono(si.bsdf().eval_diffuse_reflectance(si, hit))
    return [hit, index, z, distance, visible, uv.x, uv.y, *normal, *(-to_camera), *seen, reflectance]
