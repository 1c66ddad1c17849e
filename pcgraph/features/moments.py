# SPDX-License-Identifier: Apache-2.0
"""Additive moments: what two groups of points know together follows from what each knows alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Moments:
    """Number, means and scatter of k groups of points.

    Scatter is kept about each group's own centroid, not about the origin, so nothing cancels when a cloud
    lies far from its frame's origin.

    Attributes
    ----------
    counts : (k,) int64
        Points per group, >= 1.
    centroids : (k, 3) float64, metres
    scatters : (k, 3, 3) float64, square metres
        Sum over the points of (x - centroid)(x - centroid)^T.
    colors : (k, 3) float64, 0..1, or None
        Mean colour.
    """

    counts: NDArray[np.int64]
    centroids: NDArray[np.float64]
    scatters: NDArray[np.float64]
    colors: NDArray[np.float64] | None

    def __len__(self) -> int:
        """Number of groups."""
        return len(self.counts)

    @property
    def covariances(self) -> NDArray[np.float64]:
        """Scatter over number of points, (k, 3, 3) float64, square metres."""
        return self.scatters / self.counts[:, None, None]


def moments_of_groups(
    points: NDArray[np.float64], colors: NDArray[np.float64] | None, groups: NDArray[np.int32], n_groups: int
) -> Moments:
    """Moments of points by group.

    Parameters
    ----------
    points : (n, 3) float64, metres
    colors : (n, 3) float64, 0..1, or None
    groups : (n,) int32, 0..n_groups - 1
        Every group has a point at least.
    n_groups : int
    """
    counts = np.bincount(groups, minlength=n_groups)
    reference = _group_means(points, groups, counts)
    residual = points - reference[groups]
    correction = _group_means(residual, groups, counts)  # the first means round; the second pass mends that
    residual -= correction[groups]
    scatters = np.empty((n_groups, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            products = np.bincount(groups, residual[:, i] * residual[:, j], n_groups)
            scatters[:, i, j] = scatters[:, j, i] = products
    means = None if colors is None else _group_means(colors, groups, counts)
    return Moments(counts, reference + correction, scatters, means)


def moments_up_tree(leaves: Moments, parents: NDArray[np.int32]) -> Moments:
    """Moments of every node of a binary tree, from those of its leaves.

    Parameters
    ----------
    leaves : Moments
        Of the first nodes, in order.
    parents : (k,) int32
        Parent of each node; larger than the node's own number, except for the root, which is its own parent.
    """
    from pcgraph.features.pooling import pool_moments

    k, n_leaves = len(parents), len(leaves)
    counts = np.zeros(k, np.int64)
    centroids, scatters = np.zeros((k, 3)), np.zeros((k, 3, 3))
    colors = np.zeros((k, 3))
    counts[:n_leaves], centroids[:n_leaves], scatters[:n_leaves] = (
        leaves.counts,
        leaves.centroids,
        leaves.scatters,
    )
    if leaves.colors is not None:
        colors[:n_leaves] = leaves.colors
    pool_moments(parents, counts, centroids, scatters, colors)
    return Moments(counts, centroids, scatters, None if leaves.colors is None else colors)


def _group_means(
    values: NDArray[np.float64], groups: NDArray[np.int32], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    sums = [np.bincount(groups, values[:, axis], len(counts)) for axis in range(values.shape[1])]
    return np.stack(sums, axis=1) / counts[:, None]
