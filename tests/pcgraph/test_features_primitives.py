# SPDX-License-Identifier: Apache-2.0
"""Planes, spheres and cylinders are found from moments: exactly without noise, within stated bounds with it."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from pcgraph.features.primitives import (
    Primitive,
    PrimitiveMoments,
    fit_primitives,
    primitive_moments,
    primitive_moments_up_tree,
    sums_of_powers,
)

N = 2000
PLACES = [np.zeros(3), np.array([1.0, -2.0, 3.0]), np.full(3, 1e6)]


def rotation(rng):
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]


def sphere(rng, half_angle):
    """Points and outward normals, (N, 3), of a cap of the unit sphere."""
    z, turn = rng.uniform(np.cos(half_angle), 1.0, N), rng.uniform(0.0, 2.0 * np.pi, N)
    normals = np.column_stack((np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z))
    normals = normals @ rotation(rng)
    return normals.copy(), normals


def cylinder(rng, half_angle, length=4.0):
    """Points and outward normals, (N, 3), of a part of a cylinder of radius 1 through the origin, and its axis."""
    turn, along = rng.uniform(-half_angle, half_angle, N), rng.uniform(-length / 2.0, length / 2.0, N)
    turned = rotation(rng)
    normals = np.column_stack((np.cos(turn), np.sin(turn), np.zeros(N))) @ turned
    return normals + along[:, None] * turned[2], normals, turned[2]


def moments(points, normals):
    return primitive_moments(points, normals, np.zeros(len(points), np.int32), 1)


def test_json_takes_primitives_and_a_flat_group_has_no_radius():
    flat = np.random.default_rng(0).random((50, 3)) * [1.0, 1.0, 0.0]
    fit = fit_primitives(moments(flat, np.tile([0.0, 0.0, 1.0], (50, 1))))
    assert not np.isfinite(fit.sphere_radius[0])
    read = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    assert (read["best"], read["sphere_radius"], read["sphere_center"]) == (["plane"], [None], [[None, None, None]])
    assert read["plane_normal"] == [[0.0, 0.0, 1.0]]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("radius", [1e-3, 0.1, 10.0])
@pytest.mark.parametrize("half_angle", [np.pi, np.pi / 2.0, np.pi / 6.0])
def test_exact_spheres(place, radius, half_angle):
    points, normals = sphere(np.random.default_rng(0), half_angle)
    fit = fit_primitives(moments(radius * points + place, normals))
    # 1e6 m away, float64 itself knows places to 1e-10 m only.
    digits = max(1e-6, 1e-9 * place.max() / radius / 1e2)
    assert np.linalg.norm(fit.sphere_center[0] - place) < digits * radius
    assert fit.sphere_radius[0] == pytest.approx(radius, rel=digits)
    assert fit.sphere_residual[0] < digits * radius
    assert fit.best[0] == Primitive.SPHERE


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("radius", [1e-3, 0.1, 10.0])
@pytest.mark.parametrize("half_angle", [np.pi, np.pi / 2.0, np.pi / 6.0])
def test_exact_cylinders(place, radius, half_angle):
    points, normals, axis = cylinder(np.random.default_rng(1), half_angle)
    fit = fit_primitives(moments(radius * points + place, normals))
    digits = max(1e-6, 1e-9 * place.max() / radius / 1e2)
    assert abs(fit.cylinder_axis[0] @ axis) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(np.cross(fit.cylinder_point[0] - place, axis)) < digits * radius
    assert fit.cylinder_radius[0] == pytest.approx(radius, rel=digits)
    assert fit.cylinder_residual[0] < digits * radius
    assert fit.best[0] == Primitive.CYLINDER
    assert fit.cylinder_axis[0][np.abs(fit.cylinder_axis[0]).argmax()] > 0.0


@pytest.mark.parametrize("place", PLACES)
def test_exact_planes(place):
    rng = np.random.default_rng(2)
    turned = rotation(rng)
    points = rng.uniform(-1.0, 1.0, (N, 2)) @ turned[:2] + place
    for side in (1.0, -1.0):
        fit = fit_primitives(moments(points, np.tile(side * turned[2], (N, 1))))
        assert fit.plane_normal[0] == pytest.approx(side * turned[2], abs=1e-6)
        assert fit.plane_offset[0] == pytest.approx(side * turned[2] @ place, abs=1e-6)
        assert fit.plane_residual[0] < 1e-6
        assert fit.best[0] == Primitive.PLANE
        assert fit.sphere_residual[0] <= fit.plane_residual[0]  # a plane is the limit of spheres


def test_a_perfectly_flat_group_has_no_sphere():
    points = np.column_stack((np.random.default_rng(3).random((N, 2)), np.zeros(N)))
    fit = fit_primitives(moments(points, np.tile([0.0, 0.0, 1.0], (N, 1))))
    assert fit.sphere_radius[0] == fit.cylinder_radius[0] == np.inf
    assert np.isnan(fit.sphere_center).all()
    assert np.isnan(fit.cylinder_point).all()


# Caps of 60 and 120 degrees in all; noise along the normal of 1 % of the radius: 1 mm on a ball of 20 cm across.
@pytest.mark.parametrize(("degrees", "worst"), [(120.0, 0.005), (60.0, 0.02)])
def test_noisy_caps_of_spheres(degrees, worst):
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(30):
        points, normals = sphere(rng, np.radians(degrees / 2.0))
        fit = fit_primitives(moments(points + normals * rng.normal(0.0, 0.01, (N, 1)), normals))
        errors.append(fit.sphere_radius[0] - 1.0)
        assert np.linalg.norm(fit.sphere_center[0]) < worst
        assert fit.sphere_residual[0] == pytest.approx(0.01, rel=0.1)  # the noise itself
        assert fit.best[0] == Primitive.SPHERE
    assert np.abs(errors).max() < worst
    assert abs(np.mean(errors)) < 2.0 * np.std(errors) / np.sqrt(30.0) + worst / 10.0  # hardly any bias


@pytest.mark.parametrize(("degrees", "worst"), [(360.0, 0.005), (120.0, 0.02), (60.0, 0.08)])
def test_noisy_parts_of_cylinders(degrees, worst):
    rng = np.random.default_rng(5)
    for _ in range(30):
        points, normals, axis = cylinder(rng, np.radians(degrees / 2.0))
        noisy = normals + rng.normal(0.0, 0.05, (N, 3))  # three degrees
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        fit = fit_primitives(moments(points + normals * rng.normal(0.0, 0.01, (N, 1)), noisy))
        assert np.degrees(np.arccos(min(1.0, abs(fit.cylinder_axis[0] @ axis)))) < 1.0
        assert fit.cylinder_radius[0] == pytest.approx(1.0, abs=worst)
        assert fit.cylinder_residual[0] == pytest.approx(0.01, rel=0.5)
        assert fit.best[0] == Primitive.CYLINDER


def test_two_halves_are_the_whole():
    rng = np.random.default_rng(6)
    points, normals = sphere(rng, np.pi / 3.0)
    points = 0.1 * points + [5.0, 6.0, 7.0]
    halves = (points[:, 0] > points[:, 0].mean()).astype(np.int32)
    pooled = primitive_moments_up_tree(primitive_moments(points, normals, halves, 2), np.array([2, 2, 2], np.int32))
    whole = moments(points, normals)
    root = PrimitiveMoments(*(getattr(pooled, field.name)[2:] for field in fields(pooled)))
    united, direct = fit_primitives(root).columns(), fit_primitives(whole).columns()
    for name, column in united.items():
        assert column == pytest.approx(direct[name], rel=1e-6, abs=1e-9), name
    assert united["sphere_radius"][0] == pytest.approx(0.1, rel=1e-6)


@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_the_origin_of_the_powers_need_not_be_the_centroid(shape):
    """Far from the frame's origin centroids round; what counts is the place about which powers were summed."""
    rng = np.random.default_rng(11)
    points, normals = sphere(rng, np.pi / 3.0) if shape == "sphere" else cylinder(rng, np.pi / 3.0)[:2]
    at_centroid = moments(points, normals)
    moved = np.array([1e-4, -2e-4, 3e-4])
    powers = sums_of_powers(points, np.zeros(N, np.int32), at_centroid.centers + moved, at_centroid.scales)
    beside = replace(at_centroid, centers=at_centroid.centers + moved, powers=powers)
    expected, found = fit_primitives(at_centroid).columns(), fit_primitives(beside).columns()
    for name in ("plane_offset", "plane_residual", f"{shape}_radius", "sphere_center"):
        assert found[name] == pytest.approx(expected[name], abs=1e-5), name
    assert found[f"{shape}_residual"] < 3e-4  # a root of rounding


