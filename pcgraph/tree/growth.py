# SPDX-License-Identifier: Apache-2.0
"""Growing the segmentation tree: along the graph first, then across the gaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcgraph.features.moments import Moments, moments_up_tree
from pcgraph.tree.linkage import Merges
from pcgraph.tree.tree import SegmentationTree

_GAP_CANDIDATES = 8


def segmentation_tree(merges: Merges, leaves: Moments) -> SegmentationTree:
    """Tree over k leaves: a linkage's merges, then those across the gaps.

    Parameters
    ----------
    merges : Merges of k leaves
        Along the edges of their graph.
    leaves : Moments of k leaves

    Notes
    -----
    Parts that do not touch are joined at infinite altitude, the smallest (in points) first, each to the
    nearest larger part. So cuts below infinity never mix them, and a cut into few segments keeps the large
    parts apart.
    """
    n_leaves, n_merges = len(leaves), len(merges.pairs)
    parents = np.arange(2 * n_leaves - 1, dtype=np.int32)
    parents[merges.pairs] = np.arange(n_leaves, n_leaves + n_merges, dtype=np.int32)[:, None]
    parts = _roots(parents[: n_leaves + n_merges])[:n_leaves]
    gaps = _join_parts(parts, leaves, n_leaves + n_merges)
    parents[gaps] = np.arange(n_leaves + n_merges, 2 * n_leaves - 1, dtype=np.int32)[:, None]
    levels = np.concatenate((np.zeros(n_leaves), merges.altitudes, np.full(len(gaps), np.inf)))
    return SegmentationTree(parents, levels, moments_up_tree(leaves, parents))


def _roots(parents: NDArray[np.int32]) -> NDArray[np.int32]:
    up = parents
    while not np.array_equal(further := up[up], up):
        up = further
    return up


def _join_parts(parts: NDArray[np.int32], leaves: Moments, next_node: int) -> NDArray[np.int32]:
    """Merges, (p - 1, 2) int32, of p parts, given by the root node of each leaf."""
    roots, part = np.unique(parts, return_inverse=True)
    if len(roots) == 1:
        return np.empty((0, 2), np.int32)
    sizes = np.bincount(part, leaves.counts)
    order = np.lexsort((-roots, sizes))  # ascending size; of equal parts the later one is absorbed first
    rank = np.empty(len(roots), np.int64)
    rank[order] = np.arange(len(roots))
    target = _nearest_larger(part, rank, leaves.centroids)
    name = roots.copy()
    merges = np.empty((len(roots) - 1, 2), np.int32)
    for step, small in enumerate(order[:-1].tolist()):
        merges[step] = sorted((name[small], name[target[small]]))
        name[target[small]] = next_node + step
    return merges


def _nearest_larger(
    part: NDArray[np.int64], rank: NDArray[np.int64], centroids: NDArray[np.float64]
) -> NDArray[np.int64]:
    """For each part the larger one with a leaf nearest to its own; the largest part if none is near."""
    n_near = min(_GAP_CANDIDATES + 1, len(centroids))
    seeking = np.flatnonzero(rank[part] < len(rank) - 1)  # the largest part looks for none
    distance, leaf = cKDTree(centroids).query(centroids[seeking], k=n_near)
    row, column = np.nonzero(rank[part[leaf]] > rank[part[seeking]][:, None])
    source, candidate = part[seeking[row]], part[leaf[row, column]]
    best = np.lexsort((candidate, distance[row, column], source))
    source_part = source[best]
    first = np.flatnonzero(np.diff(source_part, prepend=-1))
    target = np.full(len(rank), int(np.argmax(rank)), np.int64)
    target[source_part[first]] = candidate[best][first]
    return target
