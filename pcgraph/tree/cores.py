# SPDX-License-Identifier: Apache-2.0
"""Cores: disjoint nodes that become segments, and the core to which every other leaf goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.tree.segments import children_of


@dataclass(frozen=True, eq=False)
class SizeCores:
    """What remains of a tree when no segment may have fewer than some number of points.

    Attributes
    ----------
    of_leaf : (n_leaves,) int32
        Core of each leaf, a node of the tree.
    joins : (n_cores - 1,) int32
        Nodes that join two groups of cores, ascending. All other merges only make a core larger.
    """

    of_leaf: NDArray[np.int32]
    joins: NDArray[np.int32]


def size_cores(parents: NDArray[np.int32], counts: NDArray[np.int64], min_size: int) -> SizeCores:
    """Cores of a tree for a least number of points: nodes that have it, while neither child has.

    Which segment a small leaf joins at one cut contains the one that it joins at a finer cut.

    Parameters
    ----------
    parents : (k,) int32
        As in `SegmentationTree`.
    counts : (k,) int64
        Points of each node.
    min_size : int
        If the whole tree has fewer points, its root is the only core.
    """
    enough = counts >= min(min_size, int(counts[-1]))
    children = children_of(parents)
    inner = children[:, 0] >= 0
    enough_below = enough[children] & inner[:, None]
    chosen = enough & ~enough_below.any(axis=1)
    joins = np.flatnonzero(enough_below.all(axis=1)).astype(np.int32)
    return SizeCores(core_of_leaf(parents, children, counts, chosen), joins)


@njit(cache=True)
def core_of_leaf(
    parents: NDArray[np.int32], children: NDArray[np.int32], counts: NDArray[np.int64], chosen: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """Chosen node of each leaf, (n_leaves,) int32.

    A leaf below no chosen node climbs to the first node with a chosen node below, and from there descends into
    the larger child that has one. So it goes where the tree would have merged it.

    Parameters
    ----------
    parents, children, counts : (k,), (k, 2), (k,)
    chosen : (k,) bool
        At least one, none above another.
    """
    core = np.full(len(parents), -1, np.int32)
    for node in range(len(parents)):
        a, b = children[node]
        if chosen[node]:
            core[node] = node
        elif a >= 0 and core[a] >= 0 and core[b] >= 0:
            core[node] = core[a] if counts[a] >= counts[b] else core[b]
        elif a >= 0:
            core[node] = max(core[a], core[b])
    for node in range(len(parents) - 2, -1, -1):
        if core[node] < 0:
            core[node] = core[parents[node]]
    return core[: (len(parents) + 1) // 2].copy()
