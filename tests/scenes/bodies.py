# SPDX-License-Identifier: Apache-2.0
"""Things with a neck on a table, sampled all around: dumbbells, bolts, bottles, lamps; and boxes, which have none.

Each thing is a list of meshes, its parts, that stands on z = 0; metres. A size of 1 makes it 5 to 35 cm long.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.transformations import rotation_matrix, translation_matrix

from scenes.surfaces import Floats, Labelled

SPACING_M = 0.0015
"""Between points, on average."""
NOISE_M = 0.0004
"""Standard deviation in all directions."""
ALONG_X = rotation_matrix(np.pi / 2, (0, 1, 0))
"""Pose, (4, 4), that lays a cylinder along x."""


def cylinder(radius: float, length: float, at: Floats, sections: int = 32) -> trimesh.Trimesh:
    """A cylinder along z about the origin, put to a pose (4, 4)."""
    return trimesh.creation.cylinder(radius, length, sections=sections, transform=at)


def dumbbell(size: float) -> list[trimesh.Trimesh]:
    """Two balls and a bar between them, along x."""
    balls = [trimesh.creation.icosphere(3, 0.035 * size) for _ in range(2)]
    for ball, x in zip(balls, (-0.07, 0.07), strict=True):
        ball.apply_translation((x * size, 0, 0.035 * size))
    return [*balls, cylinder(0.01 * size, 0.14 * size, translation_matrix((0, 0, 0.035 * size)) @ ALONG_X)]


def bolt(size: float) -> list[trimesh.Trimesh]:
    """A bolt that lies on an edge of its hexagonal head and on the tip of its shaft."""
    tilt = rotation_matrix(np.arcsin(0.01 / 0.08), (0, 1, 0))
    head = cylinder(0.02 * size, 0.014 * size, translation_matrix((-0.007 * size, 0, 0)) @ ALONG_X, 6)
    shaft = cylinder(0.01 * size, 0.08 * size, translation_matrix((0.04 * size, 0, 0)) @ ALONG_X)
    for part in (head, shaft):
        part.apply_transform(tilt)
    lowest = min(float(part.vertices[:, 2].min()) for part in (head, shaft))
    for part in (head, shaft):
        part.apply_translation((0, 0, -lowest))
    return [head, shaft]


def bottle(size: float) -> list[trimesh.Trimesh]:
    """A body and a neck."""
    neck = cylinder(0.012 * size, 0.07 * size, translation_matrix((0, 0, 0.175 * size)))
    return [cylinder(0.035 * size, 0.14 * size, translation_matrix((0, 0, 0.07 * size))), neck]


def lamp(size: float) -> list[trimesh.Trimesh]:
    """A foot, a pole and a shade."""
    heights = ((0.06, 0.015, 0.0075), (0.008, 0.25, 0.125), (0.09, 0.1, 0.3))
    return [cylinder(r * size, h * size, translation_matrix((0, 0, z * size))) for r, h, z in heights]


def box(size: float) -> list[trimesh.Trimesh]:
    """A box of 6 cm x 9 cm x 5 cm."""
    edges = np.array([0.06, 0.09, 0.05]) * size
    return [trimesh.creation.box(edges, transform=translation_matrix((0, 0, edges[2] / 2)))]


def on_a_table(things: list[list[trimesh.Trimesh]], seed: int, half_m: float = 0.4) -> Labelled:
    """Things, each given by its parts, in rows on a table (0), turned about z at random and counted from 1."""
    random = np.random.default_rng(seed)
    table = random.uniform(-half_m, half_m, (round(4 * half_m**2 / SPACING_M**2), 3)) * (1, 1, 0)
    points, labels = [table], [np.zeros(len(table), np.int64)]
    for number, parts in enumerate(things):
        place = ((number % 3 - 1) * 0.2, (number // 3 - 1) * 0.2, 0)
        at = translation_matrix(place) @ rotation_matrix(random.uniform(0, 2 * np.pi), (0, 0, 1))
        for part in parts:
            sampled = trimesh.sample.sample_surface(part, round(part.area / SPACING_M**2), seed=seed)[0]
            shown = sampled[:, 2] > 0.001
            for other in parts:
                shown &= other is part or ~_inside(other, sampled)
            seen = sampled[shown]
            points.append(seen @ at[:3, :3].T + at[:3, 3])
            labels.append(np.full(len(seen), number + 1))
    every = np.concatenate(points)
    return Labelled(every + random.normal(0, NOISE_M, every.shape), np.concatenate(labels))


def _inside(mesh: trimesh.Trimesh, points: Floats) -> NDArray[np.bool_]:
    """Whether points, (n, 3), lie in a convex mesh, (n,)."""
    away = np.einsum("ij,kj->ik", points, mesh.face_normals)
    return np.asarray((away < (mesh.triangles[:, 0] * mesh.face_normals).sum(axis=1) - 1e-6).all(axis=1))
