# SPDX-License-Identifier: Apache-2.0
"""Bits of a code, with or without inverse patterns, to words, to numbers of cells, and to projector coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rangesim.capture import Capture
from rangesim.codes.axis_code import AxisCode, AxisFrames, Contrast
from rangesim.codes.contrast import difference_noise
from rangesim.codes.thresholds import GrayThresholds
from rangesim.decoding.row_bands import in_bands
from rangesim.decoding.status import Status

if TYPE_CHECKING:
    from rangesim.codes.bit_kernels import LeastDifference

CELL_SIGMA = 12**-0.5
"""Standard deviation of a place that is known to lie in a cell, in cells: that of an even distribution."""

LONE_NOISE = 3**0.5
"""Ratio of the noise of 2 pattern - (white + black) to that of pattern - inverse, at equal noise of all frames: their
variances are those of 4 + 1 + 1 frames and of 2."""


MIN_EVEN_CONTRAST = 0.5
"""Least |pattern - inverse| of a certain bit, as a fraction of the median over the bits of the pixel, in codes whose
stripes have one width. A bit with less comes from a pixel of which a quarter or more sees the other side of an edge. On
sharp, still surfaces a third to a half lose no pixel; with half, a moving scene has 2 % of wrong readings instead of 11
% with a third."""

MIN_SHARP_CONTRAST = 0.52
"""Least median of |pattern - inverse| in codes whose stripes have one width, as a fraction of white - black, at which
bits that change within a stripe of the base can be trusted. There, a stripe of half the width lies beside its inverse.
A Gaussian blur of sigma reverses the sign of the pair if exp(-w^2 / 2 sigma^2) > 1/2, with the half width w; that is
sigma > 0.85 w, and stripes of period 4 w then have the contrast 4 / pi exp(-2 pi^2 sigma^2 / (4 w)^2) = 0.52."""

MAX_EVEN_RATIO = 1.2
"""Largest ratio of the most contrast of a bit to the median over the bits, in codes whose stripes have one width, at
which interreflection and not blur has lowered the contrast. It is below 1.08 at 90 % of the pixels of a white corner,
and above 1.29 at 90 % of the pixels out of focus (docs/codes_table.md)."""

MAX_FINE_RATIO = 0.7
"""Largest contrast of a bit finer than the base, as a fraction of the median over the bits, that blur leaves. At the
blur of `MIN_SHARP_CONTRAST` it is 0.56; the rest is for noise. Interreflection leaves the fine bits alone."""


class Words(NamedTuple):
    """The words that a code gives to its cells.

    noun : what the words are, in running text. of_cell : (2^b,) int32, word of each cell. cell_of : (2^b,) int32, cell
    of each word. base_bit : number of the bit with which all others are combined, so that the stripes of all bits have
    about one width; None: they have many widths. within_stripe : (2^b,) int32, for each cell the set of bits that
    change within its stripe of the base; (0,) without a base.
    """

    noun: str
    of_cell: np.ndarray
    cell_of: np.ndarray
    base_bit: int | None = None
    within_stripe: np.ndarray = np.empty(0, np.int32)

    @classmethod
    def of(cls, noun: str, of_cell: np.ndarray, base_bit: int | None = None) -> Words:
        """Words from those of all cells (2^b,), each word once."""
        of_cell = of_cell.astype(np.int32)
        cell_of = np.empty(len(of_cell), dtype=np.int32)
        cell_of[of_cell] = np.arange(len(of_cell), dtype=np.int32)
        if base_bit is None:
            return cls(noun, of_cell, cell_of)
        is_first = np.diff(of_cell >> base_bit & 1, prepend=-1) != 0
        starts, stripe = np.flatnonzero(is_first), np.cumsum(is_first) - 1
        within = np.bitwise_or.reduceat(of_cell ^ of_cell[starts[stripe]], starts)[stripe]
        return cls(noun, of_cell, cell_of, base_bit, within)

    @property
    def bits(self) -> int:
        """Number of bits of a word."""
        return len(self.of_cell).bit_length() - 1

    @property
    def change_one_bit(self) -> bool:
        """Whether the words of neighbouring cells differ in one bit, as in Gray code."""
        changed = self.of_cell[1:] ^ self.of_cell[:-1]
        return not (changed & (changed - 1)).any()


class BitFrames(NamedTuple):
    """The frames of one bit.

    name : of the bit. pattern, inverse : indices of its frames; None where the frame was not shown.
    """

    name: str
    pattern: int | None
    inverse: int | None

    @property
    def frame_name(self) -> str:
        """Name of the pattern, or of its inverse if that was shown alone."""
        return self.name if self.pattern is not None else f"{self.name}_inverse"


def bit_frames(names: list[str], bits: int) -> list[BitFrames]:
    """The frames of each bit, most significant first.

    Examples
    --------
    >>> bit_frames(["bit1", "bit0", "bit0_inverse"], 2)
    [BitFrames(name='bit1', pattern=0, inverse=None), BitFrames(name='bit0', pattern=1, inverse=2)]
    """
    at = {name: i for i, name in enumerate(names)}
    every = (f"bit{k}" for k in reversed(range(bits)))
    return [BitFrames(name, at.get(name), at.get(f"{name}_inverse")) for name in every]


def decode_bits(seen: AxisFrames, words: Words, cell_px: int, thresholds: GrayThresholds) -> AxisCode:
    """Projector coordinate of each pixel from the bits of its cell.

    A bit is the sign of pattern - inverse. Where only one of the two was shown, white + black - pattern stands for the
    inverse, because light adds up. A bit is uncertain where the noise is larger than the difference. A pixel on the
    edge of a stripe has one uncertain bit, which does no harm if a flip of it leads to a neighbouring cell: the
    function then returns the edge between the two cells. It refuses all other pixels with uncertain bits.

    If the stripes of all bits have one width, as in XOR codes, all bits have one contrast, except at edges and out of
    focus. A bit with clearly less is uncertain, and out of focus all bits are that change within a stripe.

    If white or black was not captured either, it is estimated from the frames. Such an estimate is wrong at cells that
    are dark in all frames, or lit in all. Blur from the next cell can look like a bit there, so cells next to these are
    refused, too, unless two frames show each level. It is right elsewhere, because in a code whose neighbouring cells
    differ in one bit all other bits are certain.

    Parameters
    ----------
    seen : frames (k, h, w) of the bits, named "bit3" and "bit3_inverse"; each bit has one of them or both.
    words : those of the code.
    cell_px : int, projector pixels per cell of the code.
    """
    capture, contrast = seen.capture, seen.contrast
    shown = bit_frames(seen.names, words.bits)
    coordinate = np.empty(contrast.values.shape, dtype=np.float32)
    status = np.zeros(contrast.values.shape, dtype=np.uint8)
    least = _least_difference(capture, thresholds)

    def decode_rows(rows: slice) -> None:
        word, uncertain = _classify(capture, seen.frames[:, rows], _rows_of(contrast, rows), shown, thresholds, least)
        if words.base_bit is not None:
            uncertain |= _uneven(seen.frames[:, rows], _rows_of(contrast, rows), shown, words, word)
        low, high = words.cell_of[word], words.cell_of[word ^ uncertain]
        on_edge = (uncertain & (uncertain - 1) == 0) & (np.abs(low - high) <= 1)
        coordinate[rows] = (0.5 * (low + high) + 0.5) * cell_px
        status[rows][coordinate[rows] >= seen.size + cell_px / 2] = Status.CODE_ERROR
        if seen.size % cell_px:
            _in_projector(coordinate[rows], seen.size, cell_px)
        failed = ~contrast.is_enough[rows] | ~on_edge
        if not contrast.is_measured:
            failed |= _is_guessed(capture.frames[:, rows], _rows_of(contrast, rows), shown, words, low)
        status[rows][failed] = Status.LOW_SIGNAL
        if failed.any():
            status[rows][failed & capture.saturated(capture.frames[:, rows])] = Status.SATURATED

    in_bands(decode_rows, len(status))
    sigma_px = np.broadcast_to(np.float32(CELL_SIGMA * cell_px), status.shape)
    return AxisCode(coordinate, status, cell_px, sigma_px)


def _in_projector(coordinate: np.ndarray, size: int, cell_px: int) -> None:
    """Move coordinates of a last cell that is cut off to the centre of what is left of it, and its edge to the end."""
    start = size - size % cell_px
    coordinate[coordinate == start + cell_px / 2] = (start + size) / 2
    coordinate[coordinate == start + cell_px] = size


def _rows_of(contrast: Contrast, rows: slice) -> Contrast:
    """Contrast of some rows of the image."""
    return contrast._replace(
        white=contrast.white[rows],
        black=contrast.black[rows],
        values=contrast.values[rows],
        is_enough=contrast.is_enough[rows],
    )


def _least_difference(capture: Capture, thresholds: GrayThresholds) -> LeastDifference:
    """Least |pattern - inverse| of a certain bit."""
    from rangesim.codes.bit_kernels import LeastDifference

    noise = capture.noise(np.arange(1 + capture.detector.max_dn)) if capture.detector else None
    floor, relative = np.float32(0), np.float32(thresholds.relative_bit)
    if noise is None and capture.is_digital:
        floor, relative = np.float32(thresholds.bit_of_scale * capture.full_scale), np.float32(0)
    variance = np.zeros(0, dtype=np.float32) if noise is None else np.asarray(noise**2, dtype=np.float32)
    return LeastDifference(floor, relative, np.float32(thresholds.bit_sigmas), variance)


def _classify(
    capture: Capture,
    frames: np.ndarray,
    contrast: Contrast,
    shown: list[BitFrames],
    thresholds: GrayThresholds,
    least: LeastDifference,
) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) int32 each: the word, and the set of its bits that are uncertain."""
    from rangesim.codes.bit_kernels import append_bit

    word = np.zeros(contrast.values.shape, dtype=np.int32)
    uncertain = np.zeros_like(word)
    levels = None
    for bit in shown:
        if bit.pattern is not None and bit.inverse is not None:
            append_bit(frames[bit.pattern], frames[bit.inverse], contrast.values, least, word, uncertain)
            continue
        levels = levels or _Levels.of(capture, contrast)
        alone = frames[bit.pattern if bit.inverse is None else bit.inverse]
        difference, is_uncertain = levels.compare(capture, alone, contrast, thresholds)
        if bit.pattern is None:
            difference = -difference
        word = (word << 1) | (difference > 0)
        uncertain = (uncertain << 1) | is_uncertain
    return word, uncertain


