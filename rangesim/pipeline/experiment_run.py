# SPDX-License-Identifier: Apache-2.0
"""The whole experiment: scene -> light -> captures -> range images -> points -> comparison, segments; and its files."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture
from rangesim.capture.exposure import exposed
from rangesim.causes.range_limits import fraction_beyond_range, warn_of_range
from rangesim.causes.rules import causes_of
from rangesim.decoding import decode
from rangesim.evaluation.comparison import compare
from rangesim.evaluation.range_noise import noise_of, warn_of_sampling
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.experiment import Experiment
from rangesim.files.result_directories import new_directory
from rangesim.instrument.instrument import Instrument
from rangesim.motion import transport_moving
from rangesim.pipeline.cost import Cost, estimate_cost
from rangesim.pipeline.provenance import provenance
from rangesim.pipeline.shared_passes import group_by_rig
from rangesim.results.run_files import (
    RESULT,
    Measurement,
    MeasurementRecord,
    PhotonsRecord,
    Result,
    Segmentation,
    complete_rows,
    write_result,
)
from rangesim.results.signals_files import LightPass
from rangesim.settings.seeds import derived_seed

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient
    from rangesim.electronics.detector import PhotoDetector
    from rangesim.motion import Timing
    from rangesim.point_cloud import PointCloud
    from rangesim.rig import Rig
    from rangesim.scene import Scene
    from rangesim.signals import Signals

Progress = Callable[[str, float], None]
"""Called with the name of the stage and the fraction of the whole job done, 0..1."""
_TRANSPORT_FRACTION = 0.7
MIN_POINTS = 3
"""Fewer points are no cloud worth grouping."""


def run(
    experiment: Experiment,
    out: str | Path,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
) -> Result:
    """Carry out an experiment and write its results, with `report.html`, to the directory `out`.

    The files appear when all is done; a failure leaves nothing behind. An older result of that name is replaced; files
    that somebody else put there stay. See `rangesim.files.result_directories`.

    Parameters
    ----------
    experiment, progress, scene, announce : as of `carry_out`.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `carry_out`, or an `out` that cannot take a result (see `rangesim.files.result_directories.check_directory`).

    Warns
    -----
    RangesimWarning, SamplingWarning
        As `carry_out`.
    """
    from rangesim.report import render_report
    from rangesim.report.tables import comparison_markdown

    with new_directory(out, RESULT, inputs=[experiment.scene]) as folder:
        result = _computed(experiment, progress or _unwatched, scene, announce)
        if progress:
            progress("Writing the report", 0.97)
        tables = comparison_markdown([(m.name, m.rows) for m in result.measurements])
        write_result(result, folder, {"comparison.md": tables.encode(), "report.html": render_report(result).encode()})
    _warn(result)
    return result


def carry_out(
    experiment: Experiment,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
) -> Result:
    """The result of an experiment; nothing is written.

    Parameters
    ----------
    progress : called with the name of the stage and the fraction done, 0..1.
    scene : a scene that is loaded already, for example from a dictionary; `experiment.scene` then only names it.
    announce : called with the estimated cost before the work starts.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        A setting out of range, more memory than there is, a scene that cannot be loaded, or no suitable LLVM.

    Warns
    -----
    RangesimWarning
        Surfaces outside the range of a sensor (`rangesim.causes.range_limits`).
    SamplingWarning
        See `warn_of_sampling`.
    """
    result = _computed(experiment, progress or _unwatched, scene, announce)
    _warn(result)
    return result


def estimate(experiment: Experiment) -> Cost:
    """Cost of `run`, in light paths, memory and time; the scene is loaded, and rendered small if it may take long.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `run`, but for the memory.
    """
    from rangesim.scene import load_scene

    scene = load_scene(experiment.scene, material=experiment.material, unit_m=experiment.unit_m)
    return estimate_cost(experiment, scene, group_by_rig(experiment, scene))


def _computed(
    experiment: Experiment, tell: Progress, scene: Scene | None, announce: Callable[[Cost], None] | None
) -> Result:
    """The result, before anything is warned about."""
    import mitsuba as mi

    from pcgraph.all_kernels import compile_kernels
    from rangesim.light_transport.kernel_launches import report_part
    from rangesim.scene import load_scene

    times: dict[str, float] = {}
    tell("Loading the scene", 0.0)
    with timed(times, "load"):
        scene = scene or load_scene(experiment.scene, material=experiment.material, unit_m=experiment.unit_m)
    if experiment.ambient is not None:
        experiment.ambient.check_emitters(scene.has_ambient)
    groups = group_by_rig(experiment, scene)
    cost = estimate_cost(experiment, scene, groups, trial=announce is not None)
    cost.check_memory()
    if announce is not None:
        announce(cost)
    with timed(times, "compile_segmentation"):  # once per machine; not to be charged to the first sensor
        compile_kernels()
    passes, measurements = [], {}
    for number, (rig, instruments) in enumerate(groups, 1):
        stage = f"Tracing light, pass {number} of {len(groups)} ({', '.join(i.name for i in instruments)})"
        begin, end = (_fraction(number, len(groups), of_pass) for of_pass in (0.0, 1.0))
        tell(stage, begin)
        told = None if tell is _unwatched else partial(report_part, partial(tell, stage), begin, end - begin)
        with timed(times, f"transport_{number}"):
            signals = _trace(experiment, scene, rig, instruments, told)
        passes.append(LightPass.of(signals))
        for instrument in instruments:
            tell(f"Measuring with {instrument.name}", end)
            seed = noise_seed(experiment, instrument)
            measurements[instrument.name] = measure(instrument, signals, seed, experiment.ambient, number)
    info = provenance(experiment, scene, groups, mi.variant(), times)
    return Result(experiment, tuple(measurements[i.name] for i in experiment.instruments), tuple(passes), info)


def _warn(result: Result) -> None:
    """Warn of surfaces out of range, and of readings that sampling decides."""
    beyond = []
    for m in result.measurements:
        assert m.capture.rig is not None
        beyond.append((m.name, *fraction_beyond_range(m.capture.sensor, m.capture.rig, m.truth)))
    warn_of_range(beyond)
    experiment = result.experiment
    warn_of_sampling({m.name: m.rows for m in result.measurements}, experiment.spp or experiment.max_spp)


def measure(
    instrument: Instrument, signals: Signals, seed: int, ambient: Ambient | None = None, light_pass: int = 1
) -> Measurement:
    """The measurement of one instrument: exposed, decoded, compared, explained and segmented.

    Parameters
    ----------
    signals : of the pass that the instrument takes part in, `light_pass`.
    seed : of the detector's noise.
    ambient : as for `rangesim.expose`.
    """
    times: dict[str, float] = {}
    moves = signals.motion_m is not None
    with timed(times, "exposure"):
        detector = _in_time(instrument) if moves else instrument.detector_in_use
        exposure = exposed(signals, instrument.sensor, detector, instrument.exposure_s, seed, ambient)
    capture, photons = exposure.capture, exposure.photons_per_pulse()
    if instrument.exposure_s is None:
        exposure.warn_of_overexposure(instrument.name)
    del exposure  # its radiance is as large as the frames
    with timed(times, "decode"):
        image = decode(capture, instrument.decoder)
    noise, readings = None, ReferenceReadings(image, capture, signals)
    if signals.knows_sampling_error:
        with timed(times, "noise"):
            noise = noise_of(readings)
        image = replace(image, sampling_sigma_m=np.abs(noise.sampling))
    comparison = compare(image, signals.truth)
    with timed(times, "causes"):
        causes = causes_of(readings, comparison.outlier_m)
    rows = [row | failures for row, failures in zip(comparison.rows(), causes.fractions(signals.truth), strict=True)]
    if noise is not None:
        rows = [row | sigmas for row, sigmas in zip(rows, noise.by_material(signals.truth), strict=True)]
    with timed(times, "points"):
        cloud = image.to_point_cloud()
    points, segmentation = int(cloud.valid.sum()), None
    if points >= MIN_POINTS:
        with timed(times, "segmentation"):
            segmentation = segmented(cloud)
    return Measurement(
        name=instrument.name,
        capture=capture,
        image=image,
        truth=signals.truth,
        causes=causes,
        rows=complete_rows(rows),
        segmentation=segmentation,
        metadata=acquisition(capture, photons, instrument.timing, moves, points, times),
        light_pass=light_pass,
    )


def _in_time(instrument: Instrument) -> PhotoDetector | None:
    """The instrument's detector, whose automatic exposure ends before the next one begins."""
    period_s = instrument.timing.frame_period_s
    detector = instrument.detector_in_use
    if detector is None or not period_s:
        return detector
    longest_s = max(detector.min_exposure_s, min(detector.max_exposure_s, period_s))
    return replace(detector, max_exposure_s=longest_s)  # type: ignore[type-var]


