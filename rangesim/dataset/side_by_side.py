# SPDX-License-Identifier: Apache-2.0
"""Objects that lie on a support side by side, each for itself, without physics."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rangesim.dataset.solid_model import SolidModel
from rangesim.dataset.supports import Placed

MAX_TRIES = 100
"""Number of places that are tried for an object before it is left out."""
CLEARANCE_M = 1e-4
"""Gap below objects and between the circles around them, metres, so that no two surfaces coincide; the renderer's
single precision resolves 1e-7 m here."""


class Arrangement(NamedTuple):
    """Places of objects.

    poses : T_world_part (4, 4) of each object; None: left out. left_out : number of those, by the reason. values : what
    a record tells of the arrangement.
    """

    poses: list[np.ndarray | None]
    left_out: dict[str, int]
    values: dict[str, Any]


def scattered(solids: list[tuple[SolidModel, float]], support: Placed, random: np.random.Generator) -> Arrangement:
    """Random places, in which objects lie stable on the support and circles around them do not overlap.

    solids : model and scale of each object. An object for which `MAX_TRIES` places are taken is left out.
    """
    poses: list[np.ndarray | None] = []
    circles: list[np.ndarray] = []  # x, y, radius
    low, high = support.area_m
    for solid, scale in solids:
        pose = np.eye(4)
        pose[:3, :3] = solid.resting_rotation(random)
        vertices = scale * solid.mesh.vertices @ pose[:3, :3].T
        middle = (vertices.min(axis=0) + vertices.max(axis=0))[:2] / 2
        radius = float(np.linalg.norm(vertices[:, :2] - middle, axis=1).max()) + CLEARANCE_M
        free = np.maximum(high - low - 2 * radius, 0)
        places = low + (high - low - free) / 2 + free * random.random((MAX_TRIES, 2))
        fits = bool((high - low >= 2 * radius).all())
        taken = np.array(circles).reshape(-1, 3)
        gaps = np.linalg.norm(places[:, None] - taken[:, :2], axis=-1) - taken[:, 2] - radius
        good = np.flatnonzero((gaps > 0).all(axis=1)) if fits else np.zeros(0, np.int64)
        if not len(good):
            poses.append(None)
            continue
        place = places[good[0]]
        circles.append(np.array([*place, radius]))
        pose[:3, 3] = [*(place - middle), support.height_m + CLEARANCE_M - vertices[:, 2].min()]
        poses.append(pose)
    missing = sum(pose is None for pose in poses)
    return Arrangement(poses, {"no free place": missing} if missing else {}, {"type": "scattered"})
