# SPDX-License-Identifier: Apache-2.0
"""A synthetic row of rooms with any number of points, for times and memory: same seed, same points; no file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SPACING_M = 0.008
JITTER = 0.25  # of the spacing, either way along the surface
NOISE_M = 0.001  # standard deviation, in all directions
SIDE_M, WALL_M = 5.0, 2.5
CELLS = 4  # squared: pieces of furniture in a room

Patch = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]  # corner and two sides, metres


def rooms(n: int, seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points (n, 3) float32, metres, z up, surface by surface, and their colours (n, 3) uint8.

    Rooms of 5 m by 5 m with walls of 2.5 m stand in a row along x: in each 16 pieces of furniture, be it a table (top
    and four legs) with a box on it, a box or a ball. Surfaces are sampled on a lattice of 8 mm, jittered by a quarter
    of that, with noise of 1 mm. The row ends where n points are reached, so that the density is the same for all n;
    the first room has 1.3 million.
    """
    rng = np.random.default_rng(seed)
    points: list[NDArray[np.float32]] = []
    colors: list[NDArray[np.uint8]] = []
    count = 0
    while count < n:
        surfaces = _room(SIDE_M * len(points), rng)
        tints = rng.integers(40, 216, (len(surfaces), 3), np.uint8)
        points.append(np.concatenate(surfaces).astype(np.float32))
        colors.append(np.repeat(tints, [len(surface) for surface in surfaces], axis=0))
        count += len(points[-1])
    kept = np.sort(np.argsort(points[-1][:, 0], kind="stable")[: len(points[-1]) - (count - n)])
    points[-1], colors[-1] = points[-1][kept], colors[-1][kept]
    position, color = np.concatenate(points), np.concatenate(colors)
    position += rng.standard_normal(position.shape, np.float32) * np.float32(NOISE_M)
    return position, color + rng.integers(0, 12, color.shape, np.uint8)


def _room(start: float, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    corner, (x, y) = np.array([start, 0.0, 0.0]), SIDE_M * np.eye(3)[:2]
    z = np.array([0.0, 0.0, WALL_M])
    surfaces = [
        _sample(patch, rng) for patch in ((corner, x, y), (corner, x, z), (corner + y, x, z), (corner + x, y, z))
    ]
    cell = SIDE_M / CELLS
    for i in range(CELLS):
        for j in range(CELLS):
            surfaces.extend(_furniture(corner[:2] + cell * (np.array([i, j]) + 0.5), rng))
    return surfaces


def _furniture(centre: NDArray[np.float64], rng: np.random.Generator) -> list[NDArray[np.float64]]:
    kind, turn = rng.integers(3), rng.uniform(0.0, np.pi)
    if kind == 0:
        return [_ball(np.append(centre, 0.3), 0.3, rng)]
    if kind == 1:
        return _box(np.append(centre, 0.0), np.array([0.6, 0.5, 0.7]), turn, rng)
    parts = _box(np.append(centre, 0.70), np.array([0.8, 0.6, 0.04]), turn, rng)
    parts += _box(np.append(centre, 0.74), np.array([0.3, 0.2, 0.25]), turn + 0.5, rng)
    for corner in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        foot = centre + _turned(np.array(corner) * (0.36, 0.26), turn)
        parts += _box(np.append(foot, 0.0), np.array([0.05, 0.05, 0.7]), turn, rng)
    return parts


def _box(
    foot: NDArray[np.float64], size: NDArray[np.float64], turn: float, rng: np.random.Generator
) -> list[NDArray[np.float64]]:
    """Five faces of a box as one part; `foot` is the centre of its lower face, which is left out."""
    a, b = (np.append(_turned(side, turn), 0.0) for side in (np.array([size[0], 0.0]), np.array([0.0, size[1]])))
    up = np.array([0.0, 0.0, size[2]])
    corner = foot - (a + b) / 2.0
    faces = [(corner + up, a, b), (corner, a, up), (corner, b, up), (corner + b, a, up), (corner + a, b, up)]
    return [np.concatenate([_sample(face, rng) for face in faces])]


def _ball(centre: NDArray[np.float64], radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """A sphere, sampled along a spiral with about the same spacing everywhere."""
    count = int(4.0 * np.pi * radius**2 / SPACING_M**2)
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    across = np.sqrt(1.0 - z**2)
    normals = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    return centre + radius * normals + rng.uniform(-JITTER, JITTER, (count, 3)) * SPACING_M


def _sample(patch: Patch, rng: np.random.Generator) -> NDArray[np.float64]:
    corner, a, b = patch
    counts = [max(1, round(float(np.linalg.norm(side)) / SPACING_M)) for side in (a, b)]
    u, v = np.meshgrid(*((np.arange(k) + 0.5) for k in counts), indexing="ij")
    u, v = ((w + rng.uniform(-JITTER, JITTER, w.shape)).ravel()[:, None] for w in (u, v))
    return corner + a * (u / counts[0]) + b * (v / counts[1])


def _turned(vector: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    c, s = np.cos(turn), np.sin(turn)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
