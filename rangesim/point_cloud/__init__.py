# SPDX-License-Identifier: Apache-2.0
"""Organised point clouds, and their files."""

from rangesim.point_cloud.point_cloud import (
    FAR_M,
    FRAMES,
    MAX_SLOPE,
    NORMAL_RADIUS,
    STEP_FLOOR,
    PointCloud,
    from_range_image,
    lattice_normals,
)

__all__ = [
    "FAR_M",
    "FRAMES",
    "MAX_SLOPE",
    "NORMAL_RADIUS",
    "STEP_FLOOR",
    "PointCloud",
    "from_range_image",
    "lattice_normals",
]
