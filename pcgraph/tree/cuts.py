# SPDX-License-Identifier: Apache-2.0
"""Cuts of a tree: the node that each leaf ends up in, by altitude, number and size.

A cut chooses nodes, none above another. A leaf goes to the chosen node above it. If there is none, because the nodes
above the leaf are too small, the leaf goes to the chosen node with which the tree would have merged it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.hierarchy import binary_children, num_leaves, propagate_sequential, propagation_sources
from pcgraph.inputs import whole_number
from pcgraph.parallel import kernel


def horizontal_cut(
    parents: NDArray[np.int32],
    altitudes: NDArray[np.float64],
    counts: NDArray[np.int64],
    n: int | None,
    altitude: float | None,
    min_size: int,
) -> NDArray[np.int32]:
    """Node of each leaf, (n_leaves,) int32, after the merges up to an altitude or down to a number of segments.

    Parameters
    ----------
    parents, altitudes : (k,) int32, (k,) float64
        As in `SegmentationTree`.
    counts : (k,) int64
        Points of each node.
    n, altitude, min_size
        As for `SegmentationTree.cut`, with its errors.
    """
    n_leaves = num_leaves(parents)
    if whole_number("min_size", min_size) == 1:
        last = n_leaves + _merges(altitudes[n_leaves:], n, altitude, n_leaves)
        return propagation_sources(parents, parents < last)[:n_leaves].copy()
    cores = size_cores(parents, counts, min_size)
    least = f" of {min_size} points or more"
    merges = _merges(altitudes[n_leaves:], n, altitude, len(cores.joins) + 1, least)
    last = n_leaves + merges
    if n is not None:  # `merges` counts only those that join cores
        last = int(cores.joins[merges - 1]) + 1 if merges > 0 else 0
    return propagation_sources(parents, parents < last)[cores.of_leaf]


def _merges(
    merge_altitudes: NDArray[np.float64], n: int | None, altitude: float | None, most: int, least: str = ""
) -> int:
    """Number of merges of a cut; the finest cut has `most` segments, and `least` says in errors how large they are."""
    if n is not None and altitude is None:
        if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or not 1 <= n <= most:
            raise ValueError(f"expected a whole number n of 1..{most} segments{least}, got {n!r}")
        return most - int(n)
    if altitude is None or n is not None:
        raise ValueError(f"expected either n or altitude, got n={n} and altitude={altitude}")
    level = np.asarray(altitude)
    if level.ndim or level.dtype.kind not in "fiu" or np.isnan(level):
        raise ValueError(f"expected altitude as a number in the linkage's unit, got {altitude!r}")
    return int(np.searchsorted(merge_altitudes, float(level), side="right"))


def numbered_segments(nodes: NDArray[np.int32], n_nodes: int) -> NDArray[np.int32]:
    """Segment of each leaf, (n_leaves,) int32, numbered from 0 in the order of their first leaf.

    Parameters
    ----------
    nodes : (n_leaves,) int32, 0..n_nodes - 1
        Leaves with the same node are one segment.
    n_nodes : int
    """
    leaves, first, number = np.arange(len(nodes)), np.empty(n_nodes, np.int64), np.empty(n_nodes, np.int32)
    first[nodes[::-1]] = leaves[::-1]  # of equal nodes the last one written stays
    firsts = nodes[first[nodes] == leaves]
    number[firsts] = np.arange(len(firsts))
    return number[nodes]


# --- cores: segments of a least size ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SizeCores:
    """Cores of a tree: the segments of its finest cut in which none has fewer than some number of points.

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
    """Cores of a tree for a least number of points: nodes that have so many, and no child that has.

    Cuts nest: the segment that a small leaf joins at one cut contains the one that it joins at a finer cut.

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
    pairs = binary_children(parents)
    inner = pairs[:, 0] >= 0
    enough_below = enough[pairs] & inner[:, None]
    chosen = enough & ~enough_below.any(axis=1)
    joins = np.flatnonzero(enough_below.all(axis=1)).astype(np.int32)
    return SizeCores(core_of_leaf(parents, counts, chosen), joins)


def core_of_leaf(parents: NDArray[np.int32], counts: NDArray[np.int64], chosen: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Chosen node of each leaf, (n_leaves,) int32.

    A leaf without a chosen node above it climbs to the first node with a chosen node below it. From there it descends
    into the larger child that has one. So it goes where the tree would have merged it.

    Parameters
    ----------
    parents, counts : (k,)
    chosen : (k,) bool
        At least one, none above another.
    """
    core = _cores_below(binary_children(parents), counts, chosen)
    return propagate_sequential(parents, core, core < 0)[: num_leaves(parents)].copy()


@kernel
def _cores_below(
    children: NDArray[np.int32], counts: NDArray[np.int64], chosen: NDArray[np.bool_]
) -> NDArray[np.int32]:
    """Chosen node at or below each node, that of the larger child if both have one; -1 if there is none."""
    core = np.full(len(children), -1, np.int32)
    for node in range(len(children)):
        a, b = children[node]
        if chosen[node]:
            core[node] = node
        elif a >= 0 and core[a] >= 0 and core[b] >= 0:
            core[node] = core[a] if counts[a] >= counts[b] else core[b]
        elif a >= 0:
            core[node] = max(core[a], core[b])
    return core


# --- persistence ------------------------------------------------------------------------------------------------------


def persistences(parents: NDArray[np.int32], altitudes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Range of altitudes over which each node is a segment of the horizontal cuts, (k,) float64.

    It is the parent's altitude less the node's own: infinite for nodes that never merge below infinity, 0 for nodes
    that come to be at infinity.
    """
    above = altitudes[parents]
    above[-1] = np.inf
    born = np.isfinite(altitudes)
    return np.subtract(above, altitudes, out=np.zeros(len(parents)), where=born)
