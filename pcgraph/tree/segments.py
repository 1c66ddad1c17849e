# SPDX-License-Identifier: Apache-2.0
"""From nodes of a tree to the segments of its leaves."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def numbered_segments(nodes: NDArray[np.int32], n_nodes: int) -> NDArray[np.int32]:
    """Segment of each leaf, (n_leaves,) int32, numbered from 0 in the order of their first leaf.

    Parameters
    ----------
    nodes : (n_leaves,) int32, 0..n_nodes - 1
        Leaves with the same node share a segment.
    n_nodes : int
    """
    number = np.full(n_nodes, -1, np.int32)
    segments = np.empty(len(nodes), np.int32)
    used = 0
    for leaf in range(len(nodes)):
        if number[nodes[leaf]] < 0:
            number[nodes[leaf]] = used
            used += 1
        segments[leaf] = number[nodes[leaf]]
    return segments


@njit(cache=True)
def tops_below(parents: NDArray[np.int32], last: int) -> NDArray[np.int32]:
    """Highest node at or above each node, (k,) int32, with a number below `last`; the node itself from `last` on.

    Parameters
    ----------
    parents : (k,) int32
        Larger than the node's own number, so one pass from the root down settles parents before children.
    last : int
    """
    top = np.arange(len(parents), dtype=np.int32)
    for node in range(min(last, len(parents)) - 1, -1, -1):
        if parents[node] < last:
            top[node] = top[parents[node]]
    return top


@njit(cache=True)
def children_of(parents: NDArray[np.int32]) -> NDArray[np.int32]:
    """The two children of each node, (k, 2) int32, the smaller number first; -1 for leaves."""
    children = np.full((len(parents), 2), -1, np.int32)
    for node in range(len(parents)):
        up = parents[node]
        if up != node:
            children[up, 1 if children[up, 0] >= 0 else 0] = node
    return children
