# SPDX-License-Identifier: Apache-2.0
"""Frames that contradict their code: what the redundancy of a whole capture tells, each as one sentence.

A pixel alone may be wrong for many reasons. These checks look at many at once: a capture that is read as what it is
not (another start or direction of the fringes, another order of frames) contradicts itself nearly everywhere.
"""

from __future__ import annotations

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.gray import GrayCode
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.status import Status

MIN_PIXELS = 200
"""Pixels; fewer say nothing."""
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
"""Into which a period is divided, to see at which phases the mean of the fringes is off."""
MIN_STEPS = 100
"""Pairs of neighbouring pixels in different cells; fewer do not tell plain binary from Gray code."""
MAX_FARTHER = 0.3
"""Powers of two by which neighbours may lie farther apart if read as Gray code; about 1 is expected of plain binary."""
MAX_BEHIND_FRACTION = 0.2
"""Fraction of pixels whose rays may meet clearly behind a device; a few do by interreflection."""
MIN_BEHIND_PX = 10.0
"""Projector pixels from parallel, from which on rays meet clearly behind; less may be noise on what is far away."""
MIN_CELLS = 8
"""Gray cells that must be in view to say that a frame is black or white everywhere."""


def fringe_contradiction(
    gray: GrayCode, refined: GrayCode, frames: np.ndarray, period_px: float, axis: str
) -> str | None:
    """A sentence if the fringes contradict the Gray code as a whole, None if they agree.

    The phase's place minus the centre of its Gray cell must be centred, and within half a cell.

    Parameters
    ----------
    gray, refined : the code before and after the phase. frames : (N, h, w) the fringes of `axis`.
    period_px : float, projector pixels.
    """
    used = _comparable(gray, refined)
    if len(used) < MIN_PIXELS:
        return None
    phase = phase_of(frames.reshape(len(frames), -1)[:, used]).normalised
    off = _wrapped(phase - gray.coordinate.ravel()[used] / np.float32(period_px))
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
    """What is wrong with one frame of fringes (N, n), as fractions from black to white; None if nothing stands out."""
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


def binary_contradiction(gray: GrayCode, axis: str) -> str | None:
    """A sentence if the patterns look like plain binary numbers, None if they look like Gray code.

    Neighbouring pixels see neighbouring cells. Numbers in plain binary, read as Gray code, lie farther apart.
    """
    cell = gray.coordinate / gray.cell_px
    usable = (cell % 1 == 0.5) & (gray.status == Status.OK)
    number = np.where(usable, cell, 0).astype(np.int64)
    plain = number ^ (number >> 1)  # the bits as shown
    apart = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = usable[here] & usable[there] & (number[here] != number[there])
        apart.append([np.abs(n[there][both] - n[here][both]) for n in (number, plain)])
    as_gray, as_binary = (np.log2(np.concatenate(steps)) for steps in zip(*apart, strict=True))
    if len(as_gray) < MIN_STEPS or as_gray.mean() < as_binary.mean() + MAX_FARTHER:
        return None
    return (
        f"the bits along {axis} contradict Gray code: read as plain binary numbers neighbouring pixels lie "
        f"{2 ** as_binary.mean():.1f} cells apart, as Gray code {2 ** as_gray.mean():.1f}: check which code was shown."
    )


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
