# SPDX-License-Identifier: Apache-2.0
"""Accumulation and votes: against sums over the points below each node, and a hand-drawn tree."""

from __future__ import annotations

import importlib

import networkx
import numpy as np
import pytest
from scipy.spatial import cKDTree

import pcgraph
from pcgraph.features.moments import Moments
from pcgraph.learning import accumulate, accumulate_points, majority, propagate_labels, pure_ancestors, unpool, votes
from pcgraph.tree.tree import SegmentationTree


def hand_drawn() -> SegmentationTree:
    """Leaves 0, 1, 2 of 1, 2 and 3 points: (0, 1) -> 3, (3, 2) -> 4."""
    parents = np.array([3, 3, 4, 4, 4], np.int32)
    counts = np.array([1, 2, 3, 3, 6])
    moments = Moments(counts, np.zeros((5, 3)), np.zeros((5, 3, 3)), None)
    return SegmentationTree(parents, np.array([0, 0, 0, 0.2, 0.5]), moments)


def leaves_below(tree: SegmentationTree) -> list[list[int]]:
    graph = tree.to_networkx()
    return [
        [x for x in {node, *networkx.descendants(graph, node)} if x < tree.n_leaves]
        for node in range(len(tree.parents))
    ]


def test_accumulation_on_a_tree_drawn_by_hand():
    tree, values = hand_drawn(), [6.0, 3.0, -1.0]
    assert accumulate(tree, values, reduce="sum").tolist() == [6, 3, -1, 9, 8]
    assert accumulate(tree, values).tolist() == [6, 3, -1, 4, 1.5]  # weighted by points
    assert accumulate(tree, values, weights=[1, 1, 2]).tolist() == [6, 3, -1, 4.5, 1.75]
    assert accumulate(tree, values, reduce="max").tolist() == [6, 3, -1, 6, 6]
    assert accumulate(tree, values, reduce="min").tolist() == [6, 3, -1, 3, -1]


def test_missing_values_are_left_out():
    tree = hand_drawn()
    values = np.array([[np.nan, np.nan], [3.0, np.nan], [np.nan, 5.0]])
    assert np.array_equal(accumulate(tree, values)[3:], [[3, np.nan], [3, 5]], equal_nan=True)
    assert np.array_equal(accumulate(tree, values, reduce="max")[3:], [[3, np.nan], [3, 5]], equal_nan=True)
    assert accumulate(tree, values, reduce="sum")[3:].tolist() == [[3, 0], [3, 5]]


def test_infinity_is_a_value_and_not_a_missing_one():
    tree = hand_drawn()
    for reduce, sign in (("min", 1.0), ("max", -1.0)):
        values = sign * np.array([np.inf, 2.0, 3.0])
        assert accumulate(tree, values, reduce=reduce).tolist() == (sign * np.array([np.inf, 2, 3, 2, 2])).tolist()
        assert accumulate(tree, [sign * np.inf] * 3, reduce=reduce).tolist() == [sign * np.inf] * 5
    assert accumulate(tree, [np.inf, 2.0, 3.0], weights=[0, 1, 1]).tolist() == [np.inf, 2, 3, 2, 2.5]


def test_sums_of_whole_numbers_are_exact_or_refused(boxes):
    _, truth, result = boxes
    values = np.zeros(truth.shape, np.int64)
    values[0] = 2**53 + 1
    assert accumulate_points(result, values, "sum")[-1] == 2**53 + 1
    assert accumulate_points(result, np.full(truth.shape, 200, np.uint8), "sum")[-1] == 200 * len(truth)
    assert accumulate(hand_drawn(), [2**53 + 1, 0, 0], reduce="sum")[-1] == 2**53 + 1
    for big in (np.uint64(2**63), np.int64(-(2**63))):
        with pytest.raises(ValueError, match="add up to"):
            accumulate_points(result, np.full(truth.shape, big), "sum")
        with pytest.raises(ValueError, match="add up to"):
            accumulate(hand_drawn(), np.array([big, 0, 0], big.dtype), reduce="sum")


@pytest.mark.parametrize("reduce", ["sum", "mean", "max", "min"])
def test_nodes_hold_what_their_points_do(boxes, reduce):
    points, _, result = boxes
    values = np.column_stack((points, np.random.default_rng(0).normal(size=len(points))))
    values[::7, 3] = np.nan
    pooled = accumulate_points(result, values, reduce)
    direct = getattr(np, f"nan{reduce}")
    for node, leaves in enumerate(leaves_below(result.tree)):
        assert pooled[node] == pytest.approx(direct(values[np.isin(result.supervoxels, leaves)], axis=0), rel=1e-9)


def test_means_of_the_points_are_the_centroids(boxes):
    points, _, result = boxes
    assert accumulate_points(result, points) == pytest.approx(result.tree.moments.centroids, rel=1e-9, abs=1e-12)


