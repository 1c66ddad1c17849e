# SPDX-License-Identifier: Apache-2.0
"""Results of experiments as directories: `write_result` writes them, `load_result` reads them.

DIR/manifest.json        size and SHA-256 of every file below; see `rangesim.files.result_directories`
    experiment.json      resolved settings, versions, and which instruments share which pass
    pass_1.npz           energy split and ground truth of each transport pass
    comparison.md        statistics of all instruments
    report.html
    NAME/capture/        of each instrument: frames and sidecar
         range.npz       range image
         causes.npz      cause of every failed pixel
         cloud.ply       points, metres, camera coordinates
         comparison.json, measurement.json, segmentation.npz
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from pcgraph.parallel import side_by_side
from rangesim.capture import Capture
from rangesim.causes import Cause, CauseMap
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import FileFormatError
from rangesim.experiment import Experiment, experiment_from_dict
from rangesim.files.array_files import write_arrays
from rangesim.files.result_directories import DirectoryKind, recover
from rangesim.files.schema import (
    ArraySpec,
    Count,
    Fraction,
    Metres,
    Name,
    Photons,
    Positive,
    Record,
    Seconds,
    read_checked_arrays,
    read_record,
    write_record,
)
from rangesim.results.capture_files import load_capture, write_capture
from rangesim.results.range_image_files import load_range_image, save_range_image
from rangesim.results.signals_files import LightPass, read_pass, write_pass
from rangesim.rig import Rig
from rangesim.settings.config import ShortRepr, from_dict, shown
from rangesim.signals import ALL, GroundTruth

SETTINGS = "experiment.json"
"""Name of the file with the settings, the scene and the versions of a result."""
FORMAT = "rangesim-result"
"""Name of the format in that file."""
RESULT = DirectoryKind(FORMAT, SETTINGS, FileFormatError)
"""Directories that hold the results of an experiment."""


# ---- What the files hold -------------------------------------------------------------------------------------------


class ShapeRecord(Record, frozen=True, kw_only=True):
    """A shape of the scene."""

    name: str
    material: Name


class SceneRecord(Record, frozen=True, kw_only=True):
    """The scene that was measured. sha256 : checksum of its file; None if it was not loaded from a file."""

    name: str
    sha256: str | None
    working_distance_m: Positive
    shapes: list[ShapeRecord]


class InstrumentRecord(Record, frozen=True, kw_only=True, rename={"light_pass": "pass"}):
    """An instrument, the number (from 1) of the pass that it took part in, and its rig as plain data."""

    name: Name
    light_pass: Count
    rig: dict[str, Any]


class ResultRecord(Record, frozen=True, kw_only=True):
    """Content of `experiment.json`."""

    format: Literal["rangesim-result"] = "rangesim-result"
    format_version: Literal[1] = 1
    experiment: dict[str, Any]
    scene: SceneRecord
    passes: Count
    instruments: list[InstrumentRecord]
    versions: dict[str, str]
    variant: str
    times_s: dict[str, Seconds]


class PhotonsRecord(Record, frozen=True, kw_only=True):
    """Mean number of photons that a pixel detects per laser pulse: the median of all pixels, and the largest.

    From about 1 on, pile-up matters: the first photon of a pulse hides the later ones.
    """

    median: Photons
    largest: Photons


class MeasurementRecord(Record, frozen=True, kw_only=True):
    """Content of `measurement.json`: frames, exposure and time per stage of an instrument.

    exposure_s : seconds per frame; None for a noise-free capture.
    acquisition_s : seconds of all exposures; None for a noise-free capture.
    photons_per_pulse : None if the detector does not count photons.
    times_s : seconds of computing, by stage.
    """

    format: Literal["rangesim-measurement"] = "rangesim-measurement"
    format_version: Literal[1] = 1
    sensor: Name
    frames: Count
    exposure_s: Positive | None
    acquisition_s: Seconds | None
    pixels: Count
    points: Count
    photons_per_pulse: PhotonsRecord | None = None
    times_s: dict[str, Seconds]


class RowRecord(Record, frozen=True, kw_only=True):
    """Statistics of one material class; None where a value is not defined or not known.

    The values are explained in `rangesim.evaluation.comparison.ErrorStatistics`, `rangesim.causes.CauseMap.fractions`
    and `rangesim.evaluation.range_noise.RangeNoise.by_material`.
    """

    material: Name
    pixels: Count
    lit: Count
    completeness: Fraction | None
    coverage: Fraction | None
    bias_m: Metres | None
    median_abs_m: Metres | None
    rmse_m: Metres | None
    p95_abs_m: Metres | None
    outlier_rate: Fraction | None
    edge_pixels: Count
    flying_rate: Fraction | None
    failed: Fraction | None
    causes: dict[str, Fraction]
    detector_sigma_m: Metres | None = None
    sampling_sigma_m: Metres | None = None
    completeness_error: Fraction | None = None


class ComparisonRecord(Record, frozen=True, kw_only=True):
    """Content of `comparison.json`: a row per material class, "all" last; outlier_m : metres, limit of outliers."""

    format: Literal["rangesim-comparison"] = "rangesim-comparison"
    format_version: Literal[1] = 1
    outlier_m: Positive
    rows: list[RowRecord]


_CAUSES = {"cause": ArraySpec("uint8", high=max(Cause)), "tolerance_m": ArraySpec("float64", (), low=1e-9, high=1e9)}
"""Arrays of `causes.npz`, with their types and limits."""
_SEGMENTATION = {
    "supervoxels": ArraySpec("int32", low=-1),
    "labels": ArraySpec("int32", low=-2),
    "parents": ArraySpec("int32", ("nodes",), low=0, per_pixel=2),
    "altitudes": ArraySpec("float64", ("nodes",), low=0, inf=True, per_pixel=2),
}
"""Arrays of `segmentation.npz`, with their types and limits."""


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation(ShortRepr):
    """Supervoxels of a point cloud and the tree that merges them.

    supervoxels : (h, w) int32, index of each pixel's supervoxel; -1 without a point.
    labels : (h, w) int32, index of each pixel's object; -1 without a point, -2 for outliers.
    parents : (k,) int32, parent of each node of the tree, the supervoxels first; the root is its own parent.
    altitudes : (k,) float64, radians, mean concavity of each merge; it does not decrease towards the root.
    """

    supervoxels: np.ndarray
    labels: np.ndarray
    parents: np.ndarray
    altitudes: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(ShortRepr):
    """The measurement of one instrument of an experiment.

    name : name of the instrument.
    capture : Capture.
    image : RangeImage, decoded from the capture.
    truth : GroundTruth of the pass that the instrument took part in.
    causes : CauseMap, causes of the failed pixels.
    rows : statistics per material class, "all" last, with the keys of `RowRecord`.
    segmentation : Segmentation of the point cloud; None if there were too few points to group.
    metadata : MeasurementRecord, frames, exposure, photons per pulse and time per stage.
    light_pass : int from 1, number of the transport pass that the instrument took part in.
    """

    name: str
    capture: Capture
    image: RangeImage
    truth: GroundTruth
    causes: CauseMap
    rows: list[dict[str, Any]]
    segmentation: Segmentation | None
    metadata: MeasurementRecord
    light_pass: int


@dataclass(frozen=True, eq=False, repr=False)
class Result(ShortRepr):
    """An experiment and its outcome; `rangesim.pipeline.experiment_run.carry_out` returns it.

    experiment : Experiment, the settings.
    measurements : one Measurement for each instrument, in the order of the experiment.
    passes : one LightPass for each transport pass.
    info : ResultRecord, scene, versions and times.
    """

    experiment: Experiment
    measurements: tuple[Measurement, ...]
    passes: tuple[LightPass, ...]
    info: ResultRecord


def complete_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Statistics per material class with all keys of `RowRecord`; a value that is not known is None."""
    return [msgspec.to_builtins(RowRecord(**row)) for row in rows]


