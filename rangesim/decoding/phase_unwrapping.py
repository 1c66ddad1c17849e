# SPDX-License-Identifier: Apache-2.0
"""Phases of several modulation frequencies to one path length.

References
----------
Droeschel, Holz, Behnke: "Multi-frequency phase unwrapping for time-of-flight cameras", IROS (2010).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.response import SPEED_OF_LIGHT


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """Common path length of several phases.

    length_m : (h, w) float64, metres. residual : (h, w), largest misfit of any frequency's phase.
    ambiguity : (h, w) in 0..1, root of the best cost over the second best; 0 if there is no second.
    """

    length_m: np.ndarray
    residual: np.ndarray
    ambiguity: np.ndarray


def unwrap(
    normalised: list[np.ndarray], modulation_hz: tuple[float, ...], weights: list[np.ndarray], longest_m: float
) -> Unwrapped:
    """Path length that agrees best with the phases of all frequencies.

    Every wrap count of the highest frequency gives a candidate; the other frequencies take the wrap nearest
    to it, and the candidate with the least weighted sum of squared differences between their lengths wins.
    The result is the weighted mean of the unwrapped lengths.

    Parameters
    ----------
    normalised : per frequency (h, w) in [0, 1). weights : per frequency (h, w), inverse variance of its length
        (any scale).
    longest_m : float, metres, path length up to which candidates are searched.
    """
    wavelengths = [SPEED_OF_LIGHT / f for f in modulation_hz]
    base = int(np.argmin(wavelengths))
    candidates = max(1, int(np.ceil(longest_m / wavelengths[base] - 1e-6)))
    total = np.sum(weights, axis=0)
    best_cost, second_cost = np.full((2, *normalised[0].shape), np.inf)
    best = np.zeros(normalised[0].shape)
    for n in range(candidates):
        guess = (normalised[base].astype(np.float64) + n) * wavelengths[base]
        lengths = [w * (t + np.rint(guess / w - t)) for t, w in zip(normalised, wavelengths, strict=True)]
        mean = sum(x * k for x, k in zip(lengths, weights, strict=True)) / total
        cost = sum(k * (x - mean) ** 2 for x, k in zip(lengths, weights, strict=True))
        better = cost < best_cost
        second_cost = np.minimum(second_cost, np.maximum(cost, best_cost))
        best_cost = np.minimum(cost, best_cost)
        best = np.where(better, mean, best)
    misfits = [best / w - t for t, w in zip(normalised, wavelengths, strict=True)]
    residual = np.max([np.abs(m - np.rint(m)) for m in misfits], axis=0)
    return Unwrapped(best, residual, np.sqrt(best_cost / np.maximum(second_cost, 1e-30)))
