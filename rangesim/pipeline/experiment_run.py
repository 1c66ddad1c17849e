# SPDX-License-Identifier: Apache-2.0
"""Carries out an experiment, from the scene to the comparison with the ground truth.

`carry_out` computes the result and writes nothing. `run` computes it and writes its directory. Each instrument passes
through the stages of `measure`: capture, range image, noise, comparison, causes, points, segmentation, objects.
"""

from __future__ import annotations

from collections.abc import Callable
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
from rangesim.errors import warn
from rangesim.evaluation.comparison import Comparison, compare
from rangesim.evaluation.object_segmentation import ObjectSegmentation, object_segmentation
from rangesim.evaluation.range_noise import noise_of, warn_of_sampling
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.experiment import Experiment
from rangesim.files.atomic_directories import new_directory
from rangesim.instrument.instrument import Instrument
from rangesim.motion import transport_moving
from rangesim.pipeline.cost import Cost, estimate_cost
from rangesim.pipeline.provenance import provenance
from rangesim.pipeline.shared_passes import group_by_rig
from rangesim.pipeline.stages import Progress, timed, unwatched
from rangesim.results.experiment_results import (
    RESULT,
    Measurement,
    MeasurementRecord,
    PhotonsRecord,
    Result,
    Segmentation,
    complete_rows,
    write_result,
)
from rangesim.results.saved_signals import LightPass
from rangesim.rig import Beam
from rangesim.settings.seeds import derived_seed

if TYPE_CHECKING:
    from rangesim.decoding.range_image import RangeImage
    from rangesim.electronics.detector import PhotoDetector
    from rangesim.motion import Timing
    from rangesim.point_cloud import PointCloud
    from rangesim.rig import Camera, Rig
    from rangesim.scene import Scene
    from rangesim.signals import GroundTruth, Signals

_TRANSPORT_FRACTION = 0.7
"""Fraction of a pass that the progress bar shows as done when its light is traced; the rest is for its instruments. It
changes the progress bar and nothing else."""
MIN_POINTS = 3
"""Smallest number of points that are segmented. Fewer points make no surface, because a plane needs three."""


def run(
    experiment: Experiment,
    out: str | Path,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
) -> Result:
    """Carry out an experiment and write its results, with `report.html`, to the directory `out`.

    The files appear when all of them are complete, and a failure leaves nothing behind. An older result in the
    directory is replaced. Other files in it stay. See `rangesim.files.atomic_directories`.

    Parameters
    ----------
    experiment, progress, scene, announce : as for `carry_out`.
    out : directory of the results.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `carry_out`, or `out` cannot take a result (see `rangesim.files.atomic_directories.check_directory`).

    Warns
    -----
    RangesimWarning, SamplingWarning
        As `carry_out`.

    Examples
    --------
    >>> from rangesim.experiment import Experiment
    >>> result = run(Experiment("tabletop", width=320, height=240), "out/tabletop")  # doctest: +SKIP
    """
    from rangesim.report import render_report
    from rangesim.report.tables import comparison_markdown

    with new_directory(out, RESULT, inputs=[experiment.scene]) as folder:
        result = _computed(experiment, progress or unwatched, scene, announce)
        if progress:
            progress("Writing the report", 0.97)
        found, taken = [(m.name, m.rows) for m in result.measurements], [m.metadata for m in result.measurements]
        tables = comparison_markdown(found, taken, experiment.tolerance_m)
        write_result(result, folder, {"comparison.md": tables.encode(), "report.html": render_report(result).encode()})
    _warn(result)
    return result


