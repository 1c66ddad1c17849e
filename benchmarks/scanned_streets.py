# SPDX-License-Identifier: Apache-2.0
"""Streets as LiDARs see them: kerbs, cars, poles, people, trees, hedges, houses; the same for the same seed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scanned_scenes import Floats, Scan, Scene, ball, box, hull, leaves, placed, rod, scan, sphere_of_rays

GROUND, BUILDING, CAR, POLE, PERSON, TREE, HEDGE = "ground", "building", "car", "pole", "person", "tree", "hedge"
KERB_M = 0.12
SENSOR_M = 1.73  # above the road
GLASS = 0.5  # fraction of the rays that a car's or a house's windows do not send back


@dataclass(frozen=True)
class Street:
    """A scene along x with its road's height."""

    scene: Scene
    half_width: float
    phase: float

    def height(self, x: Floats | float, y: Floats | float) -> Floats:
        """Of the ground, metres: slope, undulation, the road's crown, kerbs."""
        x, y = np.asarray(x, np.float64), np.abs(y)
        road = 0.01 * x + 0.08 * np.sin(x / 17.0 + self.phase) - 0.02 * np.minimum(y, self.half_width)
        beside = np.maximum(y - self.half_width - 4.0, 0.0)
        return road + KERB_M * (y > self.half_width) + 0.03 * beside * np.sin(self.phase + x / 40.0)

    def on_ground(self, x: float, y: float) -> Floats:
        return np.array([x, y, float(self.height(x, y))])


def street(seed: int, half_length: float = 100.0) -> Street:
    """A street with parked and driving cars, poles, people, trees, hedges and houses on both sides."""
    rng = np.random.default_rng(seed)
    made = Street(Scene(), float(rng.uniform(4.9, 6.0)), float(rng.uniform(0.0, 6.0)))
    kerb = made.half_width
    _ground(made, half_length + 20.0)
    for side in (-1.0, 1.0):
        x = -0.7 * half_length + rng.uniform(0.0, 6.0)
        while x < 0.7 * half_length:  # parked
            if rng.random() < 0.55:
                _car(made, x, side * (kerb - 1.15 + rng.uniform(-0.1, 0.1)), rng.normal(0.0, 0.03), rng)
            x += rng.uniform(5.6, 7.5)
        for x in np.arange(-0.6 * half_length, 0.6 * half_length, rng.uniform(16.0, 22.0)):
            _pole(made, x + rng.uniform(-2.0, 2.0), side * (kerb + 0.5), rng)
        for x in np.arange(-0.55 * half_length, 0.55 * half_length, 8.0):
            if rng.random() < 0.6:
                _person(made, x + rng.uniform(-3.0, 3.0), side * (kerb + rng.uniform(1.4, 3.0)), rng)
            if rng.random() < 0.35:
                _tree(made, x + 4.0 + rng.uniform(-1.0, 1.0), side * (kerb + rng.uniform(0.9, 1.3)), rng)
        x = -half_length
        while x < half_length:
            width = rng.uniform(11.0, 20.0)
            if rng.random() < 0.75:
                _house(made, x, x + width, side, kerb + rng.uniform(3.8, 4.6), rng)
            else:
                _hedge(made, x + 0.5, x + width - 0.5, side * (kerb + 3.9), rng)
            x += width + rng.choice((0.0, 0.0, 3.0))
    for x in (-48.0, -27.0, -13.0, 11.0, 24.0, 43.0):  # driving
        if rng.random() < 0.7:
            _car(made, x + rng.uniform(-3.0, 3.0), -np.sign(x) * 1.75 * rng.choice((-1.0, 1.0)), 0.0, rng)
    return made