def _uneven(
    frames: np.ndarray, contrast: Contrast, shown: list[BitFrames], words: Words, word: np.ndarray
) -> np.ndarray:
    """(h, w) int32, the set of bits that are uncertain because of the contrast of the other bits.

    Parameters
    ----------
    word : (h, w) int32, as read.
    """
    from rangesim.codes.bit_kernels import middle_of

    total = contrast.white.astype(np.float32) + contrast.black
    size = np.empty((len(shown), *word.shape), dtype=np.float32)
    for one, bit in zip(size, shown, strict=True):
        if bit.pattern is not None and bit.inverse is not None:
            np.subtract(frames[bit.pattern], frames[bit.inverse], out=one, dtype=np.float32)
        else:
            np.subtract(2 * frames[bit.pattern if bit.inverse is None else bit.inverse].astype(np.float32), total, one)
    np.abs(size, out=size)
    middle = middle_of(size)
    uncertain = np.zeros_like(word)
    for one in size:
        uncertain = (uncertain << 1) | (one < MIN_EVEN_CONTRAST * middle)
    is_blurred = (middle < MIN_SHARP_CONTRAST * contrast.values) & (size.max(axis=0) > MAX_EVEN_RATIO * middle)
    assert words.base_bit is not None
    for fine in size[len(size) - words.base_bit :]:
        is_blurred &= fine < MAX_FINE_RATIO * middle
    return np.asarray(uncertain | np.where(is_blurred, words.within_stripe[words.cell_of[word]], 0))


