# SPDX-License-Identifier: Apache-2.0
"""Ambient light: light of the scene's own emitters, such as the sun, the sky and luminaires.

A pass finds it in two ways: a ray of a camera path meets an emitter by chance, or the pass draws a direction towards an
emitter. Multiple importance sampling gives each way a weight (Veach 1997), so that no light is counted twice.

Rays never meet lamps without extent (sun, point, spot). Straight light of these, also through holes, is found by drawn
directions alone; `rangesim.light_transport.lamps` has their light beyond glass and mirrors.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import RayState
from rangesim.light_transport.surfaces import ray_to_emitter
from rangesim.light_transport.traced_scene import TracedScene


def ambient_on_ray(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    previous: mi.Interaction3f,
    pdf: mi.Float,
    alone: mi.Bool,
    active: mi.Bool,
) -> mi.Float:
    """Radiance (W/m2/sr) that an emitter of the scene sends along the ray that met it at `si`, with its weight.

    Parameters
    ----------
    previous : Interaction3f, where the ray started.
    pdf : Float, 1/sr, density of the BSDF sample that made the ray.
    alone : Bool, whether directions to emitters were not sampled there, so that the weight is 1.
    """
    emitter = si.emitter(scene, active)
    ds = mi.DirectionSample3f(scene, si, previous)
    emitter_pdf = scene.pdf_emitter_direction(previous, ds, active & ~alone)
    weight = dr.select(alone, 1, power_heuristic(pdf, emitter_pdf))
    return dr.select(active, weight * mono(emitter.eval(si, active)), 0)


def sampled_ambient(
    traced: TracedScene,
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    ray_state: RayState,
    xi: mi.Point2f,
    has_delta_lamps: bool,
    active: mi.Bool,
) -> mi.Float:
    """Radiance (W/m2/sr) that the surface `si` reflects from one sampled emitter of the scene, with its weight.

    `ray_state` is the state of the ray that met `si`; `xi` is uniform in the unit square; `has_delta_lamps` says
    whether the scene has lamps without extent, and surfaces with delta interactions.
    """
    scene, cutouts = traced.scene, traced.cutouts
    ds, radiance = scene.sample_emitter_direction(si, xi, not has_delta_lamps, active)
    active = active & (ds.pdf != 0)  # `&=` would change the mask of the caller
    if has_delta_lamps:
        # Shadow rays to a lamp without extent end right before it, because glass there has triangles of its light
        ray = dr.select(ds.delta, ray_to_emitter(si, ds.p), si.spawn_ray_to(ds.p))
        if cutouts is not None and cutouts.exist:
            radiance *= dr.select(ds.delta, cutouts.transmittance(si, ds.p, active & ds.delta), 1)
            active &= ds.delta | ~scene.ray_test(ray, coherent=False, active=active & ~ds.delta)
        else:
            active &= ~scene.ray_test(ray, coherent=False, active=active)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
    weight = dr.select(ds.delta, 1, power_heuristic(ds.pdf, pdf))
    absorbers = traced.absorbers
    if absorbers is not None:
        weight *= absorbers.transmittance(absorbers.beyond(si, ds.d, ray_state.sigma_a, active), ds.dist)
    return dr.select(active, weight * mono(value) * mono(radiance), 0)


def sampled_ambient_through_media(
    traced: TracedScene,
    bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f,
    direction: mi.Vector3f,
    ray_state: RayState,
    scatters: mi.Bool,
    xi: mi.Point2f,
    has_delta_lamps: bool,
    active: mi.Bool,
) -> mi.Float:
    """The same as `sampled_ambient`, but also through media that scatter, and also at scattering events inside them.

    At such events, and through boundaries, the function draws no directions to emitters of finite size: camera paths
    meet these by chance, so their light would be counted twice.

    Parameters
    ----------
    direction : Vector3f, direction of the ray that met `si`.
    scatters : Bool, whether `si` is a scattering event instead of a surface.
    """
    scene, media, absorbers, inside = traced.scene, traced.media, traced.absorbers, ray_state.inside
    assert media is not None
    assert inside is not None
    ds, radiance = scene.sample_emitter_direction(si, xi, False, active)
    active = active & (ds.pdf != 0)  # `&=` would change the mask of the caller
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active & ~scatters)
    value = dr.select(scatters, inside.albedo * inside.phase(dr.dot(direction, ds.d)), mono(value))
    around = None if absorbers is None else absorbers.beyond(si, ds.d, ray_state.sigma_a, active & ~scatters)
    fraction, crossed = media.transmittance(scene, si, ds.p, inside, active, around)
    if has_delta_lamps:
        alone, cutouts = active & ds.delta, traced.cutouts
        holes = cutouts if cutouts is not None and cutouts.exist else None
        through, _ = media.transmittance(scene, si, ds.p, inside, alone, around, holes, ray_to_emitter)
        fraction = dr.select(ds.delta, through, fraction)
    weight = dr.select(scatters | crossed, 0, power_heuristic(ds.pdf, pdf))
    weight = dr.select(ds.delta, 1, weight)
    return dr.select(active, weight * fraction * value * mono(radiance), 0)


def power_heuristic(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of a sample of density `a` that could have been made with density `b` as well (Veach 1997).

    Densities are in 1/sr.
    """
    weight = dr.square(a) / (dr.square(a) + dr.square(b))
    return dr.select(dr.isfinite(weight), weight, 0)
