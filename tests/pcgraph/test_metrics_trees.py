# SPDX-License-Identifier: Apache-2.0
"""Metrics of whole trees: a tree of five nodes by hand, every cut one by one, and Higra."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from checks import SEEDS
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import pcgraph
from pcgraph import metrics
from pcgraph.metrics.level_curves import LEVEL_SCORES

# Leaves 0, 1, 2; node 3 joins 0 and 1 at altitude 1; node 4, the root, joins 3 and 2 at altitude 2.
PARENTS = np.array([3, 3, 4, 4, 4])
ALTITUDES = np.array([0.0, 0.0, 0.0, 1.0, 2.0])
TREE = PARENTS, ALTITUDES
LEAVES = np.array([0, 0, 1, 1, 2, 2, 2, 2])
TRUTH = np.array([7, 7, 7, 9, 9, 9, 9, 9])  # cells: 0-7 2, 1-7 1, 1-9 1, 2-9 4

SCORES = {score.name: score for score in LEVEL_SCORES.values()}


def test_level_curve_by_hand():
    curve = metrics.level_curve(TREE, LEAVES, TRUTH)
    assert curve.altitudes.tolist() == [-np.inf, 1, 2]
    assert curve.regions.tolist() == [3, 2, 1]
    overlaps = [3 * 2 / 3 + 5 * 4 / 5, 3 * 3 / 4 + 5 * 4 / 5, 3 * 3 / 8 + 5 * 5 / 8]
    assert curve.values == pytest.approx(np.array(overlaps) / 8)
    assert curve.at([-1.0, 0.99, 1.0, np.inf]) == pytest.approx(np.array(overlaps)[[0, 0, 1, 2]] / 8)


def test_oracle_and_purity_by_hand():
    assert metrics.tree_oracle(TREE, LEAVES, TRUTH) == pytest.approx((3 * 3 / 4 + 5 * 4 / 5) / 8)
    # Pairs of 7: one in leaf 0 (pure), two in node 3 (3 of 4); of 9: six in leaf 2, four in the root (5 of 8).
    assert metrics.dendrogram_purity(TREE, LEAVES, TRUTH) == pytest.approx((1 + 2 * 3 / 4 + 6 + 4 * 5 / 8) / 13)
    assert metrics.dendrogram_purity(TREE, np.arange(3), np.arange(3)) == 1


def test_fragmentation_curve_by_hand():
    curve = metrics.fragmentation_curve(TREE, LEAVES, TRUTH, measure="hamming")
    assert curve.regions.tolist() == [1, 2, 3]
    assert curve.errors == pytest.approx([1 - 5 / 8, 1 - 7 / 8, 1 - 7 / 8])
    assert metrics.fragmentation_curve(TREE, LEAVES, TRUTH, max_regions=2).regions.tolist() == [1, 2]


def test_best_scales_by_hand():
    first = metrics.level_curve(TREE, LEAVES, TRUTH)  # best at 1: 6.25/8 against 6/8 and 4.25/8
    second = metrics.level_curve((PARENTS, ALTITUDES * 3), LEAVES, TRUTH)  # the same from 3 to 6
    best = metrics.best_scales([first, second])
    assert best.ois == pytest.approx(first.values.max())
    assert best.ois_altitudes.tolist() == [1, 3]
    # Common: [1, 2) gives 6.25 and 6; [3, 6) gives 4.25 and 6.25.
    assert (best.ods, best.ods_altitude) == (pytest.approx((first.values.max() + 6 / 8) / 2), 1)
    assert metrics.best_scales([first]).ods == metrics.best_scales([first]).ois
    errors = metrics.level_curve(TREE, LEAVES, TRUTH, score="variation_of_information")
    assert metrics.best_scales([errors]).ois == errors.values.min()


def test_a_leaf_alone_is_a_tree():
    tree, one = ([0], [0.0]), np.zeros(1, int)
    assert metrics.level_curve(tree, one, one).values.tolist() == [1]
    assert metrics.tree_oracle(tree, one, one) == metrics.dendrogram_purity(tree, one, one) == 1
    assert metrics.fragmentation_curve(tree, one, one).errors.tolist() == [0]


def random_tree(seed: int, arity: int = 3) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Parents and altitudes of a tree with up to 14 leaves, altitudes often equal, some infinite."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 15))
    live, parents = list(range(n)), [0] * n
    while len(live) > 1:
        taken = rng.permutation(len(live))[: rng.integers(2, arity + 1)]
        for child in (live[i] for i in taken):
            parents[child] = len(parents)
        live = [node for i, node in enumerate(live) if i not in taken] + [len(parents)]
        parents.append(len(parents))
    altitudes = np.concatenate([np.zeros(n), np.sort(rng.integers(0, 6, len(parents) - n)) / 2.0])
    altitudes[altitudes == 2.5] = np.inf
    return np.array(parents), altitudes


def random_points(seed: int, n_leaves: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rng = np.random.default_rng(seed)
    return rng.integers(-1, n_leaves, 60), rng.integers(-1, 5, 60)


def members(parents: NDArray[np.int64], leaf: int) -> list[int]:
    """The leaf and all nodes above it."""
    path = [leaf]
    while parents[path[-1]] != path[-1]:
        path.append(int(parents[path[-1]]))
    return path


def cut_at(parents: NDArray[np.int64], altitudes: NDArray[np.float64], height: float) -> NDArray[np.int64]:
    n = int(parents.min())
    return np.array(
        [[p for p in members(parents, leaf) if p == leaf or altitudes[p] <= height][-1] for leaf in range(n)]
    )


@pytest.mark.parametrize("score", SCORES)
@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_every_level_scores_as_its_labelling_does(score: str, seed: int):
    tree = parents, altitudes = random_tree(seed)
    leaves, truth = random_points(seed, int(parents.min()))
    curve = metrics.level_curve(tree, leaves, truth, score=score)
    assert curve.altitudes.tolist() == [-np.inf, *np.unique(altitudes[parents.min() :])]
    for height, regions, value in zip(curve.altitudes, curve.regions, curve.values, strict=True):
        cut = cut_at(parents, altitudes, height)
        labels = np.where(leaves >= 0, cut[leaves], -1)
        direct = getattr(metrics, score)(labels, truth)
        assert value == pytest.approx(getattr(direct, "total", direct), abs=1e-12)
        assert regions == len(np.unique(cut))


def all_cuts(parents: NDArray[np.int64], node: int) -> list[tuple[int, ...]]:
    """Every set of nodes that splits a node's leaves."""
    below = [child for child in np.flatnonzero(parents == node).tolist() if child != node]
    parts = [sum(cut, ()) for cut in itertools.product(*(all_cuts(parents, child) for child in below))] if below else []
    return [(node,), *parts]


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_no_cut_is_better_than_the_curve_and_the_oracle(seed: int):
    tree = parents, _ = random_tree(seed % 1000)
    leaves, truth = random_points(seed, int(parents.min()))
    paths = [members(parents, leaf) for leaf in range(parents.min())]
    cuts = all_cuts(parents, len(parents) - 1)[:400]
    curve = metrics.fragmentation_curve(tree, leaves, truth, measure="hamming")
    oracle = metrics.tree_oracle(tree, leaves, truth)
    least = dict(zip(curve.regions.tolist(), curve.errors.tolist(), strict=True))
    found: dict[int, float] = {}
    for cut in cuts:
        owner = np.array([next(node for node in path if node in cut) for path in paths])
        labels = np.where(leaves >= 0, owner[leaves], -1)
        error = 1 - metrics.achievable_segmentation_accuracy(labels, truth)
        assert error >= least[len(cut)] - 1e-12
        assert metrics.segmentation_covering(labels, truth) <= oracle + 1e-12
        found[len(cut)] = min(found.get(len(cut), 1.0), error)
    if len(cuts) < 400:
        assert found == pytest.approx(least)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_purity_is_the_mean_over_all_pairs(seed: int):
    tree = parents, _ = random_tree(seed)
    leaves, truth = random_points(seed, int(parents.min()))
    seen = (leaves >= 0) & (truth >= 0)
    paths = [members(parents, leaf) for leaf in range(parents.min())]
    fractions = []
    for i, j in itertools.combinations(np.flatnonzero(seen), 2):
        if truth[i] == truth[j]:
            ancestor = next(node for node in paths[leaves[i]] if node in paths[leaves[j]])
            inside = seen & np.array([leaf >= 0 and ancestor in paths[leaf] for leaf in leaves])
            fractions.append((truth[inside] == truth[i]).mean())
    assert metrics.dendrogram_purity(tree, leaves, truth) == pytest.approx(np.mean(fractions) if fractions else 1.0)


