# SPDX-License-Identifier: Apache-2.0
"""Frames that contradict their code: what the redundancy of a whole capture tells, each as one sentence.

A pixel alone may be wrong for many reasons. These checks look at many at once: a capture that is read as what it is
not (another start or direction of the fringes, another order of frames) contradicts itself nearly everywhere.
"""

from __future__ import annotations

import numpy as np

from rangesim.decoding.gray import GrayCode
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.status import Status

LEAST_PIXELS = 200
"""Fewer say nothing."""
MOST_PIXELS = 200_000
"""More say no more; evenly spread over the image."""
MOST_FAR = 0.2
"""Share of pixels whose phase lies more than an eighth of a period outside their Gray cell; a quarter if by chance."""
LEAST_ONE_SIDED = 0.02
LEAST_OFFSET_PX = 0.25


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
    if len(used) < LEAST_PIXELS:
        return None
    phase = phase_of(frames.reshape(len(frames), -1)[:, used]).normalised
    off = _wrapped(phase - gray.coordinate.ravel()[used] / np.float32(period_px))
    half = gray.cell_px / (2 * period_px)
    far = float((np.abs(off) > half + 0.125).mean())
    above, below = float((off > half + 0.005).mean()), float((off < -half - 0.005).mean())
    mean, resultant = _circular_mean(off)
    offset_px = mean * period_px
    one_sided = max(above, below) > LEAST_ONE_SIDED + 3 * min(above, below) and abs(offset_px) > LEAST_OFFSET_PX
    if far <= MOST_FAR and not one_sided:
        return None
    outside = 100 * float((np.abs(off) > half + 0.005).mean())
    text = f"the fringes along {axis} contradict the Gray code at {outside:.0f} % of the pixels"
    if far > MOST_FAR and _direction(gray, refined, frames) < 0:
        return f"{text}: they seem to be shifted in the other direction, so check the order of their frames."
    if resultant > 0.8 * np.sinc(2 * half):
        return (
            f"{text}: they seem to start {abs(offset_px):.1f} projector pixels too {'early' if mean > 0 else 'late'}, "
            "so check where their cosine starts (half a pixel: at the first pixel's centre, not its edge)."
        )
    return f"{text}, as if by chance: check the period, the steps, the order of the frames and the code."


def _comparable(gray: GrayCode, refined: GrayCode) -> np.ndarray:
    """(n,) int, flat indices of pixels inside a Gray cell whose fringes are strong enough to tell."""
    return _spread(np.flatnonzero(_inside_cell(gray, refined)))


def _inside_cell(gray: GrayCode, refined: GrayCode) -> np.ndarray:
    """(h, w) bool, pixels with a Gray cell, not an edge, whose phase was neither weak nor saturated."""
    inside = (gray.coordinate / gray.cell_px) % 1 == 0.5
    told = (refined.status == Status.OK) | (refined.status == Status.CODE_ERROR)
    return np.asarray(inside & told & (gray.status == Status.OK))


def _spread(indices: np.ndarray) -> np.ndarray:
    return indices[:: 1 + len(indices) // MOST_PIXELS]


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
