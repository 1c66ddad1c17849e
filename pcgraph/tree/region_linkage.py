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
from pcgraph.graph.boundary import BoundaryCost
from pcgraph.pairs import not_among
from pcgraph.parallel import kernel, routine
from pcgraph.tree.contraction import NONE, ContractedGraph, contract_cheapest, heap_update, insert_edges
from pcgraph.tree.least_increase import RegionState, energy_increase, regions_of, set_residuals, squared_distance, unite
from pcgraph.tree.linkage import Linkage, Merges, check_cost, check_numbers
from pcgraph.voxels.eigen import plane_normal


@dataclass(frozen=True)
class RegionLinkage(Linkage):
    """Merging by the concavity of contacts and by what the regions are as wholes: the default; altitudes in radians.

    Attributes
    ----------
    cost : BoundaryCost
        Cost of an edge, radians.
    gap : float, radians per voxel edge, >= 0
        What a gap in one scan costs beyond one voxel edge; a third of that in other clouds (`Gaps.of_one_scan`).
    bridge : float, radians per voxel edge, >= 0
        What a bridge from a speck costs.
    color : float, voxel edges, >= 0
        Distance that a difference of 1 counts for, in a colour of 0..1, if colours change where surfaces do; less as
        they do not (`AdjacencyGraph.color_evidence`).
    relief : float, radians, >= 0
        What a region costs that stands in relief: a door on its wall, a picture, a roof above the ground.

    Notes
    -----
    Two regions merge at an altitude, in radians, of evidence times weight::

        evidence = (c + relief R + H + c0 + c1 ln(1 + l / l0)) s
                   + max(c - c2, 0) max(s0 - s, 0) u
                   + k1 c (1 - s) D m / (m + m2)
        weight   = E / (E + e0)  (l / (l + l0))^1/2  (1 + M / (r m))^1/4  m / (m + m0)

    Lengths are in voxel edges, masses in mean supervoxels:

    - m, M: masses of the smaller and of the larger region.
    - c: mean cost of their contacts, weighted by length: concavity as in LCCP (Stein et al. 2014).
    - b, w: length of their contact, and width of the smaller region; s = (w / (b + w))^3/4, how short the contact is.
    - E: increase of the squared distances to the regions' best planes and mean colours by the merge, at least
      e1 m (q - q0), with q the mean square distance of the larger one from its own plane; l = E / b, lambda of Mumford
      and Shah (Koepfler et al. 1994).
    - u: mean over the contacts of 1 / (1 + (v / v1)^2), v being the circular variance of the rougher supervoxel's
      normals, 1 less the length of their mean.
    - D = d^2 / (1 + d^2), d being the distance of the two mean colours times `color`; 0 without colours.

    What the terms do:

    - E, l: what lies on one plane and has one colour merges first, whatever its normals; unless the larger region is so
      uneven, as hills are, that its plane says nothing.
    - m / (m + m0): a small piece merges early, as its contact says little, and a handful of points at once.
    - M / (r m): a piece merges later with a surface a hundred times as large, so that a thing is whole before it joins
      what it stands on.
    - c s: a valley counts most between two large surfaces that meet along a line short for their size.
    - c2, s0: what is steep of a valley counts half at least, however long the line, so that a heap is told from the
      ground; but only as far as the surfaces beside it are smooth, so that the crown of a tree is not parted at its
      clefts.
    - k1: a valley along which colours change, as where a door or a curtain is before its wall, counts however long it
      is. Prints and shadows, on one plane or over an edge, have no valley.

    R, 0..1, says that the smaller region stands in relief: the larger one surrounds it, and it lies off the larger
    one's plane by little, but as a whole. Normals of voxels do not show such a step: it is as high as a voxel or two::

        R = (t^2 b / (b1 w))^2 (1 - r1 m / M) m / (m + m2) / (1 + (v / d^2)^8) / (1 + (d / d1)^2),  v = 4 p + q + v0

    t is the fraction of the smaller region's contacts that are with the larger one, and b counts up to b1 w; d is the
    distance of the smaller one's mean from the larger one's plane, p the variance of its own distances to that plane.
    R is 0 where the larger one is not r1 times as large, and where the smaller one lies behind it: as with concavity,
    what stands out of a surface is another thing, and what is sunk into it, as panes in a wall, is not. Where it is not
    known from where the cloud was seen, either side counts, as which is the outer one of a bare sheet is a guess.

    H, radians, says that the smaller region is a heap or a hump on the larger one: a valley runs all around it, so that
    s is small, but there is no other way out of it::

        H = h1 max(c - h0, 0) t^8 u m / (m + m2)

    It is 0 where the larger one is not r1 times as large; and, whatever is known of the sides, where the smaller one
    lies behind its plane, as the floor of a pit does.

    What stands on a support is whole before it joins it, also where its parts meet at a neck that is a deeper valley
    than the line along which they meet the support, as the balls of a dumbbell do: a merge above 0.25 rad of a region
    with a flat one, twice as large or larger, waits for the first merge of the smaller one with a third that lies on
    the same side of the flat one.

    Regions merge along

    - contacts: voxels that touch;
    - gaps, at a price (`pcgraph.graph.gaps.gaps`);
    - continuations behind what hides a surface, and of planes that bound the scene, at no cost
      (`pcgraph.graph.continuations.continuations`, `pcgraph.graph.bounding_planes.bounding_planes`);
    - terrain, at the altitude of objects if they do no sooner (`pcgraph.graph.terrain.terrain`);
    - bridges from specks (`pcgraph.graph.bridges.bridges`): where nothing else joins two regions, above the altitude of
      objects, at their mean cost times m / (m + 1), so that specks are the first to go in coarser cuts. Bridges between
      specks of a few points that lie about as near to each other as to anything count as contacts at 3 rad, so that a
      surface sampled too thinly for voxels does not fall apart.

    The constants were chosen for the mean over depth images of tables, a fused office, simulated rooms and streets,
    bins and airborne scans (docs/pcgraph_benchmarks.md); none is far from others that do as well.
    """

    cost: BoundaryCost = field(default_factory=BoundaryCost)
    gap: float = 0.15
    bridge: float = 0.1
    color: float = 2.5
    relief: float = 15.0

    default_object_altitude = 0.4
    default_part_altitude = 0.06

    def __post_init__(self) -> None:
        check_cost(self.cost)
        check_numbers(self, "gap", "bridge", "color", "relief")

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the least altitude first."""
        color = self.color * graph.color_evidence
        return region_linkage(graph, leaves, self._ways(graph), color, self.relief)

    def _ways(self, graph: AdjacencyGraph) -> MergeEdges:
        """Edges along which regions merge: contacts, gaps, continuations, terrain, and bridges."""
        ways = [MergeEdges.of(graph.edges, self.cost(graph.edge_features), graph.edge_features.contact_voxels)]
        if (gaps := graph.gaps) is not None:
            beyond = np.maximum(gaps.widths - 1.0, 0.0)  # larger voxels' centroids can be nearer than their edge
            price = (self.gap if gaps.of_one_scan else _OF_SEVERAL * self.gap) * beyond
            ways.append(MergeEdges.of(gaps.edges, self.cost(gaps.edge_features) + price, gaps.weights))
        if (hidden := graph.continuations) is not None:
            behind, ground = hidden.chosen(hidden.coplanar), hidden.chosen(~hidden.coplanar)
            ways.append(MergeEdges.of(behind.pairs, np.zeros(len(behind.pairs)), 2.0 * behind.crossings))
            if len(ground.pairs):
                ways = [some._replace(terrain=~not_among(some.edges, ground.pairs)) for some in ways]
                for some in ways:
                    ground = ground.without(some.edges)
                n, every = len(ground.pairs), np.ones(len(ground.pairs), np.bool_)
                ways.append(MergeEdges(ground.pairs, np.zeros(n), np.full(n, _BRIDGE_VOXELS), every, every))
        if (bridges := graph.bridges) is not None:
            order = np.argsort(~bridges.between_specks, kind="stable")
            costs = np.where(bridges.between_specks, _BETWEEN_SPECKS, self.bridge * bridges.widths)
            of_bridges = MergeEdges.of(bridges.edges[order], costs[order], np.full(len(order), _BRIDGE_VOXELS))
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
        Contacts in voxels, of both sides.
    bridges, terrain : (m,) bool
        Which are no contacts, and which lead from ground to ground.
    """

    edges: NDArray[np.int32]
    costs: NDArray[np.float64]
    weights: NDArray[np.float64]
    bridges: NDArray[np.bool_]
    terrain: NDArray[np.bool_]

    @classmethod
    def of(cls, edges: NDArray[np.int32], costs: NDArray[np.float64], weights: NDArray[np.number]) -> MergeEdges:
        """Contacts, neither bridges nor terrain."""
        none = np.zeros(len(edges), np.bool_)
        return cls(edges, costs, weights.astype(np.float64), none, none)


