# SPDX-License-Identifier: Apache-2.0
"""Checks of fringes: they contradict the Gray code that they refine, or white and black, where the frames are wrong."""

from __future__ import annotations

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.fringes import FringeConvention
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.pixel_samples import MIN_PIXELS, evenly_spread
from rangesim.decoding.status import Status
from rangesim.robust_scale import sigma_from_median

OUTSIDE_TURNS = 0.005
"""Least distance of a phase from its Gray cell, in turns, at which the phase counts as outside. It allows for rounding:
with a period of 16 pixels it is 0.08 pixels."""

FAR_TURNS = 0.125
"""Least distance of a phase from its Gray cell, in turns, at which the phase counts as far outside: the eighth of a
period that `refine_by_phase` allows."""

MAX_FAR_FRACTION = 0.2
"""Largest fraction of pixels whose phase may lie far outside their Gray cell. It is below a quarter, because a quarter
of the pixels lie there by chance if phase and code have nothing to do with each other. A smaller value would doubt
captures that are merely noisy."""

MIN_ONE_SIDED_FRACTION = 0.02
"""Least fraction of pixels that lie outside their Gray cell on one side, if none do on the other, at which the fringes
count as shifted. Noise puts pixels outside on both sides alike."""

MIN_OFFSET_PX = 0.25
"""Least shift of the fringes that is reported, in projector pixels: a quarter of a pixel. If the cosine starts at the
edge of the first pixel instead of its centre, the shift is half a pixel, twice as much."""

MIN_CONCENTRATION = 0.8
"""Least length of a mean vector, at which all fringes count as shifted by the same amount. Each pixel has a unit vector
whose angle is its phase minus its cell; the length is a fraction of that for an even distribution over a cell. For
unrelated phases it is near 0."""

MAX_LEVEL_ERROR = 0.03
"""Largest distance of the mean of the fringes from the middle between black and white, as a fraction of white - black.
A larger one allows a stronger gamma."""

PHASE_BINS = 8
"""Number of parts into which a period is divided, to see at which phases the mean of the fringes is off. One missing
frame of N shows at some phases only; if there were more parts, each would hold fewer pixels."""

MIN_CELLS = 8
"""Least number of Gray cells in view for the check whether a frame is black or white everywhere, because a correct
frame may look like that if fewer cells are in view. With a larger number, fewer captures would be checked."""

MIN_SWING = 0.35
"""Least swing of fringes that the camera resolves, as a fraction of white - black. In focus the swing is 1. Out of
focus it is still above this value if the period is wider than a few pixels of the camera."""

MEDIAN_ERROR = 1.253
"""Ratio of the standard error of a median to that of a mean, for normally distributed values: sqrt(pi / 2)."""


def fringe_contradiction(
    seen: AxisFrames, gray: AxisCode, refined: AxisCode, period_px: float, convention: FringeConvention
) -> str | None:
    """A sentence if the fringes contradict the Gray code as a whole; None if they agree.

    The differences between the place that the phase tells and the centre of its Gray cell must lie around zero, and
    within half a cell.

    Parameters
    ----------
    seen : frames (N, h, w), the fringes of the axis. gray, refined : the code before and after `refine_by_phase`.
    period_px : float, projector pixels. convention : FringeConvention of the fringes.
    """
    frames, axis = seen.frames, seen.axis
    used = _comparable(gray, refined)
    if len(used) < MIN_PIXELS:
        return None
    phase = phase_of(frames.reshape(len(frames), -1)[:, used])
    off = _wrapped(
        convention.place_turns(phase.normalised, period_px) - gray.coordinate.ravel()[used] / np.float32(period_px)
    )
    half = gray.cell_px / (2 * period_px)
    far = float((np.abs(off) > half + FAR_TURNS).mean())
    edge = half + OUTSIDE_TURNS
    above, below = float((off > edge).mean()), float((off < -edge).mean())
    mean, resultant = _circular_mean(off)
    offset_px = mean * period_px
    one_sided = max(above, below) > MIN_ONE_SIDED_FRACTION + 3 * min(above, below) and abs(offset_px) > MIN_OFFSET_PX
    if far <= MAX_FAR_FRACTION and not one_sided:
        return None
    outside = 100 * float((np.abs(off) > edge).mean())
    text = f"the fringes along {axis} contradict the Gray code at {outside:.0f} % of the pixels"
    swing = float(np.median(2 * phase.modulation / seen.contrast.values.ravel()[used]))
    if swing < MIN_SWING:
        return (
            f"{text} and reach {100 * swing:.0f} % of white - black: a period of {period_px:g} projector pixels is too "
            "fine for the camera, or out of focus; take a longer one."
        )
    if far > MAX_FAR_FRACTION and convention.sign * _direction(gray, refined, frames) < 0:
        return f"{text}: they seem to be shifted in the opposite direction, so check the order of their frames."
    if resultant > MIN_CONCENTRATION * np.sinc(2 * half):
        return (
            f"{text}: they seem to start {abs(offset_px):.1f} projector pixels too {'early' if mean > 0 else 'late'}, "
            "so check where their cosine starts (half a pixel: at the first pixel's centre, not its edge), "
            "and whether something moved between the frames."
        )
    return f"{text}, about as many as by chance: check the period, the steps, the order of the frames and the code."


