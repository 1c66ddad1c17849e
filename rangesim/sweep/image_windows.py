# SPDX-License-Identifier: Apache-2.0
"""A part of a camera's pixels, with the light and the noise of the whole: for sweeps over even scenes, and probes."""

from __future__ import annotations

from dataclasses import replace

from rangesim.rig import Beam, Intrinsics, Rig
from rangesim.sensor import Sensor

PROBE_PX = 48
"""Pixels across of the images in which automatic exposure is looked for: the bright 1 % of them are 17 pixels."""


def windowed(rig: Rig, sensor: Sensor, width_px: int | None) -> Rig:
    """The rig with the middle of its image alone, pixel for pixel.

    Cameras that are no pinhole stay as they are. Of sensors that match texture along rows, the rows stay whole.

    Parameters
    ----------
    width_px : pixels across, three quarters as many down; None: the whole image.

    Examples
    --------
    >>> from rangesim.sensors import AmcwToF
    >>> camera = Intrinsics.from_fov(640, 480, fov_x_deg=50.0)
    >>> small = windowed(Rig(camera, camera), AmcwToF(), 64).camera
    >>> small.width, small.height, small.cx, small.fx == camera.fx
    (64, 48, 32.0, True)
    """
    camera = rig.camera
    if width_px is None or not isinstance(camera, Intrinsics):
        return rig
    width = camera.width if sensor.compares_texture else min(width_px, camera.width)
    height = min(max(1, round(0.75 * width_px)), camera.height)
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    kept = slice(top, top + height), slice(left, left + width)
    return _with_camera(rig, camera.cropped(top, top + height, left, left + width), kept)


def coarse(rig: Rig, sensor: Sensor) -> Rig:
    """The rig with few pixels that see the whole image, for `PROBE_PX`; of texture, the middle of the image instead.

    The radiance in the image stays as it is. The light of a pixel does not: take the electrons of the rig itself.
    """
    camera = rig.camera
    if not isinstance(camera, Intrinsics) or camera.width <= PROBE_PX:
        return rig
    if sensor.compares_texture:
        return windowed(rig, sensor, PROBE_PX)
    return _with_camera(rig, camera.resized(PROBE_PX, max(1, round(PROBE_PX * camera.height / camera.width))))


def _with_camera(rig: Rig, camera: Intrinsics, kept: tuple[slice, slice] | None = None) -> Rig:
    """The rig with another camera, whose pixels are those of `kept` in the former one; a beam follows its rays."""
    beam = rig.projector
    if isinstance(beam, Beam) and beam.directions is not None:
        beam = replace(beam, directions=None if kept is None else beam.directions[kept])
    return replace(rig, camera=camera, projector=beam)
