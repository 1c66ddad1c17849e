# SPDX-License-Identifier: Apache-2.0
"""Codes whose frames are bits: each cell of the projector has a word, and each frame shows one bit of it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.bit_levels import (
    between_contradiction,
    level_contradiction,
    light_of_bits,
    lost_contradiction,
    pair_contradiction,
    uneven_contradiction,
    uniform_contradiction,
)
from rangesim.codes.bit_neighbours import (
    displaced_contradiction,
    neighbours_of,
    order_contradiction,
    other_code_contradiction,
)
from rangesim.codes.bits import Words, bit_frames, decode_bits
from rangesim.codes.code import Code, CodeThresholds, stripes
from rangesim.response import DenseResponse
from rangesim.sensor import Background, ReceivedLight, least_signal_for
from rangesim.settings.config import has_defaults


class BitCode(Code):
    """A code that gives each cell of `cell_px` projector pixels a word of bits.

    The frames are the bits of the word, most significant first, each followed by its inverse. A bit may be shown
    without its inverse, or its inverse alone, see `rangesim.codes.bits.decode_bits`. White and black may then be absent
    only if the words of neighbouring cells differ in one bit, as in Gray code. Subclasses are frozen dataclasses
    with a field `cell_px`.

    Examples
    --------
    >>> from rangesim.codes import XorCode
    >>> XorCode(cell_px=2).names(16)
    ['bit2', 'bit2_inverse', 'bit1', 'bit1_inverse', 'bit0', 'bit0_inverse']
    """

    cell_px: int

    is_by_pixel: ClassVar[bool] = True

    @property
    @abstractmethod
    def noun(self) -> str:
        """Name of the words in running text: "Gray code"."""

    @abstractmethod
    def words_of_cells(self, bits: int) -> np.ndarray:
        """(2^bits,) int, the word of each cell; each word is there once."""

    def base_of(self, bits: int) -> int | None:
        """Number of the bit with which all others are combined, so that the stripes of all bits have about one width;
        None: they have many widths."""
        return None

    @classmethod
    def variants(cls) -> tuple[BitCode, ...]:
        """Codes of this kind that a capture may show instead of the one it is read as."""
        return (cls(),)

    def bits(self, size: int) -> int:
        """Number of bits that tell the cells of `size` projector pixels from each other, at least one."""
        return max(1, (-(-size // self.cell_px) - 1).bit_length())

    def words(self, size: int) -> Words:
        """Words of the cells of `size` projector pixels, and of the further cells that as many bits have."""
        return _words(self, self.bits(size))

    def place_sigma_px(self, axis: int, size: int, light: ReceivedLight) -> np.ndarray:
        """The standard deviation of an even distribution over a cell, cell / sqrt(12): a place is the cell's middle."""
        return np.full(light.emitter.shape, self.cell_px / np.sqrt(12))

    def names(self, size: int) -> list[str]:
        return [f"bit{bit}{suffix}" for bit in reversed(range(self.bits(size))) for suffix in ("", "_inverse")]

    def patterns(self, size: int) -> np.ndarray:
        word = self.words(size).of_cell[np.arange(size) // self.cell_px]
        shown = [(word >> bit) & 1 for bit in reversed(range(self.bits(size)))]
        return np.array([row for bit in shown for row in (bit, 1 - bit)], dtype=np.float32)

    def check_shown(self, size: int, shown: Sequence[str]) -> None:
        every = bit_frames(list(shown), self.bits(size))
        if missing := [bit.name for bit in every if bit.pattern is None and bit.inverse is None]:
            raise ValueError(
                f"expected an order with each bit of {self.type_name} code or its inverse: {', '.join(missing)} is "
                "missing ('*_bit*[0-9]' stands for all bits, without inverses)."
            )
        is_alone = any(bit.pattern is None or bit.inverse is None for bit in every)
        if is_alone and not {"white", "black"} <= set(shown) and not self.words(size).change_one_bit:
            raise ValueError(
                f"expected an order with white and black, or with all inverses, for {self.type_name} code: several of "
                "its bits change at one edge, and none tells there what full light and no light look like."
            )

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        return (_bit_stripes(self, axis, size),)

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        for bit in channels[0]:
            yield bit
            yield white - bit

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        return decode_bits(seen, self.words(seen.size), self.cell_px, thresholds.gray)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        words = self.words(seen.size)
        if found := pair_contradiction(seen, words) or level_contradiction(seen, words):
            return found
        light = light_of_bits(seen, code, words)
        if light is not None:
            found = (
                between_contradiction(light)
                or uniform_contradiction(light)
                or lost_contradiction(light)
                or uneven_contradiction(light)
            )
            if found:
                return found
        neighbours = neighbours_of(code, words)
        found = other_code_contradiction(seen, neighbours, words, _other_words(words)) or order_contradiction(
            seen, neighbours, words
        )
        return found or (None if light is None else displaced_contradiction(light, neighbours))

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        """The light that white - black needs, or that a bit without inverse needs, if that is more.

        Such a bit is the sign of 2 pattern - (white + black). At a lit pixel that difference is the light S, and its
        variance is 4 (S + n) + (S + n) + n = 5 S + 6 n, with n of a frame without S; so S = t sqrt(5 S + 6 n) for t
        sigmas, which is 3 sqrt(6) = 7.3 times sqrt(n) in weak light.
        """
        least = super().least_signal(size, shown, thresholds, background)
        is_alone = any(bit.pattern is None or bit.inverse is None for bit in bit_frames(list(shown), self.bits(size)))
        if background.noise_variance is None or not is_alone:
            return least
        noise_variance = 6 * (background.ambient + background.noise_variance)
        return np.maximum(least, least_signal_for(thresholds.gray.bit_sigmas**2, 5.0, noise_variance))

    @property
    def details(self) -> str:
        name = self.noun[0].upper() + self.noun[1:]
        return name if self.cell_px == 1 else f"{name} of {self.cell_px} px"

    def representative(self, size: int) -> list[str]:
        patterns = self.names(size)[::2]
        return [patterns[len(patterns) // 2], patterns[-1]]


@lru_cache(
    maxsize=256
)  # the cells do not depend on the size of a cell, but codes of all kinds are asked in each decode
def _words(code: BitCode, bits: int) -> Words:
    return Words.of(code.noun, code.words_of_cells(bits), code.base_of(bits))


@lru_cache(maxsize=64)  # a sensor is asked for its responses again and again
def _bit_stripes(code: BitCode, axis: int, size: int) -> DenseResponse:
    """Response to the patterns without their inverses, which are white - pattern."""
    whole = stripes(code, axis, size, 1.0)
    return type(whole)(axis, whole.patterns[::2])


def _other_words(words: Words) -> list[Words]:
    """Words of as many bits of all codes whose frames are bits, other than `words`."""
    kinds = [kind for kind in Code.known.values() if issubclass(kind, BitCode) and has_defaults(kind)]
    every = [_words(code, words.bits) for kind in kinds for code in kind.variants()]
    return [other for other in every if not np.array_equal(other.of_cell, words.of_cell)]
