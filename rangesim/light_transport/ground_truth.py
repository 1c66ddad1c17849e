# SPDX-License-Identifier: Apache-2.0
"""Ground truth of each pixel, found with one camera ray through its centre and one shadow ray to the projector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.cutouts import first_surface
from rangesim.light_transport.first_scatterer import FirstScatterers
from rangesim.light_transport.indirect_filter import FIRST_CHAIN, Guides
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.loop import Lanes, PathSettings, SampleAllocation, View
from rangesim.light_transport.sampling import in_pairs
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.rig import Rig
from rangesim.scene import Scene
from rangesim.scene.materials import MATERIAL_CLASSES, transmits
from rangesim.scene.media import is_boundary
from rangesim.signals import GroundTruth

PIXELS_PER_ITERATION = 3
"""Number of pixels whose ground truth takes as long as an iteration of the path loop: 2.2 to 3 on matte, tabletop and
glassware, with caustics and without. It decides on the size of the first launch of the loop, and nothing else."""


class CentreRays(NamedTuple):
    """Result of the rays through the pixels' centres.

    truth : GroundTruth.
    guides : Guides of the filter of indirect light; None if there is none.
    branches : (h, w) uint32, `Scatterer.branches`; None if no pixel has any.
    """

    truth: GroundTruth
    guides: Guides | None
    branches: np.ndarray | None


def ground_truth(scene: Scene, traced: TracedScene, rig: Rig, has_guides: bool, of_paths: Launches) -> CentreRays:
    """The ground truth of the camera's image; the guides of the filter of indirect light if it `has_guides`; and the
    branches of the main chains.

    All describe what the ray through each pixel's centre meets; see `rangesim.signals.GroundTruth`. `of_paths`, the
    launches of the path loop, learn how fast the machine traces rays in this scene.
    """
    h, w = rig.camera.height, rig.camera.width
    launches, shapes = Launches(), scene.mitsuba.shapes()
    scatterers = FirstScatterers(scene.mitsuba, traced.surfaces)
    transmits_of = mi.Bool(table_of(scene.mitsuba, [is_boundary(s) or transmits(s.bsdf()) for s in shapes]))
    parts = []
    for begin, end in launches.ranges(h * w):
        part = _first_surfaces(traced, scene.has_cutouts, scatterers, transmits_of, begin, end, has_guides)
        of_paths.learn((end - begin) // PIXELS_PER_ITERATION, launches.evaluate(part, end - begin))
        parts.append(part)

    def image(name: str) -> np.ndarray:
        """A field of the surfaces as an image, (h, w) or (h, w, components)."""
        values = [getattr(part, name) for part in parts]
        components = values[0].shape[:-1]
        return np.concatenate([dr.ravel(value).numpy() for value in values]).reshape(h, w, *components)

    instance = image("index")
    materials = np.array([MATERIAL_CLASSES.index(i.material) for i in scene.instances], dtype=np.int32)
    truth = GroundTruth(
        z=image("z"),
        range_m=image("range_m"),
        normal=image("normal"),
        instance=instance,
        material=np.where(instance >= 0, materials[instance], -1).astype(np.int32),
        projector_uv=image("uv"),
        projector_visible=image("visible"),
        instance_names=tuple(i.name for i in scene.instances),
        material_names=MATERIAL_CLASSES,
        instance_objects=tuple(i.object_name for i in scene.instances),
    )
    branches = image("branches") if scatterers.has_branches else None
    branches = branches if branches is not None and branches.any() else None
    if not has_guides:
        return CentreRays(truth, None, branches)
    reflectance = image("reflectance")
    first, cosine, number = image("position"), scatterers.cosines[image("scatterer")], image("scatterer")
    if scatterers.has_chains:
        chain = image("chain")
        number = np.where(chain > 0, FIRST_CHAIN | (chain % FIRST_CHAIN).astype(np.int32), number)
    guides = Guides(
        instance=np.where((cosine >= 0) & (reflectance > 0), number, np.int32(-1)),
        position=image("scatterer_position") if scatterers.has_chains else first,
        normal=image("shading_normal"),
        reflectance=reflectance,
        first=first,
        cosine=cosine,
    )
    return CentreRays(truth, guides, branches)


@dr.syntax
def mean_reflectance(view: View, settings: PathSettings, rig: Rig, has_cutouts: bool, samples: int) -> np.ndarray:
    """(h, w) float32, reflectance of the first surface that scatters, averaged over the first samples of each pixel."""
    launches, parts, scatterers = Launches(), [], FirstScatterers(view.traced.scene, view.traced.surfaces)
    surfaces, camera, shape = view.traced.surfaces, view.traced.camera, (rig.camera.height, rig.camera.width)
    count = np.full(shape[0] * shape[1], samples, np.uint32)
    allocation = SampleAllocation(np.arange(len(count)), count, count, rig.projector_irradiance)
    for begin, end in launches.ranges(len(count), samples):
        lanes = Lanes(view, settings, allocation, np.arange(begin, end))
        total, sample = dr.zeros(mi.Float, end - begin), dr.zeros(mi.UInt32, end - begin)
        most = dr.opaque(mi.UInt32, samples)
        while sample < most:
            place, lens = in_pairs(lanes.shift, lanes.lens_shift, sample, lanes.total)
            ray = camera.ray_in(lanes.corner, place, lens)
            si = first_surface(surfaces, mi.Ray3f(ray.origin, ray.direction), has_cutouts)
            seen = scatterers.behind(si, si.is_valid())
            total += scatterers.reflectance(seen.si, seen.index >= 0)
            sample += 1
        launches.evaluate(total, samples * (end - begin))
        parts.append(total.numpy() / np.float32(samples))
    return np.concatenate(parts).reshape(shape)


@dataclass
class FirstSurfaces:
    """The first surface behind the centre of each of n pixels. It is a dataclass, because Dr.Jit does not evaluate
    named tuples.

    index : Int32, index of its shape in the scene; -1 if there is no such surface, in which case z, range_m, uv and
        normal are NaN, and the other fields mean nothing.
    z, range_m : Float, metres, depth, and distance from the camera.
    visible : Bool, whether the projector lights the side that the camera sees.
    uv : Point2f, projector pixel coordinates.
    normal : Vector3f, unit, world, geometric normal on the side of the camera.
    position : Vector3f, metres, from the camera's centre, along the axes of the world; None without guides, as below.
    scatterer : Int32, index of the shape that scatters first, behind glass and mirrors; -1 for none. The fields that
        follow describe it.
    chain : UInt32, number of the chain up to it, see `Scatterer`.
    scatterer_position : Vector3f, as `position`.
    shading_normal : Vector3f, unit, world.
    reflectance : Float, see `FirstScatterers.reflectance`.
    branches : UInt32, see `Scatterer.branches`; None in scenes without clear glass.
    """

    index: mi.Int32
    z: mi.Float
    range_m: mi.Float
    visible: mi.Bool
    uv: mi.Point2f
    normal: mi.Vector3f
    position: mi.Vector3f | None
    scatterer: mi.Int32 | None
    chain: mi.UInt32 | None
    scatterer_position: mi.Vector3f | None
    shading_normal: mi.Vector3f | None
    reflectance: mi.Float | None
    branches: mi.UInt32 | None


def _first_surfaces(
    traced: TracedScene,
    has_cutouts: bool,
    scatterers: FirstScatterers,
    transmits_of: mi.Bool,
    begin: int,
    end: int,
    has_guides: bool,
) -> FirstSurfaces:
    """The first surfaces behind the centres of the pixels `begin` to `end` - 1, row by row.

    `transmits_of` is a table (`table_of`): whether light goes through a shape.
    """
    camera = traced.camera
    ray = camera.centre_rays(begin, end)
    si = first_surface(traced.surfaces, mi.Ray3f(ray.origin, ray.direction), has_cutouts)
    hit = si.is_valid() if ray.exists is None else si.is_valid() & ray.exists
    to_camera = mi.Vector3f(ray.origin) - mi.Vector3f(si.p)
    normal = dr.select(dr.dot(si.n, to_camera) < 0, -si.n, si.n)
    pixel = dr.arange(mi.UInt32, end - begin) + dr.opaque(mi.UInt32, begin)
    link = traced.projector.connect(traced.scene, si, hit, pixel, cutouts=traced.cutouts)
    through = dr.gather(mi.Bool, transmits_of, number_of(si.shape), hit)
    seen = scatterers.behind(si, hit)  # traced only if its fields are asked for
    return FirstSurfaces(
        index=dr.select(hit, scatterers.index(si, hit), -1),
        z=dr.select(hit, dr.dot(mi.Vector3f(si.p) - camera.centre, camera.z), dr.nan),
        range_m=dr.select(hit, dr.norm(to_camera), dr.nan),
        visible=link.lit & (through | (dr.dot(normal, link.direction) > 0)),
        uv=dr.select(hit, link.uv, dr.nan),
        normal=mi.Vector3f(dr.select(hit, normal, dr.nan)),
        position=-to_camera if has_guides else None,
        scatterer=seen.index if has_guides else None,
        chain=seen.chain if has_guides else None,
        scatterer_position=mi.Vector3f(seen.si.p) - mi.Vector3f(ray.origin) if has_guides else None,
        shading_normal=mi.Vector3f(dr.normalize(seen.si.sh_frame.n)) if has_guides else None,
        reflectance=scatterers.reflectance(seen.si, seen.index >= 0) if has_guides else None,
        branches=seen.branches if scatterers.has_branches else None,
    )
