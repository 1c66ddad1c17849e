# SPDX-License-Identifier: Apache-2.0
"""Least-increase linkage: what raises an energy least, per boundary removed, merges first (Ward, Mumford and Shah)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.parallel import kernel, routine
from pcgraph.tree.contraction import NONE, ContractedGraph, contract_cheapest, heap_update, insert_edges
from pcgraph.tree.linkage import Linkage, Merges, check_numbers
from pcgraph.voxels.eigen import SYMMETRIC_INDICES, least_eigenvalue


@dataclass(frozen=True)
class WardLinkage(Linkage):
    """Ward's linkage along the graph: the merge that adds least to the sum of squares comes first.

    Attributes
    ----------
    position : float, per voxel, >= 0
        Weight of places, in voxel edges.
    normal : float, >= 0
        Weight of unit normals.
    color : float, >= 0
        Weight of colours, 0..1.

    Notes
    -----
    A merge of A and B costs |A| |B| / (|A| + |B|) ||f_A - f_B||^2 (Ward 1963), where f are weighted means and
    |A| is the number of points over the mean number of points of a supervoxel, so that altitudes do not depend
    on the units of length or the density of points.
    """

    position: float = 0.0
    normal: float = 1.0
    color: float = 0.0

    default_object_altitude = 6.0  # increase of the sum of squares
    default_part_altitude = 0.5

    def __post_init__(self) -> None:
        check_numbers(self, "position", "normal", "color")

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the smallest increase first."""
        regions = regions_of(graph, leaves, self.position, self.normal, self.color, 0.0)
        return least_increase_linkage(regions, graph.edges, None)


@dataclass(frozen=True)
class MumfordShahLinkage(Linkage):
    """Merging by Mumford and Shah's energy; altitudes are its scale lambda.

    Attributes
    ----------
    plane : float, per voxel, >= 0
        Weight of distances to a region's least-squares plane, in voxel edges.
    normal, color : float, >= 0
        Weights of unit normals and of colours, 0..1, as piecewise constant data.

    Notes
    -----
    Energy: sum over the regions of |A| (plane^2 mean d^2 + normal^2 var n + color^2 var c) + lambda x length of
    boundaries, in voxel edges. Two regions merge at lambda = increase of the first / length of their contact, the
    smallest first (Koepfler et al. 1994). |A| as for `WardLinkage`.
    """

    plane: float = 1.0
    normal: float = 0.0
    color: float = 0.0

    default_object_altitude = 10.0  # lambda
    default_part_altitude = 0.1

    def __post_init__(self) -> None:
        check_numbers(self, "plane", "normal", "color")

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the smallest scale first."""
        regions = regions_of(graph, leaves, 0.0, self.normal, self.color, self.plane**2)
        lengths = graph.edge_features.contact_voxels / 2.0  # boundary voxels of both sides
        return least_increase_linkage(regions, graph.edges, lengths)


def regions_of(
    graph: AdjacencyGraph, leaves: Moments, position: float, normal: float, color: float, plane: float
) -> Regions:
    """Supervoxels as regions, in lengths of a voxel edge and masses of a mean supervoxel."""
    unit = graph.voxel_edge
    mean_count = leaves.counts.mean()
    centroids = leaves.centroids / unit
    columns: list[NDArray[np.float64]] = []
    if position > 0.0:
        columns.append(position * centroids)
    if normal > 0.0:
        columns.append(normal * graph.node_features.normal)
    if color > 0.0 and leaves.colors is not None:
        columns.append(color * leaves.colors)
    values = np.hstack(columns) if columns else np.zeros((len(leaves), 0))
    scatters = leaves.scatters / unit / unit / mean_count  # the square of a tiny unit may be zero
    return Regions(leaves.counts / mean_count, values, centroids, scatters, plane)


class Regions(NamedTuple):
    """What the energy of n regions is made of.

    The energy of a region is the sum over its mass of the squared distance of `values` to their mean, plus
    `plane` times the sum over its mass of the squared distance to its least-squares plane.

    Attributes
    ----------
    masses : (n,) float64, > 0
    values : (n, d) float64
        Mean values, d >= 0.
    centroids : (n, 3) float64
    scatters : (n, 3, 3) float64
        Sum over the mass of (x - centroid)(x - centroid)^T.
    plane : float, >= 0
    """

    masses: NDArray[np.float64]
    values: NDArray[np.float64]
    centroids: NDArray[np.float64]
    scatters: NDArray[np.float64]
    plane: float


def least_increase_linkage(regions: Regions, edges: NDArray[np.int32], lengths: NDArray[np.float64] | None) -> Merges:
    """Merges of regions along edges, the least increase of energy per length of boundary removed first.

    Parameters
    ----------
    regions : Regions, n of them
    edges : (m, 2) int32
        Pairs of distinct regions, each pair once.
    lengths : (m,) float64, > 0, or None
        Boundary that a merge removes; lengths of edges to the same region add up. None: 1 for every merge.

    Returns
    -------
    Merges
        Altitudes are increases per length, made not to decrease: a merge below the altitude of an earlier one,
        which a graph allows, takes that altitude. Of equal increases the first edge merges first.

    Notes
    -----
    Source: Koepfler, Lopez and Morel 1994 (Mumford-Shah by merging); Ward 1963 where lengths are None and
    `plane` is 0. After a merge all edges of the merged region get new costs, so the time is the sum of degrees of
    the merged regions times a logarithm: n log n on graphs of bounded degree, n^2 log n around a hub.
    """
    sums = np.empty((0, len(edges))) if lengths is None else lengths[None].astype(np.float64)
    n = len(regions.masses)
    state = RegionState.of(regions)
    graph = ContractedGraph.of(n, len(edges), sums)
    _merge(state, graph, edges, np.empty(len(edges)))
    merges = graph.merges()
    return Merges(merges.pairs, np.maximum.accumulate(np.maximum(merges.altitudes, 0.0)))


class RegionState(NamedTuple):
    """Regions while they merge: scatters are (n, 6) xx, yy, zz, xy, xz, yz, residuals (n,) sums of squared distances
    to their planes."""

    masses: NDArray[np.float64]
    values: NDArray[np.float64]
    centroids: NDArray[np.float64]
    scatters: NDArray[np.float64]
    residuals: NDArray[np.float64]
    plane: float

    @classmethod
    def of(cls, regions: Regions) -> RegionState:
        """The regions before they merge; residuals are not set."""
        masses, values, centroids, scatters = (np.array(column, np.float64, order="C") for column in regions[:4])
        upper = np.stack([scatters[:, i, j] for i, j in SYMMETRIC_INDICES], axis=1)
        return cls(masses, values, centroids, upper, np.zeros(len(masses)), float(regions.plane))


@routine
def set_residuals(state: RegionState) -> None:
    """Set the sums of squared distances of regions to their planes, where these count."""
    if state.plane > 0.0:
        for a in range(len(state.masses)):
            s = state.scatters[a]
            state.residuals[a] = least_eigenvalue(s[0], s[1], s[2], s[3], s[4], s[5])


@kernel
def _merge(
    state: RegionState, graph: ContractedGraph, edges: NDArray[np.int32], first_costs: NDArray[np.float64]
) -> None:
    """Merge along the cheapest edge until there is none. The costs before the first merge, (m,), are set here."""
    heap, halves, lengths = graph.heap, graph.halves, graph.sums
    set_residuals(state)
    for edge in range(len(edges)):
        first_costs[edge] = _cost(state, lengths, edge, np.int64(edges[edge, 0]), np.int64(edges[edge, 1]))
    insert_edges(graph, edges, first_costs)
    while heap.size[0] > 0:
        kept, gone, _ = contract_cheapest(graph)
        unite(state, kept, gone)
        half = graph.clusters[kept].first
        while half != NONE:
            edge = half >> 1
            heap_update(heap, edge, _cost(state, lengths, edge, kept, halves[half ^ 1].end))
            half = halves[half].after


@routine
def _cost(state: RegionState, lengths: NDArray[np.float64], edge: int, a: int, b: int) -> float:
    """Increase of energy by merging the two regions at an edge, per length where there are lengths."""
    increase = energy_increase(state, a, b, squared_distance(state.values, a, b))
    return increase / lengths[0, edge] if len(lengths) > 0 else increase


@routine
def energy_increase(state: RegionState, a: int, b: int, square: float) -> float:
    """Energy of the union of two regions less the sum of theirs, given the square of their values' distance."""
    reduced = state.masses[a] * state.masses[b] / (state.masses[a] + state.masses[b])
    increase = reduced * square
    if state.plane > 0.0:
        increase += state.plane * (_least_of_union(state, a, b, reduced) - state.residuals[a] - state.residuals[b])
    return increase


