# SPDX-License-Identifier: Apache-2.0
"""Checks of the words of neighbouring pixels, which see neighbouring cells: another code, another order of the frames.

A single pair of pixels may lie across a step of the scene, so the checks look at many pairs at once. Each check returns
one sentence with the likely cause, or None.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.bit_levels import Light
from rangesim.codes.bits import Words, bit_frames
from rangesim.decoding.status import Status

MAX_PAIRS = 50_000
"""Largest number of pairs of neighbouring pixels, across and also down the image, on which other orders of the frames
are tried, so that the time is bounded, which grows with the number of orders. With far fewer, too few of them would lie
in different cells (see `MIN_STEPS`)."""

MIN_STEPS = 100
"""Least number of pairs of neighbouring pixels in different cells from which a check of the order draws a
conclusion."""

MAX_FARTHER_OCTAVES = 0.3
"""Largest mean distance by which neighbours may lie farther apart when read as the code than when read as another one,
in powers of two. For plain binary numbers that are read as Gray code, this distance is about 1. For the right code
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

MAX_CLEAR_BETWEEN = 0.15
"""Largest fraction of the pixels between dark and lit of a bit that the camera resolves, so that its edges have a
place. In a real capture, the finest bit that it resolves has 0.13, and the next one 0.24."""

MIN_ADJACENT_FRACTION = 0.5
"""Least fraction of the places where one bit changes alone that lie between neighbouring cells, and least number of
those in Gray code. It is above 0.98 in real captures; if a frame is displaced by its own stripes, it is below 0.4."""

MIN_CODED_EDGES = 4
"""Least number of edges of a bit whose places are checked. The edges of the others are one or two lines of the image,
and steps of the scene may hide them: in a real capture, 24 % of the changes of such a bit led to the next cell."""


def other_code_contradiction(
    seen: AxisFrames, neighbours: Neighbours, words: Words, others: Sequence[Words]
) -> str | None:
    """A sentence if the patterns look like another code; None if they look like the code that they are read as.

    Neighbouring pixels see neighbouring cells. If the words of one code are read as those of another, the cells of
    neighbours lie farther apart. If the frames are in another order, they may lie farther apart too, but they lie
    clearly nearer when read in that order: then the result is None.

    Parameters
    ----------
    seen : frames (k, h, w) of the bits. neighbours : what `neighbours_of` returns. words : those of the code.
    others : those of other codes with as many bits.
    """
    both = neighbours.differing
    if both.counts.sum() < MIN_STEPS:
        return None
    own = _octaves(both, words.cell_of)
    nearest = min(others, key=lambda other: _octaves(both, other.cell_of), default=words)
    least = _octaves(both, nearest.cell_of)
    if own < least + MAX_FARTHER_OCTAVES:
        return None
    orders = [_octaves(both, cell_of) for _, cell_of in _other_orders(seen, words)]
    if min(orders) + MAX_FARTHER_OCTAVES < least:
        return None
    return (
        f"the bits along {seen.axis} contradict {words.noun}: neighbouring pixels lie {2**own:.1f} cells apart as "
        f"{words.noun}, and {2**least:.1f} as {nearest.noun}: check which code was shown."
    )


