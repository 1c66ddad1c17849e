# SPDX-License-Identifier: Apache-2.0
"""The direction of fringes is told by pixels less than half a period apart, and by no others."""

from __future__ import annotations

import numpy as np
import pytest

from rangesim.codes import FringeConvention, GrayPhase
from rangesim.conventions import detect_convention
from rangesim.sensors import StructuredLight

MIRRORED = FringeConvention("-cos", "backward")
"""Fringes whose places lie in the cells of half a period as those of the default do, on the other side of each cell."""


def taken(shown: GrayPhase, pitch_px: float) -> np.ndarray:
    """Frames of a camera whose pixels are `pitch_px` projector pixels apart and average over half of that."""
    patterns = StructuredLight(1280, 8, shown).patterns()[:, :1]
    centres = (np.arange(int(1279 / pitch_px)) + 0.5) * pitch_px
    parts = (np.arange(32) + 0.5) / 32 - 0.5
    frames = np.mean([patterns[:, :, (centres + 0.5 * pitch_px * part).astype(int)] for part in parts], axis=0)
    return np.repeat(0.1 + frames, 40, axis=1).astype(np.float32)


@pytest.mark.parametrize("pitch_px", [1, 2.5, 4, 6, 7, 8.5, 10, 12, 14, 15, 17, 20])
@pytest.mark.parametrize("code", [GrayPhase(), GrayPhase(cell_px=16), GrayPhase(32.0, 3)], ids=repr)
def test_sound_fringes_keep_their_convention(code: GrayPhase, pitch_px: float) -> None:
    """A step of more than half a period looks like one the other way."""
    sensor = StructuredLight(1280, 8, code)
    found = detect_convention(taken(code, pitch_px), sensor)
    assert found.sensor == sensor
    assert not found.findings


@pytest.mark.parametrize("pitch_px", [1, 2.5, 4, 6, 7])
def test_mirrored_fringes_are_found_where_pixels_tell(pitch_px: float) -> None:
    found = detect_convention(taken(GrayPhase(convention=MIRRORED), pitch_px), StructuredLight(1280, 8, GrayPhase()))
    assert found.sensor.code == GrayPhase(convention=MIRRORED)
