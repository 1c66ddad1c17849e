# SPDX-License-Identifier: Apache-2.0
"""Pictures of triangle meshes by ray casting: shaded, or coloured by what each pixel's point is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.report import palette
from rangesim.rig import Intrinsics
from rangesim.triangle_mesh import TriangleMesh

GREY = (222, 219, 212)
AMBIENT = 0.35
"""Of the brightness of a surface that is seen edge on."""


def mesh_picture(
    mesh: TriangleMesh,
    camera: Intrinsics,
    T_world_camera: np.ndarray,
    colors: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """(h, w, 3) uint8, a mesh lit from the camera; what it does not cover is light grey.

    Parameters
    ----------
    colors : of points (n, 3), metres, world, with their triangles (n,), as (n, 3) numbers 0..255; None: grey.
    """
    import open3d as o3d

    scene, middle = raycasting_scene(mesh)
    rays = camera.directions(camera.pixel_centres()) @ T_world_camera[:3, :3].T
    origins = np.broadcast_to(T_world_camera[:3, 3] - middle, rays.shape)
    met = scene.cast_rays(o3d.core.Tensor(np.concatenate([origins, rays], axis=-1).astype(np.float32)))
    t, face = met["t_hit"].numpy(), met["primitive_ids"].numpy()
    hit = np.isfinite(t)
    points = T_world_camera[:3, 3] + rays[hit] * t[hit, None]
    n = np.nan_to_num(mesh.face_normals[face[hit]])
    cosine = np.abs((n * rays[hit]).sum(axis=-1)) / np.linalg.norm(rays[hit], axis=-1)
    light = AMBIENT + (1 - AMBIENT) * cosine
    base = np.broadcast_to(GREY, (len(points), 3)) if colors is None else colors(points, face[hit])
    picture = np.empty((*t.shape, 3), np.uint8)
    picture[...] = palette.NO_DATA
    picture[hit] = np.clip(light[:, None] * base, 0, 255).astype(np.uint8)
    return picture
