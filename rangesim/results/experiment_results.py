# SPDX-License-Identifier: Apache-2.0
"""Writes and reads the result of an experiment: the directory that `rangesim run` writes.

DIR/manifest.json        size and SHA-256 of every file below; see `rangesim.files.atomic_directories`
    experiment.json      resolved settings, versions, and the pass that each instrument shares
    pass_1.npz           energy split and ground truth of each light-transport pass
    comparison.md        statistics of all instruments
    report.html          report for people
    NAME/capture/        frames and settings of the capture of the instrument NAME
         range.npz       range image
         causes.npz      cause of every failed pixel
         cloud.ply       points, metres, camera coordinates
         comparison.json statistics per object and material class
         measurement.json exposure and times
         segmentation.npz supervoxels, labels and tree
         objects.json    what the segmentation makes of each object
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from pcgraph.parallel import side_by_side
from rangesim.capture import Captured
from rangesim.causes import Cause, CauseMap
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import FileFormatError
from rangesim.evaluation.object_segmentation import ObjectOutcome, ObjectSegmentation, Outcome
from rangesim.evaluation.surface_rows import OBJECT, OBJECTS, index_of_row
from rangesim.experiment import Experiment, experiment_from_dict
from rangesim.files.array_files import write_arrays
from rangesim.files.atomic_directories import DirectoryKind, sidecar_of
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
from rangesim.results.captures import load_capture, write_capture
from rangesim.results.range_images import load_range_image, save_range_image
from rangesim.results.saved_signals import LightPass, read_pass, write_pass
from rangesim.rig import Camera, Rig
from rangesim.settings.config import ShortRepr, from_dict, shown
from rangesim.signals import ALL, GroundTruth

SETTINGS = "experiment.json"
"""File of a result with its settings."""
FORMAT = "rangesim-result"
"""Name of the format in the file."""
RESULT = DirectoryKind(FORMAT, SETTINGS, FileFormatError)
"""Directories that hold the results of an experiment."""


# ---- What the files hold -------------------------------------------------------------------------------------------


class ShapeRecord(Record, frozen=True, kw_only=True):
    """A shape of the scene and its material class.

    object : name of the object that it is a part of, empty for background; None in results that do not tell.
    """

    name: str
    material: Name
    object: str | None = None


class SceneRecord(Record, frozen=True, kw_only=True):
    """The scene that was measured.

    sha256 : checksum of its file; None if the scene was not loaded from a file.
    working_distance_m : distance from the camera to the point that it looks at, metres.
    """

    name: str
    sha256: str | None
    working_distance_m: Positive
    shapes: list[ShapeRecord]


class InstrumentRecord(Record, frozen=True, kw_only=True, rename={"light_pass": "pass"}):
    """An instrument, the number of its light-transport pass (counted from 1), and its rig."""

    name: Name
    light_pass: Count
    rig: dict[str, Any]


class ResultRecord(Record, frozen=True, kw_only=True):
    """The contents of `experiment.json`: settings, scene, rigs, versions and times."""

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
    """Mean number of photons that a pixel detects per laser pulse: the median and the maximum over the pixels.

    From about one photon per pulse on, pile-up hides the later photons of a pulse.
    """

    median: Photons
    largest: Photons


class MeasurementRecord(Record, frozen=True, kw_only=True):
    """The contents of `measurement.json`.

    exposure_s : exposure of each frame, seconds; None for a noise-free capture.
    exposure_is_automatic : whether it was chosen for the light of this scene, so that at another distance it is another
        one.
    acquisition_s : time from the start of the first exposure to the end of the last, seconds; of a scanner, that of its
        last ray.
    points : number of pixels with a reading.
    photons_per_pulse : None where no photons are counted.
    times_s : seconds that each stage of the computation took.
    """

    format: Literal["rangesim-measurement"] = "rangesim-measurement"
    format_version: Literal[1] = 1
    sensor: Name
    frames: Count
    exposure_s: Positive | None
    exposure_is_automatic: bool
    acquisition_s: Seconds | None
    pixels: Count
    points: Count
    photons_per_pulse: PhotonsRecord | None = None
    times_s: dict[str, Seconds]


class RowRecord(Record, frozen=True, kw_only=True):
    """Statistics of one surface.

    `rangesim.evaluation.comparison.ErrorStatistics`, `rangesim.causes.CauseMap.fractions` and
    `rangesim.evaluation.range_noise.RangeNoise.by_surface` explain them. None: not known.
    """

    kind: Literal["objects", "object", "part", "material", "all"]
    name: str
    pixels: Count
    lit: Count
    right: Fraction | None
    wrong: Fraction | None
    missing: Fraction | None
    completeness: Fraction | None
    bias_m: Metres | None
    median_abs_m: Metres | None
    rmse_m: Metres | None
    p95_abs_m: Metres | None
    edge_pixels: Count
    flying_rate: Fraction | None
    causes: dict[str, Fraction]
    detector_sigma_m: Metres | None = None
    sampling_sigma_m: Metres | None = None
    completeness_error: Fraction | None = None
    invented_readings: Count | None = None


class ComparisonRecord(Record, frozen=True, kw_only=True):
    """The contents of `comparison.json`: a row for each object and material class, the last one for "all".

    tolerance_m : largest error of a right reading, metres.
    """

    format: Literal["rangesim-comparison"] = "rangesim-comparison"
    format_version: Literal[2] = 2
    tolerance_m: Positive
    rows: list[RowRecord]

    def plain_rows(self) -> list[dict[str, Any]]:
        """The rows as dicts."""
        return [msgspec.to_builtins(row) for row in self.rows]


class ObjectRecord(Record, frozen=True, kw_only=True):
    """Record of an object in the segmentation; `rangesim.evaluation.object_segmentation.ObjectOutcome` explains it."""

    name: str
    pixels: Count
    covering: Fraction
    overlap: Fraction
    outcome: Outcome
    displaced: bool
    merged_with: list[str]
    separable: bool


class ObjectsRecord(Record, frozen=True, kw_only=True):
    """The contents of `objects.json`.

    invented : number of segments that could pass for an object and are none.
    panoptic_quality : of the objects; None if there are neither objects nor invented ones.
    """

    format: Literal["rangesim-objects"] = "rangesim-objects"
    format_version: Literal[1] = 1
    objects: list[ObjectRecord]
    invented: Count
    panoptic_quality: Fraction | None


_CAUSES = {"cause": ArraySpec("uint8", high=max(Cause)), "tolerance_m": ArraySpec("float64", (), low=1e-9, high=1e9)}
"""Type, shape and bounds of the arrays of `causes.npz`; the tolerance is in metres."""
_SEGMENTATION = {
    "supervoxels": ArraySpec("int32", low=-1),
    "labels": ArraySpec("int32", low=-1),
    "parents": ArraySpec("int32", ("nodes",), low=0, per_pixel=2),
    "altitudes": ArraySpec("float64", ("nodes",), low=0, inf=True, per_pixel=2),
}
"""Type, shape and bounds of the arrays of `segmentation.npz`. A binary tree has fewer than two nodes per pixel."""


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation(ShortRepr):
    """Supervoxels of an organised point cloud, its objects, and the tree that merges the supervoxels.

    supervoxels : (h, w) int32, number of the supervoxel of each pixel; -1 where there is no point.
    labels : (h, w) int32, number of the object of each pixel; -1 where there is no point, and for outliers.
    parents : (k,) int32, parent of each node of the tree. The supervoxels come first; the root is its own parent.
    altitudes : (k,) float64, altitude at which the children of each node merge; it never decreases towards the root.
    """

    supervoxels: np.ndarray
    labels: np.ndarray
    parents: np.ndarray
    altitudes: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(ShortRepr):
    """The measurement of one instrument.

    name : name of the instrument.
    capture : Capture, or CaptureSet of several cameras.
    image : RangeImage.
    truth : GroundTruth of the instrument's pass.
    causes : CauseMap, the cause of each failed pixel.
    rows : statistics with the keys of `RowRecord`, in this order: mean over objects, objects, parts, material classes,
        "all". `row` finds one by its name.
    segmentation : Segmentation; None if there were too few points.
    objects : ObjectSegmentation, what the segmentation makes of each object; None in results that do not tell.
    metadata : MeasurementRecord, frames, exposure, photons per pulse and time per stage.
    light_pass : number of the light-transport pass, counted from 1.
    """

    name: str
    capture: Captured
    image: RangeImage
    truth: GroundTruth
    causes: CauseMap
    rows: list[dict[str, Any]]
    segmentation: Segmentation | None
    objects: ObjectSegmentation | None
    metadata: MeasurementRecord
    light_pass: int

    def row(self, name: str, kind: str | None = None) -> dict[str, Any]:
        """The row of this name, as `rangesim.evaluation.comparison.Comparison.row` finds it; raises its errors."""
        return self.rows[index_of_row([(row["kind"], row["name"]) for row in self.rows], name, kind)]

    @property
    def camera(self) -> Camera:
        """The camera of the instrument."""
        assert self.image.camera is not None  # every measurement of an experiment has its rig
        return self.image.camera

    @property
    def true_m(self) -> np.ndarray:
        """(h, w) float32, metres, true readings: z for a pinhole camera, ranges for every other one."""
        return self.camera.reading(self.truth)


@dataclass(frozen=True, eq=False, repr=False)
class Result(ShortRepr):
    """The result of an experiment.

    experiment : Experiment, as it was carried out.
    measurements : one Measurement for each instrument, in the order of the experiment.
    passes : one LightPass for each light-transport pass.
    info : ResultRecord, with scene, versions and times.

    Examples
    --------
    >>> result = load_result("out/tabletop")  # doctest: +SKIP
    >>> {m.name: m.row("objects")["right"] for m in result.measurements}  # doctest: +SKIP
    """

    experiment: Experiment
    measurements: tuple[Measurement, ...]
    passes: tuple[LightPass, ...]
    info: ResultRecord


def complete_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows with all keys of `RowRecord`; a value is None where it is not known."""
    return [msgspec.to_builtins(RowRecord(**row)) for row in rows]


