# SPDX-License-Identifier: Apache-2.0
"""Organised point clouds, and their files."""

from rangesim.point_cloud.point_cloud import (
    COORDINATES,
    FAR_M,
    MAX_SLOPE,
    NORMAL_RADIUS,
    STEP_FLOOR,
    PointCloud,
    from_range_image,
    lattice_normals,
)

__all__ = [
    "COORDINATES",
    "FAR_M",
    "MAX_SLOPE",
    "NORMAL_RADIUS",
    "STEP_FLOOR",
    "PointCloud",
    "from_range_image",
    "lattice_normals",
]
