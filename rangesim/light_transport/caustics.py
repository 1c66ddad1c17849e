# SPDX-License-Identifier: Apache-2.0
"""The projector's light beyond glass and mirrors, as camera paths gather it.

This module chooses the number of photons and the radius within which they are gathered, and computes the light that
they bring to a vertex of a camera path.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.accumulators import Accumulators
from rangesim.light_transport.beams import BeamDevice
from rangesim.light_transport.indirect_filter import REACH_PX
from rangesim.light_transport.photon_maps import LEVELS, MAX_MAPS, GatheringRadius, PhotonMaps
from rangesim.light_transport.photons import Photons, has_delta, trace_photons
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.response import CAUSTIC, LightPath
from rangesim.rig import Rig

PHOTONS_PER_DISC = 400
"""Number of photons of all maps within the radius of the first map, where light is neither spread nor focused; the
radius is chosen so that there are this many. An estimate from n photons has a relative noise of about 1 / sqrt(n), so
fewer photons make more noise. More photons need a larger radius, which blurs more."""
MAX_RADIUS_PROJECTOR_PX = 3.0
"""Largest radius of the first map, in projector pixels at the distance of the point, so that the blur stays finer than
the stripes of structured light."""
MIN_RADIUS_CAMERA_PX = 0.3
"""Smallest radius of the first map, in camera pixels at the distance of the point, because the image shows nothing
finer."""
MAX_RADIUS_CAMERA_PX = 3.0
"""Largest radius of the first map, in camera pixels at the distance of the point, so that the image of a caustic stays
sharp."""
MAX_COSINE_RATIO = 4.0
"""Largest ratio of two cosines of a photon's direction: that to the facet at the vertex, and that to the facet on which
the photon landed. Radiance is divided by the second cosine, so without this bound, a facet that photons meet edge-on
would bring any amount of light. A smaller bound would darken caustics beside edges where facets meet at an angle."""


def caustic_photons(
    traced: TracedScene,
    rig: Rig,
    settings: TransportSettings,
    pixels: int,
    spp: int,
    report: Callable[[], None] = lambda: None,
) -> Photons | None:
    """Photons for a pass of any camera; None if the caller wants none, no surface has a delta interaction, or none
    landed. A beam needs none, see `rangesim.light_transport.beams`.

    Parameters
    ----------
    pixels : int, number of pixels of the largest camera, on which the number of photons depends by default.
    spp : int, number of samples of a pixel, which is the number of photon maps up to `MAX_MAPS`.
    report : called after each kernel launch.
    """
    number = settings.photons_for(pixels)
    if not number or not has_delta(traced.scene) or isinstance(traced.projector, BeamDevice):
        return None
    maps, memory_bytes = min(spp, MAX_MAPS), settings.memory_bytes
    landed = trace_photons(traced, rig.projector_power_w, number, maps, settings.seed, memory_bytes, report)
    return landed if len(landed.flux) else None


def caustic_maps(photons: Photons | None, rig: Rig, radius_m: float | None) -> PhotonMaps | None:
    """The photons sorted into maps, from which the camera of the rig gathers them; None if there are none.

    `radius_m` is the radius of the first map in metres; None chooses it.
    """
    if photons is None:
        return None
    radius = gathering_radius(rig, photons.per_pixel, radius_m)
    return PhotonMaps(photons, radius, rig.projector_irradiance, rig.camera.angle_of(REACH_PX))


def gathering_radius(rig: Rig, photons_per_pixel: float, fixed_m: float | None = None) -> GatheringRadius:
    """Radius within which photons of the first map are gathered.

    It is wide enough for `PHOTONS_PER_DISC` photons, as far as its bounds allow. With `fixed_m` it is this number of
    metres everywhere.
    """
    of_projector = min(np.sqrt(PHOTONS_PER_DISC / (np.pi * photons_per_pixel)), MAX_RADIUS_PROJECTOR_PX)
    low, high = (rig.camera.angle_of(pixels) for pixels in (MIN_RADIUS_CAMERA_PX, MAX_RADIUS_CAMERA_PX))
    places = (rig.T_world_projector[:3, 3], rig.T_world_camera[:3, 3])
    return GatheringRadius(rig.image_projector.angle_of(float(of_projector)), (low, high), *places, fixed_m)


class CausticLight(NamedTuple):
    """Light that the photons around a vertex bring.

    photon : UInt32, index of the photon that stands for all.
    irradiance : Float, W/m2, of all photons together.
    is_wide : Bool, whether the photon was found within a wide circle, so that the light is smooth.
    """

    photon: mi.UInt32
    irradiance: mi.Float
    is_wide: mi.Bool


class Vertex(NamedTuple):
    """A vertex of a camera path.

    si, bsdf : SurfaceInteraction3f and BSDFPtr, the surface.
    throughput : Float, radiance at the camera per radiance that leaves the vertex towards it.
    length : Float, metres, optical length from the camera.
    is_first : Bool, whether photons there are the first return: the vertex is the first of the path, and the projector
        does not light it straight.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    throughput: mi.Float
    length: mi.Float
    is_first: mi.Bool


@dr.syntax
def gather(
    maps: PhotonMaps, vertex: Vertex, sample: mi.UInt32, xi: list[mi.Float], chance: mi.Float, active: mi.Bool
) -> CausticLight:
    """The light of the photons around a vertex.

    Parameters
    ----------
    sample : UInt32, number of the sample in its pixel, which chooses the map.
    xi : three Floats, uniform in 0..1.
    chance : Float, uniform in 0..1; a level of photons is gathered if this number is below the `chance` of the level.
        Neighbouring lanes share the number, so that they skip a level together.
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
    channels: list[list[mi.Float]],
    vertex: Vertex,
    brought: CausticLight,
    place: mi.UInt32,
) -> tuple[list[list[mi.Float]], mi.Float]:
    """Add the light of the photons around a vertex; returns the channels and the radiance (W/m2/sr) at the camera.

    `place` is the index of the lane's pixel among those of the accumulators.
    """
    radiance = dr.zeros(mi.Float, dr.width(place))
    found = brought.irradiance > 0
    if found:
        flight = maps.flight(brought.photon, found)
        wi, wo = vertex.si.wi, vertex.si.to_local(-flight.direction)
        value = vertex.bsdf.eval(mi.BSDFContext(), vertex.si, wo, found)
        # Photons count flux per area, which contains the geometric cosine already; the value of the BSDF contains the
        # cosine to the shading normal (Veach 1997, 5.3). If a photon landed beside an edge, the cosine is that to its
        # own facet
        seen, lit = dr.dot(vertex.si.to_world(wi), vertex.si.n), -dr.dot(flight.direction, vertex.si.n)
        cosine = dr.maximum(flight.cosine, dr.abs(lit) / MAX_COSINE_RATIO)
        on_one_side = seen * lit * wi.z * wo.z > 0  # for both normals, or for neither
        radiance = vertex.throughput * brought.irradiance * mono(value) / cosine
        radiance = dr.select(found & on_one_side, radiance, 0)
        length = vertex.length + flight.length
        path = LightPath(flight.u, flight.v, length, vertex.is_first, mi.UInt32(CAUSTIC))
        channels = accumulators.add(channels, path, radiance, place, found, brought.is_wide)
    return channels, radiance
