# SPDX-License-Identifier: Apache-2.0
"""Linkages: five nodes by hand, the definitions by brute force, libraries that nobody here wrote."""

from __future__ import annotations

from dataclasses import replace

import networkx
import numpy as np
import pytest
import scipy.cluster.hierarchy as scipy_hierarchy
from scenes.graphs import CHAIN, edges_of, hand_graph, leaf_sets, random_graph, tree_of, unit_leaves
from scipy.spatial.distance import squareform

from pcgraph.features.moments import moments_of_groups
from pcgraph.tree.average_linkage import average_linkage
from pcgraph.tree.felzenszwalb import FelzenszwalbLinkage, normal_contrast, scale_linkage
from pcgraph.tree.lccp import LccpLinkage
from pcgraph.tree.least_increase import MumfordShahLinkage, Regions, WardLinkage, least_increase_linkage
from pcgraph.tree.single_linkage import QuasiFlatLinkage, minimum_spanning_forest, single_linkage


def value_regions(values, masses=None):
    """Regions known by their values alone."""
    n = len(values)
    rows = np.asarray(values, float).reshape(n, -1)
    weights = np.ones(n) if masses is None else np.asarray(masses, float)
    return Regions(weights, rows, np.zeros((n, 3)), np.zeros((n, 3, 3)), 0.0)


def partition_at(n, merges, level):
    """Sets of leaves after all merges up to a level."""
    sets = {i: frozenset([i]) for i in range(n)}
    for step, (pair, altitude) in enumerate(zip(merges.pairs.tolist(), merges.altitudes, strict=True)):
        if altitude <= level:
            sets[n + step] = sets.pop(pair[0]) | sets.pop(pair[1])
    return set(sets.values())


def test_quasi_flat_zones_of_five_nodes():
    # Concavities 0.3, 0.1, 0.5, 0.2 along a chain: the cheapest edge first, whatever else touches.
    graph = hand_graph(CHAIN, convexity=[-0.3, -0.1, -0.5, -0.2], contact_convexity=[-0.3, -0.1, -0.5, -0.2])
    merges = QuasiFlatLinkage().merges(graph, unit_leaves(5))
    assert merges.pairs.tolist() == [[1, 2], [3, 4], [0, 5], [6, 7]]
    assert merges.altitudes == pytest.approx([0.1, 0.2, 0.3, 0.5], abs=1e-6)


def test_single_linkage_lets_one_cheap_edge_join_what_a_mean_keeps_apart():
    edges = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], np.int32)
    costs = np.array([0.1, 0.3, 2.0, 2.0, 2.0, 0.1])  # pairs {0, 1} and {2, 3}; one of four contacts is cheap
    single, forest = minimum_spanning_forest(4, edges, costs)
    average = average_linkage(4, edges, costs, np.ones(6))
    assert single.altitudes.tolist() == [0.1, 0.1, 0.3]
    assert forest.tolist() == [0, 5, 1]
    assert average.altitudes.tolist() == [0.1, 0.1, (0.3 + 3 * 2.0) / 4]


def test_felzenszwalb_scales_of_five_nodes():
    # Weights 1, 4, 2, 8 along a chain. {0} and {1}: k = (1 - 0) 1 = 1; {2} and {3}: 2. The edge of weight 4, at
    # k >= 2: {0, 1} has Int 1, so (4 - 1) 2 = 6; {2, 3} has (4 - 2) 2 = 4; k = 6. The edge of weight 8: below k = 6
    # it would need (8 - 2) 2 = 12, from 6 on {0, 1, 2, 3} has Int 4 and needs (8 - 4) 4 = 16.
    merges = scale_linkage(5, np.array(CHAIN, np.int32), np.array([1.0, 4.0, 2.0, 8.0]))
    assert merges.pairs.tolist() == [[0, 1], [2, 3], [5, 6], [4, 7]]
    assert merges.altitudes.tolist() == [1.0, 2.0, 6.0, 16.0]


def test_scannet_weight_is_squared_where_convex():
    graph = hand_graph([[0, 1], [1, 2]], convexity=[-0.5, 0.5], normal_angle=[0.5, 0.5])
    concave, convex = normal_contrast(graph.edge_features)
    assert concave == pytest.approx(1.0 - np.cos(0.5))
    assert convex == pytest.approx((1.0 - np.cos(0.5)) ** 2)


