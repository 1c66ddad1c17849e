# SPDX-License-Identifier: Apache-2.0
"""Laws of trees and cuts, for every linkage, over random graphs."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from typing import NamedTuple

import networkx
import numpy as np
import pytest
from checks import refines
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.graphs import SHAPES, leaf_sets, made, random_graph, tree_of

from pcgraph.features.moments import Moments
from pcgraph.features.nodes import node_features
from pcgraph.graph.adjacency import AdjacencyGraph, EdgeFeatures
from pcgraph.tree.average_linkage import ConvexityLinkage
from pcgraph.tree.energies import plane_energy, variance_energy
from pcgraph.tree.felzenszwalb import FelzenszwalbLinkage
from pcgraph.tree.lccp import LccpLinkage
from pcgraph.tree.learned import EdgeModel, LearnedLinkage
from pcgraph.tree.least_increase import MumfordShahLinkage, WardLinkage
from pcgraph.tree.linkage import Merges
from pcgraph.tree.optimal_cut import Energy
from pcgraph.tree.single_linkage import QuasiFlatLinkage
from pcgraph.tree.tree import SegmentationTree, segmentation_tree

MODEL = EdgeModel(("contact_concavity", "step_voxels"), (0.2, 0.1), (0.5, 0.2), (1.5, 0.7), -0.3, 0.4)
LINKAGES = [
    ConvexityLinkage(),
    FelzenszwalbLinkage(),
    LccpLinkage(),
    LccpLinkage(sanity=True, common_neighbours=1),
    LearnedLinkage(MODEL),
    MumfordShahLinkage(plane=1.0, normal=0.3, color=0.2),
    QuasiFlatLinkage(),
    WardLinkage(position=0.2, color=0.5),
]
over_linkages = pytest.mark.parametrize("linkage", LINKAGES, ids=lambda linkage: type(linkage).__name__)
over_graphs = given(shape=st.sampled_from(SHAPES), n=st.integers(1, 24), seed=st.integers(0, 2**31), ties=st.booleans())
quick = settings(max_examples=15, deadline=None)


class Case(NamedTuple):
    """A random graph, the points of its nodes, and its tree by some linkage."""

    n: int
    seed: int
    ties: bool
    graph: AdjacencyGraph
    leaves: Moments
    points: np.ndarray
    leaf: np.ndarray
    merges: Merges
    tree: SegmentationTree


@over_linkages
@quick
@over_graphs
def test_laws_of_trees_and_cuts(linkage, shape, n, seed, ties):
    """One tree for all laws: making graphs and trees takes longer than asking them."""
    graph, leaves, points, leaf = random_graph(shape, n, np.random.default_rng(seed), ties)
    merges = linkage.merges(graph, leaves)
    case = Case(n, seed, ties, graph, leaves, points, leaf, merges, segmentation_tree(merges, leaves))
    assert_merges_cover_each_component_at_rising_altitudes(case)
    assert_cuts_never_cross(case)
    assert_cuts_of_a_least_size_have_it_and_never_cross(case)
    assert_optimal_cuts_at_rising_scales_never_cross(case)
    assert_moments_of_every_node_are_those_of_its_points(case)


def assert_merges_cover_each_component_at_rising_altitudes(case):
    n, graph, merges, tree = case.n, case.graph, case.merges, case.tree
    touching = networkx.Graph(graph.edges.tolist())
    touching.add_nodes_from(range(n))
    assert len(merges.pairs) == len(merges.altitudes) == n - networkx.number_connected_components(touching)
    assert np.isfinite(merges.altitudes).all()
    assert (merges.altitudes >= 0.0).all()
    assert (np.diff(merges.altitudes) >= 0.0).all()
    assert (merges.pairs < n + np.arange(len(merges.pairs))[:, None]).all()
    assert len(np.unique(merges.pairs)) == merges.pairs.size
    assert not tree.altitudes[:n].any()
    assert not np.isnan(tree.altitudes).any()
    parts = tree.cut(altitude=np.finfo(float).max)
    found = {frozenset(np.flatnonzero(parts == part).tolist()) for part in np.unique(parts)}
    assert found == {frozenset(part) for part in networkx.connected_components(touching)}
    joined = tree.edge_saliency(graph.edges)
    assert np.isfinite(joined).all()
    # Nothing merges without an edge: every merged node is connected by edges inside it.
    for below in leaf_sets(tree)[n : n + len(merges.pairs)]:
        assert networkx.is_connected(touching.subgraph(below))


def assert_cuts_never_cross(case):
    n, tree = case.n, case.tree
    by_number = [tree.cut(n=count) for count in range(n, 0, -1)]
    assert [int(cut.max()) + 1 for cut in by_number] == list(range(n, 0, -1))
    levels = np.unique(np.concatenate(([0.0], tree.altitudes, tree.altitudes[np.isfinite(tree.altitudes)] * 0.7)))
    for family in (by_number, list(tree.levels(levels).T)):
        assert all(refines(fine, coarse) for fine, coarse in pairwise(family))
    assert all(cut[0] == 0 and (np.diff(np.maximum.accumulate(cut)) <= 1).all() for cut in by_number)


def assert_cuts_of_a_least_size_have_it_and_never_cross(case):
    leaves, tree = case.leaves, case.tree
    least = 1 + case.seed % 25
    cuts = list(np.stack([tree.cut(altitude=level, min_size=least) for level in np.unique(tree.altitudes)]))
    finest = int(tree.cut(altitude=-1.0, min_size=least).max()) + 1
    by_number = [tree.cut(n=count, min_size=least) for count in range(finest, 0, -1)]
    assert [int(cut.max()) + 1 for cut in by_number] == list(range(finest, 0, -1))
    for family in (cuts, by_number):
        assert all(refines(fine, coarse) for fine, coarse in pairwise(family))
    for cut in (*cuts, *by_number):
        assert np.bincount(cut, leaves.counts).min() >= min(least, leaves.counts.sum())


def assert_optimal_cuts_at_rising_scales_never_cross(case):
    n, graph, tree, rng = case.n, case.graph, case.tree, np.random.default_rng(case.seed + 1)
    values = rng.integers(0, 3, (n, 2)) if case.ties else rng.normal(size=(n, 2))
    others = [tree.cut(altitude=level) for level in np.unique(tree.altitudes[np.isfinite(tree.altitudes)])]
    node_of = {below: node for node, below in enumerate(leaf_sets(tree))}

    def energy_of(cut, energy: Energy):
        """Of a cut, as a function of the scale."""
        nodes = [node_of[frozenset(np.flatnonzero(cut == segment).tolist())] for segment in range(cut.max() + 1)]
        return lambda scale: energy.data[nodes].sum() + scale * energy.complexity[nodes].sum()

    for energy in (plane_energy(tree), plane_energy(tree, graph), variance_energy(tree, values, graph)):
        by_scale = tree.by_energy(energy)
        assert (by_scale.altitudes[1:] >= by_scale.altitudes[:-1]).all()
        scales = np.unique(np.concatenate(([0.0], by_scale.altitudes[np.isfinite(by_scale.altitudes)], [1e9])))
        cuts = [tree.cut_optimal(energy, scale) for scale in scales.tolist()]
        assert all(refines(fine, coarse) for fine, coarse in pairwise(cuts))
        assert refines(cuts[-1], tree.cut(altitude=np.finfo(float).max))  # parts that do not touch stay apart
        least = [energy_of(cut, energy)(scale) for cut, scale in zip(cuts, scales.tolist(), strict=True)]
        for other in others:
            assert (least <= energy_of(other, energy)(scales) * (1.0 + 1e-9) + 1e-9).all()


def assert_moments_of_every_node_are_those_of_its_points(case):
    points, leaf = case.points, case.leaf
    tree = case.tree.by_energy(plane_energy(case.tree)) if case.seed % 2 else case.tree
    for node, below in enumerate(leaf_sets(tree)):
        mine = points[np.isin(leaf, list(below))]
        mean = mine.mean(axis=0)
        scatter = (mine - mean).T @ (mine - mean)
        assert tree.moments.counts[node] == len(mine)
        assert (np.abs(tree.moments.centroids[node] - mean) <= 1e-9 + 1e-6 * np.abs(mean)).all()
        assert np.abs(tree.moments.scatters[node] - scatter).max() <= 1e-6 * np.abs(scatter).max()


@over_linkages
@quick
@given(shape=st.sampled_from(SHAPES), n=st.integers(1, 24), seed=st.integers(0, 2**31))
def test_names_of_nodes_do_not_matter(linkage, shape, n, seed):
    rng = np.random.default_rng(seed)
    graph, leaves, _, _ = random_graph(shape, n, rng)
    name = rng.permutation(n)  # new name of each node
    there = renamed(graph, leaves, name, rng)
    first, second = tree_of(linkage, graph, leaves), tree_of(linkage, *there)
    assert first.altitudes == pytest.approx(second.altitudes, rel=1e-9, abs=1e-12)
    levels = np.unique(first.altitudes[np.isfinite(first.altitudes)])
    for low, high in pairwise(np.append(levels, levels[-1] + 1.0)):
        if high - low > 1e-9 * high + 1e-12:  # of equal merges the first comes first
            one, other = (tree.cut(altitude=(low + high) / 2.0) for tree in (first, second))
            assert refines(one, other[name])
            assert refines(other[name], one)


def renamed(graph, leaves, name, rng):
    """The same graph with new names and its edges in another order, not each from the smaller node to the larger."""
    old = np.argsort(name)
    order = rng.permutation(len(graph.edges))
    edges = name[graph.edges[order]].astype(np.int32)
    columns = {field.name: getattr(graph.edge_features, field.name)[order] for field in fields(EdgeFeatures)}
    assert leaves.colors is not None
    moved = Moments(leaves.counts[old], leaves.centroids[old], leaves.scatters[old], leaves.colors[old])
    nodes = node_features(moved)
    return AdjacencyGraph(edges, EdgeFeatures(**columns), nodes), moved


@over_linkages
def test_a_long_chain_neither_recurses_nor_hangs(linkage):
    n = 30_000
    rng = np.random.default_rng(0)
    graph, leaves = long_chain(n, rng)
    tree = tree_of(linkage, graph, leaves)
    assert tree.altitudes[-1] < np.inf
    assert tree.cut(n=7).max() == 6
    assert tree.cut_optimal(plane_energy(tree, graph), 1.0).max() >= 0


def long_chain(n, rng):
    ends = np.arange(n - 1)
    rows = {"convexity": -np.arange(1.0, n) / n, "contact_convexity": -np.arange(1.0, n) / n}
    rows |= {"contact_voxels": np.full(n - 1, 2), "contact_length": np.ones(n - 1)}
    features = made(EdgeFeatures, n - 1, normal_angle=np.arange(1.0, n) / n, **rows)
    centroids = np.column_stack((np.arange(n), rng.random(n), np.zeros(n)))
    leaves = Moments(np.ones(n, np.int64), centroids, np.zeros((n, 3, 3)), rng.random((n, 3)))
    nodes = node_features(leaves)
    return AdjacencyGraph(np.stack((ends, ends + 1), axis=1).astype(np.int32), features, nodes), leaves
