# SPDX-License-Identifier: Apache-2.0
"""Unit vectors spread evenly over the sphere, and along a plane; which normals are those of one surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SAME_SURFACE_COSINE = np.float32(0.8)
"""Least cosine between the normals of two voxels on one surface, 37 degrees. Measured: with 0.9 for colours no score
differs by 0.004."""
CREASE_COSINE = 0.5
"""Largest cosine between the normals of two voxels at a crease, 60 degrees. Chosen by eye, not varied."""


def sphere_directions(n: int) -> NDArray[np.float64]:
    """Unit vectors evenly over the sphere, (n, 3) float64, from +z downwards: a Fibonacci lattice."""
    number = np.arange(n) + 0.5
    z = 1.0 - 2.0 * number / n
    angle = np.pi * (3.0 - np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z * z)
    return np.stack((across * np.cos(angle), across * np.sin(angle), z), axis=1)


def plane_basis(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors, rows of (2, 3), that form a right-handed frame with a unit normal as the third."""
    helper = np.zeros(3)
    helper[int(np.abs(normal).argmin())] = 1.0
    first = _cross(helper, normal)
    first /= np.linalg.norm(first)
    return np.stack((first, _cross(normal, first)))


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross product of two vectors, (3,); `np.cross` takes ten times as long for one."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
