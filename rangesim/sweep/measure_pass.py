# SPDX-License-Identifier: Apache-2.0
"""The item of a sweep's campaign: one light-transport pass with all its measurements, from plain data to bytes.

The bytes are JSON: rows of statistics for each capture, counts of right and wrong readings by confidence, and small
pictures. They depend on the item alone, so they hold no times.
"""

from __future__ import annotations

import base64
import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rangesim.capture.exposure import exposed
from rangesim.causes.rules import causes_of
from rangesim.decoding import decode
from rangesim.electronics.ambient import Ambient
from rangesim.errors import RangesimWarning
from rangesim.evaluation.closed_forms import error_by_theory
from rangesim.evaluation.comparison import compare
from rangesim.evaluation.object_segmentation import Outcome
from rangesim.evaluation.range_noise import robust_sigma, sampling_errors
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.evaluation.surface_rows import with_mean_over_objects
from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import TrueSegmentations, acquisition, objects_of, segmented
from rangesim.pipeline.shared_passes import rig_of_pass
from rangesim.report import figures, palette
from rangesim.report.panorama import panorama
from rangesim.robust_scale import sigma_from_median
from rangesim.settings.config import from_dict
from rangesim.signals import SignalSet, StillSignals
from rangesim.sweep.image_windows import coarse, windowed
from rangesim.sweep.scene_sources import scene_of_dict
from rangesim.sweep.sweep_settings import instrument_given, with_settings

if TYPE_CHECKING:
    from rangesim.capture import Captured
    from rangesim.causes import CauseMap
    from rangesim.decoding.range_image import RangeImage
    from rangesim.evaluation.comparison import Comparison
    from rangesim.rig import Rig
    from rangesim.signals import GroundTruth

OUTLIER_SIGMAS = 6.0
"""Standard deviations from the median, robust ones and those of theory, beyond which a reading does not belong to the
noise: a wrong match, a wrong wrap. Of a normal distribution, 2e-9 lie beyond."""
CONFIDENCES = tuple(float(f"{10 ** (k / 16 - 4):.4g}") for k in range(65))
"""Edges of the classes of confidence in which readings are counted, from 1e-4 to 1: sixteen for each factor of ten, so
that a class is 15 % wide."""
PICTURE_PX = 96
"""Largest width of the small pictures; wider images are thinned to whole steps."""
PROBE_SPP = 8
"""Light paths of each pixel of a probe. Its bright pixels are averaged over a percentile, so few suffice."""


def item_bytes(item: Mapping[str, Any]) -> bytes:
    """Result of an item of a sweep (`rangesim.sweep.passes.Plan.items` or `probes`).

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        As `rangesim.transport` and what it measures with.
    """
    made = _probe(item) if item["kind"] == "probe" else _measured(item)
    return json.dumps(made, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


class _Pass:
    """The scene, the rigs and the instruments of an item."""

    def __init__(self, item: Mapping[str, Any]) -> None:
        folder = None if item["folder"] is None else Path(item["folder"])
        scene = scene_of_dict(item["scene"]).load()
        self.scene = replace(scene, working_distance_m=item["working_distance_m"])
        self.instruments = [
            with_settings(instrument_given(job["sensor"], "sensors", folder), job["settings"], folder)
            for job in item["jobs"]
        ]
        self.ambients = [
            None if job["ambient"] is None else from_dict(Ambient, job["ambient"], "ambient") for job in item["jobs"]
        ]
        self.transport = from_dict(Experiment, {"scene": "-", **item["transport"]})
        self.power_w = max(i.power_w for i in self.instruments)

    def rig(self) -> Rig:
        """Rig of all instruments, at the power of the pass."""
        one, settings = replace(self.instruments[0], power_w=self.power_w), self.transport
        return rig_of_pass(one, self.scene, settings.width, settings.height)

    def light_for(self, instrument: Instrument, signals: StillSignals | SignalSet) -> StillSignals | SignalSet:
        """Signals of the pass at the power and the wavelength of an instrument."""
        light = signals.at_power(instrument.power_w).at_wavelength(instrument.emitter_wavelength_m)
        assert isinstance(light, (StillSignals, SignalSet))
        return light

    def traced(self, rig: Rig, spp: int | None) -> StillSignals | SignalSet:
        """Signals of the pass with a rig.

        spp : light paths of each pixel; None: as the settings say. Adaptive sampling looks at one measurement of each
        sensor, the one with the most light, whose noise is least.
        """
        from rangesim.instrument.transport import transport

        brightest: dict[str, int] = {}
        for k, one in enumerate(self.instruments):
            other = self.instruments[brightest.setdefault(one.name, k)]
            if (one.power_w, one.exposure_s or 0) > (other.power_w, other.exposure_s or 0):
                brightest[one.name] = k
        chosen = [replace(self.instruments[k], power_w=self.power_w) for k in brightest.values()]
        dimmest = min(self.ambients, key=lambda ambient: 0.0 if ambient is None else ambient.scale)
        settings = replace(self.transport, ambient=dimmest, spp=spp or self.transport.spp).transport_settings(chosen)
        sensors = list(dict.fromkeys(one.sensor for one in self.instruments))
        rigs = self.instruments[0].sensor.rigs(rig)
        return transport(self.scene, rig if len(rigs) == 1 else rigs, sensors, settings)


def _probe(item: Mapping[str, Any]) -> dict[str, Any]:
    """The exposure, seconds, that automatic exposure chooses for each measurement of a pass; None for those that state
    one, or have none."""
    from rangesim.capture.exposure import auto_exposure_s, mean_radiance

    one = _Pass(item)
    rig = one.rig()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RangesimWarning)  # the pass itself will warn
        signals = one.traced(coarse(rig, one.instruments[0].sensor), PROBE_SPP)
    found: list[float | None] = []
    for instrument, ambient in zip(one.instruments, one.ambients, strict=True):
        detector = instrument.detector_in_use
        if instrument.exposure_s is not None or detector is None or instrument.sensor.is_ideal:
            found.append(None)
            continue
        lit = one.light_for(instrument, signals)
        radiance = mean_radiance(lit.cameras[0], instrument.sensor, detector, ambient)
        full = replace(rig, wavelength_m=instrument.emitter_wavelength_m)
        found.append(auto_exposure_s(radiance, instrument.sensor, detector, full))
    return {"exposures_s": found}


