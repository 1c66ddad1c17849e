# SPDX-License-Identifier: Apache-2.0
"""Where two leaves of a tree meet, in a time that does not depend on the tree's depth."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def lowest_common(
    parents: NDArray[np.int64], n_leaves: int, left: NDArray[np.int64], right: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Lowest common ancestor of each pair of leaves, (m,) int64; the leaf itself where the two are one.

    Parameters
    ----------
    parents : (k,) int64
        As `checked_parents` gives them; nodes may have any number of children.
    n_leaves : int
    left, right : (m,) int64

    Notes
    -----
    The smaller of two parts is linked to the larger one where they merge, so that no chain of links is longer than
    log2 of the number of leaves. Of two leaves the one whose part is linked first goes on, until both are one.
    """
    links, merges = _linked(parents, n_leaves)
    meeting = np.empty(len(left), np.int64)
    for i in range(len(left)):
        a, b = left[i], right[i]
        node = a
        while a != b:
            if merges[b] < merges[a]:
                a, b = b, a
            node, a = merges[a], links[a]
        meeting[i] = node
    return meeting


@njit(cache=True)
def _linked(parents: NDArray[np.int64], n_leaves: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Leaf to which each leaf's part is linked, and node at which; itself and k for the last one."""
    k = len(parents)
    links, merges = np.arange(n_leaves), np.full(n_leaves, k)
    name, leaves = np.arange(k), np.zeros(k, np.int64)  # of each node, by the leaf that stands for its part
    leaves[:n_leaves] = 1
    for node in range(k - 1):
        up = parents[node]
        if leaves[up] == 0:
            name[up] = name[node]
        else:
            large, small = name[up], name[node]
            if leaves[node] > leaves[up]:
                large, small = small, large
            links[small], merges[small] = large, up
            name[up] = large
        leaves[up] += leaves[node]
    return links, merges
