# SPDX-License-Identifier: Apache-2.0
"""Entry point for moving scenes: scene, rig, sensors with timings and motion in, signals of each sensor out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Unpack

from rangesim.motion.moving_scanner import on_its_way
from rangesim.motion.moving_signals import FrameStack
from rangesim.motion.passes import plan
from rangesim.motion.pose_tracks import Motion
from rangesim.motion.timing import Timing
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.signals import Signals, SignalSet, StillSignals

if TYPE_CHECKING:
    from rangesim.light_transport.transport_settings import TransportOptions, TransportSettings
    from rangesim.scene import Scene


def transport_moving(
    scene: Scene,
    rig: Rig,
    timings: Mapping[Sensor, Timing],
    motion: Motion,
    settings: TransportSettings | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **options: Unpack[TransportOptions],
) -> dict[Sensor, Signals]:
    """Signals of sensors in a moving scene; every exposure, and every band of lines, is rendered at its own time.

    Exposures of all sensors share a transport pass if everything is in the same place at their times. So without motion
    there is one pass, and the frames have the same bytes as those of `transport`. A stack of k patterns takes k passes
    if something moves. All passes of the whole image use the same random numbers, so surfaces at rest look the same in
    all frames.

    Parameters
    ----------
    scene : Scene of `load_scene`; it is not changed.
    rig : Rig without motion. If its rays have times (`rangesim.rig.Spinning`), they move with the rig in one pass, and
        the result is in the coordinates of the scanner at the start (`moving_scanner`).
    timings : sensor -> Timing, the times of its frames.
    motion : Motion, the tracks of objects and rig.
    settings : TransportSettings of each pass; None: the defaults. AdaptiveSampling is refused: passes would sample the
        same surface differently, and its noise would differ from frame to frame.
    progress : function that is called with the fraction done, 0..1.
    options : single fields that replace those of `settings`, such as spp=64 or seed=1.

    Returns
    -------
    dict
        sensor -> Signals for `rangesim.expose`; a `SignalSet` for a sensor of several cameras. `truth`, `energy` and
        `rig` are those at the middle of the sensor's acquisition, `Timing.reference_s`. The pose of a point cloud is
        also that of the middle. For each pixel, `motion_m` is the largest distance, in camera coordinates, between a
        surface point at an exposure of the pixel and the same point at that middle. It covers the point that the pixel
        sees at the middle and the points that it sees at its exposures, such as those of an object that passes by.
        Where a shadow passes, it is the distance of the fastest object. It is None if one pass serves all exposures of
        the sensor.

    Raises
    ------
    ValueError
        A shape that is not in the scene or cannot move, or settings that `transport` refuses.

    Examples
    --------
    >>> import rangesim
    >>> from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving
    >>> sensor, motion = rangesim.AmcwToF(), Motion({"large_ball": ConstantTwist(velocity_m_s=(0.3, 0, 0))})
    >>> scene = rangesim.load_scene("matte")  # doctest: +SKIP
    >>> rig = scene.rig(width=160)  # doctest: +SKIP
    >>> signals = transport_moving(scene, rig, {sensor: Timing(frame_period_s=0.01)}, motion)  # doctest: +SKIP
    >>> signals[sensor].motion_m.max()  # doctest: +SKIP
    """
    from rangesim.light_transport.light_pass import trace_light
    from rangesim.light_transport.samples_per_pixel import Sampler
    from rangesim.light_transport.transport_settings import with_options
    from rangesim.light_transport.truncation import warn_of_truncation
    from rangesim.scene.rigid_motion import MovingScene

    _check(scene, rig, timings, motion)
    rig, motion = on_its_way(rig, timings, motion)
    settings = with_options(settings, options)
    kinds: list[dict[Sensor, Timing]] = []  # sensors that share all cameras
    for sensor, timing in timings.items():
        shared = (kind for kind in kinds if next(iter(kind)).rigs(rig) == sensor.rigs(rig))
        kind = next(shared, None)
        if kind is None:
            kinds.append({sensor: timing})
        else:
            kind[sensor] = timing
    if len(kinds) > 1:
        found: dict[Sensor, Signals] = {}
        for number, kind in enumerate(kinds):
            told = progress and partial(_report, progress, number, len(kinds))
            found |= transport_moving(scene, rig, kind, motion, settings, progress=told)
        return {sensor: found[sensor] for sensor in timings}
    rigs = next(iter(timings)).rigs(rig)
    if any((one.camera.width, one.camera.height) != (rig.camera.width, rig.camera.height) for one in rigs):
        raise ValueError("expected cameras of one size where something moves.")
    if isinstance(settings.spp, Sampler):
        raise ValueError(
            f'expected a number of samples or "auto" where something moves, got {type(settings.spp).__name__}.'
        )
    stage = MovingScene(scene, tuple(motion.objects))
    passes = plan(rig, timings, motion)
    at_once: dict[Sensor, list[StillSignals]] = {}
    stacks: dict[Sensor, list[FrameStack]] = {}
    for number, one in enumerate(passes):
        of_cameras = trace_light(
            stage.at(one.poses.objects),
            [one.rig(of_camera) for of_camera in rigs],
            [response for sensor in one.sensors for response in sensor.responses()],
            replace(settings, seed=one.seed(settings.seed)),
            progress and partial(_report, progress, number, len(passes)),
        )
        warn_of_truncation(of_cameras[0].truncation, settings.max_depth, "", stacklevel=2)
        for sensor in one.reference_of:
            if any(sensor in other.sensors for other in passes if other is not one):
                stacks[sensor] = [
                    FrameStack(sensor, timings[sensor], of_camera, one, signals)
                    for of_camera, signals in zip(rigs, of_cameras, strict=True)
                ]
            else:
                at_once[sensor] = [signals.only(sensor) for signals in of_cameras]
        for sensor in one.sensors:
            for stack, signals in zip(stacks.get(sensor, []), of_cameras, strict=False):
                stack.add(one, signals)
    return {
        sensor: _together(at_once[sensor] if sensor in at_once else [stack.signals() for stack in stacks[sensor]])
        for sensor in timings
    }


def _together(of_cameras: Sequence[Signals]) -> Signals:
    """The signals of the only camera, or a set of those of several."""
    return of_cameras[0] if len(of_cameras) == 1 else SignalSet.of(of_cameras)


def _report(progress: Callable[[float], None], number: int, passes: int, fraction: float) -> None:
    progress((number + fraction) / passes)


def _check(scene: Scene, rig: Rig, timings: Mapping[Sensor, Timing], motion: Motion) -> None:
    from rangesim.scene import Scene

    if not isinstance(scene, Scene):
        raise ValueError(f"expected a Scene, as load_scene returns, got {type(scene).__name__}.")
    if not isinstance(rig, Rig):
        raise ValueError(f"expected a Rig, as scene.rig() returns, got {type(rig).__name__}.")
    if not isinstance(motion, Motion):
        raise ValueError(f"expected a Motion, got {motion!r}.")
    if not isinstance(timings, Mapping) or not timings:
        raise ValueError(f"expected sensors with their timings, for example {{AmcwToF(): Timing()}}, got {timings!r}.")
    for sensor, timing in timings.items():
        if not isinstance(sensor, Sensor) or not isinstance(timing, Timing):
            raise ValueError(f"expected a Timing for each sensor, got {timing!r} for {sensor!r}.")
        sensor.check(rig.projector.width, rig.projector.height)
    motion.check(i.name for i in scene.instances)
