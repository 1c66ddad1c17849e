# SPDX-License-Identifier: Apache-2.0
"""Outdoors, as scanners that turn see it: the scanner is at the origin unless told."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from scenes.rays import beams, nearest_of, to_box, to_plane, to_turned_box, turning
from scenes.surfaces import UP, Floats, Labelled

REACH = 60.0
"""Metres: what is farther off is not measured."""


def ground_and_wall(seed: int = 0, n: int = 160) -> Floats:
    """Ground 1.5 m below the scanner and a wall 12 m ahead, as beams of constant angle meet them, (m, 3)."""
    rng = np.random.default_rng(seed)
    rays = turning(-np.linspace(-0.3, 1.1, n), np.linspace(-np.pi, np.pi, 3 * n))
    rays = rays + rng.normal(0, 1e-3, rays.shape)
    ranges = np.minimum(to_plane(rays, UP, -1.5), to_plane(rays, (1, 0, 0), 12.0))
    return (rays * ranges[:, None])[ranges < REACH]


def rings_ahead(seed: int) -> Floats:
    """Ground, a wall and six boxes in the 90 degrees before a 64-beam LiDAR 1.7 m above the ground, 2 cm of noise."""
    rng = np.random.default_rng(seed)
    rays = turning(np.radians(np.linspace(-24.8, 2.0, 64)), np.radians(np.arange(-45, 45, 0.2)))
    met = [to_plane(rays, UP, -1.7), to_plane(rays, (0, 1, 0), 8.0)]
    for _ in range(6):
        low = np.array([rng.uniform(6, 35), rng.uniform(-9, 4), -1.7])
        met.append(to_box(rays, low, low + rng.uniform((1.5, 1.5, 1.0), (4.5, 2.0, 2.0))))
    ranges, _ = nearest_of(*met)
    ranges += rng.normal(0, 0.02, ranges.shape)
    return (rays * ranges[:, None])[ranges < REACH]


def rings_of_ground(rings: int = 20, n: int = 1000) -> Floats:
    """Rings of ground, n points each, around a scanner at (0, 0, 2), as thin with range as a scanner sees it."""
    angle, down = np.meshgrid(np.linspace(0, 2 * np.pi, n, endpoint=False), np.linspace(0.04, 0.9, rings))  # radians
    reach = 2.0 / np.tan(down)
    return np.stack((reach * np.cos(angle), reach * np.sin(angle), np.zeros(angle.shape)), axis=-1).reshape(-1, 3)


def ground_before_a_ramp(seed: int, elevations: ArrayLike, tilt: float, slope: float) -> tuple[Floats, Floats]:
    """A street 30 m wide whose ground rises by a slope from x = 10 m on, and the place of the scanner, 1.8 m above it.

    elevations : of the beams, degrees. tilt : of the scanner about y, degrees. 2 cm of noise.
    """
    rng, place = np.random.default_rng(seed), np.array([0.0, 0.0, 1.8])
    rays = turning(np.radians(elevations), np.radians(np.arange(0.1, 360.0, 0.2)))
    rays = rays @ Rotation.from_euler("y", tilt, degrees=True).as_matrix().T
    level, ramp = to_plane(rays, UP, -1.8), to_plane(rays, (-slope, 0, 1), -1.8 - 10.0 * slope)
    with np.errstate(invalid="ignore"):  # a ray along the street meets nothing, at no x
        level = np.where(level * rays[:, 0] < 10.0, level, np.inf)
        ramp = np.where(ramp * rays[:, 0] >= 10.0, ramp, np.inf)
    walls = [to_plane(rays, (0, 1, 0), y) for y in (15.0, -15.0)]
    ranges = nearest_of(level, ramp, *walls)[0] + rng.normal(0.0, 0.02, len(rays))
    return (rays * ranges[:, None])[ranges < 80.0] + place, place


def height_before_a_ramp(x: Floats, slope: float) -> Floats:
    """Height of the ground of `ground_before_a_ramp` below each x, metres."""
    return slope * np.maximum(x - 10.0, 0.0)


def lot(
    n_beams: int, lowest: float, highest: float, cars: list[tuple[float, float, float]], rng: np.random.Generator
) -> Labelled:
    """A lot with two buildings, a wall (-1) and cars (0, 1, ...), each given by its middle (x, y) and yaw, from 1.8 m
    above it by so many beams, elevations in degrees; 2 cm of noise."""
    things = [(14.0, 20.0, 0.3, 12.0, 8.0, 5.0), (-30.0, 5.0, 1.0, 10.0, 10.0, 6.0), (0.0, -28.0, 0.0, 30.0, 1.0, 2.0)]
    things += [(*car, 4.4, 1.8, 1.5) for car in cars]
    rays = beams(lowest, highest, n_beams, 0.2)
    met = [to_turned_box(rays, (x, y, size[2] / 2.0 - 1.8), size, yaw) for x, y, yaw, *size in things]
    ranges, which = nearest_of(to_plane(rays, UP, -1.8), *met)
    seen = ranges < 80.0
    points = rays[seen] * (ranges[seen] + rng.normal(0.0, 0.02, seen.sum()))[:, None]
    return Labelled(points, np.maximum(which[seen] - 4, -1))


def cartons(seed: int, apart: float) -> Labelled:
    """Six equal cartons (0 to 5) in a row, so many metres apart, on the ground before a wall (-1), from a tripod 1.7 m
    above it; 3 mm of noise."""
    rng = np.random.default_rng(seed)
    rays = turning(np.radians(np.arange(-60, 20, 0.3)), np.radians(np.arange(20, 160, 0.3)))
    met = [to_plane(rays, UP, -1.7), to_plane(rays, (0, 1, 0), 4.5)]
    for k in range(6):
        low = np.array([(k - 2.5) * (0.5 + apart) - 0.25, 3.25 + rng.normal(0.0, 0.004), -1.7])
        met.append(to_box(rays, low, low + np.array([0.5, 0.5, 0.6])))
    ranges, which = nearest_of(*met)
    near = ranges < 8.0
    points = (rays * (ranges + rng.normal(0.0, 0.003, len(ranges)))[:, None])[near]
    return Labelled(points, np.maximum(which[near] - 2, -1))