_COST, _WEIGHT, _SMOOTHNESS, _BRIDGE, _TERRAIN = range(5)  # rows of ContractedGraph.sums, over the merged edges
_STEPS = float(1 << 20)
_MANY = 40  # edges of a region
_OF_SEVERAL = 1.0 / 3.0  # of the price of a gap, where scans lie over each other
_BETWEEN_SPECKS = 3.0  # radians: as of a steep valley
_MAY_WAIT = 0.25
"""Altitude in radians from which on a merge waits for another. What lies on a surface joins it below that. At 0.1, bins
lose 0.07 of their covering, at 0.25 0.015; at 0.4, balls of a dumbbell join the table before the bar between them."""
_WHOLE = 3.0
"""Least mass in mean supervoxels of regions that wait or are waited for, because smaller ones are parts of surfaces."""
_FLAT = 0.25
"""Largest mean square distance of a support from its plane, squared voxel edges: half an edge is what voxels make of a
plane. Terrain is less flat; its patches lie off each other's planes without standing on each other."""
_CLEAR = 1.0
"""Least distance from the plane of the support, voxel edges, because less is the noise of the support itself."""
_MAX_WAITS = 64
"""Largest number of times that a merge waits, so that two that wait for each other come to an end."""
_BRIDGE_VOXELS = 2.0  # that a bridge counts as a contact where others join it: one on each side


