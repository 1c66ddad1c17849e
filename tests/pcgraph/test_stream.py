# SPDX-License-Identifier: Apache-2.0
"""Forgetting in `update`: what is old, and what a new scan sees through."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest
from scenes.rays import axes_of_view, nearest_of, pinhole, to_box, to_walls
from scenes.surfaces import patch
from scipy.spatial.transform import Rotation

import pcgraph
from pcgraph.history import History
from pcgraph.voxels.grid import voxel_grid

PLACE = np.array([0.0, 0.0, 1.3])
STILL = [((4.0, 1.0, 0.0), (4.6, 1.8, 1.2)), ((5.5, -2.0, 0.0), (6.2, 0.5, 0.8))]
BOX = np.array([(2.5, -0.4, 0.0), (3.0, 0.1, 0.5)])
PUSHED = np.array([0.0, 0.9, 0.0])


def room(place, low, seed=0):
    """What a camera sees of a room with two boxes and one more, (n, 3) metres, and the thing of each point, 3: it."""
    rays = (pinhole((120, 160), 115.0) @ axes_of_view((1.0, 0.0, -0.25))).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    met = [to_box(rays, np.array(a) - place, np.array(b) - place) for a, b in (*STILL, low)]
    ranges, things = nearest_of(to_walls(rays, (-1, -3, 0) - place, (7, 3, 2.6) - place), *met)
    ranges = ranges + np.random.default_rng(seed).normal(0.0, 0.003, len(rays))
    return place + rays * ranges[:, None], things


def with_pose_noise(points, place, metres, degrees, seed):
    """Points as of a sensor whose pose is a little off."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(degrees * rng.standard_normal(3) / np.sqrt(3.0), degrees=True)
    return (points - place) @ turn.as_matrix().T + place + metres * rng.standard_normal(3) / np.sqrt(3.0)


@pytest.fixture(scope="module")
def first():
    """The room before the box is pushed, and the voxels on the box."""
    points, things = room(PLACE, BOX)
    result = pcgraph.segment(points, viewpoint=PLACE, camera=False, range_growth=0.0)
    grid = result.surface.grid
    on_box = np.bincount(grid.voxel_of_point, things[~result.outliers] == 3, grid.n_voxels) > 0.5 * grid.counts
    return result, on_box


@pytest.fixture(scope="module")
def window():
    """Results of a window of ground that moves on by half its width from scan to scan."""
    ground, place = patch((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.6, 0.0), 0.02), np.array([0.5, 0.3, 2.0])
    results = [pcgraph.segment(ground, viewpoint=place, range_growth=0.0)]
    for step in range(1, 9):
        on = np.array([0.5 * step, 0.0, 0.0])
        results.append(pcgraph.update(results[-1], ground + on, viewpoint=place + on, max_age=2))
    return results


def cells_of(result, supervoxel):
    """Grid coordinates of the voxels of a supervoxel, and their counts of points."""
    own = result.surface.supervoxels == supervoxel
    return result.surface.grid.cells[own].tolist(), result.surface.grid.counts[own].tolist()


def assert_same(a, b):
    assert np.array_equal(a.labels, b.labels)
    assert np.array_equal(a.supervoxels, b.supervoxels)
    assert np.array_equal(a.objects, b.objects)
    assert np.array_equal(a.graph.edges, b.graph.edges)
    assert np.array_equal(a.surface.grid.cells, b.surface.grid.cells)
    assert np.array_equal(a.leaves.scatters, b.leaves.scatters)


# --- By age -----------------------------------------------------------------------------------------------------------


def test_nothing_is_too_old_for_a_large_age(first):
    points, _ = room(PLACE, BOX + PUSHED)
    plain = pcgraph.update(first[0], points, viewpoint=PLACE)
    assert_same(pcgraph.update(first[0], points, viewpoint=PLACE, max_age=1000), plain)
    assert np.array_equal(plain.supervoxel_of_earlier, np.arange(first[0].tree.n_leaves))


def test_ages_count_the_scans_since_a_supervoxel_was_seen(window):
    for step, result in enumerate(window):
        assert result.ages.dtype == np.int32
        assert result.ages.max() == min(step, 2)
        seen = np.unique(result.supervoxels)
        assert not result.ages[seen].any()
        assert (np.delete(result.ages, seen) > 0).all()


def test_a_window_that_moves_on_has_bounds_and_its_ground_keeps_its_number(window):
    n_voxels = [result.surface.grid.n_voxels for result in window]
    assert max(n_voxels[4:]) < 1.05 * n_voxels[3]
    assert window[-1].surface.grid.centroids[:, 0].min() > 2.5
    assert all((result.labels == 0).all() for result in window)


def test_what_is_remembered_keeps_its_voxels_points_and_object(window):
    for earlier, later in pairwise(window):
        now = later.supervoxel_of_earlier
        kept = np.flatnonzero(now >= 0)
        assert (np.diff(now[kept]) > 0).all()
        assert np.array_equal(now < 0, earlier.ages >= 2)
        assert np.array_equal(later.objects[now[kept]], earlier.objects[kept])
        unseen = kept[later.ages[now[kept]] > 0]
        assert len(unseen)
        assert all(cells_of(earlier, s) == cells_of(later, now[s]) for s in unseen)
        assert np.array_equal(later.leaves.counts[now[unseen]], earlier.leaves.counts[unseen])
        assert np.allclose(later.leaves.scatters[now[unseen]], earlier.leaves.scatters[unseen], rtol=1e-12)