def carry_out(
    experiment: Experiment,
    progress: Progress | None = None,
    scene: Scene | None = None,
    announce: Callable[[Cost], None] | None = None,
    sampling_error: bool = True,
    true_segmentations: TrueSegmentations | None = None,
) -> Result:
    """The result of an experiment. Nothing is written.

    Experiment and result can be pickled, so this function can run in another process or on another machine.

    Parameters
    ----------
    progress : function that is called with the name of the stage and the fraction done, 0..1.
    scene : a scene that is already loaded, for example from a dictionary. `experiment.scene` is then only its name.
    announce : function that is called with the estimated cost before the work starts.
    sampling_error : whether the noise of the readings is split into that of the detector and that of the renderer, and
        the renderer's is warned of. This decodes five more captures of each instrument, which takes a third of the time
        of a small image. Readings are the same without it.
    true_segmentations : where the segmentations of the true depths are kept for the caller; None: nowhere.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        A setting is out of its range, the memory does not suffice, the scene cannot be loaded, or there is no suitable
        LLVM.

    Warns
    -----
    RangesimWarning
        Surfaces lie outside the range of a sensor (`rangesim.causes.range_limits`).
    SamplingWarning
        The sampling error is not small (`rangesim.evaluation.range_noise.warn_of_sampling`).

    Examples
    --------
    >>> from rangesim.experiment import Experiment
    >>> result = carry_out(Experiment("matte", width=160, height=120))  # doctest: +SKIP
    >>> result.measurements[0].image.valid.mean()  # fraction of pixels with a reading  # doctest: +SKIP
    """
    result = _computed(experiment, progress or unwatched, scene, announce, sampling_error, true_segmentations)
    _warn(result)
    return result


def estimate(experiment: Experiment) -> Cost:
    """Estimated cost of `run` in light paths, memory and time.

    The scene is loaded. If the run may take long, small images of it are rendered to measure the time.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `carry_out`, except that too little memory raises nothing; `Cost.check_memory` does.
    """
    from rangesim.scene import load_scene

    scene = load_scene(experiment.scene, material=experiment.material, unit_m=experiment.unit_m)
    return estimate_cost(experiment, scene, group_by_rig(experiment, scene))


def _computed(
    experiment: Experiment,
    tell: Progress,
    scene: Scene | None,
    announce: Callable[[Cost], None] | None,
    sampling_error: bool = True,
    true_segmentations: TrueSegmentations | None = None,
) -> Result:
    """The result of an experiment, without the warnings of `carry_out`.

    `run` issues the warnings after the files are written, so that a warning raised as an error loses no result.
    """
    import mitsuba as mi

    from pcgraph.all_kernels import compile_kernels
    from rangesim.light_transport.kernel_launches import report_part
    from rangesim.scene import load_scene

    times: dict[str, float] = {}
    tell("Loading the scene", 0.0)
    with timed(times, "load"):
        scene = scene or load_scene(experiment.scene, material=experiment.material, unit_m=experiment.unit_m)
        if experiment.objects is not None:
            scene = scene.with_objects(experiment.objects)
    if experiment.ambient is not None:
        experiment.ambient.check_emitters(scene.has_ambient)
    groups = group_by_rig(experiment, scene)
    cost = estimate_cost(experiment, scene, groups, trial=announce is not None)
    cost.check_memory()
    if announce is not None:
        announce(cost)
    with timed(times, "compile_segmentation"):  # kernels compile once per machine; no sensor's time includes it
        compile_kernels()
    passes, measurements, of_truth = [], {}, true_segmentations or TrueSegmentations()
    for number, (rig, instruments) in enumerate(groups, 1):
        stage = f"Tracing light, pass {number} of {len(groups)} ({', '.join(i.name for i in instruments)})"
        begin, end = (_fraction(number, len(groups), of_pass) for of_pass in (0.0, 1.0))
        tell(stage, begin)
        told = None if tell is unwatched else partial(report_part, partial(tell, stage), begin, end - begin)
        with timed(times, f"transport_{number}"):
            signals = _trace(experiment, scene, rig, instruments, told)
        passes.append(LightPass.of(signals))
        with timed(times, f"segmentation_of_truth_{number}"):
            true_segmentation = of_truth.of(signals.rig.camera, signals.truth)
        for instrument in instruments:
            tell(f"Measuring with {instrument.name}", end)
            light = signals.at_wavelength(instrument.emitter_wavelength_m)
            measurements[instrument.name] = measure(
                experiment, instrument, light, true_segmentation, number, sampling_error
            )
    info = provenance(experiment, scene, groups, mi.variant(), times)
    return Result(experiment, tuple(measurements[i.name] for i in experiment.instruments), tuple(passes), info)


def _warn(result: Result) -> None:
    """Warn of surfaces outside a sensor's range, of readings whose sampling error is not small, and of a size that is
    not used."""
    sized = result.experiment.width is not None or result.experiment.height is not None
    instruments = result.experiment.instruments
    if sized and all(one.camera is not None for one in instruments):
        names = ", ".join(one.name for one in instruments)
        warn(f"width and height of the experiment do not apply: {names} have a camera of their own.")
    beyond = []
    for m in result.measurements:
        rig = m.capture.reference.rig
        assert rig is not None
        beyond.append((m.name, *fraction_beyond_range(m.capture.sensor, rig, m.truth)))
    warn_of_range(beyond)
    experiment = result.experiment
    warn_of_sampling({m.name: m.rows for m in result.measurements}, experiment.spp or experiment.max_spp)