# ---- Writing -------------------------------------------------------------------------------------------------------


def write_result(result: Result, folder: Path, pages: Mapping[str, bytes]) -> None:
    """Write the files of a result to an empty directory.

    Parameters
    ----------
    folder : empty directory; the caller makes it appear when it is complete.
    pages : contents of files that people read, such as `report.html`, by name.
    """
    for number, light_pass in enumerate(result.passes, 1):
        write_pass(light_pass, folder / f"pass_{number}.npz")
    for measurement in result.measurements:
        place = folder / measurement.name
        (place / "capture").mkdir(parents=True)
        side_by_side(
            partial(write_capture, measurement.capture, place / "capture"), partial(_write_readings, measurement, place)
        )
    write_record(folder / SETTINGS, result.info)
    for name, content in pages.items():
        (folder / name).write_bytes(content)


def _write_readings(measurement: Measurement, folder: Path) -> None:
    """Write the files of a measurement besides its capture."""
    causes, rows = measurement.causes, [RowRecord(**row) for row in measurement.rows]
    save_range_image(measurement.image, folder / "range.npz")
    write_arrays(folder / "causes.npz", {"cause": causes.cause, "tolerance_m": np.asarray(causes.tolerance_m)})
    write_record(folder / "comparison.json", ComparisonRecord(outlier_m=causes.tolerance_m, rows=rows))
    write_record(folder / "measurement.json", measurement.metadata)
    if measurement.segmentation is not None:
        measurement.image.to_point_cloud().save(folder / "cloud.ply")
        write_arrays(folder / "segmentation.npz", vars(measurement.segmentation))


