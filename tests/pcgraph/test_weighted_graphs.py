# SPDX-License-Identifier: Apache-2.0
"""Trees of weighted graphs without points: SciPy's and Higra's merges, cuts by size, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from checks import same_partition
from scenes.graphs import edges_of
from scipy.cluster import hierarchy
from scipy.spatial.distance import pdist

import pcgraph
from pcgraph import Energy, plane_energy, tree_of_graph, variance_energy


@pytest.mark.parametrize("linkage", ["single", "average"])
def test_on_all_pairs_merges_are_those_of_scipy(linkage):
    points = np.random.default_rng(0).random((30, 3))
    edges, weights = edges_of("complete", 30, np.random.default_rng(0)), pdist(points)
    ours = tree_of_graph(edges, weights, linkage=linkage).to_linkage_matrix()
    theirs = hierarchy.linkage(points, linkage)
    assert ours[:, [0, 1, 3]].tolist() == np.column_stack((np.sort(theirs[:, :2]), theirs[:, 3])).tolist()
    assert ours[:, 2] == pytest.approx(theirs[:, 2], rel=1e-12)


@pytest.mark.parametrize("linkage", ["single", "average"])
def test_merges_are_those_of_higra(linkage):
    hg = pytest.importorskip("higra")
    rng = np.random.default_rng(1)
    edges = edges_of("random", 60, rng)
    weights = rng.random(len(edges))
    graph = hg.UndirectedGraph(60)
    graph.add_edges(*edges.T.astype(np.int64))
    theirs = {
        "single": hg.binary_partition_tree_single_linkage,
        "average": hg.binary_partition_tree_average_linkage,
    }[linkage](graph, weights)
    ours = tree_of_graph(edges, weights, linkage=linkage)
    assert ours.altitudes == pytest.approx(theirs[1], rel=1e-12)
    for level in np.quantile(weights, [0.1, 0.3, 0.5]):
        labels = hg.labelisation_horizontal_cut_from_threshold(*theirs, level)
        assert same_partition(ours.cut(altitude=level), labels)


def test_felzenszwalb_compares_a_weight_with_those_inside():
    """A weight of 2 joins two nodes at k = 2; one of 3 joins that pair, whose inner weight is 2, to a third at
    max((3 - 2) x 2, (3 - 0) x 1) = 3."""
    tree = tree_of_graph([[0, 1], [1, 2]], [2, 3], linkage="felzenszwalb")
    assert tree.altitudes.tolist() == [0, 0, 0, 2, 3]


def test_neither_the_order_of_edges_nor_their_direction_matters():
    rng = np.random.default_rng(2)
    edges = edges_of("random", 40, rng)
    weights = rng.random(len(edges))
    order = rng.permutation(len(edges))
    for linkage in ("single", "average", "felzenszwalb"):
        first = tree_of_graph(edges, weights, linkage=linkage)
        second = tree_of_graph(edges[order, ::-1], weights[order], linkage=linkage)
        assert first.altitudes == pytest.approx(second.altitudes, rel=1e-12)
        assert np.array_equal(first.cut(n=7), second.cut(n=7))


def test_parts_that_no_edge_connects_join_the_largest_at_infinity_the_smallest_first():
    tree = tree_of_graph([[0, 1], [3, 4], [4, 5]], [0.3, 0.1, 0.2], 7, sizes=[1, 1, 5, 1, 1, 10, 1])
    assert np.isinf(tree.altitudes).sum() == 3
    assert tree.cut(altitude=1e9).tolist() == [0, 0, 1, 2, 2, 2, 3]
    assert [tree.cut(n=n).tolist() for n in (3, 2)] == [[0, 0, 1, 2, 2, 2, 2], [0, 0, 1, 0, 0, 0, 0]]
    assert tree.sizes[tree.root] == 20
    assert tree_of_graph([], [], 1).n_nodes == 1


def test_cuts_have_the_least_size_asked_for():
    tree = tree_of_graph([[0, 1], [1, 2], [2, 3]], [0.1, 0.9, 0.2], sizes=[5, 1, 1, 1])
    assert tree.cut(altitude=0.0, min_size=3).tolist() == [0, 0, 0, 0]
    assert tree.cut(altitude=0.0, min_size=2).tolist() == [0, 0, 1, 1]
    best = Energy(np.array([0, 0, 0, 0, 1.0, 1.0, 9.0]), np.ones(7))
    assert tree.by_energy(best).cut(altitude=2.0, min_size=2).tolist() == [0, 0, 1, 1]
    assert variance_energy(tree, [[0.0], [6.0], [0.0], [0.0]]).data[4] == pytest.approx(30.0)


def test_what_needs_points_says_so():
    tree = tree_of_graph([[0, 1]], [0.1])
    assert tree.moments is None
    for ask in (tree.features, tree.known_moments, lambda: plane_energy(tree)):
        with pytest.raises(ValueError, match="got one without moments"):
            ask()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0, 1, 2]], [1.0]), r"edges \(m, 2\)"),
        (([[0.0, 1.0]], [1.0]), "whole numbers"),
        (([[0, 0]], [1.0]), "two different nodes"),
        (([[-1, 0]], [1.0]), "numbered from 0"),
        (([[0, 1], [1, 0]], [1.0, 2.0]), r"each pair of nodes once, got \(0, 1\)"),
        (([[0, 1]], [1.0, 2.0]), "expected 1 weights"),
        (([[0, 1]], ["a"]), "expected 1 weights"),
        (([[0, 1]], [-1.0]), "not negative"),
        (([[0, 1]], [np.inf]), "finite"),
        (([[0, 5]], [1.0], 5), "n_nodes as a whole number from 6"),
        (([[0, 2**40]], [1.0]), "n_nodes as a whole number"),
        (([], []), "n_nodes as a whole number from 1"),
        (([[0, 1]], [1.0], 2.0), "n_nodes"),
    ],
)
def test_wrong_graphs_are_refused_in_one_sentence(arguments, message):
    with pytest.raises(ValueError, match=message):
        tree_of_graph(*arguments)


def test_wrong_words_and_sizes_are_refused():
    with pytest.raises(ValueError, match="one of single, average, felzenszwalb, got 'ward'"):
        tree_of_graph([[0, 1]], [1.0], linkage="ward")
    with pytest.raises(ValueError, match="one of single"):
        tree_of_graph([[0, 1]], [1.0], linkage=pcgraph.WardLinkage())
    for sizes in ([1], [0, 1], [1.5, 1.0]):
        with pytest.raises(ValueError, match=r"expected sizes \(2,\)"):
            tree_of_graph([[0, 1]], [1.0], sizes=sizes)
