# SPDX-License-Identifier: Apache-2.0
"""Checks of the taps of a modulated camera against each other: their order, their direction, and their frequencies.

Taps of real cameras come in orders of their own, and nothing in a single pixel shows it. The image as a whole does:
evenly spaced taps lie on a cosine, the phases of several frequencies agree on one length, and light falls with the
square of the distance. One frequency that is stated wrong scales all ranges, and contradicts nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from rangesim.decoding.phase_shift import Phase
from rangesim.decoding.phase_unwrapping import unwrap

MIN_PIXELS = 200
"""Least number of pixels with enough light for a verdict on a capture; of fewer, single objects may decide."""

MAX_PIXELS = 2000
"""Number of pixels that are looked at, evenly spread: their medians are known to 3 %."""

MAX_OFF_COSINE = 0.5
"""Largest typical distance of the taps from a cosine, as a fraction of its amplitude. Taps in another order were 1.2 to
3.3 off in tests; harmonics of a tenth are 0.1 off, and phases that pass the thresholds have 0.2 of noise."""

CLEARER = 3.0
"""Factor by which another order of the taps, or of the frequencies, has to fit better than the stated one."""

MAX_MISFIT = 0.04
"""Largest typical misfit of the worst phase, in turns. Noise at which phases are refused (0.2 radians) makes 0.03,
multipath in a corner 0.01. Wrong frequencies, orders and directions made 0.045 to 0.16 in tests."""

MIN_SPREAD = 0.3
"""Least spread of the light, and of the light times the square of its path, in powers of e, for a doubt of its
direction: albedos and slopes of one surface differ by less."""

MAX_FREQUENCIES = 4
"""Largest number of frequencies whose other orders are tried; more have more than 24."""


def chosen(usable: np.ndarray) -> np.ndarray | None:
    """(n,) int, flat indices of up to `MAX_PIXELS` usable pixels, evenly spread; None if there are too few.

    Parameters
    ----------
    usable : (h, w) bool, pixels with enough light that no tap saturates.
    """
    found = np.flatnonzero(usable)
    return found[:: max(1, len(found) // MAX_PIXELS)] if len(found) >= MIN_PIXELS else None


def empty_contradiction(frames: np.ndarray, names: Sequence[str]) -> str | None:
    """A sentence if some of the taps are 0 at all pixels, and others are not; None if not.

    Parameters
    ----------
    frames : (k, h, w), all taps. names : (k,) of the taps.
    """
    is_empty = [not frame.any() for frame in frames]
    if not any(is_empty) or all(is_empty):
        return None
    empty = ", ".join(name for name, nothing in zip(names, is_empty, strict=True) if nothing)
    return f"{empty} is 0 at all pixels, so the ranges are wrong: check that no tap is missing in the capture."


def order_contradiction(groups: Sequence[np.ndarray]) -> str | None:
    """A sentence if the taps lie on no cosine; None if they do, or if there are only three, which always do.

    Parameters
    ----------
    groups : per frequency (N, n) float, taps of n pixels.

    Examples
    --------
    >>> phi = np.linspace(0, 6, 400)
    >>> taps = np.stack([5 + np.cos(phi - np.pi * k / 2) for k in (0, 2, 1, 3)])  # 0, 180, 90, 270 degrees
    >>> order_contradiction([taps])[:56]
    'taps 1 and 2 of a frequency add up to as much as 3 and 4'
    """
    taps = len(groups[0])
    if taps == 4:
        off = [float(np.median([np.median(_unequal(g, pairs)) for g in groups])) for pairs in _PAIRS]
        amplitude = float(np.median([np.median(np.hypot(g[0] - g[2], g[1] - g[3])) / 2 for g in groups]))
        best = int(np.argmin(off))
        if off[0] > 2 * MAX_OFF_COSINE * amplitude and off[0] > CLEARER * off[best]:
            (a, b), (c, d) = _PAIRS[best]
            return (
                f"taps {a + 1} and {b + 1} of a frequency add up to as much as {c + 1} and {d + 1}, so these are "
                "opposite ones, and the frames are not in the order 0, 90, 180, 270 degrees: the ranges are wrong; "
                "sort the frames."
            )
        return None
    if taps > 4 and float(np.median([np.median(_off_cosine(g)) for g in groups])) > MAX_OFF_COSINE:
        return (
            f"the {taps} taps of a frequency lie on no cosine of evenly spaced delays, so the ranges are doubtful: "
            "check the order of the frames."
        )
    return None


_PAIRS = (((0, 2), (1, 3)), ((0, 1), (2, 3)), ((0, 3), (1, 2)))
"""Pairs of opposite taps: as stated, and in the two other orders."""


def _unequal(taps: np.ndarray, pairs: tuple[tuple[int, int], tuple[int, int]]) -> np.ndarray:
    """(n,) difference between the sums of two pairs of taps (4, n)."""
    (a, b), (c, d) = pairs
    return np.asarray(np.abs(taps[a] + taps[b] - taps[c] - taps[d]))


def _off_cosine(taps: np.ndarray) -> np.ndarray:
    """(n,) rms distance of taps (N, n) from their cosine, times sqrt(2), as a fraction of its amplitude."""
    n, spectrum = len(taps), np.fft.fft(taps, axis=0)
    rest = (np.abs(spectrum[2 : n - 1]) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(rest / np.maximum(2 * np.abs(spectrum[1]) ** 2, 1e-30)))


def frequency_contradiction(
    phases: Sequence[Phase], modulation_hz: tuple[float, ...], weights: Sequence[np.ndarray], longest_m: float
) -> str | None:
    """A sentence if the phases of several frequencies agree on no length at most pixels; None if they do.

    Parameters
    ----------
    phases : per frequency, of n pixels. weights : per frequency (n,), see `unwrap`. longest_m : see `unwrap`.
    """
    if len(phases) < 2:
        return None
    turns = [p.normalised for p in phases]
    stated = _misfit(turns, modulation_hz, weights, longest_m)
    if stated <= MAX_MISFIT:
        return None
    start = (
        "the phases of the frequencies agree on no path length, typically to "
        f"{stated:.2f} turns, so the ranges are wrong"
    )
    if len(turns) <= MAX_FREQUENCIES:
        tried = [
            (_misfit(other, hz, weights, longest_m), words) for words, hz, other in _hypotheses(turns, modulation_hz)
        ]
        misfit, words = min(tried)
        if CLEARER * misfit < stated:
            return f"{start}; they agree if {words}."
    return (
        f"{start}: check modulation_hz, the order of the frames, and whether each frequency has a phase offset of its "
        "own that calibration has to remove."
    )


def _misfit(
    turns: Sequence[np.ndarray], modulation_hz: tuple[float, ...], weights: Sequence[np.ndarray], longest_m: float
) -> float:
    """Median over the pixels of the largest misfit of a phase, in turns, to the length on which the others agree."""
    found = unwrap([t[None] for t in turns], modulation_hz, [w[None] for w in weights], longest_m)
    return float(np.median(found.residual))


def _hypotheses(
    turns: Sequence[np.ndarray], modulation_hz: tuple[float, ...]
) -> Iterator[tuple[str, tuple[float, ...], list[np.ndarray]]]:
    """Other orders of the frequencies, then other directions of some of them: in words, frequencies and phases."""
    for hertz in permutations(modulation_hz):
        if hertz != modulation_hz:
            yield f"they are those of {', '.join(f'{f / 1e6:g}' for f in hertz)} MHz in this order", hertz, list(turns)
    for signs in product((1, -1), repeat=len(turns)):
        if len(set(signs)) == 2:  # with all of them the other way, the lengths are mirrored, and agree
            back = ", ".join(f"{f / 1e6:g}" for f, sign in zip(modulation_hz, signs, strict=True) if sign < 0)
            other = [t if sign > 0 else (1 - t) % 1 for t, sign in zip(turns, signs, strict=True)]
            yield f"the taps of {back} MHz run the other way", modulation_hz, other


def direction_contradiction(length_m: np.ndarray, modulation: np.ndarray, period_m: float) -> str | None:
    """A sentence if light would fall with the square of the distance with taps in the other direction, and not as read.

    Parameters
    ----------
    length_m, modulation : (n,) float, path lengths and the light that came along. period_m : path length after which
        all readings repeat.

    Examples
    --------
    >>> length = np.linspace(2.0, 6.0, 500)
    >>> direction_contradiction(length, length**-2, period_m=15.0) is None
    True
    >>> direction_contradiction(15.0 - length, length**-2, period_m=15.0)[:43]
    'pixels are brighter where the path is longe'
    """
    inside = (length_m > 0) & (length_m < period_m) & (modulation > 0)
    if np.count_nonzero(inside) < MIN_PIXELS:
        return None
    light, length = np.log(modulation[inside]), length_m[inside]
    unexplained, stated, mirrored = (_spread(light + 2 * np.log(x)) for x in (1.0, length, period_m - length))
    if min(stated, unexplained) > max(MIN_SPREAD, CLEARER * mirrored):
        return (
            "pixels are brighter where the path is longer, and light falls with the distance if the taps run the other "
            "way, so the ranges may be mirrored: check the order of the frames, and that no surface is beyond "
            f"{period_m / 2:.4g} m."
        )
    return None


def _spread(values: np.ndarray) -> float:
    """Half of the distance between the 16th and the 84th percentile."""
    low, high = np.percentile(values, [16, 84])
    return float(high - low) / 2
