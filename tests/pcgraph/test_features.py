# SPDX-License-Identifier: Apache-2.0
"""Features of nodes follow from additive moments, which equal those computed from the points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checks import SEEDS
from hypothesis import given, settings
from hypothesis import strategies as st

import pcgraph
from pcgraph.features.moments import moments_of_groups, moments_up_tree
from pcgraph.features.nodes import node_features
from pcgraph.features.primitives import EXPONENTS, primitive_moments, primitive_moments_up_tree


def clustered_points(rng, n_groups, origin):
    """Points of groups of unlike size and place, metres, with colours, unit normals and group, shuffled."""
    groups = np.concatenate((np.arange(n_groups), rng.integers(0, n_groups, 6 * n_groups))).astype(np.int32)
    rng.shuffle(groups)
    places, sizes = rng.normal(0.0, 2.0, (n_groups, 3)), 10.0 ** rng.uniform(-2.0, 0.0, (n_groups, 3))
    points = places[groups] + sizes[groups] * rng.normal(size=(len(groups), 3)) + origin
    normals = rng.normal(size=points.shape)
    return points, rng.random(points.shape), normals / np.linalg.norm(normals, axis=1, keepdims=True), groups


def random_tree(rng, n_leaves):
    """Parents of a tree whose inner nodes have two or three children, and the leaves below each node."""
    below = [[leaf] for leaf in range(n_leaves)]
    loose, parents = list(range(n_leaves)), []
    while len(loose) > 1:
        children = [loose.pop(rng.integers(len(loose))) for _ in range(min(len(loose), int(rng.integers(2, 4))))]
        parents.append((children, len(below)))
        loose.append(len(below))
        below.append([leaf for child in children for leaf in below[child]])
    up = np.arange(len(below), dtype=np.int32)
    for children, node in parents:
        up[children] = node
    return up, below


trees = given(SEEDS, st.integers(1, 12), st.sampled_from([0.0, 1e6]))


@trees
@settings(max_examples=40, deadline=None)
def test_moments_of_every_node_equal_those_of_its_points(seed, n_leaves, origin):
    rng = np.random.default_rng(seed)
    points, colors, _, groups = clustered_points(rng, n_leaves, origin)
    parents, below = random_tree(rng, n_leaves)
    pooled = moments_up_tree(moments_of_groups(points, colors, groups, n_leaves), parents)
    assert len(pooled) == len(parents)
    for node, leaves in enumerate(below):
        inside = np.isin(groups, leaves)
        centred, shades = points[inside] - points[inside].mean(axis=0), colors[inside] - colors[inside].mean(axis=0)
        size = np.sqrt((centred**2).sum()) + 1e-6
        assert pooled.counts[node] == inside.sum()
        assert np.abs(pooled.centroids[node] - points[inside].mean(axis=0)).max() <= 1e-9 * max(1.0, origin / 1e3)
        assert np.abs(pooled.scatters[node] - centred.T @ centred).max() <= 1e-6 * size**2
        assert np.array_equal(pooled.scatters[node], pooled.scatters[node].T)
        assert pooled.colors[node] == pytest.approx(colors[inside].mean(axis=0), rel=1e-9)
        assert pooled.color_scatters[node] == pytest.approx(shades.T @ shades, rel=1e-6, abs=1e-9)


@trees
@settings(max_examples=40, deadline=None)
def test_fourth_powers_of_every_node_equal_those_of_its_points(seed, n_leaves, origin):
    rng = np.random.default_rng(seed)
    points, _, normals, groups = clustered_points(rng, n_leaves, origin)
    parents, below = random_tree(rng, n_leaves)
    pooled = primitive_moments_up_tree(primitive_moments(points, normals, groups, n_leaves), parents)
    for node, leaves in enumerate(below):
        inside = np.isin(groups, leaves)
        local = (points[inside] - pooled.centers[node]) / pooled.scales[node]
        direct = np.prod(local[:, None, :] ** EXPONENTS, axis=2)
        assert pooled.powers[node] == pytest.approx(direct.sum(axis=0), rel=1e-6, abs=1e-6 * np.abs(direct).sum())
        radius = np.sqrt((local**2).sum(axis=1).mean())
        assert radius == 0.0 or 0.49 < radius <= 1.001  # powers of a group stay near 1, whatever its size
        assert np.abs(pooled.centers[node] - points[inside].mean(axis=0)).max() <= 1e-9 * max(1.0, origin / 1e3)
        assert pooled.normal_sums[node] == pytest.approx(normals[inside].sum(axis=0), abs=1e-9)
        assert pooled.normal_scatters[node] == pytest.approx(normals[inside].T @ normals[inside], abs=1e-9)


def test_moments_keep_their_digits_far_from_the_origin():
    rng = np.random.default_rng(1)
    near = np.round(rng.normal(0.0, 0.01, (500, 3)) * 2.0**30) / 2.0**30  # exact after the shift, too
    groups = np.zeros(500, np.int32)
    at_home, far = (moments_of_groups(near + origin, None, groups, 1) for origin in (0.0, 2.0**20))
    assert far.scatters == pytest.approx(at_home.scatters, rel=1e-12, abs=1e-15)


def test_the_order_of_points_changes_nothing_but_rounding():
    points, colors, normals, groups = clustered_points(np.random.default_rng(5), 6, 1e3)
    order = np.random.default_rng(6).permutation(len(points))
    for once, again in (
        (
            moments_of_groups(points, colors, groups, 6),
            moments_of_groups(points[order], colors[order], groups[order], 6),
        ),
        (
            primitive_moments(points, normals, groups, 6),
            primitive_moments(points[order], normals[order], groups[order], 6),
        ),
    ):
        for name, column in vars(once).items():
            if column is not None:
                assert column == pytest.approx(vars(again)[name], rel=1e-9, abs=1e-9), name


def test_an_outlier_that_comes_first_costs_no_digits():
    rng = np.random.default_rng(2)
    points = np.vstack([[1e6, 0.0, 0.0], rng.normal(0.0, 1e-3, (10_000, 3))])
    scatter = moments_of_groups(points, None, np.zeros(len(points), np.int32), 1).scatters[0]
    centred = points - points.mean(axis=0)
    assert scatter[1:, 1:] == pytest.approx((centred.T @ centred)[1:, 1:], rel=1e-12)


def test_color_covariance_is_that_of_numpy():
    rng = np.random.default_rng(3)
    colors, groups = rng.random((200, 3)), np.repeat([0, 1], 100).astype(np.int32)
    moments = moments_of_groups(rng.random((200, 3)), colors, groups, 2)
    features = node_features(moments)
    for group in (0, 1):
        assert features.color_covariance[group] == pytest.approx(np.cov(colors[groups == group].T, bias=True))
    without = node_features(moments_of_groups(colors, None, groups, 2))
    assert np.isnan(without.color).all()
    assert np.isnan(without.color_covariance).all()


@given(SEEDS, st.floats(-6.0, 0.0), st.floats(-6.0, 0.0))
@settings(max_examples=60, deadline=None)
def test_shape_agrees_with_lapack(seed, second, third):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * [1.0, 10.0**second, 10.0**third] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    features = node_features(moments_of_groups(points, None, np.zeros(30, np.int32), 1))
    s3, s2, s1 = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T, bias=True)), 0.0))
    assert features.residual[0] == pytest.approx(s3, rel=1e-4, abs=3e-8 * s1)  # the root halves the digits
    assert features.linearity[0] == pytest.approx((s1 - s2) / s1, abs=1e-7)
    assert features.planarity[0] == pytest.approx((s2 - s3) / s1, abs=1e-7)
    assert features.linearity + features.planarity + features.scattering == pytest.approx(1.0)
    assert np.linalg.norm(features.normal[0]) == pytest.approx(1.0)


def test_coincident_points_have_no_shape():
    features = node_features(moments_of_groups(np.ones((7, 3)), None, np.zeros(7, np.int32), 1))
    assert features.residual[0] == features.linearity[0] == features.planarity[0] == features.scattering[0] == 0.0
    assert np.linalg.norm(features.normal[0]) == pytest.approx(1.0)


def test_a_line_faces_to_the_outer_side():
    line = np.linspace((1.0, 1.0, 1.0), (9.0, 1.0, 1.0), 100)
    moments = moments_of_groups(line, None, np.zeros(100, np.int32), 1)
    features = node_features(replace(moments, normals=np.array([[0.6, 0.0, 0.3]])))
    assert features.linearity[0] == pytest.approx(1.0)
    assert features.normal[0] == pytest.approx([0.0, 0.0, 1.0])


def test_verticality_of_floor_ramp_and_wall():
    rng = np.random.default_rng(4)
    flat = np.column_stack((rng.random((50, 2)), np.zeros(50)))
    ramp = flat @ np.array([[np.cos(np.pi / 3), 0, np.sin(np.pi / 3)], [0, 1, 0], [0, 0, 1]])
    groups = np.repeat([0, 1, 2], 50).astype(np.int32)
    moments = moments_of_groups(np.vstack([flat, ramp, flat[:, [0, 2, 1]]]), None, groups, 3)
    features = node_features(moments)
    assert features.verticality() == pytest.approx([0.0, 0.5, 1.0], abs=1e-12)
    assert features.verticality((0.0, -1e200, 0.0)) == pytest.approx([1.0, 1.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("up", [(0, 0, 0), (0, 1), (0, np.nan, 1)])
def test_verticality_needs_a_direction(up):
    features = node_features(moments_of_groups(np.eye(3), None, np.zeros(3, np.int32), 1))
    with pytest.raises(ValueError, match="expected up"):
        features.verticality(up)


def test_deviations_are_the_roots_of_lapacks_eigenvalues(boxes):
    tree = boxes[2].tree
    nodes = tree.features()
    expected = np.sqrt(np.maximum(np.linalg.eigvalsh(nodes.covariance), 0.0))
    assert nodes.deviations == pytest.approx(expected, rel=1e-9, abs=1e-7)
    squares = np.linalg.eigvalsh(tree.moments.scatters)[:, 0]
    assert pcgraph.plane_energy(tree).data == pytest.approx(np.maximum(squares, 0.0), rel=1e-6, abs=1e-9)
