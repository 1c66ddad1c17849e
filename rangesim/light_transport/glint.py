# SPDX-License-Identifier: Apache-2.0
"""Glint: the camera sees the projector's lens itself, in a mirror, through glass or directly.

The lens is a disc as large as its aperture. A camera path of delta interactions alone that meets it brings its full
radiance. A pixel that sees nothing but the lens has 10^4 times the radiance of a lit wall, so even a highlight much
finer than a pixel matters. Random paths of the pass would mostly miss it. Three steps find it:

1. A pixel is chosen if there is a delta surface behind its centre or behind the centre of a neighbour.
2. A few probing paths of each chosen pixel tell how near to the lens its paths come, and how far they spread.
3. Pixels whose paths come near the lens get more and more paths, up to thousands.

The lens is not seen through a medium that scatters, because the boundary of the medium ends a path. The lens is seen
through glass that absorbs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.light_transport.accumulators import Accumulators
from rangesim.light_transport.camera_rays import Device
from rangesim.light_transport.delta_surfaces import meets_delta
from rangesim.light_transport.kernel_launches import Launches, min_lanes
from rangesim.light_transport.sampling import Continued, Seed, aligned, of_part, random_stream, stratified
from rangesim.light_transport.scattering import bounded
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN, RayState, spawn_specular_ray, survival
from rangesim.light_transport.strategies import delta_only, is_delta, owner
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.response import GLINT, LightPath, Response
from rangesim.rig import Rig

PROBES = 32
"""Number of probing paths per pixel. It is small, because all pixels around glass and mirrors are probed. With fewer
probes, more images of the lens are missed."""
NEAR_SPREADS = 1.5
"""A pixel counts as near the lens if a probe passes the edge of the lens at less than this number of spreads. The
spread is the least distance between the places at which successive probes cross the plane of the lens. A larger value
sends paths to pixels that do not see the lens."""
UNKNOWN_SPREAD = 8.0
"""Spread, in radii of the lens, of pixels whose spread is not measured because only one probe crossed the plane of the
lens."""
MIN_RADIUS_SPREADS = 0.2
"""Radius, in spreads, of the smallest disc that stands for the lens. Such a disc covers about a tenth of the pixel, so
that enough of the pixel's paths hit it. A larger one may reach into pixels that do not see the lens."""
MAX_ENLARGEMENT = 16.0
"""Largest radius, in radii of the lens, of the disc that stands for it. A larger disc is hit by more paths, but may
reach into pixels that do not see the lens."""
MAX_PATHS = 1 << 22
"""Largest number of paths of all pixels together, so that the time is bounded: 2 to 3 s among 10 000 balls on two cores
(docs/benchmarks.md)."""
MIN_PATHS_PER_PIXEL = 64
"""Smallest number of paths per pixel, however many pixels there are, because fewer would make glint noisy."""
PATHS_PER_SAMPLE = 64
"""Largest number of paths per pixel for each of its samples, so that a pass of few samples is quick."""
MAX_PATHS_PER_PIXEL = 4096
"""Largest number of paths per pixel, however few pixels there are, so that a single highlight takes little time."""
SCREENING = 8
"""Ratio of all paths of a pixel to those that are sent first, a power of two. The number of paths then doubles as long
as one of them came close, so that pixels which do not see the lens cost little."""
CLOSE_RADII = 8.0
"""Distance from the centre of the lens, in its radii, at which one of the first paths counts as close. If one path in
4000 hits the lens, 64 in 4000 come that close, so 8 of the first 512 do; all of them miss by chance once in 3000 times.
With n times as many paths the distance is smaller by the square root of n, and as many are expected. Doubling takes
0.69 of the paths that all at once would take, and loses 0.006 % of the light of 30 random scenes."""
LANES = 8
"""Number of lanes that share the paths of a pixel, half of them for each half of the paths. Lanes of one pixel meet the
same surfaces and take about as long, so a vector of lanes is rarely idle. With 16, `MIN_PATHS_PER_PIXEL` would have to
be larger."""
MAX_LANES = 1 << 16
"""Largest number of lanes of a launch, so that a histogram of 256 bins for each of them takes 64 MiB at most."""
SEGMENTS = 4
"""Number of segments per path that is assumed when the size of a launch is chosen. Launches adapt to the time they
take, so that a wrong number costs little."""


