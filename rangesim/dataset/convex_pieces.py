# SPDX-License-Identifier: Apache-2.0
"""Convex pieces that cover a closed mesh closely, for collisions.

A piece is the convex hull of what an axis-parallel cell cuts out of the solid. The piece that stands off the mesh
farthest is cut in two, through the place where it does, until all are close enough (after Mamou and Ghorbel, "A simple
and efficient approach for 3D mesh approximate convex decomposition", ICIP 2009, with cells instead of merged faces).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from rangesim.triangle_mesh import TriangleMesh

TOLERANCE = 0.01
"""Largest distance from a piece to the solid that is good enough, as a fraction of its size: 0.6 mm of 60 mm."""
MAX_PIECES = 32
"""Largest number of pieces. Physics takes time in proportion; smooth hollows would need ever more."""
SAMPLES = 4
"""Points along each side of a triangle of a hull at which its distance to the solid is measured."""
CUTS = 8
"""Number of cuts through corners of the mesh that are tried along each axis."""
THIN = 1e-3
"""Thickness of a cell, of the solid's size, below which none is cut off."""
FLAT = 1e-6
"""Thickness of a piece, of the solid's size, below which it has no volume and is dropped."""


class ConvexPieces(NamedTuple):
    """Convex pieces of a solid.

    points : corners (k, 3) of each piece, metres. standoff_m : largest distance from a piece to the solid, metres.
    """

    points: tuple[np.ndarray, ...]
    standoff_m: float


class _Piece(NamedTuple):
    """The part of the solid within a cell.

    cell : (2, 3) lower and upper corner. triangles : (t, 3, 3) of the mesh in the cell. points : (k, 3) corners of the
    hull. standoff : largest distance from hull to solid. farthest : (3,) the place of it.
    """

    cell: np.ndarray
    triangles: np.ndarray
    points: np.ndarray
    standoff: float
    farthest: np.ndarray


def convex_pieces(mesh: TriangleMesh) -> ConvexPieces:
    """Convex pieces that cover a closed mesh, each at most `TOLERANCE` of the mesh's size outside of it if
    `MAX_PIECES` are enough for that.

    Examples
    --------
    >>> corner = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> found = convex_pieces(TriangleMesh(np.array(corner), faces))
    >>> len(found.points), found.standoff_m < 1e-6
    (1, True)
    """
    import open3d as o3d

    world = o3d.t.geometry.RaycastingScene(nthreads=1)
    world.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    size = float(np.ptp(mesh.vertices, axis=0).max())
    cell = np.stack([mesh.vertices.min(axis=0) - 0.01 * size, mesh.vertices.max(axis=0) + 0.01 * size])
    pieces = [_measured(world, cell, mesh.corners, ConvexHull(mesh.vertices))]
    while len(pieces) < MAX_PIECES:
        worst = max(range(len(pieces)), key=lambda i: pieces[i].standoff)
        if pieces[worst].standoff <= TOLERANCE * size:
            break
        pieces[worst : worst + 1] = _halves(world, pieces[worst], size)
    return ConvexPieces(tuple(piece.points for piece in pieces), max(piece.standoff for piece in pieces))


def _halves(world: Any, piece: _Piece, size: float) -> list[_Piece]:
    """The two pieces of the axis-parallel cut that leaves the least volume.

    The cuts that are tried go through the farthest place, the middle of the cell, and corners of the mesh.
    """
    best: list[tuple[np.ndarray, np.ndarray, ConvexHull]] = []
    least = np.inf
    corners = piece.triangles.reshape(-1, 3)
    for axis in range(3):
        values = np.unique(np.round(corners[:, axis] / size, 4)) * size
        some = values[np.linspace(0, len(values) - 1, min(len(values), CUTS)).astype(int)]
        for place in (*some, piece.farthest[axis], piece.cell[:, axis].mean()):
            if not piece.cell[0, axis] + THIN * size < place < piece.cell[1, axis] - THIN * size:
                continue
            halves = []
            for side in (0, 1):
                cell = piece.cell.copy()
                cell[1 - side, axis] = place
                triangles = _clipped(piece.triangles, axis, float(place), side)
                hull = _hull(world, cell, triangles, size)
                halves += [] if hull is None else [(cell, triangles, hull)]
            volume = sum(hull.volume for _, _, hull in halves)
            if halves and volume < least:
                least, best = volume, halves
    return [_measured(world, *half) for half in best] or [piece._replace(standoff=0.0)]


def _hull(world: Any, cell: np.ndarray, triangles: np.ndarray, size: float) -> ConvexHull | None:
    """The convex hull of what a cell cuts out of the solid; None if that has no volume."""
    corners = np.array([[cell[i, 0], cell[j, 1], cell[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    single = corners.astype(np.float32)
    inside = world.compute_occupancy(single, nsamples=3).numpy() > 0
    inside |= world.compute_distance(single).numpy() < FLAT * size  # a cut may lie in a face
    points = np.concatenate([triangles.reshape(-1, 3), corners[inside]])
    if len(points) < 4:
        return None
    centred = points - points.mean(axis=0)
    thinnest = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    return None if np.abs(centred @ thinnest).max() < FLAT * size else ConvexHull(points)


def _measured(world: Any, cell: np.ndarray, triangles: np.ndarray, hull: ConvexHull) -> _Piece:
    """The piece of a hull, with its largest distance to the solid."""
    i, j = np.meshgrid(np.arange(SAMPLES + 1), np.arange(SAMPLES + 1), indexing="ij")
    i, j = i[i + j <= SAMPLES], j[i + j <= SAMPLES]
    weights = np.stack([i, j, SAMPLES - i - j], axis=1) / SAMPLES
    samples = np.einsum("sk,tkx->tsx", weights, hull.points[hull.simplices]).reshape(-1, 3).astype(np.float32)
    outside = world.compute_occupancy(samples, nsamples=3).numpy() == 0
    distances = np.where(outside, world.compute_distance(samples).numpy(), 0.0)
    farthest = int(np.argmax(distances))
    return _Piece(cell, triangles, hull.points[hull.vertices], float(distances[farthest]), samples[farthest])


def _clipped(triangles: np.ndarray, axis: int, place: float, side: int) -> np.ndarray:
    """Triangles (t, 3, 3) cut off at a plane; side 0 keeps what is below it, side 1 what is above."""
    depth = (triangles[:, :, axis] - place) * (1 if side else -1)
    kept = depth >= 0
    count = kept.sum(axis=1)
    parts = [triangles[count == 3]]
    for n in (1, 2):
        some, d = triangles[count == n], depth[count == n]
        lone = np.argmax(kept[count == n] if n == 1 else ~kept[count == n], axis=1)
        order = (lone[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(some, order[:, :, None], axis=1), 1, 0)
        da, db, dc = np.take_along_axis(d, order, axis=1).T[:, :, None]
        on_b, on_c = a + (b - a) * (da / (da - db)), a + (c - a) * (da / (da - dc))
        for cut in (on_b, on_c):
            cut[:, axis] = place
        if n == 1:
            parts.append(np.stack([a, on_b, on_c], axis=1))
        else:
            parts += [np.stack([on_b, b, c], axis=1), np.stack([on_b, c, on_c], axis=1)]
    return np.concatenate(parts)
