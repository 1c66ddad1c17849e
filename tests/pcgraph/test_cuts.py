# SPDX-License-Identifier: Apache-2.0
"""Cuts, persistence and saliency: five leaves by hand, optima by brute force, Higra."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest
from checks import refines
from scenes.graphs import hand_graph, hand_tree, leaf_sets, random_graph, tree_of
from scenes.tables import two_boxes_on_a_plane

from pcgraph import segment
from pcgraph.features.moments import Moments
from pcgraph.hierarchy import binary_children
from pcgraph.tree.average_linkage import ConvexityLinkage
from pcgraph.tree.energies import boundary_lengths, plane_energy, variance_energy
from pcgraph.tree.felzenszwalb import FelzenszwalbLinkage
from pcgraph.tree.lccp import LccpLinkage
from pcgraph.tree.least_increase import MumfordShahLinkage, WardLinkage
from pcgraph.tree.optimal_cut import Energy
from pcgraph.tree.region_linkage import RegionLinkage
from pcgraph.tree.saliency import point_saliency, voxel_saliency
from pcgraph.tree.single_linkage import QuasiFlatLinkage
from pcgraph.tree.tree import SegmentationTree

#            8 (9)               Leaves 0..4; nodes 5..8 at these altitudes. Points of the leaves: 40, 30, 2, 20, 8.
#           /     \
#        7 (4)     \
#       /     \     \
#   5 (1)    2     6 (2)
#   0   1          3   4
PAIRS = [[0, 1], [3, 4], [2, 5], [6, 7]]
ALTITUDES = [1.0, 2.0, 4.0, 9.0]
COUNTS = [40, 30, 2, 20, 8]


@pytest.fixture
def tree():
    return hand_tree(PAIRS, ALTITUDES, COUNTS)


def test_persistence_of_five_leaves(tree):
    assert tree.persistence.tolist() == [1, 1, 4, 2, 2, 3, 7, 5, np.inf]


def test_persistence_ends_nowhere_for_parts_that_touch_nothing():
    apart = hand_tree([[0, 1]], [1.0])
    assert apart.persistence.tolist() == [1.0, 1.0, np.inf]
    three = tree_of(ConvexityLinkage(), *random_graph("no edges", 3, np.random.default_rng(0))[:2])
    assert three.persistence.tolist() == [np.inf, np.inf, np.inf, 0.0, 0.0]


def test_no_segment_has_fewer_points_than_min_size(tree):
    assert tree.cut(altitude=0.0, min_size=1).tolist() == [0, 1, 2, 3, 4]
    # Leaf 2 (two points) goes to its sibling 5, and there to the larger child, leaf 0; leaf 4 to its sibling 3.
    assert tree.cut(altitude=0.0, min_size=10).tolist() == [0, 1, 0, 2, 2]
    assert tree.cut(altitude=1.0, min_size=10).tolist() == [0, 0, 0, 1, 1]
    assert tree.cut(altitude=9.0, min_size=10).tolist() == [0, 0, 0, 0, 0]
    assert tree.cut(n=3, min_size=10).tolist() == [0, 1, 0, 2, 2]
    assert tree.cut(n=2, min_size=10).tolist() == [0, 0, 0, 1, 1]
    assert tree.cut(altitude=0.0, min_size=31).tolist() == [0, 0, 0, 0, 0]  # leaf 0 is the only one with as many
    assert tree.cut(altitude=0.0, min_size=1000).tolist() == [0, 0, 0, 0, 0]
    assert tree.cut_nodes(altitude=0.0, min_size=10).tolist() == [0, 1, 0, 3, 3]
    with pytest.raises(ValueError, match=r"1\.\.3 segments"):
        tree.cut(n=4, min_size=10)
    for wrong in (0, 2.0, True):
        with pytest.raises(ValueError, match="min_size"):
            tree.cut(n=1, min_size=wrong)


def random_tree(n, rng, integers=True):
    pairs, roots = [], list(range(n))
    for step in range(n - 1):
        a, b = rng.choice(len(roots), 2, replace=False).tolist()
        pairs.append(sorted((roots[a], roots[b])))
        roots = [root for root in roots if root not in pairs[-1]] + [n + step]
    altitudes = np.sort(rng.integers(0, 9, n - 1).astype(float) if integers else rng.random(n - 1))
    return hand_tree(np.reshape(pairs, (-1, 2)).tolist(), altitudes.tolist(), rng.integers(1, 50, n))


def all_cuts(tree):
    pairs = binary_children(tree.parents).tolist()

    def below(node):
        a, b = pairs[node]
        return [[node]] + ([left + right for left in below(a) for right in below(b)] if a >= 0 else [])

    return below(len(pairs) - 1)


def test_the_optimal_cut_of_five_leaves(tree):
    # Data 0 for leaves; 5: 3, 6: 10, 7: 4, 8: 30; segments count 1. 5 pays from scale 3 on; 7 replaces three
    # leaves at 4 = 2 s, so from s = 2 on: 5 never appears. 6 from s = 10; the root at 30 - 4 - 10 = 16.
    data = np.array([0, 0, 0, 0, 0, 3, 10, 4, 30], float)
    energy = Energy(data, np.ones(9))
    scales = tree.by_energy(energy)
    assert scales.altitudes.tolist() == [0, 0, 0, 0, 0, 2, 2, 10, 16]
    assert scales.parents.tolist() == [5, 5, 6, 7, 7, 6, 8, 8, 8]
    assert scales.moments.counts.tolist() == [40, 30, 2, 20, 8, 70, 72, 28, 100]
    assert tree.cut_optimal(energy, 1.9).tolist() == [0, 1, 2, 3, 4]
    assert tree.cut_optimal(energy, 2.0).tolist() == [0, 0, 0, 1, 2]
    assert tree.cut_optimal(energy, 15.0).tolist() == [0, 0, 0, 1, 1]
    assert tree.cut_optimal(energy, 16.0).tolist() == [0, 0, 0, 0, 0]


def test_no_cut_has_less_energy_than_the_optimal_one():
    rng = np.random.default_rng(2)
    for _ in range(60):
        tree = random_tree(int(rng.integers(1, 8)), rng)
        energy = random_energy(tree, rng)
        nodes_of = {leaves: node for node, leaves in enumerate(leaf_sets(tree))}
        for scale in (0.0, 0.5, 1.0, 2.0, 3.3, 7.0, 30.0):
            cut = tree.cut_optimal(energy, scale)
            nodes = [nodes_of[frozenset(np.flatnonzero(cut == s).tolist())] for s in range(cut.max() + 1)]
            costs = energy.data + scale * energy.complexity
            assert costs[nodes].sum() == pytest.approx(min(costs[c].sum() for c in all_cuts(tree)), abs=1e-9)


def random_energy(tree, rng):
    """Any data, and complexities of which a parent has at most as much as its children."""
    k = len(tree.parents)
    complexity = rng.integers(1, 6, k).astype(float)
    for node, (a, b) in enumerate(binary_children(tree.parents).tolist()):
        if a >= 0:
            complexity[node] = min(complexity[node], complexity[a] + complexity[b])
    return Energy(rng.integers(0, 40, k).astype(float), complexity)


def test_optimal_cuts_agree_with_higra():
    hg = pytest.importorskip("higra")
    rng = np.random.default_rng(3)
    for n in (2, 20, 80):
        tree = random_tree(n, rng, integers=False)
        energy = random_energy(tree, rng)
        theirs = hg.Tree(tree.parents.astype(np.int64))
        for scale in (0.21, 1.37, 4.03, 11.7, 90.1):
            labels = hg.labelisation_optimal_cut_from_energy(theirs, energy.data + scale * energy.complexity)
            ours = tree.cut_optimal(energy, scale)
            leaf_labels = np.unique(labels, return_inverse=True)[1]
            assert refines(ours, leaf_labels)
            assert refines(leaf_labels, ours)


def test_energies_by_direct_computation():
    rng = np.random.default_rng(4)
    graph, leaves, points, leaf = random_graph("random", 9, rng)
    tree = tree_of(ConvexityLinkage(), graph, leaves)
    values = rng.normal(size=(9, 3))
    planes, colors = plane_energy(tree, graph), variance_energy(tree, values)
    for node, below in enumerate(leaf_sets(tree)):
        mine = np.isin(leaf, list(below))
        centred = points[mine] - points[mine].mean(axis=0)
        assert planes.data[node] == pytest.approx(np.linalg.svd(centred)[1][-1] ** 2, rel=1e-6)
        spread = values[leaf[mine]] - values[leaf[mine]].mean(axis=0)
        assert colors.data[node] == pytest.approx((spread**2).sum(), rel=1e-9, abs=1e-12)
        crossing = np.isin(graph.edges[:, 0], list(below)) != np.isin(graph.edges[:, 1], list(below))
        outline = graph.edge_features.contact_length[crossing].sum()
        assert planes.complexity[node] == pytest.approx(outline)
    assert colors.complexity.tolist() == [1.0] * 17
    assert boundary_lengths(tree, graph)[-1] == 0.0


def test_wrong_energies_are_refused(tree):
    with pytest.raises(ValueError, match="one length"):
        Energy(np.zeros(9), np.ones(8))
    with pytest.raises(ValueError, match="NaN"):
        Energy(np.full(9, np.nan), np.ones(9))
    with pytest.raises(ValueError, match="9 rows"):
        tree.cut_optimal(Energy(np.zeros(5), np.ones(5)), 1.0)
    for scale in (float("nan"), -1.0, np.inf):
        with pytest.raises(ValueError, match="scale"):
            tree.cut_optimal(Energy(np.zeros(9), np.ones(9)), scale)
    with pytest.raises(ValueError, match="values"):
        variance_energy(tree, np.zeros((4, 3)))
    with pytest.raises(ValueError, match="not above the parent"):
        tree.with_altitudes([0, 0, 0, 0, 0, 5, 1, 4, 9])


def test_levels_from_leaf_to_scene(tree):
    nested = tree.levels([0.0, 1.0, 4.0, np.inf])
    assert nested.tolist() == [[0, 0, 0, 0], [1, 0, 0, 0], [2, 1, 0, 0], [3, 2, 1, 0], [4, 3, 1, 0]]
    assert tree.levels([]).shape == (5, 0)


def test_edge_saliency_of_five_leaves(tree):
    pairs = np.array([[0, 1], [1, 0], [0, 2], [1, 2], [3, 4], [0, 3], [2, 4], [1, 1]], np.int32)
    assert tree.edge_saliency(pairs).tolist() == [1, 1, 4, 4, 2, 9, 9, 0]
    for wrong in ([[0, 9]], [[-1, 0]], [0, 1]):
        with pytest.raises(ValueError, match="nodes"):
            tree.edge_saliency(np.array(wrong, np.int32))


def test_saliency_agrees_with_higra():
    hg = pytest.importorskip("higra")
    graph, leaves, _, _ = random_graph("random", 50, np.random.default_rng(6))
    tree = tree_of(ConvexityLinkage(), graph, leaves)
    theirs = hg.UndirectedGraph(50)
    theirs.add_edges(graph.edges[:, 0], graph.edges[:, 1])
    hierarchy = hg.Tree(tree.parents.astype(np.int64))
    hg.CptHierarchy.link(hierarchy, theirs)
    assert tree.edge_saliency(graph.edges).tolist() == hg.saliency(hierarchy, tree.altitudes).tolist()


def test_saliency_above_a_level_is_the_boundary_of_that_cut(boxes):
    points, _, result = boxes
    tree, surface = result.tree, result.surface
    strength = voxel_saliency(tree, surface)
    grid = surface.grid
    source = np.repeat(np.arange(grid.n_voxels), np.diff(grid.indptr))
    for level in (0.0, 0.1, 0.4):
        segment = tree.cut(altitude=level)[surface.supervoxels]
        boundary = np.zeros(grid.n_voxels, bool)
        boundary[source[segment[source] != segment[grid.neighbours]]] = True
        assert np.array_equal(strength > level, boundary)
        assert boundary.any()
    assert np.array_equal(point_saliency(tree, surface), strength[grid.voxel_of_point])
    assert len(point_saliency(tree, surface)) == len(points)


@pytest.mark.parametrize(
    "linkage",
    [FelzenszwalbLinkage(), LccpLinkage(), MumfordShahLinkage(), QuasiFlatLinkage(), RegionLinkage(), WardLinkage()],
    ids=lambda linkage: type(linkage).__name__,
)
def test_faces_of_boxes_are_the_parts_of_other_linkages_too(boxes, linkage):
    result = boxes[2]
    convexity = ConvexityLinkage()
    tree = tree_of(convexity, result.graph, result.leaves)
    expected = tree.cut(altitude=convexity.default_part_altitude)
    parts = tree_of(linkage, result.graph, result.leaves).cut(altitude=linkage.default_part_altitude)
    assert np.array_equal(parts, expected)


def test_faces_of_boxes_are_parts_and_boxes_are_objects(boxes):
    _, truth, result = boxes
    linkage = result.linkage
    parts, objects = result.tree.levels([linkage.default_part_altitude, linkage.default_object_altitude]).T
    assert parts.max() + 1 == 7  # the plane, and three faces of either box
    assert objects.max() + 1 == 3
    assert refines(parts, objects)
    assert len(np.unique(truth)) == objects.max() + 1


def test_parts_lie_within_objects_and_objects_within_groups():
    """Two planes far apart, with two boxes on each, of which three faces are seen: 14 parts, 6 objects, 2 groups."""
    points, _, viewpoint = two_boxes_on_a_plane()
    aside = np.array([0.0, 30.0, 0.0])
    twice = np.concatenate((points, points + aside))
    result = segment(twice, viewpoint=np.repeat([viewpoint, viewpoint + aside], len(points), axis=0))
    levels = result.supervoxels, result.parts, result.labels, result.groups
    assert [len(np.unique(level[level >= 0])) for level in levels[1:]] == [14, 6, 2]
    assert all(refines(finer, coarser) for finer, coarser in itertools.pairwise(levels))
    fine = segment(points, viewpoint=viewpoint, object_altitude=0.01)
    assert np.array_equal(fine.parts, fine.labels)


@pytest.mark.parametrize("shape", ["chain", "balanced"])
def test_a_hundred_thousand_leaves_take_a_second(shape):
    n = 100_000
    k = 2 * n - 1
    parents = np.arange(1, k + 1, dtype=np.int32)
    if shape == "chain":  # each leaf joins all before it
        parents[:n] = n + np.maximum(np.arange(n) - 1, 0)
    else:  # in rounds of neighbours
        parents[:] = n + np.arange(k) // 2
    parents[-1] = k - 1
    counts = np.concatenate((np.ones(n, np.int64), np.arange(2, n + 1)))
    rng = np.random.default_rng(8)
    altitudes = np.concatenate((np.zeros(n), np.sort(rng.random(n - 1))))
    moments = Moments(counts, np.zeros((k, 3)), np.zeros((k, 3, 3)), None)
    tree = SegmentationTree(parents, altitudes, moments)
    energy = Energy(rng.random(k) * counts, np.ones(k))
    pairs = rng.integers(0, n, (3 * n, 2)).astype(np.int32)
    calls = (
        lambda: tree.cut(n=100),
        lambda: tree.cut(altitude=0.5, min_size=20),
        lambda: tree.cut_optimal(energy, 1.0),
        lambda: tree.edge_saliency(pairs),
    )
    for call in calls:
        call()  # compiled
    start = time.process_time()
    for call in calls:
        call()
    assert time.process_time() - start < 2.0


def test_one_leaf_is_a_tree():
    tree = hand_tree([], [])
    graph = hand_graph([], n=1)
    energy = plane_energy(tree, graph)
    for cut in (tree.cut(n=1), tree.cut(altitude=0.0, min_size=7), tree.cut_optimal(energy, 1.0)):
        assert cut.tolist() == [0]
    assert tree.persistence.tolist() == [np.inf]
    assert tree.edge_saliency(graph.edges).tolist() == []


@pytest.mark.parametrize(("min_size", "most"), [(1, 5), (10, 3), (31, 1), (1000, 1)])
def test_too_many_segments_are_told_of_which_size(tree, min_size, most):
    """With a least size the limit was said without it, so that nobody knew where it came from."""
    of_size = "" if min_size == 1 else f" of {min_size} points or more"
    with pytest.raises(ValueError, match=f"n of 1..{most} segments{of_size}, got 6$"):
        tree.cut(n=6, min_size=min_size)