class _Levels(NamedTuple):
    """White and black as references of frames without inverse.

    total : (h, w) float32, white + black. variance : (h, w), of its noise; None: unknown. is_clipped : (h, w) bool,
    whether white is; None: nowhere.
    """

    total: np.ndarray
    variance: np.ndarray | None
    is_clipped: np.ndarray | None

    @classmethod
    def of(cls, capture: Capture, contrast: Contrast) -> _Levels:
        white, black = contrast.white.astype(np.float32), contrast.black.astype(np.float32)
        noise = difference_noise(capture, white, black)
        is_clipped = capture.saturated(contrast.white[None])
        return cls(white + black, None if noise is None else noise**2, is_clipped if is_clipped.any() else None)

    def compare(
        self, capture: Capture, frame: np.ndarray, contrast: Contrast, thresholds: GrayThresholds
    ) -> tuple[np.ndarray, np.ndarray]:
        """(h, w) each: 2 frame - (white + black), and whether its sign is uncertain.

        Where white is clipped, the middle of white and black is too low. A frame above it that is not clipped itself
        may be dark, so its bit is uncertain.
        """
        value = frame.astype(np.float32)
        difference = 2 * value - self.total
        noise, frame_noise = None, capture.noise(value)
        if frame_noise is not None and self.variance is not None:
            noise = np.sqrt(4 * frame_noise**2 + self.variance)
        uncertain = np.abs(difference) < _least_lone_bit(capture, noise, contrast, thresholds)
        if self.is_clipped is not None:
            uncertain |= self.is_clipped & (difference > 0) & ~capture.saturated(frame[None])
        return difference, uncertain


