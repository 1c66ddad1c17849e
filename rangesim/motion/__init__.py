# SPDX-License-Identifier: Apache-2.0
"""Captures of moving scenes: objects and rig follow pose tracks, and each exposure has its own time (docs/motion.md).

Examples
--------
An object moves to the right by 0.3 m/s, while patterns are projected and captured one by one:

>>> from rangesim import StructuredLight
>>> from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving
>>> motion = Motion({"large_ball": ConstantTwist(velocity_m_s=(0.3, 0.0, 0.0))})
>>> timings = {StructuredLight(): Timing(frame_period_s=1 / 120)}
>>> signals = transport_moving(scene, rig, timings, motion)  # doctest: +SKIP
"""

from rangesim.motion.deskewing import deskewed
from rangesim.motion.moving_scanner import as_reported, moving_scanner
from rangesim.motion.moving_signals import MovingSignals
from rangesim.motion.pose_tracks import ConstantTwist, Motion, PoseTrack, Track
from rangesim.motion.timing import Timing
from rangesim.motion.transport_moving import transport_moving

__all__ = [
    "ConstantTwist",
    "Motion",
    "MovingSignals",
    "PoseTrack",
    "Timing",
    "Track",
    "as_reported",
    "deskewed",
    "moving_scanner",
    "transport_moving",
]