def test_numbers_of_earlier_points_are_told(window):
    earlier, later = window[-2:]
    now = later.of_earlier(earlier.supervoxels.reshape(-1, 1))
    assert now.shape == (len(earlier.supervoxels), 1)
    assert (now >= 0).all()
    oldest = np.flatnonzero(earlier.ages == 2)
    assert len(oldest)
    assert (later.of_earlier(oldest) == -1).all()
    assert later.of_earlier(-1) == -1


def test_with_all_forgotten_only_the_new_scan_is_there(first):
    points, _ = room(PLACE, BOX + PUSHED, seed=1)
    twice = pcgraph.update(first[0], room(PLACE, BOX, seed=2)[0], viewpoint=PLACE)
    result = pcgraph.update(first[0], points, viewpoint=PLACE, max_age=0)
    alone = voxel_grid(points[~result.outliers], result.voxel_size, result.surface.grid.warp)
    assert np.array_equal(result.surface.grid.cells, alone.cells)
    assert np.array_equal(result.surface.grid.counts, alone.counts)
    assert np.array_equal(result.surface.grid.indptr, alone.indptr)
    assert result.tree.moments.counts[-1] == np.count_nonzero(~result.outliers)
    assert (result.supervoxel_of_earlier == -1).all()
    assert result.objects.min() == first[0].next_object
    again = pcgraph.update(twice, points, viewpoint=PLACE, max_age=0)
    assert np.array_equal(again.supervoxels, result.supervoxels)
    assert np.array_equal(again.labels - twice.next_object, result.labels - first[0].next_object)


def test_forgetting_again_forgets_nothing(window):
    history = History.of(window[4])
    once = history.without(history.ages >= 1)
    twice = once.without(once.ages >= 1)
    assert len(once.objects) < len(history.objects)
    assert all(getattr(once, field.name) is getattr(twice, field.name) for field in fields(History))
    steps = history.without(history.ages >= 2)
    steps = steps.without(steps.ages >= 1)
    assert np.array_equal(steps.numbers, once.numbers)
    assert np.array_equal(steps.surface.grid.neighbours, once.surface.grid.neighbours)
    assert np.array_equal(steps.leaves.counts, once.leaves.counts)


# --- What is seen through ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_what_has_moved_away_is_forgotten_and_what_stays_is_not(first, seed):
    result, on_box = first
    place = PLACE + np.array([0.1, 0.05, 0.0])
    points = with_pose_noise(room(place, BOX + PUSHED, seed)[0], place, 0.02, 0.2, seed)
    later = pcgraph.update(result, points, viewpoint=place, carve_free_space=True)
    gone = later.supervoxel_of_earlier[result.surface.supervoxels] < 0
    assert gone[on_box].mean() > 0.9
    assert gone[~on_box].mean() < 0.002
    assert later.labels.min() >= 0
    box = later.labels[room(place, BOX + PUSHED, seed)[1] == 3]
    assert np.bincount(box).max() > 0.9 * len(box)


def test_what_is_hidden_or_out_of_sight_stays(first):
    result, on_box = first
    board = patch((1.5, -1.0, 0.3), (0.0, 2.0, 0.0), (0.0, 0.0, 1.2), 0.02)  # before the box
    hidden = pcgraph.update(result, board, viewpoint=PLACE, carve_free_space=True)
    assert (hidden.supervoxel_of_earlier >= 0).all()
    points, _ = room(PLACE, BOX + PUSHED)
    beside = pcgraph.update(result, points[points[:, 1] > 1.2], viewpoint=PLACE, carve_free_space=True)
    assert (beside.supervoxel_of_earlier[result.surface.supervoxels[on_box]] >= 0).all()


def test_all_of_a_scene_may_be_seen_through():
    wall, far = (patch((x, -x / 2, -x / 2), (0.0, x, 0.0), (0.0, 0.0, x), 0.02 * x) for x in (1.0, 2.0))
    result = pcgraph.segment(wall, viewpoint=(0.0, 0.0, 0.0), camera=False, range_growth=0.0)
    later = pcgraph.update(result, far, viewpoint=(0.0, 0.0, 0.0), carve_free_space=True)
    assert (later.supervoxel_of_earlier == -1).all()
    assert later.surface.grid.centroids[:, 0].min() > 1.9
    kept = pcgraph.update(result, far, viewpoint=(0.0, 0.0, 0.0))
    assert kept.surface.grid.n_voxels == result.surface.grid.n_voxels + later.surface.grid.n_voxels


def test_what_cannot_be_forgotten_is_refused(window):
    ground = patch((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.6, 0.0), 0.02)
    places = ground + np.array([0.0, 0.0, 2.0])
    for viewpoint in (None, places):
        with pytest.raises(ValueError, match="expected one viewpoint of the new scan to carve free space"):
            pcgraph.update(window[0], ground, viewpoint=viewpoint, carve_free_space=True)
    for wrong in (-1, 1.5, True, "2"):
        with pytest.raises(ValueError, match="expected max_age as a whole number of at least 0"):
            pcgraph.update(window[0], ground, viewpoint=(0.5, 0.3, 2.0), max_age=wrong)


def test_a_scan_in_another_frame_is_noticed(first):
    """The points of a camera that has turned and moved on, in its own frame. In the room's frame all is silent."""
    place = PLACE + np.array([0.5, 0.3, 0.0])
    points, _ = room(place, BOX)
    pcgraph.update(first[0], points, viewpoint=place)
    turn = Rotation.from_euler("z", 25.0, degrees=True).as_matrix()
    with pytest.warns(pcgraph.CloudWarning, match=r"sees through \d+ % .* in the frame of the first scan"):
        pcgraph.update(first[0], (points - place) @ turn.T, viewpoint=np.zeros(3))
