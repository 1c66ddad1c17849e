# SPDX-License-Identifier: Apache-2.0
"""The whole experiment: scene -> transport -> capture -> range image -> points -> comparison, segments, report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import rangesim
from rangesim.capture import Capture
from rangesim.capture.capture_files import write_capture
from rangesim.capture.exposure import photons_per_pulse, warn_of_overexposure
from rangesim.causes import explain
from rangesim.causes.range_limits import fraction_beyond_range, warn_of_range
from rangesim.evaluation.range_noise import range_noise, warn_of_sampling
from rangesim.experiment import Experiment
from rangesim.experiment.cost import Cost, estimate_cost
from rangesim.experiment.instrument import Instrument
from rangesim.experiment.provenance import provenance
from rangesim.experiment.result_files import (
    RESULT,
    SETTINGS,
    MeasurementRecord,
    PhotonsRecord,
    load_result,
    save_causes,
    save_rows,
)
from rangesim.files.array_files import write_arrays
from rangesim.files.result_directories import new_directory
from rangesim.files.schema import write_record
from rangesim.motion import transport_moving
from rangesim.settings.seeds import derived_seed
from rangesim.signals.signals_files import write_pass

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
) -> None:
    """Carry out an experiment and write its results, with `report.html`, to the directory `out`.

    The files appear when all is done; a failure leaves nothing behind. An older result of that name is replaced; files
    that somebody else put there stay. See `rangesim.files.result_directories`.

    Parameters
    ----------
    scene : a scene that is loaded already, for example from a dictionary; `experiment.scene` then only names it.
    announce : called with the estimated cost before the work starts.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        A setting out of range, more memory than there is, a scene that cannot be loaded, no suitable LLVM, or an `out`
        that cannot take a result (see `rangesim.files.result_directories.check_directory`).

    Warns
    -----
    RangesimWarning
        Surfaces outside the range of a sensor (`rangesim.causes.range_limits`).
    SamplingWarning
        See `warn_of_sampling`.
    """
    import mitsuba as mi

    from pcgraph.all_kernels import compile_kernels
    from rangesim.light_transport.kernel_launches import report_part
    from rangesim.report import write_report

    tell = progress or _unwatched
    with new_directory(out, RESULT, inputs=[experiment.scene]) as folder:
        times: dict[str, float] = {}
        beyond: list[tuple[str, float, float]] = []
        tell("Loading the scene", 0.0)
        with timed(times, "load"):
            scene = scene or rangesim.load_scene(
                experiment.scene, material=experiment.material, unit_m=experiment.unit_m
            )
        if experiment.ambient is not None:
            experiment.ambient.check_emitters(scene.has_ambient)
        passes = group_by_rig(experiment, scene)
        cost = estimate_cost(experiment, scene, passes, trial=announce is not None)
        cost.check_memory()
        if announce is not None:
            announce(cost)
        with timed(times, "compile_segmentation"):  # once per machine; not to be charged to the first sensor
            compile_kernels()
        for number, (rig, instruments) in enumerate(passes, 1):
            stage = f"Tracing light, pass {number} of {len(passes)} ({', '.join(i.name for i in instruments)})"
            begin, end = (_fraction(number, len(passes), of_pass) for of_pass in (0.0, 1.0))
            tell(stage, begin)
            told = progress and partial(report_part, partial(tell, stage), begin, end - begin)
            with timed(times, f"transport_{number}"):
                signals = _trace(experiment, scene, rig, instruments, told)
            write_pass(signals, folder / f"pass_{number}.npz")
            for instrument in instruments:
                beyond.append((instrument.name, *fraction_beyond_range(instrument.sensor, signals.rig, signals.truth)))
                tell(f"Measuring with {instrument.name}", _fraction(number, len(passes), 1.0))
                seed = noise_seed(experiment, instrument)
                measure(instrument, signals, folder / instrument.name, seed, experiment.ambient)
        write_record(folder / SETTINGS, provenance(experiment, scene, passes, mi.variant(), times))
        tell("Writing the report", 0.97)
        result = load_result(folder)
        tables = {m.name: m.rows for m in result.measurements}
        _write_comparison(folder, list(tables.items()))
        write_report(result, folder / "report.html")
    warn_of_range(beyond)
    warn_of_sampling(tables, experiment.spp or experiment.max_spp)


def estimate(experiment: Experiment) -> Cost:
    """Cost of `run`, in light paths, memory and time; the scene is loaded, and rendered small if it may take long.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `run`, but for the memory.
    """
    scene = rangesim.load_scene(experiment.scene, material=experiment.material, unit_m=experiment.unit_m)
    return estimate_cost(experiment, scene, group_by_rig(experiment, scene))


def measure(instrument: Instrument, signals: Signals, folder: Path, seed: int, ambient: Ambient | None = None) -> None:
    """Expose, decode, compare, explain and segment for one instrument; write all to the new directory `folder`."""
    from pcgraph.parallel import side_by_side

    folder.mkdir()
    times: dict[str, float] = {}
    moves = signals.motion_m is not None
    with timed(times, "exposure"):
        detector = _in_time(instrument) if moves else instrument.detector
        capture = rangesim.expose(signals, instrument.sensor, detector, instrument.exposure_s, seed, ambient)
    if instrument.exposure_s is None:
        warn_of_overexposure(instrument.name, capture, signals)
    with timed(times, "decode"):
        image = rangesim.decode(capture, instrument.decoder)
    noise = None
    if signals.knows_sampling_error:
        with timed(times, "noise"):
            noise = range_noise(image, capture, signals)
        image = replace(image, sampling_sigma_m=np.abs(noise.sampling))
    comparison = rangesim.compare(image, signals.truth)
    with timed(times, "causes"):
        causes = explain(image, capture, signals, tolerance_m=comparison.outlier_m)
    rows = [row | failures for row, failures in zip(comparison.rows(), causes.fractions(signals.truth), strict=True)]
    if noise is not None:
        rows = [row | sigmas for row, sigmas in zip(rows, noise.by_material(signals.truth), strict=True)]
    with timed(times, "points"):
        cloud = image.to_point_cloud()
    enough = bool(cloud.valid.sum() >= MIN_POINTS)

    def write_readings() -> None:
        image.save(folder / "range.npz")
        save_causes(causes, folder / "causes.npz")
        save_rows(comparison.outlier_m, rows, folder)
        if enough:
            cloud.save(folder / "cloud.ply")

    (folder / "capture").mkdir()
    side_by_side(partial(write_capture, capture, folder / "capture"), write_readings)
    if enough:
        with timed(times, "segmentation"):
            segment(cloud, folder / "segmentation.npz")
    metadata = acquisition(capture, signals, instrument.timing, int(cloud.valid.sum()), times)
    write_record(folder / "measurement.json", metadata)


def _in_time(instrument: Instrument) -> PhotoDetector | None:
    """The instrument's detector, whose automatic exposure ends before the next one begins."""
    period_s = instrument.timing.frame_period_s
    if instrument.detector is None or not period_s:
        return instrument.detector
    longest_s = max(instrument.detector.min_exposure_s, min(instrument.detector.max_exposure_s, period_s))
    return replace(instrument.detector, max_exposure_s=longest_s)  # type: ignore[type-var]


