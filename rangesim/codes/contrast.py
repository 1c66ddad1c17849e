# SPDX-License-Identifier: Apache-2.0
"""Contrast of the white and the black image of a capture, and the noise of differences of frames."""

from __future__ import annotations

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.codes.axis_code import Contrast
from rangesim.codes.thresholds import GrayThresholds


def direct_contrast(capture: Capture, white: np.ndarray, black: np.ndarray, thresholds: GrayThresholds) -> Contrast:
    """Contrast of the white and the black frame (h, w) of a capture."""
    bright, dark = white.astype(np.float32), black.astype(np.float32)
    contrast = bright - dark
    noise = difference_noise(capture, bright, dark)
    if noise is not None:
        least: np.ndarray | float = thresholds.contrast_sigmas * noise
    elif capture.is_digital:
        least = thresholds.contrast_of_scale * capture.full_scale
    else:
        least = thresholds.relative_contrast * bright_level(contrast)
    return Contrast(white, black, contrast, np.asarray(contrast > least))


def difference_noise(capture: Capture, a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """(h, w) standard deviation of a - b; None if the detector is unknown or the capture is noise-free."""
    noise_a, noise_b = capture.noise(a), capture.noise(b)
    return None if noise_a is None or noise_b is None else np.sqrt(noise_a**2 + noise_b**2)