# ---- Writing -------------------------------------------------------------------------------------------------------


def write_result(result: Result, folder: Path, pages: Mapping[str, bytes]) -> None:
    """Write the files of a result to an empty directory.

    This function does not protect the files while they are incomplete; `rangesim.pipeline.experiment_run.run` does.

    Parameters
    ----------
    pages : contents of the files for people, such as `report.html`, by their names.
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
    """Write all files of a measurement except its capture."""
    causes, rows = measurement.causes, [RowRecord(**row) for row in measurement.rows]
    save_range_image(measurement.image, folder / "range.npz")
    write_arrays(folder / "causes.npz", {"cause": causes.cause, "tolerance_m": np.asarray(causes.tolerance_m)})
    write_record(folder / "comparison.json", ComparisonRecord(tolerance_m=causes.tolerance_m, rows=rows))
    write_record(folder / "measurement.json", measurement.metadata)
    if measurement.objects is not None:
        write_record(folder / "objects.json", objects_record(measurement.objects))
    if measurement.segmentation is not None:
        measurement.image.to_point_cloud().save(folder / "cloud.ply")
        write_arrays(folder / "segmentation.npz", vars(measurement.segmentation))


def objects_record(objects: ObjectSegmentation) -> ObjectsRecord:
    """The contents of `objects.json`."""
    quality = objects.panoptic_quality
    return ObjectsRecord(
        objects=msgspec.convert(msgspec.to_builtins(objects.objects), list[ObjectRecord]),
        invented=objects.invented,
        panoptic_quality=None if math.isnan(quality) else quality,
    )


# ---- Reading -------------------------------------------------------------------------------------------------------


def load_result(directory: str | Path) -> Result:
    """The result that `rangesim.pipeline.experiment_run.run` wrote.

    Raises
    ------
    FileFormatError
        The directory holds no result, or a file is missing or broken. The message names the file.
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
    """The contents of `experiment.json` in the directory of a result; FileFormatError if it holds no result."""
    return read_record(sidecar_of(folder, RESULT), ResultRecord)


