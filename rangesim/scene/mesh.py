# SPDX-License-Identifier: Apache-2.0
"""A bare mesh becomes a scene: on a matte table, in front of a camera."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from pcgraph.plumbing.plain_files import check_file
from rangesim.errors import FileFormatError
from rangesim.scene.origin import Rounding, rounding_of, warn_of_coarse_mesh
from rangesim.settings import limits
from rangesim.settings.bounds import MAX_COORDINATE_M
from rangesim.settings.config import brief, nearest

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
Y_UP_SUFFIXES = (".glb", ".gltf")
"""glTF defines y as up; the other formats define nothing, and z is taken."""

MESH_MATERIALS: dict[str, dict[str, Any]] = {
    "matte": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.6}},
    "glossy": {"type": "twosided", "bsdf": {"type": "roughplastic", "diffuse_reflectance": 0.5, "alpha": 0.1}},
    "mirror": {"type": "twosided", "bsdf": {"type": "conductor", "material": "Ag"}},
    "transparent": {"type": "dielectric", "int_ior": "bk7"},
}


def scene_around_mesh(path: Path, material: str, unit_m: float, folder: Path, advises: bool = False) -> dict[str, Any]:
    """Mitsuba scene dictionary with the mesh standing on a table, camera 640 x 480, 57 degrees wide.

    `unit_m` is the length of the mesh's unit in metres; table and camera distance follow the size of the mesh.
    Mitsuba reads fewer formats than there are, so it gets a copy of the mesh in `folder`, which must live until the
    scene is instantiated. With `advises`, vertices that single precision has rounded are warned of.
    """
    if material not in MESH_MATERIALS:
        hint = nearest(material, MESH_MATERIALS)
        raise ValueError(f"expected a material out of {', '.join(MESH_MATERIALS)}, got {material!r}{hint}.")
    vertices, faces = _read(path)
    with np.errstate(over="ignore"):  # what is too large is refused below
        is_single = np.array_equal(vertices, np.float32(vertices))
    if advises and is_single:
        offset = np.clip(0, vertices.min(axis=0), vertices.max(axis=0))  # of the mesh from the origin of the file
        warn_of_coarse_mesh(Rounding(unit_m * rounding_of(offset), path.stem), str(path))
    vertices = vertices * unit_m
    if path.suffix.lower() in Y_UP_SUFFIXES:
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
    if not (np.abs(vertices) <= MAX_COORDINATE_M).all():
        raise FileFormatError(f"expected {path} within {MAX_COORDINATE_M:g} metres; what is its unit? See unit_m.")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float(np.linalg.norm(high - low))
    if not size > 0:
        raise FileFormatError(f"expected {path} to have an extent, but all its vertices coincide.")
    vertices = vertices - [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]
    centre = [0.0, 0.0, float(high[2] - low[2]) / 2]
    eye = [centre[0], centre[1] - 1.6 * size, centre[2] + 0.9 * size]
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 57.0,
            "to_world": T().look_at(origin=eye, target=centre, up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 640, "height": 480},
        },
        "table": {
            "type": "rectangle",
            "to_world": T().scale([1.5 * size, 1.5 * size, 1]),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.4}},
        },
        "light": {"type": "constant", "radiance": 0.05},
        "mesh": {
            "type": "ply",
            "filename": _write(folder, vertices, faces),
            "face_normals": True,
            "bsdf": MESH_MATERIALS[material],
        },
    }


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) float64 vertices in metres and (m, 3) faces of a mesh file, parts of a scene graph put in their places."""
    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # it says there what it also raises
    check_file(path, FileFormatError)

    class Beside(trimesh.resolvers.FilePathResolver):  # type: ignore[misc]
        """Finds the files that a mesh refers to: plain files beside it or below."""

        def get(self, name: str) -> bytes:
            check_file(Path(self.parent) / name.strip(), FileFormatError)
            return bytes(super().get(name))

    try:
        with np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(path, process=False, skip_materials=True, resolver=Beside(str(path)))
    except FileFormatError as error:
        raise FileFormatError(f"{path} refers to a file beside it: {error}") from error
    except Exception as error:  # each of trimesh's parsers fails in its own way
        reason = brief(error) or type(error).__name__
        raise FileFormatError(f"expected a mesh in {path}, but it cannot be read: {reason}.") from error
    vertices, faces = np.asarray(mesh.vertices), np.asarray(getattr(mesh, "faces", ()))
    if len(faces) == 0:
        raise FileFormatError(f"expected a triangle mesh in {path}, which has no faces.")
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        raise FileFormatError(f"expected vertices of three numbers in {path}, got an array of shape {vertices.shape}.")
    limits.check("points", max(len(vertices), len(faces)), f"vertices or faces in {path}", FileFormatError)
    if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise FileFormatError(f"expected finite vertices and valid face indices in {path}; repair the mesh first.")
    return vertices, faces


def _write(folder: Path, vertices: np.ndarray, faces: np.ndarray) -> str:
    """Name of a PLY file in `folder` with this mesh."""
    import trimesh

    target = folder / "mesh.ply"
    trimesh.Trimesh(vertices, faces, process=False).export(target)
    return str(target)
