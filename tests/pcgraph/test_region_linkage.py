# SPDX-License-Identifier: Apache-2.0
"""Region linkage: its altitudes on graphs of a few nodes, and what it keeps together and apart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from clouds import two_boxes_on_a_plane
from graphs import random_graph

import pcgraph
from pcgraph.tree.region_linkage import RegionLinkage, region_linkage


@pytest.mark.parametrize("times_as_large", [1, 100])
def test_the_altitude_of_two_regions_is_the_formula(times_as_large):
    graph, leaves, _, _ = random_graph("random", 2, np.random.default_rng(0))
    grown = leaves.counts * np.array([1, times_as_large])
    leaves = replace(leaves, counts=grown, scatters=leaves.scatters * (grown / leaves.counts)[:, None, None])
    cost, weight = 0.4, 7.0
    found = region_linkage(graph, leaves, graph.edges, np.array([cost]), np.array([weight])).altitudes[0]
    unit = float(np.median(graph.edge_features.voxel_edge))
    mean = leaves.counts.mean()

    def residual(scatter):
        return float(np.linalg.eigvalsh(scatter / (unit**2 * mean))[0])

    a, b = leaves.scatters
    n = leaves.counts.astype(float)
    apart = leaves.centroids[0] - leaves.centroids[1]
    union = a + b + n[0] * n[1] / n.sum() * np.outer(apart, apart)
    increase, length = residual(union) - residual(a) - residual(b), weight / 2
    scale, width = increase / length, 7.7 * math.sqrt(n.min() / mean)
    evidence = cost + 0.08 + 0.04 * math.log(1 + scale / 0.1)
    weighed = increase / (increase + 1.0) * math.sqrt(scale / (scale + 0.1)) * (width / (length + width)) ** 0.75
    weighed *= (1.0 + n.max() / (100.0 * n.min())) ** 0.25 * n.min() / (n.min() + 0.1 * mean)
    assert found == pytest.approx(evidence * weighed, rel=1e-5, abs=2e-6)
    assert found > 1e-3


@pytest.mark.parametrize("kind", ["random", "chain", "star"])
def test_altitudes_rise_and_all_that_is_connected_merges(kind):
    graph, leaves, _, _ = random_graph(kind, 200, np.random.default_rng(3))
    merges = RegionLinkage().merges(graph, leaves)
    assert (np.diff(merges.altitudes) >= 0).all()
    assert len(np.unique(merges.pairs)) == merges.pairs.size
    again = RegionLinkage().merges(graph, leaves)
    assert again.pairs.tobytes() == merges.pairs.tobytes()


def test_a_plane_is_one_region_before_a_box_is():
    points, truth, viewpoint = two_boxes_on_a_plane()
    result = pcgraph.segment(points, viewpoint=viewpoint)
    assert pcgraph.metrics.segmentation_covering(result.labels, truth) > 0.99
    flat = np.unique(result.supervoxels[(truth == 0) & (np.abs(points[:, 2]) < 1e-9)])
    whole = result.tree.cut(altitude=0.001)
    assert np.bincount(whole[flat]).max() > 0.9 * len(flat)


def test_concavity_parts_what_convexity_joins():
    x, y = (c.ravel() for c in np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 1.0, 0.01)))
    roof = np.stack((x - 0.5, y, 0.3 - 0.8 * np.abs(x - 0.5)), axis=1)
    seen_from = {"above": (0.0, 0.5, 9.0), "below": (0.0, 0.5, -9.0)}
    merged_at = {side: pcgraph.segment(roof, viewpoint=place).tree.altitudes[-1] for side, place in seen_from.items()}
    assert merged_at["below"] > 3 * merged_at["above"]
    assert pcgraph.segment(roof, viewpoint=seen_from["above"]).labels.max() == 0
    assert pcgraph.segment(roof, viewpoint=seen_from["below"]).labels.max() == 1


def test_settings_are_checked():
    with pytest.raises(ValueError, match="gap"):
        RegionLinkage(gap=-1.0)
    with pytest.raises(ValueError, match="BoundaryCost"):
        RegionLinkage(cost=3)


def _two_halves_of_a_plane(colors):
    x, y = (c.ravel() for c in np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 0.5, 0.01)))
    return pcgraph.segment(np.stack((x, y, 0.0 * x), axis=1), colors(x), viewpoint=(0.5, 0.25, 2.0))


def test_colours_part_a_plane_last_but_never_into_objects():
    truth = (np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 0.5, 0.01))[0].ravel() > 0.495).astype(int)
    painted = _two_halves_of_a_plane(lambda x: np.where(x[:, None] > 0.495, (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)))
    assert pcgraph.metrics.segmentation_covering(painted.cut(n=2), truth) > 0.98
    assert painted.labels.max() == 0
    plain = _two_halves_of_a_plane(lambda x: np.full((len(x), 3), 0.4))
    bare = _two_halves_of_a_plane(lambda x: None)
    assert plain.tree.altitudes.tobytes() == bare.tree.altitudes.tobytes()


def test_colour_that_is_noise_changes_no_object():
    points, truth, viewpoint = two_boxes_on_a_plane()
    noise = np.random.default_rng(0).random((len(points), 3))
    result = pcgraph.segment(points, noise, viewpoint=viewpoint)
    assert pcgraph.metrics.segmentation_covering(result.labels, truth) > 0.99
