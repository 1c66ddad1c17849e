# SPDX-License-Identifier: Apache-2.0
"""Exact ray casting: directions of the rays of sensors, and how far along each something is met.

The sensor is at the origin. Directions are (..., 3). Distances are (...,), in lengths of the direction: metres along
rays of unit length, depths along rays with z = 1. They are inf where nothing is met.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


# --- Directions -------------------------------------------------------------------------------------------------------


def turning(elevations: ArrayLike, azimuths: ArrayLike) -> Floats:
    """Unit vectors of a scanner that turns about z, at all pairs of angles, radians: (e a, 3), ring by ring."""
    up, around = np.meshgrid(elevations, azimuths, indexing="ij")
    return np.stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), axis=-1).reshape(-1, 3)


def beams(lowest: float, highest: float, number: int, step: float, first: float = 0.0) -> Floats:
    """Unit vectors of so many beams from the lowest to the highest, a step apart along each, from the azimuth `first`
    on all around; degrees. (n, 3)."""
    return turning(np.radians(np.linspace(lowest, highest, number)), np.radians(np.arange(first, 360.0, step)))


def camera(across: ArrayLike, down: ArrayLike) -> Floats:
    """Rays with z = 1 at all pairs of tangents x/z (w,) and y/z (h,): (h, w, 3)."""
    x, y = np.meshgrid(across, down)
    return np.stack((x, y, np.ones_like(x)), axis=-1)


def pinhole(shape: tuple[int, int], focal: float) -> Floats:
    """Rays with z = 1 through the middles of the pixels of an image (h, w), whose axis is its middle; focal length in
    pixels. (h, w, 3)."""
    down, across = ((np.arange(n) + 0.5 - n / 2.0) / focal for n in shape)
    return camera(across, down)


def axes_of_view(ahead: ArrayLike) -> Floats:
    """Rows: x (right), y (down), z (ahead) of a level camera in a world whose z is up. Camera's rays @ these turn."""
    ahead = np.asarray(ahead, float) / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(ahead, right), ahead))


# --- Distances --------------------------------------------------------------------------------------------------------


def to_plane(rays: Floats, normal: ArrayLike, offset: float) -> Floats:
    """Distances to the plane normal . x = offset."""
    a, b, c = np.asarray(normal, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = offset / (a * rays[..., 0] + b * rays[..., 1] + c * rays[..., 2])
    return np.where(distances > 0.0, distances, np.inf)


def _entry_and_exit(rays: Floats, low: ArrayLike, high: ArrayLike) -> tuple[Floats, Floats]:
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.asarray(low, float) / rays, np.asarray(high, float) / rays
    return np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)


def to_box(rays: Floats, low: ArrayLike, high: ArrayLike, nearest: float = 0.0) -> Floats:
    """Distances to the outside of a box between two corners; a box nearer than `nearest` is not met."""
    entry, leave = _entry_and_exit(rays, low, high)
    return np.where((entry < leave) & (entry > nearest), entry, np.inf)


def to_walls(rays: Floats, low: ArrayLike, high: ArrayLike) -> Floats:
    """Distances to the inside of a box between two corners, in which the sensor is."""
    return _entry_and_exit(rays, low, high)[1]


def to_turned_box(rays: Floats, middle: ArrayLike, size: ArrayLike, yaw: float) -> Floats:
    """Distances to a box of a size (3,) about its middle, turned about z by so many radians."""
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    place, half = turn @ np.asarray(middle, float), np.asarray(size, float) / 2.0
    return to_box(rays @ turn.T, place - half, place + half)


def to_ball(rays: Floats, middle: ArrayLike, radius: float) -> Floats:
    """Distances to a ball."""
    middle = np.asarray(middle, float)
    along, square = rays @ middle, (rays * rays).sum(axis=-1)
    inside = along * along - square * (middle @ middle - radius * radius)
    return np.where(inside > 0.0, (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf)


def to_can(rays: Floats, middle: ArrayLike, radius: float, half_height: float) -> Floats:
    """Distances to an upright can, seen from above its lower end: to its wall and its top."""
    x, y, z = np.asarray(middle, float)
    square = (rays[..., :2] ** 2).sum(axis=-1)
    along = rays[..., 0] * x + rays[..., 1] * y
    inside = along**2 - square * (x * x + y * y - radius**2)
    wall = np.where(inside > 0.0, (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf)
    on_wall = np.abs(np.where(np.isfinite(wall), wall, 0.0) * rays[..., 2] - z) <= half_height
    top = to_plane(rays, (0.0, 0.0, 1.0), z + half_height)
    at = np.where(np.isfinite(top), top, 0.0)[..., None] * rays[..., :2] - (x, y)
    on_top = (at**2).sum(axis=-1) <= radius**2
    return np.minimum(np.where(on_wall & (wall > 0.0), wall, np.inf), np.where(on_top, top, np.inf))


def nearest_of(*distances: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """The least of several distances, (...,), and which of them it is, -1 where nothing is met."""
    all_of_them = np.stack(distances)
    which = all_of_them.argmin(axis=0)
    least = all_of_them.min(axis=0)
    return least, np.where(np.isfinite(least), which, -1)
