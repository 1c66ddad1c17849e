# SPDX-License-Identifier: Apache-2.0
"""The tree in the field's words: nodes above and below, SciPy's linkage matrix, JSON."""

from __future__ import annotations

import json

import networkx
import numpy as np
import pytest
from checks import refines
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.graphs import SHAPES, hand_tree, leaf_sets, random_graph, tree_of
from scipy.cluster.hierarchy import dendrogram, fcluster, is_valid_linkage

import pcgraph
from pcgraph.tree.average_linkage import ConvexityLinkage
from pcgraph.tree.tree import SegmentationTree

over_trees = given(shape=st.sampled_from(SHAPES), n=st.integers(1, 16), seed=st.integers(0, 2**31))
quick = settings(max_examples=20, deadline=None)


def some_tree(shape: str, n: int, seed: int) -> SegmentationTree:
    graph, leaves, _, _ = random_graph(shape, n, np.random.default_rng(seed), ties=seed % 2 == 0)
    return tree_of(ConvexityLinkage(), graph, leaves)


@pytest.fixture
def tree():
    """Five leaves: 5 = {0, 1} at 1, 6 = {3, 4} at 2, 7 = {2, 5} at 4, 8 the root at 9."""
    return hand_tree([[0, 1], [3, 4], [2, 5], [6, 7]], [1.0, 2.0, 4.0, 9.0], counts=[10, 20, 30, 40, 50])


def test_a_tree_drawn_by_hand(tree):
    assert (tree.root, tree.n_nodes, tree.n_leaves) == (8, 9, 5)
    assert tree.children.dtype == np.int32
    assert tree.children.tolist() == [[-1, -1]] * 5 + [[0, 1], [3, 4], [2, 5], [6, 7]]
    assert tree.sizes.tolist() == [10, 20, 30, 40, 50, 30, 90, 60, 150]
    assert tree.leaves_of(7).tolist() == [0, 1, 2]
    assert tree.leaves_of(3).tolist() == [3]
    assert tree.path(1).tolist() == [1, 5, 7, 8]
    assert tree.path(8).tolist() == [8]
    meeting = {(0, 1): 5, (0, 2): 7, (5, 1): 5, (1, 7): 7, (4, 2): 8, (8, 3): 8, (2, 2): 2, (6, 5): 8}
    for (a, b), node in meeting.items():
        assert tree.lowest_common_ancestor(a, b) == tree.lowest_common_ancestor(np.int64(b), a) == node
    assert tree.edge_saliency([[5, 2], [0, 5]]).tolist() == [4.0, 1.0]


@quick
@over_trees
def test_nodes_above_and_below_agree(shape, n, seed):
    tree = some_tree(shape, n, seed)
    below = leaf_sets(tree)
    for node, leaves in enumerate(below):
        assert frozenset(tree.leaves_of(node).tolist()) == leaves
        assert all(tree.parents[child] == node for child in tree.children[node] if child >= 0)
        above = tree.path(node)
        assert (above[0], above[-1]) == (node, tree.root)
        assert np.array_equal(tree.parents[above[:-1]], above[1:])
    pairs = np.stack(np.meshgrid(np.arange(tree.n_nodes), np.arange(tree.n_nodes)), axis=-1).reshape(-1, 2)
    for (a, b), node in zip(pairs.tolist(), tree.lowest_common_ancestors(pairs).tolist(), strict=True):
        assert node == next(up for up in range(tree.n_nodes) if below[a] | below[b] <= below[up])


@quick
@over_trees
def test_scipy_takes_the_linkage_matrix_and_cuts_it_alike(shape, n, seed):
    tree = some_tree(shape, n, seed)
    matrix = tree.to_linkage_matrix()
    assert matrix.shape == (n - 1, 4)
    if n == 1:
        return  # SciPy takes no tree of one leaf
    assert is_valid_linkage(matrix, throw=True)
    assert np.isfinite(matrix).all()
    assert sorted(dendrogram(matrix, no_plot=True)["leaves"]) == list(range(n))
    assert matrix[:, 3].tolist() == [len(leaves) for leaves in leaf_sets(tree)[n:]]
    for level in [0.0, *np.unique(tree.altitudes[np.isfinite(tree.altitudes)])]:
        ours, theirs = tree.cut(altitude=level), fcluster(matrix, level, "distance")
        assert refines(ours, theirs)
        assert refines(theirs, ours)


def test_infinite_altitudes_in_a_linkage_matrix():
    """At twice the largest finite altitude, or at 1."""
    apart = pcgraph.tree_of_graph([[0, 1], [2, 3]], [0.5, 1.5])
    assert apart.to_linkage_matrix().tolist() == [[0, 1, 0.5, 2], [2, 3, 1.5, 2], [4, 5, 3.0, 4]]
    assert pcgraph.tree_of_graph([], [], 2).to_linkage_matrix().tolist() == [[0, 1, 1.0, 2]]


def test_json_takes_trees_as_flat_lists(tree):
    apart = pcgraph.tree_of_graph([[0, 1]], [0.25], 3, sizes=[7, 8, 9])
    text = json.dumps(apart.to_dict(), allow_nan=False)
    parents, altitudes, sizes = [3, 3, 4, 4, 4], [0.0, 0.0, 0.0, 0.25, None], [7, 8, 9, 15, 24]
    assert json.loads(text) == {"n_leaves": 3, "parents": parents, "altitudes": altitudes, "sizes": sizes}
    json.dumps(networkx.node_link_data(apart.to_networkx(), edges="edges"), allow_nan=False)
    assert apart.to_networkx().nodes[4] == {"size": 24}
    assert tree.to_dict()["sizes"][-1] == 150


@pytest.mark.parametrize("wrong", [-1, 9, 2.0, True, "a", None, [1]])
def test_nodes_that_the_tree_does_not_have_are_refused(tree, wrong):
    for ask in (tree.leaves_of, tree.path, lambda node: tree.lowest_common_ancestor(0, node)):
        with pytest.raises(ValueError, match=r"expected .* as a node of this tree, a whole number 0\.\.8, got"):
            ask(wrong)


def test_points_of_nodes(boxes):
    points, _, result = boxes
    tree = result.tree
    assert result.points_of(tree.root).tolist() == np.flatnonzero(result.labels >= 0).tolist()
    node = tree.n_leaves + 3
    inside = result.points_of(node)
    assert len(inside) == tree.sizes[node]
    assert points[inside].mean(axis=0) == pytest.approx(tree.moments.centroids[node], rel=1e-9)
    both = [result.points_of(child) for child in tree.children[node]]
    assert sorted(np.concatenate(both)) == inside.tolist()
    with pytest.raises(ValueError, match="expected node as a node of this tree"):
        result.points_of(tree.n_nodes)


def test_points_of_nodes_of_an_image_are_flat_indices():
    rows, columns = np.mgrid[0:20, 0:20]
    image = np.stack((columns * 0.01, rows * 0.01, np.ones((20, 20))), axis=-1)
    image[3, 4] = np.nan
    result = pcgraph.segment(image, viewpoint=(0, 0, 0))
    assert result.points_of(result.tree.root).tolist() == [i for i in range(400) if i != 64]
