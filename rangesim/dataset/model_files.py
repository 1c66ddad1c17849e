# SPDX-License-Identifier: Apache-2.0
"""Models from files: STL, OBJ, GLB, PLY, OFF and URDF."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from pcgraph.plumbing.plain_files import read_file
from rangesim.dataset.solid_model import SolidModel, merged, split_at_creases
from rangesim.dataset.urdf import read_urdf
from rangesim.errors import FileFormatError
from rangesim.triangle_mesh import TriangleMesh

MODEL_SUFFIXES = (".stl", ".obj", ".glb", ".gltf", ".ply", ".off", ".urdf")
"""Suffixes of the files that are taken for models."""
MAX_ENTRIES = 200_000
"""Largest number of files and subfolders of a folder of models. To list them takes half a second; the folder may have
been "/" by mistake."""
MAX_MODELS = 256
"""Largest number of models that a process keeps in memory: 256 models of 20 000 faces take about 0.3 GB."""


def model_files(path: Path) -> tuple[Path, ...]:
    """The model files that a path stands for: the file itself, or all in a folder and its subfolders, sorted.

    If there are URDF files in the folder, only these count, because the meshes are their parts.

    Raises
    ------
    FileFormatError
        There is no such file or folder, or no model in the folder.
    """
    if path.is_file():
        if path.suffix.lower() not in MODEL_SUFFIXES:
            raise FileFormatError(f"expected a model ({', '.join(MODEL_SUFFIXES)}), got {path}.")
        return (path,)
    if not path.is_dir():
        raise FileFormatError(f"expected a model or a folder of models, but {path} does not exist.")
    found = sorted(p for p in _entries(path) if p.suffix.lower() in MODEL_SUFFIXES and p.is_file())
    if not found:
        raise FileFormatError(f"expected models ({', '.join(MODEL_SUFFIXES)}) in {path}, found none.")
    urdfs = [p for p in found if p.suffix.lower() == ".urdf"]
    return tuple(urdfs or found)


def _entries(folder: Path) -> Iterator[Path]:
    """Paths of all files in a folder and its subfolders; FileFormatError if there are more than `MAX_ENTRIES`."""
    count = 0
    for parent, folders, files in os.walk(folder):
        count += len(folders) + len(files)
        if count > MAX_ENTRIES:
            raise FileFormatError(
                f"expected a folder of models with at most {MAX_ENTRIES} files and subfolders, {folder} has more; "
                "choose a smaller one."
            )
        yield from (Path(parent, file) for file in files)


def category_of(path: Path, files: Sequence[Path]) -> str:
    """Category of a model among the files of its group: the name of the file, without its suffix, or of a folder.

    Where the files lie in several folders, it is the name of the folder below the one that all of them share.

    Examples
    --------
    >>> from pathlib import Path
    >>> flat, deep = [Path("parts/nut.stl"), Path("parts/bolt.stl")], [Path("parts/nuts/m4.stl"), Path("parts/cup.stl")]
    >>> [category_of(path, flat) for path in flat], [category_of(path, deep) for path in deep]
    (['nut', 'bolt'], ['nuts', 'cup'])
    """
    below = path.relative_to(os.path.commonpath([file.parent for file in files])).parts
    return below[0] if len(below) > 1 else path.stem


@lru_cache(maxsize=MAX_MODELS)
def read_model(path: Path, unit_m: float) -> SolidModel:
    """The model in a file, in the file's own coordinates, which it multiplies with `unit_m` metres per unit.

    Vertices at the same place are merged. A mesh that is closed but inside out is turned. A mesh that is open is
    refused, because physics, glass and the test whether a camera is inside a thing need an inside.

    Raises
    ------
    FileFormatError
        The file is missing, broken, empty or open.
    """
    from rangesim.scene.mesh import read_mesh

    files = [path]
    if path.suffix.lower() == ".urdf":
        mesh, meshes = read_urdf(path, unit_m)
        files += meshes
    else:
        vertices, faces = read_mesh(path)
        mesh = TriangleMesh(vertices.astype(np.float64) * unit_m, faces)
    mesh = merged(mesh)
    if not mesh.is_closed:
        raise FileFormatError(
            f"expected a closed mesh in {path}, but some of its edges have no face, or an equally turned one, on the "
            "other side; repair the mesh first."
        )
    volume_m3 = mesh.volume_m3
    if abs(volume_m3) < 1e-6 * float(np.prod(np.ptp(mesh.vertices, axis=0))):
        raise FileFormatError(f"expected a mesh with a volume in {path}, got {volume_m3:.3g} cubic metres.")
    if volume_m3 < 0:
        mesh = TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])
    digest = hashlib.sha256(b"".join(read_file(file, FileFormatError) for file in files)).hexdigest()
    return SolidModel(path.stem, split_at_creases(mesh), None, digest)
