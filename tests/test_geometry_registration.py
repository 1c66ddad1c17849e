# SPDX-License-Identifier: Apache-2.0
"""Registration of clouds of a known part with and without a first guess; sliding, symmetric and distant clouds."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_scenes import rigid
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tiers import draws, to_validate

from rangesim.geometry import Registration, icp, register

TRUE = rigid((0.3, -0.8, 1.2), (0.5, 0.1, 0.3))
"""The true T_target_source, metres."""


def box(
    random: np.random.Generator, n: int, size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)
) -> np.ndarray:
    """(n, 3) points on the faces of a box."""
    p, face = random.uniform(-0.5, 0.5, (n, 3)), random.integers(0, 6, n)
    p[np.arange(n), face // 2] = np.where(face % 2, 0.5, -0.5)
    return p * size + at


def part(random: np.random.Generator, n: int) -> np.ndarray:
    """A block with two bosses, which looks different from each side."""
    bosses = (
        box(random, n // 4, (0.08, 0.06, 0.15), (0.1, 0.05, 0.12)),
        box(random, n // 4, (0.05, 0.12, 0.06), (-0.1, -0.02, 0.08)),
    )
    return np.concatenate([box(random, n // 2, (0.3, 0.2, 0.1)), *bosses])


def sphere(random: np.random.Generator, n: int) -> np.ndarray:
    p = random.normal(size=(n, 3))
    return np.asarray(0.1 * p / np.linalg.norm(p, axis=1, keepdims=True))


def cylinder(random: np.random.Generator, n: int) -> np.ndarray:
    a = random.uniform(0, 2 * np.pi, n)
    return np.stack([0.05 * np.cos(a), 0.05 * np.sin(a), random.uniform(-0.1, 0.1, n)], axis=-1)


def plane(random: np.random.Generator, n: int) -> np.ndarray:
    return np.concatenate([random.uniform(-0.1, 0.1, (n, 2)), np.zeros((n, 1))], axis=1)


def pair(shape, noise: float = 0.0, n: int = 4000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Two independent samplings of a shape, the source and the target; the source is moved by the inverse of `TRUE`."""
    random = np.random.default_rng(seed)
    source, target = shape(random, n), shape(random, n)
    source = (source - TRUE[:3, 3]) @ TRUE[:3, :3]
    return source + random.normal(0, noise, source.shape), target + random.normal(0, noise, target.shape)


def off(found: Registration) -> tuple[float, float]:
    """Difference from the truth in degrees and in metres, the latter at the middle of the part."""
    E = found.T_target_source @ np.linalg.inv(TRUE)
    return float(np.degrees(Rotation.from_matrix(E[:3, :3]).magnitude())), float(np.linalg.norm(E[:3, 3]))


@pytest.mark.parametrize("noise", [0.0, 5e-4])
def test_icp_finds_the_pose_from_a_near_one(noise: float) -> None:
    source, target = pair(part, noise)
    found = icp(source, target, rigid((0.05, 0.04, -0.06), (0.004, 0, 0.003)) @ TRUE)
    degrees, metres = off(found)
    assert degrees < 0.15
    assert metres < 2e-4
    assert found.fitness > 0.95
    assert found.target_fitness > 0.95
    assert found.constraint > 0.05


@pytest.mark.validation
def test_icp_is_a_minimum_of_the_distances_to_the_surface() -> None:
    """Neither the truth nor a pose beside the result has a smaller root mean square distance to the tangent planes."""
    source, target = pair(part, 3e-4)
    best = icp(source, target, TRUE)
    assert best.rms_m < 1.3e-3
    for axis in np.eye(6):
        turned = rigid(0.03 * axis[:3], 0.003 * axis[3:]) @ best.T_target_source
        again = icp(source, target, turned)
        assert np.abs(again.T_target_source - best.T_target_source).max() < 1e-3


@pytest.mark.validation
def test_register_needs_no_first_guess_and_repeats() -> None:
    source, target = pair(part, 3e-4, n=2000)
    found = register(source, target)
    degrees, metres = off(found)
    assert degrees < 0.3
    assert metres < 5e-4
    np.testing.assert_allclose(found.T_target_source, register(source, target).T_target_source, atol=1e-9)


