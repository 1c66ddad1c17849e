# SPDX-License-Identifier: Apache-2.0
"""Rooms, corridors and halls: as a depth camera, a tripod or nobody in particular saw them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenes.rays import (
    axes_of_view,
    beams,
    nearest_of,
    pinhole,
    to_ball,
    to_box,
    to_can,
    to_plane,
    to_turned_box,
    to_walls,
    turning,
)
from scenes.surfaces import (
    OPEN_BELOW,
    Floats,
    Labelled,
    Sided,
    chosen,
    faces,
    first_of_cubes,
    inside_out,
    joined,
    labelled,
    patch,
    scattered,
    tile,
)

ROOM = faces((0, 0, 0), (4, 3, 2.5), 0.04)
"""The sides of a box of 4 m x 3 m x 2.5 m, normals outwards."""
THING = faces((1.5, 1.0, 0.02), (2.3, 1.8, 0.9), 0.04, OPEN_BELOW)
"""A box that stands in `ROOM`."""


# --- As a depth camera sees them --------------------------------------------------------------------------------------

CLASSES = ("floor", "wall", "table", "box", "ball", "can")


class View(NamedTuple):
    """An image of a room in the camera's frame: x right, y down, z ahead.

    Attributes
    ----------
    points : (h, w, 3), metres
    colors : (h, w, 3), 0..1
        One for each thing, with noise.
    classes, things : (h, w) int32
        Index into `CLASSES`, and number: 0 the floor, 1 and 2 walls, 3 and 4 a table's top and leg, then what stands
        around; -1 where there is nothing.
    up : (3,)
        The floor's normal.
    floor, table : metres
        Heights along `up` of the floor and the table's top.
    """

    points: Floats
    colors: Floats
    classes: NDArray[np.int32]
    things: NDArray[np.int32]
    up: Floats
    floor: float
    table: float


def view_of_a_room(seed: int, shape: tuple[int, int] = (240, 320)) -> View:
    """A room with two walls and a table, five to six things on it and two beside it.

    Noise is along the rays, 1.5 mm at 1 m, and grows with the square of the distance.
    """
    rng = np.random.default_rng(seed)
    height, half = rng.uniform(0.65, 0.85), np.array([rng.uniform(0.45, 0.6), rng.uniform(0.33, 0.45), 0.015])
    yaw, pitch = rng.uniform(-0.5, 0.5), rng.uniform(0.55, 0.8)
    ahead = np.array([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)])
    eye, axes = np.array([0.0, 0.0, height]) - ahead * rng.uniform(1.3, 1.7), axes_of_view(ahead)
    image = pinhole(shape, 0.9 * shape[1])
    rays = image @ axes
    back, side = rng.uniform(0.7, 1.2), rng.uniform(0.8, 1.3) * rng.choice((-1.0, 1.0))
    met = [
        to_plane(rays, (0, 0, 1), -eye[2]),
        to_plane(rays, (0, 1, 0), back - eye[1]),
        to_plane(rays, (1, 0, 0), side - eye[0]),
        to_turned_box(rays, (0, 0, height - 0.015) - eye, 2 * half, 0.0),
        to_turned_box(rays, (0, 0, height / 2 - 0.015) - eye, (0.1, 0.1, height - 0.03), 0.0),
    ]
    kinds = [0, 1, 1, 2, 2]
    cells = np.stack(np.meshgrid((-0.62, 0.0, 0.62), (-0.5, 0.5)), axis=-1).reshape(-1, 2)
    places = [(*(cell * half[:2] + rng.uniform(-0.02, 0.02, 2)), height, 1.0) for cell in cells[rng.random(6) < 0.95]]
    places += [(sign * (half[0] + 0.25), rng.uniform(-0.5, 0.3), 0.0, 1.6) for sign in (-1.0, 1.0)]
    for x, y, base, scale in places:
        kind, (a, b, c) = int(rng.integers(3)), scale * rng.uniform(0.04, 0.09, 3)
        if kind == 0:
            met.append(to_turned_box(rays, (x, y, base + c) - eye, (2 * a, 2 * b, 2 * c), rng.uniform(0, np.pi)))
        elif kind == 1:
            met.append(to_ball(rays, (x, y, base + a) - eye, a))
        else:
            met.append(to_can(rays, (x, y, base + c) - eye, a, c))
        kinds.append(3 + kind)
    depth, thing = nearest_of(*met)
    length = np.linalg.norm(image, axis=-1)
    noisy = depth + 0.0015 * length * depth**2 * rng.standard_normal(shape)
    shades = rng.uniform(0.1, 0.9, (len(met) + 1, 3))
    colors = np.clip(shades[thing] + 0.03 * rng.standard_normal((*shape, 3)), 0.0, 1.0)
    classes = np.array([*kinds, -1], np.int32)[thing]
    up = axes[:, 2].copy()
    return View(
        image * noisy[..., None], colors, classes, thing.astype(np.int32), up, float(-eye[2]), float(height - eye[2])
    )


# --- As scanners on tripods see them ----------------------------------------------------------------------------------


class Scanned(NamedTuple):
    """Points of one scan, (n, 3), metres, and the place of the scanner, (3,)."""

    points: Floats
    place: Floats


def furnished(
    rays: Floats, place: ArrayLike, size: ArrayLike, n_boxes: int, largest: float, rng: np.random.Generator
) -> Floats:
    """Ranges (r,), metres, from a place in a room of a size (3,) with so many boxes on its floor.

    Boxes are 0.4 m to `largest` long along each axis. Those nearer than 0.5 m are not met.
    """
    place, size = np.asarray(place, float), np.asarray(size, float)
    ranges = to_walls(rays, -place, size - place)
    for _ in range(n_boxes):
        low = np.append(rng.uniform(0, size[:2] - 1), 0.0)
        high = low + rng.uniform(0.4, largest, 3)
        ranges = np.minimum(ranges, to_box(rays, low - place, high - place, nearest=0.5))
    return ranges


def furniture(
    seed: int,
    place: tuple[float, ...] = (7.0, 1.0, 1.2),
    size: tuple[float, ...] = (8.0, 5.0, 2.6),
    n: int = 180,
    highest: float = 60.0,
    n_boxes: int = 8,
) -> Scanned:
    """Boxes in a room from a tripod near its corner, 3 mm of noise.

    n : rows of points from 60 degrees below the horizon to `highest`, and a third of the columns.
    """
    rng = np.random.default_rng(seed)
    rays = turning(np.radians(np.linspace(-60, highest, n)), np.linspace(-np.pi, np.pi, 3 * n))
    ranges = furnished(rays, place, size, n_boxes, 1.2, rng)
    return Scanned(rays * ranges[:, None] + place + rng.normal(0, 0.003, rays.shape), np.array(place))


def furniture_in_rings(seed: int, n_beams: int) -> Scanned:
    """Six boxes in a room as so many beams within 30 degrees see them, 0.2 degrees apart along each; 1 cm of noise."""
    rng, place = np.random.default_rng(seed), np.array([2.2, 1.7, 1.2])
    rays = beams(-15.0, 15.0, n_beams, 0.2, first=0.1)
    ranges = furnished(rays, place, (6.0, 5.0, 2.6), 6, 1.5, rng)
    ranges += rng.normal(0.0, 0.01, ranges.shape)
    return Scanned(rays * ranges[:, None] + place, place)


class Corridor(NamedTuple):
    """Points, (n, 3), metres; unit vectors into the corridor, (n, 3); and which of its six sides each is on, (n,)."""

    points: Floats
    inwards: Floats
    sides: NDArray[np.int64]


def corridor(
    length: float, places: Sequence[float], step: float, seed: int = 0, width: float = 2.2, height: float = 2.6
) -> Corridor:
    """What tripods in the middle, at places along x, see of an empty corridor or hall; 2 mm of noise.

    step : degrees between rays.
    """
    rng = np.random.default_rng(seed)
    high = np.array([length, width, height])
    rays = turning(np.radians(np.arange(-64.99, 90, step)), np.radians(np.arange(0.01, 360, step)))
    points, inwards, sides = [], [], []
    for x in places:
        place = np.array([x, width / 2.0, 1.5])
        ranges = (np.where(rays > 0, high, 0.0) - place) / rays
        axis = np.argmin(ranges, axis=1)
        upper = rays[np.arange(len(rays)), axis] > 0
        nearest = ranges.min(axis=1) + rng.normal(0.0, 0.002, len(rays))
        points.append(place + rays * nearest[:, None])
        inwards.append(np.where(upper, -1.0, 1.0)[:, None] * np.eye(3)[axis])
        sides.append(2 * axis + upper)
    return Corridor(np.concatenate(points), np.concatenate(inwards), np.concatenate(sides))


def aisle(seed: int, places: Sequence[float]) -> Floats:
    """Boxes in three rows in a hall, from each of some places along an aisle, by 16 beams; 15 mm of noise. (n, 3)."""
    rng, size = np.random.default_rng(seed), np.array([22.0, 14.0, 6.5])
    rays = turning(np.radians(np.linspace(-15.3, 15.1, 16)), np.radians(np.arange(0.1, 360.0, 0.5)))
    lows = np.array([(x, y - 0.5, 0.0) for y in (3.0, 7.0, 11.0) for x in np.arange(2.5, 15.0, 1.6)])
    highs = lows + rng.uniform((0.8, 0.8, 1.0), (1.3, 1.1, 2.8), lows.shape)
    scans = []
    for x in places:
        place = np.array([x, 9.0, 0.9])
        met = [to_box(rays, low - place, high - place) for low, high in zip(lows, highs, strict=True)]
        ranges, _ = nearest_of(to_walls(rays, -place, size - place), *met)
        scans.append(place + rays * (ranges + rng.normal(0.0, 0.015, len(rays)))[:, None])
    return np.concatenate(scans)


def house_through_a_window(away: float, seed: int) -> tuple[Sided, Floats]:
    """`ROOM` with `THING` in it and a window, seen from within, 3 mm of noise; and, (m, 3), the front of a house that
    two places in it see through the window, so many metres behind it, thinned to cubes of 6 cm."""
    rng = np.random.default_rng(seed)
    room = joined(inside_out(ROOM), THING)
    x, y, z = room.points.T
    room = chosen(room, ~((x == 4.0) & (np.abs(y - 1.5) < 1.0) & (np.abs(z - 1.5) < 0.6)))
    window = np.stack((np.full(6000, 4.0), rng.uniform(0.5, 2.5, 6000), rng.uniform(0.9, 2.1, 6000)), axis=1)
    sensor = np.array([[1.0, 0.8, 1.5], [3.0, 2.2, 1.6]])[rng.integers(0, 2, 6000)]
    front = sensor + (window - sensor) * ((4.0 + away - sensor[:, 0]) / (4.0 - sensor[:, 0]))[:, None]
    front = front[(front[:, 2] > 0.0) & (front[:, 2] < 15.0)]
    front = front[first_of_cubes(front, 0.06)]
    return Sided(room.points + rng.normal(0.0, 0.003, room.points.shape), room.normals), front


# --- With no sensor ---------------------------------------------------------------------------------------------------


def side_by_side(nx: int, ny: int, doors: bool, seed: int = 0, wall: float = 0.12) -> Sided:
    """Points on the sides of rooms of 4 m x 3 m x 2.5 m in a grid, 3.5 cm apart, 3 mm of noise; normals into them."""
    rng = np.random.default_rng(seed)
    points, inwards = [], []

    def sheet(corner: Floats, first: Floats, second: Floats, inward: Floats, door: bool = False) -> None:
        sheet = scattered(corner, first, second, 800.0, rng)
        along, up = np.abs((sheet - corner) @ first / np.linalg.norm(first) - 2.0), sheet[:, 2] - corner[2]
        sheet = sheet[~(door & (along < 0.45) & (up < 2.0))]
        points.append(sheet)
        inwards.append(np.broadcast_to(inward, sheet.shape))

    x, y, z = np.diag([4.0, 3.0, 2.5])
    for i, j in np.ndindex(nx, ny):
        corner = np.array([i * (4.0 + wall), j * (3.0 + wall), 0.0])
        sheet(corner, x, y, z)
        sheet(corner + z, x, y, -z)
        sheet(corner, x, z, y, doors and j > 0)
        sheet(corner + y, x, z, -y, doors and j < ny - 1)
        sheet(corner, y, z, x)
        sheet(corner + x, y, z, -x)
    cloud = np.concatenate(points)
    return Sided(cloud + rng.normal(0.0, 0.003, cloud.shape), np.concatenate(inwards))


def twenty_boxes(step: float) -> Labelled:
    """Points, nearly a lattice of a step in metres, on the floor (0) and four walls (1 to 4) of a room of 6 m x 5 m and
    on twenty boxes."""
    rng = np.random.default_rng(0)
    parts = [patch((0, 0, 0), (6, 0, 0), (0, 5, 0), step)]
    for corner in ((0, 0, 0), (0, 5, 0)):
        parts.append(patch(corner, (6, 0, 0), (0, 0, 2.5), step))
    for corner in ((0, 0, 0), (6, 0, 0)):
        parts.append(patch(corner, (0, 5, 0), (0, 0, 2.5), step))
    for x in 0.5 + 1.1 * np.arange(5):
        for y in 0.5 + np.arange(4):
            s = rng.uniform(0.25, 0.4)
            sides = [patch((x, y, s), (s, 0, 0), (0, s, 0), step)]
            sides += [patch((x, other, 0), (s, 0, 0), (0, 0, s), step) for other in (y, y + s)]
            sides += [patch((other, y, 0), (0, s, 0), (0, 0, s), step) for other in (x, x + s)]
            parts.append(np.concatenate(sides))
    points, things = labelled(parts)
    return Labelled(points + rng.normal(0.0, 0.1 * step, points.shape), things)


def cabinet_from_wall_to_wall(seed: int, spacing: float = 0.02) -> Labelled:
    """A floor (0) that was not seen below a cabinet (1), 4 m x 4 m, 1 mm of noise."""
    rng = np.random.default_rng(seed)
    rectangles = (
        ((0, 0, 0), (4, 0, 0), (0, 1.6, 0)),
        ((0, 2.3, 0), (4, 0, 0), (0, 1.7, 0)),
        *(((0, y, 0.15), (4, 0, 0), (0, 0, 0.85)) for y in (1.7, 2.2)),
        ((0, 1.7, 1.0), (4, 0, 0), (0, 0.5, 0)),
    )
    parts = [scattered(*rectangle, spacing**-2, rng) for rectangle in rectangles]
    points, things = labelled(parts, [0, 0, 1, 1, 1])
    return Labelled(points + rng.normal(0.0, 0.001, points.shape), things)


def things_on_a_floor(seed: int) -> Floats:
    """A floor and a wall of 2 m and five boxes at random, 4000 points per square metre at random, 2 mm of noise."""
    rng = np.random.default_rng(seed)
    sides = [((0, 0, 0), (2, 0, 0), (0, 2, 0)), ((0, 2, 0), (2, 0, 0), (0, 0, 1))]
    for _ in range(5):
        (x, y), (a, b, c) = rng.uniform(0.1, 1.5, 2), rng.uniform(0.15, 0.4, 3)
        sides += [
            ((x, y, c), (a, 0, 0), (0, b, 0)),
            ((x, y, 0), (a, 0, 0), (0, 0, c)),
            ((x, y, 0), (0, b, 0), (0, 0, c)),
            ((x, y + b, 0), (a, 0, 0), (0, 0, c)),
            ((x + a, y, 0), (0, b, 0), (0, 0, c)),
        ]
    points = [scattered(*side, 4000.0, rng) for side in sides]
    return np.concatenate(points) + rng.normal(0.0, 0.002, (sum(map(len, points)), 3))


def flat_ground(n: int, low: tuple[float, float], high: tuple[float, float], rng: np.random.Generator) -> Floats:
    """So many points at random on z = 0 between two corners (x, y), 2 mm of noise."""
    return np.column_stack((rng.uniform(low, high, (n, 2)), rng.normal(0.0, 0.002, n)))


def two_densities(thinner: float, seed: int = 0) -> Labelled:
    """A floor of 8 m x 4 m (0) with a crate on either half (1, 2); the half beyond x = 4 is thinned by a factor."""
    rng = np.random.default_rng(seed)
    parts, things = [flat_ground(100_000, (0.0, 0.0), (8.0, 4.0), rng)], [0]
    for number, x in enumerate((1.6, 5.6)):
        for axis in range(3):
            for side in (0.0, 0.8):
                face = rng.uniform(0.0, 0.8, (2500, 3))
                face[:, axis] = side
                if axis < 2 or side:
                    parts.append(face + rng.normal((x, 1.6, 0.0), 0.002, face.shape))
                    things.append(number + 1)
    points, labels = labelled(parts, things)
    under = (labels == 0) & (np.abs(points[:, 1] - 2.0) < 0.4) & (np.abs(points[:, 0] % 4.0 - 2.0) < 0.4)
    kept = ~under & ((points[:, 0] < 4.0) | (rng.random(len(points)) < 1.0 / thinner))
    return Labelled(points[kept], labels[kept])


# --- A room of 4 m x 2 m whose floor is in two pieces -----------------------------------------------------------------

STEP = 0.02
"""Metres between the points of a `sheet`."""


def sheet(corner: ArrayLike, u: ArrayLike, v: ArrayLike) -> Floats:
    """A `tile` of points 2 cm apart, each off by up to 2 mm."""
    return tile(corner, u, v, STEP, 0.002)


def floor(start: float, stop: float, height: float = 0.0) -> Floats:
    """A floor 2 m wide between two x."""
    return sheet([start, 0.0, height], [stop - start, 0.0, 0.0], [0.0, 2.0, 0.0])


def desk(start: float, stop: float, height: float = 0.5) -> Floats:
    """A board over the floor between two x."""
    return sheet([start, 0.1, height], [stop - start, 0.0, 0.0], [0.0, 1.8, 0.0])


THREE_WALLS = (
    sheet([-0.02, 0.0, 0.05], [0.0, 2.0, 0.0], [0.0, 0.0, 1.5]),
    sheet([4.02, 0.0, 0.05], [0.0, 2.0, 0.0], [0.0, 0.0, 1.5]),
    sheet([0.0, 2.02, 0.05], [4.0, 0.0, 0.0], [0.0, 0.0, 1.5]),
)
"""At both ends of the floor and along it."""