def _least_lone_bit(
    capture: Capture, noise: np.ndarray | None, contrast: Contrast, thresholds: GrayThresholds
) -> np.ndarray | float:
    """Least |2 pattern - (white + black)| of a certain bit, in the capture's units.

    Parameters
    ----------
    noise : (h, w) standard deviation of the difference; None: unknown.
    """
    if noise is not None:
        return np.maximum(thresholds.bit_sigmas * noise, thresholds.relative_bit * contrast.values)
    if capture.is_digital:
        return LONE_NOISE * thresholds.bit_of_scale * capture.full_scale
    return thresholds.relative_bit * contrast.values


def _is_guessed(
    frames: np.ndarray, contrast: Contrast, shown: list[BitFrames], words: Words, cell: np.ndarray
) -> np.ndarray:
    """(h, w) bool, pixels next to a cell that is dark in all frames or lit in all, whose levels one frame shows only.

    Parameters
    ----------
    frames : (k, h, w), all of the capture. cell : (h, w) int, number of the cell that was read.
    """
    guessed = np.zeros(cell.shape, dtype=bool)
    inverted = sum(1 << k for k, bit in enumerate(reversed(shown)) if bit.pattern is None)
    if any(bit.pattern is not None and bit.inverse is not None for bit in shown):
        return guessed  # a pair shows both levels everywhere
    all_lit = len(words.of_cell) - 1 - inverted
    for has_level, constant, sign in ((contrast.has_white, inverted, 1), (contrast.has_black, all_lit, -1)):
        if not has_level:
            y, x = np.nonzero(np.abs(cell - words.cell_of[constant]) <= 1)
            twice_middle = contrast.white[y, x].astype(np.float32) + contrast.black[y, x]
            beyond = sign * (2 * frames[:, y, x].astype(np.float32) - twice_middle) > 0
            guessed[y, x] |= np.count_nonzero(beyond, axis=0) < 2
    return guessed


def binary_of_gray(gray: np.ndarray) -> np.ndarray:
    """Numbers whose Gray codes are `gray` (integers of up to 32 bits): the running exclusive or from the top bit.

    Examples
    --------
    >>> import numpy as np
    >>> binary_of_gray(np.array([0b000, 0b001, 0b011, 0b010, 0b110]))
    array([0, 1, 2, 3, 4])
    """
    result = gray.copy()
    for step in (16, 8, 4, 2, 1):
        result ^= result >> step
    return result
