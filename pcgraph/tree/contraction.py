# SPDX-License-Identifier: Apache-2.0
"""Contraction of a graph, the cheapest edge first: what average and least-increase linkage have in common.

Edges stand in a heap by their cost and, by their two halves, in the lists of the clusters that they join. A linkage
repeats `contract_cheapest` and then corrects the costs that the merge has changed (`heap_update`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import config
from numpy.typing import NDArray

from pcgraph.hierarchy import NONE
from pcgraph.parallel import routine
from pcgraph.tree.linkage import Merges

# Tables of records: fields that are used together lie side by side, and a kernel takes one array for each table.
EDGE = np.dtype([("cost", np.float64), ("place", np.int64)])
HALF_EDGE = np.dtype([("end", np.int64), ("after", np.int64), ("before", np.int64)])
CLUSTER = np.dtype([("first", np.int64), ("degree", np.int64), ("tree_node", np.int64)])


def _records(n: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """A table of n records whose fields are attributes, in compiled kernels and where numba is switched off."""
    table = np.empty(n, dtype)
    return table.view(np.recarray) if config.DISABLE_JIT else table


class EdgeHeap(NamedTuple):
    """Binary heap of m edges whose costs may change: the cheapest on top; of equal ones that of the smallest number.

    Attributes
    ----------
    edges : (m,) EDGE
        Cost of each edge, and its place in `order`.
    order : (m,) int64
        The heap: its first `size` elements are edges.
    size : (1,) int64
    """

    edges: NDArray[Any]
    order: NDArray[np.int64]
    size: NDArray[np.int64]


class ContractedGraph(NamedTuple):
    """A graph of n nodes and m edges some of whose nodes have merged into clusters.

    Attributes
    ----------
    heap : EdgeHeap
        Edges between clusters.
    halves : (2m,) HALF_EDGE
        Edge e has the halves 2e and 2e + 1, one in the list of each cluster that it joins. A half holds that cluster
        and its neighbours in the list, or -1. ``halves[half ^ 1].end`` is the cluster on the other side.
    clusters : (n,) CLUSTER
        First half-edge of each cluster or -1, number of its edges, and its node of the tree. A merged cluster takes the
        row of one of the two.
    sums : (r, m) float64
        Quantities that add up where two edges become one, such as weights and lengths.
    parallel : (m,) int64
        Edges that the last merge made of two parallel edges.
    pairs, altitudes : (n - 1, 2) int32, (n - 1,) float64
        As in `Merges`; the first `done` of them.
    done : (1,) int64
    """

    heap: EdgeHeap
    halves: NDArray[Any]
    clusters: NDArray[Any]
    sums: NDArray[np.float64]
    parallel: NDArray[np.int64]
    pairs: NDArray[np.int32]
    altitudes: NDArray[np.float64]
    done: NDArray[np.int64]

    @classmethod
    def of(cls, n_nodes: int, n_edges: int, sums: NDArray[np.float64]) -> ContractedGraph:
        """A graph without its edges, which `insert_edges` puts in; `sums` change with its merges."""
        m, most = n_edges, max(n_nodes - 1, 0)
        return cls(
            EdgeHeap(_records(m, EDGE), np.empty(m, np.int64), np.zeros(1, np.int64)),
            _records(2 * m, HALF_EDGE),
            _records(n_nodes, CLUSTER),
            sums,
            np.empty(m, np.int64),
            np.empty((most, 2), np.int32),
            np.empty(most),
            np.zeros(1, np.int64),
        )

    def merges(self) -> Merges:
        """Merges so far, at their costs."""
        return Merges(self.pairs[: self.done[0]], self.altitudes[: self.done[0]])


@routine
def insert_edges(graph: ContractedGraph, edges: NDArray[np.int32], costs: NDArray[np.float64]) -> None:
    """Put the edges between nodes in, (m, 2), at their costs, (m,)."""
    heap, halves, clusters = graph.heap, graph.halves, graph.clusters
    for node in range(len(clusters)):
        clusters[node].first, clusters[node].degree, clusters[node].tree_node = NONE, 0, node
    for edge in range(len(edges)):
        _insert(halves, clusters, 2 * edge, np.int64(edges[edge, 0]))
        _insert(halves, clusters, 2 * edge + 1, np.int64(edges[edge, 1]))
        heap.order[edge], heap.edges[edge].place, heap.size[0] = edge, edge, edge + 1
        heap_update(heap, edge, costs[edge])


@routine
def contract_cheapest(graph: ContractedGraph) -> tuple[int, int, int]:
    """Merge the two clusters at the ends of the cheapest edge, at its cost.

    Returns
    -------
    kept, gone : int
        Rows of the two clusters: the merged one has the first, and the second is empty.
    n_parallel : int
        Where both clusters had an edge to the same third one, one edge stays, with the sums of both. These edges are
        ``graph.parallel[:n_parallel]``. All costs are as before: the caller corrects them.
    """
    heap, halves, clusters, sums = graph.heap, graph.halves, graph.clusters, graph.sums
    edge, done = heap.order[0], graph.done[0]
    kept, gone = halves[2 * edge].end, halves[2 * edge + 1].end
    a, b = clusters[kept].tree_node, clusters[gone].tree_node
    graph.pairs[done, 0], graph.pairs[done, 1] = min(a, b), max(a, b)
    graph.altitudes[done] = heap.edges[edge].cost
    graph.done[0] = done + 1
    if clusters[gone].degree > clusters[kept].degree:
        kept, gone = gone, kept
    clusters[kept].tree_node = len(clusters) + done
    _remove(halves, clusters, 2 * edge)
    _remove(halves, clusters, 2 * edge + 1)
    heap_remove(heap, edge)
    n_parallel = 0
    half = clusters[gone].first
    while half != NONE:
        following = halves[half].after
        staying = _edge_between(halves, clusters, kept, halves[half ^ 1].end)
        _remove(halves, clusters, half)
        if staying == NONE:
            _insert(halves, clusters, half, kept)
        else:
            _remove(halves, clusters, half ^ 1)
            edge = half >> 1
            heap_remove(heap, edge)
            for row in range(len(sums)):
                sums[row, staying] += sums[row, edge]
            graph.parallel[n_parallel] = staying
            n_parallel += 1
        half = following
    return kept, gone, n_parallel


# --- the edges of a cluster -------------------------------------------------------------------------------------------


@routine
def _insert(halves: NDArray[Any], clusters: NDArray[Any], half: int, cluster: int) -> None:
    """Put a half-edge at the head of a cluster's list."""
    first = clusters[cluster].first
    halves[half].end, halves[half].after, halves[half].before = cluster, first, NONE
    if first != NONE:
        halves[first].before = half
    clusters[cluster].first = half
    clusters[cluster].degree += 1


