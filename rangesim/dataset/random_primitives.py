# SPDX-License-Identifier: Apache-2.0
"""Primitives of random proportions: closed meshes that are unions of convex pieces without any gap.

A body of revolution of n sides is cut into n sectors along planes through the axis. A sector whose cross section is
convex is itself convex, because its long edges are parallel. So the pieces that collide are exactly the mesh.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rangesim.dataset.solid_model import SolidModel, split_at_creases
from rangesim.triangle_mesh import TriangleMesh

SIDES = 48
"""Number of sides of a round primitive. The mesh is then inside the true circle by at most 0.2 % of its radius, 0.06 mm
at a radius of 30 mm."""
RING_SIDES = 32
"""Number of sides of a ring, each of which is a piece that collides. It is smaller than `SIDES` because physics takes
time with every piece; the mesh is inside the true circle by at most 0.5 % of its radius."""
SPHERE_SUBDIVISIONS = 3
"""Number of times that the faces of an icosahedron are cut into four for a sphere: 1280 faces, inside the true sphere
by at most 0.3 % of its radius."""

Outline = list[tuple[float, float]]
"""A closed polygon of points (radius, height), counter-clockwise in that plane; it may touch the axis."""


def primitive(name: str, size_m: float, random: np.random.Generator) -> SolidModel:
    """A primitive of random proportions, with its centre at the origin.

    Parameters
    ----------
    name : one of `PRIMITIVES`.
    size_m : the longest side of the box around it, metres.

    Examples
    --------
    >>> ring = primitive("torus", 0.1, np.random.default_rng(0))
    >>> ring.mesh.is_closed, round(ring.size_m, 6)
    (True, 0.1)
    """
    mesh, pieces = PRIMITIVES[name](random)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre, scale = (low + high) / 2, size_m / float((high - low).max())
    mesh = TriangleMesh((mesh.vertices - centre) * scale, mesh.faces)
    return SolidModel(name, split_at_creases(mesh), tuple((piece - centre) * scale for piece in pieces))


_Made = tuple[TriangleMesh, list[np.ndarray]]


def box_mesh(low: np.ndarray, high: np.ndarray) -> TriangleMesh:
    """An axis-parallel box between two corners (3,), metres."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return TriangleMesh(np.where(corners, high, low), _triangles(quads))


def _triangles(quads: list[tuple[int, int, int, int]]) -> np.ndarray:
    a, b, c, d = np.array(quads).T
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _revolved(outline: Outline, sections: list[Outline], sides: int) -> _Made:
    """A body of revolution about z, and its pieces: one for a section that touches the axis, else one per side."""
    angles = 2 * np.pi * np.arange(sides) / sides

    def ring(points: Outline) -> np.ndarray:
        radius, height = np.array(points).T
        return np.stack(
            [radius[:, None] * np.cos(angles), radius[:, None] * np.sin(angles), height[:, None] + 0 * angles], axis=-1
        )

    rows = ring(outline)
    k = len(outline)
    row, side = np.meshgrid(np.arange(k), np.arange(sides), indexing="ij")
    at = row * sides + side
    right, up = row * sides + (side + 1) % sides, (row + 1) % k * sides + side
    across = (row + 1) % k * sides + (side + 1) % sides
    faces = np.concatenate([np.stack([at, right, across], -1), np.stack([at, across, up], -1)]).reshape(-1, 3)
    on_axis = np.repeat([r == 0 for r, _ in outline], sides)
    both = on_axis[np.stack([at, up], -1)].all(axis=-1)  # an edge of the outline along the axis bounds nothing
    mesh = TriangleMesh(rows.reshape(-1, 3), faces[~np.concatenate([both, both]).reshape(-1)])
    pieces = []
    for section in sections:
        points = ring(section)
        if min(r for r, _ in section) == 0:
            pieces.append(points.reshape(-1, 3))
        else:
            pieces += [points[:, [i, (i + 1) % sides]].reshape(-1, 3) for i in range(sides)]
    return mesh, pieces


def _box(random: np.random.Generator) -> _Made:
    mesh = box_mesh(np.zeros(3), random.uniform(0.3, 1.0, 3))
    return mesh, [mesh.vertices]


