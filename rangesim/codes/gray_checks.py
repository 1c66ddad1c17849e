# SPDX-License-Identifier: Apache-2.0
"""Checks of what is read as Gray code: pairs that do not add up, another code, another order of the frames.

A single pixel may be wrong for many reasons, so the checks look at many pixels at once: a capture that is read wrongly
contradicts itself nearly everywhere. Each check returns one sentence with the likely cause, or None.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.gray_bits import binary_of_gray
from rangesim.decoding.pixel_samples import MIN_PIXELS, evenly_spread
from rangesim.decoding.status import Status

MAX_UNPAIRED_FRACTION = 0.2
"""Largest fraction of the pixels at which the sum of a pattern and its inverse may differ from white + black. If two
patterns are no pair, it differs at half of the pixels."""

MIN_UNPAIRED = 0.75
"""Least difference between white + black and the sum of a pattern and its inverse that counts, as a fraction of white -
black. Where both are lit or both are dark, the difference is 1; a gamma makes a difference of 0.56 at most."""

MAX_PAIRS = 50_000
"""Largest number of pairs of neighbouring pixels, across and also down the image, on which other orders of the frames
are tried, so that the time is bounded, which grows with the number of orders. With far fewer, too few of them would lie
in different cells (see `MIN_STEPS`)."""

MIN_STEPS = 100
"""Least number of pairs of neighbouring pixels in different cells from which a check of the order draws a
conclusion."""

MAX_FARTHER_OCTAVES = 0.3
"""Largest mean distance by which neighbours may lie farther apart when read as Gray code than when read as plain binary
numbers, in powers of two. For plain binary numbers that are read as Gray code, this distance is about 1. For Gray code
whose neighbours lie one cell apart, it is at most 0, because they cannot lie nearer."""

MAX_NEARER_FRACTION = 0.8
"""Largest fraction of neighbours that another order of the frames may bring nearer to each other, because the right
order brings nearly all of them nearer. Only neighbours count whose distance the other order halves or doubles. With a
larger value, noise at some pixels would hide a wrong order."""

MIN_REPEATED_FRACTION = 0.9
"""Least fraction of the changes of one bit, from pixel to pixel, at which another bit changes too if both bits come
from the same frame. In Gray code that the camera sees sharply, no two bits change together."""

MIN_ALONE_FRACTION = 0.3
"""Least fraction of these changes at which no third bit changes, if both bits are the same frame. At a step of the
scene other bits change too."""


def pair_contradiction(seen: AxisFrames) -> str | None:
    """A sentence if patterns and inverses do not add up to white + black; None if they do.

    A pair adds up to white + black at any blur and any interreflection, because light adds up. Two frames that are no
    pair do so at half of the pixels only.

    Parameters
    ----------
    seen : frames (2 b, h, w), each pattern followed by its inverse.
    """
    contrast = seen.contrast
    if not contrast.is_measured:
        return None
    white, black, values = contrast.white.ravel(), contrast.black.ravel(), contrast.values.ravel()
    usable = contrast.is_enough & ~seen.capture.saturated(contrast.white[None])
    used = evenly_spread(np.flatnonzero(usable))
    if len(used) < MIN_PIXELS:
        return None
    used = used[values[used] >= np.median(values[used])]
    total = white[used].astype(np.float64) + black[used]
    fractions = []
    for k in range(0, len(seen.frames), 2):
        pattern, inverse = (seen.frames[i].ravel()[used].astype(np.float64) for i in (k, k + 1))
        fractions.append(float((np.abs(pattern + inverse - total) > MIN_UNPAIRED * values[used]).mean()))
    unpaired = [k for k, fraction in enumerate(fractions) if fraction > MAX_UNPAIRED_FRACTION]
    if not unpaired:
        return None
    worst = max(unpaired, key=fractions.__getitem__)
    pattern_name, inverse_name = map(seen.shown_name, seen.names[2 * worst : 2 * worst + 2])
    return (
        f"{len(unpaired)} of {len(fractions)} pairs of pattern and inverse along {seen.axis} contradict white and "
        f"black: frames {pattern_name} and {inverse_name} do not add up to their sum at {100 * fractions[worst]:.0f} % "
        "of the pixels: check the order of the frames, that none is missing or there twice, and that all have one "
        "exposure."
    )


def binary_contradiction(seen: AxisFrames, gray: AxisCode) -> str | None:
    """A sentence if the patterns look like plain binary numbers; None if they look like Gray code.

    Neighbouring pixels see neighbouring cells. If plain binary numbers are read as Gray code, the codes of neighbours
    lie farther apart. If the frames of a Gray code are in another order, they may lie farther apart too, but they lie
    nearest when read in that order: then the result is None.

    Parameters
    ----------
    seen : frames (2 b, h, w), each pattern followed by its inverse, most significant bit first. gray : their code.
    """
    cell = gray.coordinate / gray.cell_px
    usable = (cell % 1 == 0.5) & (gray.status == Status.OK)
    number = np.where(usable, cell, 0).astype(np.int64)
    plain = number ^ (number >> 1)  # the bits as shown
    pairs = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = usable[here] & usable[there] & (number[here] != number[there])
        pairs.append(np.stack([plain[here][both], plain[there][both]]))
    words = np.concatenate(pairs, axis=1)
    as_gray, as_binary = np.log2(_apart(words, 0)), np.log2(np.abs(words[1] - words[0]))
    if len(as_gray) < MIN_STEPS or as_gray.mean() < as_binary.mean() + MAX_FARTHER_OCTAVES:
        return None
    few = words[:, :: 1 + words.shape[1] // MAX_PAIRS]
    orders = [np.log2(_apart(reorder(few), 0)).mean() for _, reorder in _other_orders(_bit_names(seen))]
    if min(orders) < np.log2(np.abs(few[1] - few[0])).mean():
        return None
    return (
        f"the bits along {seen.axis} contradict Gray code: neighbouring pixels lie {2 ** as_gray.mean():.1f} cells "
        f"apart as Gray code, and {2 ** as_binary.mean():.1f} as plain binary numbers: check which code was shown."
    )


def order_contradiction(seen: AxisFrames, gray: AxisCode) -> str | None:
    """A sentence if the bits of the Gray code seem to be in another order, inverted or repeated; None if not.

    Neighbouring pixels see neighbouring cells. The function tries other orders. Each changes the distance of some
    neighbours; if an order brings nearly all of these nearer to each other, the frames were in that order.

    Parameters
    ----------
    seen : frames (2 b, h, w), each pattern followed by its inverse, most significant bit first. gray : their code.
    """
    number = np.floor(gray.coordinate / gray.cell_px).astype(np.int64)
    usable = ((gray.coordinate / gray.cell_px) % 1 == 0.5) & (gray.status != Status.LOW_SIGNAL)
    usable &= gray.status != Status.SATURATED
    word = number ^ (number >> 1)  # the bits as shown
    pairs = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = usable[here] & usable[there]
        pairs.append(np.stack([word[here][both], word[there][both]]))
    bits = _bit_names(seen)
    few = [words[:, :: 1 + words.shape[1] // MAX_PAIRS] for words in pairs]
    across = max(few, key=lambda words: np.count_nonzero(words[0] != words[1]))
    step = _coarse_step(across, len(bits))
    # This looks at all pairs, because the coarsest bits change at a line or two of the image.
    text = None if step is None else _repeated_bit(_that_differ(pairs) >> step, bits[step:])
    text = text or _better_order(across, _that_differ(few), bits)
    if text is None:
        return None
    return f"the bits along {seen.axis} contradict Gray code, where neighbouring pixels see neighbouring cells: {text}."


def _bit_names(seen: AxisFrames) -> list[str]:
    """Names of the patterns without their inverses, least significant first."""
    return [seen.shown_name(name) for name in seen.names[-2::-2]]


def _that_differ(pairs: list[np.ndarray]) -> np.ndarray:
    """(2, m) words of all pairs (2, n) whose two words differ."""
    words = np.concatenate(pairs, axis=1)
    return np.asarray(words[:, words[0] != words[1]])


def _better_order(across: np.ndarray, words: np.ndarray, bits: list[str]) -> str | None:
    """The fault of the frames whose correction brings neighbours nearest together; None if no correction does.

    Parameters
    ----------
    across : (2, n) int, Gray words of neighbours in the direction in which the code changes more.
    words : (2, m) int, Gray words of the neighbours in both directions whose words differ.
    bits : (b,) names of the patterns, least significant first.
    """
    best, text = 0.0, None
    for fault, reorder in _other_orders(bits):
        step = _coarse_step(reorder(across), len(bits))
        if step is None:
            continue
        octaves = np.log2(np.maximum(_apart(words, step), 0.5) / np.maximum(_apart(reorder(words), step), 0.5))
        moved, nearer, gain = np.abs(octaves) >= 1, octaves >= 1, float(octaves.sum())
        if moved.sum() >= MIN_STEPS and nearer.sum() > MAX_NEARER_FRACTION * moved.sum() and gain > best:
            best, text = gain, fault
    return text


def _coarse_step(words: np.ndarray, n_bits: int) -> int | None:
    """Least number of finest bits to leave out so that half of the neighbours with Gray words (2, n) see the same cell.

    Bits that are finer than the camera's pixels do not show neighbours. None if fewer than three bits would be left.
    """
    first, second = binary_of_gray(words)
    for step in range(n_bits - 2):
        if np.count_nonzero(first >> step == second >> step) >= 0.5 * len(first):
            return step
    return None


def _apart(words: np.ndarray, step: int) -> np.ndarray:
    """(n,) int, distance of the neighbours with Gray words (2, n), in cells as large as 2^step of the finest ones."""
    first, second = binary_of_gray(words)
    return np.asarray(np.abs((second >> step) - (first >> step)))


def _other_orders(bits: list[str]) -> Iterator[tuple[str, Callable[[np.ndarray], np.ndarray]]]:
    """Faults that the order of the frames may have, each with the function that corrects Gray words for it.

    Parameters
    ----------
    bits : (b,) names of the patterns, least significant first.
    """
    n = len(bits)
    yield "every inverse seems to stand before its pattern", partial(np.bitwise_xor, (1 << n) - 1)
    yield "the least significant bit seems to come first", partial(_reversed, n)
    for i in range(n):
        yield f"frame {bits[i]} and its inverse seem to be exchanged", partial(np.bitwise_xor, 1 << i)
        for j in range(i):
            both = f"frames {bits[i]} and {bits[j]}, each with its inverse,"
            yield f"{both} seem to be exchanged", partial(_exchanged, i, j)


def _reversed(n_bits: int, words: np.ndarray) -> np.ndarray:
    """Words of `n_bits` bits, with the bits in reverse order."""
    result = np.zeros_like(words)
    for k in range(n_bits):
        result |= ((words >> k) & 1) << (n_bits - 1 - k)
    return result


def _exchanged(i: int, j: int, words: np.ndarray) -> np.ndarray:
    """Words with bits i and j exchanged."""
    differ = ((words >> i) ^ (words >> j)) & 1
    return np.asarray(words ^ (differ << i) ^ (differ << j))


def _repeated_bit(words: np.ndarray, bits: list[str]) -> str | None:
    """A clause that names two bits which always change together; None if no two do.

    Parameters
    ----------
    words : (2, m) int, Gray words of neighbours that differ. bits : (b,) names of the patterns, least significant
        first."""
    changed = words[0] ^ words[1]
    counts = [int(np.count_nonzero(changed & (1 << i))) for i in range(len(bits))]
    for i in range(len(bits)):
        for j in range(i):
            two = (1 << i) | (1 << j)
            both = int(np.count_nonzero((changed & two) == two))
            if both < MIN_STEPS or both < MIN_REPEATED_FRACTION * max(counts[i], counts[j]):
                continue
            if np.count_nonzero(changed == two) > MIN_ALONE_FRACTION * both:
                return f"frames {bits[i]} and {bits[j]} seem to be one pattern shown twice"
    return None
