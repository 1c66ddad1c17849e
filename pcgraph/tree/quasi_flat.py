# SPDX-License-Identifier: Apache-2.0
"""Quasi-flat zones: what is connected by edges below a level."""

from __future__ import annotations

from dataclasses import dataclass, field

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.boundary import BoundaryCost
from pcgraph.tree.linkage import Linkage, Merges, check_cost, check_numbers
from pcgraph.tree.single import single_linkage


@dataclass(frozen=True)
class QuasiFlatLinkage(Linkage):
    """Single linkage on an edge's concavity; altitudes in radians.

    Attributes
    ----------
    cost : BoundaryCost
        Cost of an edge.
    object_altitude, part_altitude : float, radians

    Notes
    -----
    The cut at an altitude is what stays connected over edges of at most that cost (Meyer and Maragos 1999), so
    one cheap edge joins two objects.
    """

    cost: BoundaryCost = field(default_factory=BoundaryCost)
    object_altitude: float = 0.07
    part_altitude: float = 0.04

    def __post_init__(self) -> None:
        check_cost(self.cost)
        check_numbers(self)

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the cheapest edge first."""
        pairs, altitudes, _ = single_linkage(graph.n_nodes, graph.edges, self.cost(graph.edge_features))
        return Merges(pairs, altitudes)
