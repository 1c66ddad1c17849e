# SPDX-License-Identifier: Apache-2.0
"""Strata of specular chains: glass shows each of its images with the weight of its chain, and chance makes no noise."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from delta_scenes import GLASS, fresnel_dielectric, rig_of, scene_of, slab, transform, wall

from rangesim import Intrinsics, transport
from rangesim.environment.backend import select_variant

CAMERA = Intrinsics.from_fov(32, 24, 40)
PROJECTOR = Intrinsics.from_fov(32, 24, 40)


def glowing(z: float, radiance: float) -> dict[str, Any]:
    """A large wall at z metres that sends out the same radiance everywhere, towards the camera."""
    turned = transform().translate([0, 0, z]).rotate([1, 0, 0], 180 if z > 0 else 0).scale(50)
    emitter = {"type": "area", "radiance": {"type": "spectrum", "value": radiance}}
    return {"type": "rectangle", "to_world": turned, "emitter": emitter}


def strata(branches: int, shift: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Stratum (-1: the main chain) and number of each of a pixel's samples, (samples,) int64 each."""
    select_variant()
    import drjit as dr
    import mitsuba as mi

    from rangesim.light_transport.chain_strata import NEVER, stratum_of

    given = (dr.full(mi.UInt32, x, samples) for x in (branches, shift))
    stratum = stratum_of(*given, dr.arange(mi.UInt32, samples))
    leaves_at = stratum.leaves_at.numpy().astype(np.int64)
    return np.where(leaves_at == NEVER, -1, leaves_at), stratum.number.numpy().astype(np.int64)


# ---- Who leaves where -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("branches", [1, 2, 3, 4])
def test_an_eighth_of_all_samples_leaves_at_each_surface(branches: int) -> None:
    """Over all shifts, this holds for each number of a sample; so any number of samples gives a mean without bias."""
    of_shifts = np.array([strata(branches, shift, 40)[0] for shift in range(8)])
    for branch in range(branches):
        np.testing.assert_array_equal((of_shifts == branch).sum(axis=0), 1)
    np.testing.assert_array_equal((of_shifts == -1).sum(axis=0), 8 - branches)


@pytest.mark.parametrize("shift", range(8))
def test_eight_samples_meet_all_strata_and_sixteen_do_in_each_half(shift: int) -> None:
    """So the difference of the halves tells the noise of the mean, and not that of single strata."""
    leaves_at, _ = strata(4, shift, 64)
    assert Counter(leaves_at[:8].tolist()) == {-1: 4, 0: 1, 1: 1, 2: 1, 3: 1}
    halves = np.arange(64) >> 1 & 1
    for samples in (16, 32, 48, 64):
        for half in (0, 1):
            counts = Counter(leaves_at[:samples][halves[:samples] == half].tolist())
            assert counts == {-1: samples // 4, **dict.fromkeys(range(4), samples // 16)}


@pytest.mark.parametrize("branches", [1, 2, 3, 4])
@pytest.mark.parametrize("shift", range(8))
def test_samples_of_a_stratum_count_from_zero_in_each_half(shift: int, branches: int) -> None:
    """So places that follow a sequence fill the pixel evenly in each stratum, in pairs that are mirrored."""
    leaves_at, number = strata(branches, shift, 64)
    assert len(set(number.tolist())) == 64
    halves = np.arange(64) >> 1 & 1
    np.testing.assert_array_equal(number >> 1 & 1, halves)
    for branch in range(-1, branches):
        for half in (0, 1):
            m = number[(leaves_at == branch) & (halves == half)] - (branch + 1) * 0x10000
            np.testing.assert_array_equal((m >> 2) * 2 + (m & 1), np.arange(len(m)))


# ---- What a pixel sees ----------------------------------------------------------------------------------------------


def images_of(pane: dict[str, Any], samples: int) -> np.ndarray:
    """(h, w) error of the light of two walls: of radiance 1 behind the pane, and of radiance 10 in its reflection.

    The light is (1 - r) 1 + r 10, with r = 2 R / (1 + R).
    """
    scene = scene_of(pane=pane, behind=glowing(2.0, 1.0), reflected=glowing(-1.0, 10.0))
    seen = transport(scene, rig_of(CAMERA, PROJECTOR), [], spp=samples, max_depth=60, rr_depth=60).energy.ambient
    tangent = np.linalg.norm(CAMERA.normalise(CAMERA.pixel_centres()), axis=-1)
    reflectance = fresnel_dielectric(tangent / np.hypot(1, tangent))
    return np.asarray(seen - 1 - 9 * 2 * reflectance / (1 + reflectance))


def test_a_thin_pane_shows_both_its_images_without_noise() -> None:
    """By chance alone, the standard deviation would be 0.32 at 16 samples."""
    np.testing.assert_allclose(images_of(wall(0.5, {**GLASS, "type": "thindielectric"}), 16), 0, atol=1e-3)


@pytest.mark.parametrize(("samples", "noise"), [(16, 0.1), (64, 0.04)])
def test_light_that_is_reflected_between_two_faces_is_left_to_chance(samples: int, noise: float) -> None:
    """By chance alone, the standard deviation would be 0.32 and 0.11."""
    error = images_of(slab(0.5, 0.52), samples)
    assert error.std() < noise
    assert abs(error.mean()) < 4 * error.std() / error.size**0.5


def test_no_sample_of_a_stratum_lies_at_the_centre_of_its_pixel() -> None:
    """A strip of light behind a pane covers the middle fifth of a column of pixels, and brings a fifth of its light."""
    pixel_m = 2 * 2.0 * np.tan(np.radians(20)) / 32
    turned = transform().translate([pixel_m / 2, 0, 2]).rotate([1, 0, 0], 180).scale([0.1 * pixel_m, 5, 1])
    strip = {"type": "rectangle", "to_world": turned, "emitter": {"type": "area", "radiance": 1.0}}
    scene = scene_of(pane=wall(0.5, {**GLASS, "type": "thindielectric"}), strip=strip)
    rig = rig_of(CAMERA, PROJECTOR)
    seen = [transport(scene, rig, [], spp=16, seed=seed).energy.ambient[:, 16] for seed in range(12)]
    tangent = np.abs(CAMERA.normalise(CAMERA.pixel_centres())[:, 16, 1])
    reflectance = fresnel_dielectric(tangent / np.hypot(1, tangent))
    expected = 0.2 * np.mean((1 - reflectance) / (1 + reflectance))
    assert np.mean(seen) == pytest.approx(expected, rel=0.05)


def test_the_mean_of_a_ball_that_few_samples_see_has_no_bias() -> None:
    """With fewer than eight samples there are no strata, and chance decides."""
    ball = {"type": "sphere", "center": [0.02, 0.01, 0.6], "radius": 0.15, "bsdf": GLASS}
    scene = scene_of(ball=ball, behind=glowing(2.0, 1.0), reflected=glowing(-1.0, 10.0))
    sums = {
        spp: [transport(scene, rig_of(CAMERA, PROJECTOR), [], spp=spp, seed=s).energy.ambient.mean() for s in range(24)]
        for spp in (6, 8, 11)
    }
    means, errors = ({k: f(v) for k, v in sums.items()} for f in (np.mean, lambda v: np.std(v, ddof=1) / 24**0.5))
    for spp in (8, 11):
        assert abs(means[spp] - means[6]) < 4 * np.hypot(errors[spp], errors[6])
        assert errors[6] < 0.01 * means[6]
