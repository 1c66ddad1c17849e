# SPDX-License-Identifier: Apache-2.0
"""Results of an experiment as a directory, and back.

DIR/manifest.json        size and SHA-256 of every file below; see `pcgraph.output`
    experiment.json      resolved settings, versions, and which instruments share which pass
    pass_1.npz           energy split and ground truth of each transport pass
    comparison.md        statistics of all instruments
    report.html
    NAME/capture/        of each instrument: frames and sidecar
         range.npz       range image
         causes.npz      cause of every failed pixel
         cloud.ply       points, metres, camera frame
         comparison.json, measurement.json, segmentation.npz
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from pcgraph.output import DirectoryKind, recover
from rangesim.capture import Capture
from rangesim.capture_files import load_capture
from rangesim.causes import CauseMap
from rangesim.errors import FileFormatError
from rangesim.experiment import Experiment, experiment_from_dict
from rangesim.range_image import RangeImage
from rangesim.schema import read_sidecar
from rangesim.signals import EnergySplit, GroundTruth

SETTINGS = "experiment.json"
FORMAT = "rangesim-result"
RESULT = DirectoryKind(FORMAT, SETTINGS, FileFormatError)
"""Directories that hold the results of an experiment."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Supervoxels of a point cloud and the tree that merges them.

    supervoxels, labels : (h, w) int32, supervoxel and object per pixel, -1 without a point.
    parents : (k,) int32, parent of each tree node, the supervoxels first; a root is its own parent.
    altitudes : (k,) float64, not decreasing towards the root.
    """

    supervoxels: np.ndarray
    labels: np.ndarray
    parents: np.ndarray
    altitudes: np.ndarray


@dataclass(frozen=True, eq=False)
class Measurement:
    """What one instrument measured.

    capture : Capture. image : RangeImage. truth : GroundTruth of its pass.
    causes : CauseMap, why pixels failed.
    rows : statistics per material class, "all" last; see `rangesim.comparison.ErrorStatistics` and
        `rangesim.causes.CauseMap.shares`.
    segmentation : Segmentation, or None if there were no points to group.
    facts : frames, exposure and time per stage; see `rangesim.pipeline`.
    light_pass : int from 1, the transport pass the instrument took part in.
    """

    name: str
    capture: Capture
    image: RangeImage
    truth: GroundTruth
    causes: CauseMap
    rows: list[dict[str, Any]]
    segmentation: Segmentation | None
    facts: dict[str, Any]
    light_pass: int


@dataclass(frozen=True, eq=False)
class Result:
    """An experiment and its outcome. energy : one EnergySplit per pass. info : scene, versions, times."""

    experiment: Experiment
    measurements: tuple[Measurement, ...]
    energy: tuple[EnergySplit, ...]
    info: dict[str, Any]


def save_range_image(image: RangeImage, path: Path) -> None:
    """Write the arrays of a range image to a compressed .npz file; its camera is in the capture's sidecar."""
    arrays = {f.name: getattr(image, f.name) for f in fields(image) if isinstance(getattr(image, f.name), np.ndarray)}
    np.savez_compressed(path, **arrays)


def save_causes(causes: CauseMap, path: Path) -> None:
    """Write a cause map to a compressed .npz file: `cause`, values of `rangesim.causes.Cause`, and `tolerance_m`."""
    np.savez_compressed(path, cause=causes.cause, tolerance_m=causes.tolerance_m)


def load_result(directory: str | Path) -> Result:
    """The result that `rangesim.pipeline.run` wrote.

    Raises
    ------
    FileFormatError
        The directory is no result, or a part of it is missing or broken.
    """
    folder = Path(directory)
    info = read_settings(folder)
    try:
        experiment = experiment_from_dict(info["experiment"])
        passes = [_load_pass(folder / f"pass_{i + 1}.npz") for i in range(info["passes"])]
        measurements = tuple(
            _load_measurement(folder / entry["name"], passes[entry["pass"] - 1][1], entry["pass"])
            for entry in info["instruments"]
        )
    except (OSError, KeyError, ValueError, IndexError) as error:
        raise FileFormatError(f"{folder} is no complete result of rangesim: {error}.") from error
    return Result(experiment, measurements, tuple(energy for energy, _ in passes), info)


def read_settings(folder: Path) -> dict[str, Any]:
    """Contents of `experiment.json`; FileFormatError if there is none of ours."""
    recover(folder, FileFormatError)
    return read_sidecar(folder / SETTINGS, FORMAT)


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Statistics per material class of one instrument, from its `comparison.json`."""
    return list(json.loads((folder / "comparison.json").read_text(encoding="utf-8"))["rows"])


def _load_pass(path: Path) -> tuple[EnergySplit, GroundTruth]:
    with np.load(path) as data:
        energy = EnergySplit(**{f.name: data[f"energy_{f.name}"] for f in fields(EnergySplit)})
        truth = {f.name: data[f"truth_{f.name}"] for f in fields(GroundTruth)}
    for name in ("instance_names", "material_names"):
        truth[name] = tuple(map(str, truth[name]))
    return energy, GroundTruth(**truth)


def _load_measurement(folder: Path, truth: GroundTruth, light_pass: int) -> Measurement:
    capture = load_capture(folder / "capture")
    with np.load(folder / "range.npz") as data:
        arrays = {name: data[name] for name in data.files}
    rig = capture.rig
    arrays["T_world_camera"] = rig.T_world_camera if rig else None
    image = RangeImage(**arrays, camera=rig.camera if rig else None)
    with np.load(folder / "causes.npz") as data:
        causes = CauseMap(data["cause"], float(data["tolerance_m"]))
    segmentation = None
    if (folder / "segmentation.npz").is_file():
        with np.load(folder / "segmentation.npz") as data:
            segmentation = Segmentation(**{f.name: data[f.name] for f in fields(Segmentation)})
    facts = json.loads((folder / "measurement.json").read_text(encoding="utf-8"))
    return Measurement(folder.name, capture, image, truth, causes, read_rows(folder), segmentation, facts, light_pass)
