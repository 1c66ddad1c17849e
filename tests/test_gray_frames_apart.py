# SPDX-License-Identifier: Apache-2.0
"""Gray code without inverses tells a frame of another exposure, focus, place or scene; a sound capture is silent."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable

import numpy as np
import pytest
from scipy import ndimage

from rangesim.capture import Capture
from rangesim.decoding import decode
from rangesim.errors import DoubtWarning
from rangesim.sensors import StructuredLight

BITS = 8
ALONE = StructuredLight(2**BITS, 96, code="gray", order=tuple(f"columns_bit{bit}" for bit in reversed(range(BITS))))
BIT = 3
"""The bit whose frame is spoilt: it has 16 edges."""


def scene(sigma_px: float = 1.0) -> np.ndarray:
    """(8, 96, 512) uint8, frames of a wall with a grain behind a step, as a camera of that blur sees them."""
    rng = np.random.default_rng(0)
    grain = 0.8 + 0.2 * rng.random((96, 512))
    shown = ndimage.gaussian_filter1d(np.repeat(ALONE.patterns(), 2, axis=2), sigma_px, axis=2)
    shown[:, 40:60] = np.roll(shown[:, 40:60], 37, axis=2)
    return np.asarray(np.rint(200 * grain * shown + 10 + rng.normal(0, 2, shown.shape)), dtype=np.uint8)


def doubts(frames: np.ndarray) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtWarning)
        return " ".join(decode(Capture(frames, ALONE)).doubts)


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 2.0, 4.0])
def test_sound_frames_are_silent_at_any_blur(sigma_px: float) -> None:
    assert not doubts(scene(sigma_px))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda frame: frame // 2, "frame columns_bit3 lies between dark and lit at .* one exposure"),
        (lambda frame: ndimage.gaussian_filter(frame, 12), "frame columns_bit3 lies between dark and lit"),
        (lambda frame: np.roll(frame, 10, axis=1), "where frame columns_bit3 changes, .* do not see the next cell"),
    ],
    ids=["half the exposure", "blurred", "displaced"],
)
def test_one_frame_apart_is_named(spoil: Callable[[np.ndarray], np.ndarray], said: str) -> None:
    frames = scene(2.0)
    place = BITS - 1 - BIT
    frames[place] = spoil(frames[place])
    assert re.search(said, doubts(frames))
