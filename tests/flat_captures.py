# SPDX-License-Identifier: Apache-2.0
"""Captures of a camera that sees the projector's image flat: one pixel of a row for each place."""

from __future__ import annotations

import numpy as np

from rangesim.capture import Capture
from rangesim.electronics.detector import Detector
from rangesim.sensors import StructuredLight

WHITE_DN = 3000.0
"""Digital number of white in noisy captures, of 4095."""


def capture_at(sensor: StructuredLight, x: np.ndarray, rows: int = 1, gamma: float = 1.0) -> Capture:
    """Noise-free capture of columns x (n,), projector pixels; between two pixels, the patterns are interpolated."""
    table = sensor.patterns()[:, 0].astype(np.float64) ** gamma
    frames = np.array([np.interp(x, np.arange(table.shape[1]) + 0.5, pattern) for pattern in table])
    return Capture(np.repeat(frames[:, None], rows, axis=1).astype(np.float32), sensor)


def noisy(capture: Capture, white_dn: float = WHITE_DN, seed: int = 0) -> Capture:
    """The capture as a 12-bit camera takes it, with the noise that its detector states."""
    detector = Detector()
    clean = np.float32(detector.black_level_dn) + np.float32(white_dn) * capture.frames
    noise = np.stack([detector.noise_dn(frame) for frame in clean])
    noise *= np.random.default_rng(seed).normal(size=clean.shape).astype(np.float32)
    return Capture(
        np.clip(np.rint(clean + noise), 0, detector.max_dn).astype(np.uint16), capture.sensor, None, detector
    )


def as_bytes(capture: Capture) -> Capture:
    """The capture as an unknown camera of 8 bits takes it."""
    return Capture(np.rint(10 + 200 * capture.frames).astype(np.uint8), capture.sensor)


def all_columns(sensor: StructuredLight, rows: int = 4) -> tuple[Capture, np.ndarray]:
    """Capture of all columns at their centres, and the centres."""
    x = np.arange(sensor.projector_width) + 0.5
    return capture_at(sensor, x, rows), x
