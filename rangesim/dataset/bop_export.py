# SPDX-License-Identifier: Apache-2.0
"""A data set in the format of BOP, the benchmark of object poses: `bop_toolkit` and its users read it.

DIR/models/obj_000001.ply           each model at each scale, millimetres, with models_info.json
    camera.json                     camera of the first image
    export.json                     what each obj_id is
    train_SENSOR/000000/depth/      what the sensor measured, 16 bits; scene_camera.json has the scale of each image
                        gray/       its intensity, 8 bits
                        mask/       whole silhouettes of the objects within the image
                        mask_visib/ their visible parts
                        scene_camera.json, scene_gt.json, scene_gt_info.json

A folder below train_SENSOR holds up to a thousand images, one of each scene of the data set; the last three digits of a
scene's number are those of its image. Silhouettes end at the image's edge, so `px_count_all` counts pixels within it.

[1] Hodan et al., BOP: Benchmark for 6D Object Pose Estimation, ECCV 2018.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangesim.dataset.export_steps import box_of, grey_of, sensors_of
from rangesim.dataset.sample_files import SampleRecord
from rangesim.dataset.samples import Samples
from rangesim.errors import FileFormatError
from rangesim.files.atomic_directories import DirectoryKind, new_directory
from rangesim.files.image_files import write_grey
from rangesim.files.schema import write_json
from rangesim.rig import Intrinsics
from rangesim.triangle_mesh import TriangleMesh

KIND = DirectoryKind("rangesim-bop", "export.json", FileFormatError)
"""Directories that hold an export to BOP."""
MM = 1e3
"""Millimetres per metre: lengths are millimetres in BOP."""
IMAGES = 1000
"""Images of a folder, as in the training sets of BOP that are rendered."""
CENTRE_PX = 0.5
"""Pixel coordinates of the middle of the first pixel here. In BOP, as in OpenCV, they are 0: `bop_toolkit` takes the
ray of a depth pixel at its integer coordinates, and BlenderProc writes principal points so."""
DEPTH_SCALES = (0.1, 1.0, 10.0, 100.0)
"""Millimetres per step of a depth image: an image has the first with which its depths fit into 16 bits."""


def export_bop(
    directory: str | Path,
    out: str | Path,
    sensors: Sequence[str] | None = None,
    tell: Callable[[str, float], None] | None = None,
) -> int:
    """Write a data set in the format of BOP; returns the count of images.

    Parameters
    ----------
    directory : folder of the data set.
    out : new folder.
    sensors : names of the sensors to export. None: all whose cameras are pinholes without distortion, which is all that
        BOP has.

    Raises
    ------
    FileFormatError
        The data set is not complete or broken, or `out` holds something else.
    ValueError
        There is no such sensor, or its camera is no pinhole without distortion.
    """
    samples = Samples(directory)
    with new_directory(out, KIND, inputs=[directory]) as folder:
        names = chosen_sensors(samples, sensors)
        models = _Models(folder / "models")
        scenes: dict[Path, dict[str, dict[str, Any]]] = {}
        for count, sample in enumerate(samples):
            if tell is not None:
                tell(f"Exporting scene {samples.rows[count].scene}", count / len(samples))
            record, members = samples.record(count)
            ids = [models.number_of(samples, record, i, members) for i in range(len(record.objects))]
            for name in names:
                place = folder / f"train_{name}" / f"{record.number // IMAGES:06d}"
                of_image = _write_image(place, record, sample, name, ids)
                scene = scenes.setdefault(place, {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}})
                for file, entry in of_image.items():
                    scene[file][str(record.number % IMAGES)] = entry
                if not (folder / "camera.json").exists():
                    _write_camera(folder / "camera.json", camera_of(record, name), of_image["scene_camera"])
        for place, scene in scenes.items():
            for file, entries in scene.items():
                write_json(place / f"{file}.json", entries)
        models.write_info()
        write_json(folder / KIND.sidecar, {"format": KIND.format, "sensors": names, "objects": models.known})
    return len(samples) * len(names)


def chosen_sensors(samples: Samples, wanted: Sequence[str] | None) -> list[str]:
    """Names of the sensors to export: `wanted`, or all whose cameras are pinholes without distortion.

    Raises
    ------
    ValueError
        A name that no sensor has, a camera that is no such pinhole, or no sensor.
    """
    there, (record, _) = sensors_of(samples, wanted), samples.record(0)
    for name in wanted or ():
        if not _is_ideal_pinhole(record, name):
            raise ValueError(f"expected a sensor whose camera is a pinhole without distortion, but {name} has another.")
    names = [name for name in there if _is_ideal_pinhole(record, name)]
    if not names:
        raise ValueError("expected a sensor whose camera is a pinhole without distortion, but no sensor has one.")
    return names


def camera_of(record: SampleRecord, sensor: str) -> Any:
    """The camera of a sensor of a scene."""
    return _camera_record(record, sensor).of_record


def _camera_record(record: SampleRecord, sensor: str) -> Any:
    number = next(each.camera for each in record.sensors if each.name == sensor)
    return record.cameras[number - 1]


def _is_ideal_pinhole(record: SampleRecord, sensor: str) -> bool:
    camera = camera_of(record, sensor)
    return isinstance(camera, Intrinsics) and not any(camera.distortion)


def _write_image(
    place: Path, record: SampleRecord, sample: dict[str, Any], sensor: str, ids: Sequence[int]
) -> dict[str, Any]:
    """Write the images of a scene as a sensor sees it; returns the entries of the scene's files, by their names."""
    for folder in ("depth", "gray", "mask", "mask_visib"):
        (place / folder).mkdir(parents=True, exist_ok=True)
    image = f"{record.number % IMAGES:06d}"
    camera_record = _camera_record(record, sensor)
    camera, readings = camera_record.of_record, sample[f"sensor.{sensor}"]
    truth = sample[f"camera.{1 + record.cameras.index(camera_record)}"]
    depth_mm = np.nan_to_num(MM * readings["reading_m"].astype(np.float64))
    scale = next((s for s in DEPTH_SCALES if depth_mm.max() <= s * 65535), DEPTH_SCALES[-1])
    depth = np.rint(np.clip(depth_mm / scale, 0, 65535)).astype(np.uint16)
    write_grey(place / "depth" / f"{image}.png", depth)
    write_grey(place / "gray" / f"{image}.png", grey_of(readings["intensity"]))
    T_camera_world = np.linalg.inv(np.array(camera_record.T_world_camera))
    poses, infos = [], []
    for number, (each, obj_id) in enumerate(zip(record.objects, ids, strict=True)):
        whole, visible = truth["amodal"][number], truth["instance"] == each.shape
        write_grey(place / "mask" / f"{image}_{number:06d}.png", 255 * whole.astype(np.uint8))
        write_grey(place / "mask_visib" / f"{image}_{number:06d}.png", 255 * visible.astype(np.uint8))
        T = T_camera_world @ np.array(each.T_world_part)
        pose = {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (MM * T[:3, 3]).tolist()}
        poses.append({**pose, "obj_id": obj_id})
        infos.append(_info(whole, visible, depth > 0))
    return {
        "scene_camera": {
            "cam_K": [camera.fx, 0.0, camera.cx - CENTRE_PX, 0.0, camera.fy, camera.cy - CENTRE_PX, 0.0, 0.0, 1.0],
            "cam_R_w2c": T_camera_world[:3, :3].ravel().tolist(),
            "cam_t_w2c": (MM * T_camera_world[:3, 3]).tolist(),
            "depth_scale": scale,
        },
        "scene_gt": poses,
        "scene_gt_info": infos,
    }