@given(SEEDS, st.integers(0, 2))
@settings(max_examples=30, deadline=None)
def test_boundaries_of_every_level_are_those_of_its_labelling(seed: int, hops: int):
    tree = parents, altitudes = random_tree(seed)
    leaves, truth = random_points(seed, int(parents.min()))
    seen = (leaves >= 0) & (truth >= 0)
    graph = metrics.NeighbourGraph.of(np.random.default_rng(seed).normal(size=(60, 3)), seen, k=3)
    curve = metrics.boundary_curve(graph, tree, leaves, truth, hops=hops)
    for i, height in enumerate(curve.altitudes):
        labels = np.where(seen, cut_at(parents, altitudes, height)[leaves], -1)
        recall, precision = graph.recall(labels, truth, hops=hops), graph.precision(labels, truth, hops=hops)
        assert (curve.recall[i], curve.precision[i]) == pytest.approx((recall, precision))
        mean = 2 * recall * precision / (recall + precision) if recall + precision > 0 else 0
        assert curve.f_measure.values[i] == pytest.approx(mean)
    assert metrics.best_scales([curve.f_measure]).ois == curve.f_measure.values.max()


@pytest.mark.parametrize("seed", range(6))
def test_higra_agrees(seed: int):
    hg = pytest.importorskip("higra", reason="Higra is in the bench extra")
    rng = np.random.default_rng(seed)
    graph = hg.get_4_adjacency_graph((12, 9))
    theirs, altitudes = hg.bpt_canonical(graph, rng.integers(0, 9, graph.num_edges()).astype(float))
    truth, leaves = rng.integers(0, 6, 108), np.arange(108)
    tree = theirs.parents(), altitudes
    assert metrics.dendrogram_purity(tree, leaves, truth) == pytest.approx(hg.dendrogram_purity(theirs, truth))
    for name, ours in (("BCE", "consistency"), ("DHamming", "hamming"), ("DCovering", "covering")):
        measure = getattr(hg.OptimalCutMeasure, name)
        expected = hg.assess_fragmentation_optimal_cut(theirs, truth, measure, max_regions=60)
        curve = metrics.fragmentation_curve(tree, leaves, truth, measure=ours, max_regions=60)
        assert curve.regions.tolist() == expected.num_regions().tolist()
        assert 1 - curve.errors == pytest.approx(expected.scores())
    curve = metrics.level_curve(tree, leaves, truth)
    for height, value in zip(curve.altitudes[1:], curve.values[1:], strict=True):
        cut = hg.labelisation_horizontal_cut_from_threshold(theirs, altitudes, height).ravel()
        assert metrics.segmentation_covering(cut, truth) == pytest.approx(value)


