# SPDX-License-Identifier: Apache-2.0
"""Votes: classes of points up the tree, and from the purest nodes down again."""

from __future__ import annotations

from numbers import Real

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pcgraph.learning.pooling import down, pool_up
from pcgraph.segmentation import Segmentation
from pcgraph.tree.tree import SegmentationTree


def votes(segmentation: Segmentation, labels: ArrayLike, n_classes: int | None = None) -> NDArray[np.int64]:
    """Number of points of each class below each node, (k, c) int64, exact.

    Parameters
    ----------
    segmentation : Segmentation
    labels : the points' leading shape, int
        Class of each point, 0..c - 1; negative: unlabelled.
    n_classes : int, optional
        c; default: the largest label plus one.

    Raises
    ------
    ValueError
        The shape is not that of the points, or a label is `n_classes` or more.
    """
    array, leaf = np.asarray(labels), segmentation.supervoxels
    if array.shape != leaf.shape or array.dtype.kind not in "iu":
        raise ValueError(f"expected labels as whole numbers of shape {leaf.shape}, got {array.shape} {array.dtype}")
    voting = (leaf >= 0) & (array >= 0)
    chosen = array[voting].astype(np.int64)
    highest = int(chosen.max(initial=-1))
    if n_classes is not None and (not isinstance(n_classes, int | np.integer) or n_classes < 0):
        raise ValueError(f"expected n_classes as a whole number of at least 0, got {n_classes!r}")
    classes = highest + 1 if n_classes is None else int(n_classes)
    if highest >= classes:
        raise ValueError(f"expected labels below n_classes={classes}, got {highest}")
    tree = segmentation.tree
    flat = np.bincount(leaf[voting].astype(np.int64) * classes + chosen, minlength=tree.n_leaves * classes)
    return pool_up(tree, flat.reshape(tree.n_leaves, classes), reduce="sum")


def majority(votes: ArrayLike) -> NDArray[np.int32]:
    """Class with most votes, (k,) int32; of equals the smallest; -1 without any vote.

    Parameters
    ----------
    votes : (k, c) int, not negative

    Raises
    ------
    ValueError
        The shape or the type is another.
    """
    counts = np.asarray(votes)
    if counts.ndim != 2 or counts.dtype.kind not in "iu":
        raise ValueError(f"expected votes as whole numbers of shape (k, c), got {counts.shape} {counts.dtype}")
    if counts.shape[1] == 0:
        return np.full(len(counts), -1, np.int32)
    return np.where(counts.any(axis=1), counts.argmax(axis=1), -1).astype(np.int32)


def pure_ancestors(
    tree: SegmentationTree, votes: NDArray[np.int64], share: float = 0.95, altitude: float = np.inf
) -> NDArray[np.int32]:
    """Highest node above each leaf whose votes are pure, (n_leaves,) int32; -1 if there is none.

    Parameters
    ----------
    tree : SegmentationTree of k nodes
    votes : (k, c) int64
        As `votes` counts them.
    share : float, 0..1
        A node is pure if it has votes, and the largest class has this share of them at least.
    altitude : float, the tree's unit
        Nodes that came to be above this altitude are not taken.

    Raises
    ------
    ValueError
        There is not one row of votes per node, `share` is not within 0..1, or `altitude` is NaN.
    """
    if votes.ndim != 2 or len(votes) != len(tree.parents):
        raise ValueError(f"expected votes of all {len(tree.parents)} nodes, one row each, got {votes.shape}")
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"expected a share within 0..1, got {share!r}")
    if not isinstance(altitude, Real) or altitude != altitude:
        raise ValueError(f"expected altitude as a number, infinity for no limit, got {altitude!r}")
    total = votes.sum(axis=1)
    pure = (total > 0) & (votes.max(axis=1, initial=0) >= share * total) & (tree.altitudes <= altitude)
    return _highest(tree.parents, pure)[: tree.n_leaves]


def spread_votes(
    segmentation: Segmentation,
    labels: ArrayLike,
    n_classes: int | None = None,
    share: float = 0.95,
    altitude: float = np.inf,
) -> NDArray[np.int32]:
    """Labels of all points from those of a few, in the points' shape, int32; -1: not known.

    A supervoxel takes the majority of the highest node above it whose votes are pure; without such a node, the
    majority of its own votes.

    Parameters
    ----------
    segmentation, labels, n_classes : as for `votes`
    share, altitude : as for `pure_ancestors`
        Where few points are labelled, `altitude` keeps a label within its object.

    Raises
    ------
    ValueError
        As `votes` and `pure_ancestors` do.
    """
    counts, tree = votes(segmentation, labels, n_classes), segmentation.tree
    nodes = pure_ancestors(tree, counts, share, altitude)
    return down(segmentation, majority(counts), np.where(nodes < 0, np.arange(tree.n_leaves), nodes))


@njit(cache=True)
def _highest(parents: NDArray[np.int32], chosen: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Highest chosen node on the way from each node to the root, -1 without; parents before children."""
    highest = np.full(len(parents), -1, np.int32)
    for node in range(len(parents) - 1, -1, -1):
        up = highest[parents[node]] if parents[node] != node else -1
        highest[node] = up if up >= 0 or not chosen[node] else node
    return highest
