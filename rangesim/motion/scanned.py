# SPDX-License-Identifier: Apache-2.0
"""Signals of scanners in a moving scene: each ray is measured at its own time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.motion.moving_scanner import moving_scanner
from rangesim.motion.pose_tracks import Motion
from rangesim.motion.timing import Timing
from rangesim.rig import Beam, CroppedCamera, Rig
from rangesim.sensor import Sensor
from rangesim.settings.seeds import derived_seed
from rangesim.signals import EnergySplit, GroundTruth, SamplingError, StillSignals

Part = TypeVar("Part", EnergySplit, GroundTruth)


def scanned_signals(
    stage_at: Callable[[dict[str, np.ndarray]], Any],
    rig: Rig,
    sensors: Sequence[Sensor],
    timing: Timing,
    motion: Motion,
    settings: TransportSettings,
    report: Callable[[float], None] | None,
) -> StillSignals:
    """Signals of sensors that share a scanner, from one pass, or from one for each band of rays if objects move.

    A motion of the scanner needs no passes of its own, because each ray starts where it is measured
    (`rangesim.rig.MovingCamera`). Objects stand still during a band of rays, at the time of its middle. The truth of a
    ray is that of its own time.

    Parameters
    ----------
    stage_at : function that returns the scene with its objects at these world transforms, by name.
    rig : Rig without motion, whose camera has times.
    timing : Timing; its `start_s` is the time of the first ray, and `bands` the number of passes if objects move.
    report : function that is called with the fraction done; None: nobody listens.

    Raises
    ------
    ValueError
        The timing has lines, which contradicts the times of the rays, or the scanner moves without a beam.
    """
    from rangesim.light_transport.light_pass import trace_light

    times = rig.camera.times_s
    assert times is not None
    if timing.line_period_s:
        raise ValueError(
            f"expected line_period_s=0 for a {type(rig.camera).__name__}, whose rays have times of their own, got "
            f"{timing.line_period_s:g}."
        )
    whole = rig if motion.rig is None else moving_scanner(rig, motion.rig, timing.start_s)
    responses = list(dict.fromkeys(response for sensor in sensors for response in sensor.responses()))
    axis, edges = _bands(times, timing.bands if motion.objects else 1)
    parts = []
    for number, (begin, end) in enumerate(pairwise(edges)):
        some = (slice(None), slice(begin, end)) if axis else (slice(begin, end), slice(None))
        one = whole if len(edges) == 2 else _cropped(whole, some)
        poses = motion.at(timing.start_s + float(times[some].mean()))
        seed = derived_seed(settings.seed, number) if number else settings.seed
        (signals,) = trace_light(
            stage_at(poses.objects),
            [one],
            responses,
            replace(settings, seed=seed),
            report and partial(_report, report, number, len(edges) - 1),
        )
        parts.append(signals)
    return parts[0] if len(parts) == 1 else _joined(whole, parts, axis)


def _report(report: Callable[[float], None], number: int, bands: int, fraction: float) -> None:
    report((number + fraction) / bands)


def _bands(times: np.ndarray, bands: int) -> tuple[int, list[int]]:
    """Axis along which the times of the rays change most, and the edges of bands of lines along it."""
    steps = [float(np.abs(np.diff(times.mean(axis=1 - axis))).sum()) for axis in (0, 1)]
    axis = int(np.argmax(steps))
    lines = times.shape[axis]
    return axis, np.linspace(0, lines, min(bands, lines) + 1).round().astype(int).tolist()


def _cropped(rig: Rig, some: tuple[slice, slice]) -> Rig:
    """The rig with some of the rays of its camera, and their beams."""
    projector = rig.projector
    if isinstance(projector, Beam) and projector.directions is not None:
        projector = replace(projector, directions=projector.directions[some])
    rows, columns = (s.indices(n) for s, n in zip(some, (rig.camera.height, rig.camera.width), strict=True))
    camera = CroppedCamera(rig.camera, rows[0], rows[1], columns[0], columns[1])
    return replace(rig, camera=camera, projector=projector)


def _joined(rig: Rig, parts: Sequence[StillSignals], axis: int) -> StillSignals:
    """The signals of all bands as one image; `axis` is 0 for bands of rows, 1 for bands of columns."""

    def images(arrays: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate(arrays, axis=axis)

    def channels(each: Sequence[dict[Any, np.ndarray]]) -> dict[Any, np.ndarray]:
        return {response: np.concatenate([one[response] for one in each], axis=1 + axis) for response in each[0]}

    def joined(each: Sequence[Part]) -> Part:
        arrays = [f.name for f in fields(each[0]) if isinstance(getattr(each[0], f.name), np.ndarray)]
        together: dict[str, Any] = {name: images([getattr(one, name) for one in each]) for name in arrays}
        return replace(each[0], **together)

    errors = [part.sampling for part in parts if part.sampling is not None]
    sampling = None
    if len(errors) == len(parts):
        sampling = SamplingError(channels([e.channels for e in errors]), images([e.projector for e in errors]))
    energy, truth = joined([part.energy for part in parts]), joined([part.truth for part in parts])
    lossy = max(parts, key=lambda part: part.truncation.total if part.truncation else 0.0)
    return StillSignals(
        rig,
        energy,
        truth,
        truncation=lossy.truncation,
        channels=channels([part.channels for part in parts]),
        sampling=sampling,
    )
