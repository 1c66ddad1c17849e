# SPDX-License-Identifier: Apache-2.0
"""AMCW (indirect) time of flight: four taps to phase and amplitude, several frequencies to one path length.

References
----------
Lange: "3D time-of-flight distance measurement with custom solid-state image sensors in CMOS/CCD technology",
thesis, Siegen (2000): phase, amplitude and offset of four taps, and their shot noise.
Droeschel, Holz, Behnke: "Multi-frequency phase unwrapping for time-of-flight cameras", IROS (2010).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.bands import bands
from rangesim.decoding.path_length import range_image_from_path_length
from rangesim.decoding.phase_shift import Phase, modulation_is_weak, phase_sigma
from rangesim.range_image import RangeImage
from rangesim.response import SPEED_OF_LIGHT
from rangesim.sensors import AmcwToF
from rangesim.status import Status

TAPS = 4
MAX_RESIDUAL_TURNS = 0.1
"""A frequency whose phase is farther than this from that of the common path length contradicts it."""
MAX_AMBIGUITY = 0.5
"""Misfit of the best wrap counts over that of the second best: above, the choice between them is a guess."""


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """Common path length of several phases.

    length_m : (h, w) float64, metres. residual_turns : (h, w), largest misfit of any frequency's phase.
    ambiguity : (h, w) in 0..1, root of the best cost over the second best; 0 if there is no second.
    """

    length_m: np.ndarray
    residual_turns: np.ndarray
    ambiguity: np.ndarray


def decode_amcw(capture: Capture, correct_wiggling: bool = True) -> RangeImage:
    """Range image of an `AmcwToF` capture.

    Parameters
    ----------
    correct_wiggling : bool; for a square waveform, True inverts the triangle correlation exactly (what a
        calibrated camera does with a look-up table), False uses the sine formula and shows the raw wiggling
        error, up to 0.011 turns. Multipath sums triangles of different phase, for which neither is exact.

    Raises
    ------
    ValueError
        The capture is of another sensor.
    """
    sensor = capture.sensor
    if not isinstance(sensor, AmcwToF):
        raise ValueError(f"expected an amcw-tof capture, got {sensor.type_name}.")
    exact_square = sensor.waveform == "square" and correct_wiggling
    groups = np.split(capture.frames, len(sensor.modulation_hz))
    shape = capture.frames.shape[1:]
    status, length = np.zeros(shape, dtype=np.uint8), np.empty(shape)
    amplitude, mean = np.empty((2, *shape), dtype=np.float32)
    for rows in bands(len(status)):
        phases = [tap_phase(taps[:, rows], exact_square) for taps in groups]
        weights = [_weight(capture, phase, f) for phase, f in zip(phases, sensor.modulation_hz, strict=True)]
        unwrapped = unwrap([p.turns for p in phases], sensor.modulation_hz, weights, sensor.searched_m)
        contradiction = (unwrapped.residual_turns > MAX_RESIDUAL_TURNS) | (unwrapped.ambiguity > MAX_AMBIGUITY)
        status[rows][contradiction] = Status.WRAPPED
        for phase in phases:
            status[rows][modulation_is_weak(capture, phase, TAPS)] = Status.LOW_SIGNAL
        status[rows][capture.saturated(capture.frames[:, rows])] = Status.SATURATED
        length[rows] = unwrapped.length_m
        amplitude[rows] = np.mean([p.modulation for p in phases], axis=0)
        mean[rows] = np.mean([p.mean for p in phases], axis=0)
    confidence = 2 * amplitude / capture.full_scale
    return range_image_from_path_length(capture, length, status, confidence, mean - capture.black_level)


def tap_phase(taps: np.ndarray, exact_square: bool = False) -> Phase:
    """Phase of taps (4, h, w) at 0, 90, 180, 270 degrees, mean + modulation cos(phi - theta).

    C = tap 0 - tap 180 and S = tap 90 - tap 270 give phi = atan2(S, C), modulation = hypot(C, S) / 2. For a
    triangle correlation (`exact_square`) |C| + |S| is constant, and the phase is piecewise linear in S / (|C|
    + |S|).
    """
    tap = taps.astype(np.float32)
    cosine, sine = tap[0] - tap[2], tap[1] - tap[3]
    if exact_square:
        diagonal = np.maximum(np.abs(cosine) + np.abs(sine), np.finfo(np.float32).tiny)
        quarter = sine / diagonal
        turns = 0.25 * np.where(cosine >= 0, quarter, 2 - quarter)
    else:
        turns = np.arctan2(sine, cosine) * np.float32(1 / (2 * np.pi))
    return Phase(turns - np.floor(turns), 0.5 * np.hypot(cosine, sine), tap.mean(axis=0))


def unwrap(
    turns: list[np.ndarray], modulation_hz: tuple[float, ...], weights: list[np.ndarray], longest_m: float
) -> Unwrapped:
    """Path length that agrees best with the phases of all frequencies.

    Every wrap count of the highest frequency gives a candidate; the other frequencies take the wrap nearest
    to it, and the candidate with the least weighted sum of squared differences between their lengths wins.
    The result is the weighted mean of the unwrapped lengths.

    Parameters
    ----------
    turns : per frequency (h, w) in [0, 1). weights : per frequency (h, w), inverse variance of its length
        (any scale).
    longest_m : float, metres, path length up to which candidates are searched.
    """
    wavelengths = [SPEED_OF_LIGHT / f for f in modulation_hz]
    base = int(np.argmin(wavelengths))
    candidates = max(1, int(np.ceil(longest_m / wavelengths[base] - 1e-6)))
    total = np.sum(weights, axis=0)
    best_cost, second_cost = np.full((2, *turns[0].shape), np.inf)
    best = np.zeros(turns[0].shape)
    for n in range(candidates):
        guess = (turns[base].astype(np.float64) + n) * wavelengths[base]
        lengths = [w * (t + np.rint(guess / w - t)) for t, w in zip(turns, wavelengths, strict=True)]
        mean = sum(x * k for x, k in zip(lengths, weights, strict=True)) / total
        cost = sum(k * (x - mean) ** 2 for x, k in zip(lengths, weights, strict=True))
        better = cost < best_cost
        second_cost = np.minimum(second_cost, np.maximum(cost, best_cost))
        best_cost = np.minimum(cost, best_cost)
        best = np.where(better, mean, best)
    misfits = [best / w - t for t, w in zip(turns, wavelengths, strict=True)]
    residual = np.max([np.abs(m - np.rint(m)) for m in misfits], axis=0)
    return Unwrapped(best, residual, np.sqrt(best_cost / np.maximum(second_cost, 1e-30)))


def _weight(capture: Capture, phase: Phase, modulation_hz: float) -> np.ndarray:
    """(h, w) inverse variance of the path length by this frequency, in relative units."""
    sigma = phase_sigma(capture, phase, TAPS)
    precision = phase.modulation if sigma is None else 1 / np.maximum(sigma, 1e-9)
    scale = np.float64(modulation_hz / 1e8)
    return np.asarray((scale * precision.astype(np.float64)) ** 2 + 1e-30)