def brute_force_scales(n, edges, weights):
    """Scales of the forest's edges by the definition: components and their trees anew at every level."""
    order = np.argsort(weights, kind="stable")
    forest, scales, graph = [], [], networkx.Graph()
    graph.add_nodes_from(range(n))
    for e in order.tolist():
        i, j = edges[e].tolist()
        if networkx.has_path(graph, i, j):
            continue
        levels = sorted({0.0, *scales})
        for level, end in zip(levels, [*levels[1:], np.inf], strict=True):
            cut = networkx.Graph((a, b, {"w": w}) for a, b, w, k in forest if k <= level)
            cut.add_nodes_from(range(n))
            need = []
            for side in (i, j):
                region = networkx.node_connected_component(cut, side)
                inner = max((d["w"] for _, _, d in cut.subgraph(region).edges(data=True)), default=0.0)
                need.append((weights[e] - inner) * len(region))
            if max(*need, level) < end:
                break
        scales.append(max(*need, level))
        forest.append((i, j, weights[e], scales[-1]))
        graph.add_edge(i, j)
    return sorted(scales)


@pytest.mark.parametrize("shape", ["random", "chain", "star", "complete", "parts"])
def test_felzenszwalb_scales_agree_with_their_definition(shape):
    rng = np.random.default_rng(7)
    for n in (2, 5, 12, 25):
        edges = edges_of(shape, n, rng)
        weights = rng.integers(1, 60, len(edges)) / 4.0  # exact in floating point, so that levels compare exactly
        assert scale_linkage(n, edges, weights).altitudes.tolist() == brute_force_scales(n, edges, weights)


def test_wards_linkage_of_five_nodes():
    # Values 0, 1, 4, 6, 6.5 along a chain: {3, 4} costs 1/2 0.25 = 0.125; {0, 1} costs 1/2; then 2 to {0, 1} costs
    # 2/3 3.5^2 = 8.17 and to {3, 4} 2/3 2.25^2 = 3.375; last {0, 1} and {2, 3, 4}: 6/5 (5.5 - 0.5)^2 = 30.
    merges = least_increase_linkage(value_regions([0.0, 1.0, 4.0, 6.0, 6.5]), np.array(CHAIN, np.int32), None)
    assert merges.pairs.tolist() == [[3, 4], [0, 1], [2, 5], [6, 7]]
    assert merges.altitudes == pytest.approx([0.125, 0.5, 3.375, 30.0])


def test_mumford_shah_counts_the_boundary_that_a_merge_removes():
    # The same values; contacts 1, 1, 10 and 1/8 long: 2-3 costs 1/2 4 / 10 = 0.2 and comes first, 0-1 0.5, 3-4 would
    # cost 1 and, once 3 is {2, 3} of mean 5, 2/3 1.5^2 / (1/8) = 12; {0, 1} to {2, 3}: 4/4 4.5^2 / 1 = 20.25.
    regions = value_regions([0.0, 1.0, 4.0, 6.0, 6.5])
    lengths = np.array([1.0, 1.0, 10.0, 0.125])
    merges = least_increase_linkage(regions, np.array(CHAIN, np.int32), lengths)
    assert merges.pairs.tolist() == [[2, 3], [0, 1], [4, 5], [6, 7]]
    assert merges.altitudes == pytest.approx([0.2, 0.5, 12.0, 6 / 5 * (5.5 - 0.5) ** 2])


def test_contacts_with_the_same_third_region_add_up():
    # A triangle of values 0, 1, 4 and contacts of 1: {0, 1} costs 1/2, then 2/3 3.5^2 over a contact of 2.
    triangle = np.array([[0, 1], [0, 2], [1, 2]], np.int32)
    merges = least_increase_linkage(value_regions([0.0, 1.0, 4.0]), triangle, np.ones(3))
    assert merges.altitudes == pytest.approx([0.5, 2 / 3 * 3.5**2 / 2])
    without = least_increase_linkage(value_regions([0.0, 1.0, 4.0]), triangle, None)
    assert without.altitudes == pytest.approx([0.5, 2 / 3 * 3.5**2])


