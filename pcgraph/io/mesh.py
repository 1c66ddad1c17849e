# SPDX-License-Identifier: Apache-2.0
"""Meshes as point clouds: the vertices of OBJ, STL, OFF and glTF files, or points sampled on the surface.

The library trimesh reads the files. `pcgraph.io.ply` reads the vertices of meshes in PLY files.
"""

from __future__ import annotations

import json
import logging
import re
import warnings
from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError, library_reason
from pcgraph.io.format import CloudFile, Format
from pcgraph.plumbing.plain_files import check_file, read_file

if TYPE_CHECKING:
    import trimesh

_KINDS = {".obj": "obj", ".stl": "stl", ".off": "off", ".glb": "gltf", ".gltf": "gltf", ".ply": "ply"}
"""Trimesh's names of formats by the suffix of the file."""
_FEW_VERTICES = 1000
"""Largest count of vertices that a warning calls few for a point cloud. Chosen by eye; not varied."""
_MAX_ZEROS_PER_BYTE = 10
"""Largest count of elements of glTF accessors without data, which are zeros, per byte of the file. Sparse shapes of
animated faces have less than one. Chosen by eye; not varied."""
_GLTF_POINTS = 0
"""Mode of glTF primitives that are points. Source: the glTF 2.0 specification."""
_PLASTIC = 1.32471795724474602596
"""The plastic number, dimensionless, the root of x**3 = x + 1: multiples of its inverse powers fill a square evenly
(Roberts 2018)."""


def read_mesh(file: CloudFile, kind: str) -> Cloud:
    """Cloud of the vertices of a mesh file, with their colours and normals if the file has them.

    The vertices of all meshes of a scene are in the scene's frame. An STL file repeats a vertex in each triangle; equal
    ones are merged. An OBJ file repeats a vertex that has several normals or materials; these stay, and the vertices of
    one material come after those of another. Textures and materials are not read. `sample_surface` makes points between
    the vertices.

    Parameters
    ----------
    file : CloudFile
    kind : str
        Trimesh's name of the format: "obj", "stl", "off", or "gltf", which may be binary.

    Raises
    ------
    CloudReadError
        The file is damaged, or it has no vertices.

    Warns
    -----
    UserWarning
        The mesh has faces, but too few vertices to describe its surface. Or trimesh does not read something: colours
        and normals of OFF files, normals of OBJ files without faces, vertices of OBJ files that no face has, normals of
        points in glTF files, and attributes of glTF files with names of an application.
    """
    parts = _parts(file, kind)
    points = np.concatenate([part.points for part in parts])
    n_faces = sum(len(part.faces) for part in parts)
    left_out = _left_out(file.content, kind, len(points), n_faces)
    if left_out:
        warnings.warn(f"left out what the mesh file has besides: {', '.join(left_out)[:200]}", stacklevel=2)
    colors = _together([part.colors for part in parts])
    normals = _together([part.normals for part in parts])
    if kind == "stl":
        points = points[np.sort(np.unique(points, axis=0, return_index=True)[1])]
    if n_faces and len(points) <= _FEW_VERTICES:
        warnings.warn(
            f"read the {len(points)} vertices of the mesh, not its {n_faces} faces: "
            "pcgraph.sample_surface(path, n_points) makes points all over them",
            stacklevel=2,
        )
    return Cloud(points, None if colors is None else np.rint(colors).astype(np.uint8), normals)