def segmented(cloud: PointCloud) -> Segmentation:
    """Supervoxels, objects and the tree of an organised cloud in camera coordinates."""
    import pcgraph

    result = pcgraph.segment(cloud.points, colors=cloud.colors, viewpoint=(0.0, 0.0, 0.0))
    return Segmentation(result.supervoxels, result.labels, result.tree.parents, result.tree.altitudes)


def noise_seed(experiment: Experiment, instrument: Instrument) -> int:
    """Seed of an instrument's noise: its own for each position in the experiment."""
    return derived_seed(experiment.seed, experiment.instruments.index(instrument))


def acquisition(
    capture: Capture, photons: np.ndarray | None, timing: Timing, moves: bool, points: int, times_s: dict[str, float]
) -> MeasurementRecord:
    """Frames, time and photons of a capture; exposure None for a noise-free one, which takes no time.

    Exposures follow each other at once, or, where something moves, as the timing says.

    Parameters
    ----------
    photons : (h, w) float64, photons per laser pulse; None where they are not known.
    """
    exposure = capture.exposure_s if np.isfinite(capture.exposure_s) else None
    camera = capture.frames.shape[1:]
    shots = len(timing.exposure_times_s(capture.sensor))
    taken = None
    if exposure is not None:
        pause = max(exposure, timing.frame_period_s) if moves else exposure
        lines = camera[0] if timing.lines == "rows" else camera[1]
        taken = (shots - 1) * pause + exposure + (lines - 1) * (timing.line_period_s if moves else 0.0)
    return MeasurementRecord(
        sensor=capture.sensor.type_name,
        frames=len(capture.frames),
        exposure_s=exposure,
        acquisition_s=taken,
        pixels=int(capture.frames[0].size),
        points=points,
        photons_per_pulse=_photons_record(photons) if photons is not None else None,
        times_s=times_s,
    )


def _photons_record(photons: np.ndarray) -> PhotonsRecord:
    return PhotonsRecord(median=float(np.median(photons)), largest=float(photons.max()))


def _unwatched(stage: str, fraction: float) -> None:
    """Tell nobody how far the work is."""


@contextmanager
def timed(times: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds that the block takes to `times[stage]`."""
    start = time.monotonic()
    yield
    times[stage] = times.get(stage, 0.0) + time.monotonic() - start


def _trace(
    experiment: Experiment,
    scene: Scene,
    rig: Rig,
    instruments: list[Instrument],
    progress: Callable[[float], None] | None,
) -> Signals:
    """The light of a pass; `progress` is called with the fraction of it that is done."""
    from rangesim.instrument.transport import transport

    settings = experiment.transport_settings(instruments)
    if experiment.motion is None:
        return transport(scene, rig, [i.sensor for i in instruments], settings, progress=progress)
    (instrument,) = instruments
    timings = {instrument.sensor: instrument.timing}
    return transport_moving(scene, rig, timings, experiment.motion, settings, progress=progress)[instrument.sensor]


def _fraction(number: int, passes: int, of_pass: float) -> float:
    return 0.05 + 0.9 * (number - 1 + _TRANSPORT_FRACTION * of_pass) / passes
