# SPDX-License-Identifier: Apache-2.0
"""Checks of modulated phase shifting: images that no place of the projector explains, and the fault that does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rangesim.codes.axis_code import AxisFrames
from rangesim.codes.image_faults import CHECKED_PIXELS, exchanged_images, other_conventions, repeated_image
from rangesim.decoding.pixel_samples import MIN_PIXELS

if TYPE_CHECKING:
    from rangesim.codes.modulated_phase_shifting import ModulatedPhaseShifting

MAX_CONTRADICTING = 0.1
"""Largest fraction of the brighter pixels that may contradict the code. One image that is wrong makes it 0.1 to 0.5."""

MAX_RELATIVE_NOISE = 0.03
"""Largest noise at a pixel that is checked, as a fraction of the carrier's amplitude. With more, sound pixels may look
unexplained: with the default code the limit is 0.09."""

GAMMAS = (0.45, 0.7, 1.2, 1.5, 1.8, 2.2)
"""Exponents of a projector that are tried. Smaller deviations from 1 move phases by less than 0.06 radians."""

MIN_UNEXPLAINED = 0.002
"""Least fraction of the images that is unexplained, in the median over the pixels, at which a gamma is looked for. A
gamma of 1.2 leaves 0.003."""

MAX_GAMMA_RATIO = 0.5
"""Largest fraction of what is unexplained, in the median over the pixels, that another gamma leaves if it is right."""


def modulation_contradiction(seen: AxisFrames, code: ModulatedPhaseShifting) -> str | None:
    """A sentence if the images contradict the code as a whole, with the likely cause; None if they agree."""
    frames = _brighter(seen, code)
    if frames.shape[2] < MIN_PIXELS:
        return None
    size, names = seen.size, [seen.shown_name(name) for name in seen.names]
    fraction = _contradicting(frames, code, size)
    text = f"the images along {seen.axis} contradict their code at {100 * fraction:.0f} % of the bright pixels"
    if fraction > MAX_CONTRADICTING:
        if fault := repeated_image(frames, names):
            return f"{text}: {fault}."
        for fault, other_frames, other_code in _faults(frames, code, names):
            if _contradicting(other_frames, other_code, size) < min(MAX_CONTRADICTING, fraction / 3):
                return f"{text}: {fault}."
    level = float(np.median(_unexplained(frames, code, size)))
    curved = min(float(np.median(_unexplained(frames, code, size, gamma))) for gamma in GAMMAS)
    if curved < MAX_GAMMA_RATIO * level and level > MIN_UNEXPLAINED:
        return (
            f"the fringes along {seen.axis} are no sinusoids: check that projector and camera are linear (no gamma, no "
            "automatic exposure, no clipping)."
        )
    if fraction > MAX_CONTRADICTING:
        return (
            f"{text}: check the period, the numbers of steps, the size of the projector and the order of the images. "
            "Noise does the same: take more light, or more levels."
        )
    return None


def _brighter(seen: AxisFrames, code: ModulatedPhaseShifting) -> np.ndarray:
    """(k, 1, m) images at pixels of more than the median amplitude, evenly spread."""
    frames = seen.frames.reshape(len(seen.frames), 1, -1)
    frames = frames[..., :: 1 + frames.shape[2] // (4 * CHECKED_PIXELS)]
    carrier = code.demodulated(frames).carrier
    usable = ~seen.capture.saturated(frames) & (carrier.modulation > 0)
    noise = seen.capture.noise(carrier.mean)
    if noise is not None:
        usable &= noise < MAX_RELATIVE_NOISE * carrier.modulation
    if not usable.any():
        return frames[..., :0]
    return frames[..., (usable & (carrier.modulation >= np.median(carrier.modulation[usable])))[0]][
        ..., :CHECKED_PIXELS
    ]


def _contradicting(frames: np.ndarray, code: ModulatedPhaseShifting, size: int) -> float:
    """Fraction of the pixels at which long and short fringes disagree, or whose place does not explain the images."""
    place, agree = code.places(code.demodulated(frames), size)
    return float(1 - (agree & (code.unexplained(frames, place, size) <= code.max_unexplained(size))).mean())


def _unexplained(frames: np.ndarray, code: ModulatedPhaseShifting, size: int, gamma: float = 1.0) -> np.ndarray:
    place, _ = code.places(code.demodulated(frames), size)
    return code.unexplained(frames, place, size, gamma)


def _faults(
    frames: np.ndarray, code: ModulatedPhaseShifting, names: list[str]
) -> Iterator[tuple[str, np.ndarray, ModulatedPhaseShifting]]:
    """Faults that images may have, each with frames and code that undo it: the likely ones first."""
    for fault, other in other_conventions(code.convention):
        yield fault, frames, replace(code, convention=other)
    by_carrier = np.arange(len(frames)).reshape(code.levels, code.carrier_steps, code.steps)
    if code.levels * code.steps > 1:
        yield "the long fringes seem to be shifted first", frames[by_carrier.transpose(0, 2, 1).ravel()], code
    yield "the order of all images seems to be reversed", frames[::-1], code
    for fault, swapped in exchanged_images(frames, names):
        yield fault, swapped, code
