# SPDX-License-Identifier: Apache-2.0
"""The projector's light beyond glass and mirrors: how many photons are traced, how far they are gathered, and the light
that they bring to a vertex of a camera path."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.accumulators import Accumulators
from rangesim.light_transport.indirect_filter import REACH_PX
from rangesim.light_transport.photon_maps import LEVELS, MAX_MAPS, GatheringRadius, PhotonMaps
from rangesim.light_transport.photons import Photons, has_delta, trace_photons
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.response import CAUSTIC, LightPath
from rangesim.rig import Rig

PHOTONS_PER_DISC = 400
"""Photons of all maps within the largest radius, where light is neither spread nor focused."""
RADIUS_IN_PROJECTOR_PIXELS = 3.0
RADIUS_IN_CAMERA_PIXELS = (0.3, 3.0)
"""Bounds of the largest photon radius, where it is: finer than the stripes, about as fine as the image."""
MAX_BENT = 4.0
"""Cosine of a photon to the surface at a vertex, at most, over that where it landed."""


def caustic_photons(
    traced: TracedScene, rig: Rig, settings: TransportSettings, spp: int, report: Callable[[], None] = lambda: None
) -> Photons | None:
    """Photons for a pass of `spp` samples, of any camera; None if there are none, nothing to send them through, or none
    landed.

    `report` is called after each kernel launch.
    """
    if not settings.photons or not has_delta(traced.scene):
        return None
    maps, memory_bytes = min(spp, MAX_MAPS), settings.memory_bytes
    landed = trace_photons(traced, rig.projector_power_w, settings.photons, maps, settings.seed, memory_bytes, report)
    return landed if len(landed.flux) else None


def caustic_maps(photons: Photons | None, rig: Rig, radius_m: float | None) -> PhotonMaps | None:
    """Photons sorted for the camera of the rig to gather; None if there are none."""
    if photons is None:
        return None
    radius = gathering_radius(rig, photons.per_pixel, radius_m)
    return PhotonMaps(photons, radius, rig.projector_irradiance, REACH_PX / rig.camera.fx)


def gathering_radius(rig: Rig, photons_per_pixel: float, fixed_m: float | None = None) -> GatheringRadius:
    """Largest photon radius: wide enough for `PHOTONS_PER_DISC`, within bounds; or the same everywhere."""
    of_projector = min(np.sqrt(PHOTONS_PER_DISC / (np.pi * photons_per_pixel)), RADIUS_IN_PROJECTOR_PIXELS)
    low, high = (pixels / rig.camera.fx for pixels in RADIUS_IN_CAMERA_PIXELS)
    places = (rig.T_world_projector[:3, 3], rig.T_world_camera[:3, 3])
    return GatheringRadius(float(of_projector / rig.projector.fx), (low, high), *places, fixed_m)


class CausticLight(NamedTuple):
    """Light of the photons around a vertex: the photon that stands for all, their irradiance in W/m2, and whether it
    was found in a wide circle, and is smooth therefore."""

    photon: Any
    irradiance: Any
    is_wide: Any


class Vertex(NamedTuple):
    """A vertex of a camera path: surface, throughput, optical length from the camera, and whether light that reaches it
    is the first to do so."""

    si: Any
    bsdf: Any
    throughput: Any
    length: Any
    is_first: Any


@dr.syntax
def gather(maps: PhotonMaps, vertex: Vertex, sample: Any, xi: list[Any], chance: Any, active: Any) -> CausticLight:
    """The light of the photons around a vertex.

    `chance` decides which levels are gathered. Neighbouring lanes share it, so that they skip a level together.
    """
    photon, irradiance = dr.zeros(mi.UInt32, dr.width(sample)), dr.zeros(mi.Float, dr.width(sample))
    pick, is_wide = mi.Float(xi[2]), dr.full(mi.Bool, False, dr.width(sample))
    reach = maps.reach(vertex.si.p)
    for level, kind in enumerate(LEVELS):
        p, n = vertex.si.p, vertex.si.n
        if maps.near(level, p, reach, sample, active & (chance < kind.chance)):
            found = maps.gather(level, p, n, reach, sample, xi[0], xi[1], active)
            irradiance += found.irradiance / kind.chance
            fraction = dr.select(irradiance > 0, found.irradiance / kind.chance / irradiance, 0)
            taken = pick < fraction
            photon = dr.select(taken, found.photon, photon)
            is_wide = dr.select(taken, maps.is_wide[level], is_wide)
            pick = dr.select(taken, pick / fraction, (pick - fraction) / (1 - fraction))
    return CausticLight(photon, irradiance, is_wide)


@dr.syntax
def caustic_light(
    maps: PhotonMaps,
    accumulators: Accumulators,
    channels: list[list[Any]],
    vertex: Vertex,
    brought: CausticLight,
    place: Any,
) -> tuple[list[list[Any]], Any]:
    """Channels with the light of the photons at a vertex added, and the radiance they bring to the camera."""
    radiance = dr.zeros(mi.Float, dr.width(place))
    found = brought.irradiance > 0
    if found:
        flight = maps.flight(brought.photon, found)
        wi, wo = vertex.si.wi, vertex.si.to_local(-flight.direction)
        value = vertex.bsdf.eval(mi.BSDFContext(), vertex.si, wo, found)
        # Photons count flux per area, so the geometric cosine is in them already; the BSDF counts that to the shading
        # normal (Veach 1997, 5.3). Where a photon landed beside an edge, its own facet is the one that counts
        seen, lit = dr.dot(vertex.si.to_world(wi), vertex.si.n), -dr.dot(flight.direction, vertex.si.n)
        cosine = dr.maximum(flight.cosine, dr.abs(lit) / MAX_BENT)
        on_one_side = seen * lit * wi.z * wo.z > 0  # for both normals, or for neither
        radiance = vertex.throughput * brought.irradiance * mono(value) / cosine
        radiance = dr.select(found & on_one_side, radiance, 0)
        length = vertex.length + flight.length
        path = LightPath(flight.u, flight.v, length, vertex.is_first, mi.UInt32(CAUSTIC))
        channels = accumulators.add(channels, path, radiance, place, found, brought.is_wide)
    return channels, radiance
