# SPDX-License-Identifier: Apache-2.0
"""Surfaces that go on behind what hides them are one object; those that end in the open are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checks import objects_of
from scenes.images import before_a_wall
from scenes.rooms import cabinet_from_wall_to_wall

import pcgraph
from pcgraph.graph.continuations import continuations, faces_of
from pcgraph.tree.tree import segmentation_tree

PILLAR = (-0.1, 0.1, -2.0, 2.0, 1.0)
BOARDS = [(-0.9, -0.2, -2.0, 2.0, 2.0), (0.2, 0.9, -2.0, 2.0, 2.0)]


@pytest.mark.parametrize("organised", [True, False])
def test_a_wall_behind_a_pillar_is_one_object(organised):
    points, thing = before_a_wall([PILLAR], 2.0)
    if not organised:
        points, thing = points.reshape(-1, 3), thing.ravel()
    result = pcgraph.segment(points, viewpoint=(0, 0, 0))
    assert len(objects_of(result.labels, thing, -1)) == 1
    assert len(objects_of(result.labels, thing, 0)) == 1
    assert not objects_of(result.labels, thing, -1) & objects_of(result.labels, thing, 0)
    without = replace(result.graph, continuations=None)
    tree = segmentation_tree(result.linkage.merges(without, result.leaves), result.leaves)
    apart = result.on_points(tree.cut(altitude=result.object_altitude))
    assert len(objects_of(apart, thing, -1)) == 2
    assert len(set(result.groups[thing == -1].tolist())) == 1


def test_pairs_are_coplanar_and_neither_touch_nor_nearly_do():
    points, _ = before_a_wall([PILLAR], 2.0)
    result = pcgraph.segment(points)
    graph, found = result.graph, result.graph.continuations
    x, _, depth = graph.node_features.centroid.T
    assert len(found.pairs) > 4
    assert depth[found.pairs] == pytest.approx(2.0, abs=1e-6)
    assert (np.prod(np.sign(x[found.pairs]), axis=1) < 0).all()
    assert found.coplanar.all()
    assert (found.crossings >= 2).all()
    assert found.width == pytest.approx(0.4, abs=0.1)  # the shadow of 0.2 m at twice the distance
    pairs = [tuple(pair) for pair in found.pairs.tolist()]
    assert pairs == sorted(set(pairs))
    assert all(i < j for i, j in pairs)
    assert not set(pairs) & {tuple(pair) for pair in np.concatenate((graph.edges, graph.gaps.edges)).tolist()}
    assert len(graph.joined) == len(graph.edges) + len(graph.gaps.edges) + len(pairs)


def test_a_surface_that_jumps_behind_the_pillar_does_not_go_on():
    points, thing = before_a_wall([PILLAR, (-2.0, 0.0, -2.0, 2.0, 1.8)], 2.0)
    result = pcgraph.segment(points)
    assert not len(result.graph.continuations.pairs)
    assert not objects_of(result.labels, thing, -1) & objects_of(result.labels, thing, 1)


@pytest.mark.parametrize(("noise", "one"), [(0.0, False), (0.001, False), (0.02, True)])
def test_a_surface_goes_on_if_it_lies_no_farther_off_behind_the_pillar_than_its_noise_leaves_open(noise, one):
    points, thing = before_a_wall([PILLAR], 2.0)
    depth = points[..., 2] + np.where((thing < 0) & (points[..., 0] > 0), 0.04, 0.0)  # metres, less than a voxel
    depth += noise * np.random.default_rng(0).standard_normal(depth.shape)
    result = pcgraph.segment(points * (depth / points[..., 2])[..., None])
    left, right = (
        objects_of(np.where(side, result.labels, -1), thing, -1) for side in (points[..., 0] < 0, points[..., 0] > 0)
    )
    assert bool(left & right) == one


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("tilt", "one"), [(0.0, True), (0.05, True), (0.15, False)])
def test_a_noisy_piece_behind_the_pillar_may_lean_a_little_as_on_a_bent_wall(seed, tilt, one):
    """If it leans by 0.05 rad, its plane misses the middle of the wall, 1.5 m away, by more than a voxel edge."""
    points, thing = before_a_wall([(0.4, 0.5, -2.0, 2.0, 1.0)], 2.0)
    behind = points[..., 0] > 0.9  # metres, right of the middle of the pillar's shadow
    depth = points[..., 2] + np.where((thing < 0) & behind, tilt * (points[..., 0] - 0.9), 0.0)
    depth += 0.01 * np.random.default_rng(seed).standard_normal(depth.shape)
    result = pcgraph.segment(points * (depth / points[..., 2])[..., None])
    left, right = (objects_of(np.where(side, result.labels, -1), thing, -1) for side in (~behind, behind))
    assert bool(left & right) == one


@pytest.mark.parametrize("back", [4.0, np.inf])
def test_boards_in_one_plane_end_in_the_open_though_something_stands_before_a_part_of_the_gap(back):
    """A pole a third as high as the boards hides their borders along a few lines; the other lines see past them."""
    fronts = [*BOARDS, (-0.16, 0.16, -0.15, 0.15, 1.0)]
    points, thing = before_a_wall(fronts, back)
    result = pcgraph.segment(points)
    assert not objects_of(result.labels, thing, 0) & objects_of(result.labels, thing, 1)
    x, _, depth = np.moveaxis(result.graph.node_features.centroid[result.graph.continuations.pairs], -1, 0)
    x = x[depth[:, 0] < 2.1]
    assert (np.prod(np.sign(x), axis=1) > 0).all()  # a board goes on behind the pole, above and below it


@pytest.mark.parametrize(("width", "one"), [(1.2, True), (0.35, False)])
def test_of_boards_whose_gap_is_hidden_all_along_only_wide_ones_are_one(width, one):
    """Nothing tells them from a wall behind a pillar; narrow ones are more likely things in a row."""
    boards = [(-0.2 - width, -0.2, -2.0, 2.0, 2.0), (0.2, 0.2 + width, -2.0, 2.0, 2.0)]
    points, thing = before_a_wall([*boards, (-0.16, 0.16, -2.0, 2.0, 1.0)], np.inf)
    result = pcgraph.segment(points)
    assert (objects_of(result.labels, thing, 0) == objects_of(result.labels, thing, 1)) is one


@pytest.mark.parametrize(("beside", "one"), [(0.0, True), (1.5, False)])
def test_what_one_of_the_places_sees_past_is_no_gap_in_the_data(beside, one):
    """Half of the points were seen from another place: the same, or one that sees between the boards."""
    boards = [(-1.4, -0.2, -2.0, 2.0, 2.0), (0.2, 1.4, -2.0, 2.0, 2.0)]
    points, thing = before_a_wall([*boards, (-0.16, 0.16, -2.0, 2.0, 1.0)], np.inf)
    places = np.zeros_like(points)
    places[1::2, :, 0] = beside
    result = pcgraph.segment(points, viewpoint=places)
    assert (objects_of(result.labels, thing, 0) == objects_of(result.labels, thing, 1)) is one


@pytest.mark.parametrize("seed", range(3))
def test_a_floor_under_a_cabinet_is_one_object_though_nobody_says_from_where_it_was_seen(seed):
    points, truth = cabinet_from_wall_to_wall(seed)
    result = pcgraph.segment(points)
    assert len(result.graph.continuations.pairs) > 1
    assert len(objects_of(result.labels, truth, 0)) == 1
    assert len(objects_of(result.labels, truth, 1)) == 1
    assert pcgraph.metrics.weighted_overlap(result.labels, truth) > 0.97


def test_order_of_points_changes_nothing():
    points, _ = cabinet_from_wall_to_wall(0)
    order = np.random.default_rng(1).permutation(len(points))
    one, other = pcgraph.segment(points), pcgraph.segment(points[order])
    assert np.array_equal(one.graph.continuations.pairs, other.graph.continuations.pairs)
    assert np.array_equal(one.labels[order], other.labels)


def test_of_many_voxels_some_tell_the_same():
    """Of more than 30 000 every third is looked at, of more than 100 000 every seventh."""
    points, truth = cabinet_from_wall_to_wall(0, spacing=0.007)
    for voxel in (0.05, 0.025, 0.012):
        result = pcgraph.segment(points, voxel_size=voxel, seed_size=0.25)
        assert len(objects_of(result.labels, truth, 0)) == 1
        assert len(objects_of(result.labels, truth, 1)) == 1
    assert result.surface.grid.n_voxels > 100_000


def test_no_place_and_a_place_on_a_point_find_what_there_is():
    points, _ = before_a_wall([PILLAR], 2.0)
    result = pcgraph.segment(points)
    surface, nodes = result.surface, result.graph.node_features
    faces = faces_of(result.graph.edges, result.graph.edge_features, result.graph.n_nodes)
    on_a_point = continuations(surface, nodes, faces, result.acquisition, surface.grid.centroids[:1])
    assert on_a_point.pairs.shape[1] == 2
    single = pcgraph.segment(np.zeros((1, 3)), viewpoint=(0, 0, 0), voxel_size=0.1)
    assert single.graph.continuations.pairs.shape == (0, 2)


def test_several_viewpoints_and_an_update_look_from_some_of_them():
    points, thing = before_a_wall([PILLAR], 2.0)
    places = np.zeros_like(points)
    result = pcgraph.segment(points, viewpoint=places)
    assert len(objects_of(result.labels, thing, -1)) == 1
    after = pcgraph.update(result, points + np.array([0.0, 0.001, 0.0]), viewpoint=(0, 0, 0))
    assert len(objects_of(after.labels, thing, -1)) == 1


def test_a_pillar_at_the_seam_of_a_panorama_hides_as_any_other():
    """The image's seam lies behind the middle of the view; a pillar there was paired with nothing."""
    n = 720
    azimuth, elevation = np.meshgrid(np.arange(n) * 2.0 * np.pi / n, np.linspace(-0.4, 0.4, 92))
    found = []
    for turn in np.radians([0.0, 90.0, 180.0, 270.0]):
        angle = azimuth - turn
        pillar = np.abs(np.mod(angle + np.pi, 2.0 * np.pi) - np.pi) < 0.1
        wall = 3.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))  # a room of 6 m around
        away = np.where(pillar, 1.5, wall)
        x, y, z = away * np.cos(azimuth), away * np.sin(azimuth), away * np.tan(elevation)
        points = np.stack((x, y, z), axis=-1).reshape(-1, 3)
        result = pcgraph.segment(points, voxel_size=0.05, viewpoint=(0.0, 0.0, 0.0), range_growth=0.0)
        found.append(len(result.graph.continuations.pairs))
    assert min(found) > 4, found


