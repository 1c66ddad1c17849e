# SPDX-License-Identifier: Apache-2.0
"""Glint: the camera sees the projector's lens itself, in a mirror, through glass or directly.

The lens is a disc as large as its aperture. A camera path of delta interactions alone that meets it brings its full
radiance. Where all of a pixel sees the lens, that is 10^4 times the radiance of a lit wall, so a highlight much finer
than a pixel counts. Random paths of the pass would mostly miss it, hence three steps: pixels behind whose centre there
is a delta surface; of those, pixels of which a few probing paths come near the lens; and these get thousands of paths.
The lens is not seen through a participating medium: its boundary ends a path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.light_transport.device import Device
from rangesim.light_transport.exact_point import spawn_close
from rangesim.light_transport.loop import mono
from rangesim.light_transport.medium import Media, bounded
from rangesim.light_transport.photon_flight import MAX_CHAIN
from rangesim.light_transport.photons import meets_delta
from rangesim.light_transport.responses import Accumulators
from rangesim.light_transport.sampling import Seed, random_stream, stratified
from rangesim.response import GLINT, LightPath, Response
from rangesim.rig import Rig

PROBES = 32
"""Probing paths per pixel."""
NEAR = 1.5
"""Times the spread of a pixel's probes, within which the lens counts as near."""
UNKNOWN_SPREAD = 8.0
"""Radii of the lens; stands for the spread where but one probe crossed its plane."""
FINEST = 0.2
"""Times the spread, the radius of the smallest disc that a pixel's paths hit well: about a tenth of the pixel."""
MOST_ENLARGED = 16.0
"""Times the radius of the lens, of the disc that stands for it."""
MOST_PATHS = 1 << 22
"""Of all pixels together."""
PATHS_PER_PIXEL = (64, 4096)
"""Fewest and most."""


@dataclass(frozen=True, eq=False)
class Glint:
    """Glint of the n pixels that have any.

    pixel : (n,) int, flat index. radiance : (n,) float32, W/m2/sr. channels : per response (c, n) float32.
    """

    pixel: np.ndarray
    radiance: np.ndarray
    channels: list[np.ndarray]

    def add_to(self, image: np.ndarray, values: np.ndarray) -> None:
        """Add `values` (c, n) to an image (c, h, w) in place."""
        image.reshape(len(image), -1)[:, self.pixel] += values


