# SPDX-License-Identifier: Apache-2.0
"""Two light paths in one pixel: their lengths in closed form, from the phasors of the frequencies f, 2 f and 3 f.

A pixel that sees light of two paths has the phasors m_k = a_1 e^(i k phi_1) + a_2 e^(i k phi_2) at the frequencies k f,
with amplitudes a that are positive and the same at all frequencies. By Prony's method, m_3 - s m_2 + p m_1 = 0 with
s = e^(i phi_1) + e^(i phi_2) and p = e^(i (phi_1 + phi_2)). With the mean phase theta = (phi_1 + phi_2) / 2 this reads

    e^(-i theta) m_3 - r m_2 + e^(i theta) m_1 = 0,    r = 2 cos((phi_1 - phi_2) / 2).

Times the conjugate of m_2, its imaginary part is linear in cos(theta) and sin(theta), and its real part gives r. For
one path alone the imaginary part vanishes for every theta: then there is nothing to separate.

References
----------
Kirmani, Benedetti, Chou: "SPUMIC: simultaneous phase unwrapping and multipath interference cancellation in
time-of-flight cameras using spectral methods", ICME 2013; they solve it for more paths, by the annihilating filter of
more frequencies. Dorrington et al.: "Separating true range measurements from multi-path and scattering interference in
commercial range cameras", SPIE 7864 (2011), for two frequencies, by iteration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangesim.response import SPEED_OF_LIGHT

RATIOS = (1, 2, 3)
"""Multiples of the lowest frequency that the closed form needs."""

SAME_RATIO = 1e-6
"""Largest relative deviation of a frequency from such a multiple: over the longest path that is searched, 200 m, it
turns the phase of 100 MHz by less than 1e-4."""

MIN_SIGMAS = 4.0
"""Least evidence for a second path, in standard deviations of the noise. Below it the reading stays that of one path.
Noise alone reaches it in 1 of 3000 pixels (Rayleigh distribution: exp(-4^2 / 2))."""

MIN_EVIDENCE = 1e-4
"""The same evidence of noise-free captures and of unknown detectors, as a fraction of the light's square. It is ten
times the rounding of float32 frames of 16 bits."""


@dataclass(frozen=True, eq=False)
class TwoPaths:
    """The stronger of two light paths in each pixel.

    turns : (h, w) float64, phase of the stronger path at the lowest frequency, in turns.
    found : (h, w) bool, where there are two paths. `turns` is valid there.
    """

    turns: np.ndarray
    found: np.ndarray


def order_of_ratios(modulation_hz: tuple[float, ...]) -> tuple[int, int, int] | None:
    """Indices of the frequencies f, 2 f and 3 f; None if these are not the frequencies.

    Examples
    --------
    >>> order_of_ratios((120e6, 40e6, 80e6)), order_of_ratios((20e6, 80e6, 100e6))
    ((1, 2, 0), None)
    """
    if len(modulation_hz) != len(RATIOS):
        return None
    first, second, third = (int(i) for i in np.argsort(modulation_hz))
    ratios = np.array(modulation_hz)[[first, second, third]] / modulation_hz[first]
    return (first, second, third) if np.abs(ratios / RATIOS - 1).max() < SAME_RATIO else None


def separate(phasors: Sequence[np.ndarray], sigmas: Sequence[np.ndarray] | None) -> TwoPaths:
    """The stronger of two paths in each pixel, by the closed form of this module's docstring.

    Parameters
    ----------
    phasors : three (h, w) complex, m_1, m_2 and m_3, as fractions of the same light: divided by the demodulation
        contrast of each frequency.
    sigmas : three (h, w) float, standard deviation of the real and of the imaginary part of each phasor; None: not
        known.

    Examples
    --------
    A wall at 0.1 turns, and 0.3 of its light by a detour to 0.25 turns:

    >>> m = [np.array([[np.exp(2j * np.pi * 0.1 * k) + 0.3 * np.exp(2j * np.pi * 0.25 * k)]]) for k in (1, 2, 3)]
    >>> separate(m, None).turns.round(6)
    array([[0.1]])
    """
    m1, m2, m3 = phasors
    p, q = m3 * m2.conj(), m1 * m2.conj()
    evidence = q - p.conj()  # 0 for one path
    theta = np.arctan2(-evidence.imag, evidence.real)
    square = np.abs(m2) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (np.exp(-1j * theta) * p + np.exp(1j * theta) * q).real / square
    half = np.arccos(np.clip(r / 2, -1, 1))
    phases = np.stack([theta + half, theta - half])
    amplitudes = _amplitudes(phases, phasors)
    if sigmas is None:
        enough = MIN_EVIDENCE * (np.abs(m1) + np.abs(m3)) * np.abs(m2)
    else:
        s1, s2, s3 = sigmas
        enough = MIN_SIGMAS * np.sqrt(square * (s1**2 + s3**2) + (np.abs(m1) ** 2 + np.abs(m3) ** 2) * s2**2)
    found = (np.abs(evidence) > enough) & (np.abs(r) <= 2) & (amplitudes > 0).all(axis=0)
    stronger = np.where(amplitudes[0] >= amplitudes[1], phases[0], phases[1]) / (2 * np.pi)
    return TwoPaths(np.where(found, stronger, 0.0), found)


def turns_sigma(phasors: Sequence[np.ndarray], sigmas: Sequence[np.ndarray], turns: np.ndarray) -> np.ndarray:
    """(h, w) float64, turns, standard deviation of the phases that `separate` found, by the noise of the phasors.

    It adds up the squares of what one standard deviation of each part of each phasor changes.

    Parameters
    ----------
    phasors, sigmas : as `separate` takes them. turns : (h, w), the phases that it found.
    """
    variance = np.zeros(turns.shape)
    for k in range(len(phasors)):
        for unit in (1.0, 1.0j):
            moved = [m + unit * sigmas[k] if i == k else m for i, m in enumerate(phasors)]
            change = separate(moved, None).turns - turns
            variance += (change - np.rint(change)) ** 2
    return np.sqrt(variance)


def _amplitudes(phases: np.ndarray, phasors: Sequence[np.ndarray]) -> np.ndarray:
    """(2, h, w) float64, least-squares amplitudes of paths; phases : (2, h, w), radians at the lowest frequency."""
    n, across, right = float(len(phasors)), np.zeros(phases.shape[1:]), np.zeros(phases.shape)
    for k, m in zip(RATIOS, phasors, strict=True):
        across += np.cos(k * (phases[0] - phases[1]))
        right += (np.exp(-1j * k * phases) * m).real
    determinant = np.maximum(n**2 - across**2, 1e-12)
    first, second = n * right[0] - across * right[1], n * right[1] - across * right[0]
    return np.stack([first, second]) / determinant


def nearest_length(turns: np.ndarray, length_m: np.ndarray, modulation_hz: float) -> np.ndarray:
    """(...) float64, metres, the path length with a phase (turns) at a frequency that is nearest to another one."""
    wavelength = SPEED_OF_LIGHT / modulation_hz
    return np.asarray(wavelength * (turns + np.rint(length_m / wavelength - turns)))
