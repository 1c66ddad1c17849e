# SPDX-License-Identifier: Apache-2.0
"""Tables and planes with boxes, balls and fruit on them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scenes.rays import axes_of_view, camera, nearest_of, to_ball, to_box, to_plane
from scenes.surfaces import Floats, Labelled, labelled, patch

VIEWPOINT = (0.8, -1.0, 3.0)
"""From where `two_boxes_on_a_plane` was seen; metres."""


class Viewed(NamedTuple):
    """Points, (n, 3), metres; the thing that each is on, (n,); and the place of the sensor, metres."""

    points: Floats
    things: NDArray[np.int64]
    viewpoint: tuple[float, float, float]


def box(x: float, y: float, size: float) -> Floats:
    """What `VIEWPOINT` sees of a cube on the plane z = 0 with a corner at (x, y): the top, the front, one side."""
    side = x if x > VIEWPOINT[0] else x + size
    return np.vstack(
        [
            patch((x, y, size), (size, 0, 0), (0, size, 0)),
            patch((x, y, 0), (size, 0, 0), (0, 0, size)),
            patch((side, y, 0), (0, size, 0), (0, 0, size)),
        ]
    )


def two_boxes_on_a_plane() -> Viewed:
    """Things: 0 the plane, 1 and 2 the boxes. Points are `surfaces.SPACING` apart."""
    plane = patch((0, 0, 0), (1.6, 0, 0), (0, 1.2, 0))
    hidden = np.zeros(len(plane), bool)
    boxes = []
    for x, y, size in ((0.3, 0.4, 0.3), (1.0, 0.5, 0.25)):
        # The boxes' shadows, as if the rays were parallel: straight up in x, slanted in y.
        inside = (plane[:, 0] > x - 1e-9) & (plane[:, 0] < x + size + 1e-9)
        hidden |= inside & (plane[:, 1] > y - 1e-9) & (plane[:, 1] < y + 1.6 * size)
        boxes.append(box(x, y, size))
    return Viewed(*labelled([plane[~hidden], *boxes]), VIEWPOINT)


def boxes_on_a_table(n: int, seed: int) -> Labelled:
    """About n points at random on a table (0) and on the free sides of sixteen boxes of 10 to 16 cm; 1 mm of noise."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(*2 * (np.linspace(-0.45, 0.45, 4),))
    middles, (width, depth), high = np.stack((x, y)).reshape(2, -1).T, rng.uniform(0.05, 0.08, (2, 16)), 0.08
    per_area = n / (1.2**2 + (8.0 * high * (width + depth)).sum())
    table = rng.uniform(-0.6, 0.6, (round(1.2**2 * per_area), 2))
    under = (np.abs(table[:, None] - middles) < np.stack((width, depth), axis=1)).all(axis=2).any(axis=1)
    clouds, on = [np.column_stack((table[~under], np.zeros(np.count_nonzero(~under))))], [0]
    for i, (w, d) in enumerate(zip(width, depth, strict=True)):
        for along in (w, d, high):  # pairs of opposite sides; of the last the upper one
            half = np.array((w, d, high))
            number = round(per_area * (4.0 if along == high else 8.0) * half.prod() / along)
            side = rng.uniform(-1.0, 1.0, (number, 3))
            axis = int(np.flatnonzero(half == along)[0])
            side[:, axis] = 1.0 if along == high else np.sign(side[:, axis])
            clouds.append(side * half + (*middles[i], high))
            on.append(i + 1)
    points, things = labelled(clouds, on)
    return Labelled(points + rng.normal(0.0, 0.001, points.shape), things)


def image_of_a_table(seed: int) -> Floats:
    """Six balls on a plane as a camera at the origin sees them, (240 320, 3), row by row.

    The axis meets the plane at 53 degrees, 1 m off. Depth has 1 mm of noise.
    """
    rng, up, height = np.random.default_rng(seed), np.array([0.0, -0.6, -0.8]), 0.8
    rays = camera(np.linspace(-0.55, 0.55, 320), np.linspace(-0.42, 0.42, 240)).reshape(-1, 3)
    z = to_plane(rays, up, -height)
    for _ in range(6):
        radius, centre = rng.uniform(0.04, 0.08), np.array([rng.uniform(-0.35, 0.35), rng.uniform(-0.25, 0.25), 0.0])
        centre[2] = (-height - centre @ up) / up[2]
        z = np.minimum(z, to_ball(rays, centre + radius * up, radius))
    return rays * (z + rng.normal(0, 0.001, z.shape))[:, None]


def crate_of_fruit(seed: int) -> tuple[Floats, Floats]:
    """Two layers of balls in a crate on a table, z up, as a depth camera sees them; and its place, (3,)."""
    rng, eye = np.random.default_rng(seed), np.array([0.1, -0.3, 1.2])
    rays = (camera(np.linspace(-0.5, 0.5, 560), np.linspace(0.4, -0.4, 440)) @ axes_of_view(-eye)).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    table = to_plane(rays, (0.0, 0.0, 1.0), -eye[2])
    on_table = (np.abs((eye + table[:, None] * rays)[:, :2]) < (0.6, 0.5)).all(axis=1)
    met = [np.where(on_table, table, np.inf)]
    for low, high in (
        ((-0.31, -0.21, 0.0), (-0.3, 0.21, 0.2)),
        ((0.3, -0.21, 0.0), (0.31, 0.21, 0.2)),
        ((-0.31, -0.21, 0.0), (0.31, -0.2, 0.2)),
        ((-0.31, 0.2, 0.0), (0.31, 0.21, 0.2)),
        ((-0.3, -0.2, 0.0), (0.3, 0.2, 0.01)),
    ):
        met.append(to_box(rays, low - eye, high - eye))
    rows = np.stack(np.meshgrid(np.arange(-0.25, 0.26, 0.08), np.arange(-0.15, 0.16, 0.08)), axis=-1).reshape(-1, 2)
    for layer in range(2):
        for x, y in rows + rng.uniform(-0.01, 0.01, rows.shape) + 0.04 * layer:
            if abs(x) < 0.26 and abs(y) < 0.16 and (layer == 0 or rng.random() > 0.3):
                met.append(to_ball(rays, np.array([x, y, 0.05 + 0.065 * layer]) - eye, 0.04))
    ranges, _ = nearest_of(*met)
    points = eye + rays * (ranges + rng.normal(0.0, 0.0006, len(ranges)))[:, None]
    return points[np.isfinite(ranges)], eye
