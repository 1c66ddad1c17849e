# SPDX-License-Identifier: Apache-2.0
"""Gray code with fringes: Gray code finds the period, phase shift finds the place within it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.fringe_checks import fringe_contradiction, level_contradiction
from rangesim.codes.fringes import FringeConvention
from rangesim.codes.gray import GrayCode
from rangesim.codes.phase_refinement import refine_by_phase
from rangesim.response import DenseResponse, Fringes
from rangesim.sensor import Background, FrameContent
from rangesim.settings.bounds import Bounds, check_fields, whole

FRINGE_VISIBILITY = 0.5
"""Amplitude of a fringe as a fraction of the light at full power: fringes go from 0 to 1."""


@dataclass(frozen=True)
class GrayPhase(Code):
    """Gray code down to half a period or finer, so that a bit error at a stripe's edge cannot become a period error;
    then `steps` sinusoidal fringes, shifted in equal steps.

    Parameters
    ----------
    period_px : float, period of the fringes in projector pixels.
    steps : int >= 3, number of phase shifts.
    convention : FringeConvention.

    References
    ----------
    Sansoni, Carocci, Rodella: "Three-dimensional vision based on a combination of gray-code and phase-shift light
    projection", Applied Optics 38 (1999).

    Examples
    --------
    >>> GrayPhase(period_px=8.0, steps=3).names(16)
    ['bit1', 'bit1_inverse', 'bit0', 'bit0_inverse', 'phase0', 'phase1', 'phase2']
    """

    period_px: Annotated[float, Bounds("projector pixels", 2, 1e6)] = 16.0
    steps: Annotated[int, whole(3, "steps")] = 4
    convention: FringeConvention = field(default_factory=FringeConvention)

    type_name: ClassVar[str] = "gray-phase"
    title: ClassVar[str] = "Structured light"

    def __post_init__(self) -> None:
        check_fields(self)

    def gray(self, size: int) -> GrayCode:
        """The Gray code, of cells as large as the largest power of two that fits into half a period."""
        bits = math.ceil(math.log2(size))
        return GrayCode(1 << max(0, min(bits - 1, math.floor(math.log2(self.period_px / 2)))))

    def names(self, size: int) -> list[str]:
        return [*self.gray(size).names(size), *(f"phase{step}" for step in range(self.steps))]

    def patterns(self, size: int) -> np.ndarray:
        x = np.arange(size) + 0.5
        fringes = [self.convention.pattern(x, self.period_px, step, self.steps) for step in range(self.steps)]
        return np.concatenate([self.gray(size).patterns(size), np.array(fringes, dtype=np.float32)])

    def check_shown(self, size: int, shown: Sequence[str]) -> None:
        self.gray(size).check_shown(size, shown)
        super().check_shown(size, [*self.gray(size).names(size), *shown])

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        return (*self.gray(size).responses(axis, size), Fringes(axis, self.period_px))

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        yield from self.gray(size).frames(size, channels[:1], white)
        cosine, sine = channels[1]
        for step in range(self.steps):
            shift = 2 * math.pi * self.convention.shift_turns(step, self.steps, self.period_px)
            yield 0.5 * (white + math.cos(shift) * cosine + math.sin(shift) * sine)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        gray = self.gray(seen.size).decode(seen.starting_with("bit"), thresholds)
        least_swing = thresholds.gray.relative_bit * seen.contrast.values
        fringes = seen.starting_with("phase")
        return refine_by_phase(fringes, gray, self.period_px, self.convention, least_swing, thresholds.phase)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        gray, fringes = code.coarse, seen.starting_with("phase")
        assert gray is not None
        return (
            self.gray(seen.size).contradiction(seen.starting_with("bit"), gray)
            or level_contradiction(fringes, gray, code)
            or fringe_contradiction(fringes, gray, code, self.period_px, self.convention)
        )

    def least_signal(self, size: int, thresholds: CodeThresholds, background: Background) -> np.ndarray:
        needed = thresholds.phase.least_signal(self.steps, FRINGE_VISIBILITY, FrameContent(), background)
        return np.maximum(super().least_signal(size, thresholds, background), needed)

    @property
    def details(self) -> str:
        return f"Gray code and {self.steps}-step fringes of {self.period_px:g} px"

    def representative(self, size: int) -> list[str]:
        return [self.gray(size).representative(size)[0], "phase0"]
