# SPDX-License-Identifier: Apache-2.0
"""The tree: known merge orders, nesting, exact moments."""

from __future__ import annotations

from itertools import pairwise

import networkx
import numpy as np
import pytest
from checks import refines

from pcgraph.features.moments import moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.tree.average_linkage import average_linkage
from pcgraph.tree.tree import segmentation_tree


def leaves_on_a_line(n, **moved):
    """One point per leaf at x = 0, 1, ..., n - 1, or where `moved` says."""
    points = np.column_stack((np.arange(n, dtype=float), np.zeros(n), np.zeros(n)))
    for leaf, x in moved.items():
        points[int(leaf[1:]), 0] = x
    return moments_of_groups(points, None, np.arange(n, dtype=np.int32), n)


def test_hand_drawn_graph_of_five_nodes():
    #   0 --1-- 1 --4-- 2        0-1 merges first (1), then 3-4 (2). Then 2 touches {0, 1} at 4 and {3, 4} at
    #   |               | 3      (3 x 1 + 6 x 2) / 3 = 5 (two edges, weights 1 and 2): 4 wins. Last, {0, 1, 2} and
    #   9       4 --2-- 3        {3, 4} touch by 9 (weight 3), 3 and 6: (27 + 3 + 12) / 6 = 7.
    #    \-----/ \--6-- 2
    edges = np.array([[0, 1], [0, 4], [1, 2], [2, 3], [2, 4], [3, 4]], np.int32)
    costs = np.array([1.0, 9.0, 4.0, 3.0, 6.0, 2.0])
    weights = np.array([1.0, 3.0, 1.0, 1.0, 2.0, 1.0])
    merges = average_linkage(5, edges, costs, weights)
    assert merges.pairs.tolist() == [[0, 1], [3, 4], [2, 5], [6, 7]]
    assert merges.altitudes.tolist() == [1.0, 2.0, 4.0, 7.0]
    tree = segmentation_tree(merges, leaves_on_a_line(5))
    assert tree.parents.tolist() == [5, 5, 7, 6, 6, 7, 8, 8, 8]
    assert tree.altitudes.tolist() == [0, 0, 0, 0, 0, 1, 2, 4, 7]
    assert tree.cut(n=2).tolist() == [0, 0, 0, 1, 1]
    assert tree.cut(n=3).tolist() == [0, 0, 1, 2, 2]
    assert tree.cut(altitude=1.5).tolist() == [0, 0, 1, 2, 3]
    assert tree.cut(altitude=4.0).tolist() == [0, 0, 0, 1, 1]
    assert tree.cut_nodes(n=3).tolist() == [5, 5, 2, 6, 6]


def test_of_equal_costs_the_first_edge_merges_first():
    edges = np.array([[0, 1], [1, 2], [2, 3]], np.int32)
    merges = average_linkage(4, edges, np.full(3, 0.5), np.ones(3))
    assert merges.pairs.tolist() == [[0, 1], [2, 4], [3, 5]]
    assert merges.altitudes.tolist() == [0.5, 0.5, 0.5]


def test_average_linkage_agrees_with_brute_force():
    rng = np.random.default_rng(3)
    for n in (2, 7, 25):
        complete = networkx.gnp_random_graph(n, 0.4, seed=n)
        complete.add_edges_from((i, i + 1) for i in range(n - 1))
        edges = np.array(sorted(tuple(sorted(edge)) for edge in complete.edges), np.int32)
        costs, weights = rng.random(len(edges)), rng.integers(1, 9, len(edges)).astype(float)
        merges = average_linkage(n, edges, costs, weights)
        clusters = {i: {i} for i in range(n)}
        for step, (pair, altitude) in enumerate(zip(merges.pairs.tolist(), merges.altitudes, strict=True)):
            means = {}
            for (i, j), cost, weight in zip(edges.tolist(), costs, weights, strict=True):
                a = next(c for c, members in clusters.items() if i in members)
                b = next(c for c, members in clusters.items() if j in members)
                if a != b:
                    total = means.setdefault((min(a, b), max(a, b)), [0.0, 0.0])
                    total[0] += cost * weight
                    total[1] += weight
            best = min(means, key=lambda key: means[key][0] / means[key][1])
            assert tuple(pair) == best
            assert altitude == pytest.approx(means[best][0] / means[best][1], rel=1e-12)
            clusters[n + step] = clusters.pop(pair[0]) | clusters.pop(pair[1])


