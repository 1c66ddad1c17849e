# SPDX-License-Identifier: Apache-2.0
"""Rooms as meshes: depth images along a walk, fused by weighted signed distances, and the vertices of the mesh.

Such are the meshes that indoor data sets consist of: smooth, evenly sampled, with holes where nobody looked. Noise of
the depth images: Nguyen et al. 2012.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scanned_scenes import Floats, Scan, Scene, caster_of, rays_at

from rangesim import RangeImage, Status, look_at
from rangesim.fusion import fuse
from rangesim.rig import Intrinsics
from rangesim.triangle_mesh import TriangleMesh

CAMERA = Intrinsics.from_fov(320, 240, 60.0)
NEAREST, FARTHEST = 0.4, 4.5  # metres of depth
VIEWS = 8  # from each place
SWAY = (0.15, 0.15, 0.08)  # metres, of the camera about a place
POSE_ERROR = 0.003  # metres
TRUNCATION = 4.0  # voxels
LEAST_VIEWS = 2  # of a voxel that counts
FARTHEST_LABEL = 0.06  # metres between a vertex and the surface that it takes its label from


def meshed(scene: Scene, places: Floats, seed: int, voxel: float, faces: int | None = None) -> Scan:
    """Vertices of the mesh of a room; their origins are the nearest places.

    Parameters
    ----------
    scene : Scene
    places : (k, 3) float64, metres
        About which the camera is held.
    seed : int
    voxel : float, metres
        Of the signed distances.
    faces : int, optional
        Triangles to which the mesh is simplified (Garland and Heckbert 1997).

    Returns
    -------
    Scan
        Vertices too far from any surface have the labels -1.
    """
    rng = np.random.default_rng(seed)
    caster, part_of_triangle = caster_of(scene)
    views = [_view(caster, place, view, rng) for place in places for view in range(VIEWS)]
    fused = fuse(views, voxel, truncation_m=TRUNCATION * voxel, weights="uniform", min_weight=LEAST_VIEWS)
    vertices = _simplified(fused.mesh, faces)
    nearest = caster.compute_closest_points(vertices.astype(np.float32))
    part = part_of_triangle[nearest["primitive_ids"].numpy()]
    is_far = np.linalg.norm(nearest["points"].numpy() - vertices, axis=1) > FARTHEST_LABEL
    place = np.linalg.norm(vertices[:, None] - places, axis=2).argmin(axis=1)
    things = np.where(is_far, -1, np.array(scene.things)[part])
    return Scan(vertices, places[place], things.astype(np.int32), np.where(is_far, -1, part).astype(np.int32))


def _view(caster: Any, place: Floats, number: int, rng: np.random.Generator) -> RangeImage:
    """What a camera held at a place sees on one of its turns; half of its noise is alike over four by four pixels."""
    azimuth, elevation = 360.0 * (number + 0.5 * rng.random(1)) / VIEWS, rng.uniform(-35.0, 15.0, 1)
    centre = place + rng.normal(0.0, SWAY)
    pose = look_at(centre, centre + rays_at(azimuth, elevation)[0])
    width, height = CAMERA.width, CAMERA.height
    rays = CAMERA.directions(CAMERA.pixel_centres())
    along = rays.reshape(-1, 3) @ pose[:3, :3].T
    cast = np.concatenate((np.broadcast_to(centre, along.shape), along), axis=1).astype(np.float32)
    z = caster.cast_rays(cast)["t_hit"].numpy().astype(np.float64).reshape(height, width)
    z[(z < NEAREST) | (z > FARTHEST)] = np.nan
    coarse = rng.standard_normal((height // 4, width // 4)).repeat(4, axis=0).repeat(4, axis=1)
    noise = (coarse + rng.standard_normal(z.shape)) / np.sqrt(2.0)
    z = (z + (0.0012 + 0.0019 * (z - 0.4) ** 2) * noise).astype(np.float32)
    pose[:3, 3] += rng.normal(0.0, POSE_ERROR, 3)
    seen = np.isfinite(z)
    ones, status = seen.astype(np.float32), np.where(seen, Status.OK, Status.LOW_SIGNAL).astype(np.uint8)
    ranges = z * np.linalg.norm(rays, axis=2).astype(np.float32)
    return RangeImage(z, ranges, ones, status, ones, CAMERA, pose)


def _simplified(mesh: TriangleMesh, faces: int | None) -> Floats:
    """Vertices that are left, (n, 3)."""
    if faces is None:
        return mesh.vertices
    import open3d as o3d

    triangles = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces)
    )
    return np.asarray(triangles.simplify_quadric_decimation(faces).remove_unreferenced_vertices().vertices)