def segment(cloud: PointCloud, path: Path) -> None:
    """Write supervoxels, objects and the tree of an organised cloud in camera coordinates to a .npz file."""
    import pcgraph

    result = pcgraph.segment(cloud.points, colors=cloud.colors, viewpoint=(0.0, 0.0, 0.0))
    tree = result.tree
    arrays = {"supervoxels": result.supervoxels, "labels": result.labels}
    write_arrays(path, {**arrays, "parents": tree.parents, "altitudes": tree.altitudes})


def group_by_rig(experiment: Experiment, scene: Scene) -> list[tuple[Rig, list[Instrument]]]:
    """Instruments that share camera, emitter and power, and so one transport pass; in order of first appearance.

    Where something moves, each is on its own: it has its own time, and so its own truth.
    """
    if experiment.motion is not None:
        return [(i.rig(scene, experiment.width, experiment.height), [i]) for i in experiment.instruments]
    groups: dict[Rig, list[Instrument]] = {}
    for instrument in experiment.instruments:
        rig = instrument.rig(scene, experiment.width, experiment.height)
        groups.setdefault(rig, []).append(instrument)
    return list(groups.items())


def noise_seed(experiment: Experiment, instrument: Instrument) -> int:
    """Seed of an instrument's noise: its own for each position in the experiment."""
    return derived_seed(experiment.seed, experiment.instruments.index(instrument))


def acquisition(
    capture: Capture, signals: Signals, timing: Timing, points: int, times_s: dict[str, float]
) -> MeasurementRecord:
    """Frames, time and photons of a capture of signals; exposure None for a noise-free one, which takes no time.

    Exposures follow each other at once, or, where something moves, as the timing says.
    """
    exposure = capture.exposure_s if np.isfinite(capture.exposure_s) else None
    moves = signals.motion_m is not None
    photons = photons_per_pulse(signals, capture)
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
    settings = experiment.transport_settings(instruments)
    if experiment.motion is None:
        return rangesim.transport(scene, rig, [i.sensor for i in instruments], settings, progress=progress)
    (instrument,) = instruments
    timings = {instrument.sensor: instrument.timing}
    return transport_moving(scene, rig, timings, experiment.motion, settings, progress=progress)[instrument.sensor]


def _fraction(number: int, passes: int, of_pass: float) -> float:
    return 0.05 + 0.9 * (number - 1 + _TRANSPORT_FRACTION * of_pass) / passes


def _write_comparison(folder: Path, tables: list[tuple[str, list[dict[str, Any]]]]) -> None:
    from rangesim.report.tables import markdown

    (folder / "comparison.md").write_text(markdown(tables), encoding="utf-8")