def test_trees_come_as_they_are():
    steps = np.linspace(0.0, 0.5, 40)
    x, y = np.meshgrid(steps, steps)
    points = np.stack((x, y, 1.0 + 0.2 * (x > 0.25)), axis=-1).reshape(-1, 3)
    found, truth = pcgraph.segment(points), (points[:, 0] > 0.25).astype(int)
    tree, leaves = found.tree, found.supervoxels
    pair, graph = (tree.parents, tree.altitudes), metrics.NeighbourGraph.of(points, leaves >= 0)
    assert np.array_equal(*(metrics.level_curve(one, leaves, truth).values for one in (tree, pair)))
    assert np.array_equal(*(metrics.boundary_curve(graph, one, leaves, truth).recall for one in (tree, pair)))
    assert np.array_equal(*(metrics.fragmentation_curve(one, leaves, truth).errors for one in (tree, pair)))
    assert metrics.tree_oracle(tree, leaves, truth) == metrics.tree_oracle(pair, leaves, truth)
    assert metrics.dendrogram_purity(tree, leaves, truth) == metrics.dendrogram_purity(pair, leaves, truth)
    with pytest.raises(ValueError, match="expected a SegmentationTree or a pair"):
        metrics.tree_oracle(tree.parents, leaves, truth)


@pytest.mark.parametrize("score", SCORES)
def test_every_score_prefers_the_truth(score: str):
    curve = metrics.level_curve(TREE, LEAVES, LEAVES, score=score)
    assert metrics.best_scales([curve]).ods_altitude == -np.inf
    assert curve.larger_is_better == (curve.values[0] > curve.values[-1])


