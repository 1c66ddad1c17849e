# SPDX-License-Identifier: Apache-2.0
"""Gamma of fringes: the exponent of a response that is not linear, measured from fringes, whose phases it corrects.

A projector with gamma shows a fringe p = 1/2 + 1/2 cos(theta) as p^gamma, which has harmonics of theta. N steps cannot
tell the harmonics N - 1 and N + 1 from the fringe itself, so the phase ripples N times per period. The same harmonics
make the modulation ripple (N = 3), or leave a remainder that no sinusoid explains (N >= 4): both tell the exponent.

References
----------
- Guo, He, Zhang, Chen: "Gamma correction for digital fringe projection profilometry", Applied Optics 43 (2004).
- Pan, Kemao, Huang, Asundi: "Phase error analysis and compensation for nonsinusoidal waveforms in phase-shifting
  digital fringe projection profilometry", Optics Letters 34 (2009).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rangesim.decoding.phase_shift import Phase
from rangesim.decoding.pixel_samples import MIN_PIXELS, evenly_spread
from rangesim.robust_scale import sigma_from_median

GAMMAS = np.arange(8, 81) / 20
"""Exponents that are compared with the fringes: from a camera that was corrected for a gamma of 2.5 to a projector and
a camera of 2 each."""

RIPPLE_BINS = 16
"""Number of parts into which one ripple of the phase is divided. A ripple is nearly a sine, which needs a few; with
more parts, each would hold fewer pixels."""

MAX_GAP = 0.5
"""Largest part of a ripple, between 0 and 1, in which three steps may show no phase. With a larger gap, a brightness
that changes along the image looks like a ripple."""

MIN_SLOPE = 0.02
"""Least change of the ripple with the exponent, as a root mean square over the phases that are seen, at which they tell
the exponent. Phases all over the ripple have 0.25 to 0.4 at an exponent of 1, and 0.04 at 4 (measured)."""

TABLE_SIZE = 2048
"""Number of phases in a table of corrections. The error is below 1e-6 turns for gammas from 1.8 to
2.6 and three or four steps (measured)."""

MAX_SAMPLES = 20_000
"""Largest number of pixels from which the exponent is measured. With noise of 1 % of white
its standard deviation is 0.0012 with three steps and 0.0005 with four (measured at a gamma of 1.5)."""

MIN_CHANGE = 0.02
"""Least difference of the exponent from 1 that is corrected. With three steps it makes a ripple of 0.001 turns, 0.017
pixels of a period of 16; smaller ones are left alone, so that linear fringes are not touched."""

MIN_SIGNIFICANCE = 5.0
"""Least difference of the exponent from 1 that is corrected, in standard errors: noise alone makes as much in one
capture of two million."""

MIN_EXPLAINED = 0.8
"""Least fraction of the variance of the ripple that the exponent explains. Frames that are missing, exchanged or
repeated make ripples of another shape, and these are faults to tell, not to correct."""

MIN_RIPPLE = 0.01
"""Standard deviation of the ripple, as a fraction of the modulation, from which one that no exponent explains is
told."""


@dataclass(frozen=True)
class FringeGamma:
    """Response of projector and camera as fringes show it.

    gamma : float, exponent for which phases are corrected; 1: the fringes are linear, or do not tell.
    is_explained : bool, False if the fringes are not sinusoidal and no exponent explains how.
    is_told : bool, False if too few pixels or phases are seen to tell whether the fringes are linear.
    """

    gamma: float = 1.0
    is_explained: bool = True
    is_told: bool = True

    def corrected(self, phase: Phase, steps: int) -> Phase:
        """The phases of `steps` fringes as they would be of a linear response."""
        if self.gamma == 1:
            return phase
        place = phase.normalised + _at_ripple(phase, steps, _corrections(self.gamma, steps))
        return Phase(place - np.floor(place), phase.modulation, phase.mean)

    def slope(self, phase: Phase, steps: int) -> np.ndarray | float:
        """Change of the corrected phase over that of the measured one, (...) float32: the factor of its noise.

        Parameters
        ----------
        phase : as measured. steps : number of fringes.
        """
        if self.gamma == 1:
            return 1.0
        table = _corrections(self.gamma, steps)
        return 1 + _at_ripple(phase, steps, np.gradient(table, 1 / steps / (len(table) - 1)))


def _at_ripple(phase: Phase, steps: int, table: np.ndarray) -> np.ndarray:
    """(...) float32, values of a table (t,) over one ripple of the phase, which repeats `steps` times per period."""
    turns = phase.normalised * np.float32(steps)
    return np.interp(turns - np.floor(turns), np.linspace(0, 1, len(table)), table).astype(np.float32)


def gamma_of(frames: np.ndarray, usable: np.ndarray, scale: np.ndarray | None) -> FringeGamma:
    """Response of projector and camera as fringes show it.

    Parameters
    ----------
    frames : (N, h, w), fringes of one period. usable : (h, w) bool, pixels that are neither weak nor saturated.
    scale : (h, w) brightness that the fringes do not change, such as white - black; None: there is none.
    """
    used = evenly_spread(np.flatnonzero(usable), MAX_SAMPLES)
    if len(used) < MIN_PIXELS:
        return FringeGamma(is_told=False)
    few = frames.reshape(len(frames), -1)[:, used]
    return measured_gamma(few, None if scale is None else scale.ravel()[used])


def measured_gamma(frames: np.ndarray, contrast: np.ndarray | None = None) -> FringeGamma:
    """Exponent of the response that fringes show.

    Parameters
    ----------
    frames : (N, n) of any number type, fringes of pixels that are neither weak nor saturated.
    contrast : (n,) brightness of these pixels that the fringes do not change, such as white - black; None: there is
        none. Then ambient light makes three steps tell an exponent that is too near to 1.

    Examples
    --------
    >>> x = np.linspace(0, 9, 5000)
    >>> shown = [(0.5 + 0.5 * np.cos(2 * np.pi * (x - s / 3))) ** 2.2 for s in range(3)]
    >>> round(measured_gamma(np.array(shown)).gamma, 2)
    2.2
    """
    steps, n = frames.shape[0], frames.shape[1]
    every = slice(None, None, 1 + n // MAX_SAMPLES)
    frames = frames[:, every].astype(np.float64)
    position, value = _ripple(frames, None if contrast is None else contrast[every])
    part = np.where(np.isfinite(value), np.minimum((position * RIPPLE_BINS).astype(int), RIPPLE_BINS - 1), -1)
    members = [m for m in (np.flatnonzero(part == b) for b in range(RIPPLE_BINS)) if len(m) >= MIN_PIXELS / 10]
    if not members:
        return FringeGamma(is_told=False)
    places = np.array([np.median(position[m]) for m in members])
    medians = np.array([np.median(value[m]) for m in members])
    error = np.array([sigma_from_median(value[m], x) for m, x in zip(members, medians, strict=True)])
    error = 1.253 * error / np.sqrt([len(m) for m in members])  # of a median: sqrt(pi / 2) times that of a mean
    curves = _curves_at(places, steps, contrast is not None)
    if steps == 3:  # the scale of the modulation is not known
        medians, curves = medians - medians.mean(), curves - curves.mean(axis=1, keepdims=True)
    difference = medians - curves
    misfit = (difference**2).mean(axis=1)
    best = int(np.argmin(misfit))
    linear = misfit[int(np.argmin(np.abs(GAMMAS - 1)))]
    gamma, slope = _refined(best, difference, curves)
    is_linear = bool(linear <= MIN_RIPPLE**2 + 9 * (error**2).mean())
    if steps == 3 and float(np.diff([*places, places[0] + 1]).max()) > MAX_GAP:
        return FringeGamma(is_told=False)
    if slope < MIN_SLOPE:
        return FringeGamma(is_explained=is_linear, is_told=False)
    sigma = float(np.sqrt((error**2).mean() / len(members)) / slope)
    is_there = linear > MIN_RIPPLE**2 or abs(gamma - 1) > MIN_CHANGE
    if not is_there or abs(gamma - 1) < MIN_SIGNIFICANCE * sigma or abs(gamma - 1) <= MIN_CHANGE:
        return FringeGamma()
    if misfit[best] > (1 - MIN_EXPLAINED) * linear or best in (0, len(GAMMAS) - 1):
        return FringeGamma(is_explained=is_linear)
    return FringeGamma(round(gamma, 4))


def _refined(best: int, difference: np.ndarray, curves: np.ndarray) -> tuple[float, float]:
    """The exponent between the steps of `GAMMAS`, by a step of Gauss and Newton, and the change of the curve."""
    low, high = max(best - 1, 0), min(best + 1, len(GAMMAS) - 1)
    derivative = (curves[high] - curves[low]) / (GAMMAS[high] - GAMMAS[low])
    square = float((derivative**2).mean())
    step = float((derivative * difference[best]).mean()) / max(square, 1e-30)
    return float(GAMMAS[best] + np.clip(step, -0.05, 0.05)), square**0.5


def _ripple(frames: np.ndarray, contrast: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Place of a pixel in the ripple (n,), 0 to 1, and a value (n,) that a gamma makes change with the place.

    For three steps it is the logarithm of the modulation over white - black, or over the mean. For more it is the
    second harmonic in phase with the fringe, as a fraction of the modulation.
    """
    steps = len(frames)
    turns = np.exp(2j * np.pi * np.arange(steps) / steps)
    first = 2 / steps * (turns.real @ frames + 1j * (turns.imag @ frames))
    modulation = np.maximum(np.abs(first), 1e-30)
    phase = np.angle(first) / (2 * np.pi) * steps
    position = phase - np.floor(phase)
    if steps == 3:
        scale = frames.mean(axis=0) if contrast is None else contrast
        return position, np.log(modulation / np.where(scale > 0, scale, np.nan))
    twice = turns**2
    second = 2 / steps * (twice.real @ frames + 1j * (twice.imag @ frames))
    return position, (second * first.conj() ** 2).real / modulation**3


