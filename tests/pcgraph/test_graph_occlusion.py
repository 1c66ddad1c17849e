# SPDX-License-Identifier: Apache-2.0
"""Occlusion edges: what hides what, by how much, along which rim, and what goes on behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checks import SEEDS
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.images import PLATE_SHAPE, ball_before_a_wall, plate_before_a_wall
from scenes.rays import pinhole

import pcgraph
from pcgraph.features.moments import moments_of_groups
from pcgraph.features.nodes import node_features
from pcgraph.graph.occlusion import occlusions, spherical_image, view_from
from pcgraph.voxels.surface import Surface

RAYS = pinhole(PLATE_SHAPE, 150.0)


def pixels(result, points):
    """Voxel of each pixel, -1 where there is no point."""
    image = np.full(points.shape[:2], -1, np.int32)
    image[np.isfinite(points).all(axis=2)] = result.surface.grid.voxel_of_point
    return image


def segmented(points, **options):
    return pcgraph.segment(points, voxel_size=0.02, seed_size=0.1, viewpoint=(0, 0, 0), **options)


def occluded(result, image=None, **options):
    return occlusions(result.surface, result.graph.node_features, result.viewpoint, image, **options)


@pytest.mark.parametrize("organised", [True, False])
@pytest.mark.parametrize("camera", [True, False])
def test_a_plate_before_a_wall(organised, camera):
    points = plate_before_a_wall()
    result = segmented(points, camera=camera)
    found = occluded(result, pixels(result, points) if organised else None)
    nodes = result.graph.node_features
    depth = nodes.centroid[:, 2]
    assert len(found.pairs) > 8
    assert depth[found.pairs[:, 0]] == pytest.approx(1.0, abs=1e-6)
    assert depth[found.pairs[:, 1]] == pytest.approx(2.0, abs=1e-6)
    # Along a ray off the axis the gap of 1 m grows by the secant, 1.04 at the corners; so it does with the half cell.
    assert np.all((found.gap > 0.97) & (found.gap < 1.1))
    assert found.length.sum() == pytest.approx(1.6, rel=0.4)  # the outline, counted in voxels
    assert not {*map(tuple, found.pairs.tolist())} & {*map(tuple, result.graph.edges.tolist())}
    # Outwards from the middle of the plate, square to the line of sight.
    outwards = np.einsum("ij,ij->i", found.direction, nodes.centroid[found.pairs[:, 0]] * [1.0, 1.0, 0.0])
    assert np.sum(found.length[outwards > 0.0]) > 0.9 * np.sum(found.length)  # the rest are corners
    assert np.linalg.norm(found.direction, axis=1) == pytest.approx(1.0)
    assert np.all(np.abs(found.direction[:, 2]) < 0.3)
    assert list(found.columns()) == ["gap", "length", "direction"]


@pytest.mark.parametrize("organised", [True, False])
def test_the_wall_goes_on_behind_the_plate(organised):
    points = plate_before_a_wall()
    result = segmented(points)
    behind = occluded(result, pixels(result, points) if organised else None).continuations
    assert len(behind.pairs) > 8
    assert np.all(behind.pairs[:, 0] < behind.pairs[:, 1])
    assert result.graph.node_features.centroid[behind.pairs.ravel(), 2] == pytest.approx(2.0, abs=1e-6)
    assert behind.coplanar.all()
    assert behind.angle == pytest.approx(0.0, abs=1e-6)
    assert behind.offset == pytest.approx(0.0, abs=1e-6)
    assert np.all((behind.width > 0.7) & (behind.width < 1.0))  # the shadow of 0.4 m at twice the distance
    centroid = result.graph.node_features.centroid
    sides = np.abs(centroid[behind.pairs[:, 1]] - centroid[behind.pairs[:, 0]])
    assert np.all(sides[:, :2].max(axis=1) > 0.7)  # from one side of the plate to the other


def test_a_wall_that_jumps_behind_the_plate_does_not_go_on():
    points = plate_before_a_wall()
    right = (points[..., 0] > 0.0) & (points[..., 2] > 1.5)
    points[right] *= 1.5
    result = segmented(points)
    depth = result.graph.node_features.centroid[:, 2]
    behind = occluded(result).continuations
    across = np.abs(np.diff(depth[behind.pairs], axis=1)[:, 0]) > 0.5
    assert across.any()
    assert not behind.coplanar[across].any()
    assert np.all(behind.offset[across] > 0.9)


@pytest.mark.parametrize("band", [0, 6, 40])
def test_looks_across_the_shadow_of_the_projector_but_not_across_everything(band):
    points = plate_before_a_wall()
    front = points[..., 2] < 1.5
    shadow = np.zeros_like(front)
    for step in range(1, band + 1):  # pixels; to the left of the plate
        shadow |= np.roll(front, -step, axis=1) & ~front
    points[shadow] = np.nan
    result = segmented(points)
    nodes = result.graph.node_features
    found = occluded(result)
    left, right = (found.length[sign * found.direction[:, 0] > 0.9].sum() for sign in (-1.0, 1.0))
    assert right == pytest.approx(0.4, rel=0.3)
    assert left == pytest.approx(0.4, rel=0.3) if band < 40 else left < 0.05  # but for the corners
    assert np.all(nodes.centroid[found.pairs[:, 0], 2] < 1.5)


@pytest.mark.parametrize("organised", [True, False])
def test_a_floor_seen_at_a_slant_hides_nothing(organised):
    points = RAYS.copy()
    points *= (1.0 / np.maximum(points[..., 1] + 0.05 * points[..., 2], 0.02))[..., None]  # y + z / 20 = 1 m below
    points[points[..., 2] > 2.5] = np.nan  # farther away pixels lie further apart than voxels
    result = pcgraph.segment(points, voxel_size=0.04, seed_size=0.2)
    assert result.graph.n_nodes > 20
    found = occluded(result, pixels(result, points) if organised else None)
    assert len(found.pairs) == 0
    assert len(found.continuations.pairs) == 0
    assert found.gap.dtype == found.length.dtype == np.float64
    assert found.direction.shape == (0, 3)


def test_a_crease_hides_nothing():
    points = RAYS.copy()
    points *= (1.5 / (1.0 + 0.6 * np.abs(points[..., 0])))[..., None]  # two walls that meet in a ridge
    assert len(occluded(segmented(points)).pairs) == 0


def test_a_ball_before_a_wall():
    result = segmented(ball_before_a_wall())
    ball = result.graph.node_features.centroid[:, 2] < 1.5
    found = occluded(result)
    assert len(found.pairs) > 5
    assert ball[found.pairs[:, 0]].all()
    assert not ball[found.pairs[:, 1]].any()


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.0, 3.0])
def test_a_panorama_has_no_seam(turn):
    """A pillar of 0.3 m before the round wall of a room, wherever it stands."""
    rng = np.random.default_rng(0)
    azimuth = np.repeat(np.linspace(0.0, 2.0 * np.pi, 600, endpoint=False), 60)
    rise = np.tile(np.linspace(-0.4, 0.4, 60), 600)
    pillar = np.abs(azimuth - np.pi) < 0.15
    distance = np.where(pillar, 1.0, 3.0) * (1.0 + 1e-6 * rng.random(len(azimuth)))
    angle = azimuth + turn
    points = np.column_stack((np.cos(angle), np.sin(angle), rise)) * distance[:, None]
    result = pcgraph.segment(points, viewpoint=(0, 0, 0), voxel_size=0.06, seed_size=0.5)
    image = spherical_image(view_from(result.viewpoint, result.surface))
    assert image.wraps
    assert np.mean(image.voxels >= 0) > 0.9
    near = np.hypot(*result.graph.node_features.centroid[:, :2].T) < 2.0
    found = occluded(result)
    assert near[found.pairs[:, 0]].all()
    assert not near[found.pairs[:, 1]].any()
    assert found.length.sum() == pytest.approx(
        2 * 0.8, rel=0.4
    )  # both sides of the pillar, 0.8 m high, aslant to voxels
    assert found.gap == pytest.approx(2.0, abs=0.3)


def test_both_kinds_of_image_and_any_order_of_points_agree():
    points = plate_before_a_wall()
    result = segmented(points, camera=False)
    shuffled = segmented(np.random.default_rng(1).permutation(points.reshape(-1, 3)), camera=False)
    once, again = occluded(result), occluded(shuffled)
    assert np.array_equal(once.pairs, again.pairs)
    assert once.gap == pytest.approx(again.gap, rel=1e-9)
    assert np.array_equal(once.continuations.pairs, again.continuations.pairs)
    by_pixel = {*map(tuple, occluded(result, pixels(result, points)).pairs.tolist())}
    by_voxel = {*map(tuple, once.pairs.tolist())}
    assert len(by_pixel & by_voxel) > 0.7 * len(by_pixel | by_voxel)


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((5, 3)), np.outer(np.arange(9.0), [0.0, 0.0, 1.0])])
def test_degenerate_clouds_hide_nothing(points):
    result = pcgraph.segment(points, viewpoint=(0, 0, 0), voxel_size=0.1)
    assert len(occluded(result).pairs) == 0


@given(SEEDS, st.integers(1, 400), st.floats(-6.0, 6.0), st.floats(0.01, 0.5), st.booleans())
@settings(max_examples=40, deadline=None)
@pytest.mark.filterwarnings("ignore::pcgraph.CloudWarning")  # a place may lie within a voxel
def test_any_cloud_from_anywhere(seed, n, exponent, voxel, inside):
    rng = np.random.default_rng(seed)
    scale = 10.0**exponent
    viewpoint = scale * (rng.random(3) + (0.0 if inside else 1.5))
    result = pcgraph.segment(scale * rng.random((n, 3)), viewpoint=viewpoint, voxel_size=scale * voxel)
    found = occluded(result)
    behind = found.continuations
    for pairs in (found.pairs, behind.pairs):
        assert pairs.shape[1:] == (2,)
        assert np.all((pairs >= 0) & (pairs < result.graph.n_nodes))
        assert np.all(pairs[:, 0] != pairs[:, 1])
        keys = pairs[:, 0].astype(np.int64) * result.graph.n_nodes + pairs[:, 1]
        assert np.all(np.diff(keys) > 0)
    assert np.all(found.gap >= 3.0 * scale * voxel * (1.0 - 1e-9))
    assert np.all(found.length >= scale * voxel * (1.0 - 1e-9))
    for column in (found.gap, found.length, found.direction, behind.width, behind.angle, behind.offset):
        assert np.isfinite(column).all()
    assert np.all(behind.crossings > 0)


def test_the_nearest_voxel_is_seen():
    points = np.vstack([plate_before_a_wall().reshape(-1, 3), 2.5 * RAYS.reshape(-1, 3)])  # a second, hidden wall
    result = pcgraph.segment(points, viewpoint=(0, 0, 0), voxel_size=0.02, seed_size=0.1)
    image = spherical_image(view_from(result.viewpoint, result.surface))
    depth = result.surface.grid.centroids[image.voxels[image.voxels >= 0], 2]
    assert np.mean(depth > 2.25) < 0.02


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"viewpoint": (0, 0)}, "viewpoint"),
        ({"viewpoint": (0, 0, np.nan)}, "viewpoint"),
        ({"reach": 0.0}, "reach"),
        ({"least_gap": np.inf}, "least_gap"),
        ({"image": np.zeros((2, 2))}, "image as"),
        ({"image": np.full((2, 2), 10**6)}, "image with voxels"),
    ],
)
def test_wrong_arguments_are_refused(boxes, wrong, message):
    result = boxes[2]
    arguments = {"viewpoint": (0, 0, 0), **wrong}
    with pytest.raises(ValueError, match=message):
        occlusions(result.surface, result.graph.node_features, **arguments)


def drawn(places, image, **options):
    """Occlusions between lone voxels of 5 cm at these places (x, z), metres, that face the origin, in this image."""
    points = np.array([(x, 0.01, z) for x, z in places])
    grid = pcgraph.segment(
        points, viewpoint=(0, 0, 0), voxel_size=0.05, seed_size=0.05, normals=np.tile([0, 0, -1.0], (len(points), 1))
    ).surface.grid
    owners = np.arange(len(points), dtype=np.int32)
    assert np.array_equal(grid.voxel_of_point, owners)  # voxels are in the order of their coordinates
    facing = np.tile([0.0, 0.0, -1.0], (len(points), 1))
    nodes = node_features(replace(moments_of_groups(grid.centroids, None, owners, len(points)), normals=facing))
    surface = Surface(grid, facing, owners)
    return occlusions(surface, nodes, (0, 0, 0), np.array(image), **options)


def test_a_row_of_near_and_far():
    found = drawn([(-0.2, 1.0), (-0.2, 2.0), (0.01, 1.0), (0.2, 2.0), (0.4, 2.0)], [[0, 1, 2, -1, 3, 4]], reach=20.0)
    assert found.pairs.tolist() == [[0, 1], [2, 1], [2, 3]]
    far, near, middle = np.hypot(0.2, 2.0), np.hypot(0.2, 1.0), 1.0
    assert found.gap == pytest.approx([far - near, far - middle, far - middle], abs=1e-4)
    assert found.length == pytest.approx(0.05)
    assert found.continuations.pairs.tolist() == [[1, 3]]
    assert found.continuations.width == pytest.approx(0.4)
    assert found.continuations.crossings.tolist() == [1]
    assert found.continuations.coplanar.all()


def test_things_in_front_of_things_nest_like_brackets():
    """A wall, before it a box, before that a stick: the box goes on behind the stick, the wall behind both."""
    places = [(-0.3, 3.0), (-0.2, 2.0), (0.01, 1.0), (0.2, 2.0), (0.6, 3.0)]
    found = drawn(places, [[0, 1, 2, 3, 4]], reach=30.0)
    assert found.pairs.tolist() == [[1, 0], [2, 1], [2, 3], [3, 4]]
    assert found.continuations.pairs.tolist() == [[0, 4], [1, 3]]


def test_a_hole_ends_all_hiding():
    """What vanished does not come out again beyond a gap wider than the reach: too much may have happened there."""
    places = [(-1.0, 2.0), (-0.4, 1.0), (0.6, 1.0), (1.4, 2.0)]
    assert drawn(places, [[0, 1, 2, 3]], reach=30.0).continuations.pairs.tolist() == [[0, 3]]
    assert len(drawn(places, [[0, 1, 2, 3]], reach=8.0).pairs) == 2
    assert len(drawn(places, [[0, 1, 2, 3]], reach=8.0).continuations.pairs) == 0


def test_what_touches_is_not_apart():
    assert len(drawn([(0.01, 1.01), (0.06, 1.06)], [[0, 1]], least_gap=0.5).pairs) == 0
    assert drawn([(0.01, 1.01), (0.06, 1.11)], [[0, 1]], least_gap=0.5).pairs.tolist() == [[0, 1]]