def test_a_score_of_ones_own():
    with pytest.raises(TypeError, match="larger_is_better"):
        metrics.level_score("largest_segment")
    try:

        @metrics.level_score("mixed_segments", larger_is_better=False)
        def mixed_segments(table, order):
            return table.sums_over_cuts(order, (np.diff(table.cells.starts) > 1).astype(float))

        curve = metrics.level_curve(TREE, LEAVES, TRUTH, score="mixed_segments")
        assert curve.values.tolist() == [1, 1, 1]  # leaf 1, node 3, the root
        assert not curve.larger_is_better
    finally:
        del LEVEL_SCORES["mixed_segments"]


def test_earlier_names_of_scores():
    names = {"weighted_overlap": "segmentation_covering", "achievable_accuracy": "achievable_segmentation_accuracy"}
    for earlier, name in names.items():
        assert metrics.level_curve(TREE, LEAVES, TRUTH, score=earlier).score == name
        assert getattr(metrics, earlier) is getattr(metrics, name)


def test_bad_arguments():
    with pytest.raises(ValueError, match="each larger"):
        metrics.tree_oracle(([0, 0, 2], ALTITUDES), LEAVES, TRUTH)
    with pytest.raises(ValueError, match="each larger"):
        metrics.tree_oracle(([3, 3, 4, 4, 5], ALTITUDES), LEAVES, TRUTH)
    with pytest.raises(ValueError, match="leaves before"):
        metrics.tree_oracle(([2, 4, 4, 4, 4], ALTITUDES), LEAVES, TRUTH)
    with pytest.raises(ValueError, match=r"leaves 0\.\.2"):
        metrics.tree_oracle(TREE, LEAVES + 1, TRUTH)
    graph = metrics.NeighbourGraph.of(np.random.default_rng(0).normal(size=(8, 3)))
    with pytest.raises(ValueError, match=r"leaves 0\.\.2"):
        metrics.boundary_curve(graph, TREE, LEAVES + 1, TRUTH)
    with pytest.raises(ValueError, match="whole number of at least 0"):
        metrics.boundary_curve(graph, TREE, LEAVES, TRUTH, hops=-1)
    with pytest.raises(ValueError, match="one altitude per node"):
        metrics.level_curve((PARENTS, ALTITUDES[:3]), LEAVES, TRUTH)
    with pytest.raises(ValueError, match="do not decrease"):
        metrics.level_curve((PARENTS, -ALTITUDES), LEAVES, TRUTH)
    with pytest.raises(ValueError, match="do not decrease"):
        metrics.level_curve((PARENTS, ALTITUDES * np.nan), LEAVES, TRUTH)
    with pytest.raises(ValueError, match="expected a score"):
        metrics.level_curve(TREE, LEAVES, TRUTH, score="accuracy")
    with pytest.raises(ValueError, match="measure"):
        metrics.fragmentation_curve(TREE, LEAVES, TRUTH, measure="accuracy")
    with pytest.raises(ValueError, match="max_regions"):
        metrics.fragmentation_curve(TREE, LEAVES, TRUTH, max_regions=0)
    with pytest.raises(ValueError, match="one score"):
        metrics.best_scales([])
