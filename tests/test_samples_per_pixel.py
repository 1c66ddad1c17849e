# SPDX-License-Identifier: Apache-2.0
"""Samples that are added where caustics are uneven within a pixel."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from delta_scenes import GLASS, matte, rig_of, scene_of, wall

from rangesim import Intrinsics, transport
from rangesim.light_transport.samples_per_pixel import FRACTION_FOR_CAUSTICS, samples_for_caustics
from rangesim.response import Images

LIGHT = np.ones((20, 30))
FIRST = np.full(600, 16)


def test_the_samples_of_a_pixel_do_not_decide_about_it() -> None:
    error = np.zeros((20, 30))
    error[8, 9] = 1.0
    added = samples_for_caustics(error, LIGHT, FIRST, 256).reshape(20, 30)
    around = added[7:10, 8:11]
    assert around[1, 1] == 0
    assert (np.delete(around.ravel(), 4) > 0).all()
    assert added.sum() == around.sum()


def test_noise_below_the_shot_noise_adds_no_samples() -> None:
    assert samples_for_caustics(np.full((20, 30), 0.005), LIGHT, FIRST, 256).sum() == 0
    assert samples_for_caustics(np.ones((20, 30)), np.zeros((20, 30)), FIRST, 256).sum() == 0


def test_the_noisiest_pixels_get_the_samples_that_a_pass_may_add() -> None:
    error = np.full((20, 30), 0.1)
    error[:5] = 1.0
    added = samples_for_caustics(error, LIGHT, FIRST, 256).reshape(20, 30)
    assert 0.5 * FRACTION_FOR_CAUSTICS * FIRST.sum() < added.sum() <= FRACTION_FOR_CAUSTICS * FIRST.sum()
    assert added[1:4, 1:-1].min() > 0
    assert added[7:].max() == 0
    assert (added % 4 == 0).all()  # pairs, in two halves


def test_no_pixel_has_more_samples_than_allowed() -> None:
    error = np.zeros((20, 30))
    error[:2, :2] = 1e6
    assert samples_for_caustics(error, LIGHT, FIRST, 24).max() == 8
    assert samples_for_caustics(error, LIGHT, np.full(600, 64), 64).sum() == 0


def test_by_default_the_focus_of_a_ball_has_little_noise() -> None:
    """The light of a ball of 100 mm in its focus, a few pixels of the camera; 16 samples miss much of it."""
    ball = {"type": "sphere", "center": [0, 0, 0.515], "radius": 0.05, "bsdf": GLASS}
    scene = scene_of(wall=wall(0.6, matte()), ball=ball)
    camera, projector = Intrinsics.from_fov(48, 36, 6), Intrinsics.from_fov(160, 120, 20)
    rig = rig_of(camera, projector, camera_at=(0.5, 0, 0.1), camera_looks_at=(0, 0, 0.6))
    white = Images(np.ones((1, 120, 160), np.float32))
    options: dict[str, Any] = {"glint": False, "indirect": "raw", "max_depth": 2}

    def noise(spp: int | Literal["auto"]) -> float:
        images = np.stack([transport(scene, rig, [white], spp=spp, seed=s, **options).energy.caustic for s in range(6)])
        focus = np.argsort(images.mean(axis=0).ravel())[-8:]
        values = images.reshape(6, -1)[:, focus]
        return float(np.sqrt(values.var(axis=0, ddof=1).mean()) / values.mean())

    assert noise("auto") < 0.5 * noise(64)
