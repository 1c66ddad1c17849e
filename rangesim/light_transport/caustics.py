# SPDX-License-Identifier: Apache-2.0
"""The projector's light beyond glass and mirrors, ready to be gathered: how many photons, maps, and what radius."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rangesim.light_transport.indirect import REACH_PX
from rangesim.light_transport.photon_maps import MAX_MAPS, GatheringRadius, PhotonMaps
from rangesim.light_transport.photons import Photons, has_delta, trace_photons
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.rig import Rig

PHOTONS_PER_DISC = 400
"""Photons of all maps within the largest radius, where light is neither spread nor focused."""
RADIUS_IN_PROJECTOR_PIXELS = 3.0
RADIUS_IN_CAMERA_PIXELS = (0.3, 3.0)
"""Bounds of the largest photon radius, where it is: finer than the stripes, about as fine as the image."""


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
