# SPDX-License-Identifier: Apache-2.0
"""Planes and objects of scenes with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from clouds import VIEWPOINT, box, patch, two_boxes_on_a_plane
from scipy.spatial.transform import Rotation
from simulated_rooms import CLASSES, room

import pcgraph
from pcgraph.detection import find_planes, object_labels, objects_on
from pcgraph.detection.bends import bends
from pcgraph.detection.flat_leaves import FlatLeaves
from pcgraph.detection.noise import surface_noise
from pcgraph.detection.regions import moments_of_regions
from pcgraph.features.moments import Moments, moments_of_groups
from pcgraph.learning import leaf_descriptors


def sphere(radius, n):
    height = np.linspace(-0.2, 1.0, n)
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    around = np.sqrt(1 - height**2)
    return radius * np.column_stack((around * np.cos(turn), around * np.sin(turn), height))


@pytest.fixture(scope="module")
def scenes():
    """Four simulated rooms with their segmentations and planes."""
    rooms = [room(seed) for seed in range(4)]
    results = [pcgraph.segment(r.points, r.colors) for r in rooms]
    return [(r, s, find_planes(s, up=r.up)) for r, s in zip(rooms, results, strict=True)]


def test_the_ground_and_the_faces_of_boxes_are_found(boxes):
    points, _, result = boxes
    planes = find_planes(result)
    # A supervoxel at the foot of a box may hold a few of its points.
    assert planes.normals[0] == pytest.approx([0, 0, 1], abs=1e-4)
    assert planes.offsets[0] == pytest.approx(0, abs=1e-4)
    assert planes.residuals[0] == pytest.approx(0, abs=5e-4)
    assert planes.up == pytest.approx(planes.normals[0])
    assert planes.corners[0, :, :2].min(axis=0) == pytest.approx([0, 0], abs=result.voxel_size)
    assert planes.corners[0, :, :2].max(axis=0) == pytest.approx([1.6, 1.2], abs=result.voxel_size)
    assert planes.areas[0] == pytest.approx(1.6 * 1.2 - 0.3 * 0.48 - 0.25 * 0.4, rel=0.1)
    planes = find_planes(result, min_area=0.04)
    tops = np.flatnonzero(planes.roles == "horizontal")[1:]
    assert sorted(planes.offsets[tops]) == pytest.approx([0.25, 0.3], abs=0.002)
    assert (planes.roles == "vertical").sum() >= 4
    on_ground = result.on_points(planes.plane_of_supervoxel) == 0
    assert np.mean(points[on_ground, 2] == 0) > 0.995


def test_planes_hold_their_points_and_nothing_is_lost(boxes):
    points, _, result = boxes
    planes = find_planes(result)
    labels = result.on_points(planes.plane_of_supervoxel)
    assert planes.counts.tolist() == np.bincount(labels[labels >= 0]).tolist()
    distances = planes.distances(points)
    for i in range(len(planes)):
        assert np.sqrt((distances[labels == i, i] ** 2).mean()) == pytest.approx(planes.residuals[i], abs=1e-9)
        assert np.array_equal(planes.supervoxels(i), np.unique(result.supervoxels[labels == i]))
        assert points[labels == i].mean(axis=0) == pytest.approx(planes.centroids[i])


def test_objects_on_the_ground_stand_in_their_boxes(boxes):
    points, truth, result = boxes
    found = objects_on(result, points=points)
    assert len(found) == 2
    labels = object_labels(result, found)
    for thing, size, x, y in zip(found, (0.3, 0.25), (0.3, 1.0), (0.4, 0.5), strict=True):
        # A supervoxel at its foot may hold some ground, up to a voxel (0.035) wide.
        assert thing.box.size == pytest.approx([size] * 3, abs=0.045)
        assert thing.box.center == pytest.approx([x + size / 2, y + size / 2, size / 2], abs=0.03)
        assert thing.height == pytest.approx(size, abs=1e-4)
        assert thing.free_box.volume == pytest.approx(size**3, rel=0.3)
        assert thing.shape.kind == "box"
    for k, number in ((0, 1), (1, 2)):
        both = ((labels == k) & (truth == number)).sum()
        assert both / ((labels == k) | (truth == number)).sum() > 0.9


def test_a_scan_of_bare_table_takes_no_object_away():
    """Two boxes that touch, of different height; only `Segmentation.objects` knows them after a scan without them."""
    low, high = box(0.4, 0.3, 0.2), box(0.6, 0.3, 0.2) * [1, 1, 1.5]
    table = patch((0, 0, 0), (1.2, 0, 0), (0, 0.8, 0))
    table = table[~((table[:, 0] > 0.39) & (table[:, 0] < 0.81) & (table[:, 1] > 0.29))]
    first = pcgraph.segment(np.vstack((table, low, high)), viewpoint=VIEWPOINT)
    before = objects_on(first)
    assert len(before) == 2
    second = pcgraph.update(first, table[table[:, 0] < 0.2], viewpoint=VIEWPOINT)
    after = objects_on(second)
    assert [thing.count for thing in after] == [thing.count for thing in before]
    whole, one_scan = leaf_descriptors(second), leaf_descriptors(first)
    at = [i for i, name in enumerate(whole[1]) if name == "segment: length"]
    things = np.concatenate([thing.supervoxels for thing in after])
    assert whole[0][things][:, at] == pytest.approx(one_scan[0][things][:, at])


def test_rigid_motion_moves_the_answer_along(boxes):
    points, _, result = boxes
    turn, shift = Rotation.from_rotvec([0.4, -0.8, 1.3]).as_matrix(), np.array([3.0, -7.0, 2.0])
    moved = pcgraph.segment(points @ turn.T + shift, viewpoint=turn @ VIEWPOINT + shift)
    here, there = find_planes(result), find_planes(moved)
    assert there.normals[0] == pytest.approx(turn @ here.normals[0], abs=1e-4)
    assert there.offsets[0] == pytest.approx(here.offsets[0] + there.normals[0] @ shift, abs=1e-4)
    assert there.areas[0] == pytest.approx(here.areas[0], rel=0.05)
    ours = objects_on(result, points=points)
    theirs = objects_on(moved, points=points @ turn.T + shift)
    assert len(theirs) == len(ours) == 2
    for a, b in zip(ours, theirs, strict=True):  # the voxels lie differently, so rims may change hands
        assert b.box.center == pytest.approx(turn @ a.box.center + shift, abs=0.03)
        assert b.box.size == pytest.approx(a.box.size, abs=0.045)
        assert b.shape.kind == a.shape.kind


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_there_is_no_plane_on_a_sphere(noise):
    points = sphere(0.3, 20000)
    points = points * (1 + noise * np.random.default_rng(0).normal(size=(len(points), 1)))
    result = pcgraph.segment(points, viewpoint=(0, 0, 3), voxel_size=0.012)
    planes = find_planes(result)
    assert len(planes) == 0
    assert planes.normals.shape == (0, 3)
    assert planes.corners.shape == (0, 4, 3)
    assert planes.offsets.shape == planes.roles.shape == (0,)
    assert planes.distances(points).shape == (len(points), 0)
    assert planes.supervoxels(0).shape == (0,)
    assert np.all(planes.plane_of_supervoxel == -1)
    assert objects_on(result) == []
    assert np.all(object_labels(result, []) == -1)


def test_a_sphere_on_the_table_is_found_with_its_radius():
    table = patch((0, 0, 0), (1, 0, 0), (0, 1, 0))
    table = table[np.linalg.norm(table[:, :2] - 0.5, axis=1) > 0.12]
    cap = sphere(0.12, 6000)
    seen = (cap * (np.array([0.0, -1.5, 1.88]) - cap)).sum(axis=1) > 0  # the side that faces the viewpoint
    cap = cap[seen & (cap[:, 2] > -0.1)] + [0.5, 0.5, 0.12]
    noise = 0.0005 * np.random.default_rng(0).normal(size=(len(table) + len(cap), 3))
    result = pcgraph.segment(np.vstack((table, cap)) + noise, viewpoint=(0.5, -1, 2), voxel_size=0.015)
    found = objects_on(result)
    assert len(found) == 1
    assert found[0].shape.kind == "sphere"
    assert found[0].shape.radius == pytest.approx(0.12, rel=0.03)
    assert found[0].shape.center == pytest.approx([0.5, 0.5, 0.12], abs=0.005)
    assert found[0].height == pytest.approx(0.24, abs=0.01)


def test_pieces_of_a_table_are_one_plane_if_asked():
    left = patch((0, 0, 1), (0.4, 0, 0), (0, 0.4, 0))
    points = np.vstack((left, left + np.array([0.6, 0, 0]), left + np.array([0.3, 0.8, 0.1])))
    result = pcgraph.segment(points, viewpoint=(0.5, 0.2, 3), voxel_size=0.03)
    assert sorted(find_planes(result).counts) == [len(left), 2 * len(left)]
    apart = find_planes(result, join=False)
    assert apart.counts.tolist() == [len(left)] * 3
    assert find_planes(result, min_area=0.2).counts.tolist() == [2 * len(left)]
    assert len(find_planes(result, min_area=0.5)) == 0


def test_missing_points_belong_to_nothing():
    points = np.dstack([*np.meshgrid(np.linspace(-0.5, 0.5, 80), np.linspace(-0.4, 0.4, 60)), np.full((60, 80), 2.0)])
    points[10:20, 30:40] = np.nan
    result = pcgraph.segment(points)
    planes = find_planes(result)
    assert len(planes) == 1
    assert planes.normals[0] == pytest.approx([0, 0, -1])  # towards the camera
    assert planes.offsets[0] == pytest.approx(-2.0)
    labels = result.on_points(planes.plane_of_supervoxel)
    assert np.all((labels == -1) == np.isnan(points[..., 0]))
    assert objects_on(result, planes, points=points) == []


def test_floor_table_and_walls_of_rooms(scenes):
    for view, result, planes in scenes:
        labels = result.on_points(planes.plane_of_supervoxel)
        for thing in range(4):  # floor, two walls, table top
            true = view.things == thing
            if true.sum() < 3000:
                continue
            best = np.bincount(labels[true & (labels >= 0)]).argmax()
            found = labels == best
            assert (true & found).sum() / (true | found).sum() > 0.85
            if CLASSES[view.classes[true][0]] == "wall":
                assert planes.roles[best] == "vertical"
                continue
            level = view.floor if thing == 0 else view.table
            assert planes.roles[best] == "horizontal"
            assert np.degrees(np.arccos(planes.normals[best] @ view.up)) < 0.3
            assert planes.centroids[best] @ view.up == pytest.approx(level, abs=0.004)


def test_things_on_the_tables_of_rooms(scenes):
    hits = things = extra = 0
    for view, result, planes in scenes:
        table = int(np.argmin(np.abs(planes.offsets - view.table) + (planes.roles != "horizontal")))
        found = objects_on(result, planes, table)
        labels = object_labels(result, found)
        height = view.points @ view.up
        for thing in np.unique(view.things[view.things > 4]):
            true = view.things == thing
            if true.sum() < 150 or height[true].min() < view.table - 0.05:
                continue
            things += 1
            overlap = [((labels == k) & true).sum() / ((labels == k) | true).sum() for k in range(len(found))]
            hits += max(overlap) > 0.75
        extra += len(found)
    assert things > 10
    assert hits >= 0.9 * things
    assert extra <= 1.15 * things


def test_moments_of_regions_are_those_of_their_points():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) + np.array([1e4, 0, 0])
    leaf = rng.integers(0, 20, 500).astype(np.int32)
    regions = np.array([0, 1, -1, 2] * 5, np.int32)
    pooled = moments_of_regions(moments_of_groups(points, None, leaf, 20), regions, 3)
    for r in range(3):
        mine = points[regions[leaf] == r]
        assert pooled.counts[r] == len(mine)
        assert pooled.centroids[r] == pytest.approx(mine.mean(axis=0))
        assert pooled.covariances[r] == pytest.approx(np.cov(mine.T, bias=True), abs=1e-9)
    none = moments_of_regions(Moments(np.ones(1, int), np.ones((1, 3)), np.zeros((1, 3, 3)), None), np.array([-1]), 0)
    assert len(none) == 0


def test_noise_is_read_off_flat_parts_at_its_distance():
    rng = np.random.default_rng(0)
    edges = rng.uniform(0.01, 0.04, 2000)
    noise = 2.0 * edges**2
    curved = rng.random(2000) < 0.5
    residuals = noise * rng.uniform(0.95, 1.05, 2000) * np.where(curved, 5.0, 1.0)
    assert surface_noise(residuals, edges, np.full(2000, 100)) == pytest.approx(noise, rel=0.1)
    even = surface_noise(np.array([1.0, 2.0, 3.0, 4.0]), np.full(4, 0.01), np.ones(4, int))
    assert even == pytest.approx([1.0] * 4)
    assert surface_noise(np.zeros(100), edges[:100], np.ones(100, int)).tolist() == [0.0] * 100


def test_wrong_arguments_are_refused(boxes):
    points, _, result = boxes
    planes = find_planes(result)
    for arguments in ({"up": (0, 0, 0)}, {"up": (1, 2)}, {"tolerance": -1.0}, {"angle": 0.0}, {"angle": "a"}):
        with pytest.raises(ValueError, match="expected"):
            find_planes(result, **arguments)
    for area in (0, np.nan, "a"):
        with pytest.raises(ValueError, match="square metres"):
            find_planes(result, min_area=area)
    for support in (len(planes), -1, "table", 0.5):
        with pytest.raises(ValueError, match="support"):
            objects_on(result, planes, support)
    with pytest.raises(ValueError, match="call find_planes again"):
        objects_on(pcgraph.segment(points[:200], voxel_size=0.05), planes)
    with pytest.raises(ValueError, match="min_points"):
        objects_on(result, planes, min_points="a")
    with pytest.raises(ValueError, match="points of shape"):
        objects_on(result, planes, points=points[:-1])
    with pytest.raises(ValueError, match="margin"):
        objects_on(result, planes, margin=-1.0)


@pytest.mark.parametrize(("shows", "turn"), [(True, 0.05), (False, 0.0)])
def test_a_turn_that_distances_do_not_show_is_noise_of_the_normals(shows, turn):
    radius, reach = 2.0, 0.2
    place = np.stack(np.meshgrid(*[np.linspace(-1, 1, 41)] * 2), axis=-1).reshape(-1, 2)
    place = reach * place[np.linalg.norm(place, axis=1) <= 1]
    height = -(place**2).sum(axis=1) / (2 * radius) if shows else np.zeros(len(place))
    n = len(place)
    moments = moments_of_groups(np.column_stack((place, height)), None, np.arange(n, dtype=np.int32), n)
    normals = np.column_stack((place / radius, np.ones(n)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    free = np.zeros(n, bool)
    leaves = FlatLeaves(moments, normals, np.ones(n), free, 0.0, np.empty((0, 2), np.int32), np.empty(0, bool))
    assert bends(leaves, np.zeros(n, np.int32))[0] == pytest.approx(turn, rel=0.05)


def test_order_of_points_does_not_matter():
    points, _, viewpoint = two_boxes_on_a_plane()
    order = np.random.default_rng(0).permutation(len(points))
    first, second = (pcgraph.segment(cloud, viewpoint=viewpoint) for cloud in (points, points[order]))
    here, there = find_planes(first), find_planes(second)
    assert np.array_equal(here.plane_of_supervoxel, there.plane_of_supervoxel)
    assert here.corners == pytest.approx(there.corners, abs=1e-9)
