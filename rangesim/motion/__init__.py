# SPDX-License-Identifier: Apache-2.0
"""Captures of a world that moves: objects and rig on pose tracks, each exposure at its own time; see docs/motion.md."""

from rangesim.motion.moving_signals import MovingSignals
from rangesim.motion.timing import Timing
from rangesim.motion.track import ConstantTwist, Motion, PoseTrack, Track
from rangesim.motion.transport_moving import transport_moving

__all__ = ["ConstantTwist", "Motion", "MovingSignals", "PoseTrack", "Timing", "Track", "transport_moving"]
