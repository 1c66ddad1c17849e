# SPDX-License-Identifier: Apache-2.0
"""Checks of fringes: they contradict the Gray code that they refine, or white and black, where the frames are wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise, permutations

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.fringe_direction import phase_direction
from rangesim.codes.fringe_gamma import MAX_SAMPLES, FringeGamma
from rangesim.codes.fringe_stack import MIN_AGREEING, FringeStack
from rangesim.codes.fringes import FringeConvention
from rangesim.decoding.phase_shift import Phase, phase_of
from rangesim.decoding.pixel_samples import MAX_PIXELS, MIN_PIXELS, evenly_spread
from rangesim.decoding.status import Status
from rangesim.robust_scale import TO_SIGMA, sigma_from_median

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

MAX_UNEVEN_LEVEL = 0.01
"""Largest root mean square of that distance about its own mean over all phases, at which the mean of the fringes counts
as off by the same at all phases. Blurred fringes of gammas from 0.5 to 3 have at most 0.006 (measured); one of four
fringes that is exposed 1.3 times makes 0.027."""

MAX_MEANS_APART = 0.03
"""Largest median difference of the means of two periods, as a fraction of the modulation, beyond that of gammas. It is
0.000 in a real capture; one of its six frames that is exposed 1.2 times makes 0.08, and a drift of 20 % 0.16."""

PHASE_BINS = 8
"""Number of parts into which a period is divided, to see at which phases the mean of the fringes is off. One missing
frame of N shows at some phases only; if there were more parts, each would hold fewer pixels."""

MIN_CELLS = 8
"""Least number of Gray cells in view for the check whether a frame is black or white everywhere, because a correct
frame may look like that if fewer cells are in view. With a larger number, fewer captures would be checked."""

MIN_SWING = 0.35
"""Least swing of fringes that the camera resolves, as a fraction of white - black. In focus the swing is 1. Out of
focus it is still above this value if the period is wider than a few pixels of the camera."""

MAX_SINUSOID_ERROR = 0.08
"""Largest systematic difference of four or more fringes from a sinusoid, as a fraction of their swing. Two exchanged
neighbours of 16 frames differ by 0.097, of 4 by 0.35; a gamma of 1.2 that is not corrected
differs by 0.043 (measured)."""

MAX_SINUSOID_PIXELS = 5000
"""Largest number of pixels whose fringes are compared with a sinusoid. An eighth of them is in one part of the period:
the standard error of its median is 5 % of the noise, so that noise up to a fifth of the swing hides no fault."""

MIN_BACKWARD = 0.5
"""Least disagreement of phase and Gray code from pixel to pixel at which fringes count as backward although every place
lies in its cell. It is 1 if all run backward, -1 if none does, and 0 if the pixels of the camera are too wide to tell
(`phase_direction`)."""

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
    backwards = convention.sign * phase_direction(frames, gray, _inside_cell(gray, refined), period_px)
    if far <= MAX_FAR_FRACTION and not one_sided:
        if backwards > -MIN_BACKWARD:
            return None
        return (
            f"the fringes along {axis} contradict the Gray code: from one cell to the next, their phase runs the other "
            "way, so every place is mirrored within its cell: check the order and the direction of their frames."
        )
    outside = 100 * float((np.abs(off) > edge).mean())
    text = f"the fringes along {axis} contradict the Gray code at {outside:.0f} % of the pixels"
    swing = float(np.median(2 * phase.modulation / seen.contrast.values.ravel()[used]))
    if swing < MIN_SWING:
        return (
            f"{text} and reach {100 * swing:.0f} % of white - black: a period of {period_px:g} projector pixels is too "
            "fine for the camera, or out of focus; take a longer one."
        )
    if far > MAX_FAR_FRACTION and backwards < 0:
        return f"{text}: they seem to be shifted in the opposite direction, so check the order of their frames."
    if resultant > MIN_CONCENTRATION * np.sinc(2 * half):
        return (
            f"{text}: they seem to start {abs(offset_px):.1f} projector pixels too {'early' if mean > 0 else 'late'}, "
            "so check where their cosine starts (half a pixel: at the first pixel's centre, not its edge), "
            "and whether something moved between the frames."
        )
    return f"{text}, about as many as by chance: check the period, the steps, the order of the frames and the code."


def level_contradiction(seen: AxisFrames, gray: AxisCode, refined: AxisCode, gamma: FringeGamma) -> str | None:
    """A sentence if the fringes contradict white and black as a whole; None if they agree.

    Light adds up, also the light of interreflection. So the mean of the fringes is the middle between white and black
    at every phase, or what a gamma makes of it. A frame that is missing or there twice moves this mean at some phases,
    a gamma at all phases. If fringes of a gamma are blurred, their ripple is that of a smaller gamma, but their mean
    stays. So a mean that is off by the same at all phases is no fault where the ripple tells how to correct it.

    Parameters
    ----------
    seen : frames (N, h, w), the fringes of one period. gray, refined : the code before and after they refine it.
    gamma : what these fringes tell of the response.
    """
    inside = _inside_cell(gray, refined)
    in_many_cells = len(np.unique(gray.coordinate[inside][:: 1 + inside.size // MAX_PIXELS])) >= MIN_CELLS
    return _level_fault(seen, inside, gamma, in_many_cells)


def _level_fault(seen: AxisFrames, usable: np.ndarray, gamma: FringeGamma, in_many_cells: bool) -> str | None:
    """A sentence if the fringes contradict white and black at the pixels `usable` (h, w) bool; None if they do not.

    in_many_cells : whether these pixels lie in many Gray cells or fringes, so that a constant frame shows.
    """
    white, black, axis = seen.contrast.white, seen.contrast.black, seen.axis
    if not seen.contrast.is_measured:
        return None
    used = evenly_spread(np.flatnonzero(usable & ~seen.capture.saturated(white[None])))
    if len(used) < MIN_PIXELS:
        return None
    dark = black.ravel()[used].astype(np.float64)
    values = (seen.frames.reshape(len(seen.frames), -1)[:, used] - dark) / (white.ravel()[used] - dark)
    phase = phase_of(values)
    members = _by_phase(phase.normalised)
    if not members:
        return None
    off, noise = _medians(values.mean(axis=0) - _expected(phase, len(values), gamma.gamma).mean(axis=0), members)
    margin = 3 * float(np.sqrt((noise**2).mean()))
    if np.sqrt((off**2).mean()) < MAX_LEVEL_ERROR + margin or (gamma.is_told and off.std() < MAX_UNEVEN_LEVEL + margin):
        return None
    if in_many_cells and (fault := _odd_frame(values, members, [seen.shown_name(name) for name in seen.names])):
        return f"the fringes along {axis} contradict white and black: {fault}."
    mean = 100 * float(np.median(values.mean(axis=0)))
    return (
        f"the fringes along {axis} contradict white and black: their mean lies at {mean:.0f} % of the way from black "
        "to white, expected 50 % at every phase: check that projector and camera are linear (no gamma, automatic "
        "exposure, no clipping) and that no frame is missing or repeated."
    )


def stack_contradiction(seen: AxisFrames, code: AxisCode, stack: FringeStack) -> str | None:
    """A sentence if the fringes of a stack contradict white and black, a sinusoid, or each other; None if they agree.

    Parameters
    ----------
    seen : frames (n, h, w), those of the stack. code : what `FringeStack.decode` or `refine_by_phase` made of them.
    """
    usable = ((code.status == Status.OK) | (code.status == Status.CODE_ERROR)) & seen.contrast.is_enough
    for i, gamma in enumerate(code.gammas):
        one = stack.frames_of(seen, i)
        if code.coarse is None and (text := _level_fault(one, usable, gamma, True)):
            return text
        if text := _sinusoid_fault(one, usable, gamma):
            return text
    if text := _means_fault(seen, code, stack, usable):
        return text
    return _agreement_fault(seen, code, stack, usable) if code.coarse is None else None


def _means_fault(seen: AxisFrames, code: AxisCode, stack: FringeStack, usable: np.ndarray) -> str | None:
    """A sentence if the fringes of two periods have other means; None if they have the same.

    The mean of equally shifted fringes is (white + black) / 2 for every period, at any blur and interreflection. A
    gamma moves it by its harmonics of the order of the steps, which are summed up as if they had no shift.
    """
    usable = usable & ~seen.capture.saturated(seen.frames).reshape(usable.shape)
    used = evenly_spread(np.flatnonzero(usable), MAX_SAMPLES)
    if len(stack.steps) == 1 or len(used) < MIN_PIXELS:
        return None
    frames = seen.frames.reshape(len(seen.frames), -1)[:, used].astype(np.float64)
    phases = [phase_of(stack.of_period(frames, i)) for i in range(len(stack.steps))]
    harmonics = [_unshifted_harmonic(gamma.gamma, n) for gamma, n in zip(code.gammas, stack.steps, strict=True)]
    for i, j in pairwise(range(len(phases))):
        modulation = np.maximum(np.maximum(phases[i].modulation, phases[j].modulation), 1e-12)
        apart = (phases[i].mean - phases[j].mean) / modulation
        middle = float(np.median(apart))
        error = MEDIAN_ERROR * sigma_from_median(apart, middle) / np.sqrt(len(apart))
        if abs(middle) > MAX_MEANS_APART + harmonics[i] + harmonics[j] + 3 * error:
            one, other = (f"{stack.periods_px[k]:g}" for k in (i, j))
            return (
                f"the fringes along {seen.axis} contradict each other: the means of those of {one} and {other} pixels "
                f"differ by {100 * abs(middle):.0f} % of their modulation, and light adds up to one mean: check that "
                "all frames have one exposure, that other light does not change, and that no frame is missing or of "
                "another scene."
            )
    return None


def _unshifted_harmonic(gamma: float, steps: int) -> float:
    """Amplitude of the harmonic of order `steps` of fringes with a gamma, as a fraction of the first."""
    turns = np.arange(16 * steps) / (16 * steps)
    shown = np.abs(np.fft.rfft((0.5 + 0.5 * np.cos(2 * np.pi * turns)) ** gamma))
    return float(shown[steps] / shown[1])


def _sinusoid_fault(seen: AxisFrames, usable: np.ndarray, gamma: FringeGamma) -> str | None:
    """A sentence if no sinusoid of any gamma explains the fringes of one period; None if one does."""
    if not gamma.is_explained and len(seen.frames) == 3:
        return (
            f"the fringes along {seen.axis} are no sinusoids ({seen.shown_name(seen.names[0])} and next), and tell no "
            "gamma that explains their shape: check that projector and camera are linear and that no frame is repeated."
        )
    used = evenly_spread(np.flatnonzero(usable), MAX_SINUSOID_PIXELS)
    if len(used) < MIN_PIXELS or len(seen.frames) == 3:
        return None
    frames = seen.frames.reshape(len(seen.frames), -1)[:, used].astype(np.float64)
    if _misfit(frames, gamma) < MAX_SINUSOID_ERROR:
        return None
    names, steps = [seen.shown_name(name) for name in seen.names], len(frames)
    least, pairs = 0.5 * _misfit(frames, gamma), []
    for i, j in combinations(range(steps), 2):
        order = list(range(steps))
        order[i], order[j] = j, i
        if _misfit(frames[order], FringeGamma()) < least:
            pairs.append(f"{names[i]} and {names[j]}")
    # With four steps, to exchange the first two is to exchange the last two, and to turn the direction.
    fault = f"frames {', or '.join(pairs)} seem to be exchanged" if pairs else ""
    modulation = phase_of(frames).modulation
    for i in range(steps):
        for j in range(i):
            if np.median(np.abs(frames[i] - frames[j]) / modulation) < 0.1 * np.sin(np.pi * (i - j) / steps):
                fault = f"frame {names[i]} repeats {names[j]}"
    fault = fault or "check the number of steps, the order of the frames, and that none is missing or repeated"
    return f"the fringes along {seen.axis} are no sinusoids shifted in {steps} equal steps: {fault}."


def _misfit(frames: np.ndarray, gamma: FringeGamma) -> float:
    """Systematic difference of fringes (N, n) from a sinusoid, beyond noise, as a fraction of their swing."""
    phase = phase_of(frames)
    true = gamma.corrected(phase, len(frames))
    model = _expected(true, len(frames), gamma.gamma)
    modulation = np.maximum(phase.modulation, 1e-12)
    scale = modulation / np.maximum(phase_of(model).modulation, 1e-12)
    swing = np.sqrt(2) * np.maximum(frames.std(axis=0), 1e-12)  # the modulation, if the fringes are sinusoids
    rest = (frames - frames.mean(axis=0) - scale * (model - model.mean(axis=0))) / swing
    members = _by_phase(phase.normalised)
    if not members:
        return 0.0
    off, noise = _medians(rest, members)
    return float(np.sqrt(max((off**2 - 9 * noise**2).mean(), 0.0)))


def _agreement_fault(seen: AxisFrames, code: AxisCode, stack: FringeStack, usable: np.ndarray) -> str | None:
    """A sentence if the phases of several periods do not agree on places of the axis; None if they do."""
    used = evenly_spread(np.flatnonzero(usable), MAX_SAMPLES)
    if len(stack.steps) == 1 or len(used) < MIN_PIXELS:
        return None
    refused = float((code.status.ravel()[used] == Status.CODE_ERROR).mean())
    if refused <= MAX_FAR_FRACTION:
        return None
    frames = seen.frames.reshape(len(seen.frames), -1)[:, used]
    phases = [phase_of(stack.of_period(frames, i)).normalised for i in range(len(stack.steps))]
    text = f"the fringes along {seen.axis} contradict each other at {100 * refused:.0f} % of the pixels"
    places = [stack.convention.place_turns(t, p) for t, p in zip(phases, stack.periods_px, strict=True)]
    for fault, other in _other_places(stack, phases, places):
        if float(stack.agrees(other, seen.size).mean()) > MIN_AGREEING:
            return f"{text}: {fault}."
    return f"{text}: check the periods ({', '.join(f'{p:g}' for p in stack.periods_px)} pixels) and their order."


def _other_places(
    stack: FringeStack, phases: list[np.ndarray], places: list[np.ndarray]
) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Faults that fringes may have, each with the places in turns that would be right if it were corrected."""
    count, convention = len(places), stack.convention
    if len(set(stack.steps)) == 1:
        for order in permutations(range(count)):
            if order != tuple(range(count)) and count <= 4:
                shown = ", ".join(f"{stack.periods_px[k]:g}" for k in order)
                pairs = zip([phases[order.index(k)] for k in range(count)], stack.periods_px, strict=True)
                moved = [convention.place_turns(t, p) for t, p in pairs]
                yield f"their periods seem to be shown in the order {shown} pixels", moved
    other = replace(convention, direction="backward" if convention.sign > 0 else "forward")
    flipped = [other.place_turns(t, p) for t, p in zip(phases, stack.periods_px, strict=True)]
    yield "they seem to be shifted in the opposite direction, so check the order of their frames", flipped
    for i, period in enumerate(stack.periods_px):
        name = f"those of {period:g} pixels seem"
        turned = [*places[:i], flipped[i], *places[i + 1 :]]
        yield f"{name} to be shifted in the opposite direction, so check the order of their frames", turned
        for turns in sorted({k / stack.steps[i] for k in range(1, stack.steps[i])} | {0.25, 0.5, 0.75}):
            for there, fault in ((places[i], "start elsewhere"), (flipped[i], "run the other way and start elsewhere")):
                elsewhere = [*places[:i], (there + np.float32(turns)) % 1, *places[i + 1 :]]
                yield f"{name} to {fault}, so check the order of their frames", elsewhere


