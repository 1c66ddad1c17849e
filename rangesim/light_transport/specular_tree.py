# SPDX-License-Identifier: Apache-2.0
"""Trees of specular chains: the light of a point of a source's image on its way through glass and off mirrors.

At glass a ray splits in two: one part is reflected, the other refracted. Both are followed, each with its fraction of
the light, so a point of the image always lights the same places. A chain is named by a key, which depends on the
surfaces that it met and on the choices between reflection and refraction. Chains of the same key through neighbouring
points differ smoothly.

A launch follows every ray along its stronger part. The weaker parts are stored, and are the rays of the next launch.

Polished metal is no mirror: it scatters light into a narrow lobe. There a ray splits into several parts, one for each
point of a fixed set over the unit square, from which the BSDF samples its lobe. For one of these points, the metal is a
mirror whose normal is turned a little, and its chains differ as smoothly as others.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.delta_sources import DeltaSource
from rangesim.light_transport.delta_surfaces import is_thrower
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.sampling import R2, Continued, aligned
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN, RayState, corrected_point, spawn_specular_ray
from rangesim.light_transport.strategies import can_be_vertex, is_delta
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene

PARTS = 6
"""Largest number of weaker parts that a ray stores in a launch. Light through three panes meets six faces. A part that
finds no room is dropped by a point of the grid; a photon then follows one of the two parts by chance."""
EARLIER = 3
"""Largest number of landings of a lane before its last one, in scenes with coats: light that met four coats has less
than a hundred-thousandth left, unless it grazes them."""
LANDED_PART = 2
"""Place of `part` among the leaves of a landing."""
LAUNCHES = 3
"""Largest number of launches for points of the grid. In the last one nothing is stored: weaker parts are dropped,
because light that was the weaker part twice carries little."""
LAUNCHES_OF_PHOTONS = 2
"""Largest number of launches for photons. In the last one they choose one part by chance, because most of their light
is in the first."""
HASH_STEP = 0x9E3779B1
"""Odd factor of the hash that names chains: 2^32 divided by the golden ratio, rounded to a prime."""
HASH_FACTOR = 0x85EBCA6B
"""A second odd factor of this hash, whose bits have nothing to do with those of the first (MurmurHash3, Appleby)."""
NORMAL_STEPS = 1000.0
"""Number of steps per unit to which the normals of flat faces are rounded in a key, so that light through different
faces of a mesh has different keys; faces closer than 0.06 degrees count as one."""
LOBE_POINTS = 64
"""Largest number of directions, a power of two, into which a narrow lobe sends light. The edge of what one of them
lights is a step of a 64th of the light."""
LOBE_GROUPS = 16
"""Number of groups of these directions, and the smallest number of directions. A sample of a pixel looks for the light
of one group, so 16 samples look for all of it once."""
LOBE_RAYS = 1 << 20
"""Number of rays from pixels of the projector that meet narrow lobes, times the directions of each, up to which there
are `LOBE_POINTS`. With more, many metal parts would take ten times as long as all the rest of a pass."""
LOBE_TURN = 26
"""Even number that decides how the points of the lobes at successive surfaces are combined, so that all pairs are
spread evenly."""
NEEDS_LOBE = 0xFFFFFFFF
"""Value of `Parts.lobe` of a ray that is about to meet its first narrow lobe."""
STREAM_STEP = 0x9E3779B97F4A7C15
"""Difference between random states of parts of a photon: 2^64 divided by the golden ratio, rounded to an odd number."""
EXACT_BSDFS = ("SmoothDielectric", "ThinDielectric", "SmoothConductor", "SmoothPlastic", "Null")
"""Class names of BSDFs whose delta lobes can be asked for one by one, each with its exact weight; `twosided` around
them is exact as well. Blends and masks choose by chance."""


class Parts(NamedTuple):
    """Parts of light on their way along specular chains, one in each lane.

    point : UInt32, index of the point of the image from which the light came.
    part : Float, fraction of the light of the point.
    origin, direction : Point3f and Vector3f, world.
    state : RayState.
    key : UInt32, name of the chain so far.
    chain : UInt32, number of delta interactions so far, holes and boundaries of media aside.
    lobe : UInt32, number of the point of the lobes, from 1 on; 0 if the light met no narrow lobe. None if no lobes are
        followed.
    random : UInt64, state of the random numbers; None for points of the grid.
    """

    point: mi.UInt32
    part: mi.Float
    origin: mi.Point3f
    direction: mi.Vector3f
    state: RayState
    key: mi.UInt32
    chain: mi.UInt32
    lobe: mi.UInt32
    random: mi.UInt64 = None


class Landings(NamedTuple):
    """The m places where light landed beyond delta interactions.

    point : (m,) uint32, index of the point of the image.
    key : (m,) uint32, name of the chain and of the shape that it ends on.
    shape : (m,) uint32, number of that shape (`surfaces.number_of`).
    part : (m,) float32, fraction of the light of the point.
    length : (m,) float32, metres, optical length.
    ior : (m,) float32, refractive index in front of the surface.
    last : (m,) float32, metres, distance from the last delta interaction.
    position, normal, direction : (m, 3) float32, world; metres, geometric normal, and direction of flight.
    lobe : (m,) uint32, number of the point of the narrow lobes that the light met, from 1 on; 0 if it met none.
    """

    point: np.ndarray
    key: np.ndarray
    shape: np.ndarray
    part: np.ndarray
    length: np.ndarray
    ior: np.ndarray
    last: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    direction: np.ndarray
    lobe: np.ndarray


class SpecularTree:
    """Follows light through the delta surfaces of a scene.

    Parameters
    ----------
    traced : TracedScene
    launches : Launches.
    lobe_points : (k, 2) float64, points of the unit square from which narrow lobes are sampled, see `lobe_points`;
        None: light is not followed over narrow lobes.
    """

    def __init__(self, traced: TracedScene, launches: Launches, lobe_points: np.ndarray | None = None) -> None:
        shapes = traced.scene.shapes()
        self.traced, self.launches = traced, launches
        # Keys name shapes by their order in the scene: their own numbers depend on what else the process has loaded
        self.order = mi.UInt32(table_of(traced.scene, np.arange(len(shapes), dtype=np.uint32)))
        self.is_flat = mi.Bool(table_of(traced.scene, [_is_flat(shape) for shape in shapes]))
        self.is_exact = mi.Bool(table_of(traced.scene, [_is_exact(shape.bsdf()) for shape in shapes]))
        self.lands_twice = sum(_lands_and_goes_on(shape.bsdf()) for shape in shapes) > 0
        self.points = 1 if lobe_points is None else len(lobe_points)
        self.has_lobes = lobe_points is not None
        if lobe_points is not None:
            self.has_lobe = mi.Bool(table_of(traced.scene, list(map(is_thrower, shapes))))
            self.lobe_points = mi.Float(aligned(lobe_points, np.float32))
            self.last_point = dr.opaque(mi.UInt32, self.points - 1)
        self.max_chain, self.earlier = dr.opaque(mi.UInt32, MAX_CHAIN), dr.opaque(mi.UInt32, EARLIER)

    def follow(
        self,
        source: DeltaSource,
        pixel: mi.Point2f,
        lens: mi.Point2f | None,
        fewest: float,
        random: mi.UInt64 | None = None,
    ) -> tuple[Landings, np.ndarray]:
        """Follow the light of points of the image to where it lands.

        Parameters
        ----------
        pixel, lens : n points of the image, and the point of the lens, as for `DeltaSource.rays`.
        fewest : fraction of a point's light below which a part is dropped. Photons keep some of these parts by Russian
            roulette, so that none is left out in the mean.
        random : UInt64, states of the random numbers of photons; None for points of the grid, which drop parts and are
            stopped by surfaces whose lobes cannot be asked for one by one.

        Returns
        -------
        landings : Landings.
        dropped : (n,) float64, fraction of each point's light in parts that were dropped.
        """
        primary, fraction = source.rays(pixel, lens)
        n = dr.width(primary.direction)
        state = source.start(self.traced, n)
        state = state.restarted(True, primary.origin, primary.path_offset + dr.zeros(mi.Float, n))
        part = dr.ones(mi.Float, n) * fraction
        origin = mi.Point3f(primary.origin) + dr.zeros(mi.Point3f, n)
        none = dr.zeros(mi.UInt32, n)
        parts = Parts(dr.arange(mi.UInt32, n), part, origin, primary.direction, state, none, mi.UInt32(none),
                      mi.UInt32(none) if self.has_lobes else None, random)  # fmt: skip
        # All parts share an increment; their states differ
        chance = None if random is None else Continued(mi.PCG32(1))
        self.fewest = dr.opaque(mi.Float, fewest)
        dropped, found = np.zeros(n), []
        launches = (LAUNCHES if random is None else LAUNCHES_OF_PHOTONS) + self.has_lobes
        for left in reversed(range(launches)):
            self.room = dr.opaque(mi.UInt32, PARTS if left else 0)
            leaves = _leaves(parts)
            dr.make_opaque(leaves)
            parts = _rebuilt(parts, list(leaves))
            lanes = dr.width(parts.part)
            stored = _Stored(parts, lanes, PARTS + self.has_lobes)
            none_landed = _Landing.none(lanes, self.has_lobes)
            earlier = _Stored(none_landed, lanes, EARLIER) if self.lands_twice else None
            landing, lost = _strongest(self, parts, stored, earlier, chance)
            self.launches.evaluate([landing, stored.leaves, lost, earlier.leaves if earlier else []], lanes)
            point = parts.point.numpy()
            share = np.ones(lanes, np.float32)
            if self.has_lobes:  # a point of a lobe has a fraction of its light
                share = np.where(parts.lobe.numpy() > 0, np.float32(1 / self.points), np.float32(1))
            dropped += np.bincount(point, lost.numpy() * share, n)  # in the same order on any machine
            for leaves in [_leaves(landing), *([earlier.leaves] if earlier else [])]:
                landed = dr.compress(leaves[LANDED_PART] > 0)
                columns = [dr.gather(type(x), x, landed) for x in leaves]
                dr.eval(columns)
                lane, values = landed.numpy() % lanes, [x.numpy() for x in columns]
                if self.has_lobes:
                    values[LANDED_PART] = values[LANDED_PART] * share[lane]
                else:
                    values.append(np.zeros(len(lane), np.uint32))
                found.append([point[lane], *values])
            rest = dr.compress(stored.part > 0)
            if not len(rest):
                break
            parts = _rebuilt(parts, [dr.gather(type(x), x, rest) for x in stored.leaves])
            if self.has_lobes:
                parts = _in_lobes(parts, self.points)
        numbers = [np.concatenate(column) for column in zip(*found, strict=True)]
        vectors = [np.column_stack(numbers[k : k + 3]) for k in (7, 10, 13)]
        return Landings(*numbers[:7], *vectors, *numbers[16:]), dropped


@dataclass
class _Landing:
    """A landing in each lane, as in `Landings`; its part is 0 where there is none. Loops of Dr.Jit carry it."""

    key: mi.UInt32
    shape: mi.UInt32
    part: mi.Float
    length: mi.Float
    ior: mi.Float
    last: mi.Float
    position: mi.Point3f
    normal: mi.Vector3f
    direction: mi.Vector3f
    lobe: mi.UInt32

    @classmethod
    def none(cls, lanes: int, has_lobes: bool) -> _Landing:
        """No landing on any lane."""
        whole, real = [dr.zeros(mi.UInt32, lanes) for _ in range(2)], [dr.zeros(mi.Float, lanes) for _ in range(4)]
        vectors = (dr.zeros(kind, lanes) for kind in (mi.Point3f, mi.Vector3f, mi.Vector3f))
        lobe = [dr.zeros(mi.UInt32, lanes) if has_lobes else None]
        return cls(*whole, *real, *vectors, *lobe)


class _Stored:
    """Room for `Parts` or landings of each lane. Dr.Jit does not look into this class, so loops do not carry the
    arrays.

    Parameters
    ----------
    like : a structure as those to be stored.
    lanes : int. room : largest number of structures of a lane.
    """

    def __init__(self, like: Parts | _Landing, lanes: int, room: int) -> None:
        self.lane, self.lanes = dr.arange(mi.UInt32, lanes), dr.opaque(mi.UInt32, lanes)
        self.leaves = [dr.empty(type(x), room * lanes) for x in _leaves(like)]
        self.place = next(i for i, x in enumerate(_leaves(like)) if x is like.part)
        self.leaves[self.place] = dr.zeros(mi.Float, room * lanes)

    @property
    def part(self) -> mi.Float:
        """Fraction of the light of each structure that was stored; 0 where there is none."""
        return self.leaves[self.place]

    def add(self, parts: Parts | _Landing, number: mi.UInt32, active: mi.Bool) -> None:
        """Store a structure of each lane, after `number` that the lane stored before."""
        place = dr.fma(number, self.lanes, self.lane)
        for target, value in zip(self.leaves, _leaves(parts), strict=True):
            dr.scatter(target, value, place, active)


def lobe_points(lobe_pixels: float, seed: int) -> np.ndarray:
    """(points, 2) float64, the points of the unit square from which narrow lobes are sampled.

    They are those of the R2 sequence. Point i belongs to group i modulo `LOBE_GROUPS`; a group has some points of the
    sequence in a row, which are spread over the square. The seed shifts all points alike.

    Parameters
    ----------
    lobe_pixels : number of the projector's pixels whose light meets narrow lobes first.
    seed : int, 0 to 2^64 - 1.
    """
    points = LOBE_POINTS
    while points > LOBE_GROUPS and points * lobe_pixels > LOBE_RAYS:
        points //= 2
    number = np.arange(points).reshape(LOBE_GROUPS, -1).T.ravel()
    return np.asarray((np.random.default_rng(seed).random(2) + np.outer(number, R2)) % 1.0)


def _in_lobes(parts: Parts, points: int) -> Parts:
    """The parts, with one for each point of the lobes instead of those that are about to meet their first narrow
    lobe."""
    lobe = parts.lobe.numpy()
    others, met = np.flatnonzero(lobe != NEEDS_LOBE), np.flatnonzero(lobe == NEEDS_LOBE)
    source = mi.UInt32(aligned(np.concatenate([others, np.repeat(met, points)]), np.uint32))
    chosen = np.tile(np.arange(1, points + 1), len(met))
    parts = _rebuilt(parts, [dr.gather(type(x), x, source) for x in _leaves(parts)])
    parts = parts._replace(lobe=mi.UInt32(aligned(np.concatenate([lobe[others], chosen]), np.uint32)))
    return parts if parts.random is None else parts._replace(random=parts.random + mi.UInt64(parts.lobe) * STREAM_STEP)


@dr.syntax
def _strongest(tree, parts, stored, earlier, numbers):  # type: ignore[no-untyped-def]
    """Follow every part along the stronger of the two parts into which surfaces split it.

    Returns
    -------
    landing : _Landing, the last of each lane; those before it are in `earlier`.
    lost : Float, fraction of the light in parts that were dropped.
    """
    traced = tree.traced
    media, absorbers = traced.media, traced.absorbers
    n = dr.width(parts.part)
    reflects, transmits, any_lobe = (mi.BSDFContext(mi.TransportMode.Importance) for _ in range(3))
    reflects.type_mask = mi.BSDFFlags.DeltaReflection
    transmits.type_mask = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.Null
    any_lobe.type_mask = mi.BSDFFlags.Delta
    if dr.hint(tree.has_lobes, mode="scalar"):
        reflects.type_mask |= mi.BSDFFlags.GlossyReflection
        transmits.type_mask |= mi.BSDFFlags.GlossyTransmission

    origin, direction, state = parts.origin, parts.direction, parts.state
    part, key, chain, lobe, random = parts.part, parts.key, parts.chain, parts.lobe, parts.random
    number = dr.zeros(mi.UInt32, n)  # of parts stored
    lost, left = dr.zeros(mi.Float, n), tree.max_chain + dr.zeros(mi.UInt32, n)
    landing, landings = _Landing.none(n, tree.has_lobes), dr.zeros(mi.UInt32, n)
    active = part > 0
    while active:
        if dr.hint(tree.has_lobes, mode="scalar"):
            before, part_before = replace(state), mi.Float(part)
        # ---- Next surface ----------------------------------------------------------------------------
        ray = mi.Ray3f(origin, direction)
        si = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit, crosses = si.is_valid() & active, mi.Bool(False)
        point = dr.select(chain > 0, corrected_point(si, state.previous, ray.d), si.p)
        if dr.hint(absorbers is not None, mode="scalar"):
            part *= state.unabsorbed(traced, point, hit)
        if dr.hint(media is not None, mode="scalar"):
            crosses = hit & media.bounded_by(si, hit)
            part *= dr.select(hit, dr.exp(-state.inside.sigma_t * dr.norm(point - state.previous)), 1)
        state.length = state.length_to(point, hit)
        bsdf, shape = si.bsdf(ray), number_of(si.shape)
        order = dr.gather(mi.UInt32, tree.order, shape, hit)
        mirrors = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        throws, xi = mi.Bool(False), mi.Point2f(0.5, 0.5)
        if dr.hint(tree.has_lobes, mode="scalar"):
            throws = hit & dr.gather(mi.Bool, tree.has_lobe, shape, hit)

        # ---- Light that the surface scatters lands here ------------------------------------------------
        lands = hit & can_be_vertex(bsdf) & (chain > 0)
        if dr.hint(tree.has_lobes, mode="scalar"):
            lands &= ~throws | (lobe == 0)
        last, normal = dr.norm(point - state.previous), mi.Vector3f(si.n)
        here = _Landing(_named(key, 3 * order), shape, part, state.length, state.ior, last, point, normal, ray.d, lobe)
        if dr.hint(earlier is not None, mode="scalar"):
            again = lands & (landing.part > 0) & (landings < tree.earlier)
            earlier.add(landing, landings, again)
            landings += dr.select(again, mi.UInt32(1), mi.UInt32(0))
        landing = dr.select(lands, here, landing)

        # ---- At its first narrow lobe, light waits to be split into the points of the lobe -------------
        if dr.hint(tree.has_lobes, mode="scalar"):
            defers = throws & (lobe == 0)
            stored.add(Parts(parts.point, part_before, origin, direction, before, key, chain, mi.UInt32(NEEDS_LOBE),
                             random), mi.UInt32(PARTS), defers & (tree.room > 0))  # fmt: skip
            lost += dr.select(defers & (tree.room == 0), part, 0)
            lobe = dr.select(defers, NEEDS_LOBE, lobe)
            throws &= ~defers
            mirrors = (mirrors | throws) & ~defers
            of_lobe = ((lobe - 1) * (LOBE_TURN * chain + 1)) & tree.last_point
            xi = dr.select(throws, dr.gather(mi.Point2f, tree.lobe_points, of_lobe, throws), xi)
            key = dr.select(throws, _named(key, lobe), key)

        # ---- The rest splits into a reflected and a refracted part -------------------------------------
        face = dr.round(si.n * NORMAL_STEPS)
        face = [mi.UInt32(mi.Int32(x)) for x in (face.x, face.y, face.z)]
        place = order + dr.select(dr.gather(mi.Bool, tree.is_flat, shape, hit), _mixed(face), 0)
        splits = mirrors & (dr.gather(mi.Bool, tree.is_exact, shape, hit) | crosses | throws)
        bs_r, weight_r = bsdf.sample(reflects, si, mi.Float(0.5), xi, splits)
        bs_t, weight_t = bsdf.sample(transmits, si, mi.Float(0.5), xi, splits)
        part_r, part_t = (dr.select(splits, part * mono(w), 0) for w in (weight_r, weight_t))
        if dr.hint(numbers is not None, mode="scalar"):
            rng = numbers.at(random)
            chosen, weight = bsdf.sample(
                any_lobe, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), mirrors & ~splits
            )
            alone = mirrors & ~splits & is_delta(chosen)
            part_t = dr.select(alone, part * mono(weight), part_t)
            bs_t = dr.select(alone, chosen, bs_t)
            random = rng.state
        else:
            lost += dr.select(mirrors & ~splits, part, 0)
        turns = part_r > part_t
        d_r, d_t = si.to_world(bs_r.wo), si.to_world(bs_t.wo)
        start = state.restarted(mirrors, point, state.length)
        after_r = start.entering(traced, si, d_r, mirrors, mi.Bool(False))
        after_t = start.refracted(bs_t, mirrors).entering(traced, si, d_t, mirrors, crosses)
        key_r, key_t = _named(key, 3 * place + 1), _named(key, 3 * place + 2)
        o_r, o_t = spawn_specular_ray(si, si.p, d_r).o, spawn_specular_ray(si, si.p, d_t).o
        # Next-event estimation owns the light that went through nothing but holes
        passes = mi.Bool(crosses)
        if dr.hint(traced.cutouts is not None, mode="scalar"):
            passes |= traced.cutouts.passed(si, bs_t, mirrors)
        chain_r, chain_t = (chain + dr.select(w, mi.UInt32(1), mi.UInt32(0)) for w in (mirrors, mirrors & ~passes))

        # ---- The weaker one is stored, the stronger one goes on ----------------------------------------
        weaker, stronger = dr.minimum(part_r, part_t), dr.maximum(part_r, part_t)
        if dr.hint(numbers is not None, mode="scalar"):
            rng = numbers.at(random)
            kept = dr.select(rng.next_float32() * tree.fewest < weaker, dr.maximum(weaker, tree.fewest), 0)
            stronger = dr.select(rng.next_float32() * tree.fewest < stronger, dr.maximum(stronger, tree.fewest), 0)
            # Without room for both, one of them stands for both
            is_full = (kept > 0) & (number >= tree.room)
            swaps = is_full & (rng.next_float32() * (kept + stronger) < kept)
            turns ^= swaps
            stronger = dr.select(is_full, kept + stronger, stronger)
            kept = dr.select(is_full, 0, kept)
            random = rng.state
        else:
            kept = dr.select((weaker >= tree.fewest) & (number < tree.room), weaker, 0)
            lost += weaker - kept
            lost += dr.select(stronger < tree.fewest, stronger, 0)
            stronger = dr.select(stronger < tree.fewest, 0, stronger)
        aside = Parts(parts.point, kept, dr.select(turns, o_t, o_r), dr.select(turns, d_t, d_r),
                      dr.select(turns, after_t, after_r), dr.select(turns, key_t, key_r),
                      dr.select(turns, chain_t, chain_r), lobe, random)  # fmt: skip
        stored.add(aside, number, kept > 0)
        number += dr.select(kept > 0, mi.UInt32(1), mi.UInt32(0))
        part, key, chain = stronger, dr.select(turns, key_r, key_t), dr.select(turns, chain_r, chain_t)
        origin, direction = dr.select(turns, o_r, o_t), dr.select(turns, d_r, d_t)
        state = dr.select(turns, after_r, after_t)
        left -= 1
        lost += dr.select(left == 0, part, 0)
        active &= mirrors & (part > 0) & (left > 0)
    return landing, lost


def _named(key: mi.UInt32, step: mi.UInt32) -> mi.UInt32:
    """Name of a chain after a further step, so mixed that two chains hardly ever have the same name.

    Without the shifts, light that is reflected and light that is refracted would have one name on two shapes whose
    numbers differ in their last bits.
    """
    x = (key ^ step * HASH_STEP) * HASH_FACTOR
    x = (x ^ (x >> 15)) * HASH_STEP
    return x ^ (x >> 16)


def _mixed(numbers: list[mi.UInt32]) -> mi.UInt32:
    """One number from three, so that different triples hardly ever give the same."""
    a, b, c = numbers
    return ((a * HASH_STEP ^ b) * HASH_STEP ^ c) * HASH_STEP


def _is_flat(shape: mi.Shape) -> bool:
    """Whether a shape is a mesh whose faces look flat."""
    is_mesh = shape.shape_type() == mi.ShapeType.Mesh.value
    return bool(is_mesh and (shape.has_face_normals() or not shape.has_vertex_normals()))


def _lands_and_goes_on(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF both scatters light and has delta lobes, as a polished coat."""
    return bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta))


