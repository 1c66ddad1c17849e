# SPDX-License-Identifier: Apache-2.0
"""Piles: objects that fall onto a support and come to rest, by MuJoCo (extra `piles`).

The objects fall slowly, as if through oil, so that none of them tunnels through a thin wall; friction with the oil
vanishes at rest, so that it does not hold up anything. Surfaces begin to repel each other at `GAP_M`, and therefore
stay apart. One thread computes it, so that the same settings give the same bytes.

References
----------
Todorov, Erez, Tassa: "MuJoCo: A physics engine for model-based control", IROS 2012.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rangesim.dataset.side_by_side import Arrangement
from rangesim.dataset.solid_model import SolidModel
from rangesim.dataset.supports import Placed

STEP_S = 0.002
"""Time step, seconds: MuJoCo's default."""
CHUNK_STEPS = 50
"""Steps between two looks at the objects: 0.1 s."""
GAP_M = 2e-4
"""Half of the distance at which surfaces begin to repel each other, metres, because MuJoCo adds the two of a contact.
The objects sink into this layer by about 0.1 mm at the default stiffness, and stay apart by about 0.3 mm."""
DENSITY = 1000.0
"""Density of all objects, kg/m3, that of plastic. Where they come to rest hardly depends on it."""
FRICTION = 0.5
"""Coefficient of sliding friction of all surfaces, about that of plastic on cardboard (assumed)."""
FRICTION_STIFFNESS = 100.0
"""Stiffness of friction over that of contact, dimensionless. MuJoCo's friction lets surfaces creep under load; at 1, a
seventh of 25 piles of ten never came to rest within 8 s, at 10 and at 100 all did."""
OIL_S = 0.05
"""Time in which the oil slows an object down, seconds. The speed of fall is at most g times this, 0.5 m/s, 1 mm in a
time step."""
REST_M = 1e-4
"""Displacement in 0.1 s, metres, of any point of an object that counts as rest: a speed of 1 mm/s in the oil, so that
the forces on the object balance to 0.2 % of its weight. Of ten piles that went on for 1 s without oil, 2 % of the
objects moved by more than 1 mm: those that roll, for want of rolling friction."""
REST_CHUNKS = 2
"""Number of times 0.1 s for which all objects must be at rest."""
MAX_CHUNKS = 80
"""Largest number of times 0.1 s that is computed; what moves then is left out. Piles of ten need about 20."""
THICKNESS_M = 0.2
"""Metres by which walls and floors that collide are thicker than those that are seen, on the side that nothing touches:
an object in a wall is then always pushed out where it came in."""
MAX_OVERLAP_M = 3e-4
"""Largest depth, metres, by which an object may lie in another one; deeper ones are wedged, and one of them is left
out."""


class _Pile(NamedTuple):
    """The physics of a pile. radii : (n,) distances of the farthest points from the centres of mass, metres."""

    model: Any
    data: Any
    radii: np.ndarray


def settled(solids: list[tuple[SolidModel, float]], support: Placed, random: np.random.Generator) -> Arrangement:
    """Places of objects that have fallen onto a support from random poses above it, and are at rest.

    solids : model and scale of each object. An object whose centre of mass leaves the area of the support is left out,
        and so is one that is wedged in another one or still moves at the end.
    """
    if not solids:
        return Arrangement([], {}, {"type": "pile", "time_s": 0.0})
    pile = _pile(solids, support, random)
    model, data = pile.model, pile.data
    inside: np.ndarray = np.ones(len(solids), bool)
    reasons: dict[str, int] = {}
    low, high = support.area_m

    def leave_out(which: np.ndarray, reason: str) -> None:
        if which.any():
            reasons[reason] = reasons.get(reason, 0) + int(which.sum())
            inside[which] = False
            gone = np.isin(model.geom_bodyid, 1 + np.flatnonzero(which))
            model.geom_contype[gone] = model.geom_conaffinity[gone] = 0

    calm_chunks = 0
    for _ in range(MAX_CHUNKS):
        moved = _advance(pile)
        place = data.xpos[1:, :2]
        leave_out(inside & ((place < low) | (place > high)).any(axis=1), "fell off the support")
        calm_chunks = calm_chunks + 1 if moved[inside].max(initial=0.0) < REST_M else 0
        if calm_chunks >= REST_CHUNKS:
            wedged = _wedged(pile, inside)
            if not wedged.any():
                break
            leave_out(wedged, "wedged in another object")
            calm_chunks = 0
    else:
        leave_out(inside & (moved >= REST_M), "still moving")
        leave_out(_wedged(pile, inside), "wedged in another object")
    poses: list[np.ndarray | None] = []
    for body, (solid, scale) in enumerate(solids):
        pose = np.eye(4)
        pose[:3, :3] = data.xmat[body + 1].reshape(3, 3)
        pose[:3, 3] = data.xpos[body + 1] - pose[:3, :3] @ (scale * solid.centre_of_mass_m)
        poses.append(pose if inside[body] else None)
    values = {
        "type": "pile",
        "time_s": round(float(data.time), 3),
        "max_speed_m_s": float(moved[inside].max(initial=0.0)) / (CHUNK_STEPS * STEP_S),
        "collision_standoff_m": max(scale * solid.collision.standoff_m for solid, scale in solids),
    }
    return Arrangement(poses, reasons, values)


