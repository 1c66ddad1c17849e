# SPDX-License-Identifier: Apache-2.0
"""Average linkage along a graph: the cheapest contact merges first."""

from __future__ import annotations

import heapq

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.tree.half_edges import NONE, drop, find, hang, hung_edges, unhang


def average_linkage(
    n_nodes: int, edges: NDArray[np.int32], costs: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Binary merges of nodes along edges until every connected component is one node.

    Parameters
    ----------
    n_nodes : int
    edges : (m, 2) int32
        Pairs of distinct nodes, each pair once.
    costs : (m,) float64
        Finite; cost of merging over an edge alone.
    weights : (m,) float64
        > 0, for example contact lengths.

    Returns
    -------
    pairs : (t, 2) int32
        Merge i joins these two into the new node n_nodes + i.
    altitudes : (t,) float64
        Weighted mean cost of all edges between the two, not decreasing. Of equal costs the first edge merges
        first.

    Notes
    -----
    A mean of two costs is never below the smaller one, so merging in ascending order yields ascending
    altitudes.
    """
    pairs, altitudes = _merge(n_nodes, edges, costs * weights, weights.astype(np.float64))
    # A mean may still round down by one unit in the last place.
    return pairs, np.maximum.accumulate(altitudes)


@njit(cache=True)
def _merge(
    n_nodes: int,
    edges: NDArray[np.int32],
    cost_sums: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Merges by a heap of edges; an entry counts only if its stamp is the edge's version."""
    ends, after, before, first, degree = hung_edges(n_nodes, edges)
    version = np.zeros(len(edges), np.int64)
    heap = [(0.0, np.int64(0), np.int64(0)) for _ in range(0)]  # empty, but typed for the compiler
    for e in range(len(edges)):
        heap.append((cost_sums[e] / weights[e], np.int64(e), np.int64(0)))
    heapq.heapify(heap)
    name = np.arange(n_nodes)  # a cluster lives on under the slot of one of its leaves; this is its tree node
    pairs, altitudes = np.empty((max(n_nodes - 1, 0), 2), np.int32), np.empty(max(n_nodes - 1, 0))
    t = 0
    while len(heap) > 0:
        cost, cheapest, stamp = heapq.heappop(heap)
        e = int(cheapest)
        if version[e] != stamp:
            continue
        kept, gone = int(ends[2 * e]), int(ends[2 * e + 1])
        pairs[t, 0], pairs[t, 1] = min(name[kept], name[gone]), max(name[kept], name[gone])
        altitudes[t] = cost
        if degree[gone] > degree[kept]:
            kept, gone = gone, kept
        name[kept] = n_nodes + t
        t += 1
        drop(e, ends, after, before, first, degree, version)
        _absorb(kept, gone, ends, after, before, first, degree, version, cost_sums, weights, heap)
    return pairs[:t].copy(), altitudes[:t].copy()


@njit(cache=True)
def _absorb(kept, gone, ends, after, before, first, degree, version, cost_sums, weights, heap):  # type: ignore[no-untyped-def]
    """Move the edges of one cluster to another; where both have one to the same third, the two become one."""
    half = first[gone]
    while half != NONE:
        following = after[half]
        twin = find(kept, ends[half ^ 1], ends, after, first, degree)
        moved = half >> 1
        if twin == NONE:
            unhang(half, ends, after, before, first, degree)
            ends[half] = kept
            hang(half, ends, after, before, first, degree)
        else:
            cost_sums[twin] += cost_sums[moved]
            weights[twin] += weights[moved]
            drop(moved, ends, after, before, first, degree, version)
            version[twin] += 1
            heapq.heappush(heap, (cost_sums[twin] / weights[twin], np.int64(twin), version[twin]))
        half = following
