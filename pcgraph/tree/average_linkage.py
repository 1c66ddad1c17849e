# SPDX-License-Identifier: Apache-2.0
"""Average linkage: two parts merge at the weighted mean cost of the edges between them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.boundary import BoundaryCost
from pcgraph.parallel import kernel
from pcgraph.tree.contraction import ContractedGraph, contract_cheapest, heap_update, insert_edges
from pcgraph.tree.linkage import Linkage, Merges, check_cost


@dataclass(frozen=True)
class ConvexityLinkage(Linkage):
    """Average linkage of an edge's concavity, weighted by contact; altitudes in radians.

    Attributes
    ----------
    cost : BoundaryCost
        Cost of an edge.

    Notes
    -----
    The evidence is that of LCCP (Stein et al. 2014), but a mean over the contact instead of a yes or no per edge.

    Right-angled convex edges cost about 0.05 (0.03 per radian), and up to 0.08 where voxels round them off. Noise on a
    flat table costs as much, so a real table is still in pieces at the altitude of parts, 0.06.
    """

    cost: BoundaryCost = field(default_factory=BoundaryCost)

    default_object_altitude = 0.5  # mean concavity, radians; chosen on 12 clouds of tables (docs/tree.md, "Measured")
    default_part_altitude = 0.06  # the same; the seven faces of two synthetic boxes on a plane are the parts

    def __post_init__(self) -> None:
        check_cost(self.cost)

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the least concave contact first."""
        features = graph.edge_features
        weights = features.contact_voxels.astype(np.float64)
        return average_linkage(graph.n_nodes, graph.edges, self.cost(features), weights)


def average_linkage(
    n_nodes: int, edges: NDArray[np.int32], costs: NDArray[np.float64], weights: NDArray[np.float64]
) -> Merges:
    """Merges of nodes along edges, those of least weighted mean cost of all edges between two clusters first.

    Parameters
    ----------
    n_nodes : int
    edges : (m, 2) int32
        Pairs of distinct nodes, each pair once.
    costs : (m,) float64
        Cost of merging over each edge alone; finite.
    weights : (m,) float64, > 0
        For example contact lengths.

    Returns
    -------
    Merges
        Altitudes are these means. Of equal ones that of the first edge comes first.

    Notes
    -----
    A mean of two costs is never below the smaller one, so merging in ascending order yields ascending altitudes.
    """
    sums = np.stack((costs * weights, weights))
    graph = ContractedGraph.of(n_nodes, len(edges), sums)
    _merge(graph, edges, sums[0] / sums[1])
    merges = graph.merges()
    return Merges(merges.pairs, np.maximum.accumulate(merges.altitudes))  # a mean may round down by one last place


@kernel
def _merge(graph: ContractedGraph, edges: NDArray[np.int32], costs: NDArray[np.float64]) -> None:
    sums = graph.sums
    insert_edges(graph, edges, costs)
    while graph.heap.size[0] > 0:
        _, _, n_parallel = contract_cheapest(graph)
        for edge in graph.parallel[:n_parallel]:
            heap_update(graph.heap, edge, sums[0, edge] / sums[1, edge])
