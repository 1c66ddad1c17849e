# SPDX-License-Identifier: Apache-2.0
"""Contraction of a graph, the cheapest edge first: what average and least-increase linkage have in common.

Edges stand in a heap by their cost and, by their two halves, in the lists of the clusters that they join. A linkage
repeats `contract_cheapest` and then corrects the costs that the merge has changed (`heap_update`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

NONE = -1


# --- a heap of edges whose costs change -------------------------------------------------------------------------------


class EdgeHeap(NamedTuple):
    """Binary heap of m edges: the cheapest on top, of equals the first in number.

    Attributes
    ----------
    costs : (m,) float64
    order : (m,) int64
        The heap: its first `size` elements are edges.
    place : (m,) int64
        Where each edge stands in `order`.
    size : (1,) int64
    """

    costs: NDArray[np.float64]
    order: NDArray[np.int64]
    place: NDArray[np.int64]
    size: NDArray[np.int64]


@njit(cache=True)
def edge_heap(costs: NDArray[np.float64]) -> EdgeHeap:
    """Heap of all edges."""
    m = len(costs)
    heap = EdgeHeap(costs, np.arange(m), np.arange(m), np.array([m]))
    for at in range(m // 2 - 1, -1, -1):
        _sift_down(heap, at)
    return heap


@njit(cache=True)
def heap_update(heap: EdgeHeap, edge: int) -> None:
    """Put an edge in its place after its cost changed."""
    _sift_up(heap, heap.place[edge])
    _sift_down(heap, heap.place[edge])


@njit(cache=True)
def heap_remove(heap: EdgeHeap, edge: int) -> None:
    """Take an edge out."""
    at, last = heap.place[edge], heap.size[0] - 1
    heap.size[0] = last
    if at != last:
        moved = heap.order[last]
        heap.order[at], heap.place[moved] = moved, at
        heap_update(heap, moved)


@njit(cache=True)
def _is_cheaper(costs: NDArray[np.float64], a: int, b: int) -> bool:
    return costs[a] < costs[b] or (costs[a] == costs[b] and a < b)


@njit(cache=True)
def _sift_up(heap: EdgeHeap, at: int) -> None:
    costs, order, place, _ = heap
    edge = order[at]
    while at > 0:
        above = (at - 1) // 2
        if not _is_cheaper(costs, edge, order[above]):
            break
        order[at] = order[above]
        place[order[at]] = at
        at = above
    order[at], place[edge] = edge, at


@njit(cache=True)
def _sift_down(heap: EdgeHeap, at: int) -> None:
    costs, order, place, size = heap
    edge = order[at]
    while True:
        below = 2 * at + 1
        if below >= size[0]:
            break
        if below + 1 < size[0] and _is_cheaper(costs, order[below + 1], order[below]):
            below += 1
        if not _is_cheaper(costs, order[below], edge):
            break
        order[at] = order[below]
        place[order[at]] = at
        at = below
    order[at], place[edge] = edge, at


# --- the edges of each cluster ----------------------------------------------------------------------------------------


class EdgeLists(NamedTuple):
    """Edges of each of n clusters as doubly linked lists of half-edges: edge e has the halves 2e and 2e + 1.

    Attributes
    ----------
    ends : (2m,) int64
        Cluster in whose list a half-edge is; that of ``half ^ 1`` is the one at the other end.
    after, before : (2m,) int64
        Neighbours in that list, or -1.
    first : (n,) int64
        First half-edge of each cluster, or -1.
    degree : (n,) int64
        Number of its edges.
    """

    ends: NDArray[np.int64]
    after: NDArray[np.int64]
    before: NDArray[np.int64]
    first: NDArray[np.int64]
    degree: NDArray[np.int64]


@njit(cache=True)
def _edge_lists(n_nodes: int, edges: NDArray[np.int32]) -> EdgeLists:
    m = len(edges)
    lists = EdgeLists(
        np.empty(2 * m, np.int64),
        np.full(2 * m, NONE),
        np.full(2 * m, NONE),
        np.full(n_nodes, NONE),
        np.zeros(n_nodes, np.int64),
    )
    for e in range(m):
        for side in range(2):
            _insert(lists, 2 * e + side, edges[e, side])
    return lists


@njit(cache=True)
def _insert(lists: EdgeLists, half: int, node: int) -> None:
    """Put a half-edge at the head of a cluster's list."""
    ends, after, before, first, degree = lists
    ends[half] = node
    after[half], before[half] = first[node], NONE
    if first[node] != NONE:
        before[first[node]] = half
    first[node] = half
    degree[node] += 1


