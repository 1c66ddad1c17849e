# SPDX-License-Identifier: Apache-2.0
"""Gray code: neighbouring cells of the projector differ in one bit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.bit_code import BitCode
from rangesim.response import GrayBits
from rangesim.settings.bounds import check_fields, whole


@dataclass(frozen=True)
class GrayCode(BitCode):
    """Gray bits of the number of a cell, most significant first, each followed by its inverse.

    Parameters
    ----------
    cell_px : int, projector pixels per cell.

    References
    ----------
    - Inokuchi, Sato, Matsuda: "Range imaging system for 3-D object recognition", ICPR (1984).
    - OpenCV, structured_light module, GrayCodePattern: the same patterns in the same order.

    Examples
    --------
    >>> GrayCode(cell_px=2).patterns(8).astype(int)[::2]
    array([[0, 0, 0, 0, 1, 1, 1, 1],
           [0, 0, 1, 1, 1, 1, 0, 0]])
    """

    cell_px: Annotated[int, whole(1, "projector")] = 1

    type_name: ClassVar[str] = "gray"
    title: ClassVar[str] = "Structured light (Gray code)"
    noun: ClassVar[str] = "Gray code"  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_fields(self)

    def words_of_cells(self, bits: int) -> np.ndarray:
        cell = np.arange(1 << bits)
        return cell ^ (cell >> 1)

    def responses(self, axis: int, size: int) -> tuple[GrayBits, ...]:
        return (GrayBits(axis, self.bits(size), self.cell_px),)
