# SPDX-License-Identifier: Apache-2.0
"""De Bruijn stripes: coloured stripes of which any few in a row occur in one place only."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.contrast import difference_noise
from rangesim.decoding.pixel_samples import MIN_PIXELS
from rangesim.decoding.status import Status
from rangesim.sensor import Background, least_signal_for
from rangesim.settings import limits
from rangesim.settings.bounds import check_fields, whole

CHANNELS = ("red", "green", "blue")
"""Names of the frames, one for each colour of the projector; a grey camera takes one image of each."""

COLOURS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]])
"""(6, 3) channels of the colours. Black and white are left out, so that each pixel has a bright and a dark frame."""

MAX_FALSE = 0.002
"""Largest probability that a row of stripes from different places looks like one of the sequence. It decides how many
stripes in a row are read at once. With a smaller one, surfaces would have to show more stripes."""

SEED = 1
"""Seed of the order in which colours are tried. In a regular order, parts of the sequence would look like others with
two channels exchanged."""

MIN_FOUND = 0.5
"""Least fraction of the windows of stripes that are found in the sequence. If the frames are wrong, only those are
found that fit by chance, `MAX_FALSE`."""

MIN_WINDOWS = 50
"""Least number of windows from which a check draws a conclusion. The fraction of them that is found then has a standard
error of 7 % at most, so that a sound capture does not fall below `MIN_FOUND` by chance."""


class StripeSequence(NamedTuple):
    """A sequence of colours, and where in it each row of `window` colours stands.

    colours : (n,) int, indices in `COLOURS`. window : int, number of stripes in a row that are read at once.
    table : (6 ** window,) int32, number of the first stripe of each row of colours, as digits of base 6; -1: none.
    """

    colours: np.ndarray
    window: int
    table: np.ndarray


@dataclass(frozen=True)
class DeBruijnStripes(Code):
    """Stripes in six colours; neighbours differ, and any few stripes in a row occur once in the sequence.

    A grey camera takes one image for each of the three colour channels; they suffice for a whole projector. A row of
    stripes is only accepted if one place of the sequence has all of them, so a surface must show 5 to 9 of them side by
    side, see `StripeSequence`. The edges between stripes are found to a fraction of a camera pixel, and the places
    between two edges by linear interpolation: without noise they are exact on planes seen in parallel, and off by about
    c / 8 times the square of the stripe's width where the coordinate bends with the second derivative c.

    Parameters
    ----------
    stripe_px : int, projector pixels per stripe.

    References
    ----------
    - Zhang, Curless, Seitz: "Rapid shape acquisition using color structured light and multi-pass dynamic programming",
      3DPVT (2002): De Bruijn stripes and their edges. They match whole lines by dynamic programming; windows are used
      here, because a window either fits or is refused.
    - Salvi, Pages, Batlle: "Pattern codification strategies in structured light systems", Pattern Recognition 37
      (2004).

    Examples
    --------
    >>> DeBruijnStripes(stripe_px=2).patterns(8).astype(int)
    array([[1, 1, 0, 0, 0, 0, 0, 0],
           [0, 0, 1, 1, 0, 0, 1, 1],
           [0, 0, 1, 1, 1, 1, 0, 0]])
    """

    stripe_px: Annotated[int, whole(1, "projector")] = 10

    type_name: ClassVar[str] = "de-bruijn"
    title: ClassVar[str] = "Structured light (De Bruijn stripes)"

    def __post_init__(self) -> None:
        check_fields(self)

    def n_stripes(self, size: int) -> int:
        """Number of stripes; the last may be narrower."""
        return math.ceil(size / self.stripe_px)

    def check(self, size: int) -> None:
        least = stripe_sequence(self.n_stripes(size)).window
        if self.n_stripes(size) < least:
            raise ValueError(
                f"expected at least {least} stripes, got {self.n_stripes(size)} of {self.stripe_px} px for {size} px."
            )

    def names(self, size: int) -> list[str]:
        return list(CHANNELS)

    def patterns(self, size: int) -> np.ndarray:
        colours = stripe_sequence(self.n_stripes(size)).colours
        return np.asarray(COLOURS[colours[np.arange(size) // self.stripe_px]].T, dtype=np.float32)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        words, values, weak = _words(seen, thresholds)
        sequence = stripe_sequence(self.n_stripes(seen.size))
        coordinate, is_known, _ = _along_lines(seen.axis, words, values, sequence, self.stripe_px)
        status = np.where(is_known, np.uint8(Status.OK), np.uint8(Status.CODE_ERROR))
        status[weak] = Status.LOW_SIGNAL
        status[seen.capture.saturated(seen.frames) & (status != Status.OK)] = Status.SATURATED
        return AxisCode(coordinate, status, float(self.stripe_px))

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        """The light that white - black needs, or that a channel needs, if that is more.

        The colour of a pixel is the sign of its channels minus the middle of white and black. At a lit pixel that
        difference is half the light S, and its variance is taken as that of two frames, S + n and S / 2 + n,
        with n of a frame without S; so S / 2 = t sqrt(1.5 S + 2 n) for t sigmas.
        """
        least = super().least_signal(size, shown, thresholds, background)
        if background.noise_variance is None:
            return least
        noise_variance = 2 * (background.ambient + background.noise_variance)
        return np.maximum(least, least_signal_for((2 * thresholds.gray.bit_sigmas) ** 2, 1.5, noise_variance))

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        from rangesim.codes.stripe_kernels import DARK

        lit = np.flatnonzero((code.status == Status.OK) | (code.status == Status.CODE_ERROR))
        if len(lit) < MIN_PIXELS:
            return None
        sequence = stripe_sequence(self.n_stripes(seen.size))
        words, values, _ = _words(seen, None)
        words[(code.status != Status.OK) & (code.status != Status.CODE_ERROR)] = DARK

        def found(change: Callable[[np.ndarray], np.ndarray] = np.asarray) -> tuple[int, float]:
            counts = _along_lines(seen.axis, change(words), change(values), sequence, self.stripe_px)[2]
            return int(counts[0]), float(counts[1] / max(counts[0], 1))

        windows, fraction = found()
        if windows < MIN_WINDOWS or fraction >= MIN_FOUND:
            return None
        text = (
            f"the stripes along {seen.axis} contradict their sequence: {100 * fraction:.0f} % of the rows of "
            f"{sequence.window} stripes are in it"
        )
        mirror = (lambda a: a[..., ::-1]) if seen.axis == "columns" else (lambda a: a[..., ::-1, :])
        if found(mirror)[1] >= MIN_FOUND:
            return f"{text}; they are if the image is mirrored: check that no image is mirrored."
        for order in list(itertools.permutations(range(3)))[1:]:
            if found(lambda a, order=order: _exchanged(a, order))[1] >= MIN_FOUND:  # type: ignore[misc]
                names = ", ".join(CHANNELS[i] for i in order)
                return f"{text}; they are if the frames are taken as {names}: check their order."
        return (
            f"{text}: check the size of the projector, the order of the frames, and that a stripe is "
            "several pixels of the camera wide."
        )

    @property
    def details(self) -> str:
        return f"De Bruijn stripes of {self.stripe_px} px in 3 colour channels"

    def representative(self, size: int) -> list[str]:
        return list(CHANNELS[:2])


@lru_cache(maxsize=16)
def stripe_sequence(n: int) -> StripeSequence:
    """A sequence of n colours in which neighbours differ and no row of `window` colours occurs twice.

    `window` is the least for which a random row, in which neighbours differ, is in the sequence with a probability of
    at most `MAX_FALSE`: there are 6 x 5^(window - 1) such rows.
    """
    k = len(COLOURS)
    window = 2
    while n > MAX_FALSE * k * (k - 1) ** (window - 1):
        window += 1
    limits.check("bytes", 4 * k**window, f"bytes of the table of {n} stripes")
    order = 2  # rows of so many colours are unique, as in a De Bruijn sequence
    while k * (k - 1) ** (order - 1) < n + order:
        order += 1
    colours = _greedy(n, order, k)
    while colours is None:
        order += 1
        colours = _greedy(n, order, k)
    rows = np.lib.stride_tricks.sliding_window_view(colours, window) if n >= window else np.empty((0, window), int)
    table = np.full(k**window, -1, dtype=np.int32)
    table[rows @ k ** np.arange(window)[::-1]] = np.arange(len(rows))
    return StripeSequence(colours, window, table)


def _greedy(n: int, order: int, k: int) -> np.ndarray | None:
    """n colours whose rows of `order` are unique, each a random one that keeps them so; None: it got stuck."""
    rng = np.random.default_rng(SEED)
    result = [i % 2 for i in range(order - 1)]
    seen: set[tuple[int, ...]] = set()
    while len(result) < n:
        tail = tuple(result[len(result) - order + 1 :])
        for colour in rng.permutation(k).tolist():
            if colour != result[-1] and (*tail, colour) not in seen:
                break
        else:
            return None
        seen.add((*tail, colour))
        result.append(colour)
    return np.array(result[:n])


def _words(seen: AxisFrames, thresholds: CodeThresholds | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours (h, w) int8 of the pixels, channels (3, h, w) float32, -1 if off and 1 if on, and weak pixels (h, w).

    thresholds : None: all signs are certain.
    """
    from rangesim.codes.stripe_kernels import DARK, UNCERTAIN

    contrast, capture = seen.contrast, seen.capture
    middle = 0.5 * (contrast.white.astype(np.float32) + contrast.black.astype(np.float32))
    half = np.maximum(0.5 * contrast.values, np.float32(1e-20))
    values = np.stack([(frame.astype(np.float32) - middle) / half for frame in seen.frames])
    by_bits = np.full(8, UNCERTAIN, dtype=np.int8)
    by_bits[COLOURS @ [1, 2, 4]] = np.arange(len(COLOURS))
    bits = (values > 0).astype(np.uint8)
    words = by_bits[bits[0] + 2 * bits[1] + 4 * bits[2]]
    if thresholds is not None:
        gray = thresholds.gray
        for frame, value in zip(seen.frames, values, strict=True):
            noise = difference_noise(capture, frame.astype(np.float32), middle)
            least = np.full(words.shape, gray.relative_bit, dtype=np.float32)
            if noise is not None:
                least = np.maximum(least, gray.bit_sigmas * noise / half)
            elif capture.is_digital:
                least = np.maximum(least, 0.5 * gray.bit_of_scale * capture.full_scale / half)
            words[np.abs(value) < least] = UNCERTAIN
    weak = ~contrast.is_enough
    words[weak] = DARK
    return words, values, weak