@routine
def _remove(halves: NDArray[Any], clusters: NDArray[Any], half: int) -> None:
    """Take a half-edge out of its list."""
    cluster, after, before = halves[half].end, halves[half].after, halves[half].before
    if before == NONE:
        clusters[cluster].first = after
    else:
        halves[before].after = after
    if after != NONE:
        halves[after].before = before
    clusters[cluster].degree -= 1


@routine
def _edge_between(halves: NDArray[Any], clusters: NDArray[Any], a: int, b: int) -> int:
    """Edge between two clusters or -1, by a walk along the shorter list."""
    if clusters[b].degree < clusters[a].degree:
        a, b = b, a
    half = clusters[a].first
    while half != NONE:
        if halves[half ^ 1].end == b:
            return half >> 1
        half = halves[half].after
    return NONE


# --- the heap ---------------------------------------------------------------------------------------------------------


@routine
def heap_update(heap: EdgeHeap, edge: int, cost: float) -> None:
    """Change the cost of an edge, and put it in its place."""
    heap.edges[edge].cost = cost
    _sift(heap, edge)


@routine
def heap_remove(heap: EdgeHeap, edge: int) -> None:
    """Take an edge out."""
    at, last = heap.edges[edge].place, heap.size[0] - 1
    heap.size[0] = last
    if at != last:
        moved = heap.order[last]
        heap.order[at], heap.edges[moved].place = moved, at
        _sift(heap, moved)


@routine
def _sift(heap: EdgeHeap, edge: int) -> None:
    """Move an edge up, and then down, to where it belongs."""
    edges, order, size = heap.edges, heap.order, heap.size[0]
    at = edges[edge].place
    while at > 0:
        above = (at - 1) // 2
        if not _is_cheaper(edges, edge, order[above]):
            break
        order[at] = order[above]
        edges[order[at]].place = at
        at = above
    while True:
        below = 2 * at + 1
        if below >= size:
            break
        if below + 1 < size and _is_cheaper(edges, order[below + 1], order[below]):
            below += 1
        if not _is_cheaper(edges, order[below], edge):
            break
        order[at] = order[below]
        edges[order[at]].place = at
        at = below
    order[at], edges[edge].place = edge, at


@routine
def _is_cheaper(edges: NDArray[Any], a: int, b: int) -> bool:
    return edges[a].cost < edges[b].cost or (edges[a].cost == edges[b].cost and a < b)
