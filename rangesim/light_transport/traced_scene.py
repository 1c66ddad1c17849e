# SPDX-License-Identifier: Apache-2.0
"""What light meets: scene, devices, media; the same for camera paths, photons, glint and the ground truth."""

from __future__ import annotations

from typing import Any, NamedTuple

from rangesim.light_transport.absorption import absorbers_of
from rangesim.light_transport.cutouts import cutouts_of
from rangesim.light_transport.device import Device
from rangesim.light_transport.scattering import media_of
from rangesim.light_transport.surfaces import surfaces_of
from rangesim.rig import Rig


class TracedScene(NamedTuple):
    """A scene and a rig, ready for kernels.

    scene : mitsuba.Scene. surfaces : what rays are intersected with, see `surfaces_of`.
    camera, projector : Device.
    media, cutouts, absorbers : Media, Cutouts and Absorbers; None where there are none, and their code is in no kernel.
    """

    scene: Any
    surfaces: Any
    camera: Device
    projector: Device
    media: Any = None
    cutouts: Any = None
    absorbers: Any = None

    @classmethod
    def of(cls, scene: Any, rig: Rig) -> TracedScene:
        """A mitsuba.Scene that `rangesim.scene.load_scene` has checked, seen by a rig in its coordinates."""
        camera, projector = Device.camera(rig), Device.projector(rig)
        parts = surfaces_of(scene), camera, projector, media_of(scene), cutouts_of(scene), absorbers_of(scene)
        return cls(scene, *parts)
