# SPDX-License-Identifier: Apache-2.0
"""Scanners that move while they scan: their rig for one light-transport pass, and their images as they report them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rangesim.decoding.range_image import RangeImage
from rangesim.motion.pose_tracks import Motion, Track
from rangesim.motion.timing import Timing
from rangesim.rig import Beam, MovingCamera, Rig
from rangesim.sensor import Sensor


def moving_scanner(rig: Rig, track: Track, start_s: float = 0.0) -> Rig:
    """The rig of a scanner that moves along a track during its scan; a still scene takes one pass, however it moves.

    Its camera is a `MovingCamera`: the rays of the scanner, each from where it is measured. So range images of this rig
    know the motion, and their clouds are de-skewed, in the coordinates of the scanner at the start. `as_reported` gives
    what the scanner itself would report.

    Parameters
    ----------
    rig : Rig without motion, whose camera has times, such as `Spinning`, and whose emitter is a `Beam`.
    track : motion of the rig as in `Motion.rig`: world transforms T(t), applied to the rig as it stands.
    start_s : seconds on the track's clock at which the scan starts.

    Raises
    ------
    ValueError
        The rays of the camera have no times, or the emitter is no beam: other emitters do not move with the rays.

    Examples
    --------
    >>> from rangesim.motion import ConstantTwist
    >>> from rangesim.rig import Spinning, look_at
    >>> head = Spinning(elevations_deg=(0.0,), columns=4, period_s=0.1)
    >>> rig = Rig(head, Beam(), look_at((0, 0, 1.8), (1, 0, 1.8)))
    >>> moving_scanner(rig, ConstantTwist(velocity_m_s=(15.0, 0.0, 0.0))).camera.pixel_rays().origins[0, :, 2]
    array([0.   , 0.375, 0.75 , 1.125])
    """
    times = rig.camera.times_s
    if times is None:
        raise ValueError(f"expected a camera whose rays have times, got {type(rig.camera).__name__}.")
    if not isinstance(rig.projector, Beam):
        raise ValueError(
            f"expected a Beam as the emitter of a scanner that moves, got {type(rig.projector).__name__}: only a beam "
            "moves with the rays."
        )
    start = track.at(start_s) @ rig.T_world_camera
    poses = np.linalg.inv(start) @ track.poses_at(start_s + np.unique(times)) @ rig.T_world_camera
    return replace(rig, camera=MovingCamera(rig.camera, poses), T_world_camera=start)


def on_its_way(rig: Rig, timings: Mapping[Sensor, Timing], motion: Motion) -> tuple[Rig, Motion]:
    """A rig and the motion that is left for it: a scanner takes the motion of the rig into its rays.

    Other cameras and their motion are returned as they are.

    Raises
    ------
    ValueError
        The camera scans, and a sensor has several exposures, or the timings do not start together.
    """
    if rig.camera.times_s is None or (motion.rig is None and not motion.objects):
        return rig, motion
    for sensor, timing in timings.items():
        timing.check_scan(sensor)
    starts = {timing.start_s for timing in timings.values()}
    if len(starts) > 1:
        raise ValueError(f"expected one start_s for all sensors of a scan, got {', '.join(map(str, sorted(starts)))}.")
    if motion.rig is None:
        return rig, motion
    return moving_scanner(rig, motion.rig, starts.pop()), Motion(motion.objects)


def as_reported(image: RangeImage) -> RangeImage:
    """The range image of a scanner that moved, as the scanner reports it: as if it had stood still (a raw scan).

    The ranges are the same; they are taken along the rays of the scanner at rest, in its coordinates at the start. So
    the cloud is skewed, and `deskewed` straightens it.

    Raises
    ------
    ValueError
        The image is not that of a `MovingCamera`.
    """
    if not isinstance(image.camera, MovingCamera):
        name = "none" if image.camera is None else type(image.camera).__name__
        raise ValueError(f"expected a range image of a MovingCamera, got one of {name}.")
    camera = image.camera.camera
    return replace(image, camera=camera, z=camera.z_of(image.range_m).astype(image.z.dtype))
