# SPDX-License-Identifier: Apache-2.0
"""Writes and reads the result of a scan: the directory that `rangesim scan` writes.

DIR/manifest.json        size and SHA-256 of every file below; see `rangesim.files.atomic_directories`
    scan.json            resolved settings, versions, statistics of the surface, the shapes and the views
    mesh.ply             the fused surface, metres, world coordinates
    poses.json           T_world_camera (n, 4, 4) of the views: the poses used for the fusion, and the true ones
    truth.npz            true surface of each shape, state of the voxels around them, weights of the mesh
    view_01/range.npz    range image of each view, with its pose
    report.html          report for people
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from rangesim.errors import FileFormatError
from rangesim.experiment.scan_settings import ScanSettings, scan_settings_from_dict, scan_settings_to_dict
from rangesim.files.array_files import write_arrays
from rangesim.files.atomic_directories import DirectoryKind, sidecar_of
from rangesim.files.schema import (
    MAX_METRES,
    ArraySpec,
    Count,
    Fraction,
    Metres,
    Name,
    Positive,
    Record,
    Seconds,
    read_checked_arrays,
    read_record,
    write_json,
    write_record,
)
from rangesim.files.text_files import read_json
from rangesim.fusion.mesh_error import SurfaceError
from rangesim.fusion.multiway_registration import PoseErrors, pose_errors
from rangesim.fusion.posed_images import Scan
from rangesim.fusion.seen_volume import Occupancy, SeenOfShape, VoxelState
from rangesim.fusion.truncated_average import FusedSurface
from rangesim.fusion.voxel_grid import VoxelGrid
from rangesim.results.range_images import load_range_image, save_range_image
from rangesim.settings.config import ShortRepr, from_dict, shown, to_dict
from rangesim.triangle_mesh import TriangleMesh

SIDECAR = "scan.json"
"""File of a scan with its settings."""
FORMAT = "rangesim-scan"
"""Name of the format in the file."""
SCAN = DirectoryKind(FORMAT, SIDECAR, FileFormatError)
"""Directories that hold the results of a scan."""


# ---- What the files hold -------------------------------------------------------------------------------------------


class SeenRecord(Record, frozen=True, kw_only=True):
    """The fields of `rangesim.fusion.seen_volume.SeenOfShape`; None where they are NaN, which JSON does not have."""

    surface: Fraction | None
    volume_surface: Fraction | None
    volume_never: Fraction | None
    volume_free: Fraction | None
    area_m2: Metres
    volume_m3: Metres


class ShapeStatistics(Record, frozen=True, kw_only=True):
    """A shape of the scene and the errors of the part of the mesh that is nearest to it.

    The errors are those of `rangesim.fusion.mesh_error.SurfaceError`. They are None if no part of the mesh is nearest
    to the shape. `seen` is None for background.
    """

    material: Name
    accuracy_m: Metres | None = None
    accuracy_rms_m: Metres | None = None
    accuracy_p95_m: Metres | None = None
    completeness_m: Metres | None = None
    chamfer_m: Metres | None = None
    precision: Fraction | None = None
    recall: Fraction | None = None
    f_score: Fraction | None = None
    threshold_m: Metres | None = None
    seen: SeenRecord | None = None

    @classmethod
    def of(cls, material: str, error: SurfaceError | None, seen: SeenOfShape | None) -> ShapeStatistics:
        """The statistics of a shape, made of its errors and of what the views saw of it."""
        names = [f.name for f in msgspec.structs.fields(cls) if f.name not in ("material", "seen")]
        errors = {} if error is None else {name: float(getattr(error, name)) for name in names}
        known = {} if seen is None else {key: _none_of_nan(value) for key, value in asdict(seen).items()}
        return cls(material=material, seen=msgspec.convert(known, SeenRecord) if known else None, **errors)


class ViewStatistics(Record, frozen=True, kw_only=True):
    """The number of readings of a view, and the errors of its pose.

    angle_error_deg, centre_error_m : errors of a pose that was found, degrees and metres; None if it was known.
    """

    readings: Count
    pixels: Count
    angle_error_deg: Metres | None = None
    centre_error_m: Metres | None = None


class ScanStatistics(Record, frozen=True, kw_only=True):
    """Statistics of the fused surface, of the shapes by name, and of the views.

    things : names of the shapes that are not background.
    """

    voxel_m: Positive
    truncation_m: Positive
    min_weight: Metres
    voxels: Count
    triangles: Count
    area_m2: Metres
    shapes: dict[str, ShapeStatistics]
    things: list[str]
    views: list[ViewStatistics]


class ScanRecord(Record, frozen=True, kw_only=True):
    """The contents of `scan.json`.

    grid : the voxel grid on which the seen and the true volume are compared.
    tolerance_m : largest distance from the surface at which a reading counts as lying on it, metres.
    """

    format: Literal["rangesim-scan"] = "rangesim-scan"
    format_version: Literal[1] = 1
    settings: dict[str, Any]
    statistics: ScanStatistics
    grid: dict[str, Any]
    tolerance_m: Positive
    versions: dict[str, str]
    variant: str
    times_s: dict[str, Seconds]


@dataclass(frozen=True, eq=False, repr=False)
class ScanResult(ShortRepr):
    """The result of a scan.

    Parameters
    ----------
    settings : ScanSettings, as they were resolved.
    scan : Scan, the views with the poses that were used for the fusion.
    fused : FusedSurface, the mesh.
    surfaces : true surface of each shape by name.
    shapes : statistics of each shape by name.
    things : names of the shapes that are not background.
    seen : Occupancy, the state of the voxels around the things, and the fractions of each thing that were seen.
    poses : errors of the poses that were found; None if they were known.
    versions : version of each package by name.
    variant : Mitsuba's variant, such as "llvm_ad_mono".
    times_s : seconds that each stage took.

    Examples
    --------
    >>> result = load_scan("out/scan")  # doctest: +SKIP
    >>> {name: result.shapes[name].accuracy_m for name in result.things}  # metres  # doctest: +SKIP
    """

    settings: ScanSettings
    scan: Scan
    fused: FusedSurface
    surfaces: dict[str, TriangleMesh]
    shapes: dict[str, ShapeStatistics]
    things: tuple[str, ...]
    seen: Occupancy
    poses: PoseErrors | None
    versions: dict[str, str]
    variant: str
    times_s: dict[str, float]

    def statistics(self) -> ScanStatistics:
        """The statistics that `scan.json` holds."""
        views = []
        for number, image in enumerate(self.scan.images):
            errors = {}
            if self.poses is not None:
                errors["angle_error_deg"] = float(self.poses.angle_deg[number])
                errors["centre_error_m"] = float(self.poses.centre_m[number])
            views.append(ViewStatistics(readings=int(image.valid.sum()), pixels=int(image.valid.size), **errors))
        return ScanStatistics(
            voxel_m=self.fused.voxel_m,
            truncation_m=self.fused.truncation_m,
            min_weight=self.fused.min_weight,
            voxels=self.fused.voxels,
            triangles=len(self.fused.mesh.faces),
            area_m2=self.fused.mesh.area_m2,
            shapes=self.shapes,
            things=list(self.things),
            views=views,
        )


_ARRAYS = {
    "vertices": ArraySpec("float64", ("vertices", 3), low=-MAX_METRES, high=MAX_METRES),
    "faces": ArraySpec("int32", ("faces", 3), low=0),
    "vertex_counts": ArraySpec("int64", ("shapes",), low=0),
    "face_counts": ArraySpec("int64", ("shapes",), low=0),
    "states": ArraySpec("uint8", ("nx", "ny", "nz"), high=max(VoxelState)),
    "filled": ArraySpec("int32", ("nx", "ny", "nz"), low=-1),
    "vertex_weights": ArraySpec("float32", ("mesh",), low=0),
}
"""Type, shape and bounds of the arrays of `truth.npz`; the vertices are in metres."""


# ---- Writing -------------------------------------------------------------------------------------------------------


def write_scan(result: ScanResult, folder: Path, pages: Mapping[str, bytes]) -> None:
    """Write the files of a scan to an empty directory.

    This function does not protect the files while they are incomplete; `rangesim.pipeline.scan_run.run_scan` does.

    Parameters
    ----------
    pages : contents of the files for people, such as `report.html`, by their names.
    """
    record = ScanRecord(
        settings=scan_settings_to_dict(result.settings),
        statistics=result.statistics(),
        grid=to_dict(result.seen.grid),
        tolerance_m=result.seen.tolerance_m,
        versions=result.versions,
        variant=result.variant,
        times_s=result.times_s,
    )
    write_record(folder / SIDECAR, record)
    true_poses = result.scan.true_poses
    poses = {"T_world_camera": result.scan.poses.tolist(), "true": None if true_poses is None else true_poses.tolist()}
    write_json(folder / "poses.json", {"unit": "metres, OpenCV axes", **poses})
    result.fused.mesh.save(folder / "mesh.ply")
    surfaces = result.surfaces.values()
    write_arrays(
        folder / "truth.npz",
        {
            "vertices": np.concatenate([mesh.vertices for mesh in surfaces]),
            "faces": np.concatenate([mesh.faces for mesh in surfaces]),
            "vertex_counts": np.array([len(mesh.vertices) for mesh in surfaces]),
            "face_counts": np.array([len(mesh.faces) for mesh in surfaces]),
            "states": result.seen.states,
            "filled": result.seen.truth,
            "vertex_weights": result.fused.vertex_weights,
        },
    )
    for number, image in enumerate(result.scan.images, 1):
        place = folder / f"view_{number:02d}"
        place.mkdir()
        save_range_image(image, place / "range.npz")
    for name, content in pages.items():
        (folder / name).write_bytes(content)


# ---- Reading -------------------------------------------------------------------------------------------------------


def load_scan(directory: str | Path) -> ScanResult:
    """The scan that `rangesim.pipeline.scan_run.run_scan` wrote, without the ground truth of each view.

    Raises
    ------
    FileFormatError
        The directory holds no scan, or a file is missing or broken. The message names the file.
    """
    folder = Path(directory)
    record = read_record(sidecar_of(folder, SCAN), ScanRecord)
    try:
        settings = scan_settings_from_dict(record.settings)
        grid = from_dict(VoxelGrid, record.grid, "grid")
    except ValueError as error:
        raise FileFormatError(f"{folder / SIDECAR}: {error}") from error
    statistics = record.statistics
    if unknown := set(statistics.things) - set(statistics.shapes):
        raise FileFormatError(f"{folder / SIDECAR}: expected things out of its shapes, got {shown(min(unknown))}.")
    images = tuple(
        load_range_image(folder / f"view_{number:02d}" / "range.npz") for number in range(1, len(statistics.views) + 1)
    )
    for number, image in enumerate(images, 1):
        if image.camera is None or image.T_world_camera is None:
            raise FileFormatError(f"{folder}: expected a camera and a pose of view {number}.")
    views = Scan(images, (), _true_poses(folder / "poses.json", len(images)))
    mesh = TriangleMesh.load(folder / "mesh.ply")
    sizes = {"nx": grid.shape[0], "ny": grid.shape[1], "nz": grid.shape[2], "mesh": len(mesh.vertices)}
    data = read_checked_arrays(folder / "truth.npz", _ARRAYS, {**sizes, "shapes": len(statistics.shapes)})
    surfaces = _surfaces(data, list(statistics.shapes), folder / "truth.npz")
    shapes = {name: _seen_of(statistics.shapes[name], name, folder / SIDECAR) for name in statistics.things}
    if data["filled"].max(initial=-1) >= len(shapes):
        raise FileFormatError(f"{folder / 'truth.npz'}: array 'filled': expected numbers below {len(shapes)}.")
    seen = Occupancy(data["states"], data["filled"], tuple(shapes), shapes, grid, record.tolerance_m)
    fused = FusedSurface(
        mesh,
        statistics.voxel_m,
        statistics.truncation_m,
        data["vertex_weights"],
        statistics.min_weight,
        statistics.voxels,
    )
    is_found = settings.registration == "unknown" and views.true_poses is not None
    found = pose_errors(views.poses, views.true_poses) if is_found else None  # type: ignore[arg-type]
    return ScanResult(
        settings, views, fused, surfaces, statistics.shapes, tuple(statistics.things), seen, found,
        record.versions, record.variant, record.times_s,
    )  # fmt: skip


def _true_poses(path: Path, views: int) -> np.ndarray | None:
    """True poses of the views, (n, 4, 4) float64, T_world_camera, metres; None if the file holds none."""
    data = read_json(path)
    found = data.get("true") if isinstance(data, dict) else None
    if found is None:
        return None
    try:
        poses = np.asarray(found, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path}: expected matrices of numbers under true.") from error
    if poses.shape != (views, 4, 4) or not np.isfinite(poses).all():
        raise FileFormatError(f"{path}: expected {views} finite matrices 4 x 4 under true, got {poses.shape}.")
    return poses


def _surfaces(data: dict[str, np.ndarray], names: list[str], path: Path) -> dict[str, TriangleMesh]:
    """True surface of each shape by name, cut from the arrays in which the shapes follow one another."""
    stops = {key: np.cumsum(data[f"{key}_counts"]) for key in ("vertex", "face")}
    if (stops["vertex"][-1:] != len(data["vertices"])).any() or (stops["face"][-1:] != len(data["faces"])).any():
        raise FileFormatError(f"{path}: expected counts that add up to the vertices and faces.")
    vertices = np.split(data["vertices"], stops["vertex"][:-1])
    faces = np.split(data["faces"], stops["face"][:-1])
    try:
        return {name: TriangleMesh(v, f) for name, v, f in zip(names, vertices, faces, strict=True)}
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _seen_of(shape: ShapeStatistics, name: str, path: Path) -> SeenOfShape:
    """The fractions of a shape that the views saw, from its statistics."""
    if shape.seen is None:
        raise FileFormatError(f"{path}: expected the values 'seen' of {shown(name)}, which is no background.")
    values = msgspec.to_builtins(shape.seen)
    return SeenOfShape(**{key: float("nan") if value is None else value for key, value in values.items()})


def _none_of_nan(value: float) -> float | None:
    """The value, or None for NaN, which JSON does not have."""
    return None if np.isnan(value) else float(value)