# ---- Reading -------------------------------------------------------------------------------------------------------


def load_result(directory: str | Path) -> Result:
    """The result that `rangesim.pipeline.experiment_run.run` wrote to a directory.

    Raises
    ------
    FileFormatError
        The directory is no result, or a part of it is missing or broken; the message names the file.

    Examples
    --------
    >>> from rangesim.results.run_files import load_result
    >>> result = load_result("out/demo")  # doctest: +SKIP
    >>> result.measurements[0].image.z  # doctest: +SKIP
    """
    folder = Path(directory)
    info = read_settings(folder)
    try:
        experiment = experiment_from_dict(info.experiment)
    except ValueError as error:
        raise FileFormatError(f"{folder / SETTINGS}: {error}") from error
    names = [i.name for i in experiment.instruments]
    if [entry.name for entry in info.instruments] != names:
        raise FileFormatError(f"{folder / SETTINGS}: expected the instruments {shown(names)} as in its experiment.")
    if {entry.light_pass for entry in info.instruments} != set(range(1, info.passes + 1)):
        raise FileFormatError(f"{folder / SETTINGS}: expected each of {info.passes} passes to serve an instrument.")
    if missing := [f"transport_{n}" for n in range(1, info.passes + 1) if f"transport_{n}" not in info.times_s]:
        raise FileFormatError(f"{folder / SETTINGS}: expected the time {missing[0]} in times_s.")
    sizes = _image_sizes(info, folder / SETTINGS)
    passes = [read_pass(folder / f"pass_{n}.npz", sizes[n]) for n in range(1, info.passes + 1)]
    measurements = tuple(
        _load_measurement(
            folder / entry.name, passes[entry.light_pass - 1].truth, entry.light_pass, sizes[entry.light_pass]
        )
        for entry in info.instruments
    )
    return Result(experiment, measurements, tuple(passes), info)