def test_votes_count_points(boxes):
    _, truth, result = boxes
    labels = np.where(np.arange(len(truth)) % 3 == 0, -1, truth)
    counts = votes(result, labels)
    assert counts.dtype == np.int64
    assert counts[-1].tolist() == np.bincount(labels[labels >= 0]).tolist()
    node = result.tree.n_leaves + 5
    below = np.isin(result.supervoxels, leaves_below(result.tree)[node]) & (labels >= 0)
    assert counts[node].tolist() == np.bincount(labels[below], minlength=3).tolist()
    assert votes(result, np.full(len(truth), -1)).shape == (len(counts), 0)


def test_majority_prefers_the_smaller_of_equals_and_knows_nothing_without_votes():
    assert majority(np.array([[2, 2], [0, 3], [0, 0]])).tolist() == [0, 1, -1]
    assert majority(np.empty((2, 0), np.int64)).tolist() == [-1, -1]


def test_highest_pure_ancestor_on_a_tree_drawn_by_hand():
    tree = hand_drawn()
    leaf_votes = np.array([[9, 1], [0, 0], [0, 8]])
    counts = accumulate(tree, leaf_votes, reduce="sum")
    assert pure_ancestors(tree, counts, 0.9).tolist() == [3, 3, 2]
    assert pure_ancestors(tree, counts, 0.95).tolist() == [-1, -1, 2]
    assert pure_ancestors(tree, counts, 0.5).tolist() == [4, 4, 4]
    assert pure_ancestors(tree, counts, 0.9, altitude=0.1).tolist() == [0, -1, 2]


def test_one_click_per_object_labels_the_scene(boxes):
    points, truth, result = boxes
    clicks = np.full(len(truth), -1)
    for thing in range(3):
        at = np.flatnonzero(truth == thing)
        off_the_others = cKDTree(points[truth != thing]).query(points[at])[0]
        clicks[at[off_the_others.argmax()]] = thing  # not on an edge
    labels = propagate_labels(result, clicks, fraction=1.0)
    assert np.mean(labels == truth) > 0.97


def test_down_keeps_the_shape_and_marks_what_is_missing():
    rng = np.random.default_rng(0)
    points = rng.random((6, 8, 3)) + np.array([0, 0, 2])
    points[2, 3] = np.nan
    result = pcgraph.segment(points, voxel_size=0.3)
    tree = result.tree
    assert np.array_equal(unpool(result, np.arange(tree.n_leaves)), result.supervoxels)
    sizes = unpool(result, tree.moments.counts, tree.cut_nodes(n=1))
    assert sizes.shape == (6, 8)
    assert sizes[2, 3] == -1
    assert set(sizes.ravel().tolist()) == {47, -1}
    places = unpool(result, tree.moments.centroids)
    assert places.shape == (6, 8, 3)
    assert np.isnan(places[2, 3]).all()
    assert np.isfinite(places).all(axis=-1).sum() == 47
    assert not unpool(result, np.ones(tree.n_leaves, bool))[2, 3]


def test_wrong_input_is_refused(boxes):
    _, truth, result = boxes
    tree = result.tree
    with pytest.raises(ValueError, match="expected values of"):
        accumulate(tree, np.zeros(3))
    with pytest.raises(ValueError, match="reduce"):
        accumulate(tree, np.zeros(tree.n_leaves), reduce="median")
    with pytest.raises(ValueError, match="reduce"):
        accumulate_points(result, truth, "median")
    with pytest.raises(ValueError, match="weights"):
        accumulate(tree, np.zeros(tree.n_leaves), weights=np.full(tree.n_leaves, -1.0))
    with pytest.raises(ValueError, match="points' shape"):
        accumulate_points(result, truth[:-1])
    with pytest.raises(ValueError, match="below n_classes"):
        votes(result, truth, 2)
    with pytest.raises(ValueError, match="one row"):
        unpool(result, np.zeros(3))
    with pytest.raises(ValueError, match="per node"):
        unpool(result, np.zeros(tree.n_leaves), tree.cut_nodes(n=2))
    assert majority([[1, 2]]).tolist() == [1]
    for votes_ in (np.ones(3), [1, 2], [[0.5, 1.0]]):
        with pytest.raises(ValueError, match="votes as whole numbers"):
            majority(votes_)
    with pytest.raises(ValueError, match="fraction"):
        pure_ancestors(tree, votes(result, truth), 1.5)
    for altitude in (np.nan, "a"):
        with pytest.raises(ValueError, match="altitude"):
            pure_ancestors(tree, votes(result, truth), altitude=altitude)
    for n_classes in (-1, "a", 2.5):
        with pytest.raises(ValueError, match="n_classes as a whole"):
            votes(result, truth, n_classes)


@pytest.mark.parametrize("package", ["learning", "detection"])
def test_public_names_are_things_not_modules(package):
    rooms = importlib.import_module(f"pcgraph.{package}")
    for name in rooms.__all__:
        thing = getattr(rooms, name)
        assert callable(thing), f"{name} is shadowed by a module"
        assert thing.__doc__