def measure(
    experiment: Experiment,
    instrument: Instrument,
    signals: Signals,
    true_segmentation: Segmentation | None,
    light_pass: int = 1,
    sampling_error: bool = True,
) -> Measurement:
    """The measurement of one instrument, with its capture, range image, errors, causes and segmentation.

    Parameters
    ----------
    instrument : one of the experiment.
    signals : Signals of the light-transport pass that the instrument shares.
    true_segmentation : Segmentation of the true depth, see `TrueSegmentations`.
    light_pass : number of the pass, counted from 1.
    sampling_error : as for `carry_out`.
    """
    seed, ambient, tolerance_m = noise_seed(experiment, instrument), experiment.ambient, experiment.tolerance_m
    times: dict[str, float] = {}
    moves = signals.motion_m is not None
    with timed(times, "exposure"):
        detector = _detector_within_frame_period(instrument) if moves else instrument.detector_in_use
        exposure = exposed(signals, instrument.sensor, detector, instrument.exposure_s, seed, ambient)
    capture, photons = exposure.capture, exposure.photons_per_pulse()
    if instrument.exposure_s is None:
        exposure.warn_of_overexposure(instrument.name)
    with timed(times, "decode"):
        image = decode(capture, instrument.decoder)
    noise, readings = None, ReferenceReadings(image, capture, signals, exposure.radiance)
    if sampling_error and signals.knows_sampling_error:
        with timed(times, "noise"):
            noise = noise_of(readings)
        image = replace(image, sampling_sigma_m=np.abs(noise.sampling))
    comparison = compare(image, signals.truth, tolerance_m)
    with timed(times, "causes"):
        causes = causes_of(readings, tolerance_m)
    del readings, exposure  # frees the radiance, which is as large as the frames
    rows = [row | failures for row, failures in zip(comparison.rows(), causes.fractions(signals.truth), strict=True)]
    if noise is not None:
        rows = [row | sigmas for row, sigmas in zip(rows, noise.by_surface(signals.truth), strict=True)]
    with timed(times, "points"):
        cloud = image.to_point_cloud()
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
        objects=objects_of(segmentation, true_segmentation, image, comparison, signals.truth),
        metadata=acquisition(capture.reference, photons, instrument.timing, moves, int(cloud.valid.sum()), times),
        light_pass=light_pass,
    )


def _detector_within_frame_period(instrument: Instrument) -> PhotoDetector | None:
    """The instrument's detector, with its automatic exposure limited to the time between two frames."""
    period_s = instrument.timing.frame_period_s
    detector = instrument.detector_in_use
    if detector is None or not period_s:
        return detector
    longest_s = max(detector.min_exposure_s, min(detector.max_exposure_s, period_s))
    return replace(detector, max_exposure_s=longest_s)  # type: ignore[type-var]


def segmented(cloud: PointCloud) -> Segmentation | None:
    """Supervoxels, objects and the tree of an organised cloud in camera coordinates; None below `MIN_POINTS`."""
    import pcgraph

    if cloud.valid.sum() < MIN_POINTS:
        return None
    result = pcgraph.segment(cloud.points, colors=cloud.colors, viewpoint=(0.0, 0.0, 0.0))
    return Segmentation(result.supervoxels, result.labels, result.tree.parents, result.tree.altitudes)


class TrueSegmentations:
    """The segmentations of clouds of true depths, each computed when it is first asked for.

    Passes of different emitters often share a view. Who hands an object of this class to `carry_out` can ask it for
    the segmentations afterwards.
    """

    def __init__(self) -> None:
        self._of_cloud: dict[bytes, Segmentation | None] = {}

    def of(self, camera: Camera, truth: GroundTruth) -> Segmentation | None:
        """The cloud of the true depth, segmented as a sensor's cloud is; None below `MIN_POINTS`."""
        from rangesim.point_cloud import PointCloud

        points = camera.points(truth).astype(np.float32)
        key = points.tobytes()
        if key not in self._of_cloud:
            self._of_cloud[key] = segmented(PointCloud(points))
        return self._of_cloud[key]


