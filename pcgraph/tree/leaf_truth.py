# SPDX-License-Identifier: Apache-2.0
"""What of a true labelling of points matters to the leaves of a tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class LeafTruth:
    """Points per pair of leaf and true segment; r pairs.

    Attributes
    ----------
    leaf, truth : (r,) int64
        Leaf, and true segment numbered from 0 in ascending order of the true labels.
    points : (r,) int64
        Points that lie in both.
    n_leaves : int
    """

    leaf: NDArray[np.int64]
    truth: NDArray[np.int64]
    points: NDArray[np.int64]
    n_leaves: int

    def majority(self, share: float) -> NDArray[np.int64]:
        """True segment of each leaf, (n_leaves,) int64; -1 where none holds this share of its points."""
        order = np.argsort(self.points, kind="stable")
        best, most = np.full(self.n_leaves, -1, np.int64), np.zeros(self.n_leaves)
        best[self.leaf[order]] = self.truth[order]
        most[self.leaf[order]] = self.points[order]
        total = np.bincount(self.leaf, self.points, self.n_leaves)
        return np.where(most >= share * np.maximum(total, 1), best, -1)

    def overlap(self, segments: NDArray[np.int32]) -> float:
        """Weighted overlap, 0..1, of the leaves' segments with the true ones.

        It is `pcgraph.metrics.weighted_overlap` of the points, without a pass over them.

        Parameters
        ----------
        segments : (n_leaves,) int32
        """
        segment, n_true = segments[self.leaf].astype(np.int64), int(self.truth.max()) + 1
        keys, pair = np.unique(segment * n_true + self.truth, return_inverse=True)
        common = np.bincount(pair, self.points)
        found, true = keys // n_true, keys % n_true
        size, extent = np.bincount(segment, self.points), np.bincount(self.truth, self.points)
        best = np.zeros(n_true)
        np.maximum.at(best, true, common / (size[found] + extent[true] - common))
        return float(best @ extent / extent.sum())


def leaf_truth(supervoxels: NDArray[np.int32], truth: ArrayLike, n_leaves: int) -> LeafTruth:
    """Points per pair of leaf and true segment.

    Parameters
    ----------
    supervoxels : (n,) or (h, w) int32
        Leaf of each point, negative where it has none.
    truth : same shape, int
        True segment of each point, negative where unknown.
    n_leaves : int

    Raises
    ------
    ValueError
        The shapes differ, or the truth is not whole numbers.
    """
    true = np.asarray(truth)
    if true.shape != supervoxels.shape:
        raise ValueError(f"expected a truth of shape {supervoxels.shape}, got {true.shape}")
    if true.dtype.kind not in "iub":
        raise ValueError(f"expected a truth of whole numbers, got {true.dtype}; convert it first")
    both = (true >= 0) & (supervoxels >= 0)
    names, column = np.unique(true[both], return_inverse=True)
    n_true = np.int64(max(len(names), 1))
    keys, points = np.unique(supervoxels[both] * n_true + column, return_counts=True)
    return LeafTruth(keys // n_true, keys % n_true, points, n_leaves)
