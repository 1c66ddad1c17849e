# SPDX-License-Identifier: Apache-2.0
"""Plan of the transport passes that a set of captures needs; exposures share a pass if nothing moves between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangesim.motion.pose_tracks import Motion, Poses
from rangesim.motion.timing import Instant, Timing, Window
from rangesim.rig import Beam, Rig
from rangesim.sensor import Sensor
from rangesim.settings.seeds import derived_seed


@dataclass(frozen=True, eq=False)
class Contribution:
    """Part of a sensor's frames that one pass gives.

    sensor : Sensor.
    exposure : index of the exposure that these frames belong to.
    frames : (n,) int, indices of the frames.
    fraction : fraction (0..1) of the exposure that the pass stands for.
    """

    sensor: Sensor
    exposure: int
    frames: np.ndarray
    fraction: float


@dataclass(frozen=True, eq=False)
class Pass:
    """One run of the light transport, with everything in one place, for a window of the image.

    poses : places of everything that moves.
    window : part of the image that is rendered.
    contributions : frames that this pass gives light to; none if the pass is only the middle of an acquisition.
    reference_of : sensors whose acquisition has its middle in this pass.
    """

    poses: Poses
    window: Window
    contributions: list[Contribution] = field(default_factory=list)
    reference_of: list[Sensor] = field(default_factory=list)

    @property
    def sensors(self) -> list[Sensor]:
        """Sensors that take frames from this pass, in the order of their first contribution."""
        return list(dict.fromkeys(s.sensor for s in self.contributions))

    def rig(self, rig: Rig) -> Rig:
        """The rig at its place in this pass, with its camera cropped to the window."""
        camera, projector, window = rig.camera, rig.projector, self.window
        if window != Window.whole(camera):
            camera = camera.cropped(*window)
            if isinstance(projector, Beam) and projector.directions is not None:
                rows, columns = slice(window.top, window.bottom), slice(window.left, window.right)
                projector = replace(projector, directions=projector.directions[rows, columns])
        return replace(rig, camera=camera, projector=projector, T_world_camera=self.poses.place(rig))

    def seed(self, seed: int) -> int:
        """Seed of this pass, for a seed of the whole acquisition.

        It is the same at all times, so surfaces at rest have the same noise in all frames. It differs between windows,
        because otherwise every band of lines would repeat the noise of the first band.
        """
        corner = (self.window.top, self.window.left)
        if not any(corner):
            return seed
        return derived_seed(seed, *corner)


def plan(rig: Rig, timings: Mapping[Sensor, Timing], motion: Motion) -> list[Pass]:
    """Passes for the captures of all sensors; the passes at the middle of an acquisition come first.

    Parameters
    ----------
    rig : Rig without motion.
    timings : Timing of each sensor.
    motion : tracks of everything that moves.
    """
    passes: dict[tuple[bytes, Window], Pass] = {}

    def at(time_s: float, window: Window) -> Pass:
        poses = motion.at(time_s)
        return passes.setdefault((poses.key, window), Pass(poses, window))

    for sensor, timing in timings.items():
        at(timing.reference_s(sensor, rig.camera), Window.whole(rig.camera)).reference_of.append(sensor)
    for sensor, timing in timings.items():
        exposures = timing.exposure_of_frames(sensor)
        for exposure, time_s in enumerate(timing.exposure_times_s(sensor)):
            frames = np.flatnonzero(exposures == exposure)
            for instant in _joined(timing.instants(time_s, rig.camera), motion):
                part = Contribution(sensor, exposure, frames, instant.fraction)
                at(instant.time_s, instant.window).contributions.append(part)
    return list(passes.values())


def _joined(instants: Sequence[Instant], motion: Motion) -> list[Instant]:
    """The same instants, but instants between which nothing moves are merged.

    Instants of the same window are merged by adding their fractions. Then neighbouring bands are merged to one window.
    """
    at_place: dict[tuple[bytes, Window], Instant] = {}
    for instant in instants:
        place = (motion.at(instant.time_s).key, instant.window)
        before = at_place[place].fraction if place in at_place else 0.0
        at_place[place] = instant._replace(fraction=before + instant.fraction)
    joined: dict[bytes, Instant] = {}
    result: list[Instant] = []
    for (key, window), instant in at_place.items():
        last = joined.get(key)
        if last is not None and np.isclose(last.fraction, instant.fraction) and _touch(last.window, window):
            result.remove(last)
            instant = last._replace(window=Window(last.window.top, window.bottom, last.window.left, window.right))
        joined[key] = instant
        result.append(instant)
    return result


def _touch(first: Window, second: Window) -> bool:
    """Whether the second window is directly below the first, or directly to its right."""
    below = first.bottom == second.top and (first.left, first.right) == (second.left, second.right)
    beside = first.right == second.left and (first.top, first.bottom) == (second.top, second.bottom)
    return below or beside
