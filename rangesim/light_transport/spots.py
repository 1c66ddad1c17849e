# SPDX-License-Identifier: Apache-2.0
"""The spot of a beam as a light vertex: where a ray of the beam lands, and what it brings to a vertex of a camera path.

The spot is the surface that a ray of the beam meets first behind any delta interactions. A camera path of k vertices
that ends at the spot is found from its vertex k - 1, which is connected to the spot.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from rangesim.light_transport.beams import BeamDevice, Spot
from rangesim.light_transport.sampling import Continued
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN, RayState, corrected_point, spawn_specular_ray, survival
from rangesim.light_transport.strategies import can_be_vertex, delta_only, is_delta
from rangesim.light_transport.traced_scene import TracedScene

LANDING_FRACTION = 0.5
"""Fraction of the rays that end on a surface which scatters and has delta interactions too, such as a coat; the others
go on by these. Both parts are found with any fraction; one half gives neither of them more noise."""


@dr.syntax
def lit_spot(
    traced: TracedScene, pixel: mi.UInt32, xi: mi.Point2f, random: mi.UInt64, numbers: Continued, has_delta: bool,
    active: mi.Bool,
) -> tuple[Spot, mi.UInt64]:  # fmt: skip
    """A ray of each pixel's beam that lands on the spot, and the state of the random numbers afterwards.

    Parameters
    ----------
    xi : Point2f, uniform in the unit square; decides on the ray.
    random, numbers : state of the random numbers, and the generator (`Continued`) that takes it. They choose between
        reflection and refraction.
    has_delta : whether the scene has delta interactions.
    """
    emitter = traced.projector
    assert isinstance(emitter, BeamDevice)
    spot = emitter.sampled(pixel, xi)
    if dr.hint(has_delta, mode="scalar"):
        lanes, context = dr.width(pixel), delta_only(mi.TransportMode.Importance)
        ray_state = RayState.start(traced._replace(media=None), lanes).restarted(True, spot.origin, spot.length)
        origin, towards, weight = mi.Point3f(spot.origin), mi.Vector3f(spot.direction), mi.Float(spot.weight)
        chain, on_way = dr.zeros(mi.UInt32, lanes), active & True
        while on_way:
            rng, ray = numbers.at(random), mi.Ray3f(origin, towards)
            si = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=on_way)
            hit = si.is_valid() & on_way
            bsdf = si.bsdf(ray)
            scatters = hit & can_be_vertex(bsdf)
            deflects = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
            mixed = scatters & deflects
            lands = scatters & (~deflects | (rng.next_float32() < LANDING_FRACTION))
            weight = dr.select(mixed, weight / dr.select(lands, LANDING_FRACTION, 1 - LANDING_FRACTION), weight)
            goes_on = deflects & ~lands
            bs, bs_weight = bsdf.sample(
                context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), goes_on
            )
            remains = weight * mono(bs_weight)
            if dr.hint(traced.absorbers is not None, mode="scalar"):
                remains *= ray_state.unabsorbed(traced, si.p, goes_on)
            goes_on &= (remains > 0) & is_delta(bs) & (chain < MAX_CHAIN)
            chance = survival(chain, remains)
            goes_on &= rng.next_float32() < chance
            weight = dr.select(lands, weight, dr.select(goes_on, remains / chance, dr.select(on_way, 0, weight)))
            point = dr.select(chain > 0, corrected_point(si, ray_state.previous, ray.d), si.p)
            length = ray_state.length_to(point, goes_on)
            ray_state = ray_state.refracted(bs, goes_on).restarted(goes_on, point, length)
            further = spawn_specular_ray(si, si.p, si.to_world(bs.wo))
            ray_state = ray_state.entering(traced, si, further.d, goes_on, mi.Bool(False))
            origin, towards = dr.select(goes_on, further.o, origin), dr.select(goes_on, further.d, towards)
            chain += dr.select(goes_on, mi.UInt32(1), mi.UInt32(0))
            on_way = mi.Bool(goes_on)
            random = rng.state
        beside = dr.dot(origin - ray_state.previous, towards)  # the ray starts a little off the surface
        length = dr.fma(ray_state.ior, beside, ray_state.length)
        spot = Spot(origin, towards, length, ray_state.ior, weight, spot.u, spot.v)
    return spot, random


class SpotLight(NamedTuple):
    """Light of a spot at a vertex of a camera path.

    direction : Vector3f, unit, world, from the vertex to the spot.
    length : Float, metres, optical length from the emitter over the spot to the vertex.
    irradiance : Float, W/m2 per watt of the beam, on a surface at the vertex that faces the spot; 0 where the spot is
        not visible.
    """

    direction: mi.Vector3f
    length: mi.Float
    irradiance: mi.Float


def connect_to_spot(traced: TracedScene, spot: Spot, si: mi.SurfaceInteraction3f, active: mi.Bool) -> SpotLight:
    """The light that the spot throws on the vertex `si`."""
    ray = mi.Ray3f(spot.origin, spot.direction)
    active = active & (spot.weight > 0)
    at = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
    active &= at.is_valid()
    to_spot = at.p - si.p
    distance = dr.norm(to_spot)
    to_spot /= distance
    context = mi.BSDFContext(mi.TransportMode.Importance)  # light goes from the emitter on, not back to it
    value = mono(at.bsdf(ray).eval(context, at, at.to_local(-to_spot), active))
    irradiance = spot.weight * value / dr.square(distance)
    active &= (irradiance > 0) & (distance > 0)
    visible = active & ~traced.scene.ray_test(si.spawn_ray_to(at.p), coherent=False, active=active)
    length = dr.fma(spot.ior, dr.norm(at.p - spot.origin), spot.length) + distance
    return SpotLight(to_spot, dr.select(visible, length, 0), dr.select(visible, irradiance, 0))