def level_contradiction(seen: AxisFrames, gray: AxisCode, refined: AxisCode) -> str | None:
    """A sentence if the fringes contradict white and black as a whole; None if they agree.

    Light adds up, also the light of interreflection. So the mean of the fringes is the middle between white and black
    at every phase. A frame that is missing or there twice moves this mean at some phases, a gamma at all phases.

    Parameters
    ----------
    seen : frames (N, h, w), the fringes of the axis. gray, refined : the code before and after `refine_by_phase`.
    """
    white, black, axis = seen.contrast.white, seen.contrast.black, seen.axis
    if not seen.contrast.is_measured:
        return None
    used = evenly_spread(np.flatnonzero(_inside_cell(gray, refined) & ~seen.capture.saturated(white[None])))
    if len(used) < MIN_PIXELS:
        return None
    dark = black.ravel()[used].astype(np.float64)
    values = (seen.frames.reshape(len(seen.frames), -1)[:, used] - dark) / (white.ravel()[used] - dark)
    phase = phase_of(values)
    bins = np.minimum((phase.normalised * PHASE_BINS).astype(int), PHASE_BINS - 1)
    members = [m for m in (np.flatnonzero(bins == b) for b in range(PHASE_BINS)) if len(m) >= MIN_PIXELS / 10]
    if not members:
        return None
    off, noise = _medians(values.mean(axis=0) - 0.5, members)
    if np.sqrt((off**2).mean()) < MAX_LEVEL_ERROR + 3 * np.sqrt((noise**2).mean()):
        return None
    if len(np.unique(gray.coordinate.ravel()[used])) >= MIN_CELLS and (
        fault := _odd_frame(values, members, [seen.shown_name(name) for name in seen.names])
    ):
        return f"the fringes along {axis} contradict white and black: {fault}."
    mean = 100 * float(np.median(values.mean(axis=0)))
    return (
        f"the fringes along {axis} contradict white and black: their mean lies at {mean:.0f} % of the way from black "
        "to white, expected 50 % at every phase: check that projector and camera are linear (no gamma, automatic "
        "exposure, no clipping) and that no frame is missing or repeated."
    )


def _odd_frame(values: np.ndarray, members: list[np.ndarray], names: list[str]) -> str | None:
    """A clause on one wrong frame of the fringes; None if nothing stands out.

    Parameters
    ----------
    values : (N, n) float, fringes as fractions of the way from black to white. members : indices of the pixels in each
        part of the period. names : (N,) of the frames.
    """
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
    """Medians of groups of values (n,), and the standard error of each median; `members` are indices of the groups."""
    medians = np.array([np.median(values[m]) for m in members])
    spread = [sigma_from_median(values[m], x) for m, x in zip(members, medians, strict=True)]
    return medians, MEDIAN_ERROR * np.array(spread) / np.sqrt([len(m) for m in members])


def _comparable(gray: AxisCode, refined: AxisCode) -> np.ndarray:
    """(n,) int, flat indices of pixels inside a Gray cell whose fringes are strong enough to be compared with it."""
    return evenly_spread(np.flatnonzero(_inside_cell(gray, refined)))


def _inside_cell(gray: AxisCode, refined: AxisCode) -> np.ndarray:
    """(h, w) bool, pixels with a Gray cell, not an edge, whose phase was neither weak nor saturated."""
    inside = (gray.coordinate / gray.cell_px) % 1 == 0.5
    is_strong = (refined.status == Status.OK) | (refined.status == Status.CODE_ERROR)
    return np.asarray(inside & is_strong & (gray.status == Status.OK))


def _direction(gray: AxisCode, refined: AxisCode, frames: np.ndarray) -> float:
    """Agreement of phase and Gray code from pixel to pixel: 1 if both grow the same way, -1 if the opposite way.

    It is 0 if there are no neighbours in neighbouring cells.
    """
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
    """Angles in turns, without whole turns, in [-0.5, 0.5]."""
    return np.asarray(turns - np.rint(turns))


def _circular_mean(turns: np.ndarray) -> tuple[float, float]:
    """Mean direction of angles in turns, and the length of the mean vector, 0 to 1."""
    mean = np.exp(2j * np.pi * turns.astype(np.float64)).mean()
    return float(np.angle(mean) / (2 * np.pi)), float(np.abs(mean))
