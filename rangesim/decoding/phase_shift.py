# SPDX-License-Identifier: Apache-2.0
"""N-step phase shift: fringe frames to a phase, and to a sub-pixel coordinate with the help of Gray code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.bands import bands
from rangesim.decoding.gray import RELATIVE_BIT, GrayCode, direct_contrast
from rangesim.status import Status

MAX_PHASE_SIGMA = 0.2
"""Radians: a phase with a larger standard deviation is refused as low signal."""
MODULATION_SHARE = 2.5 / 255
"""Least modulation of full scale for digital captures of an unknown detector."""
RELATIVE_MODULATION = 0.01
"""Least modulation of a pixel's own brightness for noise-free captures."""


@dataclass(frozen=True, eq=False)
class Phase:
    """turns : (h, w) float32 in [0, 1), phase over 2 pi. modulation, mean : (h, w) float32, the capture's units."""

    turns: np.ndarray
    modulation: np.ndarray
    mean: np.ndarray


def phase_of(frames: np.ndarray) -> Phase:
    """Least-squares phase phi of frames I_s = mean + modulation cos(phi - 2 pi s / N), (N, h, w), N >= 3.

    References
    ----------
    Bruning et al.: "Digital wavefront measuring interferometer for testing optical surfaces and lenses",
    Applied Optics 13 (1974); their least-squares solution for equal steps.
    """
    n = len(frames)
    cosine = np.zeros(frames.shape[1:], dtype=np.float32)
    sine, total = np.zeros_like(cosine), np.zeros_like(cosine)
    for s, frame in enumerate(frames):
        value = frame.astype(np.float32)
        cosine += np.float32(np.cos(2 * np.pi * s / n)) * value
        sine += np.float32(np.sin(2 * np.pi * s / n)) * value
        total += value
    turns = np.arctan2(sine, cosine) * np.float32(1 / (2 * np.pi))
    return Phase(np.where(turns < 0, turns + 1, turns), np.hypot(cosine, sine) * np.float32(2 / n), total / n)


def phase_sigma(capture: Capture, phase: Phase, steps: int) -> np.ndarray | None:
    """(h, w) standard deviation of the phase in radians, sqrt(2 / N) sigma_I / B; None if the detector is unknown."""
    noise = capture.noise(phase.mean)
    if noise is None:
        return None
    return np.asarray(np.sqrt(2 / steps) * noise / np.maximum(phase.modulation, np.finfo(np.float32).tiny))


def modulation_is_weak(capture: Capture, phase: Phase, steps: int) -> np.ndarray:
    """(h, w) bool, where the phase is not to be trusted."""
    sigma = phase_sigma(capture, phase, steps)
    if sigma is not None:
        return np.asarray(sigma > MAX_PHASE_SIGMA)
    if capture.is_digital:
        return np.asarray(phase.modulation < MODULATION_SHARE * capture.full_scale)
    return np.asarray(phase.modulation <= RELATIVE_MODULATION * np.maximum(phase.mean, 0))


def refine_by_phase(capture: Capture, gray: GrayCode, frames: np.ndarray, period_px: float) -> GrayCode:
    """Sub-pixel coordinate: of all places with this phase, the one nearest to the Gray coordinate.

    Gray cells are half a period at most, so the right place lies at most a quarter of a period off the centre
    of its cell, and an eighth more is granted to noise and to camera pixels across a cell's edge. Farther
    off, code and phase contradict each other (`CODE_ERROR`).

    Parameters
    ----------
    frames : (N, h, w) fringe frames of the same axis. period_px : float, projector pixels.
    """
    coordinate, status = np.empty_like(gray.coordinate), gray.status.copy()
    contrast, _ = direct_contrast(capture)
    for rows in bands(len(status)):
        phase, whole, refused = phase_of(frames[:, rows]), gray.coordinate[rows], status[rows]
        periods = np.rint(whole / np.float32(period_px) - phase.turns)
        coordinate[rows] = (periods + phase.turns) * np.float32(period_px)
        ok = refused == Status.OK
        contradiction = np.abs(coordinate[rows] - whole) > gray.cell_px / 2 + period_px / 8
        washed_out = 2 * phase.modulation < RELATIVE_BIT * contrast[rows]  # as those seen by interreflection alone
        refused[ok & contradiction] = Status.CODE_ERROR
        refused[ok & (modulation_is_weak(capture, phase, len(frames)) | washed_out)] = Status.LOW_SIGNAL
        refused[ok & capture.saturated(frames[:, rows])] = Status.SATURATED
    return GrayCode(coordinate, status, gray.cell_px)
