# SPDX-License-Identifier: Apache-2.0
"""A warning: narrow lobes throw light onto other surfaces, where light paths rarely find it.

A mirror is a delta interaction, and caustics carry its light, as they carry that of polished metal and glass
(`roughconductor`, `roughdielectric`). Other narrow lobes are left to paths: those of a polished `principled` BSDF, of
coats, and all of them if caustics are switched off. A path from the lit wall meets such a lobe by chance once in ten
thousand times, and the sampling error does not contain light that no sample found. So rays of the projector are
followed here, through lobes and delta interactions, to the surfaces that scatter them.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.errors import warn
from rangesim.light_transport.beams import BeamDevice
from rangesim.light_transport.delta_surfaces import is_thrower
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.scene.materials import MAX_NARROW_ALPHA, has_narrow_lobe

RAYS = (128, 128)
"""Columns and rows of the grid of rays over the projector's pixels. The smallest surface that the rays find is about as
large as one cell of the grid; the time is in proportion to the number of cells."""
MAX_SURFACES = 8
"""Number of surfaces over which a ray is followed, so that its time is bounded; a hollow glass has four."""
MIN_THROWN = 0.005
"""Fraction of the projector's light, thrown onto other surfaces by narrow lobes, above which a pass warns. A smaller
value would warn of light that changes few readings."""
MIN_NAMED = 0.1
"""Fraction of the thrown light that a shape throws or receives, above which the warning names the shape, so that it
names only shapes that matter."""
MAX_NAMED = 3
"""Largest count of shapes that the warning names, so that it stays one sentence."""


class ThrownLight(NamedTuple):
    """Fraction of the projector's light that reached a surface by way of a narrow lobe, by shape.

    by : (shapes,) float64, by the shape that has the lobe, in the order of the scene's shapes.
    onto : (shapes,) float64, by the shape that the light reached.
    """

    by: np.ndarray
    onto: np.ndarray


def thrown_light(traced: TracedScene, caustics: bool) -> ThrownLight | None:
    """The light that narrow lobes throw onto other surfaces and that is left to paths; None if no surface has such a
    lobe. `caustics` says whether caustics carry the light of polished metal and glass."""
    scene, projector = traced.scene, traced.projector
    shapes = scene.shapes()
    carries = caustics and not isinstance(projector, BeamDevice)
    is_narrow = [has_narrow_lobe(shape.bsdf()) and not (carries and is_thrower(shape)) for shape in shapes]
    if not any(is_narrow):
        return None
    narrow_table = mi.Bool(table_of(scene, is_narrow))
    columns, rows = RAYS
    lanes = columns * rows
    index = dr.arange(mi.UInt32, lanes)
    rng = mi.PCG32(lanes)
    place = mi.Vector2f(index % columns + rng.next_float32(), index // columns + rng.next_float32())
    if isinstance(projector, BeamDevice):
        pixels = traced.camera.pixels
        beam = projector.sampled(mi.UInt32(mi.Float(index) / lanes * pixels), mi.Point2f(place - dr.floor(place)))
        ray, active = mi.Ray3f(beam.origin, beam.direction), mi.Bool(True)
    else:
        first = projector.centre_ray(mi.Point2f(place * projector.size / mi.Vector2f(columns, rows)))
        ray = mi.Ray3f(first.origin, first.direction)
        active = mi.Bool(True) if first.exists is None else mi.Bool(first.exists)
    throughput, thrower, is_thrown = dr.full(mi.Float, 1.0, lanes), dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Bool, lanes)
    by, onto = (dr.zeros(mi.Float, int(dr.max(number_of(scene.shapes_dr()))[0]) + 1) for _ in range(2))
    for _ in range(MAX_SURFACES):
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        active &= si.is_valid()
        shape = number_of(si.shape)
        xi = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        bs, weight = si.bsdf(ray).sample(mi.BSDFContext(), si, *xi, active)
        meets_lobe = active & dr.gather(mi.Bool, narrow_table, shape, active)
        meets_lobe &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Glossy)
        goes_on = meets_lobe | mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        goes_on |= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        lands = active & is_thrown & ~goes_on
        dr.scatter_reduce(dr.ReduceOp.Add, onto, throughput, shape, lands)
        dr.scatter_reduce(dr.ReduceOp.Add, by, throughput, thrower, lands)
        thrower = dr.select(meets_lobe & ~is_thrown, shape, thrower)
        is_thrown |= meets_lobe
        active &= goes_on
        throughput *= dr.select(active, mono(weight), 0)
        ray = si.spawn_ray(si.to_world(bs.wo))
        dr.eval(ray, active, throughput, thrower, is_thrown, rng, by, onto)
    numbers = number_of(scene.shapes_dr()).numpy()
    return ThrownLight(*(x.numpy()[numbers].astype(np.float64) / lanes for x in (by, onto)))


def warn_of_narrow_lobes(traced: TracedScene, names: list[str], caustics: bool) -> None:
    """Warn if narrow lobes throw noticeable light onto other surfaces that is left to paths.

    names : those of all shapes. caustics : whether caustics carry the light of polished metal and glass.
    """
    thrown = thrown_light(traced, caustics)
    if thrown is None or thrown.onto.sum() <= MIN_THROWN:
        return
    lit, lobes = _named(names, thrown.onto), _named(names, thrown.by)
    warn(
        f"about {thrown.onto.sum():.1%} of the projector's light reaches {lit} over narrow lobes of {lobes}, where "
        f"light paths find little of it: readings there have larger errors than their noise says; make {lobes} smooth "
        f"(conductor, dielectric) or rougher than alpha {MAX_NARROW_ALPHA:g}, or make them of roughconductor or "
        "roughdielectric, whose light caustics carry."
    )


def _named(names: list[str], light: np.ndarray) -> str:
    """The names of the shapes with the most light, as words of a sentence."""
    order = [int(i) for i in np.argsort(-light, kind="stable") if light[i] > MIN_NAMED * light.sum()]
    listed = ", ".join(repr(names[i]) for i in order[:MAX_NAMED])
    return listed + (" and others" if len(order) > MAX_NAMED else "")