def read_settings(folder: Path) -> ResultRecord:
    """Content of the `experiment.json` of a result.

    Raises
    ------
    FileFormatError
        The directory is no result, or the file is broken.
    """
    recover(folder, FileFormatError)
    if not (folder / SETTINGS).is_file():
        raise FileFormatError(f"{folder} is no {FORMAT} directory: it has no {SETTINGS}.")
    return read_record(folder / SETTINGS, ResultRecord)


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Statistics per material class of one instrument, from the `comparison.json` in its folder.

    Raises
    ------
    FileFormatError
        The file is missing or broken.
    """
    path = folder / "comparison.json"
    record = read_record(path, ComparisonRecord)
    materials = [row.material for row in record.rows]
    if materials.count(ALL) != 1 or len(set(materials)) < len(materials):
        raise FileFormatError(f"{path}: expected one row per material, and one {ALL!r}, got {shown(materials)}.")
    valid = {c.name.lower() for c in Cause if c}
    for row in record.rows:
        if unknown := set(row.causes) - valid:
            raise FileFormatError(f"{path}: unknown cause {shown(min(unknown))} of {shown(row.material)}.")
        if abs(sum(row.causes.values()) - (row.failed or 0)) > 1e-6:
            raise FileFormatError(f"{path}: expected the causes of {shown(row.material)} to add up to what failed.")
    return [msgspec.to_builtins(row) for row in record.rows]


def _image_sizes(info: ResultRecord, path: Path) -> dict[int, dict[str, int]]:
    """Height "h" and width "w" of the camera of each pass, in pixels, by the number of the pass."""
    sizes: dict[int, dict[str, int]] = {}
    for entry in info.instruments:
        try:
            camera = from_dict(Rig, entry.rig, f"rig of {entry.name}").camera
        except ValueError as error:
            raise FileFormatError(f"{path}: {error}") from error
        size = {"h": camera.height, "w": camera.width}
        if sizes.setdefault(entry.light_pass, size) != size:
            raise FileFormatError(
                f"{path}: expected one size of the cameras of pass {entry.light_pass}, got another of {entry.name}."
            )
    return sizes


def _load_measurement(folder: Path, truth: GroundTruth, light_pass: int, sizes: dict[str, int]) -> Measurement:
    """Measurement in a folder; sizes : height "h" and width "w" of the images of its pass."""
    capture = load_capture(folder / "capture")
    if capture.rig is None or capture.frames.shape[1:] != (sizes["h"], sizes["w"]):
        raise FileFormatError(f"{folder / 'capture'}: expected a rig, and frames of the size of the ground truth.")
    image = load_range_image(folder / "range.npz", sizes)
    if image.camera != capture.rig.camera:
        raise FileFormatError(f"{folder / 'range.npz'}: expected the camera of the capture.")
    data = read_checked_arrays(folder / "causes.npz", _CAUSES, sizes)
    metadata = read_record(folder / "measurement.json", MeasurementRecord)
    if (metadata.sensor, metadata.frames, metadata.pixels) != (
        capture.sensor.type_name, len(capture.frames), capture.frames[0].size
    ):  # fmt: skip
        raise FileFormatError(f"{folder / 'measurement.json'}: expected sensor, frames and pixels of the capture.")
    return Measurement(
        name=folder.name,
        capture=capture,
        image=replace(image, T_world_camera=capture.rig.T_world_camera),
        truth=truth,
        causes=CauseMap(data["cause"], float(data["tolerance_m"])),
        rows=read_rows(folder),
        segmentation=_load_segmentation(folder / "segmentation.npz", sizes),
        metadata=metadata,
        light_pass=light_pass,
    )


def _load_segmentation(path: Path, sizes: dict[str, int]) -> Segmentation | None:
    """Segmentation in a file; None if there is no file."""
    if not path.is_file():
        return None
    data = read_checked_arrays(path, _SEGMENTATION, dict(sizes))
    parents, altitudes = data["parents"], data["altitudes"]
    nodes, leaves = len(parents), (len(parents) + 1) // 2
    children = np.bincount(parents[: nodes - 1], minlength=nodes) if nodes and parents.max() < nodes else np.zeros(1)
    is_tree = (
        nodes % 2 == 1
        and len(children) == nodes
        and bool((parents[:-1] > np.arange(nodes - 1)).all())
        and parents[-1] == nodes - 1
        and not children[:leaves].any()
        and bool((children[leaves:] == 2).all())
        and bool((altitudes[parents] >= altitudes).all())
    )
    if not is_tree:
        raise FileFormatError(f"{path}: expected parents and altitudes of a binary tree, its leaves first.")
    for name in ("supervoxels", "labels"):
        if data[name].max(initial=-1) >= leaves:
            raise FileFormatError(f"{path}: array {name}: expected indices below the number of leaves, {leaves}.")
    if not np.bincount(data["supervoxels"][data["supervoxels"] >= 0], minlength=leaves).all():
        raise FileFormatError(f"{path}: array supervoxels: expected a pixel in each of {leaves} leaves.")
    return Segmentation(**data)
