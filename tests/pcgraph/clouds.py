# SPDX-License-Identifier: Apache-2.0
"""Small clouds with known answers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SPACING = 0.01  # metres between neighbouring points


def patch(
    corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], spacing: float = SPACING
) -> NDArray[np.float64]:
    """Regular points on the parallelogram corner + [0, 1] u + [0, 1] v, (n, 3), metres."""
    corner_, u_, v_ = (np.array(vector, float) for vector in (corner, u, v))
    steps_u = np.linspace(0, 1, round(np.linalg.norm(u_) / spacing) + 1)
    steps_v = np.linspace(0, 1, round(np.linalg.norm(v_) / spacing) + 1)
    a, b = np.meshgrid(steps_u, steps_v, indexing="ij")
    return corner_ + a.reshape(-1, 1) * u_ + b.reshape(-1, 1) * v_


VIEWPOINT = (0.8, -1.0, 3.0)


def box(x: float, y: float, size: float) -> NDArray[np.float64]:
    """What `VIEWPOINT` sees of a cube on the plane z = 0 with a corner at (x, y): the top, the front, one side."""
    side = x if x > VIEWPOINT[0] else x + size
    return np.vstack(
        [
            patch((x, y, size), (size, 0, 0), (0, size, 0)),
            patch((x, y, 0), (size, 0, 0), (0, 0, size)),
            patch((side, y, 0), (0, size, 0), (0, 0, size)),
        ]
    )


def two_boxes_on_a_plane() -> tuple[NDArray[np.float64], NDArray[np.int64], tuple[float, float, float]]:
    """Points, true objects (0 plane, 1 and 2 boxes) and the viewpoint from which they were seen."""
    plane = patch((0, 0, 0), (1.6, 0, 0), (0, 1.2, 0))
    hidden = np.zeros(len(plane), bool)
    boxes = []
    for x, y, size in ((0.3, 0.4, 0.3), (1.0, 0.5, 0.25)):
        # The boxes' shadows, as if the rays were parallel: straight up in x, slanted in y.
        inside = (plane[:, 0] > x - 1e-9) & (plane[:, 0] < x + size + 1e-9)
        hidden |= inside & (plane[:, 1] > y - 1e-9) & (plane[:, 1] < y + 1.6 * size)
        boxes.append(box(x, y, size))
    parts = [plane[~hidden], *boxes]
    truth = np.repeat([0, 1, 2], [len(part) for part in parts])
    return np.vstack(parts), truth, VIEWPOINT


def same_partition(a: NDArray[np.int32], b: NDArray[np.int32]) -> bool:
    """Whether two labellings are equal up to renaming."""
    pairs = len(np.unique(np.stack((a.ravel(), b.ravel()), axis=1), axis=0))
    return pairs == len(np.unique(a)) == len(np.unique(b))


def refines(fine: NDArray[np.int32], coarse: NDArray[np.int32]) -> bool:
    """Whether every segment of the fine labelling lies in one segment of the coarse one."""
    return len(np.unique(np.stack((fine.ravel(), coarse.ravel()), axis=1), axis=0)) == len(np.unique(fine))
