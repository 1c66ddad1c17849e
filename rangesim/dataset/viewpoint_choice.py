# SPDX-License-Identifier: Apache-2.0
"""A camera pose that sees something: poses inside of things, or that see no object, are drawn again and counted."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rangesim.dataset.dataset_spec import DatasetSpec
from rangesim.dataset.supports import Placed
from rangesim.rig import Intrinsics
from rangesim.settings.draws import Of

if TYPE_CHECKING:
    from rangesim.dataset.random_scene import PlacedObject

MAX_TRIES = 100
"""Number of poses that are tried before a scene is refused."""
MIN_DISTANCE_M = 0.02
"""Smallest distance from the camera to a surface, metres: the housing of a small sensor takes as much."""
COLUMNS = 32
"""Columns of the grid of rays that tell whether the camera sees an object; objects below a thirtieth of the image may
be missed, and such a view is of little use."""


class ChosenView(NamedTuple):
    """T_world_camera : (4, 4) float64, metres. redrawn : number of poses given up, by the reason. values : drawn."""

    T_world_camera: np.ndarray
    fov_deg: float
    redrawn: dict[str, int]
    values: dict[str, Any]


def chosen_view(
    spec: DatasetSpec, objects: tuple[PlacedObject, ...], support: Placed, random: np.random.Generator
) -> ChosenView:
    """The first random pose that is outside of all things and sees an object, if there is one in the scene.

    Raises
    ------
    ValueError
        None of `MAX_TRIES` poses is such.
    """
    import open3d as o3d

    world = o3d.t.geometry.RaycastingScene(nthreads=1)
    meshes = [one.world_mesh for one in objects]
    for mesh in (*meshes, *support.meshes.values()):
        world.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    boxes = [(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) for mesh in meshes]
    low = support.area_m[0] if not boxes else np.min([b[0][:2] for b in boxes], axis=0)
    high = support.area_m[1] if not boxes else np.max([b[1][:2] for b in boxes], axis=0)
    top = max((float(b[1][2]) for b in boxes), default=support.height_m)
    centre = np.array([*(low + high) / 2, (support.height_m + top) / 2])
    fov_deg = spec.fov_deg.value(random, Of(float))
    redrawn: Counter[str] = Counter()
    for _ in range(MAX_TRIES):
        T, values = spec.view.pose(centre, random)
        reason = _why_not(T, fov_deg, spec, world, len(objects))
        if not reason:
            return ChosenView(T, fov_deg, dict(redrawn), values)
        redrawn[reason] += 1
    counted = ", ".join(f"{reason} {count} times" for reason, count in redrawn.items())
    raise ValueError(f"expected a camera pose that sees an object, got none in {MAX_TRIES} draws ({counted}).")


def _why_not(T: np.ndarray, fov_deg: float, spec: DatasetSpec, world: Any, objects: int) -> str:
    """The reason why a pose is of no use; empty if it is of use."""
    place = T[None, :3, 3].astype(np.float32)
    if float(world.compute_distance(place).numpy()[0]) < MIN_DISTANCE_M:
        return "camera at a surface"
    if float(world.compute_occupancy(place).numpy()[0]) > 0:
        return "camera inside a thing"
    camera = Intrinsics.from_fov(COLUMNS, max(1, round(COLUMNS * spec.height / spec.width)), fov_deg)
    directions = camera.directions(camera.pixel_centres()).reshape(-1, 3) @ T[:3, :3].T
    rays = np.concatenate([np.broadcast_to(T[:3, 3], directions.shape), directions], axis=1)
    seen = world.cast_rays(rays.astype(np.float32))["geometry_ids"].numpy()
    if objects and not (seen < objects).any():
        return "no object in view"
    return ""
