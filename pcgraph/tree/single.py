# SPDX-License-Identifier: Apache-2.0
"""Single linkage along a graph: Kruskal's minimum spanning forest as merges."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def single_linkage(
    n_nodes: int, edges: NDArray[np.int32], costs: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int64]]:
    """Binary merges of nodes over the cheapest edge between them, until every component is one node.

    Parameters
    ----------
    n_nodes : int
    edges : (m, 2) int32
    costs : (m,) float64

    Returns
    -------
    pairs : (t, 2) int32
        Merge i joins these two into the new node n_nodes + i.
    altitudes : (t,) float64
        Cost of the edge that joins them, not decreasing. Of equal costs the first edge merges first.
    forest : (t,) int64
        That edge.
    """
    order = np.argsort(costs, kind="stable")
    pairs, taken = _kruskal(n_nodes, edges[order])
    forest = order[taken]
    return pairs, costs[forest], forest


@njit(cache=True)
def root_of(roots: NDArray[np.int64], node: int) -> int:
    """Representative of a node's set; paths are halved on the way."""
    while roots[node] != node:
        roots[node] = roots[roots[node]]
        node = roots[node]
    return node


@njit(cache=True)
def _kruskal(n_nodes: int, edges: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Merges, and which edges made them; edges come in ascending order of cost."""
    roots, size = np.arange(n_nodes), np.ones(n_nodes, np.int64)
    name = np.arange(n_nodes)  # tree node of the set with this root
    pairs, taken = np.empty((max(n_nodes - 1, 0), 2), np.int32), np.empty(max(n_nodes - 1, 0), np.int64)
    t = 0
    for e in range(len(edges)):
        a, b = root_of(roots, edges[e, 0]), root_of(roots, edges[e, 1])
        if a == b:
            continue
        if size[b] > size[a]:
            a, b = b, a
        pairs[t, 0], pairs[t, 1] = min(name[a], name[b]), max(name[a], name[b])
        taken[t] = e
        roots[b] = a
        size[a] += size[b]
        name[a] = n_nodes + t
        t += 1
    return pairs[:t].copy(), taken[:t].copy()