def _along_lines(
    axis: str, words: np.ndarray, values: np.ndarray, sequence: StripeSequence, stripe_px: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates (h, w) float32, where they are known (h, w), and the numbers of windows looked up and found, (2,)."""
    from pcgraph.parallel import MIN_ROWS, in_blocks
    from rangesim.codes.stripe_kernels import decode_lines

    if axis == "rows":
        words, values = words.T, values.transpose(0, 2, 1)
    words, values = np.ascontiguousarray(words), np.ascontiguousarray(values)
    coordinate = np.zeros(words.shape, dtype=np.float32)
    is_known = np.zeros(words.shape, dtype=bool)
    counts = np.zeros((len(words), 2), dtype=np.int64)
    in_blocks(
        decode_lines,
        len(words),
        *(words, values, sequence.table, len(COLOURS), sequence.window, float(stripe_px)),
        *(coordinate, is_known, counts),
        smallest=MIN_ROWS,
    )
    if axis == "rows":
        coordinate, is_known = coordinate.T, is_known.T
    return np.ascontiguousarray(coordinate), np.ascontiguousarray(is_known), counts.sum(axis=0)


def _exchanged(values: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    """Channels (3, h, w) in another order, or the colours (h, w) of pixels with their channels in this order."""
    if values.ndim == 3:
        return values[list(order)]
    other = COLOURS[:, list(order)]
    changed = np.array([np.flatnonzero((one == COLOURS).all(axis=1))[0] for one in other], dtype=np.int8)
    return np.where(values >= 0, changed[np.maximum(values, 0)], values)
