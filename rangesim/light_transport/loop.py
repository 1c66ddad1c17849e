# SPDX-License-Identifier: Apache-2.0
"""The path loop: one pass of light paths serves every pattern, frequency and bin.

One lane owns one half of a pixel's samples, or all of them where no sampling error is estimated, and traces them one
after the other. Where a path ends, the lane starts the next sample in the same iteration of the loop. This has three
advantages. No lane waits while its neighbours finish. Every channel is a number in a register instead of an image in
memory. Each sum is made by one thread in one order, so the same seed gives the same bytes, whatever the number of
threads.

The loop runs in launches of bounded time (`rangesim.light_transport.kernel_launches`). A launch takes some of the lanes
and moves each of them on by a bounded number of iterations. `LaneState` holds everything that a lane has done, so
neither the choice of lanes nor the number of iterations changes a byte.

A path has two limits. `max_depth` counts the surfaces that scatter it. Delta interactions (glass, mirrors, coats,
holes) scatter nothing; a limit of their own counts them in a row (`rangesim.light_transport.specular_chain`).

Inside a translucent object an iteration of the loop is a scattering event instead of a surface. A stay inside counts as
one surface towards the depth, however often light scatters there (`rangesim.light_transport.scattering`). Inside glass
that absorbs, a segment of length d keeps the fraction exp(-sigma_a d) of the light
(`rangesim.light_transport.absorption`).

The loop carries out two of the three strategies that bring the projector's light to the camera: next-event estimation,
and caustics. `rangesim.light_transport.strategies` says which paths belong to which strategy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import partial
from typing import Generic, NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.accumulators import Accumulators, Runs
from rangesim.light_transport.ambient_light import ambient_on_ray, sampled_ambient, sampled_ambient_through_media
from rangesim.light_transport.beams import BeamDevice, Pencil, Spot
from rangesim.light_transport.caustics import Draws, Vertex, caustic_light
from rangesim.light_transport.chain_strata import PERIOD, ChainStrata, stratum_of
from rangesim.light_transport.delta_surfaces import has_delta, has_throwers, is_thrower
from rangesim.light_transport.kernel_launches import Launches, Report, min_lanes
from rangesim.light_transport.lamps import lamps_of
from rangesim.light_transport.sampling import (
    Continued,
    Seed,
    Stream,
    aligned,
    along_golden,
    in_pairs,
    of_part,
    random_stream,
    used_up,
)
from rangesim.light_transport.scattering import MAX_EVENTS, ROULETTE_BELOW
from rangesim.light_transport.sheet_scene import SheetScene
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN, RayState, corrected_point, spawn_specular_ray, survival
from rangesim.light_transport.spots import connect_to_spot, lit_spot
from rangesim.light_transport.strategies import beam_connects, can_be_vertex, is_delta, next_event_kind, owner
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.light_transport.truncation import Tally
from rangesim.response import DIRECT, GLINT, MULTIPATH, SPECULAR, LightPath
from rangesim.scene import Scene

NEIGHBOURS = 256
"""Number of pixels in a row that share a launch. A launch takes such runs from all over the image, so that launches
take about equally long. Longer runs would be spread less evenly. With runs shorter than a vector of the processor (16
lanes), one vector would hold pixels whose paths differ."""
ITERATIONS_PER_SAMPLE = 2
"""Number of iterations of the loop per sample that is assumed before any were counted. It need not be exact, because
only the size of the first launch depends on it; the size of later ones depends on the count."""

TURNS = 1 << 16
"""Number of different starts in the order in which pixels look for triangles; any large number would do."""

Array = TypeVar("Array")


class PathSettings(NamedTuple):
    """Settings of the loop. The kernel cache does not see the numbers (they are opaque); the flags decide which code
    the kernel has.

    seed : Seed. max_depth, rr_depth : UInt32, see `TransportSettings`.
    delta : whether some surface of the scene has a delta interaction.
    glint : whether beams that come back to their own emitter count.
    ambient : whether the scene has light of its own.
    samples_ambient : whether directions to that light are sampled. For uniform surroundings, samples of the BSDF alone
        are best.
    delta_lamps : whether the scene has lamps without extent, and surfaces with delta interactions.
    refracts : whether light passes through some surface of the scene, so that the refractive index along a path may
        change.
    throws : whether caustics carry the projector's light over narrow lobes to surfaces that scatter it widely.
    """

    seed: Seed
    max_depth: mi.UInt32
    rr_depth: mi.UInt32
    delta: bool
    glint: bool
    ambient: bool
    samples_ambient: bool
    delta_lamps: bool
    refracts: bool
    throws: bool

    @classmethod
    def of(cls, scene: Scene, settings: TransportSettings) -> PathSettings:
        """The settings of the loop for a scene, taken from the settings of a pass."""
        return cls(
            seed=Seed.of(settings.seed),
            max_depth=dr.opaque(mi.UInt32, settings.max_depth),
            rr_depth=dr.opaque(mi.UInt32, settings.rr_depth),
            delta=has_delta(scene.mitsuba),
            glint=settings.glint,
            ambient=scene.has_ambient,
            samples_ambient=scene.has_lamps,
            delta_lamps=len(lamps_of(scene.mitsuba)) > 0 and has_delta(scene.mitsuba),
            refracts=any(mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Transmission) for s in scene.mitsuba.shapes()),
            throws=settings.caustics and has_throwers(scene.mitsuba),
        )


@dataclass(frozen=True, eq=False)
class SampleAllocation:
    """Numbers of samples for some of the pixels, and the projector's light.

    pixels : (n,) int, flat indices in the whole image.
    samples : (n,) uint32, number of samples to be taken of each pixel.
    total : (n,) uint32, number of all samples of each pixel, including those that are taken at other times.
    irradiance : W/m2, irradiance that the projector makes at z = 1 m.
    first : number of the first of the samples among all samples of a pixel, one number or (n,) int.
    stride : int, difference between the numbers of successive pairs of samples.
    part : number of the part of a pass, one number or (n,) int. Parts have independent random numbers.
    """

    pixels: np.ndarray
    samples: np.ndarray
    total: np.ndarray
    irradiance: float
    first: int | np.ndarray = 0
    stride: int = 2
    part: int | np.ndarray = 0

    def in_halves(self) -> SampleAllocation:
        """The same samples of the n pixels as 2 n entries: the first half of each pixel, then the second half of each.

        Each half has every second pair of samples, so that both fill the pixel evenly.
        """
        twice, half = partial(np.tile, reps=2), np.repeat(np.arange(2, dtype=np.uint32), len(self.pixels))
        samples = twice(self.samples)
        pairs, odd = (samples + 1) >> 1, samples & 1
        return SampleAllocation(
            pixels=twice(self.pixels),
            samples=2 * (pairs + 1 - half >> 1) - odd * ((pairs - 1 & 1) == half),
            total=twice(self.total),
            irradiance=self.irradiance,
            first=(self.first if isinstance(self.first, int) else twice(self.first)) + 2 * half,
            stride=2 * self.stride,
            part=2 * self.part + half,
        )


@dataclass
class Radiance(Generic[Array]):
    """Radiance of the projector and of ambient light by kind of light path (see `rangesim.signals.EnergySplit`).

    Sums over the samples of the lanes as `mi.Float`, or means of an image as (h, w) float32; W/m2/sr.
    """

    direct: Array
    multipath: Array
    specular: Array
    caustic: Array
    ambient: Array
    smooth_caustic: Array
    """Caustics at later vertices of a path, which change slowly over the image; `caustic` has those at the first."""
    glint: Array
    """Glint of a beam, whose emitter the paths of its own pixel meet; that of a projector is traced in `glint.py`."""


class PathSums(NamedTuple):
    """Sums over the samples of each entry of an allocation, besides channels.

    radiance : (7, n) float32, in the order of the fields of `Radiance`.
    tally : (6, n) float32, in the order of the fields of `Tally`.
    """

    radiance: np.ndarray
    tally: np.ndarray


@dataclass
class PathState:
    """The light path at work in each lane, from its last interaction on.

    depth : UInt32, surfaces that scattered it so far; a stay inside a medium counts as one.
    chain : UInt32, delta interactions since the last one that scattered it; None in scenes without delta interactions.
    origin, direction : Point3f and Vector3f, the ray that leaves the last interaction; world, metres and unit.
    throughput : Float, radiance at the camera per radiance along the ray.
    ray_state : RayState. Its optical length counts from the camera.
    is_first : Bool, whether the path has met no vertex so far (`rangesim.light_transport.strategies`).
    via_delta : Bool, whether it has met a delta interaction so far, holes aside.
    left_delta : Bool, whether the ray leaves a delta interaction.
    unsampled : Bool, whether only this ray can find the ambient light that it meets. This is so if it leaves the
        camera, a delta interaction or an event inside a medium.
    pdf : Float, 1/sr, density of the BSDF sample that made the ray.
    events : UInt32, scattering events inside media and crossed boundaries so far; None in scenes without media.
    scattered_inside : Bool, whether the path has scattered since it entered the medium; None in scenes without media.
    choice : Float in 0..1, which decides between reflection and refraction, and between lobes, up to the first vertex,
        where no stratum does. It is spread evenly over the samples of a stratum. None in scenes without delta
        interactions.
    turns : UInt32, samples of a period that came to this surface by the main chain, as this path did; 0 if no
        stratum decides any more. None if no pixel has strata.
    from_wide : Bool, whether the last vertex that is no narrow lobe is on a surface. The light that narrow lobes throw
        on such a surface is part of caustics. None if no caustics come over narrow lobes.
    spot : Spot of the lane's beam; None for a projector, and in scenes with media.
    pencil : Pencil of the lane's beam around the path; None for a projector, and in scenes without delta interactions.
    """

    depth: mi.UInt32
    chain: mi.UInt32
    origin: mi.Point3f
    direction: mi.Vector3f
    throughput: mi.Float
    ray_state: RayState
    is_first: mi.Bool
    via_delta: mi.Bool
    left_delta: mi.Bool
    unsampled: mi.Bool
    pdf: mi.Float
    events: mi.UInt32
    scattered_inside: mi.Bool
    choice: mi.Float
    turns: mi.UInt32 | None = None
    from_wide: mi.Bool | None = None
    spot: Spot | None = None
    pencil: Pencil | None = None


@dataclass
class LaneState:
    """Everything that an iteration of the loop changes in a lane; `start` makes it, `walk` changes it.

    Dr.Jit carries it through the loop as one structure. Its classes are dataclasses, and not frozen, because Dr.Jit
    does not look into named tuples. A field that the loop of a scene would never change is None instead, because such a
    field makes Dr.Jit trace the loop a second time.

    sample : UInt32, samples of the pixel that are finished.
    channels : per response its dense channels, Float each (`Accumulators.zeros`).
    """

    sample: mi.UInt32
    random: mi.UInt64
    path: PathState
    channels: list[list[mi.Float]]
    radiance: Radiance[mi.Float]
    tally: Tally[mi.Float]


class View(NamedTuple):
    """Everything that the lanes read: the scene with its devices, the triangles of light, of the projector and of lamps
    of the scene, and the strata of the pixels (None: there are none)."""

    traced: TracedScene
    sheets: SheetScene | None = None
    of_lamps: SheetScene | None = None
    strata: ChainStrata | None = None


def trace(
    view: View,
    settings: PathSettings,
    allocation: SampleAllocation,
    accumulators: Accumulators,
    launches: Launches,
    report: Report,
) -> PathSums:
    """Trace the allocated samples, and return the sums over them; channels go to the accumulators.

    Parameters
    ----------
    accumulators : Accumulators, of the entries of the allocation in the same order.
    launches : Launches, which remember how much work fits into a launch.
    report : called with the fraction done after each launch.
    """
    pixels, runs = accumulators.pixels, _dealt(-(-accumulators.pixels // NEIGHBOURS))
    traced = PathSums(
        np.zeros((len(fields(Radiance)), pixels), np.float32), np.zeros((len(fields(Tally)), pixels), np.float32)
    )
    samples = allocation.samples
    total, begin, finished, iterations = int(samples.sum(dtype=np.int64)), 0, 0, 0

    def tell(state: LaneState) -> None:
        report((finished + float(state.sample.numpy().sum(dtype=np.int64))) / total)

    while begin < len(runs):
        per_sample = iterations / finished if finished else ITERATIONS_PER_SAMPLE
        most = max(min_lanes(), int(launches.units / (per_sample * total / pixels))) // NEIGHBOURS
        left = len(runs) - begin
        end = begin + -(-left // -(-left // most))  # launches of even size
        chosen = Runs(np.sort(runs[begin:end]), NEIGHBOURS, pixels)
        places = chosen.places()
        lanes = Lanes(view, settings, allocation, places)
        loop, state = partial(walk, view, settings, accumulators, lanes), start(view, settings, accumulators, lanes)
        state, taken = launches.run(loop, state, len(places), accumulators.pending, tell)
        accumulators.store(state.channels, chosen)
        _store(state.radiance, traced.radiance, chosen)
        _store(state.tally, traced.tally, chosen)
        begin, finished, iterations = end, finished + int(samples[places].sum(dtype=np.int64)), iterations + taken
    return traced


def _store(sums: Radiance[mi.Float] | Tally[mi.Float], images: np.ndarray, runs: Runs) -> None:
    """Write the evaluated sums of lanes to `images` (k, n), which are 0 where there are none."""
    for image, field in zip(images, fields(sums), strict=True):
        if (values := getattr(sums, field.name)) is not None:
            runs.write(values.numpy(), image)


def _dealt(n: int) -> np.ndarray:
    """The numbers 0..n-1 in an order in which any few successive ones are spread evenly over 0..n-1.

    It is the order of the multiples of the golden ratio modulo n.
    """
    step = next(k for k in range(round(0.6180339887498949 * n), 2 * n + 2) if math.gcd(k, n) == 1)
    return np.arange(n) * step % n


class Lanes:
    """The pixels that a launch works on, one for each lane: everything that the loop does not change.

    Parameters
    ----------
    view, settings, allocation : View, PathSettings and SampleAllocation.
    places : (lanes,) int, indices of the entries in the allocation and in the accumulators. Random numbers do not
        depend on them, but on the flat index of a pixel in the whole image, the part and the seed.
    """

    def __init__(self, view: View, settings: PathSettings, allocation: SampleAllocation, places: np.ndarray) -> None:
        self.place = mi.UInt32(aligned(places, np.uint32))
        self.pixel = mi.UInt32(aligned(allocation.pixels[places], np.uint32))
        self.samples = mi.UInt32(aligned(allocation.samples[places], np.uint32))
        self.total = mi.UInt32(aligned(allocation.total[places], np.uint32))
        self.stride = dr.opaque(mi.UInt32, allocation.stride)
        self.first, self.part = (
            mi.UInt32(aligned(x[places], np.uint32)) if isinstance(x, np.ndarray) else dr.opaque(mi.UInt32, x)
            for x in (allocation.first, allocation.part)
        )
        self.irradiance = dr.opaque(mi.Float, allocation.irradiance)
        width = mi.UInt32(view.traced.camera.size.x)
        self.corner = mi.Point2f(mi.Float(self.pixel % width), mi.Float(self.pixel // width))
        rng = random_stream(settings.seed, self.pixel)
        self.shift = mi.Point2f(rng.next_float32(), rng.next_float32())  # of the places of samples within the pixel
        on_lens = view.traced.camera.has_lens
        self.lens_shift = mi.Point2f(rng.next_float32(), rng.next_float32()) if on_lens else None
        self.choice_shift = random_stream(settings.seed, self.pixel, Stream.SECOND).next_uint32()
        self.random = Continued(of_part(rng, self.part))
        self.branches = view.strata.branches_of(self.pixel, self.total) if view.strata is not None else None
        scene = view.traced.scene
        self.throwers = mi.Bool(table_of(scene, list(map(is_thrower, scene.shapes())))) if settings.throws else None

    def number(self, taken: mi.UInt32) -> mi.UInt32:
        """Number of the next sample among all samples of its pixel, after `taken` of the allocated ones."""
        return self.first + (taken >> 1) * self.stride + (taken & 1)

    def draws(self, number: mi.UInt32) -> Draws:
        """The numbers that decide which triangles of light a sample of this number looks for.

        They depend on the pixel and the seed, as the shift does, and not on the random numbers of the path.
        """
        x, y = (dr.reinterpret_array(mi.UInt32, of_axis) for of_axis in self.shift)
        in_half = ((number >> 2) << 1) + (number & 1)  # pairs of samples belong to the halves in turn
        turn, lobe_turn = in_half + (y >> 4) % TURNS, number + (x >> 4) % TURNS
        return Draws(turn, lobe_turn, mi.sample_tea_float32(x, number))


def start(view: View, settings: PathSettings, accumulators: Accumulators, lanes: Lanes) -> LaneState:
    """The state of lanes that have done nothing yet."""
    n, gathers, in_media = dr.width(lanes.pixel), view.sheets is not None, view.traced.media is not None
    is_beam, meets_delta = isinstance(view.traced.projector, BeamDevice), settings.delta or in_media

    def zeros(exist: bool = True) -> mi.Float:
        return dr.zeros(mi.Float, n) if exist else None

    return LaneState(
        sample=dr.zeros(mi.UInt32, n),
        random=mi.UInt64(lanes.random.rng.state),
        path=PathState(
            depth=dr.zeros(mi.UInt32, n),
            chain=dr.zeros(mi.UInt32, n) if settings.delta else None,
            origin=dr.zeros(mi.Point3f, n),
            direction=dr.zeros(mi.Vector3f, n),
            throughput=dr.ones(mi.Float, n),
            ray_state=RayState.start(view.traced, n, settings.refracts),
            is_first=dr.full(mi.Bool, True, n),
            via_delta=dr.full(mi.Bool, False, n) if meets_delta else None,
            left_delta=dr.full(mi.Bool, False, n) if meets_delta else None,
            unsampled=dr.full(mi.Bool, True, n) if settings.ambient else None,
            pdf=zeros(settings.ambient),
            events=dr.zeros(mi.UInt32, n) if in_media else None,
            scattered_inside=dr.full(mi.Bool, False, n) if in_media else None,
            choice=dr.zeros(mi.Float, n) if settings.delta else None,
            turns=dr.zeros(mi.UInt32, n) if view.strata is not None else None,
            from_wide=dr.full(mi.Bool, False, n) if settings.throws and not is_beam else None,
            spot=Spot.none(n) if is_beam and not in_media else None,
            pencil=Pencil.none(n) if is_beam and settings.delta else None,
        ),
        channels=accumulators.zeros(n),
        radiance=Radiance(
            direct=zeros(),
            multipath=zeros(),
            specular=zeros(meets_delta),
            caustic=zeros(gathers),
            ambient=zeros(settings.ambient),
            smooth_caustic=zeros(gathers),
            glint=zeros(settings.glint and is_beam and settings.delta),
        ),
        tally=Tally(
            first=zeros(),
            further=zeros(),
            before_last=zeros(),
            last=zeros(),
            indirect=zeros(),
            cut=zeros(settings.delta),
        ),
    )


@dr.syntax
def walk(
    view: View,
    settings: PathSettings,
    accumulators: Accumulators,
    lanes: Lanes,
    state: LaneState,
    max_iterations: mi.UInt32,
) -> tuple[LaneState, mi.UInt32]:
    """The state of the lanes after at most `max_iterations` of the loop, and the number of iterations of each lane."""
    traced, sheets, of_lamps, strata = view
    scene, surfaces, camera, projector, media, cutouts, absorbers = traced
    n = dr.width(state.sample)
    is_beam = isinstance(projector, BeamDevice)
    has_spot, has_pencil = state.path.spot is not None, state.path.pencil is not None
    throws = state.path.from_wide is not None
    sees_glint, meets_delta = state.radiance.glint is not None, state.path.left_delta is not None
    flags = mi.RayFlags.All | mi.RayFlags.dNSdUV if has_pencil else mi.RayFlags.All
    left = max_iterations + dr.zeros(mi.UInt32, n)  # iterations
    nothing = Accumulators((), 1)  # the light of lamps is in no channel
    active = (state.sample < lanes.samples) & (left > 0)

    while active:
        path, radiance, tally = state.path, state.radiance, state.tally  # parts of the state, changed in place
        rng = lanes.random.at(state.random)
        # In this iteration: an event inside a medium, or the boundary of one
        scatters, crosses = mi.Bool(False), mi.Bool(False)

        # ---- A new sample starts at the camera -------------------------------------------------------
        starts = path.depth == 0
        if dr.hint(settings.delta, mode="scalar"):
            starts &= path.chain == 0
        if dr.hint(media is not None, mode="scalar"):
            starts &= path.events == 0
        number, total = lanes.number(state.sample), lanes.total
        if dr.hint(strata is not None, mode="scalar"):
            assert lanes.branches is not None
            has_strata = lanes.branches > 0
            stratum = stratum_of(lanes.branches, lanes.choice_shift, number)
            total = dr.select(has_strata, 0, total)  # no sample of a stratum is the lone one at the pixel's centre
            number = dr.select(has_strata, stratum.number, number)
            path.turns = dr.select(starts, dr.select(has_strata, mi.UInt32(PERIOD), 0), path.turns)
        jitter, lens = in_pairs(lanes.shift, lanes.lens_shift, number, total)
        primary = camera.ray_in(lanes.corner, jitter, lens)
        if dr.hint(settings.delta, mode="scalar"):
            path.choice = dr.select(starts, along_golden(lanes.choice_shift, number), path.choice)
        ray = mi.Ray3f(
            dr.select(starts, primary.origin, path.origin), dr.select(starts, primary.direction, path.direction)
        )
        path.ray_state = path.ray_state.restarted(starts, primary.origin, primary.path_offset)
        if dr.hint(primary.exists is not None, mode="scalar"):
            path.throughput = dr.select(starts & ~primary.exists, 0, path.throughput)  # no ray, no light
        if dr.hint(has_pencil, mode="scalar"):
            assert path.pencil is not None
            assert isinstance(projector, BeamDevice)
            path.pencil = path.pencil.replaced(starts, projector.pencil(lanes.pixel, primary.direction))
        if dr.hint(has_spot, mode="scalar"):
            assert path.spot is not None
            xi = mi.Point2f(rng.next_float32(), rng.next_float32())
            spot, random = lit_spot(traced, lanes.pixel, xi, rng.state, lanes.random, settings.delta, starts & active)
            rng = lanes.random.at(random)
            path.spot = path.spot.replaced(starts, spot)

        # ---- Next surface ----------------------------------------------------------------------------
        si = surfaces.ray_intersect(ray, flags, coherent=False, active=active)
        hit = si.is_valid() & active
        met = mi.Point3f(si.p)
        if dr.hint(meets_delta, mode="scalar"):
            si.p = dr.select(path.left_delta, corrected_point(si, path.ray_state.previous, ray.d), met)
        if dr.hint(media is not None, mode="scalar"):
            assert media is not None
            assert path.ray_state.inside is not None
            scatters, crosses = media.event(
                path.ray_state.inside, path.ray_state.previous, ray.d, si, hit, rng.next_float32()
            )
            if dr.hint(has_pencil, mode="scalar"):
                assert path.pencil is not None
                way = dr.norm(si.p - path.ray_state.previous)
                path.pencil.fraction *= dr.exp(-path.ray_state.inside.sigma_t * dr.select(hit, way, 0))
        at_surface = hit & ~scatters
        is_own = at_surface | ~path.scattered_inside if media is not None else at_surface
        # The surface counts towards the depth if it scatters the path; this is known with the next direction
        if dr.hint(media is not None, mode="scalar"):
            arrives = ~(crosses | (scatters & path.scattered_inside))
            path.depth += dr.select(arrives, mi.UInt32(1), mi.UInt32(0))
        else:
            arrives = mi.Bool(True)
            path.depth += 1
        started, arrived = path.ray_state.length, dr.select(arrives, mi.UInt32(1), mi.UInt32(0))
        path.ray_state.length = path.ray_state.length_to(si.p, hit)
        if dr.hint(absorbers is not None, mode="scalar"):
            unabsorbed = path.ray_state.unabsorbed(traced, si.p, hit)
            path.throughput *= unabsorbed
            if dr.hint(has_pencil, mode="scalar"):
                assert path.pencil is not None
                path.pencil.fraction *= unabsorbed
        if dr.hint(has_pencil, mode="scalar"):
            assert path.pencil is not None
            facing = dr.select(scatters, ray.d, si.n)
            path.pencil = path.pencil.arrived(ray.d, dr.norm(si.p - path.ray_state.previous), facing)
        bsdf = si.bsdf(ray)
        is_rough = can_be_vertex(bsdf)
        is_vertex = hit & (path.depth < settings.max_depth) & (scatters | is_rough)
        gathers = is_vertex
        if dr.hint(throws, mode="scalar"):
            is_narrow = dr.gather(mi.Bool, lanes.throwers, number_of(si.shape), at_surface)
            gathers = is_vertex & ~(is_narrow & path.from_wide)

        # ---- The ray meets the emitter of its own beam ------------------------------------------------
        if dr.hint(sees_glint, mode="scalar"):
            assert isinstance(projector, BeamDevice)
            comes_back = active & (path.depth == arrived) & (path.chain > 0)
            seen = projector.glint(ray, lanes.pixel, si, comes_back)
            light = dr.select(seen.meets, path.throughput * seen.radiance * lanes.irradiance, 0)
            u, v = (dr.select(seen.meets, x, 0) for x in (seen.uv.x, seen.uv.y))
            path_length = dr.select(seen.meets, path.ray_state.further(seen.distance, started), 0)
            light_path = LightPath(u, v, path_length, mi.Bool(False), mi.UInt32(GLINT))
            state.channels = accumulators.add(
                state.channels, light_path, light, lanes.place, seen.meets, mi.Bool(False)
            )
            radiance.glint += light

        # ---- Throughput that tells what is left out when paths end: see `truncation` -------------------
        arriving = dr.select(is_vertex & arrives, path.throughput, 0)
        is_later = path.depth > 1
        tally.first += dr.select(is_later, 0, arriving)
        tally.further += dr.select(is_later, arriving, 0)
        tally.before_last += dr.select(path.depth + 2 == settings.max_depth, arriving, 0)
        tally.last += dr.select(path.depth + 1 == settings.max_depth, arriving, 0)

        # ---- Next-event estimation: straight to the projector ----------------------------------------
        is_connected = owner(gathers, delta_interactions=0).next_event
        if dr.hint(is_beam, mode="scalar"):
            # The boundaries of media, which nothing bends at, may lie between a mirror and the vertex
            via_delta = path.chain > 0 if settings.delta else mi.Bool(False) if media is None else path.left_delta
            is_connected &= beam_connects((path.depth == 1) & is_own, via_delta, has_spot)
        link = projector.connect(scene, si, is_connected, lanes.pixel, media, path.ray_state.inside, cutouts)
        if dr.hint(has_pencil, mode="scalar"):
            assert path.pencil is not None
            comes_back = is_vertex & is_own & (path.depth == 1) & (path.chain > 0)
            link = path.pencil.connection(comes_back, ray.d, path.ray_state.length, link)
        fresh = choice = rng.next_float32()
        if dr.hint(settings.delta, mode="scalar"):
            choice = dr.select(path.is_first, path.choice, fresh)
        if dr.hint(strata is not None, mode="scalar"):
            assert strata is not None
            path.turns = dr.select(at_surface & ~is_rough, path.turns, 0)
            way = strata.choice(bsdf, si, stratum, lanes.branches, path.turns, choice)
            choice = way.number
        value, _, bs, bs_weight = bsdf.eval_pdf_sample(
            mi.BSDFContext(),
            si,
            si.to_local(link.direction),
            choice,
            mi.Point2f(rng.next_float32(), rng.next_float32()),
            at_surface,
        )
        value, bs_weight = mono(value), mono(bs_weight)
        wo = si.to_world(bs.wo)
        if dr.hint(media is not None, mode="scalar"):
            medium = path.ray_state.inside
            assert medium is not None
            value = dr.select(scatters, medium.albedo * medium.phase(dr.dot(ray.d, link.direction)), value)
            bs_weight = dr.select(scatters, medium.albedo, bs_weight)
            xi = mi.Point2f(rng.next_float32(), rng.next_float32())
            wo = dr.select(scatters, medium.scattered(ray.d, xi), wo)
        light = dr.select(link.lit, path.throughput * value * link.geometry * lanes.irradiance, 0)
        # No undefined number (u at z = 0, for example) may reach a response: 0 times NaN is not 0
        u, v, path_length = (
            dr.select(link.lit, x, 0) for x in (link.uv.x, link.uv.y, path.ray_state.length + link.distance)
        )
        kind = next_event_kind(path.is_first, path.via_delta if meets_delta else mi.Bool(False))
        light_path = LightPath(u, v, path_length, path.is_first, kind, link.blur_px)
        state.channels = accumulators.add(state.channels, light_path, light, lanes.place, link.lit, kind == MULTIPATH)
        radiance.direct += dr.select(kind == DIRECT, light, 0)
        if dr.hint(meets_delta, mode="scalar"):
            radiance.specular += dr.select(kind == SPECULAR, light, 0)
        radiance.multipath += dr.select(kind == MULTIPATH, light, 0)
        tally.indirect += dr.select(is_later, light, 0)

        # ---- The spot of the beam: light that another vertex throws on this one -----------------------
        if dr.hint(has_spot, mode="scalar"):
            assert path.spot is not None
            looks = is_vertex & (path.depth + 1 < settings.max_depth)
            brought = connect_to_spot(traced, path.spot, si, looks)
            thrown = mono(bsdf.eval(mi.BSDFContext(), si, si.to_local(brought.direction), looks))
            light = path.throughput * thrown * brought.irradiance * lanes.irradiance
            is_lit = light > 0
            light = dr.select(is_lit, light, 0)
            u, v, path_length = (
                dr.select(is_lit, x, 0) for x in (path.spot.u, path.spot.v, path.ray_state.length + brought.length)
            )
            light_path = LightPath(u, v, path_length, mi.Bool(False), mi.UInt32(MULTIPATH))
            state.channels = accumulators.add(state.channels, light_path, light, lanes.place, is_lit, mi.Bool(True))
            radiance.multipath += light
            tally.indirect += light

        # ---- Caustics: light that reached this point through glass or off mirrors --------------------
        if dr.hint(sheets is not None, mode="scalar"):
            vertex = Vertex(si, bsdf, path.throughput, path.ray_state.length, path.is_first & ~link.lit)
            state.channels, sharp, smooth = caustic_light(
                sheets,
                accumulators,
                state.channels,
                vertex,
                lanes.draws(number),
                is_later,
                lanes.place,
                gathers & ~scatters,
            )
            radiance.caustic += sharp
            radiance.smooth_caustic += smooth
            tally.indirect += dr.select(is_later, smooth, 0)

        # ---- Ambient light: next-event estimation and emission, weighted by MIS ----------------------
        if dr.hint(settings.ambient, mode="scalar"):
            before = dr.zeros(mi.Interaction3f, n)
            before.p = path.ray_state.previous
            alone = path.unsampled | (not settings.samples_ambient)
            radiance.ambient += path.throughput * ambient_on_ray(scene, si, before, path.pdf, alone, active & ~scatters)
            if dr.hint(settings.samples_ambient, mode="scalar"):
                xi = mi.Point2f(rng.next_float32(), rng.next_float32())
                if dr.hint(media is None, mode="scalar"):
                    light = sampled_ambient(traced, bsdf, si, path.ray_state, xi, settings.delta_lamps, is_vertex)
                else:
                    light = sampled_ambient_through_media(
                        traced, bsdf, si, ray.d, path.ray_state, scatters, xi, settings.delta_lamps, is_vertex
                    )
                radiance.ambient += path.throughput * light
            if dr.hint(of_lamps is not None, mode="scalar"):
                vertex = Vertex(si, bsdf, path.throughput, path.ray_state.length, mi.Bool(False))
                _, sharp, smooth = caustic_light(
                    of_lamps,
                    nothing,
                    [],
                    vertex,
                    lanes.draws(number),
                    is_later,
                    lanes.place,
                    is_vertex & ~scatters,
                )
                radiance.ambient += sharp + smooth

        # ---- Next direction --------------------------------------------------------------------------
        goes_delta = is_delta(bs)
        if dr.hint(throws, mode="scalar"):
            path.from_wide = dr.select(is_narrow | (goes_delta & at_surface), path.from_wide, ~scatters)
        if dr.hint(has_pencil, mode="scalar"):
            assert path.pencil is not None
            bends = goes_delta & at_surface
            eta = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission), bs.eta, 1)
            turned = path.pencil.turned(ray.d, si, wo, eta)
            # `bs_weight` is that of radiance, which falls by eta^2 on the way into glass; power does not
            turned.fraction *= bs_weight * bs.pdf * dr.square(eta)
            path.pencil = path.pencil.replaced(bends, turned)
        if dr.hint(settings.delta, mode="scalar"):
            # Masks do not tell the probability of their decision
            decided = goes_delta & at_surface & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            left_over = dr.select(decided, used_up(path.choice, bs.pdf), fresh)
            if dr.hint(strata is not None, mode="scalar"):
                bs_weight *= way.factor
                path.turns = way.turns
                left_over = dr.select(way.is_made, way.left_over, left_over)
            path.choice = left_over
        path.throughput *= bs_weight
        path.ray_state = path.ray_state.refracted(bs, at_surface)
        if dr.hint(meets_delta, mode="scalar"):
            path.left_delta = goes_delta & ~crosses
        if dr.hint(settings.delta, mode="scalar"):
            path.depth -= dr.select(path.left_delta, mi.UInt32(1), mi.UInt32(0))
            path.chain = dr.select(crosses, path.chain, dr.select(path.left_delta, path.chain + 1, 0))
        fraction = path.ray_state.power(path.throughput)  # this fraction of the light is left on the path
        chance = dr.select(path.depth > settings.rr_depth, dr.minimum(fraction, 0.95), 1)
        if dr.hint(settings.delta, mode="scalar"):
            chance = dr.minimum(chance, survival(path.chain, fraction))
        if dr.hint(media is not None, mode="scalar"):
            inside_chance = dr.minimum(path.throughput / ROULETTE_BELOW, 1)
            chance = dr.select(scatters, inside_chance, dr.select(crosses, 1, chance))
        survives = rng.next_float32() < chance
        path.throughput /= chance
        passes = mi.Bool(False)  # through a hole, as if nothing were there
        if dr.hint(cutouts is not None, mode="scalar"):
            assert cutouts is not None
            passes = cutouts.passed(si, bs, at_surface)
        path.is_first &= ~scatters & (passes | ~is_rough)
        path.ray_state = path.ray_state.restarted(True, si.p, path.ray_state.length)
        if dr.hint(settings.ambient, mode="scalar"):
            path.pdf = mi.Float(bs.pdf)
            path.unsampled = goes_delta | scatters
        ray = si.spawn_ray(wo)
        if dr.hint(meets_delta, mode="scalar"):
            path.via_delta |= goes_delta & ~passes
            ray.o = dr.select(path.left_delta, spawn_specular_ray(si, met, wo).o, ray.o)
        if dr.hint(media is not None, mode="scalar"):
            path.events += dr.select(scatters | crosses, mi.UInt32(1), mi.UInt32(0))
            path.scattered_inside = scatters | (path.scattered_inside & ~crosses)
        path.ray_state = path.ray_state.entering(traced, si, wo, at_surface, crosses)

        # ---- Or next sample --------------------------------------------------------------------------
        # A path meets its last surface only for the light that this surface emits itself, which is ambient light
        last = settings.max_depth if settings.ambient else settings.max_depth - 1
        goes_on = path.depth < last
        if dr.hint(media is not None, mode="scalar"):
            goes_on |= (scatters | crosses) & (path.depth < settings.max_depth) & (path.events < MAX_EVENTS)
        goes_on &= hit & survives & (path.throughput > 0)
        if dr.hint(settings.delta, mode="scalar"):
            too_long = goes_on & (path.chain >= MAX_CHAIN)
            tally.cut += dr.select(too_long, path.ray_state.power(path.throughput), 0)
            goes_on &= path.chain < MAX_CHAIN
        ends = ~goes_on
        state.sample = dr.select(ends, state.sample + 1, state.sample)
        path.depth = dr.select(ends, 0, path.depth)
        if dr.hint(settings.delta, mode="scalar"):
            path.chain = dr.select(ends, 0, path.chain)
        path.throughput = dr.select(ends, 1, path.throughput)
        path.ray_state = path.ray_state.reset(traced, ends)
        path.is_first |= ends
        if dr.hint(throws, mode="scalar"):
            path.from_wide &= ~ends
        if dr.hint(meets_delta, mode="scalar"):
            path.via_delta &= ~ends
            path.left_delta &= ~ends
        if dr.hint(settings.ambient, mode="scalar"):
            path.unsampled |= ends
        if dr.hint(media is not None, mode="scalar"):
            path.events = dr.select(ends, 0, path.events)
            path.scattered_inside &= ~ends
        state.random, path.origin, path.direction = rng.state, ray.o, ray.d
        left -= 1
        active = (state.sample < lanes.samples) & (left > 0)

    return state, max_iterations - left
