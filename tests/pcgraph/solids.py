# SPDX-License-Identifier: Apache-2.0
"""Points on boxes and spheres, and a pose to put them in."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

UP = np.array([0.0, 0.0, 1.0])
TURN = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
AWAY = np.array([5.0, -3.0, 2.0])


def surface_of_a_box(size, n=4000, seed=0):
    """Points on all six sides, and their outward normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    side, sign = rng.integers(0, 3, n), rng.choice((-1.0, 1.0), n)
    points[np.arange(n), side] = sign / 2
    normals = np.zeros((n, 3))
    normals[np.arange(n), side] = sign
    return points * size, normals


def sphere(radius, n, lowest=0.0):
    """Points evenly on a sphere above `lowest` radii from its centre, and their normals."""
    height = np.linspace(lowest, 1.0, n)
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    around = np.sqrt(1 - height**2)
    normals = np.column_stack((around * np.cos(turn), around * np.sin(turn), height))
    return radius * normals, normals
