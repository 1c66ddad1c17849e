# SPDX-License-Identifier: Apache-2.0
"""A solid that objects are made of: its closed mesh, and the convex pieces that collide in its stead."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rangesim.dataset.convex_pieces import ConvexPieces, convex_pieces
from rangesim.triangle_mesh import TriangleMesh

CREASE_DEG = 35.0
"""Angle between two faces above which their edge is a crease, degrees. A cylinder of 16 sides, the coarsest that still
looks round, has 22 degrees between its sides; a hexagon has 60."""
FLAT_DEG = 0.5
"""Angle between two faces below which they count as one plane, degrees; coordinates in millimetres with three decimals
turn a face of 1 mm by 0.1 degrees."""


@dataclass(frozen=True, eq=False)
class SolidModel:
    """A solid in part coordinates.

    name : of the primitive or of the file.
    mesh : closed, metres, part coordinates; vertices are shared across smooth edges only, see `split_at_creases`.
    pieces : convex hulls of these points (k, 3), metres, cover the solid; None: to be found from the mesh.
    source_sha256 : of the file, with the meshes that a URDF file names; "" for a primitive.
    """

    name: str
    mesh: TriangleMesh
    pieces: tuple[np.ndarray, ...] | None = None
    source_sha256: str = ""

    @cached_property
    def is_smooth(self) -> bool:
        """Whether some faces meet smoothly, so that the renderer is to interpolate normals."""
        angles = _edges(self.mesh.faces, self.mesh.face_normals)[2]
        return bool((angles > np.radians(FLAT_DEG)).any())

    @cached_property
    def collision(self) -> ConvexPieces:
        """The convex pieces that collide, and how far they stand off the mesh."""
        return convex_pieces(self.mesh) if self.pieces is None else ConvexPieces(self.pieces, 0.0)

    @cached_property
    def size_m(self) -> float:
        """The longest side of the box around the mesh, metres, along the axes of the part."""
        return float(np.ptp(self.mesh.vertices, axis=0).max())

    @cached_property
    def centre_of_mass_m(self) -> np.ndarray:
        """(3,) float64, metres, part coordinates, of a solid of uniform density."""
        corners = self.mesh.corners - self.mesh.vertices.mean(axis=0)
        a, b, c = np.moveaxis(corners, 1, 0)
        volumes = (a * np.cross(b, c)).sum(axis=1) / 6
        centroid = (volumes[:, None] * corners.sum(axis=1) / 4).sum(axis=0) / volumes.sum()
        return np.asarray(centroid + self.mesh.vertices.mean(axis=0))

    def resting_rotation(self, random: np.random.Generator) -> np.ndarray:
        """(3, 3) float64, a random rotation in which the solid lies stable on a plane of constant z.

        A face of the convex hull is stable if the centre of mass lies above it. Its probability is about the solid
        angle that it takes up seen from the centre of mass, area / distance^2.
        """
        from scipy.spatial import ConvexHull

        hull = ConvexHull(self.mesh.vertices)
        # faces of one plane count as one; at this rounding, planes differ by a thousandth of a degree
        scaled = hull.equations / [1, 1, 1, self.size_m]
        _, first, number = np.unique(np.round(scaled, 5), axis=0, return_index=True, return_inverse=True)
        planes = hull.equations[first]
        areas = np.bincount(number.reshape(-1), TriangleMesh(hull.points, hull.simplices).face_areas_m2)
        heights = -(planes[:, :3] @ self.centre_of_mass_m + planes[:, 3])
        weights = areas / np.maximum(heights, 1e-3 * self.size_m) ** 2
        for face in random.choice(len(planes), len(planes), replace=False, p=weights / weights.sum()):
            below = self.centre_of_mass_m + heights[face] * planes[face, :3]
            if (planes[:, :3] @ below + planes[:, 3]).max() <= 1e-4 * self.size_m:
                break
        down = _turned_down(planes[face, :3])
        c, s = np.cos(turn := random.uniform(0, 2 * np.pi)), np.sin(turn)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ down


def split_at_creases(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with shared vertices along smooth edges and separate ones along creases.

    Vertices at the same place are merged first. The renderer's normals, which are means over the faces of a vertex, are
    then those of the smooth surface, and edges stay sharp.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mesh = merged(mesh)
    faces, n = mesh.faces, 3 * len(mesh.faces)
    first, second, angles = _edges(faces, mesh.face_normals)
    smooth = angles <= np.radians(CREASE_DEG)
    # an edge is a half-edge of each of two faces; its end in one face is its start in the other
    a, b = first[smooth], second[smooth]
    following = np.arange(n).reshape(-1, 3)[:, [1, 2, 0]].reshape(-1)
    rows, columns = np.concatenate([a, following[a]]), np.concatenate([following[b], b])
    count, corner = connected_components(coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n)), directed=False)
    order = np.zeros(count, np.int64)
    order[corner] = faces.reshape(-1)  # all corners of a component are at one vertex
    return TriangleMesh(mesh.vertices[order], corner.reshape(-1, 3))


def merged(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh in which vertices at the same place, to a millionth of its size, are one; without degenerate faces."""
    scale = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-30)
    places = np.round((mesh.vertices - mesh.vertices.min(axis=0)) / scale * 1e6).astype(np.int64)
    _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
    faces = number.reshape(-1)[mesh.faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return TriangleMesh(mesh.vertices[first], faces[proper])


def _edges(faces: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of half-edges that two faces share, and the angle between the faces.

    A half-edge 3 f + i leads from corner i of face f to the next. An edge of more than two faces counts as none.

    Returns
    -------
    first, second : (e,) int64, half-edges. angles : (e,) float64, radians.
    """
    start, end = faces.reshape(-1).astype(np.int64), faces[:, [1, 2, 0]].reshape(-1).astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    _, at, count = np.unique(key[order], return_index=True, return_counts=True)
    first, second = order[at[count == 2]], order[at[count == 2] + 1]
    opposite = start[first] == end[second]
    first, second = first[opposite], second[opposite]
    n, m = normals[first // 3], normals[second // 3]
    angles = np.arctan2(np.linalg.norm(np.cross(n, m), axis=1), (n * m).sum(axis=1))
    return first, second, angles


def _turned_down(normal: np.ndarray) -> np.ndarray:
    """(3, 3) rotation that turns a unit vector to -z."""
    x = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(-normal, x), -normal])
