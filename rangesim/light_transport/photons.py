# SPDX-License-Identifier: Apache-2.0
"""Caustic photons: projector light on its way through glass and off mirrors, up to the first surface that scatters it.

A photon leaves the projector through a pixel, follows delta interactions alone (dielectric, conductor, thin
dielectric, hole), and lands on the first non-delta surface. Light that lands without any delta interaction is
next-event estimation's (`rangesim.light_transport.loop`) and ends at once. A translucent object's medium weakens
photons by what it scatters out of their way; that scattered light is not followed further.

Only pixels whose light meets a delta surface first are worth photons. A pre-pass with one ray per pixel finds them and
their neighbours; a small share of the photons goes to all other pixels, so that the estimate stays unbiased where
something is finer than a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.light_transport.device import Device
from rangesim.light_transport.exact_point import on_its_line
from rangesim.light_transport.medium import Media, bounded, is_boundary

DEFENSIVE_SHARE = 0.05
"""Of the photons, for the pixels where the pre-pass found no delta surface."""
LANDING_SHARE = 0.75
"""Of the photons on a surface that both scatters and mirrors (polished plastic), those that land there."""
MAX_CHAIN = 16
"""Delta surfaces in a row that a photon is followed through."""
BYTES_PER_PHOTON = 128
"""While it flies, an upper bound."""


@dataclass(frozen=True, eq=False)
class PhotonBalance:
    """Where the projector's power went, watts; emitted = direct + stored + absorbed + escaped + truncated.

    emitted : of the pixels that photons were sent through. direct : landed without a delta surface, left to next-event
    estimation. stored : landed beyond delta surfaces. absorbed : by delta surfaces and by the parts of mixed ones that
    scatter, and by media. escaped : met no surface. truncated : still under way after `MAX_CHAIN` surfaces.
    """

    emitted: float
    direct: float
    stored: float
    absorbed: float
    escaped: float
    truncated: float


@dataclass(frozen=True, eq=False)
class Photons:
    """Photons that landed, n of them, in the order of their numbers.

    position, direction : (n, 3) float32, metres and unit, world; the direction is that of flight.
    flux : (n,) float32, watts, of white.
    u, v : (n,) float32, projector pixel coordinates.
    length_m : (n,) float32, metres, optical length from the projector.
    map : (n,) int, which of the independent maps a photon belongs to; each map alone carries all the power.
    balance : PhotonBalance, the mean over the maps.
    per_pixel : float, photons of all maps sent through each projector pixel that is worth it.
    """

    position: np.ndarray
    direction: np.ndarray
    flux: np.ndarray
    u: np.ndarray
    v: np.ndarray
    length_m: np.ndarray
    map: np.ndarray
    balance: PhotonBalance
    per_pixel: float


def has_delta(scene: Any) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction: without one there is nothing to trace."""
    return any(
        bool(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)) and not is_boundary(shape)
        for shape in scene.shapes()
    )


