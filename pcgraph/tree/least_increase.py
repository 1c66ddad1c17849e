# SPDX-License-Identifier: Apache-2.0
"""Least-increase linkage: the merge that raises an energy least, per boundary removed, comes first.

The energies are those of Ward, and of Mumford and Shah.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.hierarchy import NONE
from pcgraph.inputs import check_non_negative
from pcgraph.parallel import kernel, routine
from pcgraph.tree.contraction import ContractedGraph, contract_cheapest, heap_update, insert_edges
from pcgraph.tree.linkage import Linkage, Merges
from pcgraph.voxels.eigen import SYMMETRIC_INDICES, least_eigenvalue


@dataclass(frozen=True)
class WardLinkage(Linkage):
    """Ward's linkage along the graph: the merge that adds least to the sum of squares comes first.

    Attributes
    ----------
    position : float, per voxel, >= 0
        Weight of positions, in voxel edges.
    normal : float, >= 0
        Weight of unit normals.
    color : float, >= 0
        Weight of colours, 0..1.

    Notes
    -----
    A merge of A and B costs |A| |B| / (|A| + |B|) ||f_A - f_B||^2 (Ward 1963), where f are weighted means. |A| is the
    number of points over the mean number of points of a supervoxel, so altitudes depend neither on the unit of length
    nor on the density of points.
    """

    position: float = 0.0
    normal: float = 1.0
    color: float = 0.0

    default_object_altitude = 6.0  # increase of the sum of squares; chosen on 12 clouds of tables (docs/tree.md)
    default_part_altitude = 0.5  # the same; the seven faces of two synthetic boxes on a plane are the parts

    def __post_init__(self) -> None:
        check_non_negative(self, "position", "normal", "color")

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
    The energy is the sum over the regions of |A| (plane^2 mean d^2 + normal^2 var n + color^2 var c), plus lambda x
    length of boundaries, in voxel edges. Two regions merge at lambda = increase of the first term / length of their
    contact, the smallest first (Koepfler et al. 1994). |A| is that of `WardLinkage`.
    """

    plane: float = 1.0
    normal: float = 0.0
    color: float = 0.0

    default_object_altitude = 10.0  # lambda; chosen on 12 clouds of tables (docs/tree.md)
    default_part_altitude = 0.1  # the same; the seven faces of two synthetic boxes on a plane are the parts

    def __post_init__(self) -> None:
        check_non_negative(self, "plane", "normal", "color")

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
    scatters = leaves.scatters / unit / unit / mean_count  # not by the square, which may be 0 of a tiny unit
    return Regions(leaves.counts / mean_count, values, centroids, scatters, plane)


class Regions(NamedTuple):
    """Masses, values and moments of n regions, from which their energies follow.

    The energy of a region is the sum over its mass of the squared distance of `values` to their mean, plus `plane`
    times the sum over its mass of the squared distance to its least-squares plane.

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
        Length of the boundary that a merge removes; lengths of edges to the same region add up. None: 1 for every
        merge.

    Returns
    -------
    Merges
        Altitudes are increases per length. They do not decrease: a merge below the altitude of an earlier one, which a
        graph allows, takes that altitude. Of equal increases that of the first edge comes first.

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
    """Regions while they merge.

    Attributes are those of `Regions`, but for two: `scatters` are (n, 6) xx, yy, zz, xy, xz, yz, and `residuals`, (n,),
    are sums of squared distances to the regions' planes.
    """

    masses: NDArray[np.float64]
    values: NDArray[np.float64]
    centroids: NDArray[np.float64]
    scatters: NDArray[np.float64]
    residuals: NDArray[np.float64]
    plane: float

    @classmethod
    def of(cls, regions: Regions) -> RegionState:
        """The regions before they merge, with residuals of 0 (`set_residuals`)."""
        masses, values, centroids, scatters = (np.array(column, np.float64, order="C") for column in regions[:4])
        upper = np.stack([scatters[:, i, j] for i, j in SYMMETRIC_INDICES], axis=1)
        return cls(masses, values, centroids, upper, np.zeros(len(masses)), float(regions.plane))


@routine
def set_residuals(state: RegionState) -> None:
    """Set the sums of squared distances of regions to their planes, if planes count."""
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
    """Increase of energy by merging the two regions at an edge, per length if there are lengths."""
    increase = energy_increase(state, a, b, squared_distance(state.values, a, b))
    return increase / lengths[0, edge] if len(lengths) > 0 else increase


@routine
def energy_increase(state: RegionState, a: int, b: int, square: float) -> float:
    """Energy of the union of two regions less the sum of theirs; `square` is the squared distance of their values."""
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