@dataclass(frozen=True, eq=False)
class Glint:
    """Glint of the n pixels that may see the projector's lens.

    pixel : (n,) int, flat indices in the image.
    radiance : (n,) float32, W/m2/sr.
    channels : response -> (c, n) float32, contributions to its channels.
    radiance_error, channels_error : one draw of the sampling error of each, see `rangesim.signals.SamplingError`.
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
    samples: int,
    report: Callable[[], None] = lambda: None,
) -> Glint:
    """The glint that the camera of the rig sees.

    Parameters
    ----------
    traced, rig : TracedScene and Rig, in coordinates of the renderer.
    responses : the responses whose channels are returned.
    seed : int, 0 to 2^64 - 1.
    samples : int, number of samples of a pixel in the pass, which bounds its number of paths.
    report : called after each kernel launch.
    """
    view = GlintView(traced, Seed.of(seed))
    worth_probing = _worth_probing(traced, rig.camera.height, rig.camera.width)
    pixel, radius_m = _near_the_lens(view, rig, worth_probing, report)
    if len(pixel) == 0:
        nothing, none = np.zeros(0, np.float32), {r: np.zeros((r.channels, 0), np.float32) for r in responses}
        return Glint(pixel, nothing, none, nothing, none)
    most = min(max(PATHS_PER_SAMPLE * samples, MIN_PATHS_PER_PIXEL), MAX_PATHS_PER_PIXEL)
    per_pixel = int(np.clip(MAX_PATHS // len(pixel), MIN_PATHS_PER_PIXEL, most))
    few = per_pixel // (LANES * SCREENING)  # of each lane
    send = partial(_sums, view, rig, responses, of_lane=SCREENING * few, report=report)
    sums, sent = send(pixel, radius_m, 0, few), np.full(len(pixel), few)
    close = np.arange(len(pixel))
    while (done := int(sent.max())) < SCREENING * few:
        close = close[sums.nearest[close] < CLOSE_RADII * np.sqrt(few / done)]
        if not len(close):
            break
        more = send(pixel[close], radius_m[close], done, 2 * done)
        sums.nearest[close] = np.minimum(sums.nearest[close], more.nearest)
        sums.radiance[:, close] += more.radiance
        for response, values in sums.channels.items():
            values[:, :, close] += more.channels[response]
        sent[close] = 2 * done
    counts = np.float32(LANES) * sent.astype(np.float32)
    (a, b), of_halves = sums.radiance, sums.channels.items()
    return Glint(
        pixel,
        (a + b) / counts,
        {r: (c + d) / counts for r, (c, d) in of_halves},
        (a - b) / counts,
        {r: (c - d) / counts for r, (c, d) in of_halves},
    )


class GlintSums(NamedTuple):
    """Sums over the paths of n pixels, in two halves.

    nearest : (n,) float32, least distance of a path from the centre of the lens, in radii of the disc that stands for
        the lens.
    radiance : (2, n) float32, W/m2/sr.
    channels : response -> (2, c, n) float32.
    """

    nearest: np.ndarray
    radiance: np.ndarray
    channels: dict[Response, np.ndarray]


def _sums(
    view: GlintView,
    rig: Rig,
    responses: Sequence[Response],
    pixel: np.ndarray,
    radius_m: np.ndarray,
    begin: int,
    end: int,
    of_lane: int,
    report: Callable[[], None],
) -> GlintSums:
    """Sums over the paths `begin` to `end` - 1 of the `of_lane` paths of each lane; each pixel has `LANES` lanes.

    Paths that begin at different numbers have independent random numbers.
    """
    n, paths, projector, launches = len(pixel), end - begin, view.traced.projector, Launches()
    assert isinstance(projector, Device)
    nearest, total = np.zeros(n, np.float32), np.zeros((2, n), np.float32)
    channels = {r: np.zeros((2, r.channels, n), np.float32) for r in responses}
    radiance = rig.projector_irradiance / (np.pi * radius_m**2)
    at_least, at_most = (-(-lanes // LANES) for lanes in (min_lanes(), MAX_LANES))
    for first, last in launches.ranges(n, SEGMENTS * paths * LANES, at_least=at_least, at_most=at_most):
        some = np.repeat(np.arange(first, last), LANES)
        lens = LensDisc(projector, radius_m[some], radiance[some])
        lane = np.tile(np.arange(LANES), last - first)
        lanes = GlintLanes(view, pixel[some], paths, lane * of_lane + begin, lane + LANES * begin)
        accumulators = Accumulators(responses, len(some))
        state = GlintState(
            chain=lanes.start(),
            throughput=dr.ones(mi.Float, len(some)),
            ray_state=RayState.start(view.traced._replace(media=None), len(some)),  # media's boundaries end its paths
            channels=accumulators.zeros(len(some)),
            radiance=dr.zeros(mi.Float, len(some)),
            nearest=dr.full(mi.Float, dr.inf, len(some)),
        )
        loop = partial(_paths_to_the_lens, lanes, lens, accumulators)
        state, _ = launches.run(loop, state, len(some), accumulators.pending, lambda state: report())
        accumulators.store(state.channels)
        of_range = slice(first, last)
        nearest[of_range] = state.nearest.numpy().reshape(-1, LANES).min(axis=1)
        total[:, of_range] = _of_halves(state.radiance.numpy())
        for response, (values,) in zip(responses, accumulators.images(), strict=True):
            channels[response][:, :, of_range] = np.moveaxis(_of_halves(values), 1, 0)
    return GlintSums(nearest / radius_m.astype(np.float32), total, channels)


def _of_halves(of_lanes: np.ndarray) -> np.ndarray:
    """Sums (..., lanes) of lanes as those of the halves of the paths of each pixel, (..., 2, n)."""
    sums = of_lanes.reshape(*of_lanes.shape[:-1], -1, 2, LANES // 2).sum(axis=-1, dtype=np.float32)
    return np.moveaxis(sums, -1, -2)


class GlintView(NamedTuple):
    """The scene that the camera looks into, and the seed of its random numbers."""

    traced: TracedScene
    seed: Seed


@dataclass
class ChainState:
    """The delta chain at work in each lane, and the number of chains that are finished.

    random : UInt64, state of the random numbers.
    number : UInt32, number of chains that are finished.
    length : UInt32, surfaces that the present chain has met.
    origin, direction : Point3f and Vector3f, its ray; world, metres and unit.
    """

    random: mi.UInt64
    number: mi.UInt32
    length: mi.UInt32
    origin: mi.Point3f
    direction: mi.Vector3f


class GlintLanes:
    """The pixels that a launch works on, one for each lane, and the number of paths that each lane sends.

    Parameters
    ----------
    view : GlintView
    pixel : (lanes,) int, flat indices.
    paths : int, number of paths of each lane.
    first : (lanes,) int, numbers of the first paths, which decide on the places of the paths within the pixel.
    part : (lanes,) int, numbers of the parts of the paths; parts have independent random numbers.
    """

    def __init__(self, view: GlintView, pixel: np.ndarray, paths: int, first: np.ndarray, part: np.ndarray) -> None:
        self.traced, seed = view
        self.pixel, self.paths = mi.UInt32(aligned(pixel, np.uint32)), dr.opaque(mi.UInt32, paths)
        self.place = dr.arange(mi.UInt32, len(pixel))
        rng = random_stream(seed, self.pixel ^ 0x85EBCA6B)  # other numbers than those of the path loop
        self.shift = mi.Point2f(rng.next_float32(), rng.next_float32())
        self.first = mi.UInt32(aligned(first, np.uint32))
        self.random = Continued(of_part(rng, mi.UInt32(aligned(part, np.uint32))))
        width = mi.UInt32(self.traced.camera.size.x)
        self.corner = mi.Point2f(mi.Float(self.pixel % width), mi.Float(self.pixel // width))

    def start(self) -> ChainState:
        """The state of the lanes before their first path."""
        zero = dr.zeros(mi.UInt32, dr.width(self.pixel))
        nowhere = dr.zeros(mi.Vector3f, dr.width(self.pixel))
        return ChainState(mi.UInt64(self.random.rng.state), zero, mi.UInt32(zero), mi.Point3f(nowhere), nowhere)


@dataclass
class ProbeState:
    """Everything that a segment of a probing path changes in a lane; `_probe` changes it.

    nearest : Float, metres, least distance at which a probe passed the centre of the lens.
    spread : Float, metres, least distance between the places at which successive probes crossed the plane of the lens.
    before : Point2f, metres from the centre of the lens, the place at which the last probe crossed it.
    """

    chain: ChainState
    nearest: mi.Float
    spread: mi.Float
    before: mi.Point2f


@dataclass
class GlintState:
    """Everything that a segment of a path to the lens changes in a lane; `_paths_to_the_lens` changes it.

    throughput : Float, radiance at the camera per radiance along the ray.
    ray_state : RayState
    channels : per response its dense channels, Float each.
    radiance : Float, W/m2/sr, sum over the paths.
    nearest : Float, metres, least distance at which a path passed the centre of the lens.
    """

    chain: ChainState
    throughput: mi.Float
    ray_state: RayState
    channels: list[list[mi.Float]]
    radiance: mi.Float
    nearest: mi.Float


class LensDisc:
    """The projector's lens as the camera may see it: a disc that faces along the projector's axis.

    Where a curved mirror makes the image of the lens too small for a pixel's paths to hit, a larger and dimmer disc
    stands for it. The pixel receives the same light.

    Parameters
    ----------
    projector : Device
    radius_m : (lanes,) float, metres, radius of the disc of each pixel.
    radiance : (lanes,) float, W/m2/sr, its radiance along the axis.
    """

    def __init__(self, projector: Device, radius_m: np.ndarray, radiance: np.ndarray) -> None:
        self.projector = projector
        self.radius = mi.Float(aligned(radius_m, np.float32))
        self.radiance = mi.Float(aligned(radiance, np.float32))

    def crossing(self, ray: mi.Ray3f, si: mi.SurfaceInteraction3f) -> tuple[mi.Point2f, mi.Float, mi.Bool]:
        """The point where the ray crosses the plane of the lens from the front, before it meets the surface `si`.

        Returns
        -------
        across : Point2f, metres, the place along the projector's x and y axes, from the centre of the lens.
        t : Float, metres, the distance from the start of the ray.
        crosses : Bool, whether the ray does so at all.
        """
        z, centre = self.projector.z, self.projector.centre
        slope = -dr.dot(ray.d, z)
        t = dr.dot(mi.Vector3f(ray.o) - centre, z) / slope
        point = mi.Vector3f(ray(t)) - centre
        across = mi.Point2f(dr.dot(point, self.projector.x), dr.dot(point, self.projector.y))
        return across, t, (slope > 0) & (t > 0) & (t < si.t)


def _worth_probing(traced: TracedScene, h: int, w: int) -> np.ndarray:
    """Flat indices of the pixels to be probed: beside a delta surface, or beside the lens in plain view."""
    assert isinstance(traced.projector, Device)
    meets, exists = meets_delta(traced.scene, traced.camera.pixels, traced.camera.centre_rays)
    mask = meets.reshape(h, w)
    if isinstance(traced.camera, Device):
        uv, z = traced.camera.project(mi.Point3f(traced.projector.centre))
        u, v = float(uv.x[0]), float(uv.y[0])
        if float(z[0]) > 0 and 0 <= u < w and 0 <= v < h:
            mask[int(v), int(u)] = True
    else:
        mask |= traced.camera.looks_at(np.array(traced.projector.centre).ravel()).reshape(h, w)
    return np.flatnonzero(binary_dilation(mask, np.ones((3, 3))) & exists.reshape(h, w))


def _near_the_lens(
    view: GlintView, rig: Rig, pixel: np.ndarray, report: Callable[[], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Selection of the pixels whose probes come near the lens, compared with the spread of the probes.

    Returns
    -------
    pixel : (n,) int, flat indices.
    radius_m : (n,) float, metres, radius of the disc that stands for the lens in each pixel.
    """
    aperture = np.full(len(pixel), rig.projector_lens.aperture_radius_m)
    assert isinstance(view.traced.projector, Device)
    lens = LensDisc(view.traced.projector, aperture[:1], aperture[:1])
    nearest, spread = np.empty(len(pixel), np.float32), np.empty(len(pixel), np.float32)
    launches = Launches()
    for begin, end in launches.ranges(len(pixel), SEGMENTS * PROBES, at_least=min_lanes()):
        some, n = slice(begin, end), end - begin
        zero, far = np.zeros(n, np.uint32), dr.full(mi.Float, dr.inf, n)
        lanes = GlintLanes(view, pixel[some], PROBES, zero, zero)
        state = ProbeState(lanes.start(), far, mi.Float(far), dr.full(mi.Point2f, dr.inf, n))
        state, _ = launches.run(partial(_probe, lanes, lens), state, n, report=lambda state: report())
        nearest[some], spread[some] = state.nearest.numpy(), state.spread.numpy()
    spread = np.where(np.isfinite(spread), spread, np.float32(UNKNOWN_SPREAD * rig.projector_lens.aperture_radius_m))
    near = nearest < aperture + NEAR_SPREADS * spread
    return pixel[near], np.clip(MIN_RADIUS_SPREADS * spread, aperture, MAX_ENLARGEMENT * aperture)[near]


