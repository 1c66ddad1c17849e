# SPDX-License-Identifier: Apache-2.0
"""Points on parts of planes, boxes, balls and tubes, with no sensor; and what may be done to such clouds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

SPACING = 0.01
"""Metres between neighbouring points of a `patch`, unless told."""
UP = np.array([0.0, 0.0, 1.0])
TURN = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
AWAY = np.array([5.0, -3.0, 2.0])
"""With `TURN`, a pose that favours no axis; metres."""


class Labelled(NamedTuple):
    """Points, (n, 3) or (h, w, 3) float64, metres, and the thing that each is on, (n,) or (h, w) integers."""

    points: Floats
    things: NDArray[np.int64]


class Sided(NamedTuple):
    """Points, (n, 3), metres, and unit normals, (n, 3), that point to the side from which each was seen."""

    points: Floats
    normals: Floats


def labelled(parts: list[Floats], things: ArrayLike | None = None) -> Labelled:
    """Parts of (k, 3) points as one cloud, of things that are numbered 0, 1, 2 ... unless told."""
    numbers = np.arange(len(parts)) if things is None else np.asarray(things)
    return Labelled(np.concatenate(parts), np.repeat(numbers, [len(part) for part in parts]))


# --- Parts of planes --------------------------------------------------------------------------------------------------


def patch(corner: ArrayLike, u: ArrayLike, v: ArrayLike, spacing: float = SPACING) -> Floats:
    """Lattice of points on the parallelogram corner + [0, 1] u + [0, 1] v, its border included: (n, 3)."""
    corner_, u_, v_ = (np.array(vector, float) for vector in (corner, u, v))
    steps_u = np.linspace(0, 1, round(np.linalg.norm(u_) / spacing) + 1)
    steps_v = np.linspace(0, 1, round(np.linalg.norm(v_) / spacing) + 1)
    a, b = np.meshgrid(steps_u, steps_v, indexing="ij")
    return corner_ + a.reshape(-1, 1) * u_ + b.reshape(-1, 1) * v_


def tile(corner: ArrayLike, u: ArrayLike, v: ArrayLike, spacing: float, jitter: float = 0.0) -> Floats:
    """Points in the middles of the cells of a parallelogram, each off by up to `jitter` metres along each axis: (n, 3).

    Tiles side by side have one lattice.
    """
    corner_, u_, v_ = (np.array(vector, float) for vector in (corner, u, v))
    counts = [max(round(np.linalg.norm(side) / spacing), 1) for side in (u_, v_)]
    a, b = np.meshgrid(*((np.arange(count) + 0.5) / count for count in counts), indexing="ij")
    points = corner_ + a.reshape(-1, 1) * u_ + b.reshape(-1, 1) * v_
    return points + np.random.default_rng(0).uniform(-jitter, jitter, points.shape)


def scattered(corner: ArrayLike, u: ArrayLike, v: ArrayLike, density: float, rng: np.random.Generator) -> Floats:
    """Points at random on a parallelogram, so many per square metre: (n, 3)."""
    u_, v_ = np.array(u, float), np.array(v, float)
    number = int(density * np.linalg.norm(np.cross(u_, v_)))
    return np.array(corner, float) + rng.random((number, 1)) * u_ + rng.random((number, 1)) * v_


# --- Solids -----------------------------------------------------------------------------------------------------------

OPEN_BELOW = "-x +x -y +y +z"
"""Sides of what stands on something."""
OPEN_ABOVE = "-x +x -y +y -z"


def faces(low: ArrayLike, high: ArrayLike, spacing: float, sides: str = "-x +x -y +y -z +z") -> Sided:
    """Lattice of points on some sides of a box between two corners, and the normals that point out of it."""
    points, normals = [], []
    for side in sides.split():
        axis, upper = "xyz".index(side[1]), side[0] == "+"
        a, b = (i for i in range(3) if i != axis)
        u, v = np.meshgrid(*(np.arange(low[i] + spacing / 2, high[i], spacing) for i in (a, b)), indexing="ij")
        face = np.empty((u.size, 3))
        face[:, axis], face[:, a], face[:, b] = (high if upper else low)[axis], u.ravel(), v.ravel()
        points.append(face)
        normals.append(np.tile((1.0 if upper else -1.0) * np.eye(3)[axis], (u.size, 1)))
    return Sided(np.concatenate(points), np.concatenate(normals))


def surface_of_a_box(size: ArrayLike, n: int = 4000, seed: int = 0) -> Sided:
    """So many points at random on all six sides of a box about the origin, as many on each; outward normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    side, sign = rng.integers(0, 3, n), rng.choice((-1.0, 1.0), n)
    points[np.arange(n), side] = sign / 2
    normals = np.zeros((n, 3))
    normals[np.arange(n), side] = sign
    return Sided(points * size, normals)