def _is_exact(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF has delta lobes, which can be asked for one by one."""
    if not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta):
        return False
    parts = mi.traverse(bsdf).hierarchy if bsdf.class_name() == "TwoSidedBRDF" else {bsdf: None}
    names = {one.class_name() for one in parts if isinstance(one, mi.BSDF)}
    return names <= {*EXACT_BSDFS, "TwoSidedBRDF"}


# ---- Structures as lists of arrays -----------------------------------------------------------------------


def _leaves(value: Any) -> list[Any]:
    """The Dr.Jit arrays with one number per lane that a structure holds, in a fixed order."""
    if value is None:
        return []
    if isinstance(value, (mi.Point3f, mi.Vector3f)):
        return [value.x, value.y, value.z]
    if is_dataclass(value):
        return [x for f in fields(value) for x in _leaves(getattr(value, f.name))]
    return [x for one in value for x in _leaves(one)] if isinstance(value, tuple) else [value]


def _rebuilt(like: Any, arrays: list[Any]) -> Any:
    """A structure like `like` of these arrays, in the order of `_leaves`; takes them from the front of the list."""
    if like is None:
        return None
    if isinstance(like, (mi.Point3f, mi.Vector3f)):
        return type(like)(arrays.pop(0), arrays.pop(0), arrays.pop(0))
    if is_dataclass(like):
        of: Any = type(like)
        return of(*(_rebuilt(getattr(like, f.name), arrays) for f in fields(like)))
    return type(like)(*(_rebuilt(one, arrays) for one in like)) if isinstance(like, tuple) else arrays.pop(0)