class _Shape(NamedTuple):
    """Constants of the altitude, as in `RegionLinkage`; the width w of a region of mass m is `width` sqrt(m)."""

    c0: float
    c1: float
    c2: float
    s0: float
    v1: float
    e0: float
    e1: float
    q0: float
    l0: float
    width: float
    r: float
    m0: float
    m1: float
    m2: float
    b1: float
    r1: float
    v0: float
    d1: float
    h0: float
    h1: float
    k1: float
    objects: float  # altitude of objects, radians


_SHAPE = _Shape(
    c0=0.08,
    c1=0.04,
    c2=0.45,
    s0=0.5,
    v1=0.03,
    e0=1.0,
    e1=0.3,
    q0=2.0,
    l0=0.1,
    width=7.7,
    r=100.0,
    m0=0.1,
    m1=1.0,
    m2=10.0,
    b1=3.5,
    r1=2.0,
    v0=0.075,
    d1=3.0,
    h0=0.3,
    h1=9.0,
    k1=8.0,
    objects=RegionLinkage.default_object_altitude,
)


class _Outlines(NamedTuple):
    """What relief asks of n regions beside their moments, while they merge.

    Attributes
    ----------
    perimeters : (n,) float64
        Contacts with all others, in voxels of both sides.
    outward : (n, 3) float64
        Sums of their supervoxels' normals, by mass.
    sides_known : bool
        Whether it is known from where they were seen.
    """

    perimeters: NDArray[np.float64]
    outward: NDArray[np.float64]
    sides_known: bool


