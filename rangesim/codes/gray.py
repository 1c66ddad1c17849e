# SPDX-License-Identifier: Apache-2.0
"""Gray code: neighbouring cells of the projector differ in one bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.bit_code import BitCode
from rangesim.codes.bits import Words
from rangesim.codes.code import MAX_BEYOND_PROJECTOR, MAX_LEFT_OUTSIDE
from rangesim.decoding.pixel_samples import MIN_PIXELS, evenly_spread
from rangesim.decoding.status import Status
from rangesim.response import DenseResponse, GrayBits
from rangesim.settings.bounds import check_fields, whole


@dataclass(frozen=True)
class GrayCode(BitCode):
    """Gray bits of the number of a cell, most significant first, each followed by its inverse.

    Parameters
    ----------
    cell_px : int, projector pixels per cell.
    words_shown : "first": cell k has the word of k. "middle": the cells have the words in the middle of all 2^b words,
        so that cell k has the word of k + (2^b - cells) // 2. Both are the same if there are 2^b cells.

    References
    ----------
    - Inokuchi, Sato, Matsuda: "Range imaging system for 3-D object recognition", ICPR (1984).
    - OpenCV, structured_light module, GrayCodePattern: the same patterns in the same order.
    - Lanman, Taubin: "Build your own 3D scanner", SIGGRAPH course (2009), and Moreno, Taubin: "Simple, accurate, and
      robust projector-camera calibration", 3DIMPVT (2012): their programs show the middle words.

    Examples
    --------
    >>> GrayCode(cell_px=2).patterns(8).astype(int)[::2]
    array([[0, 0, 0, 0, 1, 1, 1, 1],
           [0, 0, 1, 1, 1, 1, 0, 0]])
    """

    cell_px: Annotated[int, whole(1, "projector")] = 1
    words_shown: Literal["first", "middle"] = "first"

    type_name: ClassVar[str] = "gray"
    title: ClassVar[str] = "Structured light (Gray code)"
    noun: ClassVar[str] = "Gray code"  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_fields(self)

    def words_of_cells(self, bits: int) -> np.ndarray:
        cell = np.arange(1 << bits)
        return cell ^ (cell >> 1)

    def words(self, size: int) -> Words:
        words = super().words(size)
        if self.words_shown == "first":
            return words
        return Words.of(words.noun, np.roll(words.of_cell, -self._unused(size)))  # the words after the last cell wrap

    def _unused(self, size: int) -> int:
        """Number of the words before the first one that is shown, if those in the middle are."""
        return int((1 << self.bits(size)) - -(-size // self.cell_px)) // 2

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        if self.words_shown == "middle":
            return super().responses(axis, size)
        return (GrayBits(axis, self.bits(size), self.cell_px),)

    def other_conventions(self) -> Iterator[tuple[GrayCode, str]]:
        other: Literal["first", "middle"] = "middle" if self.words_shown == "first" else "first"
        yield replace(self, words_shown=other), f"the Gray code shows the {other} words (words_shown = {other})."

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return super().contradiction(seen, code) or self._word_contradiction(seen, code)

    def _word_contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        """A sentence if words are seen that are not shown, but would be with the other `words_shown`; None if not."""
        decoded = (code.status == Status.OK) | (code.status == Status.CODE_ERROR)
        used = evenly_spread(np.flatnonzero(decoded))
        if len(used) < MIN_PIXELS:
            return None
        word = self.words(seen.size).of_cell[(code.coordinate.ravel()[used] / self.cell_px).astype(np.intp)]
        outside = self._outside(word, seen.size)
        for other, _ in self.other_conventions():
            if outside > MAX_BEYOND_PROJECTOR and other._outside(word, seen.size) < MAX_LEFT_OUTSIDE * outside:
                return (
                    f"{100 * outside:.0f} % of the decoded pixels along {seen.axis} see places outside the projector, "
                    f"as if the code showed its {other.words_shown} words instead of the {self.words_shown} ones: "
                    "check words_shown and the size of the projector."
                )
        return None

    def _outside(self, word: np.ndarray, size: int) -> float:
        """Fraction of the words that no cell has."""
        return float((self.words(size).cell_of[word] >= -(-size // self.cell_px)).mean())