def _pile(solids: list[tuple[SolidModel, float]], support: Placed, random: np.random.Generator) -> _Pile:
    """The objects in random poses above the support, so that spheres around them do not overlap."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = STEP_S
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = FRICTION_STIFFNESS
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for low, high in _thickened(support):
        geom = spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=(high - low) / 2, pos=(low + high) / 2, friction=[FRICTION, 0, 0]
        )
        geom.margin = GAP_M
    radii = np.zeros(len(solids))
    starts: list[np.ndarray] = []
    for i, (solid, scale) in enumerate(solids):
        radii[i] = scale * np.linalg.norm(solid.mesh.vertices - solid.centre_of_mass_m, axis=1).max()
        starts.append(_start(radii, starts, support, random))
        turn = random.normal(size=4)
        body = spec.worldbody.add_body(pos=starts[i], quat=turn / np.linalg.norm(turn))
        body.add_freejoint()
        for k, points in enumerate(solid.collision.points):
            name = f"{i}_{k}"
            vertices = (scale * (points - solid.centre_of_mass_m)).astype(np.float32)
            spec.add_mesh(name=name, uservert=vertices.ravel())
            geom = body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=DENSITY, friction=[FRICTION, 0, 0]
            )
            geom.margin = GAP_M
    model = spec.compile()
    mass, inertia = model.body_mass[1:, None], model.body_inertia[1:].mean(axis=1, keepdims=True)
    model.dof_damping[:] = (np.hstack([np.repeat(mass, 3, axis=1), np.repeat(inertia, 3, axis=1)]) / OIL_S).ravel()
    return _Pile(model, mujoco.MjData(model), radii)


def _start(radii: np.ndarray, starts: list[np.ndarray], support: Placed, random: np.random.Generator) -> np.ndarray:
    """The lowest free place (3,) above a random point of the support for a sphere of the last radius."""
    radius = radii[len(starts)]
    low, high = support.area_m
    free = np.maximum(high - low - 2 * radius, 0)
    x, y = (low + high) / 2 + free * (random.random(2) - 0.5)
    top = support.height_m if support.rim_m is None else support.rim_m
    z = top + radius
    for (other_x, other_y, other_z), other in zip(starts, radii, strict=False):
        above2 = (radius + other) ** 2 - (x - other_x) ** 2 - (y - other_y) ** 2
        if above2 > 0:
            z = max(z, other_z + np.sqrt(above2))
    return np.array([x, y, z])


def _thickened(support: Placed) -> np.ndarray:
    """Boxes (n, 2, 3) of the support that are thicker downwards and outwards, where no object touches them."""
    boxes = support.boxes.copy()
    low, high = support.area_m
    boxes[:, 0, 2] = np.where(boxes[:, 1, 2] <= support.height_m, boxes[:, 0, 2] - THICKNESS_M, boxes[:, 0, 2])
    for axis in (0, 1):
        is_wall = boxes[:, 1, 2] > support.height_m
        boxes[:, 1, axis] += np.where(is_wall & (boxes[:, 0, axis] >= high[axis]), THICKNESS_M, 0)
        boxes[:, 0, axis] -= np.where(is_wall & (boxes[:, 1, axis] <= low[axis]), THICKNESS_M, 0)
    return boxes


def _advance(pile: _Pile) -> np.ndarray:
    """Compute 0.1 s, and return an upper bound (n,) of how far the points of each object have moved, metres."""
    import mujoco

    place, turn = pile.data.xpos[1:].copy(), pile.data.xmat[1:].reshape(-1, 3, 3).copy()
    mujoco.mj_step(pile.model, pile.data, nstep=CHUNK_STEPS)
    mujoco.mj_forward(pile.model, pile.data)
    turned = np.linalg.norm(pile.data.xmat[1:].reshape(-1, 3, 3) - turn, axis=(1, 2)) / np.sqrt(2)
    return np.asarray(np.linalg.norm(pile.data.xpos[1:] - place, axis=1) + turned * pile.radii)


def _wedged(pile: _Pile, inside: np.ndarray) -> np.ndarray:
    """(n,) bool, of each pair of objects that overlap by more than `MAX_OVERLAP_M` the later one."""
    found: np.ndarray = np.zeros(len(inside), bool)
    bodies = pile.model.geom_bodyid[pile.data.contact.geom].max(axis=1) - 1
    found[bodies[pile.data.contact.dist < -MAX_OVERLAP_M]] = True
    return found & inside
