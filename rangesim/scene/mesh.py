# SPDX-License-Identifier: Apache-2.0
"""A scene around a bare mesh: a matte table, a camera and some ambient light."""

from __future__ import annotations

import logging
from collections.abc import Mapping
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
from rangesim.triangle_mesh import TriangleMesh

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Suffixes of files that are taken for meshes."""
Y_UP_SUFFIXES = (".glb", ".gltf")
"""Suffixes of formats in which y points up. glTF defines this; for the other formats, which define nothing, z is up."""
MESH_MATERIALS: dict[str, dict[str, Any]] = {
    "matte": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.6}},
    "glossy": {"type": "twosided", "bsdf": {"type": "roughplastic", "diffuse_reflectance": 0.5, "alpha": 0.1}},
    "mirror": {"type": "twosided", "bsdf": {"type": "conductor", "material": "Ag"}},
    "transparent": {"type": "dielectric", "int_ior": "bk7"},
}
"""BSDFs for bare meshes by material class, as Mitsuba dictionaries."""


def scene_around_mesh(path: Path, material: str, unit_m: float, folder: Path, advises: bool = False) -> dict[str, Any]:
    """Mitsuba scene dictionary of a mesh that stands on a table in front of a camera.

    The camera has 640 x 480 pixels and a field of view of 57 degrees. The size of the table and the distance of the
    camera follow the size of the mesh. Mitsuba reads fewer formats than trimesh, so it gets a copy of the mesh.

    Parameters
    ----------
    path : file of the mesh.
    material : key of `MESH_MATERIALS`.
    unit_m : metres per unit of length of the mesh.
    folder : folder for the copy, which must exist until the scene is instantiated.
    advises : whether to warn if single precision has rounded the vertices.

    Raises
    ------
    ValueError
        Unknown material.
    FileFormatError
        The file is missing, broken or too large, or holds no triangles of finite size.
    """
    if material not in MESH_MATERIALS:
        hint = nearest(material, MESH_MATERIALS)
        raise ValueError(f"expected a material out of {', '.join(MESH_MATERIALS)}, got {material!r}{hint}.")
    vertices, faces = read_mesh(path)
    with np.errstate(over="ignore"):  # coordinates that are too large are refused below
        is_single = np.array_equal(vertices, np.float32(vertices))
    if advises and is_single:
        offset = np.clip(0, vertices.min(axis=0), vertices.max(axis=0))  # of the mesh from the file's origin
        warn_of_coarse_mesh(Rounding(unit_m * rounding_of(offset), path.stem), str(path))
    vertices = vertices * unit_m
    if path.suffix.lower() in Y_UP_SUFFIXES:
        vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
    if not (np.abs(vertices) <= MAX_COORDINATE_M).all():
        raise FileFormatError(f"expected {path} within {MAX_COORDINATE_M:g} metres; state its unit with unit_m.")
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


def with_plain_data(scene: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The scene dictionary with the objects that Mitsuba expects in place of plain data.

    The `mesh` of a shape, a TriangleMesh, becomes a file in `folder`, and a `to_world` (4, 4) of a shape, a sensor or
    an emitter a transform.

    Raises
    ------
    FileFormatError
        A shape states both `mesh` and `filename`, or a `mesh` of another type.
    """
    result = dict(scene)
    for number, (name, node) in enumerate(scene.items()):
        if not isinstance(node, Mapping):
            continue
        entries = dict(node)
        if isinstance(matrix := entries.get("to_world"), np.ndarray):
            entries["to_world"] = mi.ScalarTransform4f(matrix)
        if "mesh" in entries:
            mesh = entries.pop("mesh")
            if not isinstance(mesh, TriangleMesh) or "filename" in entries:
                raise FileFormatError(
                    f"expected shape {name!r} with a TriangleMesh as its mesh and without a filename, got "
                    f"{type(mesh).__name__}{' and a filename' if 'filename' in entries else ''}."
                )
            mesh.save(folder / f"shape_{number}.ply")
            entries["filename"] = str(folder / f"shape_{number}.ply")
        result[name] = entries
    return result


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3), in units of the file, and faces (m, 3) of a mesh file; the parts of a scene graph are joined."""
    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # trimesh logs what it also raises
    check_file(path, FileFormatError)

    class Beside(trimesh.resolvers.FilePathResolver):  # type: ignore[misc]
        """Finds the files that a mesh refers to: plain files in the folder of the mesh or below."""

        def get(self, name: str) -> bytes:
            check_file(Path(self.parent) / name.strip(), FileFormatError)
            return bytes(super().get(name))

    try:
        with np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(path, process=False, skip_materials=True, resolver=Beside(str(path)))
    except FileFormatError as error:
        raise FileFormatError(f"{path} refers to a file beside it: {error}") from error
    except Exception as error:  # every parser of trimesh raises errors of its own
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
    """Path of a new PLY file in `folder` that holds the mesh."""
    import trimesh

    target = folder / "mesh.ply"
    trimesh.Trimesh(vertices, faces, process=False).export(target)
    return str(target)
