# SPDX-License-Identifier: Apache-2.0
"""N-step phase shift alone: one period covers the axis, so that its phase is the place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from rangesim.codes.fringe_code import FringeCode
from rangesim.codes.fringe_stack import FringeStack
from rangesim.codes.fringes import FringeConvention
from rangesim.settings.bounds import Bounds, check_fields, whole


@dataclass(frozen=True)
class PhaseShift(FringeCode):
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
           [0.63, 0.98, 0.37, 0.02],
           [0.02, 0.37, 0.98, 0.63]], dtype=float32)
    """

    period_px: Annotated[float, Bounds("projector pixels", 2, 1e6)] | None = None
    steps: Annotated[int, whole(3, "steps")] = 4
    convention: FringeConvention = field(default_factory=FringeConvention)

    type_name: ClassVar[str] = "phase-shift"
    title: ClassVar[str] = "Structured light (phase shift)"

    def __post_init__(self) -> None:
        check_fields(self)

    def stack(self, size: int) -> FringeStack:
        period = float(size) if self.period_px is None else self.period_px
        return FringeStack((period,), (self.steps,), self.convention)

    @property
    def details(self) -> str:
        period = "one period" if self.period_px is None else f"{self.period_px:g} px"
        return f"{self.steps}-step fringes of {period}"

    def representative(self, size: int) -> list[str]:
        return ["phase0", "phase1"]
