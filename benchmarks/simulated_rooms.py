# SPDX-License-Identifier: Apache-2.0
"""Rooms as a depth camera would see them, by exact ray casting in NumPy: classes and planes are known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CLASSES = ("floor", "wall", "table", "box", "sphere", "cylinder")


@dataclass(frozen=True)
class Room:
    """One view of a room, in the camera's frame (x right, y down, z forward; origin at the camera).

    Attributes
    ----------
    points : (h, w, 3) float64, metres
        NaN where a ray meets nothing.
    colors : (h, w, 3) float64, 0..1
        One random colour per thing, whatever its class, with noise.
    classes, things : (h, w) int32
        Index into `CLASSES`, and number of the thing; -1 where a ray meets nothing.
    up : (3,) float64
        The floor's normal.
    floor, table : float, metres
        Position of the floor and of the table's top along `up`.
    radii : (t,) float64, metres
        Of each thing, if it is a sphere or a cylinder; NaN otherwise.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.float64]
    classes: NDArray[np.int32]
    things: NDArray[np.int32]
    up: NDArray[np.float64]
    floor: float
    table: float
    radii: NDArray[np.float64]


def room(seed: int, noise: float = 0.0015, shape: tuple[int, int] = (240, 320)) -> Room:
    """A room with two walls, a table, and six to ten boxes, spheres and cylinders on table and floor.

    Parameters
    ----------
    seed : int
    noise : float, metres at 1 m
        Standard deviation along the ray; grows with the square of the distance, as a Kinect's does.
    shape : (h, w)
    """
    rng = np.random.default_rng(seed)
    things, height = _things(rng)
    yaw, pitch = rng.uniform(-0.5, 0.5), rng.uniform(0.55, 0.8)
    forward = np.array([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    axes = np.stack((right, np.cross(forward, right), forward))  # rows: the camera's x, y (down), z in the world
    eye = np.array([0.0, 0.0, height]) - forward * rng.uniform(1.3, 1.7)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    pixel = np.stack((columns - shape[1] / 2 + 0.5, rows - shape[0] / 2 + 0.5), axis=-1) / (0.9 * shape[1])
    rays = np.concatenate((pixel, np.ones((*shape, 1))), axis=-1)
    directions = rays @ axes
    depth, thing = np.full(shape, np.inf), np.full(shape, -1, np.int32)
    for number, (_, kind, place, size, turn) in enumerate(things):
        hit = _CAST[kind](eye, directions, place, size, turn)
        nearer = hit < depth
        depth[nearer], thing[nearer] = hit[nearer], number
    seen = np.isfinite(depth)
    distance = np.where(seen, depth, np.nan) * np.linalg.norm(rays, axis=-1)
    noisy = distance + noise * distance**2 * rng.standard_normal(shape)
    points = rays / np.linalg.norm(rays, axis=-1, keepdims=True) * noisy[..., None]
    shades = rng.uniform(0.1, 0.9, (len(things) + 1, 3))
    colors = np.clip(shades[thing] + 0.03 * rng.standard_normal((*shape, 3)), 0.0, 1.0)
    classes = np.array([CLASSES.index(entry[0]) for entry in things] + [-1], np.int32)[thing]
    up = axes[:, 2].copy()
    radii = np.array([size[0] if kind in ("sphere", "cylinder") else np.nan for _, kind, _, size, _ in things])
    return Room(points, colors, classes, thing, up, float(-eye[2]), float(height - eye[2]), radii)


_Thing = tuple[str, str, NDArray[np.float64], NDArray[np.float64], float]


def _things(
    rng: np.random.Generator,
) -> tuple[list[tuple[str, str, NDArray[np.float64], NDArray[np.float64], float]], float]:
    """Class, shape, centre, size and turn of all things, metres; and the height of the table."""
    height = rng.uniform(0.65, 0.85)
    half = np.array([rng.uniform(0.4, 0.6), rng.uniform(0.3, 0.45), 0.015])
    back, side = rng.uniform(0.7, 1.2), rng.uniform(0.8, 1.3) * rng.choice((-1.0, 1.0))
    things = [
        ("floor", "box", np.array([0.0, 0.0, -0.05]), np.array([20.0, 20.0, 0.05]), 0.0),
        ("wall", "box", np.array([0.0, back + 0.05, 0.0]), np.array([20.0, 0.05, 20.0]), 0.0),
        ("wall", "box", np.array([side + np.sign(side) * 0.05, 0.0, 0.0]), np.array([0.05, 20.0, 20.0]), 0.0),
        ("table", "box", np.array([0.0, 0.0, height - 0.015]), half, 0.0),
        ("table", "box", np.array([0.0, 0.0, height / 2 - 0.015]), np.array([0.05, 0.05, height / 2 - 0.015]), 0.0),
    ]
    taken: list[tuple[NDArray[np.float64], float, float]] = []
    for _ in range(int(rng.integers(6, 11))):
        kind = str(rng.choice(("box", "sphere", "cylinder")))
        on_table = bool(rng.random() < 0.75)
        scale = 1.0 if on_table else 1.6
        for _ in range(30):
            size = scale * rng.uniform(0.04, 0.11, 3)
            if kind == "sphere":
                size[:] = size[0]
            if kind == "cylinder":
                size[1] = size[0]
            radius = float(np.hypot(size[0], size[1]))
            reach = half[:2] - radius if on_table else np.array([0.9 * abs(side), 0.8])
            place = rng.uniform(-reach, reach)
            base = height if on_table else 0.0
            clear = all(base != b or np.linalg.norm(place - p) > radius + r + 0.02 for p, r, b in taken)
            if clear and (on_table or (np.abs(place) > half[:2] + 0.15).any()):
                taken.append((place, radius, base))
                center = np.append(place, base + size[2])
                things.append((kind, kind, center, size, float(rng.uniform(0.0, np.pi))))
                break
    return things, height


def _turned(eye, directions, place, turn):  # type: ignore[no-untyped-def]
    c, s = np.cos(turn), np.sin(turn)
    back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return back @ (eye - place), directions @ back.T


def _cast_box(eye, directions, place, size, turn):  # type: ignore[no-untyped-def]
    origin, along = _turned(eye, directions, place, turn)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-size - origin) / along, (size - origin) / along
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    return np.where((enter <= leave) & (enter > 0.0), enter, np.inf)


def _cast_sphere(eye, directions, place, size, turn):  # type: ignore[no-untyped-def]
    return _quadric(eye - place, directions, size[0], 3)[0]


def _cast_cylinder(eye, directions, place, size, turn):  # type: ignore[no-untyped-def]
    origin = eye - place
    wall, _ = _quadric(origin, directions, size[0], 2)
    on_wall = np.abs(origin[2] + np.where(np.isfinite(wall), wall, 0.0) * directions[..., 2]) <= size[2]
    wall = np.where(on_wall, wall, np.inf)
    with np.errstate(divide="ignore"):
        top = (size[2] - origin[2]) / directions[..., 2]
    disc = origin[:2] + top[..., None] * directions[..., :2]
    on_top = (top > 0.0) & ((disc**2).sum(axis=-1) <= size[0] ** 2)
    return np.minimum(wall, np.where(on_top, top, np.inf))


def _quadric(origin, directions, radius, dimensions):  # type: ignore[no-untyped-def]
    """Where rays first meet a sphere (3 dimensions) or an endless upright cylinder (2), and their discriminant."""
    o, d = origin[:dimensions], directions[..., :dimensions]
    a, b, c = (d**2).sum(axis=-1), d @ o, o @ o - radius**2
    inside = b**2 - a * c
    first = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
    return np.where((inside >= 0.0) & (first > 0.0), first, np.inf), inside


_CAST = {"box": _cast_box, "sphere": _cast_sphere, "cylinder": _cast_cylinder}
