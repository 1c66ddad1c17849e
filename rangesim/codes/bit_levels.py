# SPDX-License-Identifier: Apache-2.0
"""Checks of the light of bits: frames that do not add up to white and black, or that do not show bits of the code.

A single pixel may be wrong for many reasons, so the checks look at many pixels at once: a capture that is read wrongly
contradicts itself nearly everywhere. Each check returns one sentence with the likely cause, or None.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rangesim.capture import bright_level
from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.bits import Words, bit_frames
from rangesim.decoding.pixel_samples import MIN_PIXELS, evenly_spread
from rangesim.decoding.status import Status

MAX_UNPAIRED_FRACTION = 0.2
"""Largest fraction of the pixels at which the sum of a pattern and its inverse may differ from white + black. If two
patterns are no pair, it differs at half of the pixels."""

MIN_UNPAIRED = 0.75
"""Least difference between white + black and the sum of a pattern and its inverse that counts, as a fraction of white -
black. Where both are lit or both are dark, the difference is 1; a gamma makes a difference of 0.56 at most."""

MAX_OUTSIDE_FRACTION = 0.2
"""Largest fraction of the pixels at which a frame may be brighter than white or darker than black. If a frame of bits
is taken for one of the two, half of the pixels are."""

MIN_OUTSIDE = 0.5
"""Least distance from the range between black and white that counts, as a fraction of the range of the frames. If a
frame of stripes is taken for white or black, it is 1 where the two differ."""

MIN_RANGE = 0.25
"""Least range of the frames at a pixel that is checked, as a fraction of the range at the bright pixels. Light from
other surfaces makes a smaller range in the shadow."""

MAX_BETWEEN_FRACTION = 0.12
"""Largest fraction of the pixels that may lie between dark and lit in a bit of wide stripes, the median of these bits.
They lie there only at the edges of stripes: 0 to 4 % in real captures. A sinusoid spends 19 % of its period there."""

MAX_MORE_BETWEEN = 0.15
"""Largest fraction of the pixels by which more may lie between dark and lit in a bit than in a finer one, which has
more edges. It is at most 0.04 in real captures; a frame at half the exposure makes it 0.3 to 0.5."""

MIN_RARER_FRACTION = 0.1
"""Least fraction of the pixels at which a bit is dark, and lit, if a coarser one is compared with it. A bit that the
camera does not resolve may be lit everywhere, and between dark and lit nowhere: 0.05 in a real capture."""

MAX_CHANGE_RATE = 1 / 3
"""Largest number of changes of a bit per pixel along the lines at which the camera resolves its stripes: they are three
pixels wide. If they are narrower than a pixel, a pixel may see one side of an edge only, wherever the edge lies."""

MAX_FROM_MIDDLE = 0.15
"""Distance from the middle of dark and lit up to which a pixel lies between the two, as a fraction of their difference.
Noise of a fifth of the difference brings 4 % of the pixels there."""

MIN_UNIFORM_FRACTION = 0.98
"""Least fraction of the pixels at which a bit is dark, or lit, so that its frames count as uniform."""

MIN_SECOND_FRACTION = 0.15
"""Least fraction of the projector at which the coarsest bit has its rarer value, so that a view without that value is
worth a word if neither white nor black was shown. It is 0.2 of 1280 pixels and 0.05 of 1080, which few cameras see."""

MIN_READ_FRACTION = 0.1
"""Least fraction of the pixels that change that must be read, because the others see no more than light from other
surfaces."""

COVERED_FRACTION = 0.95
"""Fraction of the pixels whose words count as seen. Single wrong bits make the rarest words."""

MAX_LINE_PIXELS = 12_000
"""Number of pixels, about, of the lines across the image on which each bit is looked at, and of those down the image.
Fractions of them have a standard error below 0.5 %; a bit with one edge in view has an edge on each of 25 lines or
more of a usual image."""

MIN_GAPS = 20
"""Least number of gaps between edges of a bit whose median number of finer edges is told."""

MIN_MORE_CHANGES = 2.5
"""Least ratio of the changes of two bits that follow each other, from pixel to pixel, at which a bit between them may
be missing. It is 2 in Gray code, and 4 if a bit is lost; noise makes more changes in both."""

EDGES_BETWEEN = 2
"""Number of edges of the next finer bit that lie between two edges of a bit of Gray code. There are twice as many if a
bit between the two is lost, and fewer where the camera does not resolve the finer one."""


def pair_contradiction(seen: AxisFrames, words: Words) -> str | None:
    """A sentence if patterns and inverses do not add up to white + black; None if they do.

    A pair adds up to white + black at any blur and any interreflection, because light adds up. Two frames that are no
    pair do so at half of the pixels only.

    Parameters
    ----------
    seen : frames (k, h, w) of the bits. words : those of the code.
    """
    contrast = seen.contrast
    pairs = [
        (bit.pattern, bit.inverse)
        for bit in bit_frames(seen.names, words.bits)
        if bit.pattern is not None and bit.inverse is not None
    ]
    if not contrast.is_measured or not pairs:
        return None
    white, black, values = contrast.white.ravel(), contrast.black.ravel(), contrast.values.ravel()
    usable = contrast.is_enough & ~seen.capture.saturated(contrast.white[None])
    used = evenly_spread(np.flatnonzero(usable))
    if len(used) < MIN_PIXELS:
        return None
    used = used[values[used] >= np.median(values[used])]
    total = white[used].astype(np.float64) + black[used]
    fractions = []
    for places in pairs:
        pattern, inverse = (seen.frames[i].ravel()[used].astype(np.float64) for i in places)
        fractions.append(float((np.abs(pattern + inverse - total) > MIN_UNPAIRED * values[used]).mean()))
    unpaired = [k for k, fraction in enumerate(fractions) if fraction > MAX_UNPAIRED_FRACTION]
    if not unpaired:
        return None
    worst = max(unpaired, key=fractions.__getitem__)
    pattern_name, inverse_name = (seen.shown_name(seen.names[i]) for i in pairs[worst])
    return (
        f"{len(unpaired)} of {len(fractions)} pairs of pattern and inverse along {seen.axis} contradict white and "
        f"black: frames {pattern_name} and {inverse_name} do not add up to their sum at {100 * fractions[worst]:.0f} % "
        "of the pixels: check the order of the frames, that none is missing or there twice, and that all have one "
        "exposure."
    )


def level_contradiction(seen: AxisFrames, words: Words) -> str | None:
    """A sentence if frames without inverse are brighter than white or darker than black; None if they are not.

    Parameters
    ----------
    seen : frames (k, h, w) of the bits. words : those of the code.
    """
    contrast = seen.contrast
    shown = bit_frames(seen.names, words.bits)
    if all(bit.pattern is not None and bit.inverse is not None for bit in shown):
        return None  # pairs tell more, see `pair_contradiction`
    if not (contrast.has_white or contrast.has_black):
        return None
    brightest, darkest = (f.astype(np.float32).ravel() for f in (seen.frames.max(axis=0), seen.frames.min(axis=0)))
    swing = brightest - darkest
    used = evenly_spread(np.flatnonzero(swing > MIN_RANGE * bright_level(swing)))
    if len(used) < MIN_PIXELS:
        return None
    least = MIN_OUTSIDE * swing[used]
    for has_level, level, excess, words_of_it in (
        (contrast.has_white, "white", brightest[used] - contrast.white.ravel()[used], "brighter than white"),
        (contrast.has_black, "black", contrast.black.ravel()[used] - darkest[used], "darker than black"),
    ):
        outside = float((excess > least).mean())
        if has_level and outside > MAX_OUTSIDE_FRACTION:
            return (
                f"the bits along {seen.axis} contradict {level}: one of them is {words_of_it} at {100 * outside:.0f} % "
                "of the pixels: check the order of the frames, and that all have one exposure."
            )
    return None


class Light(NamedTuple):
    """Light of the bits, most significant first: 0 dark, 1 lit, NaN at pixels that are not read.

    seen : frames of the bits. words : those of the code. coded : (b, cells) int, bits of the cells of the projector.
    across, down : (b, n, m) float32, along lines across the image and down the image.
    lit : (b, n) float32, at those pixels of `across` that are read.
    halves_stripes : whether each finer bit has the edges of Gray code: two between two edges of the next coarser bit.
    """

    seen: AxisFrames
    words: Words
    coded: np.ndarray
    across: np.ndarray
    down: np.ndarray
    lit: np.ndarray
    halves_stripes: bool

    @property
    def between(self) -> np.ndarray:
        """(b,) fraction of the pixels between dark and lit."""
        return np.asarray((np.abs(self.lit - 0.5) < MAX_FROM_MIDDLE).mean(axis=1))

    @property
    def is_resolved(self) -> np.ndarray:
        """(b,) bool, where enough pixels are dark, enough lit, and stripes wide enough for the camera to see them."""
        has_both = np.abs((self.lit > 0.5).mean(axis=1) - 0.5) <= 0.5 - MIN_RARER_FRACTION
        rates = [_changes(x) / max(1, np.count_nonzero(np.isfinite(x[0]))) for x in (self.across, self.down)]
        return np.asarray(has_both & (np.maximum(*rates) <= MAX_CHANGE_RATE))


def light_of_bits(seen: AxisFrames, code: AxisCode, words: Words) -> Light | None:
    """Light of the bits at some lines of the image; None if only few of the pixels that change are read.

    Parameters
    ----------
    seen : frames (k, h, w) of the bits. code : what they decode to. words : those of the code.
    """
    swing = seen.contrast.values
    changes = seen.contrast.is_enough & (swing > MIN_RANGE * bright_level(swing))
    is_read = changes & (code.status != Status.LOW_SIGNAL) & (code.status != Status.SATURATED)
    n_read = np.count_nonzero(is_read)
    if n_read < max(MIN_PIXELS, MIN_READ_FRACTION * np.count_nonzero(changes)):
        return None
    coded = (words.of_cell[: math.ceil(seen.size / code.cell_px)] >> np.arange(words.bits)[::-1, None]) & 1
    across, down = (_along_lines(seen, is_read, words, is_down) for is_down in (False, True))
    expected = _edges_between(coded[:, None].astype(np.float32))
    halves_stripes = not (expected[np.isfinite(expected)] != EDGES_BETWEEN).any()
    return Light(seen, words, coded, across, down, across[:, np.isfinite(across[0])], halves_stripes)


def _along_lines(seen: AxisFrames, is_read: np.ndarray, words: Words, is_down: bool) -> np.ndarray:
    """(b, n, m) float32, light of the bits along lines of the image, across or down; NaN where not `is_read` (h, w)."""
    step = 1 + seen.contrast.values.size // MAX_LINE_PIXELS

    def lines(image: np.ndarray) -> np.ndarray:
        return (image.T if is_down else image)[::step].astype(np.float32)

    white, black, swing = lines(seen.contrast.white), lines(seen.contrast.black), lines(seen.contrast.values)
    swing[lines(is_read) == 0] = np.nan
    result = []
    for bit in bit_frames(seen.names, words.bits):
        pattern, inverse = (None if i is None else lines(seen.frames[i]) for i in (bit.pattern, bit.inverse))
        bright = white + black - inverse if pattern is None else pattern
        dark = white + black - bright if inverse is None else inverse
        result.append(0.5 + 0.5 * (bright - dark) / swing)
    return np.stack(result)


def between_contradiction(light: Light) -> str | None:
    """A sentence if bits of wide stripes lie between dark and lit at many pixels, as fringes do; None if not.

    A bit is dark or lit, and between the two only at its edges. Stripes are wide if they have the square root of all
    cells: half of the bits of Gray code, and no bit of a code whose stripes are all narrow.

    Parameters
    ----------
    light : what `light_of_bits` returns.
    """
    n_cells = light.coded.shape[1]
    mean_stripe = n_cells / (1 + np.count_nonzero(np.diff(light.coded), axis=1))
    is_wide = mean_stripe >= n_cells**0.5
    if not is_wide.any():
        return None
    between = float(np.median(light.between[is_wide]))
    if between <= MAX_BETWEEN_FRACTION:
        return None
    return (
        f"the frames along {light.seen.axis} show no bits: even where stripes are wide, {100 * between:.0f} % of the "
        "pixels lie between dark and lit: check --code, because fringes seem to have been shown."
    )


def uneven_contradiction(light: Light) -> str | None:
    """A sentence if a bit lies between dark and lit at more pixels than a finer one; None if none does.

    Pixels lie there at the edges of stripes, and a finer bit of Gray code has more edges, at any blur. A frame with
    another exposure, or that alone is blurred, lies there at many pixels.

    Parameters
    ----------
    light : what `light_of_bits` returns.
    """
    if not light.halves_stripes:
        return None
    between = light.between
    finer = np.where(light.is_resolved, between, np.inf)
    least = np.append(np.minimum.accumulate(finer[::-1])[::-1][1:], np.inf)  # of all bits that are finer
    excess = between - least
    worst = int(np.argmax(excess))
    if excess[worst] <= MAX_MORE_BETWEEN:
        return None
    name = light.seen.shown_name(bit_frames(light.seen.names, light.words.bits)[worst].frame_name)
    return (
        f"frame {name} lies between dark and lit at {100 * between[worst]:.0f} % of the pixels, and a frame of finer "
        f"stripes at {100 * least[worst]:.0f} %: check that all frames have one exposure and one focus, and that none "
        "shows another scene."
    )


def uniform_contradiction(light: Light) -> str | None:
    """A sentence if a bit is dark or lit at all pixels, and white or black may stand in its place; None if not.

    A bit takes both values in a view of more cells than its widest stripe has. In Gray code, the widest stripe of the
    coarsest bit is half of the projector. If the camera sees no more than that, the frame counts as white or black if
    there is no such frame beside it. A pair beside white and black is a bit, perhaps another one.

    Parameters
    ----------
    light : what `light_of_bits` returns.
    """
    seen, words, coded, lit = light.seen, light.words, light.coded, light.lit
    is_shown = {"white": seen.contrast.has_white, "black": seen.contrast.has_black}
    for i, (bit, values) in enumerate(zip(bit_frames(seen.names, words.bits), lit, strict=True)):
        is_dark, is_lit = (
            float((sign * (values - 0.5) > MAX_FROM_MIDDLE).mean()) >= MIN_UNIFORM_FRACTION for sign in (-1, 1)
        )
        if not (is_dark or is_lit):
            continue
        looks = {"": "black" if is_dark else "white", "_inverse": "white" if is_dark else "black"}
        shown = {
            seen.shown_name(f"{bit.name}{end}"): looks[end]
            for end, at in (("", bit.pattern), ("_inverse", bit.inverse))
            if at is not None
        }
        is_in_view = _n_covering(lit > 0.5) <= _widest_stripe(coded[i])
        least = 1 - MIN_UNIFORM_FRACTION if any(is_shown.values()) else MIN_SECOND_FRACTION
        is_level = i == 0 and min(coded[i].mean(), 1 - coded[i].mean()) > least
        has_level = any(is_shown[level] for level in shown.values())
        if (has_level and len(shown) == 2) or (is_in_view and (has_level or not is_level)):
            continue
        what = " and ".join(f"frame {name} is {level}" for name, level in shown.items())
        unless = ", unless the camera sees one side of the projector" if is_in_view else ""
        lost = lost_contradiction(light)
        return (
            f"{what} wherever the projector shines, as no bit along {seen.axis} is{unless}: {words.noun} seems to have "
            "a bit less than stated: check the size of the projector and of its cells (--set cell_px), and that no "
            f"image is missing{f': {lost}' if lost else '.'}"
        )
    return None


def _n_covering(bits: np.ndarray) -> int:
    """Number of the most frequent words that `COVERED_FRACTION` of the pixels have; bits (b, n) bool."""
    word = np.zeros(bits.shape[1], dtype=np.int32)
    for bit in bits:
        word = (word << 1) | bit
    counts = np.sort(np.unique(word, return_counts=True)[1])[::-1]
    return int(np.searchsorted(np.cumsum(counts), COVERED_FRACTION * len(word))) + 1


def _widest_stripe(bit: np.ndarray) -> int:
    """Largest number of cells in a row that have the same value of a bit (n,)."""
    edges = np.flatnonzero(np.diff(bit))
    return int(np.diff(edges, prepend=-1, append=len(bit) - 1).max())


def lost_contradiction(light: Light) -> str | None:
    """A sentence if four edges of a bit lie between two of the next coarser one in Gray code, where two should lie.

    Parameters
    ----------
    light : what `light_of_bits` returns.
    """
    if not light.halves_stripes:
        return None
    along, changes = max(((x, _changes(x)) for x in (light.across, light.down)), key=lambda pair: int(pair[1].sum()))
    is_known = changes[:-1] >= MIN_GAPS
    if not (changes[1:] > MIN_MORE_CHANGES * changes[:-1])[is_known].any():
        return None
    found = _edges_between(along)
    other = np.flatnonzero(found > EDGES_BETWEEN)
    if len(other) != 1 or found[other[0]] != 2 * EDGES_BETWEEN:
        return None
    at = int(other[0])
    if (found[:at] < EDGES_BETWEEN).any() or (found[at + 1 : at + 2] <= 1).any():
        return None  # frames in another order change several numbers
    bits = bit_frames(light.seen.names, light.words.bits)
    coarse, fine = (light.seen.shown_name(bit.name) for bit in bits[at : at + 2])
    return (
        f"{found[at]:.0f} edges of frame {fine} lie between two edges of frame {coarse}, and {EDGES_BETWEEN} in "
        f"{light.words.noun}: the image of a bit between the two seems to be missing."
    )


def _changes(light: np.ndarray) -> np.ndarray:
    """(b,) int, how often each bit changes from pixel to pixel along the lines (b, n, m)."""
    bits = light > 0.5
    return np.count_nonzero(bits[..., 1:] != bits[..., :-1], axis=(1, 2))


def _edges_between(light: np.ndarray) -> np.ndarray:
    """(b - 1,) median number of edges of each finer bit between two edges of a bit, NaN if unknown.

    Parameters
    ----------
    light : (b, n, m), light of the bits along n lines, most significant first.
    """
    places = np.where(np.abs(light - 0.5) > MAX_FROM_MIDDLE, np.arange(light.shape[2]), 0)
    last_clear = np.maximum.accumulate(places, axis=2)
    bits = np.take_along_axis(light > 0.5, last_clear, axis=2)
    is_edge = bits[..., 1:] != bits[..., :-1]
    n_before = np.cumsum(is_edge, axis=2, dtype=np.int32)
    medians = []
    for edges, finer in pairwise(range(len(light))):
        line, at = np.nonzero(is_edge[edges])
        between = np.diff(n_before[finer][line, at])[np.diff(line) == 0]
        medians.append(float(np.median(between)) if between.size >= (MIN_GAPS if len(light[0]) > 1 else 1) else np.nan)
    return np.array(medians)
