# SPDX-License-Identifier: Apache-2.0
"""XOR code: Gray code without coarse patterns, so that light from elsewhere cannot exchange lit and dark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.bit_code import BitCode
from rangesim.settings.bounds import Bounds, check_fields, whole


@dataclass(frozen=True)
class XorCode(BitCode):
    """Gray bits, each but one combined with that one, the base, by exclusive or.

    A coarse stripe becomes a train of the stripes of the base, or of their inverse. Half of what a surface sees of the
    others is then lit in every frame, so that interreflection adds the same light to a pattern and its inverse.

    Parameters
    ----------
    base_bit : int, number of the Gray bit that is the base. 0, the finest one, is XOR-02 of the paper: no stripe is
        wider than two cells. 1 is XOR-04: no stripe is wider than four cells.
    cell_px : int, projector pixels per cell.

    References
    ----------
    Gupta, Agrawal, Veeraraghavan, Narasimhan: "Structured light 3D scanning in the presence of global illumination",
    CVPR (2011).

    Examples
    --------
    >>> XorCode().patterns(8).astype(int)[::2]
    array([[0, 1, 1, 0, 1, 0, 0, 1],
           [0, 1, 0, 1, 1, 0, 1, 0],
           [0, 1, 1, 0, 0, 1, 1, 0]])
    """

    base_bit: Annotated[int, Bounds("the number of a bit", 0, 31)] = 0
    cell_px: Annotated[int, whole(1, "projector")] = 1

    type_name: ClassVar[str] = "xor"
    title: ClassVar[str] = "Structured light (XOR code)"

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def noun(self) -> str:
        return f"XOR-{2 << self.base_bit:02d} code"

    @classmethod
    def variants(cls) -> tuple[XorCode, ...]:
        return cls(0), cls(1)

    def check(self, size: int) -> None:
        if self.base_bit >= self.bits(size):
            raise ValueError(
                f"expected base_bit below {self.bits(size)}, the number of bits of {size} projector pixels in cells of "
                f"{self.cell_px}, got {self.base_bit}."
            )

    def words_of_cells(self, bits: int) -> np.ndarray:
        cell = np.arange(1 << bits)
        gray = cell ^ (cell >> 1)
        others = (1 << bits) - 1 - (1 << self.base_of(bits))
        return gray ^ (others * ((gray >> self.base_bit) & 1))

    def base_of(self, bits: int) -> int:
        return min(self.base_bit, bits - 1)
