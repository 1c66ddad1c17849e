# SPDX-License-Identifier: Apache-2.0
"""Plain binary code: the bits of the number of a cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from rangesim.codes.bit_code import BitCode
from rangesim.settings.bounds import check_fields, whole


@dataclass(frozen=True)
class BinaryCode(BitCode):
    """Bits of the number of a cell, most significant first, each followed by its inverse.

    Several bits change at most edges between cells, so a camera pixel across an edge may read a number that is far from
    both. Such pixels are refused where several bits are uncertain; Gray code keeps them.

    Parameters
    ----------
    cell_px : int, projector pixels per cell.

    References
    ----------
    Posdamer, Altschuler: "Surface measurement by space-encoded projected beam systems", Computer Graphics and Image
    Processing 18 (1982).

    Examples
    --------
    >>> BinaryCode().patterns(8).astype(int)[::2]
    array([[0, 0, 0, 0, 1, 1, 1, 1],
           [0, 0, 1, 1, 0, 0, 1, 1],
           [0, 1, 0, 1, 0, 1, 0, 1]])
    """

    cell_px: Annotated[int, whole(1, "projector")] = 1

    type_name: ClassVar[str] = "binary"
    title: ClassVar[str] = "Structured light (binary code)"
    noun: ClassVar[str] = "plain binary numbers"  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_fields(self)

    def words_of_cells(self, bits: int) -> np.ndarray:
        return np.arange(1 << bits)
