# SPDX-License-Identifier: Apache-2.0
"""Fringes of several periods: one place of the axis agrees with all their phases."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.fringe_code import FringeCode
from rangesim.codes.fringe_stack import FringeStack
from rangesim.codes.fringes import FringeConvention
from rangesim.settings.bounds import Bounds, check_fields, whole

FINEST_PX = 16.0
"""Finest period by default, in projector pixels: as of `GrayPhase`, wide enough for cameras with fewer pixels than the
projector."""

MAX_RATIO = 10.0
"""Largest ratio of a period to the next finer one, by default. The noise of a phase counts that many times as much when
it chooses the cycle of the next one; with more periods it counts less, but they take more frames."""


@dataclass(frozen=True)
class MultiFrequency(FringeCode):
    """Sinusoidal fringes of several periods, `steps` of each, without Gray code.

    The decoder looks for the place between 0 and the size of the axis on which all phases agree. So it needs to know
    no method: if the coarsest period covers the axis, this is hierarchical unwrapping; if the beats of similar periods
    do, heterodyne; if periods without a common divisor do, number-theoretic. Each of the three is a code with periods
    of its own: "multi-frequency", "heterodyne", "number-theoretic".

    Parameters
    ----------
    periods_px : float, projector pixels, in the order in which they are shown; none: as `default_periods` makes them.
    steps : int >= 3, phase shifts of each period. steps_each : int >= 3, one per period; none: `steps` of all.
    convention : FringeConvention of all periods.

    References
    ----------
    Huntley, Saldner: "Temporal phase-unwrapping algorithm for automated interferogram analysis", Applied Optics 32
    (1993).

    Examples
    --------
    >>> [round(period, 1) for period in MultiFrequency().default_periods(1280)]
    [1280.0, 143.1, 16.0]
    >>> MultiFrequency((64.0, 8.0), steps=3).names(64)
    ['period0_phase0', 'period0_phase1', 'period0_phase2', 'period1_phase0', 'period1_phase1', 'period1_phase2']
    """

    periods_px: tuple[Annotated[float, Bounds("projector pixels", 2, 1e6)], ...] = ()
    steps: Annotated[int, whole(3, "steps")] = 4
    steps_each: tuple[Annotated[int, whole(3, "steps")], ...] = ()
    convention: FringeConvention = field(default_factory=FringeConvention)

    type_name: ClassVar[str] = "multi-frequency"
    title: ClassVar[str] = "Structured light (fringes of several periods)"

    def __post_init__(self) -> None:
        check_fields(self)
        if self.periods_px and self.steps_each and len(self.steps_each) != len(self.periods_px):
            raise ValueError(
                f"expected steps_each with one number for each of the {len(self.periods_px)} periods, "
                f"got {len(self.steps_each)}."
            )

    def default_periods(self, size: int) -> tuple[float, ...]:
        """Periods for an axis of `size` pixels: the size, and finer ones in equal ratios down to `FINEST_PX`."""
        if size <= FINEST_PX:
            return (float(size),)
        ratio = size / FINEST_PX
        levels = max(1, math.ceil(math.log(ratio) / math.log(MAX_RATIO) - 1e-9))
        return tuple(size / ratio ** (i / levels) for i in range(levels + 1))

    def stack(self, size: int) -> FringeStack:
        periods = self.periods_px or self.default_periods(size)
        return FringeStack(periods, self.steps_each or (self.steps,) * len(periods), self.convention)

    def check(self, size: int) -> None:
        periods = self.periods_px or self.default_periods(size)
        if self.steps_each and len(self.steps_each) != len(periods):
            raise ValueError(
                f"expected steps_each with one number for each of the {len(periods)} periods, "
                f"got {len(self.steps_each)}."
            )
        super().check(size)

    @property
    def details(self) -> str:
        steps = "-, ".join(str(s) for s in dict.fromkeys(self.steps_each)) or str(self.steps)
        periods = f" of {', '.join(f'{p:g}' for p in self.periods_px)} px" if self.periods_px else ""
        return f"{steps}-step fringes{periods or ' of several periods'}"

    def representative(self, size: int) -> list[str]:
        stack = self.stack(size)
        order = np.argsort(stack.periods_px)
        first = np.concatenate([[0], np.cumsum(stack.steps)])
        names = stack.names()
        return [names[first[order[-1]]], names[first[order[0]]]]


@dataclass(frozen=True)
class Heterodyne(MultiFrequency):
    """Fringes of three similar periods whose beats cover the axis: n, n - 1 and n - sqrt(n) fringes in all.

    The beat of the first two is as long as the axis, and that of the first and the third is sqrt(n) times finer.
    Settings and decoder are those of `MultiFrequency`.

    References
    ----------
    - Reich, Ritter, Thesing: "White light heterodyne principle for 3D-measurement", Proc. SPIE 3100 (1997).
    - Towers, Towers, Jones: "Optimum frequency selection in multifrequency interferometry", Optics Letters 28 (2003).

    Examples
    --------
    >>> Heterodyne().default_periods(1296)
    (16.0, 16.2, 18.0)
    """

    type_name: ClassVar[str] = "heterodyne"
    title: ClassVar[str] = "Structured light (heterodyne fringes)"

    def default_periods(self, size: int) -> tuple[float, ...]:
        """Three periods of nearly `FINEST_PX` pixels whose beats cover `size` pixels."""
        n = max(4, round(size / FINEST_PX))
        return tuple(max(2.0, size / fringes) for fringes in (n, n - 1, n - round(math.sqrt(n))))


@dataclass(frozen=True)
class NumberTheoretic(MultiFrequency):
    """Fringes of three periods that are whole numbers of pixels without a common divisor.

    Their phases repeat together after the product of the periods, which covers the axis. Settings and decoder are those
    of `MultiFrequency`.

    References
    ----------
    - Gushov, Solodkin: "Automatic processing of fringe patterns in integer interferometers", Optics and Lasers in
      Engineering 14 (1991).
    - Zhong, Wang: "Phase unwrapping by lookup table method: application to phase map with singular points", Optical
      Engineering 38 (1999), for two periods.

    Examples
    --------
    >>> NumberTheoretic().default_periods(1280)
    (13.0, 12.0, 11.0)
    """

    type_name: ClassVar[str] = "number-theoretic"
    title: ClassVar[str] = "Structured light (number-theoretic fringes)"

    def default_periods(self, size: int) -> tuple[float, ...]:
        """The smallest m + 2, m + 1 and m, m odd, whose product is at least `size`; no two have a common divisor."""
        m = 3
        while m * (m + 1) * (m + 2) < size:
            m += 2
        return float(m + 2), float(m + 1), float(m)