def _info(whole: np.ndarray, visible: np.ndarray, measured: np.ndarray) -> dict[str, Any]:
    """The entry of an object in `scene_gt_info.json`."""
    pixels = int(whole.sum())
    return {
        "bbox_obj": box_of(whole) or [-1, -1, -1, -1],
        "bbox_visib": box_of(visible) or [-1, -1, -1, -1],
        "px_count_all": pixels,
        "px_count_valid": int((whole & measured).sum()),
        "px_count_visib": int(visible.sum()),
        "visib_fract": int(visible.sum()) / pixels if pixels else 0.0,
    }


def _write_camera(path: Path, camera: Intrinsics, entry: dict[str, Any]) -> None:
    parts = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy")}
    middle = {name: getattr(camera, name) - CENTRE_PX for name in ("cx", "cy")}
    write_json(path, {**parts, **middle, "depth_scale": entry["depth_scale"]})


class _Models:
    """The models of an export: each mesh at each scale, numbered from 1 as they come.

    known : of each number, as text, what it is.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.numbers: dict[tuple[str, float], int] = {}
        self.known: dict[str, dict[str, Any]] = {}
        self.info: dict[str, dict[str, float]] = {}
        folder.mkdir()

    def number_of(self, samples: Samples, record: SampleRecord, index: int, members: dict[str, bytes]) -> int:
        """Number of the model of an object; a new model is written."""
        each = record.objects[index]
        number = self.numbers.setdefault((each.sha256, each.scale), len(self.numbers) + 1)
        if str(number) not in self.known:
            mesh = samples.store.mesh(record, index, members)
            scaled = TriangleMesh(MM * each.scale * mesh.vertices, mesh.faces)
            (self.folder / f"obj_{number:06d}.ply").write_bytes(_ply(scaled))
            self.info[str(number)] = _extent(scaled.vertices)
            self.known[str(number)] = {
                "model": each.model, "category": each.category, "scale": each.scale, "sha256": each.sha256
            }  # fmt: skip
        return number

    def write_info(self) -> None:
        """Write `models_info.json`."""
        write_json(self.folder / "models_info.json", self.info)


def _extent(vertices: np.ndarray) -> dict[str, float]:
    """The box of a model along its axes, and the largest distance between two of its vertices."""
    from scipy.spatial import ConvexHull
    from scipy.spatial.distance import pdist

    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
    is_solid = len(vertices) > 3 and np.linalg.matrix_rank(vertices - vertices[0]) == 3
    corners = vertices[ConvexHull(vertices).vertices] if is_solid else vertices
    box = {f"min_{axis}": float(low[i]) for i, axis in enumerate("xyz")}
    box |= {f"size_{axis}": float(size[i]) for i, axis in enumerate("xyz")}
    return {"diameter": float(pdist(corners).max()), **box}


def _ply(mesh: TriangleMesh) -> bytes:
    """The bytes of a PLY file with normals, as BOP's own models have them."""
    import trimesh

    normals = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    head += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header\n"]
    faces = np.empty(len(mesh.faces), np.dtype([("n", "u1"), ("v", "<i4", 3)]))
    faces["n"], faces["v"] = 3, mesh.faces
    return "\n".join(head).encode() + np.hstack([mesh.vertices, normals]).astype("<f4").tobytes() + faces.tobytes()
