# SPDX-License-Identifier: Apache-2.0
"""Two furnished rooms as terrestrial scanners see them from several places; things stand on, in and behind others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scanned_scenes import Floats, Scan, Scene, ball, box, hull, leaves, placed, rod, scan, sphere_of_rays

Part = Floats  # triangles
Place = tuple[float, float, float]


def _slabs(*boxes: tuple[float, ...]) -> list[Part]:
    """Boxes, each as (x, x, y, y, z, z)."""
    return [box((b[0], b[2], b[4]), (b[1], b[3], b[5])) for b in boxes]


def _legs(a: float, b: float, high: float, half: float) -> list[Part]:
    feet = [(x, y) for x in (-a, a) for y in (-b, b)]
    return _slabs(*((x - half, x + half, y - half, y + half, 0, high) for x, y in feet))


def _table(a: float, b: float, high: float) -> list[Part]:
    return [*_slabs((-a, a, -b, b, high - 0.03, high)), *_legs(a - 0.06, b - 0.06, high - 0.02, 0.025)]


def _chair() -> list[Part]:
    back = [rod((-0.2, y, 0.44), (-0.26, y, 0.92), 0.015) for y in (-0.19, 0.19)]
    rest = hull(
        np.array([(x - 0.1 * (z - 0.44), y, z) for x in (-0.21, -0.19) for y in (-0.2, 0.2) for z in (0.68, 0.9)])
    )
    return [*_slabs((-0.21, 0.21, -0.21, 0.21, 0.43, 0.47)), *_legs(0.18, 0.18, 0.44, 0.017), *back, rest]


def _sofa(half: float) -> list[Part]:
    seats = [(x, x + half - 0.17, -0.3, 0.42, 0.2, 0.45) for x in (-half + 0.16, 0.01)]
    backs = [(x, x + half - 0.17, -0.4, -0.22, 0.4, 0.8) for x in (-half + 0.16, 0.01)]
    arms = [(-half, -half + 0.16, -0.42, 0.42, 0.05, 0.6), (half - 0.16, half, -0.42, 0.42, 0.05, 0.6)]
    return _slabs(*seats, *backs, *arms, (-half, half, -0.42, 0.4, 0.05, 0.22), (-half, half, -0.45, -0.38, 0.05, 0.75))


def _cupboard(half: float, deep: float, high: float) -> list[Part]:
    """Body, doors that stand out by 2 cm with a slit between them, and handles; its back is at y = 0."""
    doors = [
        (-half + 0.01, -0.004, deep, deep + 0.02, 0.08, high - 0.02),
        (0.004, half - 0.01, deep, deep + 0.02, 0.08, high - 0.02),
    ]
    handles = [rod((x, deep + 0.04, 0.45 * high), (x, deep + 0.04, 0.45 * high + 0.15), 0.008) for x in (-0.05, 0.05)]
    return [*_slabs((-half, half, 0, deep, 0, high), *doors), *handles]


def _shelf(half: float, deep: float, high: float, boards: int) -> list[Part]:
    """Sides, back and boards; its back is at y = 0."""
    levels = np.linspace(0.05, high - 0.03, boards)
    sides = [(-half, -half + 0.02, 0, deep, 0, high), (half - 0.02, half, 0, deep, 0, high)]
    return _slabs(*sides, (-half, half, 0, 0.01, 0, high), *((-half, half, 0, deep, z, z + 0.025) for z in levels))


def _floor_lamp() -> list[Part]:
    shade = rod((0, 0, 1.45), (0, 0, 1.72), 0.22, 0.14)
    return [rod((0, 0, 0), (0, 0, 0.025), 0.15), rod((0, 0, 0), (0, 0, 1.5), 0.012), shade]


def _plant(rng: np.random.Generator) -> list[Part]:
    at = np.array([0.0, 0.0, 0.75]) + rng.normal(0.0, 1.0, (140, 3)) * (0.13, 0.13, 0.16)
    stems = [rod((0, 0, 0.25), tuple(end), 0.008) for end in at[:8]]
    return [rod((0, 0, 0), (0, 0, 0.32), 0.12, 0.17), *stems, leaves(at, 0.07, rng)]


def _screen() -> list[Part]:
    return _slabs(
        (-0.12, 0.12, -0.08, 0.08, 0, 0.015), (-0.03, 0.03, -0.01, 0.02, 0, 0.25), (-0.27, 0.27, 0.02, 0.05, 0.12, 0.45)
    )


def _laptop() -> list[Part]:
    lid = [(x, y + lean, z) for x in (-0.16, 0.16) for y in (-0.12, -0.11) for z, lean in ((0.02, 0.0), (0.23, -0.07))]
    return [*_slabs((-0.16, 0.16, -0.11, 0.11, 0, 0.018)), hull(np.array(lid))]


def _mug() -> list[Part]:
    return [rod((0, 0, 0), (0, 0, 0.1), 0.042), *_slabs((0.03, 0.075, -0.006, 0.006, 0.02, 0.08))]


def _bottle() -> list[Part]:
    return [rod((0, 0, 0), (0, 0, 0.2), 0.04), rod((0, 0, 0.19), (0, 0, 0.3), 0.035, 0.013)]


def _carton(a: float, b: float, c: float) -> list[Part]:
    return _slabs((-a, a, -b, b, 0, c))


def _globe(radius: float) -> list[Part]:
    return [ball((0, 0, radius), (radius, radius, radius))]


def _drum(radius: float, high: float) -> list[Part]:
    return [rod((0, 0, 0), (0, 0, high), radius)]


def _bed() -> list[Part]:
    pillow = ball((0, 0.72, 0.52), (0.35, 0.2, 0.09))
    return [
        *_slabs((-0.5, 0.5, -1, 1, 0.15, 0.3), (-0.48, 0.48, -0.98, 0.98, 0.28, 0.5), (-0.5, 0.5, 0.98, 1.03, 0, 0.9)),
        *_legs(0.45, 0.95, 0.2, 0.03),
        pillow,
    ]


def _radiator(half: float) -> list[Part]:
    ribs = [(x, x + 0.05, 0.03, 0.12, 0.12, 0.7) for x in np.arange(-half, half, 0.065)]
    return _slabs(*ribs, (-half, half, 0.05, 0.1, 0.15, 0.2), (-half, half, 0.05, 0.1, 0.62, 0.67))


@dataclass
class _Furnisher:
    """Puts things into a scene, each of its own colour."""

    scene: Scene
    rng: np.random.Generator

    def put(self, kind: str, parts: list[Part], place: Place, turn: float = 0.0, like: int | None = None) -> int:
        """Number of a thing whose parts stand at a place, turned by degrees; `like`: a thing of the same colour."""
        tint = self.rng.integers(40, 216, 3) if like is None else self.scene.tints[like]
        number = self.scene.thing(kind, tuple(int(c) for c in tint))
        for part in parts:
            self.scene.add(number, placed(part, place, np.radians(turn)))
        return number

    def shell(self, long: float, wide: float, high: float, ceiling: bool) -> None:
        """Floor, four walls that have the same colour, and a ceiling."""
        self.put("floor", _slabs((0, long, 0, wide, -0.1, 0)), (0, 0, 0))
        walls = [(0, long, -0.1, 0, 0, high), (0, long, wide, wide + 0.1, 0, high), (-0.1, 0, 0, wide, 0, high)]
        first = None
        for wall in (*walls, (long, long + 0.1, 0, wide, 0, high)):
            first = self.put("wall", _slabs(wall), (0, 0, 0), like=first)
        if ceiling:
            self.put("ceiling", _slabs((0, long, 0, wide, high, high + 0.1)), (0, 0, 0), like=first)

    def books(self, place: Place, turn: float, half: float, boards: NDArray[np.float64]) -> None:
        """Rows of books, each row one thing, and a carton or a vase here and there; `place` as the shelf's."""
        for z in boards:
            start = -half + 0.05
            thick = self.rng.uniform(0.02, 0.05, 40)
            ends = start + np.cumsum(thick)
            ends = ends[ends < self.rng.uniform(-0.1, half - 0.25)]
            row = [
                (e - t, e, 0.03, 0.03 + self.rng.uniform(0.14, 0.2), 0, self.rng.uniform(0.19, 0.25))
                for e, t in zip(ends, thick, strict=False)
            ]
            if row:
                self.put("books", _slabs(*row), _beside(place, turn, (0, 0, z + 0.025)), turn)
            at = _beside(place, turn, (half - 0.14, 0.13, z + 0.025))
            self.put("vase", _carton(0.07, 0.06, 0.12) if self.rng.random() < 0.5 else _bottle()[:1], at, turn)


