# SPDX-License-Identifier: Apache-2.0
"""Many views to one surface, and what a range sensor never sees; names load on first use. See docs/fusion.md."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from rangesim.fusion.mesh_error import SurfaceError as SurfaceError
    from rangesim.fusion.mesh_error import surface_error as surface_error
    from rangesim.fusion.sdf import average_signed_distances as average_signed_distances
    from rangesim.fusion.sdf import reading_weights as reading_weights
    from rangesim.fusion.sdf import signed_distance as signed_distance
    from rangesim.fusion.truncated_average import FusedSurface as FusedSurface
    from rangesim.fusion.truncated_average import fuse as fuse
    from rangesim.fusion.voxel_grid import VoxelGrid as VoxelGrid
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "truncated_average": ["FusedSurface", "fuse"],
            "sdf": ["average_signed_distances", "reading_weights", "signed_distance"],
            "mesh_error": ["SurfaceError", "surface_error"],
            "voxel_grid": ["VoxelGrid"],
        },
    )
