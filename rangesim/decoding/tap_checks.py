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
from rangesim.decoding.pixel_samples import MIN_PIXELS, equal_frames, same_images

MAX_PIXELS = 2000
"""Number of pixels that are looked at, evenly spread: their medians are known to 3 %."""

MAX_OFF_COSINE = 0.12
"""Largest systematic distance of the taps from a cosine, as a fraction of its amplitude. Sound taps were at most 0.006
off in tests, a second harmonic of a tenth makes 0.1, and a lost frame, with the last one there twice, 0.17 to 0.8."""

PHASE_BINS = 24
"""Number of parts of a turn, at most, in which the distance from a cosine is averaged, so that noise cancels. Each tap
of 3, 4, 6 or 8 starts at the edge of one."""

MIN_IN_BIN = 20
"""Least number of pixels in a part of a turn. Their median has a quarter of the noise of a pixel."""

CLEARER = 3.0
"""Factor by which another order of the taps, or of the frequencies, has to fit better than the stated one."""

MAX_MISFIT = 0.04
"""Largest typical misfit of the worst phase, in turns. Noise at which phases are refused (0.2 radians) makes 0.03,
multipath in a corner 0.01. Wrong frequencies, orders and directions made 0.045 to 0.16 in tests."""

MIN_SPREAD = 0.3
"""Least spread of the light, and of the light times the square of its path, in powers of e, for a doubt of its
direction: albedos and slopes of one surface differ by less."""

MIN_RANGE_DN = 10
"""Least range of the other frames, in digital numbers, at which a frame of one number was not taken of the scene. In
weak light, all frames may have one or two numbers."""

MAX_FREQUENCIES = 4
"""Largest number of frequencies whose other orders are tried; more have more than 24."""

MIN_CLIPPED = 0.005
"""Least fraction of the pixels of which several taps have the largest number, at which it is the level where the camera
clips. A single highlight has fewer pixels."""

MIN_CLIPPED_SPREAD = 0.02
"""Least spread of the darkest taps of these pixels, as a fraction of the level. If they are alike, as on an evenly lit
wall, the largest number may be their brightness."""


def frame_contradiction(frames: np.ndarray, names: Sequence[str]) -> str | None:
    """A sentence if a frame has one number everywhere, or is there twice; None if neither.

    Parameters
    ----------
    frames : (k, h, w) of digital numbers. names : (k,) names of the frames.
    """
    if frames[0].size < MIN_PIXELS:
        return None
    ranges = np.array([int(frame.max()) - int(frame.min()) for frame in frames])
    is_flat = (ranges == 0) & (frames[:, 0, 0] < frames.max())  # the largest number may be the one that clips
    flat = [name for name, alike in zip(names, is_flat, strict=True) if alike]
    if flat and len(flat) < len(frames) and np.median(ranges[ranges > 0]) >= MIN_RANGE_DN:
        return (
            f"{', '.join(flat)}: the same number at every pixel, which no camera takes of a scene: check that "
            "{} written and read as a whole.".format("this frame was" if len(flat) == 1 else "these frames were")
        )
    return next((same_images(names[i], names[j]) for i, j in equal_frames(frames)), None)


def clipping_level(frames: np.ndarray) -> int | None:
    """The number at which an unknown camera clips, if many pixels have it in several taps; None if not.

    Without clipping, hardly two taps of a pixel have the same number, and hardly a pixel has the largest one.

    Parameters
    ----------
    frames : (k, h, w) of digital numbers.
    """
    top = int(frames.max())
    several = np.count_nonzero(frames == top, axis=0) > 1
    if np.count_nonzero(several) < max(MIN_PIXELS / 10, MIN_CLIPPED * several.size):
        return None
    spread = float(np.ptp(np.percentile(frames.min(axis=0)[several], [10, 90])))
    return top if spread > MIN_CLIPPED_SPREAD * top else None


