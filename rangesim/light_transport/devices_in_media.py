# SPDX-License-Identifier: Apache-2.0
"""Whether a camera or a projector stands inside a medium, where no light path of ours begins.

Paths begin in air and notice a medium where they cross its boundary. From inside they would cross it only on the way
out, so that fog would weaken the light there not at all, or one way alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.rig import Rig

DIRECTIONS = 32
"""Rays from a place, evenly spread, that look for the boundaries around it."""
MOST = 0.75
"""Fraction of them that must leave a body through its boundary; a few slip through the seam of two triangles."""
MAX_HITS = 64
"""Surfaces that are looked behind."""


def check_devices(scene: Any, rigs: Sequence[Rig]) -> None:
    """Raise ValueError if a camera or projector stands in a medium that fills a shape.

    Parameters
    ----------
    scene : mitsuba.Scene. rigs : in its coordinates; they share a projector.
    """
    bodies = [i for i, s in enumerate(scene.shapes()) if s.is_medium_transition() and s.interior_medium() is not None]
    if not bodies:
        return
    cameras = [(f"camera {k}" if len(rigs) > 1 else "the camera", r.T_world_camera) for k, r in enumerate(rigs)]
    for name, T in [*cameras, ("the projector", rigs[0].T_world_projector)]:
        for i in bodies_around(scene, T[:3, 3], bodies):
            raise ValueError(
                f"expected {name} in air, got it inside the medium of shape {scene.shapes()[i].id()!r}; move it out, "
                "or let the medium begin in front of it."
            )


def bodies_around(scene: Any, place: np.ndarray, bodies: Sequence[int]) -> list[int]:
    """Which `bodies`, places among the shapes of a mitsuba.Scene, a point lies inside.

    place : (3,) float, metres, in the scene's coordinates.
    """
    turns, height = np.pi * (3 - np.sqrt(5)) * np.arange(DIRECTIONS), 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    round_about = np.sqrt(1 - height**2)
    d = mi.Vector3f(np.stack([round_about * np.cos(turns), round_about * np.sin(turns), height]).astype(np.float32))
    ray = mi.Ray3f(mi.Point3f(*place.tolist()) + dr.zeros(mi.Vector3f, DIRECTIONS), d)
    leaves = np.zeros((len(bodies), DIRECTIONS), dtype=int)  # at the first crossing: 1 leaves, -1 enters, 0 none yet
    places = table_of(scene, np.arange(len(scene.shapes())))
    for _ in range(MAX_HITS):
        si = scene.ray_intersect(ray)
        hit = np.array(si.is_valid())
        if not hit.any():
            break
        outwards = np.where(np.array(dr.dot(si.n, ray.d)) > 0, 1, -1)
        shape = places[number_of(si.shape).numpy()]
        for row, body in zip(leaves, bodies, strict=True):
            row[hit & (shape == body) & (row == 0)] = outwards[hit & (shape == body) & (row == 0)]
        onwards = si.spawn_ray(ray.d)
        ray.o, ray.maxt = onwards.o, dr.select(si.is_valid(), mi.Float(dr.inf), mi.Float(0))
    return [body for row, body in zip(leaves, bodies, strict=True) if (row > 0).mean() >= MOST]
