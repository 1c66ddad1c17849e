# SPDX-License-Identifier: Apache-2.0
"""The distance of a voxel to a supervoxel."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def distance(
    features: NDArray[np.float64], i: int, means: NDArray[np.float64], s: int, scale: NDArray[np.float64]
) -> float:
    """VCCS distance of voxel i to supervoxel s, given rows of (position, unit normal, colour)."""
    space = tint = cosine = 0.0
    for axis in range(3):
        space += (features[i, axis] - means[s, axis]) ** 2
        cosine += features[i, 3 + axis] * means[s, 3 + axis]
        tint += (features[i, 6 + axis] - means[s, 6 + axis]) ** 2
    return scale[0] * np.sqrt(space) + scale[1] * (1.0 - cosine) + scale[2] * np.sqrt(tint)


@njit(cache=True)
def update_means(
    features: NDArray[np.float64],
    owner: NDArray[np.int32],
    sums: NDArray[np.float64],
    means: NDArray[np.float64],
) -> None:
    """Nothing; `means` become the supervoxels' mean rows, normals at unit length (empty ones stay).

    Sums are taken anew, in voxel order, rather than kept up to date: so they carry no history of rounding.
    """
    sums[:] = 0.0
    for i in range(len(owner)):
        s = owner[i]
        if s >= 0:
            for column in range(9):
                sums[s, column] += features[i, column]
            sums[s, 9] += 1.0
    for s in range(len(sums)):
        if sums[s, 9] > 0.0:
            length = np.sqrt(sums[s, 3] ** 2 + sums[s, 4] ** 2 + sums[s, 5] ** 2)
            for column in range(9):
                divisor = max(length, 1e-12) if 3 <= column < 6 else sums[s, 9]
                means[s, column] = sums[s, column] / divisor