def _ground(made: Street, half_length: float) -> None:
    kerb = made.half_width
    x = np.linspace(-half_length, half_length, 300)
    beside = kerb + np.array([0.03, 2.0, 4.0, 8.0, 20.0, 45.0])  # the kerb's face leans by 3 cm
    half = np.concatenate(([0.0, 1.5, 3.0, kerb], beside))
    y = np.concatenate((-half[:0:-1], half))
    at = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    grid = np.concatenate((at, made.height(at[..., 0], at[..., 1])[..., None]), axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    triangles = np.concatenate((np.stack((a, b, c), axis=2), np.stack((a, c, d), axis=2))).reshape(-1, 3, 3)
    made.scene.add(made.scene.thing(GROUND), triangles)


def _car(made: Street, x: float, y: float, turn: float, rng: np.random.Generator) -> None:
    scene, number = made.scene, made.scene.thing(CAR)
    van = rng.random() < 0.2
    long, wide, high = rng.uniform(3.9, 4.8) / 2.0, rng.uniform(1.66, 1.86) / 2.0, rng.uniform(1.42, 1.6)
    nose = 0.45 if van else 1.05
    high += 0.45 * van
    side = np.array([
        (-long, 0.4), (-long + 0.04, 0.82), (-long + 0.25, 0.92), (long - nose, 0.92), (long - 0.15, 0.72),
        (long, 0.5), (long - 0.05, 0.25), (-long + 0.08, 0.25),
    ])  # fmt: skip
    body = np.concatenate([np.insert(side, 1, s * wide, axis=1) for s in (-1.0, 1.0)])
    rear = 0.1 if van else rng.choice((0.12, 0.75))  # estate or saloon
    waist = [(-long + 0.1 * rear + 0.05, 0.9), (long - nose + 0.1, 0.9)]
    roof = [(-long + rear + 0.15, high), (long - nose - 0.85 + 0.3 * van, high)]
    glass = [(u, s * (wide - 0.03), v) for u, v in waist for s in (-1, 1)]
    glass += [(u, s * (wide - 0.2), v) for u, v in roof for s in (-1, 1)]
    turn += np.pi * (y > 0.0)
    place = made.on_ground(x, y)
    parts = [(hull(body), 0.0), (hull(np.array(glass)), 0.3 if van else GLASS)]
    parts.append((box((roof[0][0], -wide + 0.2, high - 0.02), (roof[1][0], wide - 0.2, high + 0.03)), 0.0))
    for u in (-0.62 * long, 0.64 * long):
        for s in (-1, 1):
            parts.append((rod((u, s * (wide - 0.19), 0.31), (u, s * (wide + 0.01), 0.31), 0.31), 0.0))
    for s in (-1, 1):
        mirror = (long - nose - 0.15, s * (wide + 0.09), 0.98)
        parts.append((ball(mirror, (0.08, 0.11, 0.07)), 0.0))
    for triangles, loss in parts:
        scene.add(number, placed(triangles, place, turn), loss)


def _pole(made: Street, x: float, y: float, rng: np.random.Generator) -> None:
    number, place = made.scene.thing(POLE), made.on_ground(x, y)
    sign = rng.random() < 0.4
    high, radius = (rng.uniform(2.4, 3.0), 0.04) if sign else (rng.uniform(5.0, 8.0), rng.uniform(0.06, 0.1))
    parts = [rod((0, 0, -0.2), (0, 0, high), radius, 0.8 * radius)]
    if sign:
        parts.append(rod((0.05, 0, high - 0.4), (0.07, 0, high - 0.4), 0.32))
    else:
        reach = -np.sign(y) * 1.4
        parts += [
            rod((0, 0, high - 0.1), (0, reach, high + 0.2), 0.04),
            ball((0, reach, high + 0.2), (0.15, 0.4, 0.08)),
        ]
    for part in parts:
        made.scene.add(number, placed(part, place, rng.normal(0.0, 0.1)))


def _person(made: Street, x: float, y: float, rng: np.random.Generator) -> None:
    number, place = made.scene.thing(PERSON), made.on_ground(x, y)
    step, tall = rng.uniform(0.05, 0.3), rng.uniform(0.92, 1.06)
    parts = [ball((0, 0, 1.17), (0.15, 0.22, 0.36)), ball((0, 0, 1.65), (0.1, 0.085, 0.13))]
    parts.append(rod((0, 0, 1.45), (0, 0, 1.6), 0.06))
    for s in (-1, 1):
        parts.append(rod((s * step, s * 0.1, 0.0), (0, s * 0.08, 0.95), 0.06, 0.1))
        parts.append(rod((-s * step * 0.8, s * 0.3, 0.8), (0, s * 0.2, 1.42), 0.04, 0.06))
        parts.append(box((s * step - 0.1, s * 0.1 - 0.05, 0.0), (s * step + 0.18, s * 0.1 + 0.05, 0.08)))
    turn = rng.choice((0.0, np.pi)) + rng.normal(0.0, 0.3)
    for part in parts:
        made.scene.add(number, placed(part * tall, place, turn))


def _tree(made: Street, x: float, y: float, rng: np.random.Generator) -> None:
    number, place = made.scene.thing(TREE), made.on_ground(x, y)
    trunk, radius = rng.uniform(2.2, 3.0), rng.uniform(0.1, 0.2)
    crown = rng.uniform(1.4, 2.4) * np.array([1.0, 1.0, 1.2])
    top = np.array([rng.normal(0.0, 0.15), rng.normal(0.0, 0.15), trunk + 0.75 * crown[2]])
    made.scene.add(number, placed(rod((0, 0, -0.2), (0, 0, trunk), radius, 0.8 * radius), place))
    for _ in range(5):
        end = top + rng.normal(0.0, 0.45, 3) * crown
        made.scene.add(number, placed(rod((0, 0, trunk - 0.1), end, 0.7 * radius, 0.03), place))
    way = rng.standard_normal((int(450 * crown.prod() ** (2 / 3)), 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    lumps = 1.0 + 0.18 * np.sin(3.0 * way @ rng.standard_normal((3, 4)) + rng.uniform(0.0, 6.0, 4)).sum(axis=1)
    at = top + way * (lumps * rng.random(len(way)) ** 0.4)[:, None] * crown
    made.scene.add(number, placed(leaves(at, 0.13, rng), place))


def _hedge(made: Street, start: float, end: float, y: float, rng: np.random.Generator) -> None:
    number, high = made.scene.thing(HEDGE), rng.uniform(1.0, 1.8)
    at = rng.uniform((start, y - 0.4, 0.02), (end, y + 0.4, high), (int(260 * (end - start) * high), 3))
    at[:, 2] += made.height(at[:, 0], at[:, 1])
    made.scene.add(number, leaves(at, 0.1, rng))


def _house(made: Street, start: float, end: float, side: float, front: float, rng: np.random.Generator) -> None:
    """Body, and on its front a plinth, window panes set between piers, sills, at times a balcony, and a roof."""
    scene, number = made.scene, made.scene.thing(BUILDING)
    base, floors = float(made.height((start + end) / 2.0, side * front)) - 1.0, int(rng.integers(2, 5))
    high = base + 1.5 + 3.0 * floors
    parts: list[tuple[tuple[float, ...], tuple[float, ...], float]] = [
        ((start, front + 0.15, base), (end, front + 9.0, high), GLASS),  # seen between the piers: panes
        ((start, front - 0.05, base), (end, front + 0.2, base + 1.5), 0.0),
        ((start - 0.1, front - 0.3, high - 0.3), (end + 0.1, front + 9.3, high + 0.1), 0.0),
    ]
    bays = max(2, round((end - start) / 3.0))
    edges = np.linspace(start, end, bays + 1)
    for k, x in enumerate(edges):
        reach = 0.9 if 0 < k < bays else 0.6
        parts.append(((max(x - reach, start), front, base), (min(x + reach, end), front + 0.2, high), 0.0))
    for floor in range(floors):
        low = base + 1.5 + 3.0 * floor
        parts.append(((start, front, low - 0.1), (end, front + 0.2, low + 0.7), 0.0))
        parts.append(((start, front, low + 2.2), (end, front + 0.2, low + 2.9), 0.0))
        for left, right in pairwise(edges):
            parts.append(((left + 0.8, front - 0.12, low + 0.7), (right - 0.8, front + 0.2, low + 0.76), 0.0))
            if floor > 0 and rng.random() < 0.15:
                parts.append(((left + 0.4, front - 1.1, low - 0.15), (right - 0.4, front, low), 0.0))
                parts.append(((left + 0.4, front - 1.1, low), (right - 0.4, front - 1.04, low + 0.9), 0.2))
    for low, far, loss in parts:
        y = sorted((side * low[1], side * far[1]))
        scene.add(number, box((low[0], y[0], low[2]), (far[0], y[1], far[2])), loss)


def place_over_lane(made: Street) -> Floats:
    """Where a LiDAR stands on the roof of a car in the right lane, (3,)."""
    return made.on_ground(0.0, -1.75) + np.array([0.0, 0.0, SENSOR_M])


def sweep(made: Street, seed: int) -> Scan:
    """One revolution of a 64-beam LiDAR that stands over the right lane; the sensor is the origin of the points."""
    rng = np.random.default_rng(seed)
    place = place_over_lane(made)
    azimuths = np.arange(0.0, 360.0, 0.17) + rng.uniform(0.0, 0.17)
    rays = sphere_of_rays(azimuths, np.linspace(2.0, -24.9, 64))
    found = scan(made.scene, place[None], [rays[rng.random(len(rays)) >= 0.1]], 0.02, rng)
    return Scan(found.points - place, np.zeros_like(found.points), found.things, found.parts)


def drive(made: Street, seed: int, half_length: float = 60.0, step: float = 4.0) -> Scan:
    """Scans every few metres from the roof of a car along the street."""
    rng = np.random.default_rng(seed)
    stops = np.arange(-half_length, half_length + 0.1, step)
    places = [made.on_ground(x, -1.75) + np.array([0.0, 0.0, 2.0]) for x in stops]
    azimuths, elevations = np.arange(0.0, 360.0, 0.5), np.linspace(35.0, -30.0, 66)
    turns = rng.uniform(0.0, 0.5, (len(places), 2))
    rays = [sphere_of_rays(azimuths + a, elevations + e) for a, e in turns]
    return scan(made.scene, np.array(places), rays, 0.01, rng, reach=60.0)
