# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes, for the true surface of a scene and for the surface fused from several views."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rangesim.settings.config import ShortRepr, shown

_FACE = np.dtype([("n", "u1"), ("v", "<i4", 3)])
"""Layout of a triangle in a PLY file."""
_HEAD = (
    "ply\nformat binary_little_endian 1.0\ncomment coordinates {coordinates}, metres\n"
    "element vertex {vertices}\nproperty double x\nproperty double y\nproperty double z\n"
    "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)
"""Header of the PLY files that are written."""


@dataclass(frozen=True, eq=False, repr=False)
class TriangleMesh(ShortRepr):
    """A triangle mesh: vertices, and triangles as indices of them.

    Parameters
    ----------
    vertices : (n, 3) float64, metres, world.
    faces : (m, 3) int32, indices of vertices, counter-clockwise seen from outside.

    Raises
    ------
    ValueError
        An array of another shape, a vertex that is not finite, or an index out of range.

    Examples
    --------
    >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> tetrahedron = TriangleMesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> tetrahedron.is_closed
    True
    >>> round(tetrahedron.volume_m3, 6)
    0.166667
    >>> points, faces = tetrahedron.sample(100)
    >>> points.shape
    (100, 3)
    """

    vertices: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices, faces = np.asarray(self.vertices, dtype=np.float64), np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise ValueError(f"expected finite vertices of shape (n, 3), got {shown(vertices)}.")
        if faces.ndim != 2 or faces.shape[1] != 3 or (faces.size and faces.dtype.kind not in "iu"):
            raise ValueError(f"expected faces of shape (m, 3) with indices of vertices, got {shown(faces)}.")
        if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
            raise ValueError(f"expected faces with indices from 0 to {len(vertices) - 1}, got {faces.max()}.")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int32))

    @classmethod
    def joined(cls, meshes: list[TriangleMesh]) -> TriangleMesh:
        """One mesh with the triangles of several; vertices at the same place stay separate."""
        starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        vertices = [np.zeros((0, 3)), *(m.vertices for m in meshes)]
        faces = [np.zeros((0, 3), np.int32), *(m.faces + s for m, s in zip(meshes, starts, strict=False))]
        return cls(np.concatenate(vertices), np.concatenate(faces))

    @property
    def corners(self) -> np.ndarray:
        """(m, 3, 3) float64, the three corners of each triangle, metres, world."""
        return np.asarray(self.vertices[self.faces])

    @property
    def face_areas_m2(self) -> np.ndarray:
        """(m,) float64, areas of the triangles, square metres."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1))

    @property
    def face_normals(self) -> np.ndarray:
        """(m, 3) float64, outward unit normals of the triangles, world; NaN for triangles without area."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        n = np.cross(b - a, c - a)
        with np.errstate(invalid="ignore"):
            return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))

    @property
    def area_m2(self) -> float:
        """Total area of the triangles, square metres."""
        return float(self.face_areas_m2.sum())

    @property
    def volume_m3(self) -> float:
        """Volume that a closed mesh encloses, cubic metres.

        By the divergence theorem it is the sum of a . (b x c) / 6 over the triangles with corners a, b and c.
        """
        a, b, c = np.moveaxis(self.corners - self.vertices.mean(axis=0), 1, 0)
        return float((a * np.cross(b, c)).sum() / 6)

    @property
    def is_closed(self) -> bool:
        """Whether the mesh is closed: every edge has as many triangles on one side as on the other.

        Vertices at the same place count as one.
        """
        if not len(self.faces):
            return False
        scale = max(float(np.ptp(self.vertices, axis=0).max()), 1e-30)
        places = np.round((self.vertices - self.vertices[0]) / scale * 1e6)
        number = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
        faces = number[self.faces].astype(np.int64)
        a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
        count = len(self.vertices)
        return bool(np.array_equal(np.sort(a * count + b), np.sort(b * count + a)))

    def sample(self, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Random points on the surface, uniform by area.

        The points are stratified: the area is cut into n equal parts, in the order of the faces, and each part gets one
        point.

        Returns
        -------
        points : (n, 3) float64, metres, world.
        faces : (n,) int64, index of the triangle on which each point lies.

        Raises
        ------
        ValueError
            The mesh has no area.
        """
        areas = self.face_areas_m2
        if not areas.sum() > 0:
            raise ValueError("expected a mesh with triangles that have an area, got none.")
        random = np.random.default_rng(seed)
        place = (np.arange(n) + random.random(n)) / n * areas.sum()
        face = np.minimum(np.searchsorted(np.cumsum(areas), place, side="right"), len(areas) - 1)
        s, t = np.sqrt(random.random((n, 1))), random.random((n, 1))  # Osada et al., 2002
        a, b, c = np.moveaxis(self.corners[face], 1, 0)
        return (1 - s) * a + s * (1 - t) * b + s * t * c, face

    def moved(self, T: ArrayLike) -> TriangleMesh:
        """The mesh moved by a rigid transform T, (4, 4), metres."""
        matrix = np.asarray(T, dtype=np.float64)
        return TriangleMesh(self.vertices @ matrix[:3, :3].T + matrix[:3, 3], self.faces)

    def save(self, path: str | Path) -> None:
        """Write a binary `.ply` file with vertices in double precision. The file appears only when it is complete.

        Raises
        ------
        ValueError
            The file name does not end in `.ply`.
        FileFormatError
            The file cannot be written.
        """
        from pcgraph.plumbing.plain_files import write_file
        from rangesim.errors import FileFormatError

        path = Path(path)
        if path.suffix.lower() != ".ply":
            raise ValueError(f"expected a file name ending in .ply, got {path.name!r}.")
        write_file(path, self.to_ply(), FileFormatError)

    def to_ply(self, coordinates: Literal["world", "part"] = "world") -> bytes:
        """The bytes of the file that `save` writes.

        coordinates : what the vertices are coordinates of; the file says it in a comment.
        """
        table = np.empty(len(self.faces), _FACE)
        table["n"], table["v"] = 3, self.faces
        head = _HEAD.format(vertices=len(self.vertices), faces=len(self.faces), coordinates=coordinates)
        return head.encode() + self.vertices.astype("<f8").tobytes() + table.tobytes()

    @classmethod
    def load(cls, path: str | Path) -> TriangleMesh:
        """The mesh that `save` wrote; `rangesim.load_scene` and Open3D read meshes of other programs.

        Raises
        ------
        FileFormatError
            The file is missing, or is not one that `save` wrote.
        """
        from pcgraph.plumbing.plain_files import read_file
        from rangesim.errors import FileFormatError

        content = read_file(Path(path), FileFormatError)
        head, end, body = content.partition(b"end_header\n")
        counts = re.findall(rb"element (?:vertex|face) ([0-9]{1,10})\n", head)
        n, m = map(int, counts) if len(counts) == 2 else (0, 0)
        kinds = [_HEAD.format(vertices=n, faces=m, coordinates=kind).encode() for kind in ("world", "part")]
        is_own = head + end in kinds
        if not is_own or len(body) != 24 * n + _FACE.itemsize * m:
            raise FileFormatError(f"{path}: expected a mesh that rangesim wrote, complete.")
        table = np.frombuffer(body, _FACE, offset=24 * n)
        try:
            return cls(np.frombuffer(body, "<f8", 3 * n).reshape(n, 3), table["v"])
        except ValueError as error:
            raise FileFormatError(f"{path}: {error}") from error
