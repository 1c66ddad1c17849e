# SPDX-License-Identifier: Apache-2.0
"""How densely a cloud samples its surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_SAMPLE = 4096
_NO_SPACING_M = 0.01


def median_spacing(points: NDArray[np.float64]) -> float:
    """Median distance to the nearest point elsewhere, metres, over a sample free of the points' order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1. Duplicates count as one point.

    Returns
    -------
    float
        > 0; 0.01 if all points coincide.

    Notes
    -----
    Source: Lin et al. 2018 start from the same median, their lambda_0.
    """
    distances = _nearest(points)
    if not distances.all():
        distances = _nearest(np.unique(points, axis=0))
    distances = distances[(distances > 0.0) & np.isfinite(distances)]
    return float(np.median(distances)) if len(distances) else _NO_SPACING_M


def _nearest(points: NDArray[np.float64]) -> NDArray[np.float64]:
    sample = points
    if len(points) > _SAMPLE:  # the smallest hashes: as good as random, yet a property of the points
        bits = (points + 0.0).view(np.uint64)  # + 0.0 makes one zero of the two
        hashes = (bits * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)) >> 17
        mixed = (hashes[:, 0] ^ hashes[:, 1] ^ hashes[:, 2]) * np.uint64(0xD6E8FEB86659FD93)
        sample = points[np.argpartition(mixed, _SAMPLE)[:_SAMPLE]]
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    return tree.query(sample, k=2)[0][:, 1]
