# SPDX-License-Identifier: Apache-2.0
"""Point clouds with normals, in the rows and columns of the image that they come from, and their files."""

from rangesim.point_cloud.point_cloud import (
    COORDINATES,
    FAR_M,
    MAX_SLOPE,
    NORMAL_RADIUS,
    SCAN_DTYPES,
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
    "SCAN_DTYPES",
    "STEP_FLOOR",
    "PointCloud",
    "lattice_normals",
    "organised_cloud",
]
