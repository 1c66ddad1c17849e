# SPDX-License-Identifier: Apache-2.0
"""The adjacency graph: which supervoxels touch, and what edges and nodes know."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.surfaces import SPACING, patch

import pcgraph
from pcgraph.features.moments import moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph.contacts import Contacts, angle_between, edge_features


def wedge(convex: bool):
    """Two square faces that meet at a right angle along the y axis, seen from above the ridge or valley."""
    slope = -1.0 if convex else 1.0
    side = 0.4 / np.sqrt(2.0)
    left = patch((0, 0, 0), (-side, 0, slope * side), (0, 0.4, 0))
    right = patch((SPACING / 2, 0, 0), (side, 0, slope * side), (0, 0.4, 0))
    return pcgraph.segment(np.vstack([left, right]), viewpoint=(0, 0.2, 3.0), voxel_size=0.02, seed_size=0.3)


@pytest.mark.parametrize("convex", [True, False])
def test_sign_of_convexity(convex):
    result = wedge(convex)
    nodes, edges = result.graph.node_features, result.graph.edges
    sides = np.sign(nodes.centroid[:, 0])
    across = sides[edges[:, 0]] != sides[edges[:, 1]]
    big = nodes.size[edges].min(axis=1) > 100
    features = result.graph.edge_features
    assert (across & big).any()
    sign = 1.0 if convex else -1.0
    assert np.all(sign * features.convexity[across & big] > 1.2)
    assert np.all(sign * features.contact_convexity[across & big] > 0.4)
    # Flush faces of one plane bend nowhere.
    assert np.all(np.abs(features.convexity[~across & big]) < 0.3)
    assert result.labels.max() + 1 == (1 if convex else 2)


def test_convexity_does_not_depend_on_which_side_comes_first():
    rng = np.random.default_rng(0)
    m = 20
    normals, places = rng.normal(size=(2, m, 2, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    nodes = node_features(moments_of_groups(rng.normal(size=(8 * m, 3)), None, np.arange(8 * m) % (2 * m), 2 * m))
    edges = np.arange(2 * m, dtype=np.int32).reshape(m, 2)
    voxels = np.ones((m, 2), np.int64)
    there = edge_features(nodes, Contacts(edges, voxels, places, normals, np.ones(m)))
    back = edge_features(
        nodes,
        Contacts(*(np.ascontiguousarray(both[:, ::-1]) for both in (edges, voxels, places, normals)), np.ones(m)),
    )
    for name, column in there.columns().items():
        assert np.array_equal(column, back.columns()[name]), name
    assert (there.convexity > 0.0).any()
    assert (there.contact_convexity < 0.0).any()


def test_small_angles_are_exact():
    a = np.array([[0.0, 0.0, 1.0]])
    b = np.array([[np.sin(1e-9), 0.0, np.cos(1e-9)]])
    assert angle_between(a, b) == pytest.approx(1e-9, rel=1e-6)


def test_edges_are_sorted_unique_and_join_touching_supervoxels(boxes):
    graph = boxes[2].graph
    edges = graph.edges.astype(np.int64)
    assert graph.edges.dtype == np.int32
    assert np.all(edges[:, 0] < edges[:, 1])
    assert np.all(np.diff(edges[:, 0] * graph.n_nodes + edges[:, 1]) > 0)
    for name, column in graph.edge_features.columns().items():
        assert column.shape == (len(edges),), name
        assert np.isfinite(column).all(), name


def test_contact_length_is_the_length_of_the_seam():
    left = patch((0, 0, 1), (0.2, 0, 0), (0, 0.4, 0))
    right = left + np.array([0.21, 0.0, 0.0])
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], len(left), axis=0)
    result = pcgraph.segment(
        np.vstack([left, right]),
        colors,
        voxel_size=0.0199,
        seed_size=0.1,
        method=pcgraph.SurfaceGrowth(color_weight=9.0),
        viewpoint=(0, 0, 0),
    )
    graph = result.graph
    red = graph.node_features.color[:, 0] > 0.5
    across = red[graph.edges[:, 0]] != red[graph.edges[:, 1]]
    assert graph.edge_features.contact_length[across].sum() == pytest.approx(0.4, rel=0.35)  # corners count twice
    assert np.all(graph.edge_features.color_contrast[across] > 0.5)


def test_step_is_the_height_between_parallel_planes():
    height = 0.02
    low = patch((0, 0, 0), (0.3, 0, 0), (0, 0.3, 0))
    high = patch((0.31, 0, height), (0.3, 0, 0), (0, 0.3, 0))
    result = pcgraph.segment(
        np.vstack([low, high]),
        viewpoint=(0.3, 0.15, 3),
        voxel_size=0.025,
        seed_size=0.15,
        method=pcgraph.SurfaceGrowth(spatial_weight=1.0),
    )
    nodes, graph = result.graph.node_features, result.graph
    flat = nodes.residual < 1e-6
    level = nodes.centroid[:, 2] > height / 2
    i, j = graph.edges.T
    across = (level[i] != level[j]) & flat[i] & flat[j]
    assert across.any()
    assert graph.edge_features.step[across] == pytest.approx(height, rel=1e-6)
    level_edges = (level[i] == level[j]) & flat[i] & flat[j]
    assert graph.edge_features.step[level_edges] == pytest.approx(0.0, abs=1e-7)  # voxels are exact to 2**-21


@pytest.mark.filterwarnings("ignore:expected a voxel_size far below")  # one supervoxel each
def test_shape_features_of_a_line_a_square_and_a_cloud():
    def features(points):
        return pcgraph.segment(points, voxel_size=10.0, viewpoint=(0, 0, 50)).graph.node_features

    rng = np.random.default_rng(0)
    line = features(np.linspace((1, 1, 1), (9, 1, 1), 100))
    square = features(rng.random((4000, 2)) @ np.array([[8.0, 0, 0], [0, 8.0, 0]]) + 1.0)
    ball = features(rng.normal(5, 0.5, (4000, 3)))
    assert line.linearity[0] == pytest.approx(1.0)
    assert square.planarity[0] > 0.9
    assert square.normal[0] == pytest.approx([0, 0, 1])
    assert square.residual[0] == pytest.approx(0.0, abs=1e-6)
    assert ball.scattering[0] > 0.9
    assert ball.residual[0] == pytest.approx(0.5, rel=0.1)


def test_given_normals_keep_their_direction():
    points = patch((0, 0, 1), (0.3, 0, 0), (0, 0.3, 0))
    ridge = np.where(points[:, :1] < 0.1523, (-0.6, 0.0, -0.8), (0.6, 0.0, -0.8))
    result = pcgraph.segment(points, normals=ridge, seed_size=0.1, voxel_size=0.02)
    sides = points[:, 0] < 0.1523  # a border between cells
    mixed = [len(np.unique(sides[result.supervoxels == s])) == 2 for s in range(result.graph.n_nodes)]
    assert np.mean(mixed) < 0.3
    assert result.graph.edge_features.contact_convexity.max() > 1.0


def test_networkx_export(boxes):
    graph = boxes[2].graph
    exported = graph.to_networkx()
    assert exported.number_of_nodes() == graph.n_nodes
    assert exported.number_of_edges() == len(graph.edges)
    i, j = graph.edges[3].tolist()
    assert exported.edges[i, j]["contact_length"] == graph.edge_features.contact_length[3]
    assert exported.nodes[i]["size"] == graph.node_features.size[i]
