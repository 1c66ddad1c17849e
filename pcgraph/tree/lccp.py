# SPDX-License-Identifier: Apache-2.0
"""LCCP: locally convex connected patches, as a tree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.contacts import angle_between
from pcgraph.hierarchy import roots
from pcgraph.inputs import check_non_negative, positive
from pcgraph.tree.average_linkage import average_linkage
from pcgraph.tree.linkage import Linkage, Merges
from pcgraph.tree.single_linkage import single_linkage

_MAX_STEP = 0.1
"""Step, voxel edges, that a smooth edge may have beyond the step that its angle explains: the default of PCL, source of
the rule (`setSmoothnessCheck`)."""


@dataclass(frozen=True)
class LccpLinkage(Linkage):
    """LCCP (Stein et al. 2014): objects are the supervoxels that convex edges connect, the cut at altitude 1.

    Below 1, the supervoxels of an object merge by single linkage over its convex edges, at the angle between normals
    over pi. Above 1, objects merge by average linkage over their contact, at 1 + mean angle / pi. LCCP itself ends at
    1.

    Attributes
    ----------
    concavity_tolerance : float, radians, >= 0
        Concave edges of a smaller angle count as convex. Its default is LCCP's, 10 degrees.
    smoothness : bool
        Whether edges over steps are refused: those where both centroids' distances to the other one's plane exceed
        sin(angle) seed_size + 0.1 voxel edges.
    sanity : bool
        Whether edges are refused where the patches' planes meet along the line that joins the patches.
    common_neighbours : int, >= 0
        Their k: number of common neighbours, with convex edges to both ends, that a convex edge needs.
    seed_size : float, metres, > 0, optional
        Spacing of the supervoxels; default: the median distance between the centroids of those that touch.

    Notes
    -----
    The rules are those of PCL's lccp_segmentation.hpp.
    """

    concavity_tolerance: float = math.radians(10.0)
    smoothness: bool = True
    sanity: bool = False
    common_neighbours: int = 0
    seed_size: float | None = None

    default_object_altitude = 1.0  # their segmentation
    default_part_altitude = 1.0 / 9.0  # convex edges of up to 20 degrees join parts

    def __post_init__(self) -> None:
        check_non_negative(self, "concavity_tolerance", "common_neighbours")
        if self.seed_size is not None:
            positive("seed_size", self.seed_size)

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges inside objects, then merges of objects."""
        convex = self.convex(graph)
        angles = graph.edge_features.normal_angle[convex] / np.pi
        inside = single_linkage(graph.n_nodes, graph.edges[convex], angles)
        between = _merges_between(graph, inside.pairs)
        altitudes = np.concatenate((inside.altitudes, 1.0 + between.altitudes))
        return Merges(np.concatenate((inside.pairs, between.pairs)), altitudes)

    def convex(self, graph: AdjacencyGraph) -> NDArray[np.bool_]:
        """Whether LCCP takes each edge for convex, (m,) bool."""
        nodes, (i, j) = graph.node_features, graph.edges.T
        towards_i = nodes.centroid[i] - nodes.centroid[j]
        normal_i, normal_j = nodes.normal[i], nodes.normal[j]
        angle = angle_between(normal_i, normal_j)
        opens = angle_between(towards_i, normal_i) <= angle_between(towards_i, normal_j)
        convex = opens | (angle < self.concavity_tolerance)
        if self.smoothness and len(i):
            seed = self.seed_size if self.seed_size is not None else float(np.median(_length(towards_i)))
            offset = np.minimum(np.abs(_dot(towards_i, normal_i)), np.abs(_dot(towards_i, normal_j)))
            convex &= offset <= np.sin(angle) * seed + _MAX_STEP * graph.edge_features.voxel_edge
        if self.sanity:
            convex &= _is_sane(np.cross(normal_i, normal_j), towards_i, angle)
        if self.common_neighbours > 0:
            convex &= _common_neighbours(graph, convex) >= self.common_neighbours
        return convex


def _is_sane(
    crease: NDArray[np.float64], towards: NDArray[np.float64], angle: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether the crease of two planes lies across the line between the patches; true of parallel planes.

    The least angle, 60 / (1 + exp(-0.25 (angle - 25))) degrees, is PCL's.
    """
    between = angle_between(crease, towards)
    folded = np.minimum(between, np.pi - between)
    least = np.deg2rad(60.0) / (1.0 + np.exp(-0.25 * (np.rad2deg(angle) - 25.0)))
    return (folded >= least) | (_length(crease) == 0.0)


def _common_neighbours(graph: AdjacencyGraph, convex: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number of nodes with convex edges to both ends of each edge, (m,)."""
    from scipy.sparse import csr_array

    i, j = graph.edges[convex].T
    ones = np.ones(2 * len(i), np.int64)
    n = graph.n_nodes
    adjacency = csr_array((ones, (np.concatenate((i, j)), np.concatenate((j, i)))), shape=(n, n))
    common = adjacency[graph.edges[:, 0]] * adjacency[graph.edges[:, 1]]
    return np.asarray(common.sum(axis=1)).astype(np.int64)


def _merges_between(graph: AdjacencyGraph, pairs: NDArray[np.int32]) -> Merges:
    """Average linkage, by angle between normals over pi, of the clusters that earlier merges made."""
    n, done = graph.n_nodes, graph.n_nodes + len(pairs)
    parents = np.arange(done, dtype=np.int32)
    parents[pairs] = np.arange(n, done, dtype=np.int32)[:, None]
    top, part = np.unique(roots(parents)[:n], return_inverse=True)
    ends = np.sort(part[graph.edges], axis=1)
    across = ends[:, 0] != ends[:, 1]
    lengths = graph.edge_features.contact_voxels[across].astype(np.float64)
    keys, edge = np.unique(ends[across] @ np.array([len(top), 1]), return_inverse=True)
    weights = np.bincount(edge, lengths, len(keys)).astype(np.float64)
    means = np.bincount(edge, lengths * graph.edge_features.normal_angle[across] / np.pi, len(keys)) / weights
    quotient = np.stack((keys // len(top), keys % len(top)), axis=1).astype(np.int32)
    between = average_linkage(len(top), quotient, means, weights)
    named = np.concatenate((top, np.arange(done, done + len(between.pairs)))).astype(np.int32)
    return Merges(np.sort(named[between.pairs], axis=1), between.altitudes)


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", a, b)


def _length(a: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(a, axis=1)