def _curves_at(places: np.ndarray, steps: int, has_contrast: bool) -> np.ndarray:
    """(g, n) value of `_ripple` at places (n,) in the ripple, for each of `GAMMAS`."""
    curves = _curves(steps, has_contrast)
    at = places * (curves.shape[1] - 1)
    low = np.minimum(at.astype(int), curves.shape[1] - 2)
    return np.asarray(curves[:, low] + (at - low) * (curves[:, low + 1] - curves[:, low]))


@lru_cache(maxsize=32)
def _curves(steps: int, has_contrast: bool) -> np.ndarray:
    """(g, TABLE_SIZE) value of `_ripple` at places from 0 to 1, both included, for each of `GAMMAS`."""
    result = np.empty((len(GAMMAS), TABLE_SIZE))
    for i, gamma in enumerate(GAMMAS):
        position, value = _ripple(_shown(float(gamma), steps), np.ones(TABLE_SIZE) if has_contrast else None)
        result[i] = np.interp(np.linspace(0, 1, TABLE_SIZE), position, value, period=1)
    return result


def _shown(gamma: float, steps: int) -> np.ndarray:
    """(N, TABLE_SIZE) fringes as they are shown with a gamma, of two ripples: 2 / N turns."""
    turns = np.linspace(-0.5, 1.5, TABLE_SIZE) / steps
    shifts = np.arange(steps)[:, None] / steps
    return np.asarray((0.5 + 0.5 * np.cos(2 * np.pi * (turns - shifts))) ** gamma)


@lru_cache(maxsize=32)
def _corrections(gamma: float, steps: int) -> np.ndarray:
    """(t,) turns, true minus measured phase at measured phases from 0 to 1 / N turns, both ends included."""
    true = np.linspace(-0.5, 1.5, TABLE_SIZE) / steps
    first = np.tensordot(np.exp(2j * np.pi * np.arange(steps) / steps), _shown(gamma, steps), axes=1)
    measured = np.unwrap(np.angle(first) / (2 * np.pi), period=1)
    measured -= np.rint((measured - true).mean())
    return np.interp(np.linspace(0, 1 / steps, TABLE_SIZE), measured, true - measured)
