# SPDX-License-Identifier: Apache-2.0
"""Fringes of several periods have one mean; a drift of the exposure or of other light contradicts it, a gamma not."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from rangesim.capture import Capture
from rangesim.codes import MultiFrequency
from rangesim.decoding import decode
from rangesim.errors import DoubtWarning
from rangesim.sensors import StructuredLight

PERIODS_PX = (32.0, 512.0)
DRIFT = (1.0, 0.96, 0.92, 0.88, 0.84, 0.8)
ONE_BRIGHTER = (1.0, 1.0, 1.0, 1.2, 1.0, 1.0)
OTHER_LIGHT = (0.0, 0.0, 0.0, 9.0, 9.0, 9.0)


def doubts(steps: int, gamma: float = 1.0, gain: tuple[float, ...] = (1.0,), light: tuple[float, ...] = (0.0,)) -> str:
    """What is said of a wall with a grain under fringes; `gain` and `light` of the frames repeat."""
    sensor = StructuredLight(512, 128, code=MultiFrequency(PERIODS_PX, steps), order=("columns_*",))
    rng = np.random.default_rng(1)
    grain = 0.8 + 0.2 * rng.random((128, 512))
    shown = 10 + 180 * grain * sensor.patterns() ** gamma
    frames = shown * np.resize(gain, len(shown))[:, None, None] + np.resize(light, len(shown))[:, None, None]
    frames += rng.normal(0, 1, shown.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtWarning)
        return " ".join(decode(Capture(np.rint(frames).astype(np.uint8), sensor)).doubts)


@pytest.mark.parametrize("steps", [3, 4])
@pytest.mark.parametrize("gamma", [0.6, 1.0, 1.4, 2.2])
def test_sound_fringes_are_silent_with_any_gamma(steps: int, gamma: float) -> None:
    assert "mean" not in doubts(steps, gamma)


@pytest.mark.parametrize(
    ("gain", "light"),
    [
        ((1.0, 0.96, 0.92, 0.88, 0.84, 0.8), (0.0,)),
        ((1.0, 1.0, 1.0, 1.2, 1.0, 1.0), (0.0,)),
        ((0.8,), (0.0, 0.0, 0.0, 9.0, 9.0, 9.0)),
    ],
    ids=["a drift of the exposure", "a brighter frame", "other light"],
)
def test_another_mean_of_one_period_is_told(gain: tuple[float, ...], light: tuple[float, ...]) -> None:
    assert "the means of those of 32 and 512 pixels differ by" in doubts(3, 1.0, gain, light)
