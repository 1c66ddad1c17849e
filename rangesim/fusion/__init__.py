# SPDX-License-Identifier: Apache-2.0
"""Fusion of many views to one surface, its error, and the volume that the views never see (docs/fusion.md).

Python loads each name when it is first used.

Examples
--------
Views of a ball from six sides, computed in closed form, become a mesh whose error is a fraction of a voxel:

>>> import numpy as np
>>> import trimesh
>>> from rangesim import Intrinsics, RangeImage, look_at
>>> from rangesim.fusion import fuse, surface_error
>>> from rangesim.triangle_mesh import TriangleMesh
>>> camera, radius_m = Intrinsics.from_fov(96, 72, 20.0), 0.05
>>> rays = camera.directions(camera.pixel_centres())
>>> def view(x, y, z):
...     T = look_at((x, y, z), (0, 0, 0))
...     centre = T[:3, :3].T @ -T[:3, 3]
...     a, b = (rays**2).sum(axis=-1), rays @ centre
...     inside = b * b - a * (centre @ centre - radius_m**2)
...     z = np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, np.nan).astype(np.float32)
...     one, status = np.ones_like(z), np.where(np.isfinite(z), 0, 1).astype(np.uint8)
...     return RangeImage(z, z * np.linalg.norm(rays, axis=-1), one, status, one, camera, T)
>>> sides = [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0, -0.5, 0), (0.01, 0, 0.5), (0.01, 0, -0.5)]
>>> fused = fuse([view(*side) for side in sides], voxel_m=0.004)
>>> true = trimesh.creation.icosphere(subdivisions=4, radius=radius_m)
>>> error = surface_error(fused.mesh, TriangleMesh(true.vertices, true.faces), threshold_m=0.002)
>>> error.accuracy_m < 0.0005, error.f_score > 0.99
(True, True)
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from rangesim.fusion.computed_tomography import Sinogram as Sinogram
    from rangesim.fusion.computed_tomography import filtered_back_projection as filtered_back_projection
    from rangesim.fusion.computed_tomography import sampling_angles as sampling_angles
    from rangesim.fusion.computed_tomography import with_photon_noise as with_photon_noise
    from rangesim.fusion.computed_tomography import xray_projections as xray_projections
    from rangesim.fusion.joint_registration import refine_jointly as refine_jointly
    from rangesim.fusion.mesh_error import SurfaceError as SurfaceError
    from rangesim.fusion.mesh_error import surface_error as surface_error
    from rangesim.fusion.multiway_registration import Alignment as Alignment
    from rangesim.fusion.multiway_registration import PairFit as PairFit
    from rangesim.fusion.multiway_registration import PoseErrors as PoseErrors
    from rangesim.fusion.multiway_registration import align as align
    from rangesim.fusion.multiway_registration import pose_errors as pose_errors
    from rangesim.fusion.posed_images import Scan as Scan
    from rangesim.fusion.sdf import average_signed_distances as average_signed_distances
    from rangesim.fusion.sdf import reading_weights as reading_weights
    from rangesim.fusion.sdf import signed_distance as signed_distance
    from rangesim.fusion.seen_volume import Occupancy as Occupancy
    from rangesim.fusion.seen_volume import SeenOfShape as SeenOfShape
    from rangesim.fusion.seen_volume import VoxelState as VoxelState
    from rangesim.fusion.seen_volume import occupancy as occupancy
    from rangesim.fusion.seen_volume import true_occupancy as true_occupancy
    from rangesim.fusion.seen_volume import voxel_states as voxel_states
    from rangesim.fusion.solids import Solid as Solid
    from rangesim.fusion.solids import attenuation_volume as attenuation_volume
    from rangesim.fusion.solids import inside_voxels as inside_voxels
    from rangesim.fusion.truncated_average import FusedSurface as FusedSurface
    from rangesim.fusion.truncated_average import fuse as fuse
    from rangesim.fusion.virtual_cameras import pinhole_views as pinhole_views
    from rangesim.fusion.voxel_grid import VoxelGrid as VoxelGrid
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "computed_tomography": [
                "Sinogram",
                "filtered_back_projection",
                "sampling_angles",
                "with_photon_noise",
                "xray_projections",
            ],
            "solids": ["Solid", "attenuation_volume", "inside_voxels"],
            "joint_registration": ["refine_jointly"],
            "mesh_error": ["SurfaceError", "surface_error"],
            "multiway_registration": ["Alignment", "PairFit", "PoseErrors", "align", "pose_errors"],
            "virtual_cameras": ["pinhole_views"],
            "posed_images": ["Scan"],
            "sdf": ["average_signed_distances", "reading_weights", "signed_distance"],
            "seen_volume": ["Occupancy", "SeenOfShape", "VoxelState", "occupancy", "true_occupancy", "voxel_states"],
            "truncated_average": ["FusedSurface", "fuse"],
            "voxel_grid": ["VoxelGrid"],
        },
    )
