# SPDX-License-Identifier: Apache-2.0
"""The distance of a voxel to a supervoxel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.voxels.grid import VoxelGrid


class Metric(NamedTuple):
    """D = normal (1 - n . n') + color |c - c'| + spatial |x - x'|, with |n . n'| where `two_sided`.

    Attributes
    ----------
    spatial : float, 1 / metres
    normal, color : float
    two_sided : bool
        Whether opposite normals are the same.
    """

    spatial: float
    normal: float
    color: float
    two_sided: bool


def voxel_features(grid: VoxelGrid, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (place in the warped space, unit normal, colour) of the voxels, (v, 9) float64."""
    features = np.zeros((grid.n_voxels, 9))
    features[:, :3], features[:, 3:6] = grid.warped, normals
    if grid.colors is not None:
        features[:, 6:] = grid.colors
    return features


@njit(cache=True, nogil=True)
def distance(features: NDArray[np.float64], i: int, means: NDArray[np.float64], s: int, metric: Metric) -> float:
    """Distance D of voxel i to supervoxel s, given rows of `voxel_features`."""
    x, y, z = features[i, 0] - means[s, 0], features[i, 1] - means[s, 1], features[i, 2] - means[s, 2]
    cosine = features[i, 3] * means[s, 3] + features[i, 4] * means[s, 4] + features[i, 5] * means[s, 5]
    r, g, b = features[i, 6] - means[s, 6], features[i, 7] - means[s, 7], features[i, 8] - means[s, 8]
    if metric.two_sided:
        cosine = abs(cosine)
    away, tint = np.sqrt(x * x + y * y + z * z), np.sqrt(r * r + g * g + b * b)
    return metric.spatial * away + metric.normal * (1.0 - cosine) + metric.color * tint


@njit(cache=True, nogil=True)
def sum_features(features: NDArray[np.float64], owner: NDArray[np.int32], n_owners: int) -> NDArray[np.float64]:
    """Sums of the features of each supervoxel's voxels, and their number, (n_owners, 10) float64, in voxel order."""
    sums = np.zeros((n_owners, 10))
    for i in range(len(owner)):
        if owner[i] >= 0:
            add_features(features, i, sums, owner[i], 1.0)
    return sums


@njit(cache=True, nogil=True, inline="always")
def add_features(features: NDArray[np.float64], i: int, sums: NDArray[np.float64], s: int, sign: float) -> None:
    """Nothing; voxel i has joined supervoxel s (sign 1) or left it (sign -1)."""
    for column in range(9):
        sums[s, column] += sign * features[i, column]
    sums[s, 9] += sign


@njit(cache=True, nogil=True)
def set_means(sums: NDArray[np.float64], means: NDArray[np.float64]) -> None:
    """Nothing; `means`, (k, 9), become the supervoxels' mean rows, normals at unit length (empty ones stay)."""
    for s in range(len(sums)):
        if sums[s, 9] > 0.0:
            length = max(np.sqrt(sums[s, 3] ** 2 + sums[s, 4] ** 2 + sums[s, 5] ** 2), 1e-12)
            for column in range(9):
                means[s, column] = sums[s, column] / (length if 3 <= column < 6 else sums[s, 9])