def _expected(phase: Phase, steps: int, gamma: float) -> np.ndarray:
    """(N, n) values from 0 to 1 of fringes of these phases, with a gamma."""
    shifts = np.arange(steps)[:, None] / steps
    turns = phase.normalised.astype(np.float64)[None]
    return np.asarray((0.5 + 0.5 * np.cos(2 * np.pi * (turns - shifts))) ** gamma)


def _by_phase(normalised: np.ndarray) -> list[np.ndarray]:
    """Indices of the pixels in each part of the period that holds enough of them."""
    bins = np.minimum((normalised * PHASE_BINS).astype(int), PHASE_BINS - 1)
    return [m for m in (np.flatnonzero(bins == b) for b in range(PHASE_BINS)) if len(m) >= MIN_PIXELS / 10]


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
    """Medians (..., groups) of values (..., n), and the standard error of each; `members` are indices of the groups."""
    groups = [values[..., m] for m in members]
    medians = [np.median(group, axis=-1, keepdims=True) for group in groups]
    away = [np.median(np.abs(group - x), axis=-1, keepdims=True) for group, x in zip(groups, medians, strict=True)]
    spread = MEDIAN_ERROR * TO_SIGMA * np.concatenate(away, axis=-1)
    return np.concatenate(medians, axis=-1), spread / np.sqrt([len(m) for m in members])


def _comparable(gray: AxisCode, refined: AxisCode) -> np.ndarray:
    """(n,) int, flat indices of pixels inside a Gray cell whose fringes are strong enough to be compared with it."""
    return evenly_spread(np.flatnonzero(_inside_cell(gray, refined)))


def _inside_cell(gray: AxisCode, refined: AxisCode) -> np.ndarray:
    """(h, w) bool, pixels with a Gray cell, not an edge, whose phase was neither weak nor saturated."""
    inside = (gray.coordinate / gray.cell_px) % 1 == 0.5
    is_strong = (refined.status == Status.OK) | (refined.status == Status.CODE_ERROR)
    return np.asarray(inside & is_strong & (gray.status == Status.OK))


def _wrapped(turns: np.ndarray) -> np.ndarray:
    """Angles in turns, without whole turns, in [-0.5, 0.5]."""
    return np.asarray(turns - np.rint(turns))


def _circular_mean(turns: np.ndarray) -> tuple[float, float]:
    """Mean direction of angles in turns, and the length of the mean vector, 0 to 1."""
    mean = np.exp(2j * np.pi * turns.astype(np.float64)).mean()
    return float(np.angle(mean) / (2 * np.pi)), float(np.abs(mean))