def sphere(radius: float, n: int, lowest: float = 0.0) -> Sided:
    """So many points evenly on a sphere about the origin, above `lowest` radii; outward normals."""
    height = np.linspace(lowest, 1.0, n)
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    around = np.sqrt(1 - height**2)
    normals = np.column_stack((around * np.cos(turn), around * np.sin(turn), height))
    return Sided(radius * normals, normals)


def directions(n: int, rng: np.random.Generator) -> Floats:
    """Unit vectors at random, (n, 3), evenly over the sphere."""
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def tube(radius: float, length: float, spacing: float) -> Sided:
    """Points at random, `spacing` apart on average, on a tube around x and on its two ends; outward normals."""
    rng = np.random.default_rng(0)
    n, n_end = int(2 * np.pi * radius * length / spacing**2), int(np.pi * radius**2 / spacing**2)
    angle = rng.uniform(0, 2 * np.pi, n + 2 * n_end)
    x = np.append(rng.uniform(0, length, n), np.repeat([0.0, length], n_end))
    reach = radius * np.append(np.ones(n), np.sqrt(rng.uniform(size=2 * n_end)))
    across = np.column_stack((np.zeros(len(x)), np.cos(angle), np.sin(angle)))
    normals = np.concatenate((across[:n], np.repeat([[-1.0, 0, 0], [1.0, 0, 0]], n_end, axis=0)))
    return Sided(reach[:, None] * across + x[:, None] * [1.0, 0, 0], normals)


def cube_corner(noise: float) -> Floats:
    """Lattice on the three faces of a cube of 1 m that meet in a corner, 80 x 80 points each, turned: (n, 3).

    noise : standard deviation in all directions, in steps of the lattice.
    """
    u, v = (np.mgrid[0:80, 0:80].reshape(2, -1) + 0.5) / 80
    face = np.stack((u, v, np.zeros_like(u)), axis=1)
    points = np.concatenate([np.roll(face, axis, axis=1) for axis in range(3)])
    points += np.random.default_rng(0).normal(0.0, noise / 80, points.shape)
    return points @ Rotation.from_rotvec([0.4, -0.8, 1.3]).as_matrix()


DEGENERATE = {
    "one point": np.array([[1.0, 2, 3]]),
    "one point at the origin": np.zeros((1, 3)),
    "two points": np.array([[0.0, 0, 1], [0, 0, 2]]),
    "duplicates of one point": np.ones((50, 3)),
    "duplicates of many": np.repeat(np.random.default_rng(0).random((40, 3)), 5, axis=0),
    "a line": np.linspace((0, 0, 1), (1, 0, 1), 200),
    "a line through the viewpoint": np.linspace((0, 0, 1), (0, 0, 2), 200),
    "a flat square": patch((0, 0, 1), (0.5, 0, 0), (0, 0.5, 0)),
    "a flat square seen edge on": patch((0.1, 0, 0), (0.5, 0, 0), (0, 0.5, 0)),
    "whole numbers": np.arange(60).reshape(20, 3),
    "scattered": np.random.default_rng(1).random((300, 3)),
    "tiny": np.random.default_rng(1).random((30, 3)) * 1e-200,
    "huge": np.random.default_rng(1).random((30, 3)) * 1e99,
    "subnormal": np.full((5, 3), 5e-324),
}
"""Clouds, (n, 3), of which hardly anything can be said, by name."""


# --- What is done to clouds -------------------------------------------------------------------------------------------


def random_turn(seed: int) -> Floats:
    """A rotation at random, (3, 3)."""
    return Rotation.random(rng=np.random.default_rng(seed)).as_matrix()


def turned(cloud: Sided, turn: ArrayLike) -> Sided:
    """A cloud and its normals, turned by a rotation vector, (3,) radians."""
    matrix = Rotation.from_rotvec(turn).as_matrix().T
    return Sided(cloud[0] @ matrix, cloud[1] @ matrix)


def joined(*clouds: tuple[Floats, Floats]) -> Sided:
    """Several clouds with their normals as one."""
    return Sided(*(np.concatenate(columns) for columns in zip(*clouds, strict=True)))


def inside_out(cloud: Sided) -> Sided:
    """The same points, seen from the other side."""
    return Sided(cloud.points, -cloud.normals)


def chosen(cloud: Sided, kept: NDArray[np.bool_]) -> Sided:
    """Some points of a cloud, (n,) bool, with their normals."""
    return Sided(cloud.points[kept], cloud.normals[kept])


def thinned(points: Floats, edge: float) -> Floats:
    """One point of each cube of so many metres, so that no law of spacing tells where the sensor was."""
    return points[first_of_cubes(points, edge)]


def first_of_cubes(points: Floats, edge: float) -> NDArray[np.int64]:
    """The index of the first point in each cube of so many metres, cubes in the order of their coordinates."""
    return np.unique(np.floor(points / edge), axis=0, return_index=True)[1]
