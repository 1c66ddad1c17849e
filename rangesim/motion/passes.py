# SPDX-License-Identifier: Apache-2.0
"""Which transport passes a set of captures needs: exposures between which nothing has moved share one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangesim.motion.timing import Instant, Timing, Window
from rangesim.motion.track import Motion, Poses
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.settings.seeds import derived_seed


@dataclass(frozen=True, eq=False)
class Contribution:
    """What one sensor takes from a pass: a fraction (0..1) of the light of these frames, which one exposure fills.

    The pass at the middle of the acquisition may have no frames to give.
    """

    sensor: Sensor
    exposure: int
    frames: np.ndarray
    fraction: float


@dataclass(frozen=True, eq=False)
class Pass:
    """Light transport with everything at one place, for a window of the image.

    reference_of : the sensors whose middle of the acquisition this is.
    """

    poses: Poses
    window: Window
    contributions: list[Contribution] = field(default_factory=list)
    reference_of: list[Sensor] = field(default_factory=list)

    @property
    def sensors(self) -> list[Sensor]:
        """Those that take frames from this pass, in order of first appearance."""
        return list(dict.fromkeys(s.sensor for s in self.contributions))

    def rig(self, rig: Rig) -> Rig:
        """The rig where it is, its camera cropped to the window."""
        camera, window = rig.camera, self.window
        if window != Window.whole(camera):
            camera = replace(
                camera,
                width=window.right - window.left,
                height=window.bottom - window.top,
                cx=camera.cx - window.left,
                cy=camera.cy - window.top,
            )
        return replace(rig, camera=camera, T_world_camera=self.poses.place(rig))

    def seed(self, seed: int) -> int:
        """Seed of the pass: the same at all times, so that what stands still has the same noise in all frames, but
        another one for each place of the window, or every band of lines would repeat the noise of the first."""
        corner = (self.window.top, self.window.left)
        if not any(corner):
            return seed
        return derived_seed(seed, *corner)


def plan(rig: Rig, timings: Mapping[Sensor, Timing], motion: Motion) -> list[Pass]:
    """Passes for the captures of all sensors; those at the middle of an acquisition come first."""
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
    """Fewer instants that mean the same: where nothing has moved from one to the next, equal windows become one
    fraction, and then neighbouring bands one window."""
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
    """Whether the second window follows right below, or right beside, the first."""
    below = first.bottom == second.top and (first.left, first.right) == (second.left, second.right)
    beside = first.right == second.left and (first.top, first.bottom) == (second.top, second.bottom)
    return below or beside
