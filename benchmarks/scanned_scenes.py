# SPDX-License-Identifier: Apache-2.0
"""Scenes as laser scanners see them, by ray casting: what each point belongs to is known exactly.

Everything is made of convex solids, each the hull of a few points; leaves are loose triangles. Rooms are in
`scanned_rooms.py`, streets in `scanned_streets.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Floats = NDArray[np.float64]


@dataclass
class Scene:
    """Triangles with what they belong to.

    Attributes
    ----------
    kinds : list of str
        Of each thing.
    tints : list of (3,) uint8
        Colour of each thing.
    corners : list of (t, 3, 3) float64, metres
        Triangles of each part.
    things : list of int
        Thing of each part.
    losses : list of float
        Fraction of the rays that a part does not send back.
    """

    kinds: list[str] = field(default_factory=list)
    tints: list[NDArray[np.uint8]] = field(default_factory=list)
    corners: list[Floats] = field(default_factory=list)
    things: list[int] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)

    def thing(self, kind: str, tint: tuple[int, int, int] = (128, 128, 128)) -> int:
        """Number of a new thing without parts."""
        self.kinds.append(kind)
        self.tints.append(np.array(tint, np.uint8))
        return len(self.kinds) - 1

    def add(self, thing: int, triangles: Floats, loss: float = 0.0) -> None:
        """One more part of a thing."""
        self.corners.append(triangles)
        self.things.append(thing)
        self.losses.append(loss)

    def numbers(self, *kinds: str) -> NDArray[np.int64]:
        """Things of some kinds."""
        return np.flatnonzero(np.isin(self.kinds, kinds))


@dataclass(frozen=True, eq=False)
class Scan:
    """Points of one or more places.

    Attributes
    ----------
    points, origins : (n, 3) float64, metres
        Noisy points, and where the sensor stood.
    things, parts : (n,) int32
    """

    points: Floats
    origins: Floats
    things: NDArray[np.int32]
    parts: NDArray[np.int32]


def scan(
    scene: Scene, places: Floats, directions: list[Floats], noise: float, rng: np.random.Generator, reach: float = 100.0
) -> Scan:
    """What is hit by rays from each place, unit directions (r, 3) each, with noise along the ray, metres."""
    caster, part_of_triangle = caster_of(scene)
    losses, things = np.array(scene.losses), np.array(scene.things)
    columns = []
    for place, along in zip(places, directions, strict=True):
        rays = np.concatenate((np.broadcast_to(place, along.shape), along), axis=1).astype(np.float32)
        answer = caster.cast_rays(rays)
        distance, triangle = answer["t_hit"].numpy().astype(np.float64), answer["primitive_ids"].numpy()
        hit = np.flatnonzero(distance < reach)
        part = part_of_triangle[triangle[hit]]
        kept = rng.random(len(hit)) >= losses[part]
        hit, part = hit[kept], part[kept]
        measured = distance[hit] + noise * rng.standard_normal(len(hit))
        points = place + along[hit] * measured[:, None]
        columns.append((points, np.broadcast_to(place, points.shape), things[part], part))
    points, origins, thing, part = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Scan(points, origins, thing.astype(np.int32), part.astype(np.int32))


def caster_of(scene: Scene) -> tuple[Any, NDArray[np.int64]]:
    """Open3D's ray caster for a scene, and the part of each triangle, (t,)."""
    import open3d as o3d

    caster = o3d.t.geometry.RaycastingScene()
    corners = np.concatenate(scene.corners).reshape(-1, 3).astype(np.float32)
    caster.add_triangles(corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
    return caster, np.repeat(np.arange(len(scene.corners)), [len(part) for part in scene.corners])


def sphere_of_rays(azimuths: Floats, elevations: Floats) -> Floats:
    """Unit directions (a e, 3) of a scanner that turns about z; degrees."""
    a, e = np.meshgrid(azimuths, elevations, indexing="ij")
    return rays_at(a.ravel(), e.ravel())


def rays_at(azimuths: Floats, elevations: Floats) -> Floats:
    """Unit vectors (n, 3) at azimuths about z and elevations (n,), degrees."""
    a, e = np.radians(azimuths), np.radians(elevations)
    return np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=1)


# --- Solids: triangles (t, 3, 3), metres --------------------------------------------------------------------------


def hull(points: Floats) -> Floats:
    """Convex hull of points (p, 3)."""
    points = np.asarray(points, np.float64)
    return points[ConvexHull(points).simplices]


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Floats:
    """Box between two corners."""
    return hull(np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3))


def rod(start: Floats | tuple[float, ...], end: Floats | tuple[float, ...], *radii: float) -> Floats:
    """Cylinder, or cone frustum with two radii, between two places."""
    ends = np.array([start, end], np.float64)
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    u = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    u /= np.linalg.norm(u)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)[:, None]
    ring = np.cos(angle) * u + np.sin(angle) * np.cross(axis, u)
    return hull(np.concatenate((ends[0] + radii[0] * ring, ends[1] + radii[-1] * ring)))


def ball(centre: Floats | tuple[float, ...], radii: tuple[float, float, float]) -> Floats:
    """Ellipsoid."""
    k = np.arange(200)
    z, angle = 1.0 - (2.0 * k + 1.0) / len(k), np.pi * (3.0 - np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z**2)
    return hull(np.asarray(centre) + np.stack((across * np.cos(angle), across * np.sin(angle), z), 1) * radii)


def leaves(places: Floats, size: float, rng: np.random.Generator) -> Floats:
    """A triangle of a random attitude at each place."""
    return places[:, None] + size * rng.standard_normal((len(places), 3, 3)) / np.sqrt(3.0)


def placed(triangles: Floats, place: Floats | tuple[float, ...], turn: float = 0.0) -> Floats:
    """Triangles turned about z, radians, and moved."""
    c, s = np.cos(turn), np.sin(turn)
    return triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + np.asarray(place)
