# SPDX-License-Identifier: Apache-2.0
"""The scene and the rig as all kernels see them: camera paths, caustics, glint and the ground truth."""

from __future__ import annotations

from typing import NamedTuple

import mitsuba as mi

from rangesim.light_transport.absorption import Absorbers, absorbers_of
from rangesim.light_transport.beams import BeamDevice, emitter_device
from rangesim.light_transport.camera_rays import Device
from rangesim.light_transport.cutouts import Cutouts, cutouts_of
from rangesim.light_transport.ray_tables import RayTableDevice, camera_device
from rangesim.light_transport.scattering import Media, media_of
from rangesim.light_transport.surfaces import Surfaces, surfaces_of
from rangesim.rig import Rig


class TracedScene(NamedTuple):
    """A scene and a rig, ready for kernels.

    scene : mitsuba.Scene
    surfaces : the scene itself, or its `Surfaces`; rays are intersected with this, see `surfaces_of`.
    camera : Device of a pinhole, or RayTableDevice.
    projector : Device, or BeamDevice.
    media, cutouts, absorbers : Media, Cutouts and Absorbers. None if the scene has none: no kernel then has code for
        them.
    """

    scene: mi.Scene
    surfaces: mi.Scene | Surfaces
    camera: Device | RayTableDevice
    projector: Device | BeamDevice
    media: Media | None = None
    cutouts: Cutouts | None = None
    absorbers: Absorbers | None = None

    @classmethod
    def of(cls, scene: mi.Scene, rig: Rig) -> TracedScene:
        """A traced scene of a mitsuba.Scene that `rangesim.scene.load_scene` has checked, and a rig in its
        coordinates."""
        camera, projector = camera_device(rig), emitter_device(rig)
        surfaces = surfaces_of(scene)
        cutouts = cutouts_of(scene, surfaces)
        return cls(scene, surfaces, camera, projector, media_of(scene), cutouts, absorbers_of(scene))