def test_parts_that_do_not_touch_join_last_smallest_first_each_to_the_nearest_larger_one():
    edges = np.array([[0, 1], [1, 2], [5, 6]], np.int32)  # parts {0, 1, 2}, {3}, {4}, {5, 6}
    merges = average_linkage(7, edges, np.array([0.1, 0.2, 5.0]), np.ones(3))
    tree = segmentation_tree(merges, leaves_on_a_line(7, x4=4.4))
    assert np.isinf(tree.altitudes[-3:]).all()
    assert np.isfinite(tree.altitudes[:-3]).all()
    assert tree.cut(altitude=1e9).tolist() == [0, 0, 0, 1, 2, 3, 3]
    assert tree.cut(n=2).tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert [int(tree.cut(n=n).max()) + 1 for n in range(1, 8)] == list(range(1, 8))


def test_altitudes_rise_and_cuts_nest(boxes):
    tree = boxes[2].tree
    assert np.all(np.diff(tree.altitudes) >= 0)
    assert np.all(tree.parents[:-1] > np.arange(len(tree.parents) - 1))
    assert tree.parents[-1] == len(tree.parents) - 1
    cuts = [tree.cut(n=n) for n in range(1, tree.n_leaves + 1)]
    assert [int(cut.max()) + 1 for cut in cuts] == list(range(1, tree.n_leaves + 1))
    assert all(refines(fine, coarse) for coarse, fine in pairwise(cuts))
    levels = np.unique(tree.altitudes)[::7]
    by_altitude = [tree.cut(altitude=level) for level in levels]
    assert all(refines(fine, coarse) for fine, coarse in pairwise(by_altitude))


def test_moments_are_exact_at_every_node(boxes):
    points, _, result = boxes
    points = points + np.array([1000.0, -500.0, 30.0])  # far from the origin, where naive sums cancel
    rng = np.random.default_rng(0)
    colors = rng.random(points.shape)
    leaves = moments_of_groups(points, colors, result.supervoxels, result.graph.n_nodes)
    tree = result.tree
    from pcgraph.features.moments import moments_up_tree

    pooled = moments_up_tree(leaves, tree.parents)
    features = node_features(pooled)
    below = np.zeros((len(tree.parents), tree.n_leaves), bool)
    below[: tree.n_leaves] = np.eye(tree.n_leaves, dtype=bool)
    for node, up in enumerate(tree.parents[:-1]):
        below[up] |= below[node]
    for node in range(len(tree.parents)):
        mine = below[node][result.supervoxels]
        mean = points[mine].mean(axis=0)
        covariance = (points[mine] - mean).T @ (points[mine] - mean) / mine.sum()
        assert features.size[node] == mine.sum()
        assert features.centroid[node] == pytest.approx(mean, rel=1e-9)
        assert features.color[node] == pytest.approx(colors[mine].mean(axis=0), rel=1e-9)
        scale = np.abs(covariance).max()
        assert np.abs(features.covariance[node] - covariance).max() <= 1e-6 * scale
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
        assert features.residual[node] == pytest.approx(spread[0], rel=1e-6, abs=1e-6 * spread[2])


def test_wrong_cuts_are_refused(boxes):
    tree = boxes[2].tree
    for arguments in ({}, {"n": 1, "altitude": 0.5}, {"n": 0}, {"n": tree.n_leaves + 1}, {"n": 2.0}):
        with pytest.raises(ValueError, match="expected"):
            tree.cut(**arguments)
    with pytest.raises(ValueError, match="nan"):
        tree.cut(altitude=float("nan"))


def test_networkx_export(boxes):
    tree = boxes[2].tree
    exported = tree.to_networkx()
    assert networkx.is_arborescence(exported)
    assert exported.number_of_nodes() == len(tree.parents)
    assert exported.nodes[len(tree.parents) - 1]["size"] == len(boxes[0])
