# SPDX-License-Identifier: Apache-2.0
"""Outlines, rectangles, boxes and shapes: known poses come back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcgraph.detection.boxes import OrientedBox, plane_basis, standing_box, tight_box
from pcgraph.detection.hulls import inside_outline, outline, smallest_rectangle
from pcgraph.detection.shapes import fit_shape

UP = np.array([0.0, 0.0, 1.0])
TURN = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
AWAY = np.array([5.0, -3.0, 2.0])


def surface_of_a_box(size, n=4000, seed=0):
    """Points on all six sides, and their outward normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    side, sign = rng.integers(0, 3, n), rng.choice((-1.0, 1.0), n)
    points[np.arange(n), side] = sign / 2
    normals = np.zeros((n, 3))
    normals[np.arange(n), side] = sign
    return points * size, normals


def sphere(radius, n=2000):
    """Points evenly on the upper half of a sphere, and their normals."""
    height = np.linspace(0.0, 1.0, n)
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    normals = np.column_stack((np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height))
    return radius * normals, normals


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
    assert fit_shape(points, points, 10 * TURN[0]).residuals == pytest.approx(
        fit_shape(points, points, TURN[0]).residuals
    )


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((5, 3), np.nan), np.ones((5, 2)), np.ones(3)])
def test_boxes_and_shapes_need_finite_points(points):
    for call in (lambda: standing_box(points, UP), lambda: tight_box(points), lambda: fit_shape(points, points)):
        with pytest.raises(ValueError, match=r"expected .*point"):
            call()


def test_shapes_need_a_normal_per_point_and_boxes_a_direction():
    points = np.random.default_rng(4).random((200_000, 3))
    for normals in (points[:3], np.full((200_000, 3), np.nan)):
        with pytest.raises(ValueError, match="normal"):
            fit_shape(points, normals)
    for up in (np.zeros(3), (0, 1), "z"):
        with pytest.raises(ValueError, match="up"):
            standing_box(points, up)


def test_no_turned_rectangle_is_smaller():
    rng = np.random.default_rng(2)
    for _ in range(20):
        points = rng.normal(size=(30, 2)) * [3, 1]
        best = smallest_rectangle(points)
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


def test_plane_basis_is_right_handed():
    for normal in np.vstack((np.eye(3), -np.eye(3), TURN)):
        frame = np.vstack((plane_basis(normal), normal))
        assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1.0)


def test_a_sphere_is_a_sphere():
    points, normals = sphere(0.12)
    noise = 0.001 * np.random.default_rng(0).normal(size=(len(points), 1))
    shape = fit_shape((points + noise * normals) @ TURN.T + AWAY, normals @ TURN.T)
    assert shape.kind == "sphere"
    assert shape.radius == pytest.approx(0.12, abs=2e-4)
    assert shape.center == pytest.approx(AWAY, abs=5e-4)
    assert shape.residual == pytest.approx(0.001, rel=0.1)


def test_two_sides_and_the_top_of_a_box_are_a_box():
    points, normals = surface_of_a_box([0.3, 0.2, 0.15])
    seen = (normals @ [1, 2, 3]) > 0
    noise = 0.001 * np.random.default_rng(0).normal(size=(int(seen.sum()), 1))
    shape = fit_shape((points[seen] + noise * normals[seen]) @ TURN.T + AWAY, normals[seen] @ TURN.T)
    assert shape.kind == "box"
    assert shape.box.size == pytest.approx([0.3, 0.2, 0.15], abs=0.004)
    assert shape.residual == pytest.approx(0.001, rel=0.3)


@pytest.mark.parametrize("with_top", [False, True])
def test_half_a_can_is_a_cylinder(with_top):
    turn, height = np.meshgrid(np.linspace(0, np.pi, 60), np.linspace(0, 0.2, 40))
    normals = np.column_stack((np.cos(turn.ravel()), np.sin(turn.ravel()), np.zeros(turn.size)))
    points = 0.05 * normals + height.reshape(-1, 1) * UP
    if with_top:
        disc = np.random.default_rng(0).uniform(-0.05, 0.05, (1200, 2))
        disc = disc[np.linalg.norm(disc, axis=1) < 0.05]
        points = np.vstack((points, np.column_stack((disc, np.full(len(disc), 0.2)))))
        normals = np.vstack((normals, np.repeat(UP[None], len(disc), axis=0)))
    shape = fit_shape(points @ TURN.T + AWAY, normals @ TURN.T, TURN @ UP)
    assert shape.kind == "cylinder"
    assert shape.radius == pytest.approx(0.05, rel=1e-3)
    assert abs(shape.axis @ TURN @ UP) == pytest.approx(1.0, abs=1e-6)
    assert shape.center == pytest.approx(AWAY + 0.1 * TURN @ UP, abs=1e-4)


def test_a_flat_patch_is_a_plane():
    rng = np.random.default_rng(0)
    points = rng.random((500, 3)) * [0.3, 0.2, 0.0] + 0.001 * rng.normal(size=(500, 3)) * UP
    shape = fit_shape(points @ TURN.T, np.repeat((TURN @ UP)[None], 500, axis=0))
    assert shape.kind == "plane"
    assert abs(shape.axis @ TURN @ UP) == pytest.approx(1.0, abs=1e-4)
    assert shape.residual == pytest.approx(0.001, rel=0.1)


def test_one_point_is_no_puzzle():
    assert fit_shape(AWAY[None], UP[None], UP).residual == 0.0