def trace_photons(
    scene: Any,
    projector: Device,
    power_w: float,
    photons: int,
    maps: int,
    seed: int,
    memory_bytes: int,
    media: Media | None = None,
) -> Photons:
    """`photons` photons of a projector of that power, dealt out evenly to `maps` independent maps."""
    pixels, share = _worthwhile_pixels(scene, projector, media)
    per_map = -(-photons // maps)
    cumulative = np.cumsum(share)
    total = per_map * maps
    chunk = max(1, min(total, memory_bytes // BYTES_PER_PHOTON))
    landed: list[list[np.ndarray]] = []
    balance = np.zeros(len(PhotonBalance.__dataclass_fields__))
    for begin in range(0, total, chunk):
        number = np.arange(begin, min(begin + chunk, total))
        chosen = np.searchsorted(cumulative, _stratified(number, per_map) * cumulative[-1], side="right")
        flux = power_w / (len(pixels) * per_map * share[chosen] / cumulative[-1])
        end, fate = _fly(scene, projector, pixels[chosen], flux, number, seed, media)
        kept = np.flatnonzero(end.flux)
        landed.append([_columns(x)[kept] for x in end] + [number[kept] // per_map])
        balance += fate
    position, direction, flux, u, v, length, of_map = (np.concatenate(parts) for parts in zip(*landed, strict=True))
    total_balance = PhotonBalance(*(balance / maps))
    return Photons(position, direction, flux, u, v, length, of_map, total_balance, total / cumulative[-1])


def _worthwhile_pixels(scene: Any, projector: Device, media: Media | None) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of all projector pixels along a Morton curve, and the relative chance of a photon for each."""
    w, h = int(projector.size.x[0]), int(projector.size.y[0])
    index, width = dr.arange(mi.UInt32, w * h), mi.UInt32(projector.size.x)
    ray = projector.centre_ray(mi.Point2f(mi.Float(index % width) + 0.5, mi.Float(index // width) + 0.5))
    si = scene.ray_intersect(mi.Ray3f(ray.origin, ray.direction))
    meets_delta = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta) & ~bounded(media, si)
    mask = binary_dilation(meets_delta.numpy().reshape(h, w), np.ones((3, 3))).ravel()
    rest = ~mask
    chance = np.where(mask, 1.0, DEFENSIVE_SHARE / (1 - DEFENSIVE_SHARE) * max(mask.sum(), 1) / max(rest.sum(), 1))
    order = np.argsort(_morton(np.arange(w * h) % w, np.arange(w * h) // w))
    return order, chance[order]


def _morton(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Place along the Morton curve: even steps along it are spread evenly over the image."""

    def spread(a: np.ndarray) -> np.ndarray:
        a = a.astype(np.uint64)
        for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
            a = (a | (a << np.uint64(shift))) & np.uint64(mask)
        return a

    return spread(x) | (spread(y) << np.uint64(1))


def _stratified(number: np.ndarray, per_map: int) -> np.ndarray:
    """Places in 0..1, evenly spaced within each map, each map shifted against the others (golden ratio)."""
    shift = (number // per_map * 0.6180339887498949 + 0.5) % 1.0
    return np.asarray((number % per_map + shift) / per_map)


class _Landing(NamedTuple):
    """Where a photon landed; flux 0 where it did not."""

    position: Any
    direction: Any
    flux: Any
    u: Any
    v: Any
    length: Any


def _fly(
    scene: Any,
    projector: Device,
    pixel: np.ndarray,
    flux: np.ndarray,
    number: np.ndarray,
    seed: int,
    media: Media | None = None,
) -> tuple[_Landing, np.ndarray]:
    """Landings of photons sent through projector pixels, and the sums of `PhotonBalance`."""
    pixel, width = mi.UInt32(pixel.astype(np.uint32)), mi.UInt32(projector.size.x)
    states = mi.sample_tea_32(dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), mi.UInt32(number.astype(np.uint32)) ^ 0x9E3779B9)
    rng = mi.PCG32(1, *(mi.UInt64(x) for x in states))
    jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
    uv = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width)) + jitter
    landing, fate = _chain(
        scene, projector, uv, mi.Float(flux.astype(np.float32)), rng, dr.opaque(mi.UInt32, MAX_CHAIN), media
    )
    dr.eval(list(landing), list(fate))
    return landing, np.array([x.numpy().sum(dtype=np.float64) for x in fate])


@dr.syntax
def _chain(
    scene: Any, projector: Device, uv: Any, power: Any, rng: Any, max_chain: Any, media: Any = None
) -> tuple[_Landing, tuple[Any, ...]]:
    """Follow photons through delta interactions until they land, leave, are absorbed, or the chain is too long."""
    lanes = dr.width(power)
    lens = mi.Point2f(rng.next_float32(), rng.next_float32()) if dr.hint(projector.has_lens, mode="scalar") else None
    primary = projector.sample_ray(uv, lens)
    ray = mi.Ray3f(primary.origin, primary.direction)
    flux = power * projector.relative_illumination(primary.direction)
    if dr.hint(primary.exists is not None, mode="scalar"):
        flux = dr.select(primary.exists, flux, 0)
    emitted = mi.Float(flux)
    length = primary.lead + dr.zeros(mi.Float, lanes)  # optical, from the projector to `previous`
    ior = dr.ones(mi.Float, lanes)  # refractive index along the ray
    chain = dr.zeros(mi.UInt32, lanes)  # delta interactions so far
    inside: Any = None if media is None else media.none(lanes)  # what the ray runs through
    crosses, crossed = mi.Bool(False), dr.zeros(mi.UInt32, lanes)  # boundaries of media: this one, those so far
    previous = mi.Point3f(primary.origin)
    position, direction = dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes)
    direct, stored, absorbed, escaped, truncated = (dr.zeros(mi.Float, lanes) for _ in range(5))
    context = mi.BSDFContext(mi.TransportMode.Importance)
    context.type_mask = mi.BSDFFlags.Delta
    active = emitted > 0

    while active:
        # ---- Next surface ----------------------------------------------------------------------------
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit = si.is_valid() & active
        point = dr.select(chain > 0, on_its_line(si, previous, ray.d), si.p)
        escaped += dr.select(active & ~hit, flux, 0)
        if dr.hint(media is not None, mode="scalar"):
            crosses = hit & media.bounded_by(si, hit)
            lost = dr.select(hit, flux * (1 - dr.exp(-inside.sigma_t * dr.norm(point - previous))), 0)
            flux -= lost
            direct += dr.select(chain == 0, lost, 0)
            absorbed += dr.select(chain == 0, 0, lost)
        length = dr.select(hit, dr.fma(ior, dr.norm(point - previous), length), length)
        bsdf = si.bsdf(ray)
        scatters = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        mirrors = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)

        # ---- It lands: beyond a delta surface for the map, else for next-event estimation ------------
        direct += dr.select(hit & ~mirrors & (chain == 0), flux, 0)
        mixed = scatters & mirrors & (chain > 0)
        lands = scatters & (chain > 0) & (~mixed | (rng.next_float32() < LANDING_SHARE))
        landing_flux = dr.select(mixed, flux / LANDING_SHARE, flux)
        stored = dr.select(lands, landing_flux, stored)
        position = dr.select(lands, point, position)
        direction = dr.select(lands, ray.d, direction)

        # ---- Or goes on as a delta interaction -------------------------------------------------------
        goes_on = mirrors & ~lands
        bs, weight = bsdf.sample(
            context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), goes_on
        )
        remains = flux * dr.select(mixed, 1 / (1 - LANDING_SHARE), 1) * mi.unpolarized_spectrum(weight)[0]
        goes_on &= (remains > 0) & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        remains = dr.select(goes_on, remains, 0)
        absorbed += dr.select(hit & ~(~mirrors & (chain == 0)), flux - remains - dr.select(lands, landing_flux, 0), 0)
        flux = dr.select(active, remains, flux)
        ior = dr.select(goes_on & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission), ior * bs.eta, ior)
        chain += dr.select(goes_on & ~crosses, mi.UInt32(1), mi.UInt32(0))
        previous = dr.select(goes_on, point, previous)
        ray = si.spawn_ray(si.to_world(bs.wo))
        if dr.hint(media is not None, mode="scalar"):
            inside = inside.replaced(crosses, media.beyond(si, ray.d, crosses))
            crossed += dr.select(crosses, mi.UInt32(1), mi.UInt32(0))
        truncated += dr.select(goes_on & (chain + crossed >= max_chain), flux, 0)
        active = goes_on & (chain + crossed < max_chain)

    landing = _Landing(position, direction, stored, uv.x, uv.y, length)
    return landing, (emitted, direct, stored, absorbed, escaped, truncated)


def _columns(array: Any) -> np.ndarray:
    """(n,) or (n, 3) of a Dr.Jit array."""
    return np.ascontiguousarray(np.array(array).T)
