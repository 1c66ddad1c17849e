# SPDX-License-Identifier: Apache-2.0
"""Land from far above: blocks of houses, banks, woods; and what is dug into it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scenes.surfaces import OPEN_ABOVE, Floats, Labelled, Sided, chosen, faces, inside_out, joined

SIDE = 120.0
"""Metres, along x and y, of `block` and `banked`."""
STREET, COURT, ROOF, SHED, WALL = range(5)


def block(
    court: float = 0.0, roof: float = 15.0, shed: float | None = None, walls: bool = False, seed: int = 0
) -> Labelled:
    """A street around a block of four wings, 20 m wide, about a court of 40 m; heights in metres, 5 cm of noise.

    A shed of 14 m stands in the court, so many metres above it. Things: `STREET`, `COURT`, `ROOF`, `SHED`, `WALL`.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, SIDE, (2, 12_000))
    off = np.maximum(np.abs(x - SIDE / 2), np.abs(y - SIDE / 2))  # of squares around the middle
    on = np.where(off > 40.0, STREET, np.where(off > 20.0, ROOF, COURT))
    z = np.choose(on, [0.0, court, roof])
    if shed is not None:
        on[off < 7.0], z[off < 7.0] = SHED, court + shed
    points = np.stack((x, y, z + rng.normal(0.0, 0.05, len(x))), axis=1)
    if walls:
        along, height = rng.uniform(20.0, 100.0, 3000), rng.uniform(0.0, roof, 3000)
        front = np.stack((along, np.full(3000, 20.0), height), axis=1)
        points, on = np.concatenate((points, front, front[:, [1, 0, 2]])), np.concatenate((on, np.full(6000, WALL)))
    return Labelled(points, on)


def banked(houses: bool, seed: int = 0) -> Labelled:
    """Ground (`STREET`) and ground 3 m above it (`COURT`), a bank of 45 degrees between, houses on both or none."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, SIDE, (2, 16_000))
    z = np.clip(x - SIDE / 2, 0.0, 3.0)
    on = np.where(x > SIDE / 2, COURT, STREET)
    for east in (20.0, 90.0) if houses else ():
        for north in (20.0, 60.0, 100.0):
            house = (np.abs(x - east) < 6.0) & (np.abs(y - north) < 6.0)
            on[house], z[house] = ROOF, 9.0 + 3.0 * (east > SIDE / 2)
    return Labelled(np.stack((x, y, z + rng.normal(0.0, 0.05, len(x))), axis=1), on)


def wooded(seed: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Rolling ground of 200 m, 160 m above the origin, with twenty houses and a hundred trees, (n, 3); and which points
    are in crowns of trees, (n,)."""
    rng, n, n_houses = np.random.default_rng(seed), 12_000, 20
    places = rng.uniform(-100, 100, (n, 2))
    z = 160.0 + 20.0 * np.sin(places @ rng.uniform(-0.02, 0.02, 2))
    corners = rng.uniform(-100, 85, (n_houses, 2))
    others = corners + rng.uniform(10, 60, (n_houses, 2))
    within = ((places[:, None] > corners) & (places[:, None] < others)).all(axis=2)
    to_tree = np.linalg.norm(places[:, None] - rng.uniform(-100, 100, (100, 2)), axis=2).min(axis=1)
    is_crown = (to_tree < 5.0) & (rng.random(n) < 0.9) & ~within.any(axis=1)
    above = np.where(is_crown, rng.uniform(4.0, 16.0, n), rng.normal(0.0, 0.1, n))
    z += np.where(within.any(axis=1), rng.uniform(6, 25, n_houses)[within.argmax(axis=1)], above)
    return np.column_stack((places, z)), is_crown


def heap(seed: int) -> Floats:
    """The upper halves of balls of 1 m radius in a heap, from above, 1 cm of noise, (n, 3)."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[-4:5, -4:5].reshape(2, -1)
    balls = np.stack((1.7 * (row + 0.5 * (column % 2)), 1.5 * column), axis=1)
    places = rng.uniform(-5.0, 5.0, (40_000, 2))
    squared = np.square(places[:, None] - balls).sum(axis=2).min(axis=1)
    places, squared = places[squared < 0.98], squared[squared < 0.98]
    points = np.column_stack((places, np.sqrt(1.0 - squared) - 0.02 * np.square(places).sum(axis=1)))
    return points + rng.normal(0.0, 0.01, points.shape)


def pit(
    ground: tuple[tuple[float, float], tuple[float, float]],
    low: tuple[float, float, float],
    high: tuple[float, float],
    spacing: float,
) -> Sided:
    """Ground at z = 0 between two corners (x, y), and a pit from its lowest corner `low` to the rim's corner `high`."""
    around = faces((*ground[0], -1), (*ground[1], 0), spacing, "+z")
    x, y, _ = around.points.T
    over = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
    return joined(chosen(around, ~over), inside_out(faces(low, (*high, 0.0), spacing, OPEN_ABOVE)))
