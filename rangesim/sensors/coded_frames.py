# SPDX-License-Identifier: Apache-2.0
"""Runs of coded frames, of which a structured-light capture consists: Gray code, and fringes.

A run codes one axis of the projector. It knows how its frames are made, named and decoded, how much light they need,
and how they may contradict themselves. So a sensor with a new order of runs, or with runs of a new kind, overrides
`StructuredLight.layout` alone.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rangesim.decoding.axis_code import AxisCode, AxisFrames
from rangesim.decoding.fringes import fringe_contradiction, level_contradiction, refine_by_phase
from rangesim.decoding.gray import (
    GrayThresholds,
    binary_contradiction,
    decode_gray,
    order_contradiction,
    pair_contradiction,
)
from rangesim.decoding.phase_shift import PhaseThresholds
from rangesim.response import DenseResponse, Fringes, GrayBits
from rangesim.sensor import Background, FrameContent, least_signal_for

AXES = ("columns", "rows")
"""Axes of a projector that a code may follow; the index of an axis here is the index of its projector coordinate."""

FRINGE_VISIBILITY = 0.5
"""Amplitude of a fringe as a fraction of the light at full power: fringes go from 0 to 1."""


class CodeThresholds(NamedTuple):
    """Thresholds of all kinds of runs. Each kind takes those that it needs."""

    gray: GrayThresholds
    phase: PhaseThresholds


@dataclass(frozen=True)
class CodedFrames(ABC):
    """A run of frames that code one axis of the projector.

    Parameters
    ----------
    axis : "columns" or "rows". size : int, projector pixels along the axis.
    start : int, index of the first frame in the capture.
    """

    axis: str
    size: int
    start: int

    @property
    @abstractmethod
    def response(self) -> DenseResponse:
        """Response of which the frames are made."""

    @abstractmethod
    def names(self) -> list[str]:
        """One short name per frame."""

    @property
    def span(self) -> slice:
        """Place of the frames in the capture."""
        return slice(self.start, self.start + len(self.names()))

    @property
    def distinct(self) -> range:
        """Indices in the capture of the frames that differ from each other by more than their sign or phase."""
        return range(self.start, self.start + 1)

    @abstractmethod
    def frames(self, channels: np.ndarray, white: np.ndarray, ambient: np.ndarray, out: np.ndarray) -> None:
        """Write the radiance of the frames into `out` (n, h, w), W/m2/sr.

        Parameters
        ----------
        channels : (c, h, w) float32, channels of `response`. white, ambient : (h, w) float32, as in `Sensor.frames`.
        """

    @abstractmethod
    def decode(self, seen: AxisFrames, coarse: AxisCode | None, thresholds: CodeThresholds) -> AxisCode:
        """Projector coordinates along the axis.

        Parameters
        ----------
        seen : the frames of this run. coarse : code of the runs of this axis before this one; None: it is the first.
        """

    @abstractmethod
    def contradiction(self, seen: AxisFrames, coarse: AxisCode | None, code: AxisCode) -> str | None:
        """A sentence if the frames as a whole contradict their code; None if they agree.

        Parameters
        ----------
        seen, coarse : as for `decode`. code : what `decode` returned.
        """

    @abstractmethod
    def least_signal(self, thresholds: CodeThresholds, background: Background) -> np.ndarray:
        """(h, w) float64, least light of the projector at full power that the thresholds accept, in the background's
        unit."""


@dataclass(frozen=True)
class GrayFrames(CodedFrames):
    """Gray bits, most significant first, each followed by its inverse.

    Parameters
    ----------
    bits : int, number of bits that the axis needs. shift : int, number of the finest bits that are left out.

    Examples
    --------
    >>> GrayFrames("rows", size=8, start=0, bits=3, shift=1).names()
    ['rows_bit2', 'rows_bit2_inverse', 'rows_bit1', 'rows_bit1_inverse']
    """

    bits: int
    shift: int

    @property
    def response(self) -> GrayBits:
        return GrayBits(AXES.index(self.axis), self.bits, self.shift)

    def names(self) -> list[str]:
        bits = reversed(range(self.shift, self.bits))
        return [f"{self.axis}_bit{bit}{suffix}" for bit in bits for suffix in ("", "_inverse")]

    @property
    def distinct(self) -> range:
        """The patterns without their inverses."""
        return range(self.span.start, self.span.stop, 2)

    def frames(self, channels: np.ndarray, white: np.ndarray, ambient: np.ndarray, out: np.ndarray) -> None:
        for bit, pattern, inverse in zip(channels, out[0::2], out[1::2], strict=True):
            np.add(bit, ambient, out=pattern, casting="same_kind")
            np.add(white - bit, ambient, out=inverse, casting="same_kind")

    def decode(self, seen: AxisFrames, coarse: AxisCode | None, thresholds: CodeThresholds) -> AxisCode:
        return decode_gray(seen, self.shift, self.size, thresholds.gray)

    def contradiction(self, seen: AxisFrames, coarse: AxisCode | None, code: AxisCode) -> str | None:
        return pair_contradiction(seen) or binary_contradiction(seen, code) or order_contradiction(seen, code)

    def least_signal(self, thresholds: CodeThresholds, background: Background) -> np.ndarray:
        if background.noise_variance is None:
            return background.floor(thresholds.gray.relative_contrast)
        noise_variance = 2 * (background.ambient + background.noise_variance)  # white - black: the noise of two frames
        return least_signal_for(thresholds.gray.contrast_sigmas**2, 1.0, noise_variance)


@dataclass(frozen=True)
class FringeFrames(CodedFrames):
    """Sinusoidal fringes of one period, shifted in equal steps. They refine the code of the runs before.

    Parameters
    ----------
    period_px : float, projector pixels. steps : int, number of frames.

    Examples
    --------
    >>> FringeFrames("columns", size=64, start=6, period_px=16.0, steps=3).names()
    ['columns_phase0', 'columns_phase1', 'columns_phase2']
    """

    period_px: float
    steps: int

    @property
    def response(self) -> Fringes:
        return Fringes(AXES.index(self.axis), self.period_px)

    def names(self) -> list[str]:
        return [f"{self.axis}_phase{step}" for step in range(self.steps)]

    def frames(self, channels: np.ndarray, white: np.ndarray, ambient: np.ndarray, out: np.ndarray) -> None:
        for s, fringe in enumerate(out):
            shift = 2 * math.pi * s / self.steps
            shown = 0.5 * (white + math.cos(shift) * channels[0] + math.sin(shift) * channels[1])
            np.add(shown, ambient, out=fringe, casting="same_kind")

    def decode(self, seen: AxisFrames, coarse: AxisCode | None, thresholds: CodeThresholds) -> AxisCode:
        least_swing = thresholds.gray.relative_bit * seen.contrast.values
        return refine_by_phase(seen, _before(coarse), self.period_px, least_swing, thresholds.phase)

    def contradiction(self, seen: AxisFrames, coarse: AxisCode | None, code: AxisCode) -> str | None:
        gray = _before(coarse)
        return level_contradiction(seen, gray, code) or fringe_contradiction(seen, gray, code, self.period_px)

    def least_signal(self, thresholds: CodeThresholds, background: Background) -> np.ndarray:
        return thresholds.phase.least_signal(self.steps, FRINGE_VISIBILITY, FrameContent(), background)


def _before(coarse: AxisCode | None) -> AxisCode:
    """The code that fringes refine; ValueError if there is none."""
    if coarse is None:
        raise ValueError(
            "expected a code of the same axis before its fringes, because fringes tell only the place within a period."
        )
    return coarse
