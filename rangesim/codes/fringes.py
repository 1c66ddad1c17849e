# SPDX-License-Identifier: Apache-2.0
"""Conventions of sinusoidal fringes: where the first pattern starts, and which way the next ones move."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from rangesim.settings.bounds import Bounds, check_fields

STARTS = {"cos": 0.0, "sin": 0.25, "-cos": 0.5, "-sin": 0.75, "cos-120": 1 / 3, "cos+120": 2 / 3}
"""Phase of the first pattern at the origin, by its name, in turns before that of a cosine. Three-step fringes often
start at -120 degrees, so that the second pattern is the cosine."""

VISIBILITY = 0.5
"""Amplitude of a fringe as a fraction of the light at full power: fringes go from 0 to 1."""


@dataclass(frozen=True)
class FringeConvention:
    """Start, direction and origin of fringes.

    Pattern s of N is 1/2 + 1/2 cos(2 pi ((x - origin_px) / P - start -+ s / N)).

    Parameters
    ----------
    start : function that the first pattern follows from the origin on: "cos", "sin", "-cos", "-sin", or a cosine whose
        phase is 120 degrees less or more, "cos-120" and "cos+120".
    direction : "forward" if each pattern is the one before moved towards larger x (- s / N), as in
        I_s = A + B cos(phi - 2 pi s / N); "backward" if towards smaller x (+ s / N).
    origin_px : float, projector coordinate at which the first pattern starts. Pixel centres lie at integer + 0.5, so
        0 is the edge of the first pixel, and 0.5 is its centre.

    Examples
    --------
    >>> FringeConvention(start="sin").pattern(np.array([0.0, 2.0, 4.0]), 8.0, 0, 4)
    array([0.5, 1. , 0.5])
    """

    start: Literal["cos", "sin", "-cos", "-sin", "cos-120", "cos+120"] = "cos"
    direction: Literal["forward", "backward"] = "forward"
    origin_px: Annotated[float, Bounds("projector pixels", -1e6, 1e6)] = 0.0

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def sign(self) -> int:
        """1 for "forward", -1 for "backward"."""
        return 1 if self.direction == "forward" else -1

    def shift_turns(self, step: int, steps: int, period_px: float) -> float:
        """Shift of a pattern in turns: the pattern is 1/2 + 1/2 cos(2 pi (x / period_px - shift))."""
        return self.sign * step / steps + STARTS[self.start] + self.origin_px / period_px

    def pattern(self, x: np.ndarray, period_px: float, step: int, steps: int) -> np.ndarray:
        """(n,) values of pattern `step` of `steps`, 0 to 1, at projector coordinates x (n,)."""
        return np.asarray(0.5 + 0.5 * np.cos(2 * math.pi * (x / period_px - self.shift_turns(step, steps, period_px))))

    def place_turns(self, normalised: np.ndarray, period_px: float) -> np.ndarray:
        """Place within the period, x / period_px in [0, 1), from the phase that `phase_of` finds, in turns.

        Parameters
        ----------
        normalised : (...) float32, phase in turns of frames I_s = mean + modulation cos(phase - 2 pi s / N).
        """
        place = self.sign * normalised + np.float32(self.shift_turns(0, 1, period_px))
        return np.asarray(place - np.floor(place))