def objects_of(
    segmentation: Segmentation | None,
    true_segmentation: Segmentation | None,
    image: RangeImage,
    comparison: Comparison,
    truth: GroundTruth,
) -> ObjectSegmentation:
    """Outcomes of the true objects in the segmentation of a range image.

    comparison : Comparison of the range image with the truth.
    """
    both = segmentation, true_segmentation
    labels, true_labels = (np.full(truth.z.shape, -1, dtype=np.int32) if s is None else s.labels for s in both)
    wrong = image.valid & ~(np.abs(comparison.error_m) <= comparison.tolerance_m)
    return object_segmentation(labels, truth, wrong, true_labels)


def noise_seed(experiment: Experiment, instrument: Instrument) -> int:
    """Seed of an instrument's noise. It depends on the position of the instrument in the experiment."""
    return derived_seed(experiment.seed, experiment.instruments.index(instrument))


def acquisition(
    capture: Capture, photons: np.ndarray | None, timing: Timing, moves: bool, points: int, times_s: dict[str, float]
) -> MeasurementRecord:
    """The record of a capture: its frames, exposure, acquisition time and photons.

    A noise-free capture has no exposure and takes no time. The rays of a scanner are exposed one after the other, so
    its acquisition lasts as long as its turn. A beam that goes over the pixels of a pinhole has no times, so how long
    its acquisition takes is not known.

    Parameters
    ----------
    photons : (h, w) float64, photons per laser pulse; None: not known.
    timing : when the exposures begin, if something moves. Otherwise each begins when the one before it ends.
    moves : whether something moves.
    points : number of points of the cloud.
    times_s : seconds that each stage took.
    """
    exposure = capture.exposure_s if np.isfinite(capture.exposure_s) else None
    camera = capture.frames.shape[1:]
    shots = len(timing.exposure_times_s(capture.sensor))
    taken = None
    if exposure is not None and not _scans_untimed(capture):
        pause = max(exposure, timing.frame_period_s) if moves else exposure
        lines = camera[0] if timing.lines == "rows" else camera[1]
        taken = (shots - 1) * pause + exposure + (lines - 1) * (timing.line_period_s if moves else 0.0)
        taken += _scan_s(capture)
    return MeasurementRecord(
        sensor=capture.sensor.type_name,
        frames=len(capture.frames),
        exposure_s=exposure,
        exposure_is_automatic=capture.exposure_is_automatic,
        acquisition_s=taken,
        pixels=int(capture.frames[0].size),
        points=points,
        photons_per_pulse=_photons_record(photons) if photons is not None else None,
        times_s=times_s,
    )


def _scan_s(capture: Capture) -> float:
    """Seconds from the first ray of a scanner to its last one; 0 for a camera that measures all pixels at once."""
    times_s = capture.rig.camera.times_s if capture.rig is not None else None
    return float(np.ptp(times_s)) if times_s is not None else 0.0


def _scans_untimed(capture: Capture) -> bool:
    """Whether a beam lights the pixels of a pinhole one after the other, at times that nobody states."""
    return capture.rig is not None and isinstance(capture.rig.projector, Beam) and capture.rig.camera.is_pinhole


def _photons_record(photons: np.ndarray) -> PhotonsRecord:
    return PhotonsRecord(median=float(np.median(photons)), largest=float(photons.max()))


def _trace(
    experiment: Experiment,
    scene: Scene,
    rig: Rig,
    instruments: list[Instrument],
    progress: Callable[[float], None] | None,
) -> Signals:
    """Signals of a pass. `progress` is called with the fraction of the pass that is done, 0..1."""
    from rangesim.instrument.transport import transport

    settings = experiment.transport_settings(instruments)
    if experiment.motion is None:
        rigs, sensors = instruments[0].sensor.rigs(rig), [i.sensor for i in instruments]
        return transport(scene, rig if len(rigs) == 1 else rigs, sensors, settings, progress=progress)
    (instrument,) = instruments
    timings = {instrument.sensor: instrument.timing}
    return transport_moving(scene, rig, timings, experiment.motion, settings, progress=progress)[instrument.sensor]


def _fraction(number: int, passes: int, of_pass: float) -> float:
    """Fraction of the whole work done, when the fraction `of_pass` of tracing pass `number` (from 1) is done."""
    return 0.05 + 0.9 * (number - 1 + _TRANSPORT_FRACTION * of_pass) / passes