def _measured(item: Mapping[str, Any]) -> dict[str, Any]:
    """The results of all measurements of a pass."""
    one = _Pass(item)
    rig = windowed(one.rig(), one.instruments[0].sensor, item["window_px"])
    said: dict[str, None] = {}
    with _warnings_kept(said):
        signals = one.traced(rig, None)
    jobs = []
    for instrument, ambient, job in zip(one.instruments, one.ambients, item["jobs"], strict=True):
        with _warnings_kept(said, f"{instrument.name}: "):
            jobs.append(_measurements(instrument, one.light_for(instrument, signals), ambient, job["seeds"], item))
    return {"jobs": jobs, "warnings": list(said)}


@contextmanager
def _warnings_kept(said: dict[str, None], whose: str = "") -> Iterator[None]:
    """Add the texts of the package's warnings in the block to `said`, each once, with the words `whose` before them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RangesimWarning)
        yield
    said.update((f"{whose}{w.message}", None) for w in caught if issubclass(w.category, RangesimWarning))


def _measurements(
    instrument: Instrument,
    signals: StillSignals | SignalSet,
    ambient: Ambient | None,
    seeds: Sequence[int],
    item: Mapping[str, Any],
) -> dict[str, Any]:
    """Rows of all captures of one instrument, one list for each seed, and what they have in common."""
    truth, detector, tolerance_m = signals.truth, instrument.detector_in_use, item["tolerance_m"]
    rows, counts = [], np.zeros((2, len(CONFIDENCES) + 1), dtype=np.int64)
    common: dict[str, Any] = {}
    for seed in seeds:
        capture = exposed(signals, instrument.sensor, detector, instrument.exposure_s, seed, ambient).capture
        image = decode(capture, instrument.decoder)
        comparison = compare(image, truth, tolerance_m)
        if not common:
            common = _of_first(instrument, signals, capture, image, comparison, item["window_px"])
        theory_m = error_by_theory(signals, capture, image.decoder or instrument.sensor.default_decoder)
        exposure = {"exposure_s": _finite(capture.reference.exposure_s)}
        counts += _by_confidence(image, comparison.error_m, tolerance_m)
        errors = [
            {
                "kind": kind,
                "name": name,
                **_errors(comparison.error_m[mask], None if theory_m is None else theory_m[mask]),
            }
            for kind, name, mask in truth.surfaces()
        ]
        both = zip(comparison.rows(), with_mean_over_objects(errors), strict=True)
        rows.append([row | more | exposure for row, more in both])
    return {**common, "rows": rows, "confidence": counts.tolist()}


def _of_first(
    instrument: Instrument,
    signals: StillSignals | SignalSet,
    capture: Captured,
    image: RangeImage,
    comparison: Comparison,
    window_px: int | None,
) -> dict[str, Any]:
    """Findings from the first capture of an instrument: causes, noise of the renderer, pictures, frames.

    The causes of one capture are enough: they take as long as ten captures, and it has many pixels.
    """
    readings, truth = ReferenceReadings(image, capture, signals), signals.truth
    causes, sampling = causes_of(readings, comparison.tolerance_m), []
    if signals.knows_sampling_error:
        draw = sampling_errors(readings)
        known = [
            {"kind": kind, "name": name, "sampling_sigma_m": robust_sigma(draw[mask])}
            for kind, name, mask in truth.surfaces()
        ]
        sampling = [row["sampling_sigma_m"] for row in with_mean_over_objects(known)]
    frames = acquisition(capture.reference, None, instrument.timing, False, 0, {})
    return {
        "causes": [row["causes"] for row in causes.fractions(truth)],
        "sampling_sigma_m": sampling,
        "objects": _objects(image, comparison, signals),
        "pictures": _pictures(image, comparison.error_m, causes, truth, window_px),
        "frames": frames.frames,
        "acquisition_s": frames.acquisition_s,
    }


def _objects(image: RangeImage, comparison: Comparison, signals: StillSignals | SignalSet) -> dict[str, int] | None:
    """Numbers of the true objects that the segmentation of the first capture finds, merges, splits and misses, and of
    the objects that it invents; None for a scene without objects."""
    if not signals.truth.object_names:
        return None
    both = segmented(image.to_point_cloud()), TrueSegmentations().of(signals.rig.camera, signals.truth)
    found = objects_of(*both, image, comparison, signals.truth)
    counts = {outcome.value: len(found.names(outcome)) for outcome in Outcome}
    return {**counts, "displaced": sum(o.displaced for o in found.objects), "invented": found.invented}


def _errors(error_m: np.ndarray, theory_m: np.ndarray | None) -> dict[str, float | None]:
    """Root mean square error, metres, of the readings (n,) without outliers, and that of theory for the same ones.

    Errors of whole bins have two values, of which the rarer ones may lie beyond robust standard deviations. So an
    error that theory expects is no outlier.
    """
    known = np.isfinite(error_m)
    errors = error_m[known].astype(np.float64)
    if not len(errors):
        return {"error_m": None, "theory_m": None}
    theory = np.full(errors.shape, np.nan) if theory_m is None else theory_m[known]
    middle = float(np.median(errors))
    scale = np.fmax(max(sigma_from_median(errors, middle), 1e-9), theory)
    kept = np.abs(errors - middle) <= OUTLIER_SIGMAS * scale
    return {"error_m": _rms(errors[kept]), "theory_m": _finite(_rms(theory[kept]))}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _by_confidence(image: RangeImage, error_m: np.ndarray, tolerance_m: float) -> np.ndarray:
    """(2, classes) int64, numbers of right and of wrong readings in each class of confidence."""
    read = np.isfinite(error_m)
    at = np.searchsorted(CONFIDENCES, image.confidence[read], side="right")
    is_right = np.abs(error_m[read]) <= tolerance_m
    return np.array([np.bincount(at[part], minlength=len(CONFIDENCES) + 1) for part in (is_right, ~is_right)])


def _pictures(
    image: RangeImage, error_m: np.ndarray, causes: CauseMap, truth: GroundTruth, window_px: int | None
) -> dict[str, str]:
    """PNG files, base64, of the errors and of the causes, no wider than `PICTURE_PX`.

    Of whole rows that a window has kept for a sensor that matches texture, they show the middle.
    """
    assert image.camera is not None
    layout = panorama(image.camera)
    outcome = np.where(np.isfinite(truth.z), causes.cause, palette.NOTHING).astype(np.uint8)
    error = layout.picture(palette.error_fraction(error_m), np.nan)
    cause = layout.picture(outcome, palette.NOTHING)
    if window_px is not None and image.camera.is_pinhole:
        left = max(0, (error.shape[1] - window_px) // 2)
        error, cause = (picture[:, left : left + window_px] for picture in (error, cause))
    step = math.ceil(error.shape[1] / PICTURE_PX)
    thin = (slice(step // 2, None, step),) * 2
    indices, colors = figures.indexed(error[thin], palette.color_table("RdBu_r"))
    return {
        "error": base64.b64encode(figures.png_bytes(indices, colors)).decode("ascii"),
        "causes": base64.b64encode(figures.png_bytes(cause[thin], palette.OUTCOME_COLORS)).decode("ascii"),
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
