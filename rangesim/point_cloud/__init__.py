# SPDX-License-Identifier: Apache-2.0
"""Point clouds that are organised as the image they come from, with normals, and their files."""

from rangesim.point_cloud.point_cloud import (
    COORDINATES,
    FAR_M,
    MAX_SLOPE,
    NORMAL_RADIUS,
    STEP_FLOOR,
    PointCloud,
    lattice_normals,
    organised_cloud,
)

__all__ = [
    "COORDINATES",
    "FAR_M",
    "MAX_SLOPE",
    "NORMAL_RADIUS",
    "STEP_FLOOR",
    "PointCloud",
    "lattice_normals",
    "organised_cloud",
]