def trace_glint(scene: Any, rig: Rig, responses: Sequence[Response], seed: int, media: Media | None = None) -> Glint:
    """What the camera of the rig sees of the projector's lens."""
    camera, projector = Device.camera(rig), Device.projector(rig)
    h, w = rig.camera.height, rig.camera.width
    worth_probing = _worth_probing(scene, camera, projector, h, w, media)
    pixel, radius_m = _near_the_lens(scene, rig, camera, projector, worth_probing, seed, media)
    accumulators = Accumulators(responses, max(1, len(pixel)))
    if len(pixel) == 0:
        return Glint(pixel, np.zeros(0, np.float32), [np.zeros((r.channels, 0), np.float32) for r in responses])
    paths = int(np.clip(MOST_PATHS // len(pixel), *PATHS_PER_PIXEL))
    lens = Lens(rig, projector, radius_m, rig.projector_irradiance / (np.pi * radius_m**2) / paths)
    dense, total = _paths_to_the_lens(scene, camera, lens, accumulators, *_lanes(pixel, seed, paths), media)
    channels, sums = accumulators.images(dense, [total])
    return Glint(pixel, sums[0], channels)


class Lens:
    """The projector's lens as the camera may see it: a disc that faces along the projector's axis.

    Where a curved mirror makes its image too small for a pixel's paths to hit, a larger and dimmer disc stands for it:
    `radius_m` and `radiance`, for each pixel. What the pixel receives is the same.
    """

    def __init__(self, rig: Rig, projector: Device, radius_m: np.ndarray, radiance: np.ndarray) -> None:
        self.projector = projector
        self.radius = mi.Float(np.float32(radius_m))
        self.radiance = mi.Float(np.float32(radiance))

    def offset(self, ray: Any, si: Any) -> tuple[Any, Any, Any]:
        """Where the ray crosses the plane of the lens, metres from its centre; the way there; and whether it does."""
        z, centre = self.projector.z, self.projector.centre
        slope = -dr.dot(ray.d, z)
        t = dr.dot(mi.Vector3f(ray.o) - centre, z) / slope
        point = mi.Vector3f(ray(t)) - centre
        across = mi.Point2f(dr.dot(point, self.projector.x), dr.dot(point, self.projector.y))
        return across, t, (slope > 0) & (t > 0) & (t < si.t)


def _worth_probing(scene: Any, camera: Device, projector: Device, h: int, w: int, media: Media | None) -> np.ndarray:
    """Flat indices of the pixels around whose centre there is a delta surface, or the lens in plain view."""
    rays = camera.centre_rays()
    mask = meets_delta(scene, rays, media).reshape(h, w)
    uv, z = camera.project(mi.Point3f(projector.centre))
    u, v = float(uv.x[0]), float(uv.y[0])
    if float(z[0]) > 0 and 0 <= u < w and 0 <= v < h:
        mask[int(v), int(u)] = True
    mask = binary_dilation(mask, np.ones((3, 3)))
    if rays.exists is not None:  # a distorted lens may send no ray through some pixels
        mask &= rays.exists.numpy().reshape(h, w)
    return np.flatnonzero(mask)


def _near_the_lens(
    scene: Any, rig: Rig, camera: Device, projector: Device, pixel: np.ndarray, seed: int, media: Media | None
) -> tuple[np.ndarray, np.ndarray]:
    """Those of the pixels whose probes come near the lens, as measured by how far they spread; and for each of them
    the radius in metres of the disc to hit."""
    aperture = np.full(len(pixel), rig.projector_aperture_radius_m)
    if len(pixel) == 0:
        return pixel, aperture
    lens = Lens(rig, projector, aperture, aperture)
    nearest, spread = _probe(scene, camera, lens, *_lanes(pixel, seed, PROBES), media)
    dr.eval([nearest, spread])
    near = nearest.numpy() < aperture + NEAR * spread.numpy()
    return pixel[near], np.clip(FINEST * spread.numpy(), aperture, MOST_ENLARGED * aperture)[near]


def _lanes(pixel: np.ndarray, seed: int, paths: int) -> tuple[Any, Any, Any]:
    """Pixels, their random numbers, and the number of paths, on the renderer's side."""
    lanes = mi.UInt32(pixel.astype(np.uint32))
    rng = random_stream(Seed.of(seed), lanes ^ 0x85EBCA6B)
    return lanes, rng, dr.opaque(mi.UInt32, paths)


@dr.syntax
def _probe(
    scene: Any, camera: Device, lens: Lens, pixel: Any, rng: Any, paths: Any, media: Media | None = None
) -> tuple[Any, Any]:
    """Least distance at which each pixel's delta paths pass the lens's centre, and how far apart they cross its plane.

    Where light splits into reflection and refraction, probes take both alike, however faint one is.
    """
    lanes = dr.width(pixel)
    nearest, spread = dr.full(mi.Float, dr.inf, lanes), dr.full(mi.Float, dr.inf, lanes)
    before = dr.full(mi.Point2f, dr.inf, lanes)  # where the last one crossed
    shift, width = mi.Point2f(rng.next_float32(), rng.next_float32()), mi.UInt32(camera.size.x)
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Delta
    k, chain = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes)
    ray = mi.Ray3f(dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes))
    while k < paths:
        primary = camera.centre_ray(corner + stratified(shift, k))
        ray.o, ray.d = dr.select(chain == 0, primary.origin, ray.o), dr.select(chain == 0, primary.direction, ray.d)
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False)
        across, _, crosses = lens.offset(ray, si)
        nearest = dr.select(crosses, dr.minimum(nearest, dr.norm(across)), nearest)
        # The least step, because probes that went another way are far off and say nothing
        spread = dr.select(crosses, dr.minimum(spread, dr.norm(across - before)), spread)
        before = dr.select(crosses, across, before)
        hit = si.is_valid() & ~bounded(media, si)
        way = dr.select(rng.next_float32() < 0.5, mi.Float(0), mi.Float(0.9999))
        bs, weight = si.bsdf(ray).sample(context, si, way, mi.Point2f(0.5), hit)
        ray = spawn_close(si, si.p, si.to_world(bs.wo))
        chain += 1
        ends = ~hit | ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) | (mono(weight) <= 0) | (chain >= MAX_CHAIN)
        chain = dr.select(ends, 0, chain)
        k = dr.select(ends, k + 1, k)
    return nearest, dr.select(dr.isfinite(spread), spread, UNKNOWN_SPREAD * lens.radius)


