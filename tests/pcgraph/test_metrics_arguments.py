# SPDX-License-Identifier: Apache-2.0
"""All metrics take the same labels: whole numbers, negative or masked ones left out; other words are refused first."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from test_metrics_trees import ALTITUDES, LEAVES, PARENTS, TREE

from pcgraph import metrics

TRUTH = np.array([0, 0, 0, 1, 1, 1, 2, 2])
POINTS = np.random.default_rng(0).random((8, 3))

OF_TWO: dict[str, Callable[[ArrayLike, ArrayLike], object]] = {
    "contingency": lambda labels, truth: metrics.contingency(labels, truth).toarray().tolist(),
    "segmentation_covering": metrics.segmentation_covering,
    "undersegmentation_error": metrics.undersegmentation_error,
    "achievable_segmentation_accuracy": metrics.achievable_segmentation_accuracy,
    "adjusted_rand_index": metrics.adjusted_rand_index,
    "variation_of_information": lambda labels, truth: metrics.variation_of_information(labels, truth).total,
    "panoptic_quality": lambda labels, truth: metrics.panoptic_quality(labels, truth, labels, truth).pq,
    "boundary_recall": lambda labels, truth: metrics.boundary_recall(POINTS, labels, truth, k=2),
    "boundary_precision": lambda labels, truth: metrics.boundary_precision(POINTS, labels, truth, k=2),
    "explained_variation": lambda labels, _: metrics.explained_variation(POINTS, labels),
    "compactness": lambda labels, _: metrics.compactness(POINTS, labels, k=2),
    "tree_oracle": lambda labels, truth: metrics.tree_oracle(TREE, labels, truth),
    "level_curve": lambda labels, truth: metrics.level_curve(TREE, labels, truth).values.tolist(),
    "fragmentation_curve": lambda labels, truth: metrics.fragmentation_curve(TREE, labels, truth).errors.tolist(),
}


@pytest.mark.parametrize("name", OF_TWO)
@pytest.mark.parametrize("wrong", [LEAVES * 1.0, LEAVES + 0.5, LEAVES.astype(str), LEAVES * 1j])
def test_labels_are_whole_numbers_everywhere(name: str, wrong: NDArray[np.generic]):
    with pytest.raises(ValueError, match=r"^expected labels that are whole numbers, got"):
        OF_TWO[name](wrong, TRUTH)
    if name not in ("explained_variation", "compactness"):
        with pytest.raises(ValueError, match=r"^expected labels that are whole numbers, got"):
            OF_TWO[name](LEAVES, TRUTH * 1.0)


@pytest.mark.parametrize("name", OF_TWO)
@pytest.mark.parametrize("dtype", [np.int64, np.uint8, np.uint64])
def test_masked_labels_are_left_out_everywhere(name: str, dtype: type):
    mask = np.array([False, True, False, False, True, False, False, False])
    masked = np.ma.masked_array(LEAVES.astype(dtype), mask)
    assert OF_TWO[name](masked, TRUTH) == OF_TWO[name](np.where(mask, -1, LEAVES), TRUTH)
    if name not in ("explained_variation", "compactness"):
        truth = np.ma.masked_array(TRUTH.astype(dtype), mask)
        assert OF_TWO[name](LEAVES, truth) == OF_TWO[name](LEAVES, np.where(mask, -1, TRUTH))


def test_masked_points_and_values_take_no_part():
    places = np.ma.masked_array(POINTS, np.arange(24).reshape(8, 3) == 10)
    assert metrics.NeighbourGraph.of(places, k=2).members.tolist() == [0, 1, 2, 4, 5, 6, 7]
    valid = np.ma.masked_array(np.ones(8, bool), np.arange(8) == 5)
    assert metrics.NeighbourGraph.of(POINTS, valid, k=2).members.tolist() == [0, 1, 2, 3, 4, 6, 7]
    for refused in (metrics.explained_variation, metrics.compactness):
        with pytest.raises(ValueError, match="expected finite"):
            refused(places, TRUTH)


def test_labels_without_end_are_refused():
    with pytest.raises(ValueError, match=r"below 2\*\*63"):
        metrics.segmentation_covering(TRUTH.astype(np.uint64) + 2**63, TRUTH)
    assert metrics.segmentation_covering(TRUTH + 2**62, TRUTH) == 1.0


@pytest.mark.parametrize("truth", [TRUTH, np.zeros(8, int)], ids=["a boundary", "no boundary"])
@pytest.mark.parametrize(
    "wrong", [{"hops": -1}, {"hops": 1.5}, {"tolerance": -1}, {"tolerance": "a"}, {"tolerance": np.nan}, {"k": 2.5}]
)
def test_reach_is_checked_before_anything_is_found(truth: NDArray[np.int64], wrong: dict[str, object]):
    for score in (metrics.boundary_recall, metrics.boundary_precision):
        with pytest.raises(ValueError, match="at least"):
            score(POINTS, truth, truth, **{"k": 2, **wrong})
    if "hops" in wrong:
        graph = metrics.NeighbourGraph.of(POINTS, k=2)
        with pytest.raises(ValueError, match="at least"):
            metrics.boundary_curve(graph, TREE, LEAVES, truth, **wrong)


@pytest.mark.parametrize("wrong", [PARENTS * 1.0, "a", [3.5]])
def test_parents_are_whole_numbers(wrong: object):
    with pytest.raises(ValueError, match="parents that are whole numbers"):
        metrics.tree_oracle((wrong, ALTITUDES), LEAVES, TRUTH)


def test_curves_compare_and_hash_as_objects():
    curve = metrics.level_curve(TREE, LEAVES, TRUTH)
    graph = metrics.NeighbourGraph.of(POINTS, k=2)
    quality = metrics.panoptic_quality(LEAVES, TRUTH)
    for thing in (curve, graph, quality, metrics.best_scales([curve])):
        assert thing == thing
        assert thing != metrics.NeighbourGraph.of(POINTS, k=2)
        assert len({thing, thing}) == 1


def test_all_metrics_take_the_points_then_the_segments_then_the_truth():
    order = ["graph", "tree", "points", "values", "labels", "leaves", "truth"]
    functions = [getattr(metrics, name) for name in dir(metrics) if name.islower()]
    assert len(functions) > 15
    for function in functions:
        taken = [order.index(argument) for argument in signature(function).parameters if argument in order]
        assert taken == sorted(taken), function
