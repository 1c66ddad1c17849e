# SPDX-License-Identifier: Apache-2.0
"""Average linkage along a graph: the cheapest contact merges first."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.tree.edge_queue import queued_edges, requeue, unqueue
from pcgraph.tree.half_edges import drop, hand_over, hung_edges


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
    pairs, altitudes = _merge(n_nodes, edges, np.stack((costs * weights, weights)))
    # A mean may still round down by one unit in the last place.
    return pairs, np.maximum.accumulate(altitudes)


@njit(cache=True)
def _merge(
    n_nodes: int,
    edges: NDArray[np.int32],
    sums: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    ends, after, before, first, degree = hung_edges(n_nodes, edges)
    costs = sums[0] / sums[1]
    twins, moved = np.empty(len(edges), np.int64), np.empty(len(edges), np.int64)
    order, place, size = queued_edges(costs)
    name = np.arange(n_nodes)  # a cluster lives on under the slot of one of its leaves; this is its tree node
    pairs, altitudes = np.empty((max(n_nodes - 1, 0), 2), np.int32), np.empty(max(n_nodes - 1, 0))
    t = 0
    while size[0] > 0:
        e = order[0]
        kept, gone = ends[2 * e], ends[2 * e + 1]
        pairs[t, 0], pairs[t, 1] = min(name[kept], name[gone]), max(name[kept], name[gone])
        altitudes[t] = costs[e]
        if degree[gone] > degree[kept]:
            kept, gone = gone, kept
        name[kept] = n_nodes + t
        t += 1
        drop(e, ends, after, before, first, degree)
        unqueue(e, costs, order, place, size)
        for pair in range(hand_over(kept, gone, ends, after, before, first, degree, sums, twins, moved)):
            unqueue(moved[pair], costs, order, place, size)
            twin = twins[pair]
            costs[twin] = sums[0, twin] / sums[1, twin]
            requeue(twin, costs, order, place, size)
    return pairs[:t].copy(), altitudes[:t].copy()
