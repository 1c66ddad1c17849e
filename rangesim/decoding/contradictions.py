# SPDX-License-Identifier: Apache-2.0
"""Frames that contradict their code: what the redundancy of a whole capture tells, each as one sentence.

A pixel alone may be wrong for many reasons. These checks look at many at once: a capture that is read as what it is
not (another start or direction of the fringes, another order of frames) contradicts itself nearly everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.gray import Contrast, GrayCode, binary_of_gray
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.status import Status

MIN_PIXELS = 200
"""Least number of pixels that tell anything."""
MAX_PIXELS = 200_000
"""Pixels that are looked at, evenly spread over the image; more say no more."""
MAX_FAR_FRACTION = 0.2
"""Fraction of pixels whose phase may lie more than an eighth of a period outside their Gray cell; a quarter do by
chance."""
MIN_ONE_SIDED_FRACTION = 0.02
"""Fraction of pixels outside their Gray cell, on one side more than on the other, from which on fringes are shifted."""
MIN_OFFSET_PX = 0.25
"""Projector pixels by which fringes must be shifted to be told."""
MAX_LEVEL_ERROR = 0.03
"""Fraction of white - black by which the mean of the fringes may miss the middle between black and white."""
PHASE_BINS = 8
"""Number of parts into which a period is divided, to see at which phases the mean of the fringes is off."""
MAX_PAIRS = 50_000
"""Pairs of neighbouring pixels, across and down each, that are looked at in every other order of the frames."""
MIN_STEPS = 100
"""Pairs of neighbouring pixels in different cells; fewer do not tell plain binary from Gray code."""
MAX_FARTHER = 0.3
"""Powers of two by which neighbours may lie farther apart if read as Gray code; about 1 is expected of plain binary."""
MAX_UNPAIRED_FRACTION = 0.2
"""Fraction of pixels at which a pattern and its inverse may miss white + black; half do of two patterns that are
no pair."""
MIN_UNPAIRED = 0.75
"""Fraction of white - black from which on they miss it: 1 where both are lit or both are dark, to 0.56 by a gamma."""
MAX_NEARER_FRACTION = 0.8
"""Fraction of neighbours that another order of the frames may bring nearer to each other, of those that it brings to
half or twice the distance; all, if that order is the right one."""
MIN_REPEATED_FRACTION = 0.9
"""Fraction of the changes of one bit, from pixel to pixel, that another bit has too, from which on it is the same
frame; none in Gray code, seen sharply."""
MIN_ALONE_FRACTION = 0.3
"""Fraction of these changes at which no third bit changes; at a step of the scene other bits change, too."""
MIN_SWING = 0.35
"""Fraction of white - black that fringes reach where they are wider than a few pixels of the camera, also out of focus;
1 in focus."""
MAX_BEHIND_FRACTION = 0.2
"""Fraction of pixels whose rays may meet clearly behind a device; a few do by interreflection."""
MIN_BEHIND_PX = 10.0
"""Projector pixels from parallel, from which on rays meet clearly behind; less may be noise on what is far away."""
MIN_CELLS = 8
"""Gray cells that must be in view to say that a frame is black or white everywhere."""


def fringe_contradiction(
    gray: GrayCode, refined: GrayCode, frames: np.ndarray, contrast: np.ndarray, period_px: float, axis: str
) -> str | None:
    """A sentence if the fringes contradict the Gray code as a whole, None if they agree.

    The phase's place minus the centre of its Gray cell must be centred, and within half a cell.

    Parameters
    ----------
    gray, refined : the code before and after the phase. frames : (N, h, w) the fringes of `axis`.
    contrast : (h, w) white - black. period_px : float, projector pixels.
    """
    used = _comparable(gray, refined)
    if len(used) < MIN_PIXELS:
        return None
    phase = phase_of(frames.reshape(len(frames), -1)[:, used])
    off = _wrapped(phase.normalised - gray.coordinate.ravel()[used] / np.float32(period_px))
    half = gray.cell_px / (2 * period_px)
    far = float((np.abs(off) > half + 0.125).mean())
    above, below = float((off > half + 0.005).mean()), float((off < -half - 0.005).mean())
    mean, resultant = _circular_mean(off)
    offset_px = mean * period_px
    one_sided = max(above, below) > MIN_ONE_SIDED_FRACTION + 3 * min(above, below) and abs(offset_px) > MIN_OFFSET_PX
    if far <= MAX_FAR_FRACTION and not one_sided:
        return None
    outside = 100 * float((np.abs(off) > half + 0.005).mean())
    text = f"the fringes along {axis} contradict the Gray code at {outside:.0f} % of the pixels"
    swing = float(np.median(2 * phase.modulation / contrast.ravel()[used]))
    if swing < MIN_SWING:
        return (
            f"{text} and reach {100 * swing:.0f} % of white - black: a period of {period_px:g} projector pixels is too "
            "fine for the camera, or out of focus; take a longer one."
        )
    if far > MAX_FAR_FRACTION and _direction(gray, refined, frames) < 0:
        return f"{text}: they seem to be shifted in the other direction, so check the order of their frames."
    if resultant > 0.8 * np.sinc(2 * half):
        return (
            f"{text}: they seem to start {abs(offset_px):.1f} projector pixels too {'early' if mean > 0 else 'late'}, "
            "so check where their cosine starts (half a pixel: at the first pixel's centre, not its edge), "
            "and whether something moved between the frames."
        )
    return f"{text}, as if by chance: check the period, the steps, the order of the frames and the code."


def level_contradiction(
    capture: Capture, gray: GrayCode, refined: GrayCode, run: slice, names: list[str], axis: str
) -> str | None:
    """A sentence if the fringes contradict white and black as a whole, None if they agree.

    Where light adds up, also that of interreflection, the mean of the fringes is the middle between white and black
    at every phase. A frame that is missing or there twice moves it at some phases, a gamma at all.

    Parameters
    ----------
    gray, refined : the code before and after the phase. run : where the fringes of `axis` stand among the frames.
    names : of all frames.
    """
    white, black = capture.frames[-2], capture.frames[-1]
    used = _spread(np.flatnonzero(_inside_cell(gray, refined) & ~capture.saturated(white[None])))
    if len(used) < MIN_PIXELS:
        return None
    dark = black.ravel()[used].astype(np.float64)
    values = (capture.frames[run].reshape(run.stop - run.start, -1)[:, used] - dark) / (white.ravel()[used] - dark)
    phase = phase_of(values)
    bins = np.minimum((phase.normalised * PHASE_BINS).astype(int), PHASE_BINS - 1)
    members = [m for m in (np.flatnonzero(bins == b) for b in range(PHASE_BINS)) if len(m) >= MIN_PIXELS / 10]
    if not members:
        return None
    off, noise = _medians(values.mean(axis=0) - 0.5, members)
    if np.sqrt((off**2).mean()) < MAX_LEVEL_ERROR + 3 * np.sqrt((noise**2).mean()):
        return None
    if len(np.unique(gray.coordinate.ravel()[used])) >= MIN_CELLS and (
        fault := _odd_frame(values, members, names[run])
    ):
        return f"the fringes along {axis} contradict white and black: {fault}."
    mean = 100 * float(np.median(values.mean(axis=0)))
    return (
        f"the fringes along {axis} contradict white and black: their mean lies at {mean:.0f} % of the way from black "
        "to white, expected 50 % at every phase: check that projector and camera are linear (no gamma, automatic "
        "exposure, no clipping) and that no frame is missing or there twice."
    )


def _odd_frame(values: np.ndarray, members: list[np.ndarray], names: list[str]) -> str | None:
    """A clause on one wrong frame of fringes (N, n), fractions from black to white; None if nothing stands out."""
    for name, low, high in zip(names, *np.percentile(values, [5, 95], axis=1), strict=True):
        if high < 0.1 or low > 0.9:
            return f"frame {name} is {'black' if high < 0.1 else 'white'} everywhere"
    swing, steps = np.sqrt(2) * float(np.median(phase_of(values).modulation)), len(values)
    for i in range(steps):
        for j in range(i):
            difference, _ = _medians(values[i] - values[j], members)
            if np.sqrt((difference**2).mean()) < 0.25 * swing * np.sin(np.pi * (i - j) / steps):
                return f"frame {names[i]} repeats {names[j]}"
    return None


def _medians(values: np.ndarray, members: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Medians of groups of values (n,), and how far off noise may put each: its standard error."""
    medians = np.array([np.median(values[m]) for m in members])
    spread = [np.median(np.abs(values[m] - x)) for m, x in zip(members, medians, strict=True)]
    return medians, 1.253 * 1.483 * np.array(spread) / np.sqrt([len(m) for m in members])