@dr.syntax
def _paths_to_the_lens(
    scene: Any,
    camera: Device,
    lens: Lens,
    accumulators: Accumulators,
    pixel: Any,
    rng: Any,
    paths: Any,
    media: Media | None = None,
) -> tuple[list[list[Any]], Any]:
    """Dense channels and radiance of the delta paths from each pixel to the lens; bins go to the accumulators."""
    lanes = dr.width(pixel)
    lane = dr.arange(mi.UInt32, lanes)
    shift, width = mi.Point2f(rng.next_float32(), rng.next_float32()), mi.UInt32(camera.size.x)
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    channels, total = accumulators.zeros(), dr.zeros(mi.Float, lanes)
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Delta
    k, chain = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes)
    ray = mi.Ray3f(dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes))
    throughput, length, ior = dr.ones(mi.Float, lanes), dr.zeros(mi.Float, lanes), dr.ones(mi.Float, lanes)
    previous = dr.zeros(mi.Point3f, lanes)
    while k < paths:
        # ---- The next path starts at the camera ------------------------------------------------------
        starts = chain == 0
        on_lens = (
            mi.Point2f(rng.next_float32(), rng.next_float32()) if dr.hint(camera.has_lens, mode="scalar") else None
        )
        primary = camera.sample_ray(corner + stratified(shift, k), on_lens)
        ray.o, ray.d = dr.select(starts, primary.origin, ray.o), dr.select(starts, primary.direction, ray.d)
        previous, length = dr.select(starts, primary.origin, previous), dr.select(starts, primary.lead, length)
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False)

        # ---- Does this segment meet the lens? --------------------------------------------------------
        across, way, crosses = lens.offset(ray, si)
        uv, z = lens.projector.project(previous)
        size = lens.projector.size
        meets = crosses & (dr.norm(across) < lens.radius) & (z > 0)
        meets &= (uv.x >= 0) & (uv.x < size.x) & (uv.y >= 0) & (uv.y < size.y)
        # Intensity E / cos^3 of the pinhole, from a disc that looks smaller by cos
        cosine = -dr.dot(ray.d, lens.projector.z)
        radiance = (
            throughput * lens.radiance * lens.projector.relative_illumination(-ray.d) / dr.square(dr.square(cosine))
        )
        radiance = dr.select(meets, radiance * lens.projector.pixel_density(-ray.d), 0)
        u, v, path_length = (dr.select(meets, x, 0) for x in (uv.x, uv.y, dr.fma(ior, way, length)))
        path = LightPath(u, v, path_length, dr.full(mi.Bool, False, lanes), mi.UInt32(GLINT))
        channels = accumulators.add(channels, path, radiance, lane, meets)
        total += radiance

        # ---- On through delta interactions, or the next path -----------------------------------------
        hit = si.is_valid() & ~meets & ~bounded(media, si)
        length = dr.select(hit, dr.fma(ior, dr.norm(si.p - previous), length), length)
        bs, weight = si.bsdf(ray).sample(
            context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), hit
        )
        throughput *= mono(weight)
        ior = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission), ior * bs.eta, ior)
        previous = mi.Point3f(si.p)
        ray = spawn_close(si, si.p, si.to_world(bs.wo))
        chain += 1
        ends = ~hit | ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) | (throughput <= 0) | (chain >= MAX_CHAIN)
        chain, k = dr.select(ends, 0, chain), dr.select(ends, k + 1, k)
        throughput, ior = dr.select(ends, 1, throughput), dr.select(ends, 1, ior)
    return channels, total