@routine
def squared_distance(values: NDArray[np.float64], a: int, b: int) -> float:
    """Square of the distance of two rows."""
    square = 0.0
    for i in range(values.shape[1]):
        gap = values[a, i] - values[b, i]
        square += gap * gap
    return square


@routine
def unite(state: RegionState, kept: int, gone: int) -> None:
    """Give the first of two regions the moments of both."""
    masses, values, centroids, scatters, residuals, plane = state
    total = masses[kept] + masses[gone]
    fraction = masses[gone] / total
    if plane > 0.0:
        reduced = masses[kept] * fraction
        residuals[kept] = _least_of_union(state, kept, gone, reduced)
        for column in range(6):
            i, j = SYMMETRIC_INDICES[column]
            shift = (centroids[kept, i] - centroids[gone, i]) * (centroids[kept, j] - centroids[gone, j])
            scatters[kept, column] += scatters[gone, column] + reduced * shift
    for i in range(values.shape[1]):
        values[kept, i] += fraction * (values[gone, i] - values[kept, i])
    for i in range(3):
        centroids[kept, i] += fraction * (centroids[gone, i] - centroids[kept, i])
    masses[kept] = total


@routine
def _least_of_union(state: RegionState, a: int, b: int, reduced: float) -> float:
    """Sum of squared distances of the union of two regions to its plane."""
    p, q = state.scatters[a], state.scatters[b]
    x = state.centroids[a, 0] - state.centroids[b, 0]
    y = state.centroids[a, 1] - state.centroids[b, 1]
    z = state.centroids[a, 2] - state.centroids[b, 2]
    return least_eigenvalue(
        p[0] + q[0] + reduced * x * x,
        p[1] + q[1] + reduced * y * y,
        p[2] + q[2] + reduced * z * z,
        p[3] + q[3] + reduced * x * y,
        p[4] + q[4] + reduced * x * z,
        p[5] + q[5] + reduced * y * z,
    )
