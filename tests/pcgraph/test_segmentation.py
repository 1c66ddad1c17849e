# SPDX-License-Identifier: Apache-2.0
"""What a segmentation answers beyond its labels: saliency, occlusions, primitives."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.images import at_depths
from scenes.surfaces import directions, patch
from scenes.tables import two_boxes_on_a_plane

import pcgraph
from pcgraph.features.primitives import Primitive


def test_saliency_above_a_level_is_the_boundary_of_that_cut(boxes):
    points, _, result = boxes
    saliency = result.saliency()
    assert saliency.shape == (len(points),)
    grid, voxels = result.surface.grid, result.surface.supervoxels
    for altitude in (0.02, 0.3):
        segments = result.tree.cut(altitude=altitude)[voxels]
        row = np.repeat(np.arange(grid.n_voxels), np.diff(grid.indptr))
        edge = np.zeros(grid.n_voxels, bool)
        np.logical_or.at(edge, row, segments[row] != segments[grid.neighbours])
        assert np.array_equal(saliency > altitude, edge[grid.voxel_of_point])


def test_saliency_of_missing_points_is_nan():
    points = at_depths((40, 50), 50.0, np.where(np.arange(50) > 25, 0.8, np.ones((40, 50))))
    points[3, 4] = np.nan
    result = pcgraph.segment(points)
    saliency = result.saliency()
    assert saliency.shape == (40, 50)
    assert np.array_equal(np.isnan(saliency), np.isnan(points[..., 0]))


def test_the_front_plate_hides_the_wall_behind_it():
    rows, columns = np.mgrid[0:60, 0:80]
    plate = (abs(rows - 30) < 12) & (abs(columns - 40) < 15)
    result = pcgraph.segment(at_depths((60, 80), 80.0, np.where(plate, 0.6, 1.2)))
    found = result.occlusions()
    of_plate = set(result.supervoxels[plate].tolist())
    assert len(found.pairs) > 0
    assert {int(front) for front, _ in found.pairs} <= of_plate
    assert not {int(behind) for _, behind in found.pairs} & of_plate
    assert found.gap == pytest.approx(0.6, abs=0.1)


def test_occlusions_need_one_viewpoint():
    points, _, viewpoint = two_boxes_on_a_plane()
    viewpoints = np.tile(viewpoint, (len(points), 1))
    assert pcgraph.segment(points, viewpoint=viewpoints).occlusions() is not None  # all one
    viewpoints[::2, 0] += 0.5
    result = pcgraph.segment(points, viewpoint=viewpoints)
    with pytest.raises(ValueError, match="one viewpoint"):
        result.occlusions()


def test_primitives_of_a_ball_on_a_floor():
    rng = np.random.default_rng(0)
    ball = 0.2 * directions(6000, rng) + (0.5, 0.5, 0.2)
    seen = ball[ball[:, 2] > 0.1]
    floor = patch((0, 0, 0), (1, 0, 0), (0, 1, 0))
    points = np.vstack([floor[np.hypot(*(floor[:, :2] - 0.5).T) > 0.18], seen])
    result = pcgraph.segment(points, viewpoint=(0.5, 0.5, 3))
    primitives = result.primitives(points)
    nodes = result.tree.cut_nodes(n=2)
    of_ball = nodes[result.supervoxels[-1]]
    assert primitives.best[of_ball] == Primitive.SPHERE
    assert primitives.sphere_radius[of_ball] == pytest.approx(0.2, rel=0.02)
    assert primitives.sphere_center[of_ball] == pytest.approx((0.5, 0.5, 0.2), abs=0.01)
    assert primitives.best[nodes[result.supervoxels[0]]] == Primitive.PLANE
    assert result.primitives().sphere_radius[of_ball] == pytest.approx(0.2, rel=0.05)  # from voxels


def test_primitives_need_all_points():
    points, _, viewpoint = two_boxes_on_a_plane()
    result = pcgraph.segment(points, viewpoint=viewpoint)
    with pytest.raises(ValueError, match="the points that were segmented"):
        result.primitives(points[:-1])
    twice = pcgraph.update(result, points, viewpoint=viewpoint)
    with pytest.raises(ValueError, match="points of every scan"):
        twice.primitives(points)
    assert twice.primitives().plane_residual == pytest.approx(result.primitives().plane_residual, abs=1e-9)


def test_values_of_supervoxels_on_points():
    points = patch((0, 0, 1), (0.5, 0, 0), (0, 0.5, 0))
    points[7] = np.nan
    result = pcgraph.segment(points)
    n = result.tree.n_leaves
    levels = result.on_points(np.stack((np.arange(n), np.zeros(n, int)), axis=1))
    assert levels.shape == (len(points), 2)
    assert levels[7].tolist() == [-1, -1]
    assert np.array_equal(np.delete(levels[:, 0], 7), np.delete(result.supervoxels, 7))
    assert result.on_points(np.arange(n, dtype=np.uint8))[7] == -1
    assert np.isnan(result.on_points(np.ones(n))[7])
    assert not result.on_points(np.ones(n, bool))[7]
    for wrong in (np.ones(n + 1), np.ones(2 * n - 1), 3.0, ["a"] * n):
        with pytest.raises(ValueError, match="expected"):
            result.on_points(wrong)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "vccs"}, "expected a method such as"),
        ({"method": pcgraph.Vccs}, "expected a method such as"),
        ({"linkage": "ward"}, "expected a linkage such as"),
        ({"linkage": pcgraph.WardLinkage}, "expected a linkage such as"),
        ({"camera": "no"}, "expected camera as True, False or None"),
        ({"n_supervoxels": 0}, "expected n_supervoxels as a whole number of at least 1, got 0"),
        ({"n_supervoxels": 20.0}, "expected n_supervoxels as a whole number"),
        ({"n_supervoxels": 20, "seed_size": 0.1}, "expected seed_size or n_supervoxels, got both"),
    ],
)
def test_settings_of_another_kind_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        pcgraph.segment(patch((0, 0, 1), (0.2, 0, 0), (0, 0.2, 0)), **options)


def test_segmentations_are_compared_by_identity(boxes):
    assert boxes[2] == boxes[2]
    assert len({boxes[2]}) == 1


def test_a_segmentation_shows_what_it_holds(boxes):
    points, _, result = boxes
    assert repr(result).startswith(f"Segmentation({len(points)} points, {result.graph.n_nodes} supervoxels, ")


def test_another_cut_gives_the_objects(boxes):
    _, _, result = boxes
    for options in ({"n": 5}, {"altitude": 0.1}, {"n": 4, "min_size": 200}):
        cut = result.with_objects(**options)
        assert np.array_equal(cut.labels, result.cut(**options))
        assert np.array_equal(cut.labels, cut.on_points(cut.objects))
        assert cut.next_object == cut.labels.max() + 1
        pairs = np.stack((cut.parts, cut.labels), axis=-1).reshape(-1, 2)
        assert len(np.unique(pairs, axis=0)) == len(np.unique(pairs[:, 0]))  # parts lie within objects
    five = result.with_objects(n=5)
    assert np.array_equal(result.cut(altitude=five.object_altitude), five.labels)
    assert np.array_equal(result.with_objects(altitude=result.object_altitude).labels, result.labels)
    assert np.isfinite(result.with_objects(n=1).object_altitude)