@pytest.mark.parametrize("metres", [1.0, *to_validate(3.0, 30.0, 1000.0), 5e5])
@pytest.mark.parametrize("seed", draws(2, quick=1))
def test_far_from_the_origin_icp_finds_the_same(metres: float, seed: int) -> None:
    """With an offset of the target and another of the source, the pose is that at the origin, moved by the offsets."""
    source, target = pair(part, 3e-4, n=2000, seed=seed)
    guess = rigid((0.05, 0.04, -0.06), (0.004, 0, 0.003)) @ TRUE
    near = icp(source, target, guess)
    by = rigid((0, 0, 0), metres * np.array([1.0, -0.7, 0.1]))
    before = rigid((0, 0, 0), metres * np.array([-0.3, 0.4, 1.0]))
    far = icp(source - before[:3, 3], target + by[:3, 3], by @ guess @ before)
    moved = np.linalg.inv(by) @ far.T_target_source @ np.linalg.inv(before)
    atol = 1e-8 + 1e-14 * metres
    np.testing.assert_allclose(moved[:3, :3], near.T_target_source[:3, :3], atol=atol)
    np.testing.assert_allclose(moved[:3, 3], near.T_target_source[:3, 3], atol=1e-7 + 1e-12 * metres)
    assert off(near)[1] < 3e-4
    assert far.agreement == pytest.approx(near.agreement, abs=1e-4)


@pytest.mark.parametrize("metres", [*to_validate(1000.0), 5e5])
def test_far_from_the_origin_register_finds_the_same(metres: float) -> None:
    source, target = pair(part, 3e-4, n=2000)
    by = metres * np.array([1.0, -0.7, 0.1])
    E = register(source + by, target + by).T_target_source
    E[:3, 3] += E[:3, :3] @ by - by
    E = E @ np.linalg.inv(TRUE)
    assert np.degrees(Rotation.from_matrix(E[:3, :3]).magnitude()) < 0.3
    assert np.linalg.norm(E[:3, 3]) < 5e-4


def corrugated(random: np.random.Generator, n: int) -> np.ndarray:
    """A plate with waves of 30 mm along x, 12 mm high, and of 60 mm along y, 4 mm high, so that it cannot slide."""
    xy = random.uniform(-0.15, 0.15, (n, 2))
    return np.column_stack([xy, np.sin(2 * np.pi * xy / [0.03, 0.06]) @ [0.006, 0.002]])


@pytest.mark.parametrize(("turn", "seed"), [(0.3, 0), *to_validate((1.57, 1), (1.0, 2))])
def test_plates_with_their_waves_across_each_other_are_refused(turn: float, seed: int) -> None:
    """Nearly all points have a partner, although the waves of one plate cross those of the other."""
    source, target = pair(corrugated, 2e-4, n=6000, seed=seed)
    with pytest.raises(ValueError, match="expected surfaces that lie on each other"):
        icp(source, target, rigid((0, 0, turn), (0.004, 0, 0.003)) @ TRUE)
    assert icp(source, target, TRUE).agreement > 0.85