def binary_contradiction(gray: GrayCode, names: list[str], axis: str) -> str | None:
    """A sentence if the patterns look like plain binary numbers, None if they look like Gray code.

    Neighbouring pixels see neighbouring cells. Numbers in plain binary, read as Gray code, lie farther apart. Those of
    Gray code in another order of the frames may, too, but lie nearest if read in that order: None for them.

    Parameters
    ----------
    names : (2 b,) of the patterns and inverses, most significant bit first.
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
    if len(as_gray) < MIN_STEPS or as_gray.mean() < as_binary.mean() + MAX_FARTHER:
        return None
    few = words[:, :: 1 + words.shape[1] // MAX_PAIRS]
    orders = [np.log2(_apart(reorder(few), 0)).mean() for _, reorder in _other_orders(names[-2::-2])]
    if min(orders) < np.log2(np.abs(few[1] - few[0])).mean():
        return None
    return (
        f"the bits along {axis} contradict Gray code: read as plain binary numbers neighbouring pixels lie "
        f"{2 ** as_binary.mean():.1f} cells apart, as Gray code {2 ** as_gray.mean():.1f}: check which code was shown."
    )


def pair_contradiction(capture: Capture, contrast: Contrast, run: slice, names: list[str], axis: str) -> str | None:
    """A sentence if patterns and inverses do not add up to white + black, None if they do.

    They do at any blur and any interreflection, for light adds up. Two frames that are no pair do at half of the
    pixels.

    Parameters
    ----------
    run : where the Gray patterns of `axis` stand among the frames. names : of all frames.
    """
    white, black = capture.frames[-2].ravel(), capture.frames[-1].ravel()
    values = contrast.values.ravel()
    usable = contrast.is_enough & ~capture.saturated(capture.frames[-2:-1])
    used = _spread(np.flatnonzero(usable))
    if len(used) < MIN_PIXELS:
        return None
    used = used[values[used] >= np.median(values[used])]
    total = white[used].astype(np.float64) + black[used]
    fractions = []
    for k in range(run.start, run.stop, 2):
        pattern, inverse = (capture.frames[i].ravel()[used].astype(np.float64) for i in (k, k + 1))
        fractions.append(float((np.abs(pattern + inverse - total) > MIN_UNPAIRED * values[used]).mean()))
    unpaired = [k for k, fraction in enumerate(fractions) if fraction > MAX_UNPAIRED_FRACTION]
    if not unpaired:
        return None
    worst = max(unpaired, key=fractions.__getitem__)
    first = run.start + 2 * worst
    return (
        f"{len(unpaired)} of {len(fractions)} pairs of pattern and inverse along {axis} contradict white and black: "
        f"frames {names[first]} and {names[first + 1]} do not add up to them at {100 * fractions[worst]:.0f} % of the "
        "pixels: check the order of the frames, that none is missing or there twice, and that all have one exposure."
    )


def order_contradiction(gray: GrayCode, names: list[str], axis: str) -> str | None:
    """A sentence if the bits of the Gray code seem to be in another order, inverted or repeated, None if not.

    Neighbouring pixels see neighbouring cells. Other orders are tried; where one brings nearly all neighbours that it
    moves nearer to each other, the frames were in that order.

    Parameters
    ----------
    names : (2 b,) of the patterns and inverses, most significant bit first.
    """
    number = np.floor(gray.coordinate / gray.cell_px).astype(np.int64)
    usable = ((gray.coordinate / gray.cell_px) % 1 == 0.5) & (gray.status != Status.LOW_SIGNAL)
    usable &= gray.status != Status.SATURATED
    word = number ^ (number >> 1)  # the bits as shown
    pairs = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = usable[here] & usable[there]
        pairs.append(np.stack([word[here][both], word[there][both]]))
    bits = names[-2::-2]  # least significant first
    few = [words[:, :: 1 + words.shape[1] // MAX_PAIRS] for words in pairs]
    across = max(few, key=lambda words: np.count_nonzero(words[0] != words[1]))
    step = _coarse_step(across, len(bits))
    # of all pairs: the coarsest bits change at a line or two of the image
    text = None if step is None else _repeated_bit(_that_differ(pairs) >> step, bits[step:])
    text = text or _better_order(across, _that_differ(few), bits)
    if text is None:
        return None
    return f"the bits along {axis} contradict Gray code, where neighbouring pixels see neighbouring cells: {text}."


def _that_differ(pairs: list[np.ndarray]) -> np.ndarray:
    """(2, m) words of all pairs (2, n) whose two words differ."""
    words = np.concatenate(pairs, axis=1)
    return np.asarray(words[:, words[0] != words[1]])


def _better_order(across: np.ndarray, words: np.ndarray, bits: list[str]) -> str | None:
    """The fault of the frames whose removal brings neighbours nearest together, None if none brings them nearer.

    Parameters
    ----------
    across : (2, n) Gray words of neighbours in the direction in which the code changes more. words : (2, m) of those
        in both directions that differ. bits : (b,) names of the patterns, least significant first.
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
    """Finest bits to leave out, so that half of the neighbours with Gray words (2, n) see one cell.

    What is finer than the camera's pixels does not tell neighbours. None if less than three bits are left.
    """
    first, second = binary_of_gray(words)
    for step in range(n_bits - 2):
        if np.count_nonzero(first >> step == second >> step) >= 0.5 * len(first):
            return step
    return None


