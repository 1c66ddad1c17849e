# SPDX-License-Identifier: Apache-2.0
"""Scenes of kinds that pcgraph was not developed on: no constant was chosen, and none changed, after a look at them.

A plant, a warehouse, a table before a stereo camera, bales of hay from the air, a turntable, the front of a house, a
walk with drift, power lines. Every thing that a person would name is judged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scanned_scenes import Floats, Scan, Scene, ball, box, placed, rod, scan, sphere_of_rays
from scipy.spatial.transform import Rotation

Place = tuple[float, float, float]


def plant() -> Scan:
    """Pipes, tanks, columns and a pump before a wall, from three tripods."""
    scene = Scene()
    _alone(scene, box((-6.0, -5.0, -0.1), (6.0, 5.0, 0.0)), box((-6.0, 5.0, 0.0), (6.0, 5.1, 4.0)))
    for i in range(5):
        y, z = 3.2 + 0.3 * i, 2.2 + 0.3 * (i % 2)
        _alone(scene, rod((-6.0, y, z), (6.0, y, z), 0.06 + 0.03 * i))
    for i in range(4):
        _alone(scene, rod((-4.0 + 2.5 * i, 1.5, 0.0), (-4.0 + 2.5 * i, 1.5, 3.2), 0.08 + 0.02 * i))
    for i in range(3):
        _alone(scene, rod((-4.0 + 4.0 * i, -2.5, 0.3), (-4.0 + 4.0 * i, -2.5, 2.3), 0.8))
    _alone(scene, rod((0.0, -1.0, 1.2), (3.0, -1.0, 1.2), 0.15), box((3.2, -0.3, 0.0), (4.0, 0.5, 0.9)))
    _alone(scene, box((-2.0, 2.6, 0.0), (-1.4, 3.0, 1.8)))
    return _from_tripods(scene, [(-2.0, 0.0, 1.6), (2.0, 0.4, 1.6), (0.0, -4.0, 1.7)], 0.5, 0.003)


def warehouse() -> Scan:
    """Two racks with cartons on pallets, from four places in the aisles."""
    scene, rng = Scene(), np.random.default_rng(0)
    _alone(scene, box((-1.0, -1.0, -0.1), (13.0, 9.0, 0.0)))
    for y in (2.0, 5.5):
        rack = scene.thing("rack")
        for side in (y, y + 1.0):
            for i in range(5):
                scene.add(rack, box((2.8 * i, side, 0.0), (2.8 * i + 0.1, side + 0.1, 4.5)))
            for z in (1.5, 3.0, 4.4):
                scene.add(rack, box((0.0, side, z), (11.3, side + 0.06, z + 0.12)))
        for i, z, k in np.ndindex(4, 3, 2):
            x, low, high = 2.8 * i + 1.25 * k + 0.25, (0.0, 1.62, 3.12)[z], rng.uniform(0.6, 1.2)
            if rng.random() < 0.85:
                _alone(scene, box((x, y + 0.05, low), (x + 1.1, y + 0.95, low + high)))
    return _from_tripods(scene, [(1.0, 0.3, 1.6), (9.0, 0.5, 1.6), (3.0, 4.6, 1.6), (10.0, 4.5, 1.6)], 0.5, 0.004)


def stereo_table() -> Scan:
    """Eight things on a table before a wall, from a stereo camera whose disparities are eighths of a pixel."""
    scene, random = Scene(), np.random.default_rng(0)
    _alone(scene, box((-3.0, -2.0, 3.0), (3.0, 2.0, 3.1)), box((-1.2, 0.45, 0.8), (1.2, 0.5, 2.2)))
    for i in range(8):
        x, z, high = -0.9 + 0.26 * i, 1.1 + 0.3 * (i % 3), 0.12 + 0.05 * (i % 4)
        shapes = (
            box((x - 0.07, 0.45 - high, z - 0.07), (x + 0.07, 0.45, z + 0.07)),
            rod((x, 0.45 - high, z), (x, 0.45, z), 0.06),
            ball((x, 0.37, z), (0.08, 0.08, 0.08)),
        )
        _alone(scene, shapes[i % 3])
    focal, baseline = 525.0, 0.12
    u, v = np.meshgrid(np.arange(640) - 319.5, np.arange(480) - 239.5)
    rays = np.stack((u, v, np.full(u.shape, focal)), axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = scan(scene, np.zeros((1, 3)), [rays], 0.0, random)
    z = found.points[:, 2]
    disparity = np.rint(8.0 * (focal * baseline / z + random.normal(0.0, 0.05, len(z)))) / 8.0
    return replace(found, points=found.points * (focal * baseline / (disparity * z))[:, None])


def hay_bales() -> Scan:
    """Twenty-five bales on rolling ground, from a drone."""
    scene, random = Scene(), np.random.default_rng(0)

    def height(x: Floats | float, y: Floats | float) -> Floats:
        return np.asarray(0.8 * np.sin(np.asarray(x) / 9.0) + 0.6 * np.cos(np.asarray(y) / 7.0))

    x, y = np.meshgrid(np.linspace(0.0, 60.0, 121), np.linspace(0.0, 60.0, 121))
    knots = np.stack((x, y, height(x, y)), axis=-1)
    a, b, c, d = knots[:-1, :-1], knots[:-1, 1:], knots[1:, 1:], knots[1:, :-1]
    _alone(scene, np.concatenate([np.stack(t, axis=-2).reshape(-1, 3, 3) for t in ((a, b, c), (a, c, d))]))
    for x0, y0, turn in random.uniform((4.0, 4.0, 0.0), (56.0, 56.0, np.pi), (25, 3)):
        place = (x0, y0, float(height(x0, y0)) + 0.6)
        _alone(scene, placed(rod((-0.6, 0.0, 0.0), (0.6, 0.0, 0.0), 0.62), place, turn))
    places = np.stack(np.meshgrid((10.0, 30.0, 50.0), (10.0, 30.0, 50.0), 40.0), axis=-1).reshape(-1, 3)
    return _towards(scene, places, [random.uniform((0, 0, 0), (60, 60, 0), (14_000, 3)) for _ in places], 0.03)


def turntable() -> Scan:
    """Six things that touch each other on a plate, from a ring of ten cameras."""
    scene = Scene()
    _alone(scene, rod((0.0, 0.0, -0.02), (0.0, 0.0, 0.0), 0.25))
    _alone(scene, box((-0.05, -0.05, 0.0), (0.05, 0.05, 0.12)), ball((0.105, 0.0, 0.055), (0.055, 0.055, 0.055)))
    _alone(scene, rod((-0.09, 0.0, 0.0), (-0.09, 0.0, 0.15), 0.04), box((-0.04, 0.05, 0.0), (0.06, 0.13, 0.06)))
    _alone(scene, ball((0.0, -0.1, 0.05), (0.05, 0.05, 0.05)), rod((0.0, 0.0, 0.12), (0.0, 0.0, 0.2), 0.03))
    places, targets = [], []
    for angle in np.arange(0.0, 2.0 * np.pi, 0.2 * np.pi):
        place = np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.5])
        right = np.array([-np.sin(angle), np.cos(angle), 0.0])
        down = np.cross(-place / np.linalg.norm(place), right)
        u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(*2 * (np.linspace(-0.3, 0.3, 130),)))
        places.append(place)
        targets.append(u * right + v * down)
    return _towards(scene, np.array(places), targets, 0.0004)


def house_front() -> Scan:
    """Fifteen windows and eight balconies, denser below, from photographs taken along the street."""
    scene, random = Scene(), np.random.default_rng(0)
    _alone(scene, box((0.0, 0.0, 0.0), (20.0, 0.3, 12.0)), box((-2.0, -8.0, -0.2), (22.0, 0.0, 0.0)))
    for i, j in np.ndindex(5, 3):
        x, z = 1.5 + 3.7 * i, 1.5 + 3.6 * j
        _alone(scene, box((x, -0.12, z), (x + 1.6, 0.0, z + 2.0)))
        if (i + j) % 2 == 0:
            _alone(scene, box((x - 0.3, -1.2, z - 0.35), (x + 1.9, -0.12, z - 0.2)))
    places = np.stack((np.linspace(-2.0, 22.0, 7), np.full(7, -9.0), random.uniform(2.0, 4.0, 7)), axis=1)
    targets = []
    for _ in places:
        wall = np.stack((random.uniform(-2.0, 22.0, 18_000), np.zeros(18_000), 12.0 * random.random(18_000) ** 1.3), 1)
        targets.append(np.concatenate((wall, random.uniform((-2.0, -8.0, 0.0), (22.0, 0.0, 0.0), (4_000, 3)))))
    return _towards(scene, places, targets, 0.012)


def drifting_walk() -> Scan:
    """Two rooms, the second half of the walk through them off by 2 cm and 0.3 degrees, so that walls are doubled."""
    scene = Scene()
    _alone(scene, box((0.0, 0.0, -0.1), (9.0, 4.0, 0.0)), box((0.0, 0.0, 2.5), (9.0, 4.0, 2.6)))
    _alone(scene, box((0.0, -0.1, 0.0), (9.0, 0.0, 2.5)), box((0.0, 4.0, 0.0), (9.0, 4.1, 2.5)))
    _alone(scene, box((-0.1, 0.0, 0.0), (0.0, 4.0, 2.5)), box((9.0, 0.0, 0.0), (9.1, 4.0, 2.5)))
    _alone(scene, box((4.4, 0.0, 0.0), (4.5, 2.8, 2.5)))
    furniture = ((1.7, 0.85, 1.4, 0.7, 0.74), (3.3, 3.45, 0.6, 0.9, 1.8), (6.8, 1.4, 1.6, 0.8, 0.45))
    furniture += ((8.25, 3.25, 0.5, 0.5, 0.9), (5.95, 3.4, 0.9, 0.4, 2.0), (2.2, 2.4, 0.4, 0.4, 0.45))
    for i, (x, y, a, b, high) in enumerate(furniture):
        _alone(scene, placed(box((-a / 2, -b / 2, 0.0), (a / 2, b / 2, high)), (x, y, 0.0), 0.2 * i))
    before = _from_tripods(scene, [(1.0, 2.0, 1.5), (3.0, 1.5, 1.5), (5.2, 2.0, 1.5), (7.5, 1.0, 1.5)], 1.0, 0.008, 80)
    after = _from_tripods(scene, [(1.5, 2.5, 1.4), (4.0, 3.4, 1.5), (6.0, 2.2, 1.6), (7.0, 3.2, 1.5)], 1.0, 0.008, 80)
    drift = Rotation.from_euler("z", 0.3, degrees=True)
    moved = [drift.apply(places) + np.array((0.015, 0.01, 0.008)) for places in (after.points, after.origins)]
    after = replace(after, points=moved[0], origins=moved[1])
    return Scan(*(np.concatenate(columns) for columns in zip(vars(before).values(), vars(after).values(), strict=True)))


def power_lines() -> Scan:
    """Three wires between three masts over open ground, points at random on them, as from the air."""
    random = np.random.default_rng(0)
    x, y = random.uniform(0.0, 120.0, 70_000), random.uniform(-25.0, 25.0, 70_000)
    things = [np.stack((x, y, 2.0 * np.sin(x / 20.0) + 0.002 * y**2), axis=1)]
    for side in (-4.0, 0.0, 4.0):
        t, start = random.random(1800), np.repeat((5.0, 60.0), 900)
        things.append(np.stack((start + 55.0 * t, np.full(1800, side), 14.0 - 12.0 * t * (1.0 - t)), axis=1))
    for place in (5.0, 60.0, 115.0):
        angle, up, along = random.uniform(0.0, 2.0 * np.pi, 2500), random.uniform(0.0, 16.0, 2500), random.random(600)
        mast = np.stack((place + 0.25 * np.cos(angle), 0.25 * np.sin(angle), up), axis=1)
        arm = np.stack((np.full(600, place), 8.6 * along - 4.3, np.full(600, 14.0)), axis=1)
        things.append(np.concatenate((mast, arm + random.uniform(-0.15, 0.15, (600, 3)) * (1.0, 0.0, 1.0))))
    numbers = np.repeat(np.arange(len(things), dtype=np.int32), [len(thing) for thing in things])
    points = np.concatenate(things) + random.normal(0.0, 0.02, (len(numbers), 3))
    return Scan(points, np.broadcast_to((60.0, 0.0, 300.0), points.shape), numbers, numbers)


def _alone(scene: Scene, *shapes: Floats) -> None:
    """Things of one part each."""
    for shape in shapes:
        scene.add(scene.thing("thing"), shape, loss=0.02)


def _from_tripods(scene: Scene, places: list[Place], step: float, noise: float, steepest: float = 60.0) -> Scan:
    """Rays every so many degrees, from each place."""
    rays = sphere_of_rays(np.arange(0.0, 360.0, step), np.arange(-steepest, steepest, step))
    return scan(scene, np.array(places), [rays] * len(places), noise, np.random.default_rng(0))


def _towards(scene: Scene, places: Floats, targets: list[Floats], noise: float) -> Scan:
    """Rays from each place through some others."""
    rays = [far - place for place, far in zip(places, targets, strict=True)]
    unit = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    return scan(scene, places, unit, noise, np.random.default_rng(0))
