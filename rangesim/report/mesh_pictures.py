# SPDX-License-Identifier: Apache-2.0
"""Pictures of triangle meshes by ray casting, with a colour for each point of the surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.report import palette
from rangesim.rig import Intrinsics
from rangesim.triangle_mesh import TriangleMesh

GREY = (222, 219, 212)
"""Colour of a mesh without colours of its own, RGB 0..255."""
EDGE_ON_BRIGHTNESS = 0.35
"""Brightness of a surface seen edge on, as a fraction of that of one seen face on, so that steep parts stay visible."""


def mesh_picture(
    mesh: TriangleMesh,
    camera: Intrinsics,
    T_world_camera: np.ndarray,
    colors: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """(h, w, 3) uint8 picture of a mesh that is lit from the camera; pixels without a surface are light grey.

    Parameters
    ----------
    camera : Intrinsics of the picture.
    T_world_camera : (4, 4) float64, maps camera coordinates to world coordinates, metres.
    colors : function of points (n, 3), metres, world, and the indices (n,) of their triangles; it returns the colours
        (n, 3), numbers 0..255. None: all points are grey.
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
    light = EDGE_ON_BRIGHTNESS + (1 - EDGE_ON_BRIGHTNESS) * cosine
    base = np.broadcast_to(GREY, (len(points), 3)) if colors is None else colors(points, face[hit])
    picture = np.empty((*t.shape, 3), np.uint8)
    picture[...] = palette.NO_DATA
    picture[hit] = np.clip(light[:, None] * base, 0, 255).astype(np.uint8)
    return picture
