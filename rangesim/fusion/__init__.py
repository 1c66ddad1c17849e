# SPDX-License-Identifier: Apache-2.0
"""Many views to one surface, and what a range sensor never sees; names load on first use. See docs/fusion.md."""

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
    from rangesim.fusion.scan import Scan as Scan
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
            "scan": ["Scan"],
            "sdf": ["average_signed_distances", "reading_weights", "signed_distance"],
            "seen_volume": ["Occupancy", "SeenOfShape", "VoxelState", "occupancy", "true_occupancy", "voxel_states"],
            "truncated_average": ["FusedSurface", "fuse"],
            "voxel_grid": ["VoxelGrid"],
        },
    )
