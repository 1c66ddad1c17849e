# SPDX-License-Identifier: Apache-2.0
"""Range images of analytic shapes and of meshes, with their noise, and meshes to compare with; no renderer."""

from __future__ import annotations

import numpy as np
import trimesh
from scenes.rays import to_ball

from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.rig import Intrinsics
from rangesim.triangle_mesh import TriangleMesh

CAMERA = Intrinsics.from_fov(96, 72, 40.0)


def range_image(z: np.ndarray, T: np.ndarray | None = None, camera: Intrinsics = CAMERA, **rest: object) -> RangeImage:
    """A range image of depths z (h, w), NaN where there is none, of confidence 0.5."""
    rays = camera.directions(camera.pixel_centres())
    arrays = {
        "confidence": np.full(z.shape, 0.5, np.float32),
        "intensity": np.ones(z.shape, np.float32),
        "status": np.where(np.isfinite(z), Status.OK, Status.LOW_SIGNAL).astype(np.uint8),
        "range_m": (z * np.linalg.norm(rays, axis=-1)).astype(np.float32),
    }
    T = np.eye(4) if T is None else T
    return RangeImage(z=z.astype(np.float32), camera=camera, T_world_camera=T, **{**arrays, **rest})  # type: ignore[arg-type]


def sphere_depth(camera: Intrinsics, T: np.ndarray, centre: tuple[float, float, float], radius: float) -> np.ndarray:
    """(h, w) depth of a sphere, closed form; NaN beside it."""
    distance = to_ball(camera.directions(camera.pixel_centres()), T[:3, :3].T @ (centre - T[:3, 3]), radius)
    return np.where(np.isfinite(distance), distance, np.nan)


def mesh_depth(mesh: TriangleMesh, camera: Intrinsics, T: np.ndarray) -> np.ndarray:
    """(h, w) depth of a mesh by Open3D's ray casting; NaN beside it."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    rays = camera.directions(camera.pixel_centres()) @ T[:3, :3].T
    origins = np.broadcast_to(T[:3, 3], rays.shape)
    t = scene.cast_rays(o3d.core.Tensor(np.concatenate([origins, rays], axis=-1).astype(np.float32)))["t_hit"].numpy()
    return np.where(np.isfinite(t), t, np.nan)


def ball(radius: float = 0.05, centre: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    """A finely divided sphere."""
    made = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return TriangleMesh(made.vertices + np.asarray(centre), made.faces)


def block(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    """A box."""
    made = trimesh.creation.box(extents=size)
    return TriangleMesh(made.vertices + np.asarray(centre), made.faces)


def part() -> TriangleMesh:
    """A block with two bosses and a ball, that looks different from all sides."""
    return TriangleMesh.joined(
        [
            block((0.10, 0.07, 0.04)),
            block((0.03, 0.02, 0.06), (0.03, 0.02, 0.04)),
            block((0.02, 0.04, 0.03), (-0.03, -0.01, 0.03)),
            ball(0.018, (0.0, -0.035, 0.025)),
        ]
    )