@dr.syntax
def _probe(
    lanes: GlintLanes, lens: LensDisc, state: ProbeState, max_iterations: mi.UInt32
) -> tuple[ProbeState, mi.UInt32]:
    """The state of the probes after at most `max_iterations` segments, and the number of segments of each lane.

    Where light splits into reflection and refraction, probes take both equally often, however faint one is.
    """
    traced = lanes.traced
    context = delta_only(mi.TransportMode.Radiance)
    left = max_iterations + dr.zeros(mi.UInt32, dr.width(state.nearest))  # iterations
    while (state.chain.number < lanes.paths) & (left > 0):
        chain = state.chain  # a part of the state, changed in place
        rng = lanes.random.at(chain.random)
        primary = traced.camera.ray_in(lanes.corner, stratified(lanes.shift, chain.number))
        starts = chain.length == 0
        ray = mi.Ray3f(
            dr.select(starts, primary.origin, chain.origin), dr.select(starts, primary.direction, chain.direction)
        )
        si = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False)
        across, _, crosses = lens.crossing(ray, si)
        state.nearest = dr.select(crosses, dr.minimum(state.nearest, dr.norm(across)), state.nearest)
        # The least step counts: a probe that was reflected where others were refracted is far off and says nothing
        step = dr.norm(across - state.before)
        state.spread = dr.select(crosses, dr.minimum(state.spread, step), state.spread)
        state.before = dr.select(crosses, across, state.before)
        hit = si.is_valid() & ~bounded(traced.media, si)
        component = dr.select(rng.next_float32() < 0.5, mi.Float(0), mi.Float(0.9999))  # the first, or the last
        bs, weight = si.bsdf(ray).sample(context, si, component, mi.Point2f(0.5), hit)
        ray = spawn_specular_ray(si, si.p, si.to_world(bs.wo))
        chain.length += 1
        ends = ~hit | ~owner(has_vertex=~is_delta(bs), delta_interactions=chain.length).glint
        ends |= (mono(weight) <= 0) | (chain.length >= MAX_CHAIN)
        chain.length = dr.select(ends, 0, chain.length)
        chain.number = dr.select(ends, chain.number + 1, chain.number)
        chain.random, chain.origin, chain.direction = rng.state, ray.o, ray.d
        left -= 1
    return state, max_iterations - left