def _beside(place: Place, turn: float, offset: Place) -> Place:
    """A place given in a turned thing's own frame."""
    moved = placed(np.array(offset)[None], place, np.radians(turn))[0]
    return (float(moved[0]), float(moved[1]), float(moved[2]))


def office(seed: int = 0) -> tuple[Scene, Floats]:
    """Room A: desk, round of chairs, cupboards, shelf, sofa, lamp, things on tables; and where the scanner stood."""
    rng = np.random.default_rng(seed)
    put = (room := _Furnisher(Scene(), rng)).put
    room.shell(5.6, 4.4, 2.6, ceiling=True)
    door = [*_slabs((-0.45, 0.45, 0, 0.05, 0, 2.03), (-0.52, -0.45, 0, 0.03, 0, 2.1), (0.45, 0.52, 0, 0.03, 0, 2.1))]
    put(
        "door",
        [*door, *_slabs((-0.52, 0.52, 0, 0.03, 2.03, 2.1)), rod((0.36, 0.09, 1), (0.24, 0.09, 1), 0.01)],
        (4.8, 0, 0),
    )
    frame = ((-0.7, 0.7, 0, 0.06, 0.9, 0.97), (-0.7, 0.7, 0, 0.06, 2.1, 2.17), (-0.7, -0.63, 0, 0.06, 0.9, 2.17))
    put("window", _slabs(*frame, (0.63, 0.7, 0, 0.06, 0.9, 2.17), (-0.03, 0.03, 0, 0.06, 0.9, 2.17)), (0, 2.2, 0), -90)
    put("radiator", _radiator(0.6), (0, 2.2, 0), -90)
    put("table", _table(0.9, 0.5, 0.75), (2.6, 2.3, 0), 8)
    for x, y, turn in ((2.0, 1.5, 95), (3.1, 1.62, 80), (2.1, 3.15, -80), (3.3, 3.05, -100)):
        put("chair", _chair(), (x, y, 0), turn + float(rng.normal(0, 6)))
    for kind, parts, x, y, turn in (
        ("laptop", _laptop(), 2.2, 2.15, 175),
        ("carton", _carton(0.15, 0.11, 0.16), 2.9, 2.45, 30),
        ("mug", _mug(), 2.55, 2.1, 0),
        ("bottle", _bottle(), 3.2, 2.2, 0),
        ("ball", _globe(0.09), 2.45, 2.55, 0),
        ("drum", _drum(0.07, 0.18), 3.25, 2.55, 0),
        ("carton", _carton(0.1, 0.07, 0.05), 1.95, 2.45, 60),
    ):
        put(kind, parts, (x, y, 0.75), turn)
    put("carton", _carton(0.1, 0.08, 0.1), (2.9, 2.45, 0.91), 40)
    put("desk", [*_table(0.75, 0.38, 0.73), *_slabs((0.3, 0.72, -0.33, 0.35, 0.08, 0.7))], (4.9, 3.95, 0), 180)
    put("screen", _screen(), (4.9, 4.1, 0.73), 180)
    put("carton", _carton(0.12, 0.16, 0.09), (4.4, 4.0, 0.73), 10)
    put("chair", _chair(), (4.85, 3.3, 0), 260)
    put("cupboard", _cupboard(0.5, 0.42, 1.9), (0.95, 4.4, 0), 180)
    put("cupboard", _cupboard(0.5, 0.42, 1.9), (2.0, 4.4, 0), 180)
    put("carton", _carton(0.2, 0.15, 0.25), (0.9, 4.18, 1.9), 5)
    shelf = (5.6, 1.9, 0.0)
    put("shelf", _shelf(0.6, 0.3, 1.8, 5), shelf, 90)
    room.books(shelf, 90, 0.6, np.linspace(0.05, 1.77, 5)[:4])
    put("sofa", _sofa(0.85), (2.4, 0.5, 0))
    put("cushion", [ball((0, 0, 0.16), (0.2, 0.09, 0.2))], (1.9, 0.45, 0.42))
    put("lamp", _floor_lamp(), (0.4, 0.5, 0))
    put("bin", _drum(0.14, 0.34), (3.9, 3.9, 0))
    put("plant", _plant(rng), (5.2, 0.75, 0))
    put("ball", _globe(0.12), (1.2, 1.3, 0))
    put("carton", _carton(0.25, 0.18, 0.3), (0.5, 3.3, 0), 20)
    put("carton", _carton(0.2, 0.16, 0.22), (0.52, 3.3, 0.3), 45)
    put("picture", _slabs((-0.35, 0.35, 0, 0.03, 1.3, 1.8)), (2.4, 0, 0))
    return room.scene, np.array([(1.2, 2.2, 1.5), (4.2, 2.6, 1.4), (3.6, 1.0, 1.6), (1.0, 3.6, 1.3), (4.4, 1.2, 1.5)])


