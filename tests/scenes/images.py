# SPDX-License-Identifier: Apache-2.0
"""Depth images, (h, w, 3), of a camera at the origin: x right, y down, z ahead, unless told."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scenes.rays import camera, pinhole, to_ball
from scenes.surfaces import Floats, Labelled

VGA = (480, 640)
QVGA = (240, 320)

FRAMES = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "x": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""Rotations, (3, 3), from the frame of `images` to that of cameras that look along z, -z (OpenGL's) and x."""


def at_depths(shape: tuple[int, int], focal: float, depths: Floats) -> Floats:
    """Points at depths (h, w) of the pixels of a camera with a focal length in pixels."""
    return pinhole(shape, focal) * depths[..., None]


def stairs(height: int = 60, width: int = 80) -> Floats:
    """A floor before a camera, farther off by 1 m right of a line."""
    rays = camera((np.arange(width) - width / 2) / width, (np.arange(height) + 1) / height)
    return rays * (1.0 / (rays[..., 1:2] + 0.2) + (rays[..., :1] > 0.1))


def hall(end: float, noise: float = 0.0, step: float = 0.0, shape: tuple[int, int] = QVGA) -> Labelled:
    """A floor (1), two walls (2, 3), all 1.2 m off the camera's axis, and a wall at a depth `end` (0).

    Inverse depth has noise of a standard deviation and comes in steps, 1/metres.
    """
    rng, rays = np.random.default_rng(0), pinhole(shape, 0.9 * shape[1])
    x, y = rays[..., 0], rays[..., 1]
    walls = np.stack([np.full(shape, end), *(1.2 / np.maximum(way, 1e-9) for way in (y, x, -x))])
    inverse = 1.0 / walls.min(axis=0) + noise * rng.normal(size=shape)
    return Labelled(rays / _in_steps(inverse, step)[..., None], walls.argmin(axis=0))


def floor_wall_and_boxes(
    seed: int, shape: tuple[int, int] = QVGA, noise: float = 0.002, step: float = 0.0, focal: float = 250.0
) -> Labelled:
    """A wall 3 m ahead (0), a floor 0.8 m below the camera (1) and three slanted boards before them (2 to 4).

    Inverse depth has noise of a standard deviation and comes in steps, 1/metres. focal : pixels.
    """
    rng, rays = np.random.default_rng(seed), pinhole(shape, focal)
    x, y = rays[..., 0], rays[..., 1]
    inverse = np.stack((np.full(shape, 1.0 / 3.0), np.maximum(y, 0.0) / 0.8))
    truth = inverse.argmax(axis=0)
    inverse = inverse.max(axis=0)
    for number in range(3):
        left, top, depth = rng.uniform(-0.5, 0.3), rng.uniform(-0.3, 0.1), rng.uniform(1.2, 2.2)
        board = (x > left) & (x < left + 0.25) & (y > top) & (y < top + 0.3) & (inverse < 1.0 / depth)
        inverse[board], truth[board] = (1.0 + 0.2 * (x - left)[board]) / depth, 2 + number
    inverse = inverse + noise * rng.normal(size=shape)
    return Labelled(rays / _in_steps(inverse, step)[..., None], truth)


def _in_steps(values: Floats, step: float) -> Floats:
    return np.round(values / step) * step if step else values


def boards_with_mixed_edges(seed: int, fraction: float = 0.3) -> tuple[Floats, NDArray[np.int64], NDArray[np.bool_]]:
    """Three boards (1 to 3) before a wall (0), which of these (h, w), and which pixels mix two depths (h, w).

    A fraction of the pixels at the right edges of the boards are mixed.
    """
    rng, (h, w) = np.random.default_rng(seed), QVGA
    y, x = np.mgrid[:h, :w]
    depths, truth = np.full(QVGA, 2.0), np.zeros(QVGA, int)
    for number, (top, left) in enumerate(((30, 30), (90, 130), (60, 240)), start=1):
        inside = (abs(y - top - 50) < 50) & (abs(x - left - 25) < 25)
        depths[inside], truth[inside] = 1.0 + 0.2 * number, number
    beside = np.zeros(QVGA, bool)
    beside[:, 1:] = depths[:, 1:] > depths[:, :-1] + 0.1
    mixed = beside & (rng.random(QVGA) < fraction)
    depths[mixed] -= rng.uniform(0.2, 0.8, mixed.sum()) * (depths - np.roll(depths, 1, axis=1))[mixed]
    rays = camera((np.arange(w) - w / 2) / 300.0, (np.arange(h) - h / 2) / 300.0)
    return rays * (depths + 0.001 * rng.normal(size=QVGA))[..., None], truth, mixed


def before_a_wall(fronts: list[tuple[float, ...]], back: float, shape: tuple[int, int] = (160, 220)) -> Labelled:
    """Rectangles (x0, x1, y0, y1, z), metres, numbered from 0, before a wall (-1) at a depth `back`, which may be inf.

    NaN where there is nothing.
    """
    rays = pinhole(shape, 150.0)
    depth, thing = np.full(shape, back), np.full(shape, -1)
    for number, (x0, x1, y0, y1, z) in enumerate(fronts):
        x, y = z * rays[..., 0], z * rays[..., 1]
        hit = (x0 < x) & (x < x1) & (y0 < y) & (y < y1) & (z < depth)
        depth[hit], thing[hit] = z, number
    points = rays * depth[..., None]
    points[~np.isfinite(depth)] = np.nan
    return Labelled(points, thing)


def plate_before_a_wall() -> Floats:
    """A square plate of 0.4 m at a depth of 1 m before a wall at 2 m, (120, 160, 3)."""
    return before_a_wall([(-0.2, 0.2, -0.2, 0.2, 1.0)], 2.0, PLATE_SHAPE).points


PLATE_SHAPE = (120, 160)


def ball_before_a_wall() -> Floats:
    """A ball of 0.25 m radius before a wall at a depth of 2 m, (120, 160, 3)."""
    rays = pinhole(PLATE_SHAPE, 150.0)
    return rays * np.minimum(to_ball(rays, (0.0, 0.0, 1.2), 0.25), 2.0)[..., None]