def region_linkage(
    graph: AdjacencyGraph, leaves: Moments, ways: MergeEdges, color: float = 0.0, relief: float = 0.0
) -> Merges:
    """Merges of regions along edges, the least altitude of `RegionLinkage` first.

    Parameters
    ----------
    graph : AdjacencyGraph of k nodes
        Its contacts give the unit of length, a voxel edge.
    leaves : Moments of k regions
    ways : MergeEdges
    color : float, voxel edges, >= 0
        What colours count, if there are any.
    relief : float, radians, >= 0
        What a region costs that stands in relief.

    Returns
    -------
    Merges
        Altitudes are made not to decrease: a merge below the altitude of an earlier one takes that. Of equal ones the
        first edge merges first.
    """
    edges, costs, weights, bridges, terrain = ways
    state = RegionState.of(regions_of(graph, leaves, 0.0, 0.0, color, 1.0))
    sums: NDArray[np.float64] = np.stack(
        (costs * weights, weights, _smoothness(leaves, edges) * weights, bridges * weights, terrain)
    )
    sums = sums[: (_TERRAIN if terrain.any() else _BRIDGE if bridges.any() else _SMOOTHNESS) + 1]
    perimeters = np.bincount(edges.ravel(), np.repeat(weights, 2), graph.n_nodes)
    outward = state.masses[:, None] * graph.node_features.normal
    outlines = _Outlines(perimeters.astype(np.float64), outward, graph.sides_known)
    contracted = ContractedGraph.of(graph.n_nodes, len(edges), sums)
    _merge(state, outlines, relief, contracted, edges, np.empty(len(edges)), np.empty((2, 3)))
    merges = contracted.merges()
    return Merges(merges.pairs, np.maximum.accumulate(merges.altitudes))


def _smoothness(leaves: Moments, edges: NDArray[np.int32]) -> NDArray[np.float64]:
    """How smooth the rougher region at each edge is, (m,) float64, 0..1: u of `RegionLinkage`, in whole steps."""
    if leaves.normals is None:
        return np.ones(len(edges))
    spread = 1.0 - np.sqrt(np.einsum("ij,ij->i", leaves.normals, leaves.normals))
    rougher = np.maximum(spread[edges[:, 0]], spread[edges[:, 1]])
    return np.rint(_STEPS / (1.0 + np.square(rougher / _SHAPE.v1))) / _STEPS


@kernel
def _merge(
    state: RegionState,
    outlines: _Outlines,
    relief: float,
    graph: ContractedGraph,
    edges: NDArray[np.int32],
    altitudes: NDArray[np.float64],
    scratch: NDArray[np.float64],
) -> None:
    """Merge along the lowest edge until there is none. The altitudes before the first merge, (m,), are set here.

    After a merge all edges of the merged region get new altitudes; of a region with many, whose altitudes each merge
    hardly changes, an edge gets it when it comes up. Then, too, it is seen whether one stands out, which raises it.
    """
    heap, halves, clusters, sums = graph.heap, graph.halves, graph.clusters, graph.sums
    perimeters, outward, _ = outlines
    # After how many merges each region changed, each altitude was computed, and, plus 1, it was asked what stands out.
    changed, computed = np.zeros(len(clusters), np.int64), np.zeros(len(heap.edges), np.int64)
    asked, waits = np.zeros(len(heap.edges), np.int64), np.zeros(len(heap.edges), np.int64)  # and how often it waited
    normal, normal_of_other = scratch[0], scratch[1]
    set_residuals(state)
    for edge in range(len(edges)):
        altitudes[edge] = _altitude(state, sums, edge, np.int64(edges[edge, 0]), np.int64(edges[edge, 1]), 0.0)
    insert_edges(graph, edges, altitudes)
    while heap.size[0] > 0:
        edge = heap.order[0]
        a, b = halves[2 * edge].end, halves[2 * edge + 1].end
        if computed[edge] < max(changed[a], changed[b]):
            computed[edge] = graph.done[0]
            heap_update(heap, edge, _altitude(state, sums, edge, a, b, 0.0))
            continue
        if asked[edge] <= computed[edge]:
            asked[edge] = computed[edge] + 1
            stands_out = _standing_out(state, outlines, sums, edge, a, b, relief, normal)
            if stands_out > 0.0:
                heap_update(heap, edge, _altitude(state, sums, edge, a, b, stands_out))
                continue
        if heap.edges[edge].cost > _MAY_WAIT and waits[edge] < _MAX_WAITS:
            later = _awaited(state, graph, a, b, normal, normal_of_other)
            if later >= heap.edges[edge].cost:
                waits[edge] += 1
                heap_update(heap, edge, later + 1.0 / _STEPS)
                continue
        inside = 2.0 * sums[_WEIGHT, edge]
        kept, gone, n_parallel = contract_cheapest(graph)
        unite(state, kept, gone)
        perimeters[kept] += perimeters[gone] - inside
        for axis in range(3):
            outward[kept, axis] += outward[gone, axis]
        changed[kept] = graph.done[0]
        half = clusters[kept].first if clusters[kept].degree <= _MANY else NONE
        while half != NONE:
            edge = half >> 1
            computed[edge] = graph.done[0]
            heap_update(heap, edge, _altitude(state, sums, edge, kept, halves[half ^ 1].end, 0.0))
            half = halves[half].after
        for edge in graph.parallel[:n_parallel]:
            if computed[edge] < graph.done[0]:  # two became one: both old altitudes say little
                computed[edge] = graph.done[0]
                a, b = halves[2 * edge].end, halves[2 * edge + 1].end
                heap_update(heap, edge, _altitude(state, sums, edge, a, b, 0.0))


