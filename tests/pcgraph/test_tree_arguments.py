# SPDX-License-Identifier: Apache-2.0
"""What does not fit the tree is refused in one sentence: graphs and surfaces of other clouds, settings, words."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.graphs import CHAIN, hand_graph, hand_tree, random_graph, tree_of

import pcgraph
from pcgraph.graph.boundary import BoundaryCost, BoundaryStrength
from pcgraph.tree.average_linkage import ConvexityLinkage
from pcgraph.tree.energies import boundary_lengths, plane_energy, variance_energy
from pcgraph.tree.felzenszwalb import FelzenszwalbLinkage
from pcgraph.tree.lccp import LccpLinkage
from pcgraph.tree.learned import EdgeModel, LearnedLinkage
from pcgraph.tree.least_increase import MumfordShahLinkage, WardLinkage
from pcgraph.tree.optimal_cut import Energy
from pcgraph.tree.saliency import point_saliency, voxel_saliency
from pcgraph.tree.single_linkage import QuasiFlatLinkage


@pytest.fixture
def tree():
    return hand_tree([[0, 1], [3, 4], [2, 5], [6, 7]], [1.0, 2.0, 4.0, 9.0])


@pytest.mark.parametrize("n", [4, 6, 3000])
def test_graphs_of_other_clouds_are_refused(tree, n):
    other = hand_graph([[0, n - 1]], n=n)
    for energy in (
        lambda: plane_energy(tree, other),
        lambda: variance_energy(tree, np.zeros((5, 1)), other),
        lambda: boundary_lengths(tree, other),
    ):
        with pytest.raises(ValueError, match=f"5 leaves, got one of {n} nodes"):
            energy()
    assert boundary_lengths(tree, hand_graph(CHAIN))[-1] == 0.0


def test_surfaces_of_other_clouds_are_refused(tree, boxes):
    for saliency in (voxel_saliency, point_saliency):
        with pytest.raises(ValueError, match=f"5 leaves, got one with supervoxel {boxes[2].tree.n_leaves - 1}"):
            saliency(tree, boxes[2].surface)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([[0, 9]], r"nodes 0\.\.8, got 0\.\.9"),
        ([[-1, 0]], r"nodes 0\.\.8, got -1\.\.0"),
        ([[0, 2**40]], r"nodes 0\.\.8"),
        ([[0.0, 1.7]], "whole numbers, got float64"),
        ([["a", "b"]], "whole numbers"),
        ([0, 1], r"\(m, 2\)"),
        ([[0, 1, 2]], r"\(m, 2\)"),
    ],
)
def test_pairs_are_nodes(tree, pairs, message):
    with pytest.raises(ValueError, match=message):
        tree.edge_saliency(pairs)
    with pytest.raises(ValueError, match=message):
        tree.lowest_common_ancestors(pairs)


def test_pairs_come_in_any_form(tree):
    pairs = np.array([[0, 2], [3, 4], [0, 4]])
    for form in (pairs, pairs.astype(np.uint8), np.asfortranarray(pairs), pairs.tolist(), pairs[::-1][::-1]):
        assert tree.edge_saliency(form).tolist() == [4.0, 2.0, 9.0]
    assert tree.edge_saliency(np.empty((0, 2))).shape == (0,)


@pytest.mark.parametrize("wrong", [-0.1, np.nan, np.inf, "a", None])
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *((BoundaryCost, name) for name in ("contact", "convex", "step", "step_limit")),
        *((BoundaryStrength, name) for name in ("concavity", "step", "normal", "color")),
        *((WardLinkage, name) for name in ("position", "normal", "color")),
        *((MumfordShahLinkage, name) for name in ("plane", "normal", "color")),
        *((LccpLinkage, name) for name in ("concavity_tolerance", "common_neighbours")),
    ],
)
def test_settings_are_finite_and_not_negative(kind, name, wrong):
    with pytest.raises(ValueError, match=name):
        kind(**{name: wrong})


@pytest.mark.parametrize("kind", [ConvexityLinkage, FelzenszwalbLinkage, LccpLinkage, QuasiFlatLinkage, WardLinkage])
def test_where_the_tree_is_cut_is_no_setting_of_a_linkage(kind):
    assert 0.0 < kind.default_part_altitude < kind.default_object_altitude < np.inf
    with pytest.raises(TypeError, match="object_altitude"):
        kind(object_altitude=0.3)


def test_other_settings():
    assert BoundaryCost(contact=1.0).contact == 1.0
    for wrong in (
        lambda: BoundaryCost(contact=1.01),
        lambda: LccpLinkage(seed_size=0.0),
        lambda: ConvexityLinkage(0.3),
        lambda: QuasiFlatLinkage(None),
        lambda: LearnedLinkage(None),
    ):
        with pytest.raises(ValueError, match="expected"):
            wrong()


@pytest.mark.parametrize(
    "wrong",
    [
        lambda tree: tree.cut(altitude="a"),
        lambda tree: tree.cut(altitude=[1.0]),
        lambda tree: tree.levels(["a"]),
        lambda tree: tree.levels(None),
        lambda tree: tree.cut_optimal(None, 1),
        lambda tree: tree.by_energy(np.ones(9)),
        lambda tree: tree.cut_optimal(Energy(np.zeros(9), np.ones(9)), "a"),
        lambda tree: tree.cut_optimal(Energy(np.zeros(9), np.ones(9)), -1.0),
        lambda tree: Energy([1.0], [1.0]),
        lambda tree: Energy(np.ones(1), [1.0]),
        lambda tree: Energy(np.array(["a"]), np.ones(1)),
    ],
)
def test_words_and_lists_are_refused_in_one_sentence(tree, wrong):
    with pytest.raises(ValueError, match=r"^expected "):
        wrong(tree)


def test_an_energy_of_whole_numbers_is_one_of_floats(tree):
    data, complexity = np.array([0, 0, 0, 0, 0, 1, 7, 3, 20]), np.array([1, 1, 1, 1, 1, 1, 2, 1, 2])
    expected = tree.by_energy(Energy(data.astype(float), complexity.astype(float)))
    whole = tree.by_energy(Energy(data, complexity))
    assert np.array_equal(whole.altitudes, expected.altitudes)
    assert np.array_equal(whole.parents, expected.parents)


def test_learning_needs_lists(boxes):
    _, truth, result = boxes
    with pytest.raises(ValueError, match="list of segmentations"):
        LearnedLinkage.fit(result, truth)
    with pytest.raises(ValueError, match="whole numbers"):
        LearnedLinkage.fit([result], [truth * 1.0])


def test_files_that_cannot_be_read_or_written_are_the_same_kind_of_error(tmp_path):
    model = EdgeModel(("step_voxels",), (0.0,), (1.0,), (1.0,), 0.0, 0.5)
    for nowhere in (tmp_path / "nowhere" / "model.json", tmp_path):
        with pytest.raises(pcgraph.CloudReadError, match="cannot read"):
            EdgeModel.load(nowhere)
        with pytest.raises(pcgraph.CloudReadError):
            LearnedLinkage.load(nowhere)
        with pytest.raises(pcgraph.CloudWriteError, match="choose another path"):
            model.save(nowhere)


def test_results_compare_and_hash_as_objects(boxes):
    _, _, result = boxes
    graph, leaves = random_graph("random", 5, np.random.default_rng(0))[:2]
    tree, energy = tree_of(ConvexityLinkage(), graph, leaves), Energy(np.ones(2), np.ones(2))
    hidden = result.occlusions()
    others = (graph.edge_features, graph.node_features, hidden, hidden.continuations)
    for thing in (graph, tree, energy, ConvexityLinkage().merges(graph, leaves), *others):
        assert thing == thing
        assert thing != tree_of(ConvexityLinkage(), graph, leaves)
        assert len({thing, thing}) == 1
    assert ConvexityLinkage() == ConvexityLinkage()  # settings are equal where their numbers are
