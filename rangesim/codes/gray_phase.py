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
from rangesim.codes.fringe_checks import fringe_contradiction, level_contradiction, stack_contradiction
from rangesim.codes.fringe_stack import FringeStack
from rangesim.codes.fringes import VISIBILITY, FringeConvention
from rangesim.codes.gray import GrayCode
from rangesim.codes.phase_refinement import refine_by_phase
from rangesim.response import DenseResponse
from rangesim.sensor import Background, FrameContent, ReceivedLight
from rangesim.settings.bounds import Bounds, check_fields, whole

GUARD_TURNS = 1 / 8
"""Distance beyond the edges of a Gray cell, in periods of the fringes, at which a place may still lie: for noise, four
standard deviations of the noisiest phase that is accepted, and for camera pixels across the edge of a cell."""


@dataclass(frozen=True)
class GrayPhase(Code):
    """Gray code that finds the cycle of sinusoidal fringes, and the fringes, shifted in equal steps.

    By default the cells are half a period or finer, so that a bit error at a stripe's edge cannot become a period
    error. Cells of up to a period are decoded too, but then places near the edges of a cell that may belong to two
    cycles are refused (`CODE_ERROR`). Fringes of a second period tell them: their beat with the first is longer than a
    cell.

    Parameters
    ----------
    period_px : float, period of the fringes in projector pixels.
    steps : int >= 3, number of phase shifts of each period.
    convention : FringeConvention.
    cell_px : int, projector pixels per Gray cell, of any size that the fringes can tell; None: the largest power of two
        that fits into half a period.
    further_periods_px : float, projector pixels, periods of further fringes, shown after those of `period_px`.

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
    cell_px: Annotated[int, whole(1, "projector")] | None = None
    further_periods_px: tuple[Annotated[float, Bounds("projector pixels", 2, 1e6)], ...] = ()

    type_name: ClassVar[str] = "gray-phase"
    title: ClassVar[str] = "Structured light"
    is_by_pixel: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_fields(self)

    def gray(self, size: int) -> GrayCode:
        """The Gray code, of cells of `cell_px` or as large as the largest power of two that fits into half a period."""
        if self.cell_px is not None:
            return GrayCode(self.cell_px)
        bits = math.ceil(math.log2(size))
        return GrayCode(1 << max(0, min(bits - 1, math.floor(math.log2(self.period_px / 2)))))

    @property
    def stack(self) -> FringeStack:
        """The fringes."""
        periods = (self.period_px, *self.further_periods_px)
        return FringeStack(periods, (self.steps,) * len(periods), self.convention)

    def check(self, size: int) -> None:
        gray = self.gray(size)
        if gray.bits(size) == 1 and gray.cell_px >= size:
            return
        if not self.further_periods_px and gray.cell_px > self.period_px:
            raise ValueError(
                f"expected cell_px to be at most the period of {self.period_px:g} pixels, got {gray.cell_px}: the "
                "fringes repeat within a cell; take smaller cells, or set further_periods_px."
            )
        if self.further_periods_px:
            self.stack.check(min(size, gray.cell_px + math.ceil(self._guard_px())))

    def _guard_px(self) -> float:
        """Distance beyond the edge of a cell up to which a place is accepted, projector pixels."""
        return GUARD_TURNS * max(self.stack.periods_px)

    def names(self, size: int) -> list[str]:
        return [*self.gray(size).names(size), *self.stack.names()]

    def patterns(self, size: int) -> np.ndarray:
        return np.concatenate([self.gray(size).patterns(size), self.stack.patterns(size)])

    def check_shown(self, size: int, shown: Sequence[str]) -> None:
        self.gray(size).check_shown(size, shown)
        super().check_shown(size, [*self.gray(size).names(size), *shown])

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        return (*self.gray(size).responses(axis, size), *self.stack.responses(axis))

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        yield from self.gray(size).frames(size, channels[:1], white)
        yield from self.stack.frames(channels[1:], white)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        gray = self.gray(seen.size).decode(seen.starting_with("bit"), thresholds)
        least_swing = thresholds.gray.relative_bit * seen.contrast.values
        fringes = self._fringes(seen)
        if not self.further_periods_px:
            return refine_by_phase(fringes, gray, self.period_px, self.convention, least_swing, thresholds.phase)
        reach = np.float32(gray.cell_px / 2 + self._guard_px())
        low, high = gray.coordinate - reach, gray.coordinate + reach
        return self.stack.decode(fringes, low, high, least_swing, thresholds.phase, gray)

    def _fringes(self, seen: AxisFrames) -> AxisFrames:
        """The frames of the fringes alone."""
        return seen.starting_with("p")  # phase0 ... of one period, period0_phase0 ... of several

    def place_sigma_px(self, axis: int, size: int, light: ReceivedLight) -> np.ndarray:
        return self.stack.place_sigma_px(light, axis)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        gray, fringes = code.coarse, self._fringes(seen)
        assert gray is not None
        text = self.gray(seen.size).contradiction(seen.starting_with("bit"), gray)
        for i, period_px in enumerate(self.stack.periods_px):
            if text is None:
                one = self.stack.frames_of(fringes, i)
                text = level_contradiction(one, gray, code, code.gammas[i]) or fringe_contradiction(
                    one, gray, code, period_px, self.convention
                )
        return text or stack_contradiction(fringes, code, self.stack)

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        needed = thresholds.phase.least_signal(self.steps, VISIBILITY, FrameContent(), background)
        return np.maximum(self.gray(size).least_signal(size, shown, thresholds, background), needed)

    @property
    def details(self) -> str:
        periods = " and ".join(f"{p:g}" for p in self.stack.periods_px)
        return f"Gray code and {self.steps}-step fringes of {periods} px"

    def representative(self, size: int) -> list[str]:
        return [self.gray(size).representative(size)[0], self.stack.names()[0]]