def _sphere(random: np.random.Generator) -> _Made:
    import trimesh

    ball = trimesh.creation.icosphere(SPHERE_SUBDIVISIONS)
    return TriangleMesh(ball.vertices, ball.faces), [np.asarray(ball.vertices)]


def _solid(outline: Outline) -> _Made:
    return _revolved(outline, [outline], SIDES)


def _cylinder(random: np.random.Generator) -> _Made:
    height = np.exp(random.uniform(np.log(0.5), np.log(5.0)))  # of a radius of 1
    return _solid([(0, 0), (1, 0), (1, height), (0, height)])


def _cone(random: np.random.Generator) -> _Made:
    height, top = random.uniform(1.0, 3.0), random.uniform(0.0, 0.5)
    return _solid([(0, 0), (1, 0), (top, height), (0, height)] if top > 0.1 else [(0, 0), (1, 0), (0, height)])


def _capsule(random: np.random.Generator) -> _Made:
    height = random.uniform(0.5, 4.0)
    angles = np.linspace(0, np.pi / 2, 9)
    low = [(float(np.sin(a)), float(-np.cos(a))) for a in angles]
    high = [(r, height - z) for r, z in reversed(low)]
    outline = [(0.0 if i in (0, len(low) + len(high) - 1) else r, z) for i, (r, z) in enumerate(low + high)]
    return _solid(outline)


def _torus(random: np.random.Generator) -> _Made:
    tube = random.uniform(0.15, 0.4)
    angles = 2 * np.pi * np.arange(20) / 20
    section = [(float(1 + tube * np.cos(a)), float(tube * np.sin(a))) for a in angles]
    return _revolved(section, [section], RING_SIDES)


def _tube(random: np.random.Generator) -> _Made:
    inner, height = random.uniform(0.5, 0.9), random.uniform(0.4, 4.0)
    section: Outline = [(inner, 0), (1, 0), (1, height), (inner, height)]
    return _revolved(section, [section], RING_SIDES)


def _cup(random: np.random.Generator) -> _Made:
    height, thick = random.uniform(1.2, 2.8), random.uniform(0.06, 0.15)
    inner = 1 - thick
    outline: Outline = [(0, 0), (1, 0), (1, height), (inner, height), (inner, thick), (0, thick)]
    wall: Outline = [(inner, 0), (1, 0), (1, height), (inner, height)]
    base: Outline = [(0, 0), (inner, 0), (inner, thick), (0, thick)]
    return _revolved(outline, [wall, base], RING_SIDES)


def _bracket(random: np.random.Generator) -> _Made:
    thick, arm, depth = random.uniform(0.1, 0.3), random.uniform(0.5, 1.0), random.uniform(0.3, 1.0)
    outline = np.array([(0, 0), (1, 0), (1, thick), (thick, thick), (thick, arm), (0, arm)])
    front, back = (np.column_stack([outline[:, 0], np.full(6, y), outline[:, 1]]) for y in (0.0, depth))
    sides = [(i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6)]
    ends = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = np.concatenate([_triangles(sides)[:, ::-1], np.array(ends), np.array(ends)[:, ::-1] + 6])
    mesh = TriangleMesh(np.concatenate([front, back]), faces)
    if mesh.volume_m3 < 0:
        mesh = TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])
    corner = [box_mesh(np.zeros(3), np.array([1, depth, thick])).vertices]
    return mesh, [*corner, box_mesh(np.array([0, 0, thick]), np.array([thick, depth, arm])).vertices]


def _prism(random: np.random.Generator) -> _Made:
    sides, height = int(random.integers(3, 9)), random.uniform(0.3, 3.0)
    section: Outline = [(0, 0), (1, 0), (1, height), (0, height)]
    return _revolved(section, [section], sides)


PRIMITIVES: dict[str, Callable[[np.random.Generator], _Made]] = {
    "box": _box,
    "sphere": _sphere,
    "cylinder": _cylinder,
    "cone": _cone,
    "capsule": _capsule,
    "torus": _torus,
    "tube": _tube,
    "cup": _cup,
    "bracket": _bracket,
    "prism": _prism,
}
"""The function that makes each primitive, by its name."""