@pytest.mark.parametrize(
    ("pitch", "studs", "seed", "wrong", "right"),
    [
        (0.03, 8, 0, [1.0], [0.4]),
        *to_validate(*((p, n, s, [-1.5, 1.0, 1.5], [0.0, 0.4]) for p, n in ((0.03, 8), (0.02, 12)) for s in (0, 1))),
    ],
)
def test_a_guess_off_by_one_stud_of_many_is_refused(
    pitch: float, studs: int, seed: int, wrong: list[float], right: list[float]
) -> None:
    """A prism with studs in a row: a guess half a pitch off finds the pose; a full pitch off, another pose fits."""

    def prism(random: np.random.Generator, n: int) -> np.ndarray:
        row = (np.arange(studs) - (studs - 1) / 2) * pitch
        parts = [box(random, n // 2 // studs, (0.008, 0.008, 0.02), (x, 0.01, 0.03)) for x in row]
        return np.concatenate([box(random, n // 2, (0.3, 0.06, 0.05)), *parts])

    source, target = pair(prism, 2e-4, n=6000, seed=seed)
    for steps in wrong:
        with pytest.raises(ValueError, match=r"one way, got two poses 0 degrees and 0\.0"):
            icp(source, target, rigid((0.01, 0, 0.02), (steps * pitch, 0.001, 0.002)) @ TRUE)
    for steps in right:
        found = icp(source, target, rigid((0.01, 0, 0.02), (steps * pitch, 0.001, 0.002)) @ TRUE)
        assert off(found)[0] < 0.2
        assert off(found)[1] < 2e-4


@pytest.mark.parametrize("scale", [1.1, *to_validate(0.9)])
@pytest.mark.validation
def test_a_part_of_another_scale_is_refused(scale: float) -> None:
    source, target = pair(part, 3e-4, n=2000)
    with pytest.raises(ValueError, match="expected surfaces that lie on each other"):
        register(scale * source, target)


@pytest.mark.parametrize(("noise", "n"), [(3e-3, 4000), *to_validate((2e-3, 20000))])
def test_a_noisy_scan_of_a_dense_model_is_not_refused(noise: float, n: int) -> None:
    """Noise far above the spacing of the model lowers the agreement of the correct pose too."""
    random = np.random.default_rng(0)
    source, target = part(random, n), part(random, 30000)
    source = (source - TRUE[:3, 3]) @ TRUE[:3, :3] + random.normal(0, noise, source.shape)
    found = icp(source, target, TRUE)
    assert found.agreement < 0.45
    assert off(found)[0] < 0.5
    assert off(found)[1] < 2e-3


def overlap(x: float) -> tuple[np.ndarray, np.ndarray]:
    """The source from -0.15 to x, and the target from -x to 0.15, metres."""
    source, target = pair(part, 3e-4, n=6000)
    return source[(source @ TRUE[:3, :3].T + TRUE[:3, 3])[:, 0] < x], target[target[:, 0] > -x]


def test_fitness_is_the_fraction_that_overlaps() -> None:
    found = icp(*overlap(0.1), TRUE)
    degrees, metres = off(found)
    assert degrees < 0.2
    assert metres < 3e-4
    assert 0.6 < found.fitness < 0.75
    with pytest.raises(ValueError, match="expected 90% of the source"):
        icp(*overlap(0.1), TRUE, min_fitness=0.9)


def test_too_small_an_overlap_that_fits_in_two_ways_is_refused() -> None:
    """Each cloud then shows only one of the two bosses, and these fit on each other."""
    with pytest.raises(ValueError, match=r"fit in one way, got two poses 0 degrees and 0\.04"):
        icp(*overlap(0.08), TRUE)


@pytest.mark.parametrize("shape", [sphere, cylinder, plane])
@pytest.mark.parametrize("noise", [0.0, 3e-4])
def test_surfaces_that_slide_are_refused(shape, noise: float) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match="surfaces that hold each other"):
        icp(*pair(shape, noise, n=1500), TRUE)


def gutter(random: np.random.Generator, n: int) -> np.ndarray:
    """A plate with waves of 30 mm along x alone, which slides along y."""
    xy = random.uniform(-0.15, 0.15, (n, 2))
    return np.column_stack([xy, 0.006 * np.sin(2 * np.pi * xy[:, 0] / 0.03)])


def roof(random: np.random.Generator, n: int) -> np.ndarray:
    xy = random.uniform(-0.15, 0.15, (n, 2))
    return np.column_stack([xy, 0.5 * np.abs(xy[:, 0])])


@pytest.mark.parametrize("seed", draws(3, quick=1))
@pytest.mark.parametrize(
    ("shape", "n", "noise"),
    [(sphere, 600, 0.0), (sphere, 600, 1.0), (cylinder, 600, 0.5), (cylinder, 2500, 1.0), (roof, 600, 1.0),
     (roof, 2500, 1.0), (plane, 600, 1.0), (gutter, 6000, 0.05)],
)  # fmt: skip
def test_surfaces_that_slide_are_refused_with_few_noisy_points(shape, n: int, noise: float, seed: int) -> None:  # type: ignore[no-untyped-def]
    """With one estimate of the normals, noise looked like a constraint of 0.005 to 0.024, and wrong poses passed."""
    points = shape(np.random.default_rng(0), n)
    spacing = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    with pytest.raises(ValueError, match="surfaces that hold each other"):
        icp(*pair(shape, noise * spacing, n=n, seed=seed), TRUE)


def test_a_symmetric_part_is_refused_without_a_first_guess() -> None:
    def block(random: np.random.Generator, n: int) -> np.ndarray:
        return box(random, n, (0.3, 0.2, 0.1))

    source, target = pair(block, 3e-4, n=2000)
    with pytest.raises(ValueError, match="one way, got two poses"):
        register(source, target)
    assert off(icp(source, target, TRUE))[0] < 0.2


SOURCE, TARGET = pair(part, n=400)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: icp(SOURCE + 5, TARGET), "expected 30% of the source on the target, got 0.0%"),
        (lambda: register(SOURCE, pair(sphere, n=400)[1] * 10), "expected"),
        (lambda: icp(SOURCE[:10], TARGET), "at least 20"),
        (lambda: icp(np.repeat(SOURCE[:10], 4, axis=0), TARGET), "20 different"),
        (lambda: icp(SOURCE[:, :2], TARGET), r"shape \(\.\.\., n, 3\)"),
        (lambda: icp(SOURCE, np.full_like(TARGET, np.nan)), "NaN"),
        (lambda: icp(SOURCE, TARGET, np.diag([2, 1, 1, 1])), "rigid"),
        (lambda: icp(SOURCE, TARGET, max_distance_m=0), "max_distance_m"),
        (lambda: register(SOURCE, TARGET, min_fitness=1.5), "min_fitness"),
    ],
)
def test_invalid_input_is_refused(call, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        call()