def test_noise_speaks_for_the_simpler_shape():
    points, normals = sphere(np.random.default_rng(7), np.radians(5.0))  # sagitta of 0.4 % of the radius
    assert fit_primitives(moments(points, normals)).best[0] == Primitive.SPHERE
    assert fit_primitives(moments(points, normals), noise=0.01).best[0] == Primitive.PLANE


def test_wrong_input_is_refused_before_it_is_summed():
    points, one = np.random.default_rng(0).random((1000, 3)), np.zeros(1000, np.int32)
    for normals in (points[:3], points[:, :2], points[0], np.full((1000, 3), np.nan)):
        with pytest.raises(ValueError, match="normal"):
            primitive_moments(points, normals, one, 1)
    with pytest.raises(ValueError, match="points as finite"):
        primitive_moments(np.full((1000, 3), np.inf), points, one, 1)
    for groups, n in ((one + 1, 1), (one - 1, 1), (one, 2), (one + 1, 2)):
        with pytest.raises(ValueError, match="groups"):
            primitive_moments(points, points, groups, n)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_few_or_coincident_points_break_nothing(n):
    rng = np.random.default_rng(8)
    for points in (np.ones((n, 3)), rng.random((n, 3)), np.outer(np.arange(n), [1.0, 2.0, 3.0])):
        fit = fit_primitives(moments(points, np.tile([0.0, 0.0, 1.0], (n, 1))))
        assert np.isfinite(fit.plane_normal).all()
        assert np.isfinite(fit.plane_residual).all()
        assert np.isfinite(fit.sphere_residual).all()
        assert np.isfinite(fit.cylinder_residual).all()
        if n < 4:
            assert fit.best[0] == Primitive.PLANE


@pytest.mark.parametrize("scale", [1e-60, 1e60])
def test_wild_units(scale):
    points, normals = sphere(np.random.default_rng(9), np.pi / 3.0)
    fit = fit_primitives(moments(scale * points, normals))
    assert fit.sphere_radius[0] == pytest.approx(scale, rel=1e-6)
    assert fit.best[0] == Primitive.SPHERE


@pytest.mark.parametrize("wrong", [{"gain": 0.5}, {"gain": np.nan}, {"noise": -1.0}, {"noise": np.inf}])
def test_wrong_parameters_are_refused(wrong):
    points, normals = sphere(np.random.default_rng(10), np.pi)
    with pytest.raises(ValueError, match="expected"):
        fit_primitives(moments(points, normals), **wrong)