def read_comparison(folder: Path) -> ComparisonRecord:
    """The contents of `comparison.json` in the directory of an instrument; FileFormatError if the file is broken."""
    path = folder / "comparison.json"
    record = read_record(path, ComparisonRecord)
    keys = [(row.kind, row.name) for row in record.rows]
    kinds: list[str] = [kind for kind, _ in keys]
    if kinds.count(ALL) != 1 or kinds.count(OBJECTS) != (OBJECT in kinds) or len(set(keys)) < len(keys):
        raise FileFormatError(
            f"{path}: expected one row per object and material, one {ALL!r}, and {OBJECTS!r} if there are objects, "
            f"got {shown([name for _, name in keys])}."
        )
    valid = {c.name.lower() for c in Cause if c}
    for row in record.rows:
        if unknown := set(row.causes) - valid:
            raise FileFormatError(f"{path}: unknown cause {shown(min(unknown))} of {shown(row.name)}.")
        failed = (row.wrong or 0) + (row.missing or 0)
        if row.right is not None and abs(row.right + failed - 1) > 1e-6:
            raise FileFormatError(f"{path}: expected right, wrong and missing of {shown(row.name)} to add up to 1.")
        if abs(sum(row.causes.values()) - failed) > 1e-6:
            raise FileFormatError(
                f"{path}: expected the causes of {shown(row.name)} to add up to what is wrong or missing."
            )
    return record


