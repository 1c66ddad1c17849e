# SPDX-License-Identifier: Apache-2.0
"""Region linkage: two regions merge early if no valley parts them, and late if they do not lie on one surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.boundary import COST_STEPS, BoundaryCost, in_whole_steps
from pcgraph.graph.continuations import MAX_RESIDUAL
from pcgraph.hierarchy import NONE
from pcgraph.inputs import check_non_negative
from pcgraph.pairs import not_among
from pcgraph.parallel import kernel, routine
from pcgraph.tree.contraction import ContractedGraph, contract_cheapest, heap_update, insert_edges
from pcgraph.tree.least_increase import RegionState, energy_increase, regions_of, set_residuals, squared_distance, unite
from pcgraph.tree.linkage import Linkage, Merges, check_cost
from pcgraph.voxels.eigen import plane_normal


@dataclass(frozen=True)
class RegionLinkage(Linkage):
    """Merging by the concavity of contacts and by the regions as wholes: the default; altitudes in radians.

    Attributes
    ----------
    cost : BoundaryCost
        Cost of an edge, radians.
    gap : float, radians per voxel edge, >= 0
        Cost of a gap for each voxel edge of width beyond the first, in one scan; a third of that in other clouds
        (`Acquisition.is_one_scan`).
    bridge : float, radians per voxel edge, >= 0
        Cost of a bridge from a speck, for each voxel edge of its width.
    color : float, voxel edges, >= 0
        Distance that a difference of 1 in a colour of 0..1 counts for. It is multiplied by how far colours change where
        surfaces do (`AdjacencyGraph.color_evidence`).
    relief : float, radians, >= 0
        Cost of a region that stands in relief, as a door on its wall, a picture, or a roof above the ground.

    Notes
    -----
    Two regions merge at the mean concavity of their contacts (LCCP, Stein et al. 2014), weighed by the increase of
    their squared distances to planes and colours (Mumford and Shah's lambda, Koepfler et al. 1994), by the length of
    their contact, and by their sizes. A region that stands in relief, or as a heap, out of a larger one around it
    merges late.

    The formula with all symbols, and what each term does: docs/pcgraph_method.md, "Tree". Its constants:
    `AltitudeConstants`.
    """

    cost: BoundaryCost = field(default_factory=BoundaryCost)
    gap: float = 0.15
    bridge: float = 0.1
    color: float = 2.5
    relief: float = 15.0

    default_object_altitude = 0.4  # radians; from 0.34 to 0.43 the mean of all scores changes by 0.003
    default_part_altitude = 0.06  # radians; the seven faces of two synthetic boxes on a plane are the parts

    def __post_init__(self) -> None:
        check_cost(self.cost)
        check_non_negative(self, "gap", "bridge", "color", "relief")

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the least altitude first."""
        color = self.color * graph.color_evidence
        return region_linkage(graph, leaves, self._ways(graph), color, self.relief)

    def _ways(self, graph: AdjacencyGraph) -> MergeEdges:
        """Edges along which regions merge: contacts, gaps, continuations, terrain, and bridges."""
        ways = [MergeEdges.of(graph.edges, self.cost(graph.edge_features), graph.edge_features.contact_voxels)]
        if (gaps := graph.gaps) is not None:
            beyond = np.maximum(gaps.widths - 1.0, 0.0)  # centroids of larger voxels can be nearer than an edge
            price = (self.gap if graph.acquisition.is_one_scan else _GAP_OF_SEVERAL_SCANS * self.gap) * beyond
            ways.append(MergeEdges.of(gaps.edges, self.cost(gaps.edge_features) + price, gaps.weights))
        if (hidden := graph.continuations) is not None:
            behind, ground = hidden.chosen(hidden.coplanar), hidden.chosen(~hidden.coplanar)
            ways.append(MergeEdges.of(behind.pairs, np.zeros(len(behind.pairs)), 2.0 * behind.crossings))
            if len(ground.pairs):
                ways = [some._replace(terrain=~not_among(some.edges, ground.pairs)) for some in ways]
                for some in ways:
                    ground = ground.without(some.edges)
                n, every = len(ground.pairs), np.ones(len(ground.pairs), np.bool_)
                ways.append(MergeEdges(ground.pairs, np.zeros(n), np.full(n, _VOXELS_OF_BRIDGE), every, every))
        if (bridges := graph.bridges) is not None:
            order = np.argsort(~bridges.between_specks, kind="stable")
            costs = np.where(bridges.between_specks, _COST_BETWEEN_SPECKS, self.bridge * bridges.widths)
            of_bridges = MergeEdges.of(bridges.edges[order], costs[order], np.full(len(order), _VOXELS_OF_BRIDGE))
            ways.append(of_bridges._replace(bridges=~bridges.between_specks[order]))
        return MergeEdges(*(np.concatenate(columns) for columns in zip(*ways, strict=True)))


class MergeEdges(NamedTuple):
    """Edges along which regions may merge.

    Attributes
    ----------
    edges : (m, 2) int32
        Pairs of distinct regions, each pair once.
    costs : (m,) float64, radians, >= 0
    weights : (m,) float64, > 0
        Voxels of contact, of both sides.
    bridges, terrain : (m,) bool
        Whether an edge is a bridge, not a contact; and whether it joins two pieces of terrain.
    """

    edges: NDArray[np.int32]
    costs: NDArray[np.float64]
    weights: NDArray[np.float64]
    bridges: NDArray[np.bool_]
    terrain: NDArray[np.bool_]

    @classmethod
    def of(cls, edges: NDArray[np.int32], costs: NDArray[np.float64], weights: NDArray[np.number]) -> MergeEdges:
        """Edges that are neither bridges nor terrain."""
        none = np.zeros(len(edges), np.bool_)
        return cls(edges, costs, weights.astype(np.float64), none, none)


_COST, _WEIGHT, _SMOOTHNESS, _BRIDGE, _TERRAIN = range(5)
"""Rows of ``ContractedGraph.sums``, over the edges that have become one."""
_GAP_OF_SEVERAL_SCANS = 1.0 / 3.0
"""Fraction of the price of a gap that counts in several scans, where one scan leaves gaps and another is dense.
Measured against the full price: cars bumper to bumper cover 0.99 for 0.78, forests 0.77 for 0.72, thinned streets lose
0.02. In one scan the price stays: without it sweeps lose 0.01 of their things."""
_COST_BETWEEN_SPECKS = 3.0
"""Cost, radians, of a bridge between specks of a few points: as of a steep valley. For so few points that is below the
altitude of objects. Chosen by eye; not varied."""
_VOXELS_OF_BRIDGE = 2.0
"""Voxels of contact as which a bridge, or a way between pieces of terrain, counts: one on each side, as in the least
contact there can be."""
_MAX_UPDATED_EDGES = 40
"""Most edges of a merged region, count, that get new altitudes at once. Each merge hardly changes the altitudes of a
region with more, so they are computed when they come up, and a hub does not cost the square of its degree. Why 40 is
not recorded; not varied."""


class AltitudeConstants(NamedTuple):
    """Constants of the altitude of a merge, named by the symbols of docs/pcgraph_method.md ("Tree").

    Lengths are in voxel edges, masses in mean supervoxels, altitudes in radians.

    They were chosen for the mean over depth images of tables, a fused office, simulated rooms and streets, bins and
    airborne scans. When heaps were added, each constant but h0 and h1 was tried times 0.8 and 1.25: neither the mean of
    these domains nor that of 27 further kinds of scene gained more than 0.0007. So a field that gives no other reason
    has this one. What each term gains: docs/pcgraph_experiments.md.
    """

    c0: float = 0.08
    """Evidence, radians, of two regions without a valley: without it 53 of 66 domains change, but not their mean."""
    c1: float = 0.04
    """Evidence, radians, per logarithm of the scale l: without it the mean of all scores loses 0.005."""
    c2: float = 0.45
    """Concavity, radians, above which a valley is steep."""
    s0: float = 0.5
    """Least shortness of contact, fraction, as which a steep valley counts: heaps are told from the ground."""
    v1: float = 0.03
    """Circular variance of the normals of a supervoxel, fraction, at which its surface counts as half smooth."""
    e0: float = 1.0
    """Increase of energy, squared voxel edges times mass, at which a merge costs half: what lies on one plane merges
    first. With nearly none the mean loses 0.0056."""
    e1: float = 0.3
    """Fraction of the mean square distance from its plane of an uneven larger region that counts as increase."""
    q0: float = 2.0
    """Mean square distance from its plane, squared voxel edges, from which on a region counts as uneven: without e1 and
    q0, hay bales on rolling ground lose 0.09 of their things."""
    l0: float = 0.1
    """Scale l, squared voxel edges times mass per voxel edge, well below which two regions are one surface."""
    width: float = 7.7
    """Width w, voxel edges, of a region of the mass of a mean supervoxel; of a region of mass m it is width sqrt(m)."""
    r: float = 100.0
    """Ratio of masses at which the smaller region merges 1.19 times as high, so that it is whole before it joins its
    support."""
    m0: float = 0.1
    """Mass, mean supervoxels, at which the contact of a small region counts half: it says little."""
    m1: float = 1.0
    """Mass, mean supervoxels, at which a bridge costs half: specks merge early among bridges."""
    m2: float = 10.0
    """Mass, mean supervoxels, at which relief, heaps and colours along a valley count half: they are no specks."""
    b1: float = 3.5
    """Length of contact, in widths w of the smaller region, from which on relief does not grow; the outline of a disc
    is 3.14 of its widths."""
    r1: float = 2.0
    """Least ratio of the masses of what surrounds or bears a thing, and the thing."""
    v0: float = 0.075
    """Variance of distances from a plane, squared voxel edges, that is noise in any case: 0.27 voxel edges, so that
    ground whose heights are whole decimetres is one."""
    d1: float = 3.0
    """Distance from the plane, voxel edges, at which relief counts half: what stands farther off shows a valley."""
    h0: float = 0.3
    """Concavity, radians, above which a valley all around makes a heap. With 0.25 to 0.35, and 4 to 14 for h1, the mean
    of all scores of 90 photogrammetric clouds is 0.812 to 0.819; without heaps 0.800."""
    h1: float = 9.0
    """Evidence of a heap, radians per radian of concavity above h0: see h0."""
    k1: float = 8.0
    """Times that a valley counts along which colours change: with 6 and 11 the covering of 31 flats changes by 0.003 at
    most."""
    objects: float = RegionLinkage.default_object_altitude
    """Altitude of objects, radians: terrain merges there at the latest, and bridges above it. From 0.34 to 0.43 the
    mean of all scores changes by 0.003."""
    wait_above: float = 0.25
    """Altitude, radians, from which on the merge of a thing with its support may wait for another. What lies on a
    surface joins it below that. At 0.1 bins lose 0.07 of their covering, at 0.25 0.015; at 0.4 the balls of a dumbbell
    join the table before the bar between them."""
    max_waits: int = 64
    """Most times, count, that a merge waits: two that wait for each other come to an end."""
    whole: float = 3.0
    """Least mass, mean supervoxels, of regions that wait or are waited for: smaller ones are parts of surfaces."""
    flat: float = MAX_RESIDUAL**2
    """Most mean square distance of a support from its plane, squared voxel edges: half an edge is what voxels make of a
    plane. Terrain is less flat; its pieces lie off each other's planes without standing on each other."""
    clear: float = 1.0
    """Least distance from the plane of a support, voxel edges, at which a region stands on it: less is noise."""


_CONSTANTS = AltitudeConstants()


class _Outlines(NamedTuple):
    """Outlines and outer sides of n regions while they merge, from which relief follows.

    Attributes
    ----------
    perimeters : (n,) float64
        Contacts with all other regions, in voxels of both sides.
    outward : (n, 3) float64
        Sums of the normals of their supervoxels, weighted by mass.
    sides_known : bool
        Whether it is known from where the regions were seen.
    """

    perimeters: NDArray[np.float64]
    outward: NDArray[np.float64]
    sides_known: bool


def region_linkage(
    graph: AdjacencyGraph, leaves: Moments, ways: MergeEdges, color: float = 0.0, relief: float = 0.0
) -> Merges:
    """Merges of regions along edges, those at the least altitude first.

    Parameters
    ----------
    graph : AdjacencyGraph of k nodes
        Its contacts give the unit of length, a voxel edge.
    leaves : Moments of k regions
    ways : MergeEdges
    color : float, voxel edges, >= 0
        Distance that a difference of 1 in colour counts for.
    relief : float, radians, >= 0
        Cost of a region that stands in relief.

    Returns
    -------
    Merges
        Altitudes do not decrease: a merge below the altitude of an earlier one takes that altitude. Of edges at equal
        altitudes the first merges first.
    """
    edges, costs, weights, bridges, terrain = ways
    state = RegionState.of(regions_of(graph, leaves, 0.0, 0.0, color, 1.0))
    sums: NDArray[np.float64] = np.stack(
        (costs * weights, weights, _smoothness(leaves, edges) * weights, bridges * weights, terrain)
    )
    sums = sums[: (_TERRAIN if terrain.any() else _BRIDGE if bridges.any() else _SMOOTHNESS) + 1]
    perimeters = np.bincount(edges.ravel(), np.repeat(weights, 2), graph.n_nodes)
    outward = state.masses[:, None] * graph.node_features.normal
    outlines = _Outlines(perimeters.astype(np.float64), outward, graph.acquisition.sides_known)
    contracted, scratch = ContractedGraph.of(graph.n_nodes, len(edges), sums), np.empty((2, 3))
    _merge(state, outlines, relief, contracted, _CONSTANTS, edges, np.empty(len(edges)), scratch)
    merges = contracted.merges()
    return Merges(merges.pairs, np.maximum.accumulate(merges.altitudes))


def _smoothness(leaves: Moments, edges: NDArray[np.int32]) -> NDArray[np.float64]:
    """Smoothness of the rougher region at each edge, (m,) float64, 0..1, in whole steps: the symbol u."""
    if leaves.normals is None:
        return np.ones(len(edges))
    spread = 1.0 - np.sqrt(np.einsum("ij,ij->i", leaves.normals, leaves.normals))
    rougher = np.maximum(spread[edges[:, 0]], spread[edges[:, 1]])
    return in_whole_steps(1.0 / (1.0 + np.square(rougher / _CONSTANTS.v1)))


@kernel
def _merge(
    state: RegionState,
    outlines: _Outlines,
    relief: float,
    graph: ContractedGraph,
    constants: AltitudeConstants,
    edges: NDArray[np.int32],
    altitudes: NDArray[np.float64],
    scratch: NDArray[np.float64],
) -> None:
    """Merge along the lowest edge until no edge is left. The altitudes before the first merge, (m,), are set here.

    After a merge the edges of the merged region get new altitudes. Of a region with many edges, each gets its new
    altitude when it comes up. Whether one region stands out of the other is also asked when their edge comes up; if so,
    its altitude rises.
    """
    heap, halves, clusters, sums = graph.heap, graph.halves, graph.clusters, graph.sums
    perimeters, outward, _ = outlines
    # Numbers of merges done as a region changed, an altitude was computed, and (plus 1) relief was asked for.
    changed, computed = np.zeros(len(clusters), np.int64), np.zeros(len(heap.edges), np.int64)
    asked, waits = np.zeros(len(heap.edges), np.int64), np.zeros(len(heap.edges), np.int64)  # and how often it waited
    normal, normal_of_other = scratch[0], scratch[1]
    set_residuals(state)
    for edge in range(len(edges)):
        a, b = np.int64(edges[edge, 0]), np.int64(edges[edge, 1])
        altitudes[edge] = _altitude(state, sums, edge, a, b, 0.0, constants)
    insert_edges(graph, edges, altitudes)
    while heap.size[0] > 0:
        edge = heap.order[0]
        a, b = halves[2 * edge].end, halves[2 * edge + 1].end
        if computed[edge] < max(changed[a], changed[b]):
            computed[edge] = graph.done[0]
            heap_update(heap, edge, _altitude(state, sums, edge, a, b, 0.0, constants))
            continue
        if asked[edge] <= computed[edge]:
            asked[edge] = computed[edge] + 1
            stands_out = _standing_out(state, outlines, sums, edge, a, b, relief, constants, normal)
            if stands_out > 0.0:
                heap_update(heap, edge, _altitude(state, sums, edge, a, b, stands_out, constants))
                continue
        if heap.edges[edge].cost > constants.wait_above and waits[edge] < constants.max_waits:
            later = _awaited(state, graph, a, b, constants, normal, normal_of_other)
            if later >= heap.edges[edge].cost:
                waits[edge] += 1
                heap_update(heap, edge, later + 1.0 / COST_STEPS)
                continue
        inside = 2.0 * sums[_WEIGHT, edge]
        kept, gone, n_parallel = contract_cheapest(graph)
        unite(state, kept, gone)
        perimeters[kept] += perimeters[gone] - inside
        for axis in range(3):
            outward[kept, axis] += outward[gone, axis]
        changed[kept] = graph.done[0]
        half = clusters[kept].first if clusters[kept].degree <= _MAX_UPDATED_EDGES else NONE
        while half != NONE:
            edge = half >> 1
            computed[edge] = graph.done[0]
            heap_update(heap, edge, _altitude(state, sums, edge, kept, halves[half ^ 1].end, 0.0, constants))
            half = halves[half].after
        for edge in graph.parallel[:n_parallel]:
            if computed[edge] < graph.done[0]:  # two edges became one, which changes its altitude at once
                computed[edge] = graph.done[0]
                a, b = halves[2 * edge].end, halves[2 * edge + 1].end
                heap_update(heap, edge, _altitude(state, sums, edge, a, b, 0.0, constants))


@routine
def _awaited(
    state: RegionState,
    graph: ContractedGraph,
    a: int,
    b: int,
    constants: AltitudeConstants,
    normal: NDArray[np.float64],
    normal_of_other: NDArray[np.float64],
) -> float:
    """Altitude at which the smaller of two regions, on its support, merges first with a third beside it; -1 if never.

    The larger region is the support. A third region counts if it lies on the same side of the support and is no support
    of the smaller one itself. So a dumbbell is whole before it joins its table, though its bar is a deeper valley than
    its feet. The normals are scratch.
    """
    if state.masses[b] < state.masses[a]:
        a, b = b, a
    side = _side_on(state, a, b, constants, normal)
    if state.masses[a] < constants.whole or side == 0.0:
        return -1.0
    heap, halves, clusters = graph.heap, graph.halves, graph.clusters
    least, half = np.inf, clusters[a].first
    while half != NONE:
        c, cost = halves[half ^ 1].end, heap.edges[half >> 1].cost
        is_whole = c != b and state.masses[c] >= constants.whole
        if is_whole and cost < least and side * _height(state, c, b, normal) > constants.clear:
            least = cost if _side_on(state, a, c, constants, normal_of_other) == 0.0 else least
        half = halves[half].after
    return least if least < np.inf else -1.0


@routine
def _side_on(state: RegionState, a: int, b: int, constants: AltitudeConstants, normal: NDArray[np.float64]) -> float:
    """Side of region b on which region a stands, 1 or -1; 0 if b is no support of a.

    A support is flat and much larger, and a is clear of its plane. `normal` receives the normal of b.
    """
    if constants.r1 * state.masses[a] >= state.masses[b] or state.residuals[b] > constants.flat * state.masses[b]:
        return 0.0
    if plane_normal(state.scatters[b], normal) < 0.0:
        return 0.0
    height = _height(state, a, b, normal)
    return np.sign(height) if abs(height) > constants.clear else 0.0


@routine
def _height(state: RegionState, a: int, b: int, normal: NDArray[np.float64]) -> float:
    """Distance of region a from the plane of region b, whose normal is given, voxel edges."""
    height = 0.0
    for axis in range(3):
        height += normal[axis] * (state.centroids[a, axis] - state.centroids[b, axis])
    return height


@routine
def _altitude(
    state: RegionState,
    sums: NDArray[np.float64],
    edge: int,
    a: int,
    b: int,
    stands_out: float,
    constants: AltitudeConstants,
) -> float:
    """Altitude at which the two regions at an edge merge, radians, evidence times weight of docs/pcgraph_method.md.

    It is a whole number of steps, so that the rounding noise of energies near 0 does not order merges.
    """
    cost, length = sums[_COST, edge] / sums[_WEIGHT, edge], 0.5 * sums[_WEIGHT, edge]
    smaller, larger = min(state.masses[a], state.masses[b]), max(state.masses[a], state.masses[b])
    objects, is_terrain = round(constants.objects * COST_STEPS), len(sums) > _TERRAIN and sums[_TERRAIN, edge] > 0.0
    if len(sums) > _BRIDGE and sums[_BRIDGE, edge] == sums[_WEIGHT, edge]:  # nothing but bridges
        if is_terrain:
            return objects / COST_STEPS
        return max(round(cost * smaller / (smaller + constants.m1) * COST_STEPS), objects + 1) / COST_STEPS
    uneven = state.residuals[a if state.masses[a] == larger else b] / larger - constants.q0
    contrast = squared_distance(state.values, a, b)
    increase = max(energy_increase(state, a, b, contrast), constants.e1 * smaller * uneven, 0.0)
    scale = increase / length
    width = constants.width * math.sqrt(smaller)
    shortness = width / (length + width)
    shortness = math.sqrt(shortness * math.sqrt(shortness))  # to the power of 3/4
    evidence = (cost + stands_out + constants.c0 + constants.c1 * math.log(1.0 + scale / constants.l0)) * shortness
    if cost > constants.c2 and shortness < constants.s0:
        steep = (cost - constants.c2) * (constants.s0 - shortness)
        evidence += steep * sums[_SMOOTHNESS, edge] / sums[_WEIGHT, edge]
    of_colors = constants.k1 * cost * (1.0 - shortness) * contrast / (1.0 + contrast)
    evidence += of_colors * smaller / (smaller + constants.m2)
    evidence *= increase / (increase + constants.e0) * math.sqrt(scale / (scale + constants.l0))
    evidence *= math.sqrt(math.sqrt(1.0 + larger / (constants.r * smaller))) * smaller / (smaller + constants.m0)
    altitude = round(evidence * COST_STEPS)
    return (min(altitude, objects) if is_terrain else altitude) / COST_STEPS


@routine
def _standing_out(
    state: RegionState,
    outlines: _Outlines,
    sums: NDArray[np.float64],
    edge: int,
    a: int,
    b: int,
    relief: float,
    constants: AltitudeConstants,
    normal: NDArray[np.float64],
) -> float:
    """Evidence, radians, that the smaller region at an edge stands out of the larger: R + H of docs/pcgraph_method.md.

    `normal` is scratch.
    """
    if state.masses[b] < state.masses[a]:
        a, b = b, a
    smaller, larger, contact = state.masses[a], state.masses[b], sums[_WEIGHT, edge]
    if constants.r1 * smaller >= larger or plane_normal(state.scatters[b], normal) < 0.0:
        return 0.0
    x, y, z = normal
    inner, outer = state.centroids[a], state.centroids[b]
    distance = x * (inner[0] - outer[0]) + y * (inner[1] - outer[1]) + z * (inner[2] - outer[2])
    outwards = x * outlines.outward[b, 0] + y * outlines.outward[b, 1] + z * outlines.outward[b, 2]
    enclosed, cost, heap = min(contact / outlines.perimeters[a], 1.0), sums[_COST, edge] / contact, 0.0
    if cost > constants.h0 and distance * outwards >= 0.0:
        heap = constants.h1 * (cost - constants.h0) * enclosed**8 * sums[_SMOOTHNESS, edge] / contact
    elif outlines.sides_known and distance * outwards < 0.0:
        return 0.0  # it lies behind
    width = constants.width * math.sqrt(smaller)
    within = enclosed * enclosed * min(0.5 * contact / (constants.b1 * width), 1.0)
    scatter = state.scatters[a]
    spread = x * x * scatter[0] + y * y * scatter[1] + z * z * scatter[2]
    spread += 2.0 * (x * y * scatter[3] + x * z * scatter[4] + y * z * scatter[5])
    square, off = distance * distance, 0.0
    # With 8 times the smaller region's variance in place of 4, windows of a house front are lost (IoU 0.54).
    noise = constants.v0 + 4.0 * spread / smaller + state.residuals[b] / larger
    if square >= 0.1 * noise:  # else `off` would be less than 1e-8
        off = 1.0 / ((1.0 + (noise / square) ** 8) * (1.0 + square / (constants.d1 * constants.d1)))
    in_relief = within * within * (1.0 - constants.r1 * smaller / larger) * off
    return (relief * in_relief + heap) * smaller / (smaller + constants.m2)
