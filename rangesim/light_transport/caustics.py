# SPDX-License-Identifier: Apache-2.0
"""The projector's light beyond glass and mirrors, ready to be gathered: how many photons, maps, and what radius."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rangesim.light_transport.indirect import REACH_PX
from rangesim.light_transport.photon_maps import MAX_MAPS, GatheringRadius, PhotonMaps
from rangesim.light_transport.photons import has_delta, trace_photons
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.rig import Rig

PHOTONS = 500_000
PHOTONS_PER_DISC = 400
"""Photons of all maps within the largest radius, where light is neither spread nor focused."""
RADIUS_IN_PROJECTOR_PIXELS = 3.0
RADIUS_IN_CAMERA_PIXELS = (0.3, 3.0)
"""Bounds of the largest photon radius, where it is: finer than the stripes, about as fine as the image."""

MIN_RADIUS_M = 1e-6


def caustic_maps(
    traced: TracedScene,
    rig: Rig,
    photons: int,
    radius_m: float | None,
    spp: int,
    seed: int,
    memory_bytes: int,
    report: Callable[[], None] = lambda: None,
) -> PhotonMaps | None:
    """Maps for a pass of `spp` samples; None if there are no photons, nothing to send them through, or none landed.

    `report` is called after each kernel launch.
    """
    if not photons or not has_delta(traced.scene):
        return None
    maps = min(spp, MAX_MAPS)
    landed = trace_photons(traced, rig.projector_power_w, photons, maps, seed, memory_bytes, report)
    radius = gathering_radius(rig, landed.per_pixel, radius_m)
    wide = REACH_PX / rig.camera.fx
    return PhotonMaps(landed, maps, radius, rig.projector_irradiance, wide) if len(landed.flux) else None


def gathering_radius(rig: Rig, photons_per_pixel: float, fixed_m: float | None = None) -> GatheringRadius:
    """Largest photon radius: wide enough for `PHOTONS_PER_DISC`, within bounds; or the same everywhere."""
    of_projector = min(np.sqrt(PHOTONS_PER_DISC / (np.pi * photons_per_pixel)), RADIUS_IN_PROJECTOR_PIXELS)
    low, high = (pixels / rig.camera.fx for pixels in RADIUS_IN_CAMERA_PIXELS)
    places = (rig.T_world_projector[:3, 3], rig.T_world_camera[:3, 3])
    return GatheringRadius(float(of_projector / rig.projector.fx), (low, high), *places, fixed_m)


def check_photons(photons: int, radius_m: float | None) -> None:
    """Raise ValueError if there cannot be so many photons, or no such radius."""
    if not isinstance(photons, (int, np.integer)) or photons < 0:
        raise ValueError(f"expected photons to be a whole number of at least 0, got {photons!r}.")
    if radius_m is not None and not MIN_RADIUS_M <= radius_m < np.inf:
        raise ValueError(f"expected a caustic_radius_m of at least {MIN_RADIUS_M:g} m, got {radius_m!r}.")