def _apart(words: np.ndarray, step: int) -> np.ndarray:
    """(n,) int, cells of 2^step of the finest between the neighbours of Gray words (2, n)."""
    first, second = binary_of_gray(words)
    return np.asarray(np.abs((second >> step) - (first >> step)))


def _other_orders(bits: list[str]) -> Iterator[tuple[str, Callable[[np.ndarray], np.ndarray]]]:
    """Faults that the order of the frames may have, and how Gray words are without each.

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
    """Words with their bits in the other order."""
    result = np.zeros_like(words)
    for k in range(n_bits):
        result |= ((words >> k) & 1) << (n_bits - 1 - k)
    return result


def _exchanged(i: int, j: int, words: np.ndarray) -> np.ndarray:
    """Words with bits i and j exchanged."""
    differ = ((words >> i) ^ (words >> j)) & 1
    return np.asarray(words ^ (differ << i) ^ (differ << j))


def _repeated_bit(words: np.ndarray, bits: list[str]) -> str | None:
    """A clause that names two bits which always change together; None if no two do."""
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


def behind_contradiction(behind_px: np.ndarray) -> str | None:
    """A sentence if many rays meet behind camera or projector, None if not.

    Parameters
    ----------
    behind_px : (n,) float, as `ProjectorTriangulation` has it.
    """
    fraction = float((behind_px > MIN_BEHIND_PX).mean()) if len(behind_px) >= MIN_PIXELS else 0.0
    if fraction <= MAX_BEHIND_FRACTION:
        return None
    return (
        f"{100 * fraction:.0f} % of the decoded rays meet behind camera or projector, where nothing is, so the depth "
        "of the others is doubtful: check that no image is mirrored, that T_camera_projector is not its inverse, and "
        "that the axes and their order are those shown."
    )


def _comparable(gray: GrayCode, refined: GrayCode) -> np.ndarray:
    """(n,) int, flat indices of pixels inside a Gray cell whose fringes are strong enough to tell."""
    return _spread(np.flatnonzero(_inside_cell(gray, refined)))


def _inside_cell(gray: GrayCode, refined: GrayCode) -> np.ndarray:
    """(h, w) bool, pixels with a Gray cell, not an edge, whose phase was neither weak nor saturated."""
    inside = (gray.coordinate / gray.cell_px) % 1 == 0.5
    told = (refined.status == Status.OK) | (refined.status == Status.CODE_ERROR)
    return np.asarray(inside & told & (gray.status == Status.OK))


def _spread(indices: np.ndarray) -> np.ndarray:
    return indices[:: 1 + len(indices) // MAX_PIXELS]


def _direction(gray: GrayCode, refined: GrayCode, frames: np.ndarray) -> float:
    """-1 to 1: whether the phase grows with the Gray code from pixel to pixel; 0 if no neighbours tell."""
    usable, cell = _inside_cell(gray, refined), gray.coordinate / gray.cell_px
    agreement, pairs = 0.0, 0
    for here, there in (
        (np.s_[..., :, :-1], np.s_[..., :, 1:]),
        (np.s_[..., :-1, :], np.s_[..., 1:, :]),
    ):
        crossed = usable[here] & usable[there] & (np.abs(cell[there] - cell[here]) == 1)
        y, x = np.nonzero(crossed)
        turn = _wrapped(
            phase_of(frames[there][:, y, x]).normalised - phase_of(frames[here][:, y, x]).normalised,
        )
        agreement += float((np.sign(turn) * (cell[there][y, x] - cell[here][y, x])).sum())
        pairs += len(y)
    return agreement / max(pairs, 1)


def _wrapped(turns: np.ndarray) -> np.ndarray:
    """Turns, less whole ones, in [-0.5, 0.5]."""
    return np.asarray(turns - np.rint(turns))


def _circular_mean(turns: np.ndarray) -> tuple[float, float]:
    """Mean direction in turns, and the length of the mean vector, 0 to 1."""
    mean = np.exp(2j * np.pi * turns.astype(np.float64)).mean()
    return float(np.angle(mean) / (2 * np.pi)), float(np.abs(mean))