def test_mumford_shah_grows_planes_before_it_bends_them():
    # A floor (nodes 0, 1) and a wall (2, 3) of unit squares, and a lid (4) parallel to the floor but higher up.
    square = np.stack(np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5)), axis=-1).reshape(-1, 2)
    flat = np.column_stack((square, np.zeros(25)))
    wall = np.column_stack((np.zeros(25), square[:, 1], square[:, 0]))
    shifts = np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1], [-1, 0, 2]])
    pieces = [piece + shift for piece, shift in zip((flat, flat, wall, wall, flat), shifts, strict=True)]
    leaves = moments_of_groups(np.vstack(pieces), None, np.repeat(np.arange(5), 25).astype(np.int32), 5)
    merges = MumfordShahLinkage(plane=1.0).merges(hand_graph(CHAIN), leaves)
    assert {tuple(pair) for pair in merges.pairs[:2].tolist()} == {(0, 1), (2, 3)}
    assert merges.altitudes[:2] == pytest.approx([0.0, 0.0], abs=1e-12)
    tree = tree_of(MumfordShahLinkage(plane=1.0), hand_graph(CHAIN), leaves)
    residual = np.linalg.eigvalsh(tree.moments.scatters)[:, 0]
    ends = merges.pairs[2]
    rise = (residual[7] - residual[ends].sum()) / leaves.counts.mean()  # contact of one voxel, voxels of 1 m
    assert merges.altitudes[2] == pytest.approx(rise)


def lccp_graph():
    """A floor (0, 1), a box's front (2) and top (3) on it, seen from the front above, and a far floor piece (4)."""
    up, front = [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]
    centroids = [[0, -2, 0], [0, -1, 0], [0, 0, 0.5], [0, 0.5, 1], [1, -1, 0]]
    return hand_graph(
        [[0, 1], [1, 2], [1, 4], [2, 3]],
        centroids,
        [up, up, front, up, up],
        normal_angle=[0.0, np.pi / 2, 0.0, np.pi / 2],
    )


def test_lccp_of_five_nodes():
    graph = lccp_graph()
    assert LccpLinkage().convex(graph).tolist() == [True, False, True, True]
    tree = tree_of(LccpLinkage(), graph, unit_leaves(5))
    assert tree.cut(altitude=1.0).tolist() == [0, 0, 1, 1, 0]
    assert tree.cut(altitude=0.1).tolist() == [0, 0, 1, 2, 0]  # the box's faces are 90 degrees = 0.5 apart
    assert tree.altitudes[5:].tolist() == [0.0, 0.0, 0.5, 1.5]


def test_lccps_checks():
    graph = lccp_graph()
    nodes = graph.node_features
    nodes.centroid[1] += [0, 0, -0.5]  # the near floor sinks: two parallel planes half a metre apart
    assert LccpLinkage(smoothness=False).convex(graph).tolist() == [True, False, True, True]
    assert LccpLinkage(seed_size=1.0).convex(graph).tolist() == [False, False, False, True]
    # An edge needs k common neighbours convex to both ends: in a chain there are none, in a triangle one.
    assert not LccpLinkage(common_neighbours=1).convex(lccp_graph()).any()
    flat = hand_graph([[0, 1], [0, 2], [1, 2], [2, 3], [3, 4]], np.eye(5)[:, :3], np.tile([0.0, 0, 1], (5, 1)))
    assert LccpLinkage(common_neighbours=1, smoothness=False).convex(flat).tolist() == [True] * 3 + [False] * 2
    # Two walls that meet in a crease along the line between them: convex by the angles, but not sane.
    beside = hand_graph([[0, 1]], [[0, 0, 0], [0, 0, 1]], [[1, 0, 0], [0, 1, 0]], n=2)
    assert LccpLinkage(smoothness=False).convex(beside).tolist() == [True]
    assert LccpLinkage(smoothness=False, sanity=True).convex(beside).tolist() == [False]


@pytest.mark.parametrize("shape", ["random", "parts", "star", "no edges"])
def test_lccps_partition_is_a_cut(shape):
    for seed in range(5):
        graph, leaves, _, _ = random_graph(shape, 20, np.random.default_rng(seed))
        linkage = LccpLinkage(sanity=seed % 2 == 0)
        convex = networkx.Graph(graph.edges[linkage.convex(graph)].tolist())
        convex.add_nodes_from(range(20))
        tree = tree_of(linkage, graph, leaves)
        cut = tree.cut(altitude=1.0)
        found = {frozenset(np.flatnonzero(cut == s).tolist()) for s in np.unique(cut)}
        assert found == {frozenset(part) for part in networkx.connected_components(convex)}


def merges_of(name, graph, values, costs, weights):
    n = len(values)
    if name == "single":
        return single_linkage(n, graph, costs)
    if name == "average":
        return average_linkage(n, graph, costs, weights)
    return least_increase_linkage(value_regions(values), graph, None)