@njit(cache=True)
def _remove(lists: EdgeLists, half: int) -> None:
    """Take a half-edge out of its list."""
    ends, after, before, first, degree = lists
    if before[half] == NONE:
        first[ends[half]] = after[half]
    else:
        after[before[half]] = after[half]
    if after[half] != NONE:
        before[after[half]] = before[half]
    degree[ends[half]] -= 1


@njit(cache=True)
def _edge_between(lists: EdgeLists, a: int, b: int) -> int:
    """Edge between two clusters or -1, by a walk along the shorter list."""
    if lists.degree[b] < lists.degree[a]:
        a, b = b, a
    half = lists.first[a]
    while half != NONE:
        if lists.ends[half ^ 1] == b:
            return half >> 1
        half = lists.after[half]
    return NONE


# --- the graph that shrinks -------------------------------------------------------------------------------------------


class ContractedGraph(NamedTuple):
    """A graph of n nodes and m edges some of whose nodes have merged into clusters.

    Attributes
    ----------
    heap : EdgeHeap
        Edges between clusters, and their costs.
    lists : EdgeLists
        A cluster lives on in the place of one of its nodes.
    sums : (r, m) float64
        What adds up where two edges become one: weights, lengths.
    tree_nodes : (n,) int64
        Node of the tree that the cluster in each place is.
    pairs, altitudes : (n - 1, 2) int32, (n - 1,) float64
        Merges, as in `Merges`; the first `done` of them.
    done : (1,) int64
    parallel : (m,) int64
        Edges that the last merge made of two parallel ones.
    """

    heap: EdgeHeap
    lists: EdgeLists
    sums: NDArray[np.float64]
    tree_nodes: NDArray[np.int64]
    pairs: NDArray[np.int32]
    altitudes: NDArray[np.float64]
    done: NDArray[np.int64]
    parallel: NDArray[np.int64]


@njit(cache=True)
def uncontracted_graph(
    n_nodes: int, edges: NDArray[np.int32], costs: NDArray[np.float64], sums: NDArray[np.float64]
) -> ContractedGraph:
    """A graph before its first merge. `costs` (m,) and `sums` (r, m) change with it."""
    most = max(n_nodes - 1, 0)
    return ContractedGraph(
        edge_heap(costs),
        _edge_lists(n_nodes, edges),
        sums,
        np.arange(n_nodes),
        np.empty((most, 2), np.int32),
        np.empty(most),
        np.zeros(1, np.int64),
        np.empty(len(edges), np.int64),
    )


@njit(cache=True)
def contract_cheapest(graph: ContractedGraph) -> tuple[int, int, int]:
    """Merge the two clusters at the ends of the cheapest edge, at its cost.

    Returns
    -------
    kept, gone : int
        Places of the two clusters: the merged one is in the first, and none is left in the second.
    n_parallel : int
        Where both had an edge to the same third cluster, one edge stays, with the sums of both: those are
        ``graph.parallel[:n_parallel]``. All costs but that of the edge in between are as before.
    """
    heap, lists, sums = graph.heap, graph.lists, graph.sums
    edge, done = heap.order[0], graph.done[0]
    kept, gone = lists.ends[2 * edge], lists.ends[2 * edge + 1]
    a, b = graph.tree_nodes[kept], graph.tree_nodes[gone]
    graph.pairs[done, 0], graph.pairs[done, 1] = min(a, b), max(a, b)
    graph.altitudes[done] = heap.costs[edge]
    graph.done[0] = done + 1
    if lists.degree[gone] > lists.degree[kept]:
        kept, gone = gone, kept
    graph.tree_nodes[kept] = len(graph.tree_nodes) + done
    _remove_edge(graph, edge)
    n_parallel = 0
    half = lists.first[gone]
    while half != NONE:
        following = lists.after[half]
        staying = _edge_between(lists, kept, lists.ends[half ^ 1])
        if staying == NONE:
            _remove(lists, half)
            _insert(lists, half, kept)
        else:
            graph.parallel[n_parallel] = staying
            n_parallel += 1
            for row in range(len(sums)):
                sums[row, staying] += sums[row, half >> 1]
            _remove_edge(graph, half >> 1)
        half = following
    return kept, gone, n_parallel


@njit(cache=True)
def _remove_edge(graph: ContractedGraph, edge: int) -> None:
    _remove(graph.lists, 2 * edge)
    _remove(graph.lists, 2 * edge + 1)
    heap_remove(graph.heap, edge)