@routine
def _awaited(
    state: RegionState,
    graph: ContractedGraph,
    a: int,
    b: int,
    normal: NDArray[np.float64],
    normal_of_other: NDArray[np.float64],
) -> float:
    """Altitude of the first merge that the smaller of two regions has with a third that stands on the larger one, too,
    or above it on nothing; -1 if there is none, or if the smaller one does not stand on the larger one.

    The normals are scratch.
    """
    if state.masses[b] < state.masses[a]:
        a, b = b, a
    side = _side_on(state, a, b, normal)
    if state.masses[a] < _WHOLE or side == 0.0:
        return -1.0
    heap, halves, clusters = graph.heap, graph.halves, graph.clusters
    least, half = np.inf, clusters[a].first
    while half != NONE:
        c, cost = halves[half ^ 1].end, heap.edges[half >> 1].cost
        is_whole = c != b and state.masses[c] >= _WHOLE
        if is_whole and cost < least and side * _height(state, c, b, normal) > _CLEAR:
            least = cost if _side_on(state, a, c, normal_of_other) == 0.0 else least
        half = halves[half].after
    return least if least < np.inf else -1.0


@routine
def _side_on(state: RegionState, a: int, b: int, normal: NDArray[np.float64]) -> float:
    """On which side of region b region a stands, 1 or -1, where `normal` receives the normal of b; 0 if b is not flat
    and much larger, or a is not clear of it."""
    if _SHAPE.r1 * state.masses[a] >= state.masses[b] or state.residuals[b] > _FLAT * state.masses[b]:
        return 0.0
    if plane_normal(state.scatters[b], normal) < 0.0:
        return 0.0
    height = _height(state, a, b, normal)
    return np.sign(height) if abs(height) > _CLEAR else 0.0


@routine
def _height(state: RegionState, a: int, b: int, normal: NDArray[np.float64]) -> float:
    """Distance of region a from the plane of region b, whose normal is given, voxel edges."""
    height = 0.0
    for axis in range(3):
        height += normal[axis] * (state.centroids[a, axis] - state.centroids[b, axis])
    return height


