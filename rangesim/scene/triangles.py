# SPDX-License-Identifier: Apache-2.0
"""The true surfaces of a scene as triangle meshes, to compare measurements with."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from rangesim.rig import translation
from rangesim.scene.scene import Scene
from rangesim.triangle_mesh import TriangleMesh

SEGMENTS = 256
"""Number of segments of a full circle. With 256, the triangles of a sphere of radius 0.1 m are at most 8 um inside it:
r (1 - cos(pi / 256)). Memory and time grow with the square of the number of segments."""


def true_surfaces(scene: Scene) -> dict[str, TriangleMesh]:
    """The surface of each shape in metres, world, by the name of the shape (its id in the scene file).

    Round shapes are approximated with 256 segments per circle. A surface is the bare geometry: holes of a `mask` are
    filled, bump maps are flat, and thin panes have no thickness.

    Raises
    ------
    ValueError
        A shape is neither a mesh nor a sphere, cylinder, disk or rectangle.
    """
    parameters = mi.traverse(scene.mitsuba)
    to_world = translation(*scene.origin_m)
    return {s.id(): _triangles(s, parameters).moved(to_world) for s in scene.mitsuba.shapes()}


def _triangles(shape: Any, parameters: Any) -> TriangleMesh:
    name, kind = shape.id(), shape.class_name()
    if f"{name}.vertex_positions" in parameters:
        vertices = np.array(parameters[f"{name}.vertex_positions"], dtype=np.float64).reshape(-1, 3)
        return TriangleMesh(vertices, np.array(parameters[f"{name}.faces"]).reshape(-1, 3))
    if kind not in _UNIT_SHAPES:
        raise ValueError(f"expected meshes, spheres, cylinders, disks and rectangles, but {name!r} is a {kind}.")
    matrix = np.array(parameters[f"{name}.to_world"].matrix, dtype=np.float64).reshape(4, 4)
    unit = _UNIT_SHAPES[kind]()
    faces = unit.faces if np.linalg.det(matrix[:3, :3]) > 0 else unit.faces[:, ::-1]
    return TriangleMesh(unit.vertices @ matrix[:3, :3].T + matrix[:3, 3], faces)


def _lattice(points: np.ndarray) -> TriangleMesh:
    """The mesh of two triangles in each cell of a lattice of points (k, l, 3)."""
    k, l = points.shape[:2]  # noqa: E741
    index = np.arange(k * l).reshape(k, l)
    a, b, c, d = (index[i : k - 1 + i, j : l - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    mesh = TriangleMesh(points.reshape(-1, 3), faces)
    return TriangleMesh(mesh.vertices, faces[mesh.face_areas_m2 > 1e-12])  # cells at a pole have one triangle


def _circle() -> np.ndarray:
    a = 2 * np.pi * np.arange(SEGMENTS + 1) / SEGMENTS
    a[-1] = 0  # the last point is exactly the first
    return np.stack([np.cos(a), np.sin(a), 0 * a], axis=-1)


def _sphere() -> TriangleMesh:
    a = np.pi * np.arange(SEGMENTS // 2 + 1) / (SEGMENTS // 2)
    rings = np.sin(a)[:, None, None] * _circle() + np.cos(a)[:, None, None] * np.array([0, 0, 1.0])
    return _lattice(rings)


def _cylinder() -> TriangleMesh:
    return _lattice(np.stack([_circle() + np.array([0, 0, 1.0]), _circle()]))


def _disk() -> TriangleMesh:
    return _lattice(np.stack([0 * _circle(), _circle()]))


def _rectangle() -> TriangleMesh:
    corners = np.array([[[-1, -1, 0], [-1, 1, 0]], [[1, -1, 0], [1, 1, 0.0]]])
    return _lattice(corners)


_UNIT_SHAPES = {"Sphere": _sphere, "Cylinder": _cylinder, "Disk": _disk, "Rectangle": _rectangle}
"""Functions that mesh a shape as it is before its `to_world`, by the name of its class in Mitsuba."""
