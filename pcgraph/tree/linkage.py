# SPDX-License-Identifier: Apache-2.0
"""Linkages: in which order the parts of a graph merge, and at what altitude."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.boundary import BoundaryCost
from pcgraph.plumbing.short_repr import ShortRepr


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


def checked_merges(merges: Merges, n_nodes: int, linkage: object) -> Merges:
    """The merges that a linkage made of a graph of `n_nodes`, checked.

    Raises
    ------
    ValueError
        They are no `Merges`, join nodes that do not exist or are joined already, or altitudes are negative, not finite,
        or decrease.
    """
    name = f"{type(linkage).__name__}.merges"
    if not isinstance(merges, Merges):
        raise ValueError(f"expected {name} to return Merges, got {type(merges).__name__}")
    pairs, altitudes = np.asarray(merges.pairs), np.asarray(merges.altitudes)
    t = len(altitudes)
    if pairs.shape != (t, 2) or pairs.dtype.kind not in "iu" or t > max(n_nodes - 1, 0):
        raise ValueError(
            f"expected {name} to return pairs (t, 2) of whole numbers and altitudes (t,), t up to {n_nodes - 1}, "
            f"got {pairs.shape} {pairs.dtype} and {altitudes.shape}"
        )
    are_there = bool((pairs >= 0).all() and (pairs < n_nodes + np.arange(t)[:, None]).all())
    if not are_there or (np.bincount(pairs.ravel(), minlength=1) > 1).any():
        raise ValueError(f"expected {name} to join nodes that are there and not joined yet, 0..{n_nodes - 1} at first")
    if not (np.isfinite(altitudes).all() and (altitudes >= 0).all() and (np.diff(altitudes) >= 0).all()):
        raise ValueError(f"expected {name} to return finite altitudes, not negative and not decreasing")
    return merges


class Linkage(ABC):
    """A rule that makes a tree of a graph.

    A linkage is a frozen dataclass of the settings that decide its merges. The altitude of a cut is an argument of the
    cut (``segment(..., object_altitude=)``, `SegmentationTree.cut`); the class only knows the usual altitudes.
    """

    @property
    @abstractmethod
    def default_object_altitude(self) -> float:
        """Altitude, in the linkage's unit, of the cut into objects, if the caller names none."""

    @property
    @abstractmethod
    def default_part_altitude(self) -> float:
        """Altitude of the cut into parts, which are faces and smooth pieces; at most that of objects."""

    @abstractmethod
    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges of the graph's nodes; `leaves` are the moments of their points."""


def check_cost(cost: BoundaryCost) -> None:
    """Raise ValueError unless this is a `BoundaryCost`."""
    if not isinstance(cost, BoundaryCost):
        raise ValueError(f"expected cost as a BoundaryCost, got {cost!r}")