@dr.syntax
def _paths_to_the_lens(
    lanes: GlintLanes, lens: LensDisc, accumulators: Accumulators, state: GlintState, max_iterations: mi.UInt32
) -> tuple[GlintState, mi.UInt32]:
    """The state of the paths after at most `max_iterations` segments, and the number of segments of each lane.

    Sparse responses are added to the accumulators.
    """
    traced, camera = lanes.traced, lanes.traced.camera
    context = delta_only(mi.TransportMode.Radiance)
    n = dr.width(state.nearest)
    left = max_iterations + dr.zeros(mi.UInt32, n)  # iterations
    while (state.chain.number < lanes.paths) & (left > 0):
        chain = state.chain  # a part of the state, changed in place
        rng = lanes.random.at(chain.random)
        # ---- The next path starts at the camera ------------------------------------------------------
        starts = chain.length == 0
        on_lens = (
            mi.Point2f(rng.next_float32(), rng.next_float32()) if dr.hint(camera.has_lens, mode="scalar") else None
        )
        primary = camera.ray_in(lanes.corner, stratified(lanes.shift, lanes.first + chain.number), on_lens)
        ray = mi.Ray3f(
            dr.select(starts, primary.origin, chain.origin), dr.select(starts, primary.direction, chain.direction)
        )
        state.ray_state = state.ray_state.restarted(starts, primary.origin, primary.path_offset)
        si = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False)

        # ---- Does this segment meet the lens? --------------------------------------------------------
        across, t, crosses = lens.crossing(ray, si)
        uv, z = lens.projector.project(state.ray_state.previous)
        size = lens.projector.size
        state.nearest = dr.select(crosses, dr.minimum(state.nearest, dr.norm(across)), state.nearest)
        meets = crosses & (dr.norm(across) < lens.radius) & (z > 0)
        meets &= (uv.x >= 0) & (uv.x < size.x) & (uv.y >= 0) & (uv.y < size.y)
        # Intensity E / cos^3 of the pinhole, from a disc that looks smaller by cos
        cosine = -dr.dot(ray.d, lens.projector.z)
        illumination = lens.projector.relative_illumination(-ray.d)
        radiance = state.throughput * lens.radiance * illumination / dr.square(dr.square(cosine))
        radiance = dr.select(meets, radiance * lens.projector.pixel_density(-ray.d), 0)
        length = dr.fma(state.ray_state.ior, t, state.ray_state.length)
        u, v, path_length = (dr.select(meets, x, 0) for x in (uv.x, uv.y, length))
        path = LightPath(u, v, path_length, dr.full(mi.Bool, False, n), mi.UInt32(GLINT))
        state.channels = accumulators.add(state.channels, path, radiance, lanes.place, meets)
        state.radiance += radiance

        # ---- On through delta interactions, or the next path -----------------------------------------
        hit = si.is_valid() & ~meets & ~bounded(traced.media, si)
        state.ray_state.length = state.ray_state.length_to(si.p, hit)
        if dr.hint(traced.absorbers is not None, mode="scalar"):
            state.throughput *= state.ray_state.unabsorbed(traced, si.p, hit)
        bs, weight = si.bsdf(ray).sample(
            context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), hit
        )
        state.throughput *= mono(weight)
        state.ray_state = state.ray_state.refracted(bs, hit).restarted(True, si.p, state.ray_state.length)
        ray = spawn_specular_ray(si, si.p, si.to_world(bs.wo))
        chain.length += 1
        chance = survival(chain.length, state.throughput * dr.square(state.ray_state.ior))
        ends = ~hit | ~owner(has_vertex=~is_delta(bs), delta_interactions=chain.length).glint
        ends |= (state.throughput <= 0) | (chain.length >= MAX_CHAIN)
        ends |= rng.next_float32() >= chance
        state.throughput /= chance
        state.ray_state = state.ray_state.entering(traced, si, ray.d, hit, mi.Bool(False)).reset(traced, ends)
        chain.length = dr.select(ends, 0, chain.length)
        chain.number = dr.select(ends, chain.number + 1, chain.number)
        state.throughput = dr.select(ends, 1, state.throughput)
        chain.random, chain.origin, chain.direction = rng.state, ray.o, ray.d
        left -= 1
    return state, max_iterations - left
