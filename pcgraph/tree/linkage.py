# SPDX-License-Identifier: Apache-2.0
"""Linkages: in which order the parts of a graph merge, and at what altitude."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.boundary import BoundaryCost
from pcgraph.inputs import non_negative
from pcgraph.short_repr import ShortRepr
from pcgraph.tree.average import average_linkage


@dataclass(frozen=True, eq=False)
class Merges(ShortRepr):
    """Binary merges along the edges of a graph, until every connected component is one node.

    Attributes
    ----------
    pairs : (t, 2) int32
        Merge i joins these two nodes into the new node n_nodes + i.
    altitudes : (t,) float64, the linkage's unit, >= 0
        Not decreasing.
    """

    pairs: NDArray[np.int32]
    altitudes: NDArray[np.float64]


class Linkage(ABC):
    """How a graph becomes a tree.

    Attributes
    ----------
    object_altitude : float, the linkage's unit
        Altitude of the cut that is taken for objects where the caller names none.
    part_altitude : float, the linkage's unit
        Altitude, not above it, of the cut that is taken for parts: faces and smooth pieces of objects.
    """

    object_altitude: float
    part_altitude: float

    @abstractmethod
    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges of the graph's nodes, whose points have these moments."""


def check_numbers(linkage: Linkage, *names: str) -> None:
    """Nothing; raises ValueError unless these attributes and both altitudes are finite numbers, not negative."""
    for name in (*names, "object_altitude", "part_altitude"):
        non_negative(name, getattr(linkage, name))


def check_cost(cost: BoundaryCost) -> None:
    """Nothing; raises ValueError unless this is a `BoundaryCost`."""
    if not isinstance(cost, BoundaryCost):
        raise ValueError(f"expected cost as a BoundaryCost, got {cost!r}")


@dataclass(frozen=True)
class ConvexityLinkage(Linkage):
    """Average linkage of an edge's concavity, weighted by contact; altitudes in radians.

    Attributes
    ----------
    cost : BoundaryCost
        Cost of an edge.
    object_altitude : float, radians
        Mean concavity above which two parts are two objects.
    part_altitude : float, radians
        Right-angled convex edges cost about 0.05 (0.03 per radian) and up to 0.08 where voxels round them off;
        noise on a flat table costs as much: of a real one pieces remain at this altitude.

    Notes
    -----
    Evidence as in LCCP (Stein et al. 2014), but a mean over the contact instead of a yes or no per edge.
    """

    cost: BoundaryCost = field(default_factory=BoundaryCost)
    object_altitude: float = 0.5
    part_altitude: float = 0.06

    def __post_init__(self) -> None:
        check_cost(self.cost)
        check_numbers(self)

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the least concave contact first."""
        features = graph.edge_features
        weights = features.contact_voxels.astype(np.float64)
        return Merges(*average_linkage(graph.n_nodes, graph.edges, self.cost(features), weights))
