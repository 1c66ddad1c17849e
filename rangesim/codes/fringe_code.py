# SPDX-License-Identifier: Apache-2.0
"""Codes of fringes alone: the place of the axis on which the phases of all periods agree."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.fringe_checks import stack_contradiction
from rangesim.codes.fringe_stack import FringeStack
from rangesim.codes.fringes import VISIBILITY
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.row_bands import in_bands
from rangesim.response import DenseResponse
from rangesim.sensor import Background, FrameContent, ReceivedLight


class FringeCode(Code):
    """A code whose frames are fringes of one or several periods, and nothing else. Subclasses are frozen dataclasses.

    Examples
    --------
    >>> from rangesim.codes import PhaseShift
    >>> PhaseShift(steps=3).stack(640).periods_px
    (640.0,)
    """

    tells_direction: ClassVar[bool] = False
    is_by_pixel: ClassVar[bool] = True

    @abstractmethod
    def stack(self, size: int) -> FringeStack:
        """The fringes for an axis of `size` projector pixels."""

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
        swing = thresholds.gray.relative_bit * seen.contrast.values if seen.contrast.is_measured else 0.0
        return self.stack(seen.size).decode(seen, 0.0, float(seen.size), swing, thresholds.phase)

    def place_sigma_px(self, axis: int, size: int, light: ReceivedLight) -> np.ndarray:
        return self.stack(size).place_sigma_px(light, axis)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return stack_contradiction(seen, code, self.stack(seen.size))

    def white_and_black(self, size: int, names: list[str], frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mean of the fringes plus and minus their largest modulation."""
        stack = self.stack(size)
        white, black = np.empty((2, *frames.shape[1:]), dtype=np.float32)

        def estimate_rows(rows: slice) -> None:
            phases = [phase_of(stack.of_period(frames, i)[:, rows]) for i in range(len(stack.steps))]
            mean = np.mean([p.mean for p in phases], axis=0)
            modulation = np.max([p.modulation for p in phases], axis=0)
            white[rows], black[rows] = mean + modulation, mean - modulation

        in_bands(estimate_rows, len(white))
        return white, black

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        stack = self.stack(size)
        sigma_rad = min(thresholds.phase.max_sigma_rad, stack.max_sigma_rad(size))
        phase = replace(thresholds.phase, max_sigma_rad=sigma_rad)
        return phase.least_signal(min(stack.steps), VISIBILITY, FrameContent(), background)
