# SPDX-License-Identifier: Apache-2.0
"""Light of the scene's own emitters, ambient to the sensor: met by chance and sampled, weighted against each other."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import RayState
from rangesim.light_transport.traced_scene import TracedScene


def emission(scene: Any, si: Any, previous: Any, pdf: Any, alone: Any, active: Any) -> Any:
    """Radiance that a scene emitter sends along the ray, weighted against having been sampled at `previous`."""
    emitter = si.emitter(scene, active)
    ds = mi.DirectionSample3f(scene, si, previous)
    emitter_pdf = scene.pdf_emitter_direction(previous, ds, active & ~alone)
    weight = dr.select(alone, 1, power_heuristic(pdf, emitter_pdf))
    return dr.select(active, weight * mono(emitter.eval(si, active)), 0)


def sampled_emission(traced: TracedScene, bsdf: Any, si: Any, ray_state: RayState, xi: Any, active: Any) -> Any:
    """Reflected radiance of one sampled direction to a scene emitter, weighted against BSDF sampling.

    `ray_state` : that which met `si`.
    """
    ds, radiance = traced.scene.sample_emitter_direction(si, xi, True, active)
    active &= ds.pdf != 0
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
    weight = dr.select(ds.delta, 1, power_heuristic(ds.pdf, pdf))
    absorbers = traced.absorbers
    if absorbers is not None:
        weight *= absorbers.transmittance(absorbers.beyond(si, ds.d, ray_state.sigma_a, active), ds.dist)
    return dr.select(active, weight * mono(value) * mono(radiance), 0)


def emission_through(
    traced: TracedScene, bsdf: Any, si: Any, direction: Any, ray_state: RayState, scatters: Any, xi: Any, active: Any
) -> Any:
    """Like `sampled_emission`, through media as well, and also at scattering events.

    Lamps of finite size are left to random walks there and beyond boundaries, so that none is counted twice.
    """
    scene, media, absorbers, inside = traced.scene, traced.media, traced.absorbers, ray_state.inside
    ds, radiance = scene.sample_emitter_direction(si, xi, False, active)
    active &= ds.pdf != 0
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active & ~scatters)
    value = dr.select(scatters, inside.albedo * inside.phase(dr.dot(direction, ds.d)), mono(value))
    around = None if absorbers is None else absorbers.beyond(si, ds.d, ray_state.sigma_a, active & ~scatters)
    fraction, crossed = media.transmittance(scene, si, ds.p, inside, active, around)
    weight = dr.select(scatters | crossed, 0, power_heuristic(ds.pdf, pdf))
    weight = dr.select(ds.delta, 1, weight)
    return dr.select(active, weight * fraction * value * mono(radiance), 0)


def power_heuristic(a: Any, b: Any) -> Any:
    """Weight of a sample of density `a` that density `b` could have made too (Veach 1997)."""
    weight = dr.square(a) / (dr.square(a) + dr.square(b))
    return dr.select(dr.isfinite(weight), weight, 0)