@pytest.mark.parametrize("name", ["single", "average", "ward"])
def test_agreement_with_scipy_on_complete_graphs(name):
    rng = np.random.default_rng(11)
    for n in (2, 9, 40):
        values, edges = rng.normal(size=(n, 3)), edges_of("complete", n, rng)
        distances = np.linalg.norm(values[edges[:, 0]] - values[edges[:, 1]], axis=1)
        merges = merges_of(name, edges, values, distances, np.ones(len(edges)))
        theirs = scipy_hierarchy.linkage(squareform(squareform(distances)), name)
        assert merges.pairs.tolist() == np.sort(theirs[:, :2], axis=1).astype(int).tolist()
        heights = (
            np.sqrt(2.0 * merges.altitudes) if name == "ward" else merges.altitudes
        )  # their height of a pair: its distance
        assert heights == pytest.approx(theirs[:, 2], rel=1e-9)


@pytest.mark.parametrize("name", ["single", "average", "ward"])
@pytest.mark.parametrize("shape", ["random", "chain", "star"])
def test_agreement_with_higra(name, shape):
    hg = pytest.importorskip("higra")
    rng = np.random.default_rng(5)
    n = 60
    edges, values = edges_of(shape, n, rng), rng.normal(size=(n, 2))
    costs, weights = rng.random(len(edges)), rng.integers(1, 9, len(edges)).astype(float)
    merges = merges_of(name, edges, values, costs, weights)
    graph = hg.UndirectedGraph(n)
    graph.add_edges(edges[:, 0], edges[:, 1])
    if name == "single":
        theirs, levels = hg.bpt_canonical(graph, costs)
    elif name == "average":
        theirs, levels = hg.binary_partition_tree_average_linkage(graph, costs, weights)
    else:
        theirs, levels = hg.binary_partition_tree_ward_linkage(graph, values)
    for level in np.quantile(merges.altitudes, [0.1, 0.5, 0.9]) * (1.0 + 1e-9):
        labels = hg.labelisation_horizontal_cut_from_threshold(theirs, levels, level)
        expected = {frozenset(np.flatnonzero(labels == label).tolist()) for label in np.unique(labels)}
        assert partition_at(n, merges, level) == expected
    assert np.sort(merges.altitudes) == pytest.approx(np.sort(levels[n:]), rel=1e-9)


def test_wards_altitudes_do_not_fall_where_the_graph_would_let_them():
    # 0 - 1 - 2 at 0, 5, 0: the first merge costs 12.5, then {0, 1} at 2.5 and 2 at 0 only 2/3 6.25 = 4.2.
    merges = least_increase_linkage(value_regions([0, 5, 0]), np.array([[0, 1], [1, 2]], np.int32), None)
    assert merges.altitudes.tolist() == [12.5, 12.5]
    assert merges.pairs.tolist() == [[0, 1], [2, 3]]


def test_ward_and_mumford_shah_know_no_units_nor_density():
    for linkage in (WardLinkage(position=0.1, color=1.0), MumfordShahLinkage(normal=0.5, color=0.5)):
        graph, leaves, points, leaf = random_graph("random", 12, np.random.default_rng(2))
        twice = np.concatenate((leaf, leaf))
        scale = 1000.0
        colors = leaves.colors[leaf]
        plain = moments_of_groups(points, colors, leaf, 12)
        dense = moments_of_groups(scale * np.vstack((points, points)), np.vstack((colors, colors)), twice, 12)
        features = replace(graph.edge_features, contact_length=graph.edge_features.contact_length * scale)
        larger = replace(graph, edge_features=features)
        a, b = linkage.merges(graph, plain), linkage.merges(larger, dense)
        assert a.pairs.tolist() == b.pairs.tolist()
        assert a.altitudes == pytest.approx(b.altitudes, rel=1e-6)


def test_felzenszwalbs_tree_reads_its_weights_from_the_normals():
    graph = hand_graph(CHAIN, convexity=-np.ones(4), normal_angle=[0.1, 0.4, 0.2, 0.8])
    tree = tree_of(FelzenszwalbLinkage(), graph, unit_leaves(5))
    weights = 1.0 - np.cos([0.1, 0.4, 0.2, 0.8])
    assert tree.altitudes[5:] == pytest.approx(scale_linkage(5, graph.edges, weights).altitudes)
    assert leaf_sets(tree)[7] == {0, 1, 2, 3}
