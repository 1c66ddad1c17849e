# SPDX-License-Identifier: Apache-2.0
"""Outlines, rectangles and boxes: known poses come back."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scenes.surfaces import AWAY, TURN, UP, surface_of_a_box
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from pcgraph.detection.boxes import (
    OrientedBox,
    boxes_of_labels,
    inside_outline,
    outline,
    smallest_rectangle,
    standing_box,
    tight_box,
)
from pcgraph.voxels.directions import plane_basis


def test_box_knows_its_corners_and_what_it_holds():
    box = OrientedBox(AWAY, TURN, np.array([0.4, 0.2, 0.1]))
    assert box.volume == pytest.approx(0.008)
    assert box.corners()[0] == pytest.approx(AWAY - np.array([0.2, 0.1, 0.05]) @ TURN)
    assert box.corners()[7] == pytest.approx(AWAY + np.array([0.2, 0.1, 0.05]) @ TURN)
    assert box.contains(AWAY + 0.999 * (box.corners() - AWAY)).all()
    assert not box.contains(AWAY + 1.001 * (box.corners() - AWAY)).any()
    assert box.contains(AWAY + 1.001 * (box.corners() - AWAY), margin=0.001).all()
    assert not box.contains([np.nan, 0, 0])
    assert box.distances(AWAY) == pytest.approx(0.05)
    assert box.distances(AWAY + np.array([0.5, 0.1, 0.05]) @ TURN) == pytest.approx(0.3)
    assert box.distances(AWAY + np.array([0.23, 0.14, 0.0]) @ TURN) == pytest.approx(0.05)


def test_tight_box_finds_a_box_in_any_pose():
    points, _ = surface_of_a_box([0.4, 0.25, 0.1])
    corners = OrientedBox(np.zeros(3), np.eye(3), np.array([0.4, 0.25, 0.1])).corners()
    box = tight_box(np.vstack((points, corners)) @ TURN.T + AWAY)
    assert box.size == pytest.approx([0.4, 0.25, 0.1], rel=1e-6)
    assert box.center == pytest.approx(AWAY)
    assert np.abs(box.axes @ TURN) == pytest.approx(np.eye(3), abs=1e-6)
    assert np.linalg.det(box.axes) == pytest.approx(1.0)


def test_boxes_hold_all_their_points():
    points = np.random.default_rng(1).normal(size=(300, 3)) @ TURN
    for box in (tight_box(points), standing_box(points, TURN[0])):
        assert box.contains(points, margin=1e-9).all()
        assert box.axes @ box.axes.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(box.axes) == pytest.approx(1.0)


def test_standing_box_reaches_down_to_its_support():
    points, _ = surface_of_a_box([0.3, 0.2, 0.1])
    turned = points @ Rotation.from_euler("z", 33, degrees=True).as_matrix().T + AWAY
    box = standing_box(turned, UP, bottom=1.5)
    assert box.axes[2] == pytest.approx(UP)
    assert box.size == pytest.approx([0.3, 0.2, 0.55], rel=0.02)
    assert box.center[2] - box.size[2] / 2 == pytest.approx(1.5)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_few_points_and_points_on_a_line_or_plane_have_boxes(n):
    rng = np.random.default_rng(n)
    line = rng.random((n, 1)) * [0.1, 0.2, -0.4] + AWAY
    flat = rng.random((n, 2)) @ rng.random((2, 3)) + AWAY
    for points in (line, flat, np.repeat(line[:1], n, axis=0)):
        for box in (tight_box(points), standing_box(points, UP)):
            assert box.contains(points, margin=1e-9).all()
            assert np.isfinite(box.axes).all()
    assert tight_box(line).size[1:] == pytest.approx([0, 0], abs=1e-9)
    assert tight_box(flat).size[2] == pytest.approx(0, abs=1e-9)


def test_only_the_direction_of_up_counts():
    points = np.random.default_rng(3).normal(size=(60, 3))
    unit, longer = standing_box(points, TURN[0]), standing_box(points.tolist(), 10 * TURN[0])
    assert longer.size == pytest.approx(unit.size)
    assert longer.center == pytest.approx(unit.center)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((5, 3), np.nan), np.ones((5, 2)), np.ones(3)])
def test_boxes_need_finite_points(points):
    for call in (lambda: standing_box(points, UP), lambda: tight_box(points)):
        with pytest.raises(ValueError, match=r"expected .*point"):
            call()


def test_no_turned_rectangle_is_smaller():
    rng = np.random.default_rng(2)
    for _ in range(20):
        points = rng.normal(size=(30, 2)) * [3, 1]
        best = smallest_rectangle(outline(points))
        for angle in np.linspace(0, np.pi / 2, 200):
            c, s = np.cos(angle), np.sin(angle)
            assert np.ptp(points @ np.array([[c, -s], [s, c]]), axis=0).prod() >= best.area * (1 - 1e-12)
        local = (points - best.center) @ best.axes.T
        assert np.all(np.abs(local) <= best.size / 2 + 1e-9)
        assert best.size[0] >= best.size[1]


def test_outline_of_a_square_and_what_lies_inside():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5], [0.5, 0.0]])
    hull = outline(square)
    assert {tuple(corner) for corner in hull.tolist()} == {(0, 0), (1, 0), (1, 1), (0, 1)}
    turned = np.roll(hull, -1, axis=0) - hull
    assert np.all(turned[:, 0] * np.roll(turned[:, 1], -1) - turned[:, 1] * np.roll(turned[:, 0], -1) > 0)
    probe = np.array([[0.5, 0.5], [1.05, 0.5], [1.2, 0.5]])
    assert inside_outline(probe, hull, 0.0).tolist() == [True, False, False]
    assert inside_outline(probe, hull, 0.1).tolist() == [True, True, False]
    segment = outline(np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]]))
    assert segment.tolist() in ([[0, 0], [1, 0]], [[1, 0], [0, 0]])
    assert inside_outline(probe, segment, 0.6).tolist() == [True, True, True]
    assert inside_outline(probe, segment, 0.1).tolist() == [False, False, False]


@pytest.mark.parametrize("seed", range(3))
def test_boxes_go_through_json_and_back(seed):
    points = np.random.default_rng(seed).normal(size=(60, 3)) @ TURN.T + AWAY
    for box in (tight_box(points), standing_box(points, UP), tight_box(points[:1])):
        text = json.dumps(box.to_dict(), allow_nan=False)
        back = OrientedBox(**{name: np.array(value) for name, value in json.loads(text).items()})
        for name in ("center", "axes", "size"):
            assert np.array_equal(getattr(back, name), getattr(box, name))
        assert np.array_equal(back.corners(), box.corners())


def test_plane_basis_is_right_handed():
    for normal in np.vstack((np.eye(3), -np.eye(3), TURN)):
        frame = np.vstack((plane_basis(normal), normal))
        assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1.0)


def test_boxes_need_a_direction():
    points = np.random.default_rng(4).random((20, 3))
    for up in (np.zeros(3), (0, 1), "z"):
        with pytest.raises(ValueError, match="up"):
            standing_box(points, up)


@pytest.mark.parametrize("seed", range(5))
def test_the_tight_box_is_the_smallest_on_any_facet(seed):
    points = np.random.default_rng(seed).normal(size=(40 + 40 * seed, 3)) * [1, 2, 3] @ TURN.T + AWAY
    hull = ConvexHull(points)
    volumes = [standing_box(points, normal).volume for normal in hull.equations[:, :3]]
    large = np.argsort(-np.linalg.norm(np.cross(*np.diff(points[hull.simplices], axis=1).transpose(1, 0, 2)), axis=1))
    assert tight_box(points).volume == pytest.approx(np.array(volumes)[large[:64]].min(), rel=1e-9)


def test_boxes_of_labels_are_those_of_their_points():
    first, _ = surface_of_a_box([0.4, 0.25, 0.1])
    second = first @ TURN + AWAY
    points = np.concatenate((first, second, [[np.nan, 0.0, 0.0], [90.0, 90.0, 90.0]]))
    labels = np.repeat([5, 2, 5, -1], [len(first), len(second), 1, 1])
    mixed = np.random.default_rng(0).permutation(len(points))
    boxes = boxes_of_labels(points[mixed], labels[mixed])
    assert list(boxes) == [2, 5]
    assert boxes[5].size == pytest.approx(tight_box(first).size)
    assert boxes[2].center == pytest.approx(tight_box(second).center)
    upright = boxes_of_labels(points[mixed], labels[mixed], up=UP)
    assert upright[2].center == pytest.approx(standing_box(second, UP).center)
    assert boxes_of_labels(points, np.full(len(points), -1)) == {}
    with pytest.raises(ValueError, match="one whole number per point"):
        boxes_of_labels(points, labels[1:])
