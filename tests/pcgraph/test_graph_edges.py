# SPDX-License-Identifier: Apache-2.0
"""Contacts against brute force, edge features by hand, and the strength of boundaries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checks import SEEDS
from hypothesis import given, settings
from hypothesis import strategies as st

import pcgraph
from pcgraph.features.moments import moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph.adjacency import EdgeFeatures
from pcgraph.graph.boundary import BoundaryCost, BoundaryStrength
from pcgraph.graph.contacts import Contacts, contacts, edge_features


@given(SEEDS, st.integers(1, 60), st.floats(0.02, 0.9))
@settings(max_examples=30, deadline=None)
def test_contacts_equal_brute_force(seed, n_supervoxels, density):
    rng = np.random.default_rng(seed)
    points = rng.random((int(density * 400) + 1, 3))
    surface = pcgraph.segment(points, voxel_size=0.15, seed_size=0.15, viewpoint=(9, 9, 9), camera=False).surface
    grid = surface.grid
    owners = rng.integers(0, n_supervoxels, grid.n_voxels).astype(np.int32)  # need not be connected for this
    rims: dict[tuple[int, int], set[int]] = {}
    for i in range(grid.n_voxels):
        for j in grid.neighbours[grid.indptr[i] : grid.indptr[i + 1]]:
            if owners[i] != owners[j]:
                rims.setdefault((owners[i], owners[j]), set()).add(i)
    found = contacts(replace(surface, supervoxels=owners))
    expected = sorted((int(i), int(j)) for i, j in rims if i < j)
    assert [tuple(edge) for edge in found.edges.tolist()] == expected
    assert found.edges.dtype == np.int32
    assert found.edges.shape == (len(expected), 2)
    for e, (i, j) in enumerate(expected):
        sides = [sorted(rims[i, j]), sorted(rims[j, i])]
        assert found.voxels[e].tolist() == [len(side) for side in sides]
        length = 0.5 * sum(grid.edge_lengths[side].sum() for side in sides)
        assert abs(found.lengths[e] - length) <= 1e-6 * length
        for side in (0, 1):
            position = grid.centroids[sides[side]].mean(axis=0)
            assert (abs(found.positions[e, side] - position) <= 1e-6 * abs(position)).all()
            total = surface.normals[sides[side]].sum(axis=0)
            normal = total / max(np.linalg.norm(total), 1e-12)
            assert (abs(found.normals[e, side] - normal) <= 1e-9 + 1e-6 * abs(normal)).all()


def test_many_contacts_of_one_supervoxel():
    """A plain in which every voxel but the first supervoxel's own is one of thousands: the table has to grow."""
    x, y = np.meshgrid(np.arange(90.0), np.arange(90.0))
    surface = pcgraph.segment(
        np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size))) + 0.5, voxel_size=1.0, seed_size=30.0,
        viewpoint=(45, 45, 500),
    ).surface  # fmt: skip
    found = contacts(replace(surface, supervoxels=np.arange(8100, dtype=np.int32)))
    assert len(found.edges) == 2 * 90 * 89 + 2 * 89 * 89  # rows, columns, both diagonals
    assert np.all(found.voxels == 1)


def test_edge_features_of_a_hand_drawn_roof_and_gutter():
    """Three faces along x: down to the left, down to the right, then level 0.1 m below; seen from above."""
    root = np.sqrt(0.5)
    normals = np.array([[-root, 0.0, root], [root, 0.0, root], [0.0, 0.0, 1.0]])
    centroids = np.array([[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [3.0, 0.0, -2.1]])
    colors = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.4]])
    nodes = node_features(moments_of_groups(centroids, colors, np.arange(3, dtype=np.int32), 3))
    nodes = replace(nodes, normal=normals)
    rims = np.array([[[0.0, 0, 0], [0.0, 0, 0]], [[2.0, 0, -2.0], [2.0, 0, -2.1]]])
    touching = Contacts(
        np.array([[0, 1], [1, 2]], np.int32), np.array([[3, 4], [5, 5]]), rims, normals[[[0, 1], [1, 2]]],
        np.array([0.35, 0.5]),
    )  # fmt: skip
    edges = edge_features(nodes, touching)
    assert edges.normal_angle == pytest.approx([np.pi / 2, np.pi / 4])
    assert edges.convexity == pytest.approx([np.pi / 2, -np.pi / 4])
    assert edges.contact_convexity == pytest.approx([0.0, -np.pi / 4])  # rims at one place say nothing about a bend
    assert edges.color_contrast == pytest.approx([0.0, 0.5])
    assert edges.contact_voxels.tolist() == [7, 10]
    assert edges.voxel_edge == pytest.approx([0.1, 0.1])
    assert edges.step == pytest.approx([0.0, 0.1 * root])


