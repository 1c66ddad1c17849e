# SPDX-License-Identifier: Apache-2.0
"""Single linkage: two parts merge at the cheapest edge between them (minimum spanning forest, quasi-flat zones)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import root_of
from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.boundary import BoundaryCost
from pcgraph.parallel import kernel
from pcgraph.tree.linkage import Linkage, Merges, check_cost


@dataclass(frozen=True)
class QuasiFlatLinkage(Linkage):
    """Single linkage on an edge's concavity; altitudes in radians.

    Attributes
    ----------
    cost : BoundaryCost
        Cost of an edge.

    Notes
    -----
    Segments of the cut at an altitude are what edges of at most that cost connect (Meyer and Maragos 1999). So one
    cheap edge joins two objects.
    """

    cost: BoundaryCost = field(default_factory=BoundaryCost)

    default_object_altitude = 0.07  # radians; chosen on 12 clouds of tables (docs/tree.md)
    default_part_altitude = 0.04  # the same; the seven faces of two synthetic boxes on a plane are the parts

    def __post_init__(self) -> None:
        check_cost(self.cost)

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the cheapest edge first."""
        return single_linkage(graph.n_nodes, graph.edges, self.cost(graph.edge_features))


def single_linkage(n_nodes: int, edges: NDArray[np.int32], costs: NDArray[np.float64]) -> Merges:
    """Merges of nodes along edges: two clusters merge at the cheapest edge between them.

    Parameters
    ----------
    n_nodes : int
    edges : (m, 2) int32
    costs : (m,) float64

    Returns
    -------
    Merges
        Altitudes are these costs. Of equal ones that of the first edge comes first.
    """
    return minimum_spanning_forest(n_nodes, edges, costs)[0]


def minimum_spanning_forest(
    n_nodes: int, edges: NDArray[np.int32], costs: NDArray[np.float64]
) -> tuple[Merges, NDArray[np.int64]]:
    """Merges of `single_linkage`, and the edge of each merge, (t,) int64 (Kruskal 1956)."""
    order = np.argsort(costs, kind="stable")
    pairs, taken = _kruskal(n_nodes, edges[order])
    forest = order[taken]
    return Merges(pairs, costs[forest]), forest


@kernel
def _kruskal(n_nodes: int, edges: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Merges, and the edge of each; `edges` are in ascending order of cost."""
    roots, size = np.arange(n_nodes), np.ones(n_nodes, np.int64)
    tree_node = np.arange(n_nodes)  # of the set with this root
    pairs, taken = np.empty((max(n_nodes - 1, 0), 2), np.int32), np.empty(max(n_nodes - 1, 0), np.int64)
    t = 0
    for e in range(len(edges)):
        a, b = root_of(roots, np.int64(edges[e, 0])), root_of(roots, np.int64(edges[e, 1]))
        if a == b:
            continue
        if size[b] > size[a]:
            a, b = b, a
        pairs[t, 0], pairs[t, 1] = min(tree_node[a], tree_node[b]), max(tree_node[a], tree_node[b])
        taken[t] = e
        roots[b] = a
        size[a] += size[b]
        tree_node[a] = n_nodes + t
        t += 1
    return pairs[:t].copy(), taken[:t].copy()
