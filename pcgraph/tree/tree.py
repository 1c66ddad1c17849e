# SPDX-License-Identifier: Apache-2.0
"""The segmentation tree: from supervoxels to the whole scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.columns import rows
from pcgraph.features.moments import Moments
from pcgraph.features.nodes import NodeFeatures, node_features

if TYPE_CHECKING:
    import networkx


@dataclass(frozen=True)
class SegmentationTree:
    """Binary merge tree; every cut of it is a segmentation, and all cuts nest.

    Attributes
    ----------
    parents : (k,) int32
        Parent of each node, larger than the node's own number; the root (last node) is its own parent. The
        first `n_leaves` nodes are the supervoxels, in their order. k = 2 n_leaves - 1.
    altitudes : (k,) float64, radians
        Cost at which a node came to be: 0 for leaves, not decreasing with the node's number; infinite where
        parts that do not touch were joined.
    moments : Moments
        k rows: additive moments of the points below each node.
    viewpoint : (3,) float64, metres, the points' frame
        Side to which nodes' normals point.
    """

    parents: NDArray[np.int32]
    altitudes: NDArray[np.float64]
    moments: Moments
    viewpoint: NDArray[np.float64]

    @property
    def n_leaves(self) -> int:
        """Number of supervoxels."""
        return (len(self.parents) + 1) // 2

    def cut(self, n: int | None = None, altitude: float | None = None) -> NDArray[np.int32]:
        """Segment of each leaf, (n_leaves,) int32, numbered from 0 in the order of their first leaf.

        Points follow in one step: ``tree.cut(n=5)[supervoxels]``, or `Segmentation.cut`, which minds the -1.

        Parameters
        ----------
        n : int, 1..n_leaves
            Exact number of segments.
        altitude : float, radians
            All merges up to and including this cost are done.

        Raises
        ------
        ValueError
            Not exactly one of the two is given, n is out of range, or altitude is not a number.
        """
        nodes = self.cut_nodes(n, altitude)
        _, first, inverse = np.unique(nodes, return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int32)
        rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
        return rank[inverse]

    def cut_nodes(self, n: int | None = None, altitude: float | None = None) -> NDArray[np.int32]:
        """Node of the tree above each leaf after a cut, (n_leaves,) int32; parameters as for `cut`."""
        last = self.n_leaves + self._merges(n, altitude)
        up = np.where(self.parents < last, self.parents, np.arange(len(self.parents), dtype=np.int32))
        while True:  # pointer jumping: as many rounds as the logarithm of the depth
            further = up[up]
            if np.array_equal(further, up):
                return up[: self.n_leaves].copy()
            up = further

    def features(self) -> NodeFeatures:
        """Features of all k nodes, from their moments."""
        return node_features(self.moments, self.viewpoint)

    def to_networkx(self) -> networkx.DiGraph:
        """The tree as ``networkx.DiGraph`` from parent to child; attributes ``altitude`` and features."""
        from networkx import DiGraph

        columns = {"altitude": self.altitudes, **self.features().columns()}
        tree = DiGraph()
        tree.add_nodes_from(enumerate(rows(columns, len(self.parents))))
        tree.add_edges_from((up, node) for node, up in enumerate(self.parents.tolist()) if up != node)
        return tree

    def _merges(self, n: int | None, altitude: float | None) -> int:
        if n is not None and altitude is None:
            if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or not 1 <= n <= self.n_leaves:
                raise ValueError(f"expected a whole number n of 1..{self.n_leaves} segments, got {n!r}")
            return self.n_leaves - int(n)
        if altitude is None or n is not None:
            raise ValueError(f"expected either n or altitude, got n={n} and altitude={altitude}")
        if np.isnan(altitude):
            raise ValueError("expected an altitude in radians, got NaN")
        return int(np.searchsorted(self.altitudes[self.n_leaves :], altitude, side="right"))
