# SPDX-License-Identifier: Apache-2.0
"""Average linkage along a graph: the cheapest contact merges first."""

from __future__ import annotations

import heapq

import numpy as np
from numba import njit
from numpy.typing import NDArray

_NONE = -1


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
    low, high = edges[:, 0].astype(np.int64), edges[:, 1].astype(np.int64)
    pairs, altitudes = _merge(n_nodes, low, high, costs * weights, weights.astype(np.float64))
    # A mean may still round down by one unit in the last place.
    return pairs, np.maximum.accumulate(altitudes)


@njit(cache=True)
def _merge(
    n_nodes: int,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    cost_sums: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Merges by a heap of edges; half-edge 2e + side hangs in a doubly linked list at its end node."""
    m = len(low)
    ends = np.empty(2 * m, np.int64)
    after, before = np.full(2 * m, _NONE), np.full(2 * m, _NONE)
    first, degree = np.full(n_nodes, _NONE), np.zeros(n_nodes, np.int64)
    version = np.zeros(m, np.int64)
    heap = [(0.0, np.int64(0), np.int64(0)) for _ in range(0)]  # empty, but typed for the compiler
    for e in range(m):
        ends[2 * e], ends[2 * e + 1] = low[e], high[e]
        _hang(2 * e, ends, after, before, first, degree)
        _hang(2 * e + 1, ends, after, before, first, degree)
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
        _drop(e, ends, after, before, first, degree, version)
        _absorb(kept, gone, ends, after, before, first, degree, version, cost_sums, weights, heap)
    return pairs[:t].copy(), altitudes[:t].copy()


@njit(cache=True)
def _absorb(kept, gone, ends, after, before, first, degree, version, cost_sums, weights, heap):  # type: ignore[no-untyped-def]
    """Move the edges of one cluster to another; where both have one to the same third, the two become one."""
    half = first[gone]
    while half != _NONE:
        following = after[half]
        twin = _find(kept, ends[half ^ 1], ends, after, first, degree)
        moved = half >> 1
        if twin == _NONE:
            _unhang(half, ends, after, before, first, degree)
            ends[half] = kept
            _hang(half, ends, after, before, first, degree)
        else:
            cost_sums[twin] += cost_sums[moved]
            weights[twin] += weights[moved]
            _drop(moved, ends, after, before, first, degree, version)
            version[twin] += 1
            heapq.heappush(heap, (cost_sums[twin] / weights[twin], np.int64(twin), version[twin]))
        half = following


@njit(cache=True)
def _hang(half, ends, after, before, first, degree):  # type: ignore[no-untyped-def]
    """Put a half-edge at the head of its end node's list."""
    node = ends[half]
    after[half], before[half] = first[node], _NONE
    if first[node] != _NONE:
        before[first[node]] = half
    first[node] = half
    degree[node] += 1


@njit(cache=True)
def _unhang(half, ends, after, before, first, degree):  # type: ignore[no-untyped-def]
    """Take a half-edge out of its end node's list."""
    if before[half] == _NONE:
        first[ends[half]] = after[half]
    else:
        after[before[half]] = after[half]
    if after[half] != _NONE:
        before[after[half]] = before[half]
    degree[ends[half]] -= 1


@njit(cache=True)
def _drop(e, ends, after, before, first, degree, version):  # type: ignore[no-untyped-def]
    """Remove an edge from both lists and outdate its entries in the heap."""
    _unhang(2 * e, ends, after, before, first, degree)
    _unhang(2 * e + 1, ends, after, before, first, degree)
    version[e] += 1


@njit(cache=True)
def _find(a, b, ends, after, first, degree):  # type: ignore[no-untyped-def]
    """Edge between two clusters or -1, by a walk along the shorter list."""
    if degree[b] < degree[a]:
        a, b = b, a
    half = first[a]
    while half != _NONE:
        if ends[half ^ 1] == b:
            return half >> 1
        half = after[half]
    return _NONE