def signed_readings(taps: np.ndarray, largest: int) -> Iterator[np.ndarray]:
    """Numbers in two's complement that were read without their sign, each as float32 with the sign.

    Parameters
    ----------
    taps : (k, n) of unsigned numbers. largest : largest number of their type.
    """
    top = int(taps.max())
    for size in {largest + 1, 1 << top.bit_length()}:
        yield np.where(taps >= size // 2, taps.astype(np.float64) - size, taps).astype(np.float32)


def chosen(usable: np.ndarray) -> np.ndarray | None:
    """(n,) int, flat indices of up to `MAX_PIXELS` usable pixels, evenly spread; None if there are too few.

    Parameters
    ----------
    usable : (h, w) bool, pixels with enough light that no tap saturates.
    """
    found = np.flatnonzero(usable)
    return found[:: max(1, len(found) // MAX_PIXELS)] if len(found) >= MIN_PIXELS else None


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
        if off[0] > amplitude and off[0] > CLEARER * off[best]:
            (a, b), (c, d) = _PAIRS[best]
            return (
                f"taps {a + 1} and {b + 1} of a frequency add up to as much as {c + 1} and {d + 1}, so these are "
                "opposite ones, and the frames are not in the order 0, 90, 180, 270 degrees: the ranges are wrong; "
                "sort the frames."
            )
    if taps < 4 or max(_off_cosine(group) for group in groups) <= MAX_OFF_COSINE:
        return None
    return (
        f"the {taps} taps of a frequency lie on no cosine of evenly spaced delays, so the ranges are wrong: check that "
        "no frame is missing or there twice, and the order of the frames."
    )


_PAIRS = (((0, 2), (1, 3)), ((0, 1), (2, 3)), ((0, 3), (1, 2)))
"""Pairs of opposite taps: as stated, and in the two other orders."""


def _unequal(taps: np.ndarray, pairs: tuple[tuple[int, int], tuple[int, int]]) -> np.ndarray:
    """(n,) difference between the sums of two pairs of taps (4, n)."""
    (a, b), (c, d) = pairs
    return np.asarray(np.abs(taps[a] + taps[b] - taps[c] - taps[d]))


def _off_cosine(taps: np.ndarray) -> float:
    """Systematic distance of taps (N, n) from a cosine, rms times sqrt(2), as a fraction of its amplitude.

    Light that changes from one exposure to the next scales opposite taps alike, and is taken out. Four taps show even
    harmonics of the correlation alone, which are small. More taps show others, too. Those move each tap by the same
    function of the phase minus the tap's delay, and a wrong frame does not: what the taps have in common is taken out,
    and phases at which only one tap was seen do not count.
    """
    values, n = taps.astype(np.float64), len(taps)
    if n % 2 == 0:
        sums = values[: n // 2] + values[n // 2 :]
        scale = (sums[0] * sums).sum(axis=1) / np.maximum((sums**2).sum(axis=1), 1e-12)
        values = values * np.tile(scale, 2)[:, None]
    spectrum = np.fft.fft(values, axis=0)
    amplitude, turns = 2 * np.abs(spectrum[1]) / n, -np.angle(spectrum[1]) / (2 * np.pi) % 1
    spectrum[[0, 1, n - 1]] = 0
    rest = np.fft.ifft(spectrum, axis=0).real / np.maximum(amplitude, 1e-12)
    bins = max(1, PHASE_BINS // n) * n
    at = np.minimum((turns * bins).astype(int), bins - 1)
    seen = np.full((n, bins), np.nan)  # by the phase minus the tap's delay
    for i in range(bins):
        if np.count_nonzero(at == i) >= MIN_IN_BIN:
            seen[np.arange(n), (i - np.arange(n) * bins // n) % bins] = np.median(rest[:, at == i], axis=1)
    known = np.isfinite(seen)
    count = known.sum(axis=0)
    common = np.nansum(seen, axis=0) / np.maximum(count, 1) if n > 4 else 0.0
    used = known & ((count > 1) | (n == 4))
    return float(np.sqrt(2 * np.mean((seen - common)[used] ** 2))) if used.any() else 0.0


def frequency_contradiction(
    phases: Sequence[Phase],
    modulation_hz: tuple[float, ...],
    weights: Sequence[np.ndarray],
    longest_m: float,
    taps: int,
) -> str | None:
    """A sentence if the phases of several frequencies agree on no length at most pixels; None if they do.

    Parameters
    ----------
    phases : per frequency, of n pixels. weights : per frequency (n,), see `unwrap`. longest_m : see `unwrap`.
    taps : number of taps of a frequency.
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
            (_misfit(other, hz, weights, longest_m), words)
            for words, hz, other in _hypotheses(turns, modulation_hz, taps)
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
    turns: Sequence[np.ndarray], modulation_hz: tuple[float, ...], taps: int
) -> Iterator[tuple[str, tuple[float, ...], list[np.ndarray]]]:
    """Other orders of the frequencies, other directions of some, other first taps: in words, frequencies and phases."""
    for hertz in permutations(modulation_hz):
        if hertz != modulation_hz:
            yield f"they are those of {', '.join(f'{f / 1e6:g}' for f in hertz)} MHz in this order", hertz, list(turns)
    for signs in product((1, -1), repeat=len(turns)):
        if len(set(signs)) == 2:  # with all of them the other way, the lengths are mirrored, and agree
            back = ", ".join(f"{f / 1e6:g}" for f, sign in zip(modulation_hz, signs, strict=True) if sign < 0)
            other = [t if sign > 0 else (1 - t) % 1 for t, sign in zip(turns, signs, strict=True)]
            yield f"the taps of {back} MHz run the other way", modulation_hz, other
    for words, sign, shift in _other_starts(taps):
        yield words, modulation_hz, [(sign * t + np.float32(shift)) % 1 for t in turns]


def _other_starts(taps: int) -> Iterator[tuple[str, int, float]]:
    """Orders of evenly spaced taps that start at another one, or run the other way, too: in words, and the sign and the
    shift in turns that make the right phases of the phases that were read."""
    for k, sign in product(range(1, taps), (1, -1)):
        other = "" if sign > 0 else " and run the other way"
        yield f"the taps of each frequency start at {360 * k / taps:.4g} degrees{other}", sign, k / taps


def direction_contradiction(length_m: np.ndarray, modulation: np.ndarray, period_m: float, taps: int = 1) -> str | None:
    """A sentence if light would fall with the square of the distance with taps in another order, and not as read.

    Parameters
    ----------
    length_m, modulation : (n,) float, path lengths and the light that came along. period_m : path length after which
        all readings repeat. taps : number of taps, any of which may be the first; 1: only their direction may be other.

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
    light, turns = np.log(modulation[inside]), length_m[inside] / period_m
    unexplained, stated = _spread(light), _spread(light + 2 * np.log(turns))
    least = min(stated, unexplained)
    if least > max(MIN_SPREAD, CLEARER * _spread(light + 2 * np.log(1 - turns))):
        return (
            "pixels are brighter where the path is longer, and light falls with the distance if the taps run the other "
            "way, so the ranges may be mirrored: check the order of the frames, and that no surface is beyond "
            f"{period_m / 2:.4g} m."
        )
    tried = [
        (_spread(light + 2 * np.log(np.maximum((sign * turns + shift) % 1, 1e-6))), words)
        for words, sign, shift in _other_starts(taps)
    ]
    spread, words = min(tried, default=(least, ""))
    if least > max(MIN_SPREAD, CLEARER * spread):
        return (
            f"light does not fall with the square of the distance, but it does if {words}, so the ranges may be wrong: "
            "check the order of the frames."
        )
    return None


def _spread(values: np.ndarray) -> float:
    """Half of the distance between the 16th and the 84th percentile."""
    low, high = np.percentile(values, [16, 84])
    return float(high - low) / 2
