# SPDX-License-Identifier: Apache-2.0
"""Glint: the camera sees the projector's lens itself, in a mirror, through glass or directly.

The lens is a disc as large as its aperture. A camera path of delta interactions alone that meets it brings its full
radiance. Where all of a pixel sees the lens, that is 10^4 times the radiance of a lit wall, so a highlight much finer
than a pixel counts. Random paths of the pass would mostly miss it, hence three steps: pixels behind whose centre there
is a delta surface; of those, pixels of which a few probing paths come near the lens; and these get thousands of paths.
The lens is not seen through a medium that scatters: its boundary ends a path. Through glass that absorbs it is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.light_transport.accumulators import Accumulators
from rangesim.light_transport.device import Device
from rangesim.light_transport.kernel_launches import Launches, min_lanes
from rangesim.light_transport.photons import meets_delta
from rangesim.light_transport.sampling import Continued, Seed, aligned, of_part, random_stream, stratified
from rangesim.light_transport.scattering import bounded
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN, RayState, spawn_specular_ray, survival
from rangesim.light_transport.strategies import delta_only, is_delta, owner
from rangesim.light_transport.traced_scene import TracedScene
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
MAX_ENLARGEMENT = 16.0
"""Times the radius of the lens, of the disc that stands for it."""
MAX_PATHS = 1 << 22
"""Of all pixels together."""
PATHS_PER_PIXEL = (64, 4096)
"""Least and largest number."""
SCREENING, CLOSE = 8, 8.0
"""Fraction of the paths that look first, as its inverse; the others are sent where one of them came so close to the
centre of the lens, in radii. A lens that one path in 4000 hits has eight of 512 come as close; it is missed by chance
once in 3000 times."""
SEGMENTS = 4
"""Segments of a path, about, on which the size of launches rests."""


@dataclass(frozen=True, eq=False)
class Glint:
    """Glint of the n pixels that have any.

    pixel : (n,) int, flat index. radiance : (n,) float32, W/m2/sr. channels : response -> (c, n) float32.
    radiance_error, channels_error : a draw of the sampling error of each, see `rangesim.signals.SamplingError`.
    """

    pixel: np.ndarray
    radiance: np.ndarray
    channels: dict[Response, np.ndarray]
    radiance_error: np.ndarray
    channels_error: dict[Response, np.ndarray]

    def add_to(self, image: np.ndarray, values: np.ndarray) -> None:
        """Add `values` (c, n) to an image (c, h, w) in place."""
        image.reshape(len(image), -1)[:, self.pixel] += values


def trace_glint(
    traced: TracedScene,
    rig: Rig,
    responses: Sequence[Response],
    seed: int,
    report: Callable[[], None] = lambda: None,
) -> Glint:
    """What the camera of the rig sees of the projector's lens; `report` is called after each kernel launch."""
    view = GlintView(traced, Seed.of(seed))
    worth_probing = _worth_probing(traced, rig.camera.height, rig.camera.width)
    pixel, radius_m = _near_the_lens(view, rig, worth_probing, report)
    if len(pixel) == 0:
        nothing, none = np.zeros(0, np.float32), {r: np.zeros((r.channels, 0), np.float32) for r in responses}
        return Glint(pixel, nothing, none, nothing, none)
    paths = int(np.clip(MAX_PATHS // len(pixel), *PATHS_PER_PIXEL)) // 2  # of each half
    few = paths // SCREENING
    halves = [_sums(view, rig, responses, pixel, radius_m, half * paths, few, half, report) for half in (0, 1)]
    close = np.flatnonzero(np.minimum(*(half.nearest for half in halves)) < CLOSE)
    counts = np.full(len(pixel), np.float32(few))
    if len(close):
        for number, half in enumerate(halves):
            first, part = number * paths + few, 2 + number
            more = _sums(view, rig, responses, pixel[close], radius_m[close], first, paths - few, part, report)
            half.radiance[close] += more.radiance
            for response, values in half.channels.items():
                values[:, close] += more.channels[response]
        counts[close] = paths
    a, b = halves
    return Glint(
        pixel,
        (a.radiance + b.radiance) / (2 * counts),
        {r: (a.channels[r] + b.channels[r]) / (2 * counts) for r in responses},
        (a.radiance - b.radiance) / (2 * counts),
        {r: (a.channels[r] - b.channels[r]) / (2 * counts) for r in responses},
    )


class GlintSums(NamedTuple):
    """Sums over paths of n pixels: how near one came to the centre of the lens, in radii of the disc that stands for
    it; radiance; response -> (c, n) channels."""

    nearest: np.ndarray
    radiance: np.ndarray
    channels: dict[Response, np.ndarray]


def _sums(
    view: GlintView,
    rig: Rig,
    responses: Sequence[Response],
    pixel: np.ndarray,
    radius_m: np.ndarray,
    first: int,
    paths: int,
    part: int,
    report: Callable[[], None],
) -> GlintSums:
    """Sums over the paths of each pixel from number `first` on; each part has random numbers of its own."""
    nearest, total = (np.zeros(len(pixel), np.float32) for _ in range(2))
    radiance = rig.projector_irradiance / (np.pi * radius_m**2)
    accumulators, launches, projector = Accumulators(responses, len(pixel)), Launches(), view.traced.projector
    for begin, end in launches.ranges(len(pixel), SEGMENTS * paths, at_least=min_lanes()):
        some, n = slice(begin, end), end - begin
        lens = LensDisc(rig, projector, radius_m[some], radiance[some])
        lanes = GlintLanes(view, pixel[some], paths, begin, first, part)
        state = PathState(
            chain=lanes.start(),
            throughput=dr.ones(mi.Float, n),
            ray_state=RayState.start(view.traced._replace(media=None), n),  # boundaries of media end its paths
            channels=accumulators.zeros(n),
            total=dr.zeros(mi.Float, n),
            nearest=dr.full(mi.Float, dr.inf, n),
        )
        loop = partial(_paths_to_the_lens, lanes, lens, accumulators)
        state, _ = launches.run(loop, state, n, accumulators.pending, lambda state: report())
        accumulators.store(state.channels, some)
        total[some], nearest[some] = state.total.numpy(), state.nearest.numpy()
    channels = {r: parts[0] for r, parts in zip(responses, accumulators.images(), strict=True)}
    return GlintSums(nearest / radius_m.astype(np.float32), total, channels)


class GlintView(NamedTuple):
    """What the camera looks into, and the seed of its random numbers."""

    traced: TracedScene
    seed: Seed


@dataclass
class Chain:
    """Where a lane is in the delta chains of its pixel.

    random : UInt64, state of the random numbers. k : UInt32, chains finished. length : UInt32, surfaces of this one so
    far. origin, direction : the ray.
    """

    random: Any
    k: Any
    length: Any
    origin: Any
    direction: Any


class GlintLanes:
    """Pixels at work, a lane for each, and how many paths each of them sends.

    Parameters
    ----------
    view : GlintView
    pixel : (lanes,) int, flat indices.
    paths : int, for each pixel.
    first_place : int, the number of the first pixel in the accumulators.
    first, part : number of the first path, which gives them their place in the pixel; and of their random numbers.
    """

    def __init__(
        self, view: GlintView, pixel: np.ndarray, paths: int, first_place: int = 0, first: int = 0, part: int = 0
    ) -> None:
        self.traced, seed = view
        self.pixel, self.paths = mi.UInt32(aligned(pixel, np.uint32)), dr.opaque(mi.UInt32, paths)
        self.place = dr.arange(mi.UInt32, len(pixel)) + dr.opaque(mi.UInt32, first_place)
        rng = random_stream(seed, self.pixel ^ 0x85EBCA6B)
        self.shift = mi.Point2f(rng.next_float32(), rng.next_float32())
        self.first = dr.opaque(mi.UInt32, first)
        self.random = Continued(of_part(rng, dr.opaque(mi.UInt32, part)))
        width = mi.UInt32(self.traced.camera.size.x)
        self.corner = mi.Point2f(mi.Float(self.pixel % width), mi.Float(self.pixel // width))

    def start(self) -> Chain:
        """The lanes before their first path."""
        zero = dr.zeros(mi.UInt32, dr.width(self.pixel))
        nowhere = dr.zeros(mi.Vector3f, dr.width(self.pixel))
        return Chain(mi.UInt64(self.random.rng.state), zero, mi.UInt32(zero), mi.Point3f(nowhere), nowhere)


@dataclass
class ProbeState:
    """What a lane carries from one probing segment to the next; see `_probe`."""

    chain: Chain
    nearest: Any
    spread: Any
    before: Any


@dataclass
class PathState:
    """What a lane carries from one segment of its paths to the lens to the next; see `_paths_to_the_lens`."""

    chain: Chain
    throughput: Any
    ray_state: RayState
    channels: list[list[Any]]
    total: Any
    nearest: Any


class LensDisc:
    """The projector's lens as the camera may see it: a disc that faces along the projector's axis.

    Where a curved mirror makes its image too small for a pixel's paths to hit, a larger and dimmer disc stands for it:
    `radius_m` and `radiance`, for each pixel. What the pixel receives is the same.
    """

    def __init__(self, rig: Rig, projector: Device, radius_m: np.ndarray, radiance: np.ndarray) -> None:
        self.projector = projector
        self.radius = mi.Float(aligned(radius_m, np.float32))
        self.radiance = mi.Float(aligned(radiance, np.float32))

    def offset(self, ray: Any, si: Any) -> tuple[Any, Any, Any]:
        """Where the ray crosses the plane of the lens, metres from its centre; the way there; and whether it does."""
        z, centre = self.projector.z, self.projector.centre
        slope = -dr.dot(ray.d, z)
        t = dr.dot(mi.Vector3f(ray.o) - centre, z) / slope
        point = mi.Vector3f(ray(t)) - centre
        across = mi.Point2f(dr.dot(point, self.projector.x), dr.dot(point, self.projector.y))
        return across, t, (slope > 0) & (t > 0) & (t < si.t)


def _worth_probing(traced: TracedScene, h: int, w: int) -> np.ndarray:
    """Flat indices of the pixels around whose centre there is a delta surface, or the lens in plain view."""
    meets, exists = meets_delta(traced.scene, traced.camera)
    mask = meets.reshape(h, w)
    uv, z = traced.camera.project(mi.Point3f(traced.projector.centre))
    u, v = float(uv.x[0]), float(uv.y[0])
    if float(z[0]) > 0 and 0 <= u < w and 0 <= v < h:
        mask[int(v), int(u)] = True
    return np.flatnonzero(binary_dilation(mask, np.ones((3, 3))) & exists.reshape(h, w))


def _near_the_lens(
    view: GlintView, rig: Rig, pixel: np.ndarray, report: Callable[[], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Those of the pixels whose probes come near the lens, as measured by how far they spread; and for each of them
    the radius in metres of the disc to hit."""
    aperture = np.full(len(pixel), rig.projector_lens.aperture_radius_m)
    lens = LensDisc(rig, view.traced.projector, aperture[:1], aperture[:1])
    nearest, spread = np.empty(len(pixel), np.float32), np.empty(len(pixel), np.float32)
    launches = Launches()
    for begin, end in launches.ranges(len(pixel), SEGMENTS * PROBES, at_least=min_lanes()):
        some, n = slice(begin, end), end - begin
        lanes, far = GlintLanes(view, pixel[some], PROBES), dr.full(mi.Float, dr.inf, n)
        state = ProbeState(lanes.start(), far, mi.Float(far), dr.full(mi.Point2f, dr.inf, n))
        state, _ = launches.run(partial(_probe, lanes, lens), state, n, report=lambda state: report())
        nearest[some], spread[some] = state.nearest.numpy(), state.spread.numpy()
    spread = np.where(np.isfinite(spread), spread, np.float32(UNKNOWN_SPREAD * rig.projector_lens.aperture_radius_m))
    near = nearest < aperture + NEAR * spread
    return pixel[near], np.clip(FINEST * spread, aperture, MAX_ENLARGEMENT * aperture)[near]


@dr.syntax
def _probe(lanes: GlintLanes, lens: LensDisc, state: ProbeState, most: Any) -> tuple[ProbeState, Any]:
    """The state after at most so many iterations, and those taken: the least distance at which each pixel's delta paths
    pass the lens's centre, and how far apart they cross its plane (infinite where fewer than two do).

    Where light splits into reflection and refraction, probes take both alike, however faint one is.
    """
    traced = lanes.traced
    random, k, chain = state.chain.random, state.chain.k, state.chain.length
    origin, direction = state.chain.origin, state.chain.direction
    nearest, spread, before = state.nearest, state.spread, state.before  # where the last one crossed
    context = delta_only(mi.TransportMode.Radiance)
    left = most + dr.zeros(mi.UInt32, dr.width(k))  # iterations
    while (k < lanes.paths) & (left > 0):
        rng = lanes.random.at(random)
        primary = traced.camera.centre_ray(lanes.corner + stratified(lanes.shift, k))
        ray = mi.Ray3f(
            dr.select(chain == 0, primary.origin, origin), dr.select(chain == 0, primary.direction, direction)
        )
        si = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False)
        across, _, crosses = lens.offset(ray, si)
        nearest = dr.select(crosses, dr.minimum(nearest, dr.norm(across)), nearest)
        # The least step, because probes that went another way are far off and say nothing
        spread = dr.select(crosses, dr.minimum(spread, dr.norm(across - before)), spread)
        before = dr.select(crosses, across, before)
        hit = si.is_valid() & ~bounded(traced.media, si)
        way = dr.select(rng.next_float32() < 0.5, mi.Float(0), mi.Float(0.9999))
        bs, weight = si.bsdf(ray).sample(context, si, way, mi.Point2f(0.5), hit)
        ray = spawn_specular_ray(si, si.p, si.to_world(bs.wo))
        chain += 1
        ends = (
            ~hit
            | ~owner(has_vertex=~is_delta(bs), delta_interactions=chain).glint
            | (mono(weight) <= 0)
            | (chain >= MAX_CHAIN)
        )
        chain = dr.select(ends, 0, chain)
        k = dr.select(ends, k + 1, k)
        random, origin, direction = rng.state, ray.o, ray.d
        left -= 1
    return ProbeState(Chain(random, k, chain, origin, direction), nearest, spread, before), most - left


@dr.syntax
def _paths_to_the_lens(
    lanes: GlintLanes, lens: LensDisc, accumulators: Accumulators, state: PathState, most: Any
) -> tuple[PathState, Any]:
    """The state after at most so many iterations, and those taken: dense channels and radiance of the delta paths
    from each pixel to the lens; bins go to the accumulators."""
    traced, camera = lanes.traced, lanes.traced.camera
    random, k, chain = state.chain.random, state.chain.k, state.chain.length
    origin, direction = state.chain.origin, state.chain.direction
    throughput, ray_state, channels, total, nearest = (
        state.throughput,
        state.ray_state,
        state.channels,
        state.total,
        state.nearest,
    )
    context = delta_only(mi.TransportMode.Radiance)
    left = most + dr.zeros(mi.UInt32, dr.width(k))  # iterations
    while (k < lanes.paths) & (left > 0):
        rng = lanes.random.at(random)
        # ---- The next path starts at the camera ------------------------------------------------------
        starts = chain == 0
        on_lens = (
            mi.Point2f(rng.next_float32(), rng.next_float32()) if dr.hint(camera.has_lens, mode="scalar") else None
        )
        primary = camera.sample_ray(lanes.corner + stratified(lanes.shift, lanes.first + k), on_lens)
        ray = mi.Ray3f(dr.select(starts, primary.origin, origin), dr.select(starts, primary.direction, direction))
        ray_state = ray_state.restarted(starts, primary.origin, primary.path_offset)
        si = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False)

        # ---- Does this segment meet the lens? --------------------------------------------------------
        across, way, crosses = lens.offset(ray, si)
        uv, z = lens.projector.project(ray_state.previous)
        size = lens.projector.size
        nearest = dr.select(crosses, dr.minimum(nearest, dr.norm(across)), nearest)
        meets = crosses & (dr.norm(across) < lens.radius) & (z > 0)
        meets &= (uv.x >= 0) & (uv.x < size.x) & (uv.y >= 0) & (uv.y < size.y)
        # Intensity E / cos^3 of the pinhole, from a disc that looks smaller by cos
        cosine = -dr.dot(ray.d, lens.projector.z)
        radiance = (
            throughput * lens.radiance * lens.projector.relative_illumination(-ray.d) / dr.square(dr.square(cosine))
        )
        radiance = dr.select(meets, radiance * lens.projector.pixel_density(-ray.d), 0)
        u, v, path_length = (dr.select(meets, x, 0) for x in (uv.x, uv.y, dr.fma(ray_state.ior, way, ray_state.length)))
        path = LightPath(u, v, path_length, dr.full(mi.Bool, False, dr.width(k)), mi.UInt32(GLINT))
        channels = accumulators.add(channels, path, radiance, lanes.place, meets)
        total += radiance

        # ---- On through delta interactions, or the next path -----------------------------------------
        hit = si.is_valid() & ~meets & ~bounded(traced.media, si)
        ray_state.length = ray_state.length_to(si.p, hit)
        if dr.hint(traced.absorbers is not None, mode="scalar"):
            throughput *= ray_state.unabsorbed(traced, si.p, hit)
        bs, weight = si.bsdf(ray).sample(
            context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), hit
        )
        throughput *= mono(weight)
        ray_state = ray_state.refracted(bs, hit).restarted(True, si.p, ray_state.length)
        ray = spawn_specular_ray(si, si.p, si.to_world(bs.wo))
        chain += 1
        chance = survival(chain, throughput * dr.square(ray_state.ior))
        ends = (
            ~hit
            | ~owner(has_vertex=~is_delta(bs), delta_interactions=chain).glint
            | (throughput <= 0)
            | (chain >= MAX_CHAIN)
        )
        ends |= rng.next_float32() >= chance
        throughput /= chance
        ray_state = ray_state.entering(traced, si, ray.d, hit, mi.Bool(False)).reset(traced, ends)
        chain, k = dr.select(ends, 0, chain), dr.select(ends, k + 1, k)
        throughput = dr.select(ends, 1, throughput)
        random, origin, direction = rng.state, ray.o, ray.d
        left -= 1
    at = Chain(random, k, chain, origin, direction)
    return PathState(at, throughput, ray_state, channels, total, nearest), most - left
