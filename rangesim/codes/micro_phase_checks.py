# SPDX-License-Identifier: Apache-2.0
"""Checks of micro phase shifting: images that no place of the projector explains, and which fault explains them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rangesim.codes.axis_code import AxisFrames
from rangesim.codes.image_faults import CHECKED_PIXELS, exchanged_images, other_conventions, repeated_image
from rangesim.decoding.phase_shift import phase_of, phase_sigma
from rangesim.decoding.pixel_samples import MIN_PIXELS

if TYPE_CHECKING:
    from rangesim.codes.micro_phase_shifting import MicroPhaseShifting

MAX_SIGMA_RAD = 0.05
"""Largest standard deviation of a phase at a pixel that is checked, radians. With more noise, sound pixels may fit
badly too: at 0.05 none of 100 000 does with eight periods, at 0.15 one of fifty."""

MAX_MISFIT_FRACTION = 0.05
"""Largest fraction of the brighter pixels that no place may fit. It is below 0.001 in the authors' captures. One image
that is wrong makes it 0.2 or more."""

MAX_MENDED_FRACTION = 0.02
"""Largest fraction of pixels that no place may fit once the right cause is undone, less than half of
`MAX_MISFIT_FRACTION`, so that a cause is named only if it explains most of the misfits."""

MAX_HARMONIC = 0.06
"""Largest amplitude of the second harmonic of the fringes, as a fraction of the first. A projector's gamma g makes it
(g - 1) / (g + 2): 0.06 is a gamma of 1.2, and moves phases by 0.06 radians."""

GAMMAS = (0.45, 1.4, 1.8, 2.2, 2.6)
"""Exponents of a projector that are tried on images that fit to no place."""


def period_contradiction(seen: AxisFrames, code: MicroPhaseShifting) -> str | None:
    """A sentence if the images contradict the periods as a whole, with the likely cause; None if they agree."""
    from rangesim.codes.micro_phase_shifting import SHIFTS, brightest

    frames = brightest(seen, SHIFTS, CHECKED_PIXELS)
    first = phase_of(frames[:SHIFTS])
    sigma = phase_sigma(seen.capture, first, SHIFTS)
    if sigma is not None:
        frames = frames[..., sigma[0] <= MAX_SIGMA_RAD]
    if frames.shape[2] < MIN_PIXELS:
        return None
    periods = code.periods(seen.size)
    misfits = _misfits(frames, code, periods, seen.size)
    if misfits <= MAX_MISFIT_FRACTION:
        return _harmonic(frames, code, periods, seen)
    text = f"the images along {seen.axis} contradict the periods at {100 * misfits:.0f} % of the bright pixels"
    names = [seen.shown_name(name) for name in seen.names]
    if fault := repeated_image(frames, names):
        return f"{text}: {fault}."
    for fault, other_frames, other_code, other_periods in _faults(frames, code, periods, names):
        if _misfits(other_frames, other_code, other_periods, seen.size) <= MAX_MENDED_FRACTION:
            return f"{text}: {fault}."
    curved = {
        gamma: float(1 - code.match(frames, periods, code.table_of(seen.size, gamma)).fits.mean()) for gamma in GAMMAS
    }
    gamma = min(curved, key=lambda gamma: curved[gamma])
    if curved[gamma] <= MAX_MENDED_FRACTION:
        return f"{text}: the fringes seem to have a gamma of about {gamma:.1f}: projector and camera must be linear."
    return (
        f"{text}: check periods_px, which are the periods in projector pixels (the name of a set is not them), the "
        "size of the projector, and the order of the images. Noise does the same: take more light."
    )


def _misfits(frames: np.ndarray, code: MicroPhaseShifting, periods: Sequence[float], size: int) -> float:
    """Fraction of the pixels that fit to no place."""
    from rangesim.codes.micro_phase_shifting import period_table

    table = period_table(periods, code.convention, size, np.ones(len(periods)))
    return float(1 - code.match(frames, periods, table).fits.mean())


def _faults(
    frames: np.ndarray, code: MicroPhaseShifting, periods: Sequence[float], names: list[str]
) -> Iterator[tuple[str, np.ndarray, MicroPhaseShifting, Sequence[float]]]:
    """Faults that images may have, each with frames, code and periods that undo it: the likely ones first."""
    for fault, other in other_conventions(code.convention):
        yield fault, frames, replace(code, convention=other), periods
    yield "the order of all images seems to be reversed", frames[::-1], code, periods
    for fault, swapped in exchanged_images(frames, names):
        yield fault, swapped, code, periods
    shifts = len(frames) - len(periods) + 1
    if len(periods) > 3:  # two periods always agree with some place
        for f in range(1, len(periods)):
            others = np.delete(frames, f + shifts - 1, axis=0)
            fault = f"frame {names[f + shifts - 1]} does not show its period of {periods[f]:g} px"
            yield fault, others, code, [*periods[:f], *periods[f + 1 :]]


def _harmonic(frames: np.ndarray, code: MicroPhaseShifting, periods: Sequence[float], seen: AxisFrames) -> str | None:
    """A sentence if the fringes have a second harmonic, as those of a projector that is not linear."""
    from rangesim.codes.micro_phase_shifting import angles, period_table

    match = code.match(frames, periods, period_table(periods, code.convention, seen.size, np.ones(len(periods))))
    omega, start = angles(periods, code.convention)
    fits = match.fits.ravel()
    place = match.place.ravel()[fits]
    if not place.size or np.ptp(place) < max(periods):
        return None  # a part of a fringe does not tell its shape
    theta = omega[1:, None] * place - start[1:, None]
    shown = np.stack([np.ones_like(theta), np.cos(theta), np.cos(2 * theta)]).reshape(3, -1).T
    _, first, second = np.linalg.lstsq(shown, match.units[fits, 2:].T.ravel().astype(np.float64), rcond=None)[0]
    harmonic = second / first
    if abs(harmonic) < MAX_HARMONIC:
        return None
    gamma = (1 + 2 * harmonic) / (1 - harmonic)
    return (
        f"the fringes along {seen.axis} are no sinusoids: their second harmonic is {100 * harmonic:.0f} % of the "
        f"first, as with a gamma of {gamma:.1f}: check that projector and camera are linear (no gamma, no clipping)."
    )
