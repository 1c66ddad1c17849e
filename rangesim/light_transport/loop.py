# SPDX-License-Identifier: Apache-2.0
"""The path loop: one pass of light paths serves every pattern, frequency and bin.

One lane owns one pixel and traces its samples one after the other; where a path ends, the lane starts the
next sample in the same iteration of the loop. So no lane idles while its neighbours finish, every channel is a
register instead of a film, and each sum is made by one thread in one order: same seed, same bytes,
whatever the number of threads. The loop is run in launches of bounded time, each of which takes some lanes so many
iterations further: what a lane has done is its `State`, so that neither the lanes of a launch nor its iterations change
a byte.

A path has two limits. `max_depth` counts the surfaces that scatter it; delta interactions (glass, mirrors, coats,
holes) scatter nothing and have a limit of their own, of so many in a row (`rangesim.light_transport.specular_chain`).

Inside a translucent object an iteration of the loop is a scattering event instead of a surface; a stay inside counts as
one surface towards the depth, however often it scatters (`rangesim.light_transport.scattering`). Inside glass that
absorbs, what a segment leaves of the throughput is exp(-sigma_a d) (`rangesim.light_transport.absorption`).

The strategies that bring projector light to the camera partition all light paths: next-event estimation (here),
caustic photons gathered at every non-delta vertex (here, from maps made before), and glint, paths without any
non-delta vertex (`rangesim.light_transport.glint`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.accumulators import Accumulators
from rangesim.light_transport.caustics import Vertex, caustic_light, gather
from rangesim.light_transport.device import connect
from rangesim.light_transport.emitters import emission, emission_through, sampled_emission
from rangesim.light_transport.kernel_launches import Launches, Report, min_lanes
from rangesim.light_transport.photon_maps import PhotonMaps
from rangesim.light_transport.photons import has_delta
from rangesim.light_transport.sampling import Continued, Seed, Stream, aligned, in_pairs, of_part, random_stream
from rangesim.light_transport.scattering import MAX_EVENTS, ROULETTE_BELOW
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN, RayState, corrected_point, spawn_specular_ray, survival
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.light_transport.truncation import Tally
from rangesim.response import DIRECT, MULTIPATH, SPECULAR, LightPath
from rangesim.scene import Scene

NEIGHBOURS = 256
"""Pixels in a row that share a launch. Launches take such runs from all over the image: so their times are alike."""
ITERATIONS_PER_SAMPLE = 2
"""Iterations of the loop that a sample takes, before any were counted."""


class PathSettings(NamedTuple):
    """Sampling of the loop. Numbers are opaque; the flags shape the kernel.

    delta : whether some surface of the scene has a delta interaction.
    ambient : whether the scene has light of its own.
    lamps : whether that light has a direction worth sampling; uniform surroundings are found best by the BSDF alone.
    """

    seed: Seed
    max_depth: Any
    rr_depth: Any
    delta: bool
    ambient: bool
    lamps: bool

    @classmethod
    def of(cls, scene: Scene, settings: TransportSettings) -> PathSettings:
        """Those of a pass."""
        max_depth, rr_depth = dr.opaque(mi.UInt32, settings.max_depth), dr.opaque(mi.UInt32, settings.rr_depth)
        return cls(
            Seed.of(settings.seed), max_depth, rr_depth, has_delta(scene.mitsuba), scene.has_ambient, scene.has_lamps
        )


@dataclass(frozen=True, eq=False)
class SampleAllocation:
    """Samples that some pixels get, and the projector's light.

    pixels : (n,) flat indices in the whole image. samples : (n,) uint32, how many of each pixel are taken.
    total : (n,) uint32, samples of each pixel all in all, those taken at other times included.
    first, stride : number of the first of the samples taken, and numbers from a pair of samples to the next.
    part : int, numbers the parts of a pass; their random numbers are independent.
    irradiance : of the projector, W/m2 at z = 1 m.
    """

    pixels: np.ndarray
    samples: np.ndarray
    total: np.ndarray
    irradiance: float
    first: int = 0
    stride: int = 2
    part: int = 0

    def of(self, some: slice) -> SampleAllocation:
        """The allocation of some of the pixels."""
        return replace(self, pixels=self.pixels[some], samples=self.samples[some], total=self.total[some])

    def halves(self) -> list[SampleAllocation]:
        """Two budgets that have every second pair of samples each, so that both fill the pixel evenly."""
        pairs, odd = (self.samples + 1) >> 1, self.samples & 1
        return [
            replace(
                self,
                samples=2 * (pairs + 1 - half >> 1) - odd * ((pairs - 1 & 1) == half),
                first=self.first + 2 * half,
                stride=2 * self.stride,
                part=2 * self.part + half,
            )
            for half in (0, 1)
        ]


class Radiance(NamedTuple):
    """Sums over the samples of one pixel by kind of light path (see `rangesim.signals.EnergySplit`)."""

    direct: Any
    multipath: Any
    specular: Any
    caustic: Any
    ambient: Any
    smooth_caustic: Any
    """Caustics that were gathered from afar, and are smooth therefore; `caustic` has the others."""


class PathSums(NamedTuple):
    """Sums over the samples of each pixel, besides channels.

    radiance : (6, n) float32, in the order of `Radiance`. tally : (6, n) float32, in the order of `Tally`.
    """

    radiance: np.ndarray
    tally: np.ndarray


@dataclass
class State:
    """What a lane carries from one iteration of the loop to the next; see `start`.

    A dataclass, not frozen: Dr.Jit looks into no named tuple when it evaluates. What never changes is not in it (None
    instead), or Dr.Jit would trace the loop twice.
    """

    random: Any
    choice: Any
    rotation: Any
    channels: list[list[Any]]
    radiance: list[Any]
    tally: list[Any]
    sample: Any
    depth: Any
    chain: Any
    origin: Any
    direction: Any
    throughput: Any
    ray_state: RayState
    first: Any
    via: Any
    previous_pdf: Any
    previous_delta: Any
    was_bent: Any
    events: Any
    stays: Any


class View(NamedTuple):
    """What the loop is run in: the scene with its devices, and photons; the same for all lanes.

    maps : PhotonMaps, or None.
    """

    traced: TracedScene
    maps: PhotonMaps | None = None


def trace(
    view: View,
    settings: PathSettings,
    allocation: SampleAllocation,
    accumulators: Accumulators,
    launches: Launches,
    report: Report,
) -> PathSums:
    """Radiance by kind of path, and what tells how much is left out; channels go to the accumulators.

    The pixels of the allocation are those of the accumulators. `report` gets the fraction done.
    """
    pixels, runs = accumulators.pixels, _dealt(-(-accumulators.pixels // NEIGHBOURS))
    traced = PathSums(*(np.empty((len(kind._fields), pixels), np.float32) for kind in (Radiance, Tally)))
    samples = allocation.samples
    total, begin, finished, iterations = int(samples.sum(dtype=np.int64)), 0, 0, 0

    def tell(state: State) -> None:
        report((finished + float(state.sample.numpy().sum(dtype=np.int64))) / total)

    while begin < len(runs):
        per_sample = iterations / finished if finished else ITERATIONS_PER_SAMPLE
        most = max(min_lanes(), int(launches.units / (per_sample * total / pixels))) // NEIGHBOURS
        left = len(runs) - begin
        end = begin + -(-left // -(-left // most))  # launches of even size
        places = (np.sort(runs[begin:end])[:, None] * NEIGHBOURS + np.arange(NEIGHBOURS)).ravel()
        places = places[places < pixels]
        lanes = Lanes(view, settings, allocation, places)
        loop, state = partial(walk, view, settings, accumulators, lanes), start(view, settings, accumulators, lanes)
        state, taken = launches.run(loop, state, len(places), accumulators.pending, tell)
        accumulators.store(state.channels, places)
        for images, sums in zip(traced, (state.radiance, state.tally), strict=True):
            for image, values in zip(images, sums, strict=True):
                image[places] = 0 if values is None else values.numpy()
        begin, finished, iterations = end, finished + int(samples[places].sum(dtype=np.int64)), iterations + taken
    return traced


def _dealt(n: int) -> np.ndarray:
    """The numbers 0..n in an order of which any few are spread evenly (multiples of the golden ratio)."""
    step = next(k for k in range(round(0.6180339887498949 * n), 2 * n + 2) if math.gcd(k, n) == 1)
    return np.arange(n) * step % n


class Lanes:
    """Pixels at work, a lane for each: what of a lane never changes.

    Parameters
    ----------
    view, settings, allocation : View, PathSettings and SampleAllocation.
    places : (lanes,) int, numbers of the pixels in allocation and accumulators. Random numbers depend on a pixel's flat
        index in the whole image, the part and the seed alone.
    """

    def __init__(self, view: View, settings: PathSettings, allocation: SampleAllocation, places: np.ndarray) -> None:
        self.place = mi.UInt32(aligned(places, np.uint32))
        self.pixel = mi.UInt32(aligned(allocation.pixels[places], np.uint32))
        self.samples = mi.UInt32(aligned(allocation.samples[places], np.uint32))
        self.total = mi.UInt32(aligned(allocation.total[places], np.uint32))
        self.first, self.stride, self.part = (
            dr.opaque(mi.UInt32, n) for n in (allocation.first, allocation.stride, allocation.part)
        )
        self.irradiance = dr.opaque(mi.Float, allocation.irradiance)
        width = mi.UInt32(view.traced.camera.size.x)
        self.corner = mi.Point2f(mi.Float(self.pixel % width), mi.Float(self.pixel // width))
        rng = random_stream(settings.seed, self.pixel)
        self.shift = mi.Point2f(rng.next_float32(), rng.next_float32())  # of the samples in the pixel
        on_lens = view.traced.camera.has_lens
        self.lens_shift = mi.Point2f(rng.next_float32(), rng.next_float32()) if on_lens else None
        self.random = Continued(of_part(rng, self.part))
        self.choice = Continued(of_part(random_stream(settings.seed, self.pixel, Stream.SECOND), self.part))

    def number(self, taken: Any) -> Any:
        """Number among all samples of the pixel of the next one, after so many were taken."""
        return self.first + (taken >> 1) * self.stride + (taken & 1)


def start(view: View, settings: PathSettings, accumulators: Accumulators, at: Lanes) -> State:
    """The state of lanes that have done nothing yet."""
    lanes, gathers, in_media = dr.width(at.pixel), view.maps is not None, view.traced.media is not None
    shines = [True, True, True, gathers, settings.ambient, gathers]
    return State(
        # ---- Of the lane: its random numbers, its sums -----------------------------------------------
        random=mi.UInt64(at.random.rng.state),
        choice=mi.UInt64(at.choice.rng.state) if gathers else None,  # of photons; they change no other light
        # Shared by neighbours; evenly spread from here on
        rotation=of_part(random_stream(settings.seed, at.pixel >> 4, Stream.THIRD), at.part).next_uint32()
        if gathers
        else None,
        channels=accumulators.zeros(lanes),
        radiance=[dr.zeros(mi.Float, lanes) if any_of_it else None for any_of_it in shines],
        tally=[dr.zeros(mi.Float, lanes) for _ in range(5)] + [dr.zeros(mi.Float, lanes) if settings.delta else None],
        sample=dr.zeros(mi.UInt32, lanes),  # samples of this pixel finished so far, of those to be taken
        # ---- Of the path -----------------------------------------------------------------------------
        depth=dr.zeros(mi.UInt32, lanes),  # surfaces that scattered it so far
        chain=dr.zeros(mi.UInt32, lanes) if settings.delta else None,  # delta interactions since
        origin=dr.zeros(mi.Point3f, lanes),  # of the ray
        direction=dr.zeros(mi.Vector3f, lanes),
        throughput=dr.ones(mi.Float, lanes),  # radiance at the camera per radiance along the ray
        ray_state=RayState.start(view.traced, lanes),  # from the last vertex on; its length counts from the camera
        first=dr.full(mi.Bool, True, lanes),  # no non-delta surface so far
        via=dr.full(mi.Bool, False, lanes),  # some delta surface so far
        previous_pdf=dr.zeros(mi.Float, lanes),  # of the BSDF sample that made the ray; for MIS with ambient light
        previous_delta=dr.full(mi.Bool, True, lanes),
        was_bent=dr.full(mi.Bool, False, lanes),  # the ray left a delta surface
        events=dr.zeros(mi.UInt32, lanes) if in_media else None,  # scatterings in media and crossed boundaries so far
        stays=dr.full(mi.Bool, False, lanes) if in_media else None,  # scattered since it entered the medium
    )


@dr.syntax
def walk(
    view: View, settings: PathSettings, accumulators: Accumulators, at: Lanes, state: State, most: Any
) -> tuple[State, Any]:
    """The state of the lanes after at most so many iterations of the loop, and those that each one took."""
    traced, maps = view
    scene, surfaces, camera, projector, media, cutouts, absorbers = traced
    # ---- The state, by name ------------------------------------------------------------------------
    random, choice, rotation, channels, sample = (
        state.random,
        state.choice,
        state.rotation,
        state.channels,
        state.sample,
    )
    origin, towards = state.origin, state.direction
    direct, multipath, specular, caustic, ambient, smooth_caustic = state.radiance
    at_first, further, before_last, at_last, indirect, cut = state.tally
    depth, chain, throughput, ray_state = state.depth, state.chain, state.throughput, state.ray_state
    first, via, was_bent = state.first, state.via, state.was_bent
    previous_pdf, previous_delta = state.previous_pdf, state.previous_delta
    events, stays = state.events, state.stays
    lanes = dr.width(sample)
    left = most + dr.zeros(mi.UInt32, lanes)  # iterations
    active = (sample < at.samples) & (left > 0)

    while active:
        rng = at.random.at(random)
        scatters, crosses = (
            mi.Bool(False),
            mi.Bool(False),
        )  # in this iteration: an event inside a medium, or its boundary

        # ---- A new sample starts at the camera -------------------------------------------------------
        starts = depth == 0
        if dr.hint(settings.delta, mode="scalar"):
            starts &= chain == 0
        if dr.hint(media is not None, mode="scalar"):
            starts &= events == 0
        number = at.number(sample)
        jitter, lens = in_pairs(at.shift, at.lens_shift, number, at.total)
        primary = camera.sample_ray(at.corner + jitter, lens)
        ray = mi.Ray3f(dr.select(starts, primary.origin, origin), dr.select(starts, primary.direction, towards))
        ray_state = ray_state.restarted(starts, primary.origin, primary.path_offset)
        if dr.hint(camera.distortion is not None, mode="scalar"):
            throughput = dr.select(starts & ~primary.exists, 0, throughput)  # no ray, no light

        # ---- Next surface ----------------------------------------------------------------------------
        si = surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit = si.is_valid() & active
        met = mi.Point3f(si.p)
        si.p = dr.select(was_bent, corrected_point(si, ray_state.previous, ray.d), met)
        if dr.hint(media is not None, mode="scalar"):
            scatters, crosses = media.event(ray_state.inside, ray_state.previous, ray.d, si, hit, rng.next_float32())
        at_surface = hit & ~scatters
        # It counts if it scatters the path; whether it does is known when the next direction is
        if dr.hint(media is not None, mode="scalar"):
            arrives = ~(crosses | (scatters & stays))
            depth += dr.select(arrives, mi.UInt32(1), mi.UInt32(0))
        else:
            arrives = mi.Bool(True)
            depth += 1
        ray_state.length = ray_state.length_to(si.p, hit)
        if dr.hint(absorbers is not None, mode="scalar"):
            throughput *= ray_state.unabsorbed(traced, si.p, hit)
        bsdf = si.bsdf(ray)
        may_connect = hit & (depth < settings.max_depth) & (scatters | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))

        # ---- What is left when paths end: see `truncation` -------------------------------------------
        arriving = dr.select(may_connect & arrives, throughput, 0)
        is_later = depth > 1
        at_first += dr.select(is_later, 0, arriving)
        further += dr.select(is_later, arriving, 0)
        before_last += dr.select(depth + 2 == settings.max_depth, arriving, 0)
        at_last += dr.select(depth + 1 == settings.max_depth, arriving, 0)

        # ---- Next-event estimation: straight to the projector ----------------------------------------
        link = connect(scene, projector, si, may_connect, media, ray_state.inside)
        value, _, bs, bs_weight = bsdf.eval_pdf_sample(
            mi.BSDFContext(),
            si,
            si.to_local(link.direction),
            rng.next_float32(),
            mi.Point2f(rng.next_float32(), rng.next_float32()),
            at_surface,
        )
        value, bs_weight = mono(value), mono(bs_weight)
        wo = si.to_world(bs.wo)
        if dr.hint(media is not None, mode="scalar"):
            medium = ray_state.inside
            value = dr.select(scatters, medium.albedo * medium.phase(dr.dot(ray.d, link.direction)), value)
            bs_weight = dr.select(scatters, medium.albedo, bs_weight)
            xi = mi.Point2f(rng.next_float32(), rng.next_float32())
            wo = dr.select(scatters, medium.scattered(ray.d, xi), wo)
        radiance = dr.select(link.lit, throughput * value * link.geometry * at.irradiance, 0)
        # Nothing undefined (u at z = 0, say) may reach a response: 0 times it is not always 0
        u, v, path_length = (
            dr.select(link.lit, x, 0) for x in (link.uv.x, link.uv.y, ray_state.length + link.distance)
        )
        kind = dr.select(first, dr.select(via, mi.UInt32(SPECULAR), mi.UInt32(DIRECT)), mi.UInt32(MULTIPATH))
        light = LightPath(u, v, path_length, first, kind, link.blur_px)
        channels = accumulators.add(channels, light, radiance, at.place, link.lit, kind == MULTIPATH)
        direct += dr.select(kind == DIRECT, radiance, 0)
        specular += dr.select(kind == SPECULAR, radiance, 0)
        multipath += dr.select(kind == MULTIPATH, radiance, 0)
        indirect += dr.select(is_later, radiance, 0)

        # ---- Caustic photons: light that reached this point through glass or off mirrors -------------
        if dr.hint(maps is not None, mode="scalar"):
            vertex = Vertex(si, bsdf, throughput, ray_state.length, first & ~link.lit)
            chosen = at.choice.at(choice)
            xi = [chosen.next_float32() for _ in range(3)]
            choice = chosen.state
            rotation += 2654435769  # 2^32 over the golden ratio
            chance, gathers = mi.Float(rotation >> 8) * 2**-24, may_connect & ~scatters
            brought = gather(maps, vertex, number, xi, chance, gathers)
            channels, radiance = caustic_light(maps, accumulators, channels, vertex, brought, at.place)
            caustic += dr.select(brought.is_wide, 0, radiance)
            smooth_caustic += dr.select(brought.is_wide, radiance, 0)
            indirect += dr.select(is_later, radiance, 0)

        # ---- Ambient light: next-event estimation and emission, weighted by MIS ----------------------
        if dr.hint(settings.ambient, mode="scalar"):
            alone = previous_delta | (not settings.lamps)  # no other strategy finds this light
            before = dr.zeros(mi.Interaction3f, lanes)
            before.p = ray_state.previous
            ambient += throughput * emission(scene, si, before, previous_pdf, alone, active & ~scatters)
            if dr.hint(settings.lamps, mode="scalar"):
                xi = mi.Point2f(rng.next_float32(), rng.next_float32())
                if dr.hint(media is None, mode="scalar"):
                    lamp = sampled_emission(traced, bsdf, si, ray_state, xi, may_connect)
                    ambient += throughput * lamp
                else:
                    lamp = emission_through(traced, bsdf, si, ray.d, ray_state, scatters, xi, may_connect)
                    ambient += throughput * lamp

        # ---- Next direction --------------------------------------------------------------------------
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        throughput *= bs_weight
        ray_state = ray_state.refracted(bs, at_surface)
        was_bent = is_delta & ~crosses
        if dr.hint(settings.delta, mode="scalar"):
            depth -= dr.select(was_bent, mi.UInt32(1), mi.UInt32(0))
            chain = dr.select(crosses, chain, dr.select(was_bent, chain + 1, 0))
        fraction = throughput * dr.square(ray_state.ior)  # of the light, that this path stands for
        chance = dr.select(depth > settings.rr_depth, dr.minimum(fraction, 0.95), 1)
        if dr.hint(settings.delta, mode="scalar"):
            chance = dr.minimum(chance, survival(chain, fraction))
        if dr.hint(media is not None, mode="scalar"):
            chance = dr.select(scatters, dr.minimum(throughput / ROULETTE_BELOW, 1), dr.select(crosses, 1, chance))
        survives = rng.next_float32() < chance
        throughput /= chance
        passes = mi.Bool(False)  # through a hole, as if nothing were there
        if dr.hint(cutouts is not None, mode="scalar"):
            passes = cutouts.passed(si, bs, at_surface)
        first &= ~scatters & (passes | ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))
        via |= is_delta & ~passes
        ray_state = ray_state.restarted(True, si.p, ray_state.length)
        previous_pdf = mi.Float(bs.pdf)
        previous_delta = is_delta | scatters
        ray = si.spawn_ray(wo)
        ray.o = dr.select(was_bent, spawn_specular_ray(si, met, wo).o, ray.o)
        if dr.hint(media is not None, mode="scalar"):
            events += dr.select(scatters | crosses, mi.UInt32(1), mi.UInt32(0))
            stays = scatters | (stays & ~crosses)
        ray_state = ray_state.entering(traced, si, wo, at_surface, crosses)

        # ---- Or next sample --------------------------------------------------------------------------
        # The last surface can only be seen to emit, so it is needed for ambient light alone
        last = settings.max_depth if settings.ambient else settings.max_depth - 1
        goes_on = depth < last
        if dr.hint(media is not None, mode="scalar"):
            goes_on |= (scatters | crosses) & (depth < settings.max_depth) & (events < MAX_EVENTS)
        goes_on &= hit & survives & (throughput > 0)
        if dr.hint(settings.delta, mode="scalar"):
            cut += dr.select(goes_on & (chain >= MAX_CHAIN), throughput * dr.square(ray_state.ior), 0)
            goes_on &= chain < MAX_CHAIN
        ends = ~goes_on
        sample = dr.select(ends, sample + 1, sample)
        depth = dr.select(ends, 0, depth)
        if dr.hint(settings.delta, mode="scalar"):
            chain = dr.select(ends, 0, chain)
        throughput = dr.select(ends, 1, throughput)
        ray_state = ray_state.reset(traced, ends)
        first |= ends
        via &= ~ends
        previous_delta |= ends
        was_bent &= ~ends
        if dr.hint(media is not None, mode="scalar"):
            events = dr.select(ends, 0, events)
            stays &= ~ends
        random, origin, towards = rng.state, ray.o, ray.d
        left -= 1
        active = (sample < at.samples) & (left > 0)

    return State(
        random=random,
        choice=choice,
        rotation=rotation,
        channels=channels,
        radiance=[direct, multipath, specular, caustic, ambient, smooth_caustic],
        tally=[at_first, further, before_last, at_last, indirect, cut],
        sample=sample,
        depth=depth,
        chain=chain,
        origin=origin,
        direction=towards,
        throughput=throughput,
        ray_state=ray_state,
        first=first,
        via=via,
        previous_pdf=previous_pdf,
        previous_delta=previous_delta,
        was_bent=was_bent,
        events=events,
        stays=stays,
    ), most - left
