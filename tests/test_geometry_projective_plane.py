# SPDX-License-Identifier: Apache-2.0
"""The projective plane: laws of points and lines, kinds of transforms, rectification, examples from the textbook."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rangesim.geometry import (
    LINE_AT_INFINITY,
    affine_rectification,
    classify,
    euclidean,
    homogeneous,
    is_at_infinity,
    join,
    map_lines,
    map_points,
    meet,
    metric_rectification,
    point_at_infinity,
)

CIRCULAR = np.array([1, 1j, 0])
PERSPECTIVE = np.array([[1.1, 0.1, 30], [-0.05, 0.9, 20], [3e-4, 2e-4, 1]])


def random_lines(random: np.random.Generator, n: int) -> np.ndarray:
    return join(homogeneous(random.uniform(0, 600, (n, 2))), homogeneous(random.uniform(0, 600, (n, 2))))


# ------------------------------------------------------------------------------------- worked cases of the field


def test_parallel_lines_meet_at_a_point_at_infinity() -> None:
    l1, l2, l3, m3 = 2.0, -3.0, 5.0, 7.0
    point = meet((l1, l2, l3), (l1, l2, m3))
    assert is_at_infinity(point)
    np.testing.assert_allclose(point, (m3 - l3) * np.array([l2, -l1, 0]))
    assert np.isnan(euclidean(point)).all()


@pytest.mark.parametrize("far", [1e-3, 1.0, 1e3])
def test_parallel_lines_meet_at_infinity_whatever_multiples_of_their_coefficients_are_given(far: float) -> None:
    random = np.random.default_rng(0)
    turns = random.uniform(-np.pi, np.pi, 2000)
    offsets = far * random.uniform(-1, 1, (2, 2000))
    first = np.stack([np.cos(turns), np.sin(turns), offsets[0]], axis=-1)
    opposite = np.stack([np.cos(turns + np.pi), np.sin(turns + np.pi), offsets[1]], axis=-1)  # other roundings
    scaled = first * [1, 1, 0] + np.stack([0 * turns, 0 * turns, offsets[1]], axis=-1)
    scaled *= random.uniform(0.1, 10, (2000, 1))
    for second in (opposite, scaled, scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)):
        points = meet(first, second)
        assert is_at_infinity(points).all()
        assert np.isnan(euclidean(points)).all()
        direction = points[:, :2] / np.linalg.norm(points[:, :2], axis=-1, keepdims=True)
        assert np.abs((direction * first[:, :2]).sum(axis=-1)).max() < 1e-10
    np.testing.assert_array_equal(meet(first, first * random.uniform(0.1, 10, (2000, 1))), 0.0)


@pytest.mark.parametrize("angle", [1e-14, 1e-12, 1e-6])
def test_lines_that_are_nearly_parallel_meet_where_they_do(angle: float) -> None:
    # y = 0 and y = angle (x - 2): exact in these coefficients
    np.testing.assert_allclose(euclidean(meet((0, 1, 0), (angle, -1, -2 * angle))), (2, 0), rtol=1e-12)
    np.testing.assert_allclose(euclidean(meet((0, 1, 0), (angle, -1, 1e-3))), (-1e-3 / angle, 0), rtol=1e-12)


def test_images_of_parallel_lines_that_meet_make_the_map_a_projectivity_and_one_pair_is_not_enough() -> None:
    pair = (4, 2, 1), (5, 2, 2)
    np.testing.assert_allclose(euclidean(meet(*pair)), (-1, 1.5))
    with pytest.raises(ValueError, match=r"at most 2 of the 8 degrees of freedom.*metric one also orthogonal"):
        affine_rectification([pair])
    # a map that does this to parallel lines has all eight degrees of freedom
    second = (1, 0, -3), (1, 1, -6)
    H = affine_rectification([pair, second])
    found = classify(np.linalg.inv(H))
    assert (found.kind, found.degrees_of_freedom) == ("projectivity", 8)
    for lines in (pair, second):
        assert is_at_infinity(np.round(meet(*map_lines(H, lines)), 12))


def test_a_similarity_with_its_parts_and_invariants() -> None:
    found = classify([[0, -4, 5], [4, 0, -3], [0, 0, 1]])
    assert (found.kind, found.degrees_of_freedom) == ("similarity", 4)
    assert found.invariants == ("ratio of lengths", "ratio of areas", "angle", "circular points")
    parts = found.decomposition
    assert parts is not None
    assert parts.scale == pytest.approx(4)
    assert np.degrees(parts.rotation_rad) == pytest.approx(90)
    np.testing.assert_allclose(parts.translation, (5, -3))
    assert not parts.is_reversing


# ------------------------------------------------------------------------------------- points and lines


def test_join_and_meet_are_dual() -> None:
    random = np.random.default_rng(0)
    a, b, c = (homogeneous(random.normal(size=(50, 2))) for _ in range(3))
    line = join(a, b)
    np.testing.assert_allclose((line * a).sum(-1), 0, atol=1e-12)
    np.testing.assert_allclose((line * b).sum(-1), 0, atol=1e-12)
    np.testing.assert_allclose(euclidean(meet(join(a, b), join(a, c))), euclidean(a), rtol=1e-6)
    np.testing.assert_array_equal(join(a, a), 0)


def test_the_point_at_infinity_of_a_line_is_its_direction() -> None:
    a, b = np.array([1.0, 2.0]), np.array([4.0, 6.0])
    direction = point_at_infinity(join(homogeneous(a), homogeneous(b)))
    assert is_at_infinity(direction)
    assert abs(np.linalg.det(np.stack([direction[:2], b - a]))) < 1e-12
    assert direction @ LINE_AT_INFINITY == 0


def test_maps_keep_incidence() -> None:
    random = np.random.default_rng(1)
    points, others = random.uniform(0, 600, (2, 20, 2))
    lines = join(homogeneous(points), homogeneous(others))
    mapped, image = map_lines(PERSPECTIVE, lines), map_points(PERSPECTIVE, points)
    scale = np.linalg.norm(mapped, axis=-1) * np.linalg.norm(homogeneous(image), axis=-1)
    np.testing.assert_allclose((mapped * homogeneous(image)).sum(-1) / scale, 0, atol=1e-12)
    np.testing.assert_allclose(map_points(np.stack([PERSPECTIVE] * 3), points)[1], image)  # batched
    np.testing.assert_allclose(map_points(np.linalg.inv(PERSPECTIVE), image), points)


def test_what_a_map_sends_to_infinity_is_nan() -> None:
    assert np.isnan(map_points([[1, 0, 0], [0, 1, 0], [1, 0, -2]], [(2.0, 5.0)])).all()


# ------------------------------------------------------------------------------------- kinds


def build(scale: float, angle: float, t: tuple[float, float], shear: float, aspect: float, v: tuple[float, float]):  # type: ignore[no-untyped-def]
    c, s = np.cos(angle), np.sin(angle)
    H_S = np.array([[scale * c, -scale * s, t[0]], [scale * s, scale * c, t[1]], [0, 0, 1]])
    root = np.sqrt(aspect)
    H_A = np.array([[root, shear * root, 0], [0, 1 / root, 0], [0, 0, 1]])
    H_P = np.array([[1, 0, 0], [0, 1, 0], [*v, 1]])
    return H_S @ H_A @ H_P


SIZE = st.floats(0.2, 5)
SIGNED = st.floats(-2, 2)


@settings(max_examples=60, deadline=None)
@given(
    SIZE,
    st.floats(-3.1, 3.1),
    SIGNED,
    SIGNED,
    SIGNED,
    SIZE,
    SIGNED,
    SIGNED,
    st.floats(-9, 9).filter(lambda x: abs(x) > 0.1),
)
def test_the_decomposition_gives_back_what_a_map_was_made_of(
    scale: float, angle: float, x: float, y: float, shear: float, aspect: float, v1: float, v2: float, multiple: float
) -> None:
    H = build(scale, angle, (x, y), shear, aspect, (v1, v2))
    parts = classify(multiple * H).decomposition
    assert parts is not None
    found = [parts.scale, parts.shear, parts.aspect, *parts.translation, *parts.projective]
    np.testing.assert_allclose(found, [scale, shear, aspect, x, y, v1, v2], rtol=1e-6, atol=1e-7)
    assert np.cos(parts.rotation_rad - angle) == pytest.approx(1)
    product = parts.H_S @ parts.H_A @ parts.H_P
    np.testing.assert_allclose(product, H, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "kind", "freedom"),
    [
        ((1, 0.3, (5, 2), 0, 1, (0, 0)), "isometry", 3),
        ((1.5, 0.3, (5, 2), 0, 1, (0, 0)), "similarity", 4),
        ((1.5, 0.3, (5, 2), 0.2, 1, (0, 0)), "affinity", 6),
        ((1.5, 0.3, (5, 2), 0, 2, (0, 0)), "affinity", 6),
        ((1, 0.3, (5, 2), 0, 1, (0.1, 0)), "projectivity", 8),
    ],
)
def test_each_kind_keeps_what_it_should(arguments: tuple, kind: str, freedom: int) -> None:  # type: ignore[type-arg]
    H = build(*arguments)
    found = classify(-3 * H)
    assert (found.kind, found.degrees_of_freedom) == (kind, freedom)
    a, b, c, d = points = np.random.default_rng(2).uniform(-1, 1, (4, 2))
    p, q, r, s = map_points(H, points)
    kept = {
        "length": np.isclose(np.linalg.norm(q - p), np.linalg.norm(b - a)),
        "ratio of lengths": np.isclose(
            np.linalg.norm(q - p) / np.linalg.norm(r - p), np.linalg.norm(b - a) / np.linalg.norm(c - a)
        ),
        "ratio of areas": np.isclose(area(p, q, r) / area(p, q, s), area(a, b, c) / area(a, b, d)),
        "line at infinity": np.allclose(join(map_lines(H, [LINE_AT_INFINITY])[0], LINE_AT_INFINITY), 0),
        "circular points": np.isclose(abs(np.vdot(CIRCULAR, H @ CIRCULAR)) / np.linalg.norm(H @ CIRCULAR), np.sqrt(2)),
    }
    for name, holds in kept.items():
        inherited = name == "line at infinity" and kind != "projectivity"
        assert holds == (name in found.invariants or inherited), name
    # the cross ratio of points on a line stays under all of them
    places = np.array([0.0, 1.0, 2.5, 4.0])
    line = map_points(H, a + places[:, None] * (b - a))
    along = np.linalg.norm(line - line[0], axis=-1)
    assert cross_ratio(along) == pytest.approx(cross_ratio(places))


def area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float(np.linalg.det(np.stack([b - a, c - a])))


def cross_ratio(x: np.ndarray) -> float:
    return float((x[2] - x[0]) * (x[3] - x[1]) / ((x[2] - x[1]) * (x[3] - x[0])))


def test_mirrors_are_isometries_and_say_so() -> None:
    found = classify([[-1, 0, 4], [0, 1, 0], [0, 0, 1]])
    assert found.kind == "isometry"
    assert found.decomposition is not None
    assert found.decomposition.is_reversing


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_tolerance_has_no_unit(unit: float) -> None:
    """A map has the same kind in metres, micrometres and megametres if the extent is given in that unit."""
    scale = np.diag([unit, unit, 1.0])
    nearly = build(1, 0.3, (5, 2), 0, 1, (1e-6, 0))
    for tolerance, kind in ((1e-5, "isometry"), (1e-7, "projectivity")):
        assert classify(scale @ nearly @ np.linalg.inv(scale), tolerance, extent=unit).kind == kind


def test_a_map_that_sends_the_origin_to_infinity_has_no_decomposition() -> None:
    found = classify([[1, 0, 0], [0, 0, 1], [0, 1, 0]])
    assert found.kind == "projectivity"
    assert found.decomposition is None


# ------------------------------------------------------------------------------------- rectification

SQUARES = np.array([(x, y) for y in range(4) for x in range(4)], dtype=float) * 100


def image_lines(H: np.ndarray, directions: list[tuple[float, float]], random: np.random.Generator) -> np.ndarray:
    """(n, 3) images under H of lines with these directions through random points."""
    start = random.uniform(0, 300, (len(directions), 2))
    ends = map_points(H, start), map_points(H, start + 50 * np.array(directions))
    return join(homogeneous(ends[0]), homogeneous(ends[1]))


@pytest.mark.parametrize("pairs", [2, 5])
def test_affine_rectification_makes_parallels_parallel(pairs: int) -> None:
    random = np.random.default_rng(3)
    directions = [(np.cos(a), np.sin(a)) for a in random.uniform(0, np.pi, pairs)]
    lines = [image_lines(PERSPECTIVE, [d, d], random) for d in directions]
    H = affine_rectification([(pair[0], pair[1]) for pair in lines])
    assert classify(H @ PERSPECTIVE, tolerance=1e-6, extent=300).kind == "affinity"


@pytest.mark.parametrize("n", [5, 8])
def test_metric_rectification_from_orthogonal_pairs_alone(n: int) -> None:
    random = np.random.default_rng(4)
    angles = np.linspace(0, np.pi / 2, n, endpoint=False) + 0.1
    pairs = [image_lines(PERSPECTIVE, [(np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a))], random) for a in angles]
    H = metric_rectification([(pair[0], pair[1]) for pair in pairs])
    assert classify(H @ PERSPECTIVE, tolerance=1e-6, extent=300).kind == "similarity"
    assert np.linalg.det(H) > 0


def test_metric_rectification_after_the_affine_one_takes_two_pairs() -> None:
    random = np.random.default_rng(5)
    affine = build(1.3, 0.4, (20, -10), 0.5, 1.7, (0, 0))
    pairs = [image_lines(affine, [(np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a))], random) for a in (0.1, 0.7)]
    H = metric_rectification([(pair[0], pair[1]) for pair in pairs], LINE_AT_INFINITY)
    assert classify(H @ affine, tolerance=1e-8, extent=300).kind == "similarity"
    # a known vanishing line does as well as a rectified image
    line = np.linalg.inv(PERSPECTIVE).T @ LINE_AT_INFINITY
    pairs = [image_lines(PERSPECTIVE, [(np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a))], random) for a in (0.1, 0.7)]
    H = metric_rectification([(pair[0], pair[1]) for pair in pairs], line)
    assert classify(H @ PERSPECTIVE, tolerance=1e-6, extent=300).kind == "similarity"


def parallel(angle: float) -> tuple[np.ndarray, np.ndarray]:
    lines = image_lines(PERSPECTIVE, [(np.cos(angle), np.sin(angle))] * 2, np.random.default_rng(6))
    return lines[0], lines[1]


def orthogonal(angle: float) -> tuple[np.ndarray, np.ndarray]:
    c, s = np.cos(angle), np.sin(angle)
    lines = image_lines(PERSPECTIVE, [(c, s), (-s, c)], np.random.default_rng(7))
    return lines[0], lines[1]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: affine_rectification([parallel(0.3), parallel(0.3)]), "all parallel to each other"),
        (lambda: affine_rectification([parallel(0.3), (parallel(0.9)[0],) * 2]), "same line twice in pair 1"),
        (lambda: affine_rectification([parallel(0.3), ((0, 0, 1), (1, 2, 3))]), "line at infinity"),
        (lambda: affine_rectification([]), "two pairs"),
        (lambda: metric_rectification([orthogonal(0.1)] * 4), "expected 5 pairs"),
        (lambda: metric_rectification([orthogonal(0.1)] * 5), "repeat each other"),
        (lambda: metric_rectification([orthogonal(0.1)], LINE_AT_INFINITY), "expected 2 pairs"),
        (lambda: metric_rectification([orthogonal(0.1)] * 2, LINE_AT_INFINITY), "repeat each other"),
        (
            lambda: metric_rectification([((1, 0, 1), (1, 0.1, 2)), ((0, 1, 1), (0.1, 1, 2))], LINE_AT_INFINITY),
            "no plane has",
        ),
        (lambda: classify([[1, 2, 3], [2, 4, 6], [0, 0, 1]]), "invertible"),
        (lambda: classify(np.zeros((3, 3))), "invertible"),
        (lambda: classify(np.full((3, 3), np.nan)), "9 NaN"),
        (lambda: classify(np.eye(2)), r"shape \(\.\.\., 3, 3\)"),
        (lambda: classify(np.eye(3), tolerance=-1), "tolerance >= 0"),
        (lambda: map_lines(np.diag([1, 1, 0]), [(1, 2, 3)]), "singular"),
        (lambda: homogeneous([(1, 2, 3)]), r"\(\.\.\., 2\)"),
        (lambda: homogeneous("a line"), "array of numbers"),
    ],
)
def test_invalid_input_is_refused(call, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        call()
