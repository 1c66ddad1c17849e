# SPDX-License-Identifier: Apache-2.0
"""Shapes: known ones in known poses come back."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from scenes.surfaces import AWAY, TURN, UP, sphere, surface_of_a_box

from pcgraph.detection.shapes import Kind, fit_shape
from pcgraph.features.primitives import Primitive


def test_a_sphere_is_a_sphere():
    points, normals = sphere(0.12, 2000)
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


def test_the_kinds_are_the_primitives_and_the_box():
    assert set(get_args(Kind)) == {primitive.name.lower() for primitive in Primitive} | {"box"}


def test_shapes_need_finite_points_and_a_normal_for_each():
    points = np.random.default_rng(4).random((200_000, 3))
    for normals in (points[:3], np.full((200_000, 3), np.nan)):
        with pytest.raises(ValueError, match="normal"):
            fit_shape(points, normals)
    for wrong in (np.empty((0, 3)), np.full((5, 3), np.nan), np.ones((5, 2)), np.ones(3)):
        with pytest.raises(ValueError, match=r"expected .*point"):
            fit_shape(wrong, wrong)


def test_only_the_direction_of_up_counts():
    points = np.random.default_rng(3).normal(size=(60, 3))
    unit, longer = fit_shape(points, points, TURN[0]), fit_shape(points, points, 10 * TURN[0])
    assert longer.residuals == pytest.approx(unit.residuals)
