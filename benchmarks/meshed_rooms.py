# SPDX-License-Identifier: Apache-2.0
"""Rooms as meshes: depth images along a walk, fused to signed distances, and the vertices of their zero level.

Such are the meshes that indoor data sets consist of: smooth, evenly sampled, with holes where nobody looked. Source of
the fusion: Curless and Levoy 1996; of the noise: Nguyen et al. 2012.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scanned_scenes import Floats, Scan, Scene, caster_of

WIDTH, HEIGHT = 320, 240
FOCAL = WIDTH / 2.0 / np.tan(np.radians(30.0))  # pixels
NEAREST, FARTHEST = 0.4, 4.5  # metres of depth
VIEWS = 8  # from each place
SWAY = (0.15, 0.15, 0.08)  # metres, of the camera about a place
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
    vertices = _simplified(*_zero_level(scene, places, voxel, rng), faces)
    caster, part_of_triangle = caster_of(scene)
    nearest = caster.compute_closest_points(vertices.astype(np.float32))
    part = part_of_triangle[nearest["primitive_ids"].numpy()]
    is_far = np.linalg.norm(nearest["points"].numpy() - vertices, axis=1) > FARTHEST_LABEL
    place = np.linalg.norm(vertices[:, None] - places, axis=2).argmin(axis=1)
    things = np.where(is_far, -1, np.array(scene.things)[part])
    return Scan(vertices, places[place], things.astype(np.int32), np.where(is_far, -1, part).astype(np.int32))


def _zero_level(
    scene: Scene, places: Floats, voxel: float, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (n, 3), metres, and triangles (m, 3) of the surface between seen free space and what lies behind."""
    from skimage.measure import marching_cubes

    corners = np.concatenate(scene.corners).reshape(-1, 3)
    low, high = corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1
    shape = tuple(np.ceil((high - low) / voxel).astype(int))
    centres = (low + voxel * np.indices(shape).reshape(3, -1).T).astype(np.float32)
    sums, weights = np.zeros(len(centres), np.float32), np.zeros(len(centres), np.float32)
    caster, _ = caster_of(scene)
    for place in places:
        for view in range(VIEWS):
            camera = place + rng.normal(0.0, SWAY)
            axes = _axes(2.0 * np.pi * (view + 0.5 * rng.random()) / VIEWS, np.radians(rng.uniform(-35.0, 15.0)))
            depth = _depth_image(caster, camera, axes, rng)
            _integrate(centres, depth, camera + rng.normal(0.0, 0.003, 3), axes, TRUNCATION * voxel, sums, weights)
    distances = np.where(weights >= LEAST_VIEWS, sums / np.maximum(weights, 1.0), np.nan)
    vertices, triangles, *_ = marching_cubes(distances.reshape(shape), 0.0)
    is_known = np.isfinite(vertices).all(axis=1)
    return low + voxel * vertices, triangles[is_known[triangles].all(axis=1)]


def _axes(yaw: float, pitch: float) -> Floats:
    """Axes of a level camera, (3, 3), columns x right, y down, z forward, in the world."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return np.stack((right, np.cross(forward, right), forward), axis=1)


def _depth_image(caster: Any, camera: Floats, axes: Floats, rng: np.random.Generator) -> Floats:
    """Depth, (HEIGHT, WIDTH), metres, 0 where there is none; half of the noise is alike over four by four pixels."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack((u / FOCAL, v / FOCAL, np.ones_like(u)), axis=-1).reshape(-1, 3) @ axes.T
    cast = np.concatenate((np.broadcast_to(camera, rays.shape), rays), axis=1).astype(np.float32)
    depth = caster.cast_rays(cast)["t_hit"].numpy().astype(np.float64).reshape(HEIGHT, WIDTH)
    depth[(depth < NEAREST) | (depth > FARTHEST)] = 0.0
    coarse = rng.standard_normal((HEIGHT // 4, WIDTH // 4)).repeat(4, axis=0).repeat(4, axis=1)
    noise = (coarse + rng.standard_normal(depth.shape)) / np.sqrt(2.0)
    return np.where(depth > 0.0, depth + (0.0012 + 0.0019 * (depth - 0.4) ** 2) * noise, 0.0)


def _integrate(
    centres: NDArray[np.float32],
    depth: Floats,
    camera: Floats,
    axes: Floats,
    truncation: float,
    sums: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> None:
    """Add what one depth image says of the signed distance at voxels' centres, metres, positive before the surface."""
    seen = (centres - camera.astype(np.float32)) @ axes.astype(np.float32)
    voxel = np.flatnonzero(seen[:, 2] > NEAREST)
    seen = seen[voxel]
    column, row = (np.floor(FOCAL * seen[:, k] / seen[:, 2] + half) for k, half in ((0, WIDTH / 2), (1, HEIGHT / 2)))
    inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    voxel, measured = voxel[inside], depth[row[inside].astype(int), column[inside].astype(int)]
    distance = measured - seen[inside, 2]
    counts = (measured > 0.0) & (distance > -truncation)
    sums[voxel[counts]] += np.minimum(distance[counts], truncation)
    weights[voxel[counts]] += 1.0


def _simplified(vertices: Floats, triangles: NDArray[np.int64], faces: int | None) -> Floats:
    """Vertices that are left, (n, 3)."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles.astype(np.int32))
    )
    if faces is not None:
        mesh = mesh.simplify_quadric_decimation(faces)
    return np.asarray(mesh.remove_unreferenced_vertices().vertices)
