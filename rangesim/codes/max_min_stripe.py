# SPDX-License-Identifier: Apache-2.0
"""Gray code whose narrowest stripe is as wide as possible, so that blur and scattering leave it readable."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from rangesim.codes.bit_code import BitCode
from rangesim.settings.bounds import check_fields, whole


class _Cycle(NamedTuple):
    """A cyclic Gray code of which a part is given: the rest repeats it with other bits.

    changes : number of the bit that changes at each edge of the first part, one hexadecimal digit each.
    next_bits : for each bit, the bit that changes in its place in the next part, one digit each.
    """

    changes: str
    next_bits: str


_CYCLES = {
    1: _Cycle("0", "0"),
    2: _Cycle("01", "01"),
    3: _Cycle("01020102", "012"),
    4: _Cycle("0102010301020103", "0123"),
    5: _Cycle("02431203", "10234"),
    6: _Cycle("21352045", "123045"),
    7: _Cycle("05412035124653021450234652146032", "1023456"),
    8: _Cycle("20143752014372605371426073516407", "12304567"),
    9: _Cycle("68135760138276015478023164725360", "123456708"),
}
"""Codes of up to 9 bits, found by a search for cycles with this symmetry. Their narrowest stripes have 1, 2, 2, 2, 4,
4, 5, 6 and 6 cells."""


class _Merger(NamedTuple):
    """Rule that merges two shorter codes: of 2^bits changes in turn, `part` are those of the shorter code.

    `part` and 2^bits - part are odd, so that all pairs of words of the two occur, each once (Goddyn and Gvozdjak).
    """

    bits: int
    part: int


_MERGERS = {10: _Merger(2, 1), 11: _Merger(2, 1), 12: _Merger(2, 1), 13: _Merger(3, 1), 14: _Merger(3, 1)}
"""Mergers with the widest narrowest stripe among all of the codes above and these: 8, 8, 8, 9 and 9 cells."""

_LONG_MERGER = _Merger(5, 9)
"""The merger of codes of 15 bits and more; 11 cells for 15 and 16 bits."""


@dataclass(frozen=True)
class MaxMinStripeCode(BitCode):
    """Gray code in which each bit changes about equally often, and no stripe is narrow.

    With 10 bits, the narrowest stripe has 8 cells (2 in the common Gray code) and the widest 24 instead of 512. So
    neither blur nor light that travels far inside the scene takes away the contrast of single patterns.

    Parameters
    ----------
    cell_px : int, projector pixels per cell.

    References
    ----------
    - Gupta, Agrawal, Veeraraghavan, Narasimhan: "Structured light 3D scanning in the presence of global illumination",
      CVPR (2011): max min-SW Gray code.
    - Goddyn, Gvozdjak: "Binary gray codes with long bit runs", Electronic Journal of Combinatorics 10 (2003).

    Examples
    --------
    >>> pattern = MaxMinStripeCode().patterns(1024)[0]
    >>> edges = np.flatnonzero(np.diff(pattern))
    >>> int(np.diff(edges).min())
    8
    """

    cell_px: Annotated[int, whole(1, "projector")] = 1

    type_name: ClassVar[str] = "max-min-stripe"
    title: ClassVar[str] = "Structured light (max-min-stripe Gray code)"
    noun: ClassVar[str] = "max-min-stripe Gray code"  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_fields(self)

    def words_of_cells(self, bits: int) -> np.ndarray:
        return np.bitwise_xor.accumulate(np.concatenate([[0], 1 << _changes(bits)[:-1]]))


@lru_cache(maxsize=32)
def _changes(bits: int) -> np.ndarray:
    """(2^bits,) int, number of the bit that changes at each edge of a cyclic Gray code of wide stripes."""
    if bits in _CYCLES:
        part = np.array([int(digit, 16) for digit in _CYCLES[bits].changes])
        next_bits = np.array([int(digit, 16) for digit in _CYCLES[bits].next_bits])
        parts = [part]
        while len(parts) * len(part) < 1 << bits:
            parts.append(next_bits[parts[-1]])
        return np.concatenate(parts)
    merger = _MERGERS.get(bits, _LONG_MERGER)
    turn = 1 << merger.bits
    is_short = np.zeros(turn, dtype=bool)
    is_short[np.arange(merger.part) * turn // merger.part] = True
    of_short = np.tile(is_short, (1 << bits) // turn)
    short, long = _changes(merger.bits), _changes(bits - merger.bits)
    result = np.empty(1 << bits, dtype=np.int64)
    result[of_short] = np.resize(short, np.count_nonzero(of_short))
    result[~of_short] = merger.bits + np.resize(long, np.count_nonzero(~of_short))
    return result