def sample_surface(mesh: str | PathLike[str] | trimesh.Trimesh, n_points: int) -> Cloud:
    """Cloud of points sampled evenly on the surface of a mesh; every run gives the same points.

    Parameters
    ----------
    mesh : str, path or trimesh.Trimesh
        ``.obj``, ``.stl``, ``.off``, ``.glb``, ``.gltf`` or ``.ply``, or a mesh in memory.
    n_points : int
        Number of points, at least 1.

    Returns
    -------
    Cloud
        Points (n_points, 3) float64 in the mesh's frame and unit; the normals of their faces; colours, if faces or
        vertices have some; and the column ``face`` (int32), the number of each point's face.

    Raises
    ------
    CloudReadError
        The file cannot be read, or the mesh has no face with an area.
    ValueError
        `n_points` is less than 1.

    Notes
    -----
    Systematic sampling gives each face a number of points in proportion to its area, to less than one point. Within a
    face, the points follow the R2 sequence (Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences"),
    folded into the triangle.

    Examples
    --------
    >>> import trimesh
    >>> cloud = sample_surface(trimesh.creation.box((2.0, 1.0, 1.0)), 1000)
    >>> cloud.points.shape, int((cloud.normals[:, 0] > 0.5).sum())
    ((1000, 3), 100)
    """
    if n_points < 1:
        raise ValueError(f"expected n_points of at least 1, got {n_points}")
    if isinstance(mesh, (str, PathLike)):
        path = Path(mesh)
        kind = _KINDS.get(path.suffix.lower())
        if kind is None:
            raise CloudReadError(f"expected a mesh file ending in {', '.join(_KINDS)}, got {path.name!r}")
        parts = _parts(CloudFile(read_file(path, CloudReadError), path), kind)
    else:
        parts = [_part(mesh, np.eye(4))]
    triangles = np.concatenate([part.points[part.faces] for part in parts])
    with np.errstate(over="ignore", invalid="ignore"):
        across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        doubled = np.linalg.norm(across, axis=1)
    covered = np.cumsum(doubled)
    if not len(covered) or not np.isfinite(covered[-1]) or covered[-1] <= 0.0:
        raise CloudReadError("expected a mesh with faces of some finite area, but it has none")
    steps = np.arange(n_points)
    faces = np.searchsorted(covered, (steps + 0.5) / n_points * covered[-1], side="right")
    u, v = (0.5 + np.outer((1.0 / _PLASTIC, 1.0 / _PLASTIC**2), steps)) % 1.0
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    colors = _together([part.corner_colors for part in parts if len(part.faces)])
    return Cloud(
        np.einsum("nc,ncd->nd", weights, triangles[faces]),
        None if colors is None else np.rint(np.einsum("nc,ncd->nd", weights, colors[faces])).astype(np.uint8),
        across[faces] / doubled[faces, None],
        columns={"face": faces.astype(np.int32)},
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """One mesh of a file, in the scene's frame.

    Attributes
    ----------
    points : (n, 3) float64
    faces : (m, 3) int64
    colors, normals : (n, 3), or None
        Colours (0..255) and normals of the vertices, if the file has them.
    corner_colors : (m, 3, 3), or None
        Colours of the three corners of each face, taken from the vertices or from the faces.
    """

    points: NDArray[np.float64]
    faces: NDArray[np.int64]
    colors: NDArray[np.float64] | None
    normals: NDArray[np.float64] | None
    corner_colors: NDArray[np.float64] | None


def _parts(file: CloudFile, kind: str) -> list[_Part]:
    """The meshes of a file; raises CloudReadError if there is no vertex."""
    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else its errors are printed beside our sentence
    if file.content.startswith(b"glTF"):
        kind = "glb"
    resolver = None  # only .gltf needs other files, and gets none but those beside it
    if kind == "gltf" and file.path is not None:
        resolver = _beside(file.path)
    try:
        if kind in ("glb", "gltf"):
            _check_accessors(file.content)
            buffers = _gltf_scene(file.content).get("buffers", [])
            if file.path is None and not all(one.get("uri", "data:").startswith("data:") for one in buffers):
                raise CloudReadError("a glTF file is read with the files beside it that it names: give its path")
        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(
                BytesIO(file.content), file_type=kind, resolver=resolver, process=False, skip_materials=True
            )
            placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
            parts = [_part(scene.geometry[name], transform) for transform, name in placed]
    except CloudReadError:
        raise
    except MemoryError:
        raise CloudReadError("the mesh does not fit into memory: split the file, or simplify the mesh") from None
    except Exception as error:  # noqa: BLE001 - of damaged files, trimesh raises whatever its parts raise
        raise CloudReadError(f"the mesh file is damaged: {library_reason(error)}") from None
    parts = [part for part in parts if len(part.points)]
    if not parts:
        raise CloudReadError("expected a mesh with vertices, but the file has none")
    return parts


def _beside(path: Path) -> trimesh.resolvers.Resolver:
    """Resolver that opens the files that a .gltf file refers to; they must be regular files in its folder."""
    import trimesh

    class Beside(trimesh.resolvers.FilePathResolver):
        def get(self, name: str) -> bytes:
            check_file(path.parent / name, CloudReadError)
            return super().get(name)

    return Beside(str(path))


def _check_accessors(content: bytes) -> None:
    """Raise CloudReadError if a glTF file promises many more zeros than it has bytes, before they are allocated.

    Also if it is of version 1, which has other structures.
    """
    if content[:4] == b"glTF" and content[4:8] == b"\1\0\0\0":
        raise CloudReadError("expected glTF of version 2, got version 1: convert it first")
    accessors = _gltf_scene(content).get("accessors", [])
    if isinstance(accessors, dict):
        raise CloudReadError("expected glTF of version 2, got version 1: convert it first")
    promised = sum(accessor["count"] for accessor in accessors if "bufferView" not in accessor)
    if promised > _MAX_ZEROS_PER_BYTE * len(content):
        raise CloudReadError(f"the glTF file promises {promised} elements, but it is only {len(content)} bytes long")


def _gltf_scene(content: bytes) -> dict[str, Any]:
    """The JSON of a glTF file; in a binary file it follows the header of 12 bytes, its own length and its type."""
    text = content[20 : 20 + int.from_bytes(content[12:16], "little")] if content[:4] == b"glTF" else content
    scene: dict[str, Any] = json.loads(text)
    return scene


def _left_out(content: bytes, kind: str, n_points: int, n_faces: int) -> list[str]:
    """Names of the data of its vertices that a file has and trimesh did not read."""
    if kind == "off":
        word = re.search(rb"(?m)^\s*(\w*)OFF\b", content)
        letters = word[1] if word else b""
        return [name for letter, name in ((b"C", "colors"), (b"N", "normals")) if letter in letters]
    if kind == "obj":
        lines = b"\n" + content
        if not n_faces:
            return ["normals"] if b"\nvn " in lines else []
        n_missing = lines.count(b"\nv ") - n_points  # or more, as vertices with several normals are repeated
        return [f"{n_missing} vertices of no face"] if n_missing > 0 else []
    if kind != "gltf":
        return []
    names = set()
    for mesh in _gltf_scene(content).get("meshes", []):
        for one in mesh["primitives"]:
            are_points = one.get("mode") == _GLTF_POINTS
            names |= {name for name in one["attributes"] if name[0] == "_" or (name == "NORMAL" and are_points)}
    return sorted(names)


def _part(mesh: Any, transform: NDArray[np.float64]) -> _Part:
    """A mesh or point cloud of trimesh, transformed by a matrix (4, 4)."""
    points = np.asarray(mesh.vertices, np.float64).reshape(-1, 3) @ transform[:3, :3].T + transform[:3, 3]
    faces = np.asarray(getattr(mesh, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
    if faces.size and not (faces.min() >= 0 and faces.max() < len(points)):
        raise CloudReadError(f"expected faces of vertices 0 to {len(points) - 1}, got {faces.min()} to {faces.max()}")
    normals = None
    if "vertex_normals" in mesh._cache:  # trimesh keeps those of a file there, and computes others when asked for them
        moved = np.asarray(mesh.vertex_normals, np.float64) @ np.linalg.inv(transform[:3, :3])
        lengths = np.linalg.norm(moved, axis=1, keepdims=True)
        normals = np.divide(moved, lengths, out=moved, where=lengths > 0.0)
    colors = corner_colors = None
    if mesh.visual.kind == "vertex" and len(mesh.visual.vertex_colors) == len(points):
        colors = np.asarray(mesh.visual.vertex_colors, np.float64)[:, :3]
        corner_colors = colors[faces]
    elif mesh.visual.kind == "face":
        corner_colors = np.repeat(np.asarray(mesh.visual.face_colors, np.float64)[:, None, :3], 3, axis=1)
    return _Part(points, faces, colors, normals, corner_colors)


def _together(arrays: list[NDArray[np.float64] | None]) -> NDArray[np.float64] | None:
    """The arrays, concatenated; None if the list is empty or one of them is None."""
    known = [array for array in arrays if array is not None]
    return np.concatenate(known) if known and len(known) == len(arrays) else None


OBJ = Format("obj", (".obj",), lambda file: read_mesh(file, "obj"))
STL = Format("stl", (".stl",), lambda file: read_mesh(file, "stl"))
OFF = Format("off", (".off",), lambda file: read_mesh(file, "off"))
GLTF = Format("gltf", (".glb", ".gltf"), lambda file: read_mesh(file, "gltf"))
