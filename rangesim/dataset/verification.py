# SPDX-License-Identifier: Apache-2.0
"""Checks of a data set on the disk: its files, the arrays of its scenes, and the masks against the poses.

The masks are checked by other means than they were made: the models of the store are put at their poses, and rays are
cast at them (Open3D). So a mask, a pose, a model or a camera that does not fit the others is found.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rangesim.dataset.sample_files import (
    MODELS_MEMBER,
    SCENE_MEMBER,
    CameraRecord,
    SampleRecord,
    arrays_of,
    members_of,
    record_of,
)
from rangesim.dataset.store import CHECKSUMS, IndexRow, Store
from rangesim.errors import FileFormatError
from rangesim.rig import Camera, Zones
from rangesim.triangle_mesh import TriangleMesh

OFFSET_PX = 0.05
"""Offset of the rays around a pixel's centre, in pixels, of which one has to agree where the centre's does not: two
programs round a ray that grazes an edge to either side, by less than a thousandth of a pixel."""
MAX_DISTANCE = 1e-3
"""Largest difference between the true reading and the distance to the model, as a fraction of the reading. Single
precision explains 1e-6, and ten times more where a ray grazes a surface; a wrong pose is off by far more."""


@dataclass(frozen=True)
class Findings:
    """Check of a data set, which lists what is broken.

    scenes : count of scenes that were checked. failed : count of scenes that failed when the data set was made; the
    index has their errors. problems : sentences, each with its place.
    """

    scenes: int
    failed: int
    problems: tuple[str, ...]

    def __str__(self) -> str:
        lines = [f"{self.scenes} scenes checked, {len(self.problems)} problems"]
        if self.failed:
            lines[0] += f"; {self.failed} scenes failed when the data set was made"
        return "\n".join([*lines, *(f"  {problem}" for problem in self.problems)])


def verify_dataset(directory: str | Path, tell: Callable[[str, float], None] | None = None) -> Findings:
    """Check all files and all scenes of a data set.

    Raises
    ------
    FileFormatError
        The directory holds no complete data set.
    """
    store = Store(directory)
    problems = list(_broken_files(store))
    rows = store.rows  # refused if it is the index that is broken
    there = [row for row in rows if row.error is None]
    if [row.scene for row in rows] != list(range(store.record.scenes)):
        problems.append(f"index: expected a row for each of {store.record.scenes} scenes, got {len(rows)} rows.")
    models: dict[str, TriangleMesh] = {}
    for number, row in enumerate(there):
        if tell is not None:
            tell(f"Checking scene {row.scene}", number / len(there))
        problems += _problems_of(store, row, models)
    return Findings(len(there), len(rows) - len(there), tuple(problems))


def _broken_files(store: Store) -> Iterator[str]:
    """Sentences about files that are missing, changed or too many."""
    listed = store.checksums
    for name, sha256 in listed.items():
        path = store.directory / name
        if not path.is_file():
            yield f"{name} is missing."
        elif _digest(path) != sha256:
            yield f"{name} was changed: its checksum is not that in {CHECKSUMS}."
    for folder, pattern in (("shards", "*.tar"), ("models", "*.ply")):
        for path in sorted((store.directory / folder).glob(pattern)):
            if f"{folder}/{path.name}" not in listed:
                yield f"{folder}/{path.name} does not belong to the data set: {CHECKSUMS} does not list it."


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _problems_of(store: Store, row: IndexRow, models: dict[str, TriangleMesh]) -> list[str]:
    """Sentences about a scene."""
    try:
        segment = store.segment(row)
        members = members_of(segment, f"scene {row.scene}")
        record = record_of(members, f"scene {row.scene}")
        if IndexRow.of(record, *row.place[:2], segment) != row:
            return [f"scene {row.scene}: its row in the index does not agree with its record."]
        meshes, problems = [], []
        for index, each in enumerate(record.objects):
            mesh = models.get(each.sha256) or store.mesh(record, index, members)
            if each.from_file:
                models[each.sha256] = mesh
            elif hashlib.sha256(mesh.to_ply("part")).hexdigest() != each.sha256:
                problems.append(f"object {index}: its mesh is not the one of the record's checksum.")
            meshes.append(mesh)
        for name in sorted(set(members) - {SCENE_MEMBER, MODELS_MEMBER}):
            arrays = arrays_of(members, name, f"scene {row.scene}", record.sizes(name.removesuffix(".npz")))
            if name.startswith("camera."):
                camera = record.cameras[int(name.split(".")[1]) - 1]
                problems += _problems_of_masks(record, camera, arrays, meshes)
    except FileFormatError as error:
        return [str(error)]
    return [f"scene {row.scene}, {problem}" for problem in problems]


def _problems_of_masks(
    record: SampleRecord, camera_record: CameraRecord, arrays: dict[str, np.ndarray], meshes: Sequence[TriangleMesh]
) -> list[str]:
    """Sentences about masks that do not fit the poses, or the depth behind them."""
    camera, problems = camera_record.of_record, []
    if arrays["instance"].max(initial=-1) >= len(record.shapes):
        return [f"instance: expected numbers of {len(record.shapes)} shapes, got {arrays['instance'].max()}."]
    T_world_camera = np.array(camera_record.T_world_camera)
    for mask, each, mesh in zip(arrays["amodal"], record.objects, meshes, strict=True):
        name = record.shapes[each.shape].name
        visible = arrays["instance"] == each.shape
        if (visible & ~mask).any():
            problems.append(f"{name}: {int((visible & ~mask).sum())} visible pixels lie outside of its amodal mask.")
        if isinstance(camera, Zones):
            continue  # a zone sees more than its middle
        T = np.linalg.inv(T_world_camera) @ np.array(each.T_world_part)
        vertices = each.scale * mesh.vertices @ T[:3, :3].T + T[:3, 3]
        caster = _Caster(TriangleMesh(vertices, mesh.faces), camera)
        everywhere = np.ones(mask.shape, dtype=bool)
        off = ~caster.agrees(everywhere, (0.0, 0.0), mask, visible, arrays["true_m"]).reshape(mask.shape)
        for offset in np.ndindex(3, 3):
            if off.any():
                around = OFFSET_PX * (np.array(offset) - 1.0)
                off[off] = ~caster.agrees(off, around, mask, visible, arrays["true_m"])
        if off.any():
            wrong_m = int((off & visible).sum())
            problems.append(
                f"{name}: {int(off.sum())} pixels of its mask do not fit its pose, or not the distance to its model "
                f"there ({wrong_m} of {int(visible.sum())} visible ones)."
            )
    return problems


class _Caster:
    """Rays of a camera to a mesh in its coordinates, metres."""

    def __init__(self, mesh: TriangleMesh, camera: Camera) -> None:
        import open3d

        self.scene, self.camera = open3d.t.geometry.RaycastingScene(), camera
        vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
        self.scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(faces))

    def agrees(
        self, at: np.ndarray, offset: ArrayLike, mask: np.ndarray, visible: np.ndarray, true_m: np.ndarray
    ) -> np.ndarray:
        """(n,) bool, for each of the n pixels `at` (h, w) whether a ray beside its centre agrees with the truth.

        offset : (2,) pixels. mask, visible : (h, w) bool, of the object. true_m : (h, w) true readings, metres.
        """
        import open3d

        rays = np.concatenate(self.camera.rays_at(at, offset), axis=1).astype(np.float32)
        reading = self.scene.cast_rays(open3d.core.Tensor(rays))["t_hit"].numpy()
        near = np.abs(true_m[at] - reading) <= MAX_DISTANCE * reading
        return np.asarray((np.isfinite(reading) == mask[at]) & (near | ~visible[at]))
