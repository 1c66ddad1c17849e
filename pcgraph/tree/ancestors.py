# SPDX-License-Identifier: Apache-2.0
"""Lowest common ancestors, in a time that does not depend on the tree's depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pcgraph.tree.segments import children_of


@dataclass(frozen=True, eq=False)
class AncestorIndex:
    """Leaves linked by size: at each merge the larger side keeps its representative, the other one links to it.

    A leaf's side at least doubles with each link, so no chain is longer than log2 of the number of leaves.

    Attributes
    ----------
    links : (n_leaves,) int32
        Representative to which a leaf's representative was linked; its own for the last one.
    merges : (n_leaves,) int32
        Node at which that happened; larger than any node for the last one.
    """

    links: NDArray[np.int32]
    merges: NDArray[np.int32]

    def of_pairs(self, pairs: ArrayLike) -> NDArray[np.int32]:
        """Lowest common ancestor of each pair of leaves, (m,) int32; the leaf itself where the two are one.

        Parameters
        ----------
        pairs : (m, 2) int, 0..n_leaves - 1

        Raises
        ------
        ValueError
            Pairs are not (m, 2) whole numbers, or not leaves of the tree.
        """
        leaves, last = np.asarray(pairs), len(self.links) - 1
        if leaves.ndim != 2 or leaves.shape[1] != 2 or (leaves.size and leaves.dtype.kind not in "iu"):
            raise ValueError(
                f"expected pairs (m, 2) of leaves, whole numbers, got {leaves.dtype} of shape {leaves.shape}"
            )
        if leaves.size and not 0 <= leaves.min() <= leaves.max() <= last:
            raise ValueError(f"expected pairs of this tree's leaves 0..{last}, got {leaves.min()}..{leaves.max()}")
        return _common_ancestors(self.links, self.merges, np.ascontiguousarray(leaves, np.int32))


def ancestor_index(parents: NDArray[np.int32]) -> AncestorIndex:
    """Index of the tree with these parents, (k,) int32, as in `SegmentationTree`."""
    return AncestorIndex(*_link(parents, children_of(parents)))


@njit(cache=True)
def _link(parents: NDArray[np.int32], children: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    k = len(parents)
    n_leaves = (k + 1) // 2
    links, merges = np.arange(n_leaves).astype(np.int32), np.full(n_leaves, k, np.int32)
    representative, leaves = np.arange(k).astype(np.int32), np.ones(k, np.int64)
    for node in range(n_leaves, k):
        large, small = children[node]
        if leaves[small] > leaves[large]:
            large, small = small, large
        links[representative[small]] = representative[large]
        merges[representative[small]] = node
        representative[node] = representative[large]
        leaves[node] = leaves[large] + leaves[small]
    return links, merges


@njit(cache=True)
def common_ancestor(links: NDArray[np.int32], merges: NDArray[np.int32], a: int, b: int) -> int:
    """Lowest common ancestor of two leaves: the side that was linked first climbs until both meet."""
    node = a
    while a != b:
        if merges[a] < merges[b]:
            node, a = merges[a], links[a]
        else:
            node, b = merges[b], links[b]
    return node


@njit(cache=True)
def _common_ancestors(
    links: NDArray[np.int32], merges: NDArray[np.int32], pairs: NDArray[np.int32]
) -> NDArray[np.int32]:
    nodes = np.empty(len(pairs), np.int32)
    for i in range(len(pairs)):
        nodes[i] = common_ancestor(links, merges, pairs[i, 0], pairs[i, 1])
    return nodes
