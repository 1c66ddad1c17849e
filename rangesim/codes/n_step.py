# SPDX-License-Identifier: Apache-2.0
"""N-step phase shift alone: one period covers the axis, so that its phase is the place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.fringe_checks import stack_contradiction
from rangesim.codes.fringe_stack import FringeStack
from rangesim.codes.fringes import VISIBILITY, FringeConvention
from rangesim.codes.multi_frequency import decode_fringes, mean_and_swing
from rangesim.response import DenseResponse
from rangesim.sensor import Background, FrameContent
from rangesim.settings.bounds import Bounds, check_fields, whole


@dataclass(frozen=True)
class PhaseShift(Code):
    """Sinusoidal fringes of one period, shifted in `steps` equal steps.

    Parameters
    ----------
    period_px : float, projector pixels, at least the size of the axis; None: the size of the axis.
    steps : int >= 3, number of phase shifts. The standard deviation of a place is
        period / (2 pi) sqrt(2 / steps) times the noise over the modulation.
    convention : FringeConvention.

    References
    ----------
    Srinivasan, Liu, Halioua: "Automated phase-measuring profilometry of 3-D diffuse objects", Applied Optics 23 (1984).

    Examples
    --------
    >>> PhaseShift(steps=3).patterns(4).round(2)
    array([[0.85, 0.15, 0.15, 0.85],
           [0.37, 0.98, 0.63, 0.02],
           [0.02, 0.63, 0.98, 0.37]], dtype=float32)
    """

    period_px: Annotated[float, Bounds("projector pixels", 2, 1e6)] | None = None
    steps: Annotated[int, whole(3, "steps")] = 4
    convention: FringeConvention = field(default_factory=FringeConvention)

    type_name: ClassVar[str] = "phase-shift"
    title: ClassVar[str] = "Structured light (phase shift)"

    def __post_init__(self) -> None:
        check_fields(self)

    def stack(self, size: int) -> FringeStack:
        """The fringes for an axis of `size` pixels."""
        period = float(size) if self.period_px is None else self.period_px
        return FringeStack((period,), (self.steps,), self.convention)

    def check(self, size: int) -> None:
        self.stack(size).check(size)

    def names(self, size: int) -> list[str]:
        return self.stack(size).names()

    def patterns(self, size: int) -> np.ndarray:
        return self.stack(size).patterns(size)

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        return self.stack(size).responses(axis)

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        yield from self.stack(size).frames(channels, white)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        return decode_fringes(self.stack(seen.size), seen, thresholds)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return stack_contradiction(seen, code, self.stack(seen.size))

    def white_and_black(self, size: int, names: list[str], frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return mean_and_swing(self.stack(size), frames)

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        return thresholds.phase.least_signal(self.steps, VISIBILITY, FrameContent(), background)

    @property
    def details(self) -> str:
        period = "one period" if self.period_px is None else f"{self.period_px:g} px"
        return f"{self.steps}-step fringes of {period}"

    def representative(self, size: int) -> list[str]:
        return ["phase0", "phase1"]