def read_acquisition(folder: Path) -> MeasurementRecord:
    """The contents of `measurement.json` in the directory of an instrument; FileFormatError if the file is broken."""
    return read_record(folder / "measurement.json", MeasurementRecord)


def _image_sizes(info: ResultRecord, path: Path) -> dict[int, dict[str, int]]:
    """Height "h" and width "w" of the camera of each pass in pixels, by the number of the pass."""
    sizes: dict[int, dict[str, int]] = {}
    for entry in info.instruments:
        try:
            camera = from_dict(Rig, entry.rig, f"rig of {entry.name}").camera
        except ValueError as error:
            raise FileFormatError(f"{path}: {error}") from error
        size = {"h": camera.height, "w": camera.width}
        if sizes.setdefault(entry.light_pass, size) != size:
            raise FileFormatError(
                f"{path}: expected cameras of one size in pass {entry.light_pass}, got another size for {entry.name}."
            )
    return sizes


def _load_measurement(folder: Path, truth: GroundTruth, light_pass: int, sizes: dict[str, int]) -> Measurement:
    """The measurement in the directory of an instrument, checked against its pass."""
    captured = load_capture(folder / "capture")
    capture = captured.reference
    if capture.rig is None or capture.frames.shape[1:] != (sizes["h"], sizes["w"]):
        raise FileFormatError(f"{folder / 'capture'}: expected a rig, and frames of the size of the ground truth.")
    image = load_range_image(folder / "range.npz", sizes)
    if image.camera != capture.rig.camera:
        raise FileFormatError(f"{folder / 'range.npz'}: expected the camera of the capture.")
    data = read_checked_arrays(folder / "causes.npz", _CAUSES, sizes)
    metadata = read_acquisition(folder)
    if (metadata.sensor, metadata.frames, metadata.pixels) != (
        capture.sensor.type_name, len(capture.frames), capture.frames[0].size
    ):  # fmt: skip
        raise FileFormatError(f"{folder / 'measurement.json'}: expected sensor, frames and pixels of the capture.")
    return Measurement(
        name=folder.name,
        capture=captured,
        image=replace(image, T_world_camera=capture.rig.T_world_camera),
        truth=truth,
        causes=CauseMap(data["cause"], float(data["tolerance_m"])),
        rows=read_comparison(folder).plain_rows(),
        segmentation=_load_segmentation(folder / "segmentation.npz", sizes),
        objects=_load_objects(folder / "objects.json"),
        metadata=metadata,
        light_pass=light_pass,
    )


def _load_objects(path: Path) -> ObjectSegmentation | None:
    """The objects in the segmentation, read from a file; None if there is no such file."""
    if not path.is_file():
        return None
    record = read_record(path, ObjectsRecord)
    objects = msgspec.convert(msgspec.to_builtins(record.objects), tuple[ObjectOutcome, ...])
    return ObjectSegmentation(objects, record.invented)


def _load_segmentation(path: Path, sizes: dict[str, int]) -> Segmentation | None:
    """The segmentation of a file, checked to be a binary tree; None if there is no such file."""
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