def test_viewpoints_of_points_are_those_given_and_no_means_of_them():
    """Two scanners on either side of a wall see each its own pillar before it; between them stands nobody."""
    rng = np.random.default_rng(0)
    clouds, viewpoints = [], []
    for side in (-1.0, 1.0):
        points = before_a_wall([PILLAR], 2.0)[0].reshape(-1, 3)[:, [0, 2, 1]] * [1.0, side, 1.0]  # y is along the view
        clouds.append(points + np.array([0.0, -2.02 * side, 0.0]) + rng.normal(0.0, 5e-4, points.shape))
        viewpoints.append(np.tile([0.0, -2.02 * side, 0.0], (len(points), 1)))
    points, places = np.concatenate(clouds), np.concatenate(viewpoints)
    result = pcgraph.segment(points, viewpoint=places)
    y = result.graph.node_features.centroid[result.graph.continuations.pairs, 1]
    assert (np.abs(y) < 0.1).all()
    assert (y < 0).any()
    assert (y > 0).any()


def test_a_voxel_at_the_viewpoint_lies_in_no_direction_and_nothing_is_warned_of():
    """Voxels as large as a planet: what has no range is not divided by it."""
    points = np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0], [9, 9, 0], [0, 0, 9]]) * 1e9
    result = pcgraph.segment(points, viewpoint=(0.0, 0.0, 0.0), voxel_size=1e9, range_growth=0.0)
    assert result.graph.continuations.pairs.shape == (0, 2)