def order_contradiction(seen: AxisFrames, neighbours: Neighbours, words: Words) -> str | None:
    """A sentence if the bits seem to be in another order, inverted or repeated; None if not.

    Neighbouring pixels see neighbouring cells. The function tries other orders. Each changes the distance of some
    neighbours; if an order brings nearly all of these nearer to each other, the frames were in that order.

    Parameters
    ----------
    seen : frames (k, h, w) of the bits. neighbours : what `neighbours_of` returns. words : those of the code.
    """
    from rangesim.codes.bit_kernels import coarse_step

    few = [part[:: 1 + len(part) // MAX_PAIRS] for part in neighbours.keys]
    across = Pairs.of(max(few, key=lambda part: len(_that_differ(part))))
    step, differing, text = coarse_step(across, words.cell_of, words.bits), neighbours.differing, None
    if step >= 0 and words.change_one_bit:
        names = [seen.shown_name(bit.name) for bit in reversed(bit_frames(seen.names, words.bits))]
        text = _repeated_bit((differing.first ^ differing.second) >> step, differing.counts, names[step:])
    text = text or _better_order(across, differing, seen, words)
    if text is None:
        return None
    return (
        f"the bits along {seen.axis} contradict {words.noun}, where neighbouring pixels see neighbouring cells: {text}."
    )


def displaced_contradiction(light: Light, neighbours: Neighbours) -> str | None:
    """A sentence if a bit changes where the finer ones have no edge between cells; None if none does.

    In a code that changes one bit from cell to cell, a bit that changes alone leads to the next cell. If its frame is
    displaced, or of another scene, it leads elsewhere.

    Parameters
    ----------
    light : what `light_of_bits` returns. neighbours : what `neighbours_of` returns.
    """
    words = light.words
    if not (words.change_one_bit and light.halves_stripes):
        return None
    clear = np.flatnonzero((light.between < MAX_CLEAR_BETWEEN)[::-1] & light.is_resolved[::-1])
    if not len(clear):
        return None
    finest = int(clear[0])
    both = neighbours.differing
    changed = (both.first ^ both.second) >> finest
    is_next = np.abs(words.cell_of[both.first] - words.cell_of[both.second]) < 2 << finest  # finer bits may differ
    n_edges = np.count_nonzero(np.diff(light.coded), axis=1)[::-1]
    expected = float(both.counts[changed == 1].sum())  # each coarser bit has half the edges
    shown = list(reversed(bit_frames(light.seen.names, words.bits)))
    for k in range(finest + 1, words.bits):
        expected /= 2
        alone = changed == 1 << (k - finest)
        n = int(both.counts[alone].sum())
        adjacent = int(both.counts[alone & is_next].sum())
        if n >= MIN_STEPS and n_edges[k] >= MIN_CODED_EDGES and adjacent < MIN_ADJACENT_FRACTION * min(n, expected):
            name = light.seen.shown_name(shown[k].frame_name)
            return (
                f"the bits along {light.seen.axis} contradict {words.noun}: where frame {name} changes, "
                f"{100 * (1 - adjacent / n):.0f} % of the pixels do not see the next cell: check that nothing moved "
                "between the frames, and that all show one scene."
            )
    return None


class Pairs(NamedTuple):
    """Words of neighbouring pixels; equal pairs are counted, because most are equal to others.

    first, second : (n,) int32, words of the two pixels. counts : (n,) int64, number of such pairs.
    """

    first: np.ndarray
    second: np.ndarray
    counts: np.ndarray

    @classmethod
    def of(cls, keys: np.ndarray) -> Pairs:
        """Pairs of keys (m,) int64, as `neighbours_of` returns them."""
        distinct, counts = np.unique(keys, return_counts=True)
        return cls((distinct >> 32).astype(np.int32), distinct.astype(np.int32), counts.astype(np.int64))


class Neighbours(NamedTuple):
    """Words of neighbouring pixels, both inside a cell.

    keys : (n,) int64 each, across and down the image: the word of the one pixel in the upper 32 bits, and that of the
    other in the lower ones. differing : Pairs, all of those whose words differ, because the coarsest bits change at a
    line or two of the image.
    """

    keys: list[np.ndarray]
    differing: Pairs


def neighbours_of(code: AxisCode, words: Words) -> Neighbours:
    """Words of neighbouring pixels of an image.

    Parameters
    ----------
    code : what the frames decode to. words : those of the code.
    """
    from rangesim.codes.bit_kernels import neighbour_keys

    cell = code.coordinate / np.float32(code.cell_px)
    number = np.floor(cell)
    usable = (cell - number == 0.5) & (code.status != Status.LOW_SIGNAL) & (code.status != Status.SATURATED)
    word = np.where(usable, words.of_cell[number.astype(np.int32)], np.int32(-1))  # the bits as shown
    keys = [neighbour_keys(word, 0, 1), neighbour_keys(word, 1, 0)]
    return Neighbours(keys, Pairs.of(np.concatenate([_that_differ(part) for part in keys])))


def _that_differ(keys: np.ndarray) -> np.ndarray:
    """The keys, of keys (n,), whose two words differ."""
    return np.asarray(keys[keys >> 32 != keys & 0xFFFFFFFF])


def _octaves(both: Pairs, cell_of: np.ndarray) -> float:
    """Mean distance of neighbours with words that differ, in cells, as a power of two; cell_of : (2^b,), of words."""
    apart = np.abs(cell_of[both.second] - cell_of[both.first])
    return float(np.average(np.log2(apart), weights=both.counts))


def _better_order(across: Pairs, differing: Pairs, seen: AxisFrames, words: Words) -> str | None:
    """The fault of the frames whose correction brings neighbours nearest together; None if no correction does.

    Parameters
    ----------
    across : words of neighbours in the direction in which the code changes more.
    differing : words of the neighbours in both directions whose words differ.
    seen : frames of the bits. words : those of the code.
    """
    from rangesim.codes.bit_kernels import coarse_step, octaves_nearer

    best, text = 0.0, None
    unresolved = max(coarse_step(across, words.cell_of, words.bits), 0)
    for fault, cell_of in _other_orders(seen, words):
        step = coarse_step(across, cell_of, words.bits)
        changed = np.bitwise_xor(words.of_cell[cell_of], np.arange(len(cell_of)))
        if step < 0 or changed.max() >> unresolved == 0:  # bits that the camera does not resolve tell no order
            continue
        moved, nearer, gain = octaves_nearer(differing, words.cell_of, cell_of, step)
        if moved >= MIN_STEPS and nearer > MAX_NEARER_FRACTION * moved and gain > best:
            best, text = gain, fault
    return text


def _other_orders(seen: AxisFrames, words: Words) -> Iterator[tuple[str, np.ndarray]]:
    """Faults that the order of the frames may have, each with the cells (2^b,) int32 of words that it corrects."""
    every = np.arange(len(words.cell_of), dtype=np.int32)
    for fault, corrected in _corrections(seen, words):
        yield fault, words.cell_of[corrected(every)]


def _corrections(seen: AxisFrames, words: Words) -> Iterator[tuple[str, Callable[[np.ndarray], np.ndarray]]]:
    """Faults that the order of the frames may have, each with the function that corrects words for it."""
    n = words.bits
    shown = list(reversed(bit_frames(seen.names, n)))
    is_pair = [bit.pattern is not None and bit.inverse is not None for bit in shown]
    names = [seen.shown_name(bit.name if bit.pattern is not None else f"{bit.name}_inverse") for bit in shown]
    if all(is_pair):
        yield "every inverse seems to stand before its pattern", partial(np.bitwise_xor, (1 << n) - 1)
    else:
        lone = sum(1 << i for i in range(n) if not is_pair[i])
        yield "frames without their inverse seem to be inverted", partial(np.bitwise_xor, lone)
    yield "the least significant bit seems to come first", partial(_reversed, n)
    for i in range(n):
        fault = f"{names[i]} and its inverse seem to be exchanged" if is_pair[i] else f"{names[i]} seems to be inverted"
        yield f"frame {fault}", partial(np.bitwise_xor, 1 << i)
        for j in range(i):
            each = ", each with its inverse," if is_pair[i] and is_pair[j] else ""
            yield f"frames {names[i]} and {names[j]}{each} seem to be exchanged", partial(_exchanged, i, j)


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


def _repeated_bit(changed: np.ndarray, weights: np.ndarray, bits: list[str]) -> str | None:
    """A clause that names two bits which always change together; None if no two do.

    Parameters
    ----------
    changed : (n,) int, bits in which the words of neighbours differ. weights : (n,) int, number of such neighbours.
    bits : (b,) names of the patterns, least significant first.
    """
    counts = [int(weights[changed & (1 << i) > 0].sum()) for i in range(len(bits))]
    for i in range(len(bits)):
        for j in range(i):
            two = (1 << i) | (1 << j)
            both = int(weights[(changed & two) == two].sum())
            if both < MIN_STEPS or both < MIN_REPEATED_FRACTION * max(counts[i], counts[j]):
                continue
            if weights[changed == two].sum() > MIN_ALONE_FRACTION * both:
                return f"frames {bits[i]} and {bits[j]} seem to be one pattern shown twice"
    return None
