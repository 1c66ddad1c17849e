# SPDX-License-Identifier: Apache-2.0
"""Phase unwrapping: the phases of several modulation frequencies to one path length.

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
    """Path length on which the phases of several frequencies agree.

    length_m : (h, w) float64, metres, there and back.
    residual : (h, w) float64, largest misfit of any frequency's phase, in turns, 0 to 0.5.
    ambiguity : (h, w) float64 in 0..1, square root of the ratio of the least cost to the second least; 0 if there is no
        second.
    weight : (h, w) float64, sum of the weights of all frequencies: the inverse variance of `length_m`, in their scale.
    """

    length_m: np.ndarray
    residual: np.ndarray
    ambiguity: np.ndarray
    weight: np.ndarray


def unwrap(
    normalised: list[np.ndarray], modulation_hz: tuple[float, ...], weights: list[np.ndarray], longest_m: float
) -> Unwrapped:
    """Path length that agrees best with the phases of all frequencies.

    Every wrap count of the highest frequency gives a candidate. Each other frequency takes the wrap count whose length
    is nearest to it. The candidate with the least weighted sum of squared differences between the lengths of all
    frequencies wins, and the result is the weighted mean of its lengths.

    Parameters
    ----------
    normalised : per frequency (h, w) float32, phases in turns, in [0, 1).
    weights : per frequency (h, w) float, inverse variance of its length, in any scale.
    longest_m : float, metres, path length up to which candidates are searched.

    Examples
    --------
    The phases of 20 and 30 MHz after a path of 12 m, longer than both wavelengths (15 and 10 m, nearly):

    >>> import numpy as np
    >>> hertz, one = (20e6, 30e6), np.ones((1, 1))
    >>> phases = [np.array([[12.0 * f / SPEED_OF_LIGHT % 1]]) for f in hertz]
    >>> unwrap(phases, hertz, [one, one], longest_m=30.0).length_m.round(6)
    array([[12.]])
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
    return Unwrapped(best, residual, np.sqrt(best_cost / np.maximum(second_cost, 1e-30)), total)
