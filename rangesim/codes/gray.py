# SPDX-License-Identifier: Apache-2.0
"""Gray code: neighbouring cells of the projector differ in one bit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.gray_bits import decode_gray
from rangesim.codes.gray_checks import binary_contradiction, order_contradiction, pair_contradiction
from rangesim.response import GrayBits
from rangesim.settings.bounds import check_fields, whole


@dataclass(frozen=True)
class GrayCode(Code):
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

    def __post_init__(self) -> None:
        check_fields(self)

    def bits(self, size: int) -> int:
        """Number of bits, at least one."""
        return max(1, math.ceil(math.log2(math.ceil(size / self.cell_px))))

    def names(self, size: int) -> list[str]:
        return [f"bit{bit}{suffix}" for bit in reversed(range(self.bits(size))) for suffix in ("", "_inverse")]

    def patterns(self, size: int) -> np.ndarray:
        cell = np.arange(size) // self.cell_px
        word = cell ^ (cell >> 1)
        shown = [(word >> bit) & 1 for bit in reversed(range(self.bits(size)))]
        return np.array([row for bit in shown for row in (bit, 1 - bit)], dtype=np.float32)

    def responses(self, axis: int, size: int) -> tuple[GrayBits, ...]:
        return (GrayBits(axis, self.bits(size), self.cell_px),)

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        for bit in channels[0]:
            yield bit
            yield white - bit

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        return decode_gray(seen, self.cell_px, thresholds.gray)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return pair_contradiction(seen) or binary_contradiction(seen, code) or order_contradiction(seen, code)

    @property
    def details(self) -> str:
        return "Gray code" if self.cell_px == 1 else f"Gray code of {self.cell_px} px"

    def representative(self, size: int) -> list[str]:
        patterns = self.names(size)[::2]
        return [patterns[len(patterns) // 2], patterns[-1]]
