# SPDX-License-Identifier: Apache-2.0
"""Noise of a surface, read off its flattest parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FLAT_SHARE = 0.25  # a quarter of any scene is taken to be flat enough to show the noise
GROUPS = 8
GROUP_SIZE = 20
SAME_SIZE = 1.2  # ratio of voxel edges below which there is nothing to learn about distance
STEEPEST = 3.0  # noise of active sensors grows at most with the cube of the distance


def surface_noise(
    residuals: NDArray[np.float64], edges: NDArray[np.float64], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Standard deviation of the noise at each supervoxel, (n,) float64, metres.

    Parameters
    ----------
    residuals : (n,) float64, metres
        Root mean square distance of each supervoxel's points to its plane.
    edges : (n,) float64, metres
        Mean edge of its voxels; where voxels grow with the distance this stands for the distance.
    counts : (n,) int64
        Its number of points.

    Notes
    -----
    The quarter with the smallest residuals shows the noise; where voxels grow, that of eight groups by distance,
    through which goes a power law (exponent 1 to 3).
    """
    order = np.argsort(edges, kind="stable")
    n_groups = min(GROUPS, len(edges) // GROUP_SIZE)
    if n_groups < 2 or edges[order[-1]] < SAME_SIZE * edges[order[0]]:
        return edges * _quantile(residuals / edges, counts)
    groups = np.array_split(order, n_groups)
    levels = np.array([_quantile(residuals[group], counts[group]) for group in groups])
    places = np.array([np.median(edges[group]) for group in groups])
    seen = levels > 0.0
    if seen.sum() < 2:
        return edges * _quantile(residuals / edges, counts)
    x, y = np.log(places[seen]), np.log(levels[seen])
    spread = float(((x - x.mean()) ** 2).sum())
    slope = float(((x - x.mean()) * (y - y.mean())).sum()) / spread if spread > 0.0 else 1.0
    slope = float(np.clip(slope, 1.0, STEEPEST))
    return np.exp(np.median(y - slope * x)) * edges**slope


def _quantile(values: NDArray[np.float64], weights: NDArray[np.int64]) -> float:
    """Smallest value such that values up to it have the flat share of the weights."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, FLAT_SHARE * reached[-1])])
