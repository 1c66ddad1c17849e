# SPDX-License-Identifier: Apache-2.0
"""The flight of photons: from the projector through delta interactions to the first surface that scatters them."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import CellGrid, Device
from rangesim.light_transport.sampling import Continued, Seed, aligned, random_stream
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import MAX_CHAIN, RayState, corrected_point, spawn_specular_ray, survival
from rangesim.light_transport.strategies import can_be_vertex, delta_only, is_delta, owner
from rangesim.light_transport.traced_scene import TracedScene

LANDING_FRACTION = 0.75
"""Fraction of the photons that land on a surface which both scatters and mirrors (polished plastic); the others go on
as delta interactions. The photons of both kinds are divided by their fraction, so its value changes the noise, but no
mean."""


class PhotonDeposit(NamedTuple):
    """Photons that landed on a surface that scatters.

    position : Point3f, world, metres.
    direction : Vector3f, unit, world, direction of flight.
    flux : Float, watts; 0 for photons that did not land.
    u, v : Float, projector pixel coordinates.
    length : Float, metres, optical length from the projector.
    cosine : Float, absolute cosine between the direction and the geometric normal of the surface.
    """

    position: mi.Point3f
    direction: mi.Vector3f
    flux: mi.Float
    u: mi.Float
    v: mi.Float
    length: mi.Float
    cosine: mi.Float


class PhotonEnergy(NamedTuple):
    """Power of each photon by where it went, watts; the fields of `rangesim.light_transport.photons.EnergyBudget`."""

    emitted: mi.Float
    direct: mi.Float
    stored: mi.Float
    absorbed: mi.Float
    escaped: mi.Float
    truncated: mi.Float


def trace_photon_paths(
    traced: TracedScene, grid: CellGrid, cell: np.ndarray, flux: np.ndarray, number: np.ndarray, seed: int
) -> tuple[PhotonDeposit, PhotonEnergy]:
    """Send photons through cells of the projector's image; returns where they landed, and where their power went.

    Parameters
    ----------
    grid : CellGrid of the projector.
    cell : (n,) int, flat indices of its cells.
    flux : (n,) float, watts.
    number : (n,) int, numbers of the photons, on which their random numbers depend.
    """
    assert isinstance(traced.projector, Device)
    photon = mi.UInt32(aligned(number, np.uint32))
    rng = random_stream(Seed.of(seed), photon ^ 0x9E3779B9)
    jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
    uv = grid.place(mi.UInt32(aligned(cell, np.uint32)), jitter)
    power, most = mi.Float(aligned(flux, np.float32)), dr.opaque(mi.UInt32, MAX_CHAIN)
    return _chain(traced, uv, power, rng, most)


@dr.syntax
def _chain(
    traced: TracedScene, uv: mi.Point2f, power: mi.Float, rng: mi.PCG32, max_chain: mi.UInt32
) -> tuple[PhotonDeposit, PhotonEnergy]:
    """Follow photons through delta interactions until they land, leave, are absorbed, or the chain is too long."""
    lanes, projector, media, absorbers = dr.width(power), traced.projector, traced.media, traced.absorbers
    assert isinstance(projector, Device)
    lens = mi.Point2f(rng.next_float32(), rng.next_float32()) if dr.hint(projector.has_lens, mode="scalar") else None
    primary = projector.sample_ray(uv, lens)
    flux = power * projector.relative_illumination(primary.direction)
    if dr.hint(primary.exists is not None, mode="scalar"):
        flux = dr.select(primary.exists, flux, 0)
    emitted = mi.Float(flux)
    ray_state = RayState.start(traced, lanes).restarted(True, primary.origin, primary.path_offset)
    chain = dr.zeros(mi.UInt32, lanes)  # delta interactions so far
    left = max_chain + dr.zeros(mi.UInt32, lanes)  # surfaces and boundaries of media that may still be met
    position, direction = dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes)
    cosine = dr.ones(mi.Float, lanes)
    direct, stored, absorbed, escaped, truncated = (dr.zeros(mi.Float, lanes) for _ in range(5))
    context = delta_only(mi.TransportMode.Importance)
    active = emitted > 0

    random, numbers = mi.UInt64(rng.state), Continued(rng)
    origin, towards = primary.origin, primary.direction

    while active:
        rng, ray = numbers.at(random), mi.Ray3f(origin, towards)
        crosses = mi.Bool(False)  # the boundary of a medium
        # ---- Next surface ----------------------------------------------------------------------------
        si = traced.surfaces.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit = si.is_valid() & active
        point = dr.select(chain > 0, corrected_point(si, ray_state.previous, ray.d), si.p)
        if dr.hint(absorbers is not None, mode="scalar"):
            lost = dr.select(active, flux * (1 - ray_state.unabsorbed(traced, point, hit)), 0)
            flux -= lost
            absorbed += lost
        escaped += dr.select(active & ~hit, flux, 0)
        if dr.hint(media is not None, mode="scalar"):
            assert media is not None
            assert ray_state.inside is not None
            crosses = hit & media.bounded_by(si, hit)
            through = dr.exp(-ray_state.inside.sigma_t * dr.norm(point - ray_state.previous))
            lost = dr.select(hit, flux * (1 - through), 0)
            flux -= lost
            direct += dr.select(chain == 0, lost, 0)
            absorbed += dr.select(chain == 0, 0, lost)
        ray_state.length = ray_state.length_to(point, hit)
        bsdf = si.bsdf(ray)
        scatters = hit & can_be_vertex(bsdf)
        mirrors = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)

        # ---- It lands: in the photon map, if beyond a delta surface; else next-event estimation counts it
        direct += dr.select(hit & ~mirrors & (chain == 0), flux, 0)
        mixed = scatters & mirrors & (chain > 0)
        lands = owner(scatters, chain).photons & (~mixed | (rng.next_float32() < LANDING_FRACTION))
        landing_flux = dr.select(mixed, flux / LANDING_FRACTION, flux)
        stored = dr.select(lands, landing_flux, stored)
        position = dr.select(lands, point, position)
        direction = dr.select(lands, ray.d, direction)
        cosine = dr.select(lands, dr.abs(dr.dot(ray.d, si.n)), cosine)

        # ---- Or goes on as a delta interaction -------------------------------------------------------
        goes_on = mirrors & ~lands
        bs, weight = bsdf.sample(
            context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), goes_on
        )
        remains = flux * dr.select(mixed, 1 / (1 - LANDING_FRACTION), 1) * mono(weight)
        goes_on &= (remains > 0) & is_delta(bs)
        chance = survival(chain, remains / emitted)
        goes_on &= rng.next_float32() < chance
        remains = dr.select(goes_on, remains / chance, 0)  # Russian roulette absorbs nothing on average
        absorbed += dr.select(hit & ~(~mirrors & (chain == 0)), flux - remains - dr.select(lands, landing_flux, 0), 0)
        flux = dr.select(active, remains, flux)
        chain += dr.select(goes_on & ~crosses, mi.UInt32(1), mi.UInt32(0))
        ray_state = ray_state.refracted(bs, goes_on).restarted(goes_on, point, ray_state.length)
        ray = spawn_specular_ray(si, si.p, si.to_world(bs.wo))
        ray_state = ray_state.entering(traced, si, ray.d, goes_on, crosses)
        left -= dr.select(goes_on | crosses, mi.UInt32(1), mi.UInt32(0))
        truncated += dr.select(goes_on & (left == 0), flux, 0)
        active = goes_on & (left > 0)
        random, origin, towards = rng.state, ray.o, ray.d

    landing = PhotonDeposit(position, direction, stored, uv.x, uv.y, ray_state.length, cosine)
    return landing, PhotonEnergy(emitted, direct, stored, absorbed, escaped, truncated)