def flat(seed: int = 1) -> tuple[Scene, Floats]:
    """Room B: kitchen row, dining table, bed, low table, shelf on a slant; no ceiling; and where the scanner stood."""
    rng = np.random.default_rng(seed)
    put = (room := _Furnisher(Scene(), rng)).put
    room.shell(6.4, 5.0, 2.5, ceiling=False)
    for k, x in enumerate((0.45, 1.1, 1.75, 2.4)):
        put(
            "cabinet",
            [
                *_slabs((-0.32, 0.32, 0, 0.56, 0.1, 0.86), (-0.31, 0.31, 0.56, 0.58, 0.12, 0.84)),
                rod((-0.15, 0.6, 0.75), (0.15, 0.6, 0.75), 0.008),
            ],
            (x, 0, 0),
        )
        if k != 1:
            put("cabinet", _slabs((-0.32, 0.32, 0, 0.33, 1.45, 2.1), (-0.31, 0.31, 0.33, 0.35, 1.46, 2.09)), (x, 0, 0))
    put("worktop", _slabs((0.1, 2.75, 0, 0.6, 0.86, 0.9)), (0, 0, 0))
    rims = [(0.3 * s, 0.45 * s, z) for s, z in ((1, 1.55), (0.4, 1.8))]
    funnel = hull(np.array([(x, y, z) for a, b, z in rims for x in (-a, a) for y in (0, b)]))
    put("hood", [funnel, *_slabs((-0.1, 0.1, 0, 0.18, 1.8, 2.4))], (1.1, 0, 0))
    put(
        "fridge",
        _slabs((-0.3, 0.3, 0, 0.6, 0, 1.75), (-0.29, 0.29, 0.6, 0.63, 0.05, 0.6), (-0.29, 0.29, 0.6, 0.63, 0.62, 1.73)),
        (3.15, 0, 0),
    )
    for kind, parts, x, y, turn in (
        ("pot", [*_drum(0.11, 0.14), rod((0.1, 0, 0.11), (0.25, 0, 0.12), 0.012)], 1.1, 0.3, 20),
        ("bottle", _bottle(), 0.35, 0.2, 0),
        ("bottle", _bottle(), 0.48, 0.22, 0),
        ("mug", _mug(), 1.6, 0.35, 40),
        ("toaster", _carton(0.15, 0.09, 0.19), 2.2, 0.25, 5),
        ("bowl", [rod((0, 0, 0), (0, 0, 0.09), 0.06, 0.13)], 1.85, 0.3, 0),
    ):
        put(kind, parts, (x, y, 0.9), turn)
    put(
        "table",
        [rod((0, 0, 0.71), (0, 0, 0.74), 0.6), rod((0, 0, 0), (0, 0, 0.72), 0.05), rod((0, 0, 0), (0, 0, 0.03), 0.3)],
        (4.6, 1.6, 0),
    )
    for turn in (20, 140, 255):
        put("chair", _chair(), _beside((4.6, 1.6, 0), turn, (-0.62, 0, 0)), turn)
    for kind, parts, x, y in (
        ("vase", [rod((0, 0, 0), (0, 0, 0.13), 0.04, 0.07), rod((0, 0, 0.13), (0, 0, 0.2), 0.07, 0.03)], 4.6, 1.65),
        ("plate", [rod((0, 0, 0), (0, 0, 0.02), 0.08, 0.13)], 4.3, 1.5),
        ("mug", _mug(), 4.45, 1.85),
        ("melon", _globe(0.11), 4.85, 1.45),
        ("carton", _carton(0.12, 0.05, 0.21), 4.85, 1.8),
    ):
        put(kind, parts, (x, y, 0.74), 33)
    put("bed", _bed(), (0.75, 3.9, 0), 0)
    put("bedside", _cupboard(0.2, 0.35, 0.5), (1.55, 5.0, 0), 180)
    put(
        "lamp",
        [rod((0, 0, 0), (0, 0, 0.2), 0.06, 0.02), rod((0, 0, 0.18), (0, 0, 0.36), 0.14, 0.08)],
        (1.55, 4.8, 0.52),
    )
    put("sofa", _sofa(0.8), (3.5, 4.5, 0), 180)
    put("low table", _table(0.45, 0.3, 0.42), (3.5, 3.4, 0), 5)
    for x, y, z in ((3.3, 3.45, 0.42), (3.31, 3.44, 0.46), (3.32, 3.46, 0.49)):
        put("book", _carton(0.11, 0.15, 0.03 + 0.01 * (z == 0.42)), (x, y, z), float(rng.uniform(0, 40)))
    put("ball", _globe(0.07), (3.7, 3.35, 0.42))
    shelf = (6.05, 4.75, 0.0)
    put("shelf", _shelf(0.5, 0.28, 2.0, 6), shelf, 150)
    room.books(shelf, 150, 0.5, np.linspace(0.05, 1.97, 6)[:5])
    put("stool", [rod((0, 0, 0.42), (0, 0, 0.46), 0.17), *_legs(0.11, 0.11, 0.43, 0.015)], (2.3, 2.3, 0), 10)
    put("carton", _carton(0.13, 0.1, 0.18), (2.3, 2.3, 0.46), 60)
    put("suitcase", _slabs((-0.3, 0.3, -0.11, 0.11, 0.04, 0.5)), (6.1, 3.0, 0), 80)
    put("plant", _plant(rng), (5.9, 0.5, 0))
    put("lamp", _floor_lamp(), (2.4, 4.6, 0))
    put("bin", [rod((0, 0, 0), (0, 0, 0.4), 0.13, 0.16)], (3.75, 0.4, 0))
    put("column", _slabs((-0.15, 0.15, -0.15, 0.15, 0, 2.5)), (5.4, 3.5, 0))
    put(
        "door",
        _slabs((-0.45, 0.45, 0, 0.05, 0, 2.03), (-0.52, -0.45, 0, 0.03, 0, 2.1), (0.45, 0.52, 0, 0.03, 0, 2.1)),
        (0, 1.9, 0),
        -90,
    )
    places = [(1.6, 1.5, 1.5), (3.4, 2.4, 1.4), (5.6, 2.4, 1.6), (4.9, 4.2, 1.3), (2.0, 3.4, 1.5), (5.6, 0.9, 1.5)]
    turn, shift = 25.0, (2.0, -1.0, 0.3)
    scene = room.scene
    scene.corners = [placed(part, shift, np.radians(turn)) for part in scene.corners]
    return scene, placed(np.array(places), shift, np.radians(turn))


def stations(scene: Scene, places: Floats, seed: int, step: float) -> Scan:
    """A terrestrial scanner's points, 2 mm of noise: rays `step` degrees apart, from 65 below level to 55 above."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(0.0, step, (len(places), 2))
    azimuths, elevations = np.arange(0.0, 360.0, step), np.arange(-65.0, 55.0, step)
    return scan(scene, places, [sphere_of_rays(azimuths + a, elevations + e) for a, e in turns], 0.002, rng, reach=30.0)