@routine
def _altitude(state: RegionState, sums: NDArray[np.float64], edge: int, a: int, b: int, stands_out: float) -> float:
    """Altitude at which the two regions at an edge merge, radians, in whole steps, as energies of nothing are noise."""
    shape = _SHAPE
    cost, length = sums[_COST, edge] / sums[_WEIGHT, edge], 0.5 * sums[_WEIGHT, edge]
    smaller, larger = min(state.masses[a], state.masses[b]), max(state.masses[a], state.masses[b])
    objects, is_terrain = round(shape.objects * _STEPS), len(sums) > _TERRAIN and sums[_TERRAIN, edge] > 0.0
    if len(sums) > _BRIDGE and sums[_BRIDGE, edge] == sums[_WEIGHT, edge]:  # nothing but bridges
        if is_terrain:
            return objects / _STEPS
        return max(round(cost * smaller / (smaller + shape.m1) * _STEPS), objects + 1) / _STEPS
    uneven = state.residuals[a if state.masses[a] == larger else b] / larger - shape.q0
    contrast = squared_distance(state.values, a, b)
    increase = max(energy_increase(state, a, b, contrast), shape.e1 * smaller * uneven, 0.0)
    scale = increase / length
    width = shape.width * math.sqrt(smaller)
    shortness = width / (length + width)
    shortness = math.sqrt(shortness * math.sqrt(shortness))
    evidence = (cost + stands_out + shape.c0 + shape.c1 * math.log(1.0 + scale / shape.l0)) * shortness
    if cost > shape.c2 and shortness < shape.s0:
        evidence += (cost - shape.c2) * (shape.s0 - shortness) * sums[_SMOOTHNESS, edge] / sums[_WEIGHT, edge]
    evidence += shape.k1 * cost * (1.0 - shortness) * contrast / (1.0 + contrast) * smaller / (smaller + shape.m2)
    evidence *= increase / (increase + shape.e0) * math.sqrt(scale / (scale + shape.l0))
    evidence *= math.sqrt(math.sqrt(1.0 + larger / (shape.r * smaller))) * smaller / (smaller + shape.m0)
    altitude = round(evidence * _STEPS)
    return (min(altitude, objects) if is_terrain else altitude) / _STEPS


@routine
def _standing_out(
    state: RegionState,
    outlines: _Outlines,
    sums: NDArray[np.float64],
    edge: int,
    a: int,
    b: int,
    relief: float,
    normal: NDArray[np.float64],
) -> float:
    """How much the smaller region at an edge stands out of the larger one, radians: relief R + H of `RegionLinkage`.

    `normal` is scratch.
    """
    shape = _SHAPE
    if state.masses[b] < state.masses[a]:
        a, b = b, a
    smaller, larger, contact = state.masses[a], state.masses[b], sums[_WEIGHT, edge]
    if shape.r1 * smaller >= larger or plane_normal(state.scatters[b], normal) < 0.0:
        return 0.0
    x, y, z = normal
    inner, outer = state.centroids[a], state.centroids[b]
    distance = x * (inner[0] - outer[0]) + y * (inner[1] - outer[1]) + z * (inner[2] - outer[2])
    outwards = x * outlines.outward[b, 0] + y * outlines.outward[b, 1] + z * outlines.outward[b, 2]
    enclosed, cost, heap = min(contact / outlines.perimeters[a], 1.0), sums[_COST, edge] / contact, 0.0
    if cost > shape.h0 and distance * outwards >= 0.0:
        heap = shape.h1 * (cost - shape.h0) * enclosed**8 * sums[_SMOOTHNESS, edge] / contact
    elif outlines.sides_known and distance * outwards < 0.0:
        return 0.0  # it lies behind
    width = shape.width * math.sqrt(smaller)
    within = enclosed * enclosed * min(0.5 * contact / (shape.b1 * width), 1.0)
    scatter = state.scatters[a]
    spread = x * x * scatter[0] + y * y * scatter[1] + z * z * scatter[2]
    spread += 2.0 * (x * y * scatter[3] + x * z * scatter[4] + y * z * scatter[5])
    square, off = distance * distance, 0.0
    noise = shape.v0 + 4.0 * spread / smaller + state.residuals[b] / larger
    if square >= 0.1 * noise:  # else it would be less than 1e-8
        off = 1.0 / ((1.0 + (noise / square) ** 8) * (1.0 + square / (shape.d1 * shape.d1)))
    in_relief = within * within * (1.0 - shape.r1 * smaller / larger) * off
    return (relief * in_relief + heap) * smaller / (smaller + shape.m2)