def some_edges(**columns):
    zeros = dict.fromkeys(("convexity", "contact_convexity", "normal_angle", "color_contrast", "step"), 0.0)
    values = {name: np.atleast_1d(np.asarray(value, float)) for name, value in {**zeros, **columns}.items()}
    m = max(len(value) for value in values.values())
    values = {name: np.broadcast_to(value, m) for name, value in values.items()}
    return EdgeFeatures(**values, contact_voxels=np.full(m, 10), contact_length=np.full(m, 0.05))  # voxels of 1 cm


def test_boundary_strength_by_hand():
    flat = some_edges()
    assert flat.boundary_strength.tolist() == [0.0]
    assert some_edges(convexity=2.0, contact_convexity=1.0).boundary_strength.tolist() == [0.0]
    half = some_edges(convexity=-1.0 / 0.85, contact_convexity=-1.0 / 0.85)
    assert half.boundary_strength == pytest.approx(0.5)
    assert some_edges(step=0.04).boundary_strength == pytest.approx(0.5)  # four voxels
    assert some_edges(step=1e6).boundary_strength == pytest.approx(1.0)
    both = some_edges(convexity=-1.0, contact_convexity=-0.5, step=0.02, normal_angle=1.0, color_contrast=0.4)
    z = 0.85 * 0.75 + 0.25 * 2.0 + 0.1 * 1.0 + 0.05 * 0.4
    assert both.boundary_strength == pytest.approx(1.0 - 2.0 ** -(z**3))
    only_steps = BoundaryStrength(concavity=0.0, step=1.0, normal=0.0, color=0.0)
    assert only_steps(both) == pytest.approx(1.0 - 2.0**-8)


@pytest.mark.parametrize("name", ["convexity", "contact_convexity"])
def test_a_valley_costs_its_angle_and_less_as_it_closes(name):
    angles = np.array([0.0, 0.5, 0.75 * np.pi, 0.9 * np.pi, np.pi])
    assert BoundaryCost()(some_edges(**{name: -angles})) == pytest.approx(
        0.5 * np.array([0.0, 0.5, 0.75 * np.pi, 0.3 * np.pi, 0.0]), abs=1e-6
    )
    assert BoundaryCost()(some_edges(**{name: angles})) == pytest.approx(0.015 * angles, abs=1e-6)


@pytest.mark.parametrize("name", ["convexity", "contact_convexity"])
def test_a_valley_with_room_between_its_sides_costs_its_angle(name):
    closed = {name: np.full(4, -np.pi)}
    steps = np.array([0.0, 0.7, 1.7, 3.0])  # voxels of 1 cm
    of_steps = BoundaryCost()(some_edges(step=0.01 * steps))
    assert BoundaryCost()(some_edges(step=0.01 * steps, **closed)) - of_steps == pytest.approx(
        0.5 * np.array([0.0, 0.0, 3.0, np.pi]), abs=1e-6
    )


unit = st.floats(0.0, 1.0)


@given(st.tuples(unit, unit, unit, unit, unit), st.integers(0, 4), unit)
def test_boundary_strength_rises_with_everything_that_speaks_for_a_boundary(values, which, more):
    scale = np.array([-np.pi, -np.pi, 0.1, np.pi, np.sqrt(3.0)])
    names = ("convexity", "contact_convexity", "step", "normal_angle", "color_contrast")
    rows = np.array([values, values])
    rows[1, which] = min(rows[1, which] + more, 1.0)
    weaker, stronger = some_edges(**dict(zip(names, (rows * scale).T, strict=True))).boundary_strength
    assert 0.0 <= weaker <= stronger <= 1.0


def test_boundaries_between_objects_are_stronger(boxes):
    _, truth, result = boxes
    i, j = result.graph.edges.T
    counts = np.zeros((result.graph.n_nodes, 3))
    np.add.at(counts, (result.supervoxels, truth), 1.0)
    objects = counts.argmax(axis=1)
    pure = (counts.max(axis=1) == counts.sum(axis=1))[result.graph.edges].all(axis=1)
    across = objects[i] != objects[j]
    strength = result.graph.edge_features.boundary_strength
    assert strength[pure & across].mean() > 0.3
    assert strength[pure & ~across].mean() < 0.1
    assert BoundaryCost()(result.graph.edge_features)[pure & across].mean() > 0.4
