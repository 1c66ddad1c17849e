# SPDX-License-Identifier: Apache-2.0
"""N-step phase shift: fringe frames, or the taps of a modulated camera, to a phase with its standard deviation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rangesim.capture import Capture
from rangesim.sensor import Background, FrameContent, Threshold, least_signal_for
from rangesim.settings.bounds import Bounds, check_fields

MIN_MODULATION = 1e-20
"""Modulation, in the units of the capture, that replaces zero in the standard deviation of a phase: so small that the
phase is refused, and large enough for products with the result to stay finite in float32."""


@dataclass(frozen=True)
class PhaseThresholds:
    """Thresholds at which a phase is refused.

    Parameters
    ----------
    max_sigma_rad : float, radians, largest standard deviation of a phase, where the detector is known.
    modulation_of_scale : float, least modulation as a fraction of full scale, for digital captures of unknown
        detectors. Fringes of several periods tell the noise, and ask for more if `max_sigma_rad` does.
    relative_modulation : float, least modulation as a fraction of the pixel's own brightness, for noise-free captures.

    Examples
    --------
    >>> PhaseThresholds(max_sigma_rad=0.1).max_sigma_rad
    0.1
    """

    max_sigma_rad: Annotated[float, Bounds("positive and finite", 1e-6, 1e6)] = 0.2
    modulation_of_scale: Threshold = 2.5 / 255
    relative_modulation: Threshold = 0.01

    def __post_init__(self) -> None:
        check_fields(self)

    def least_signal(self, steps: int, visibility: float, content: FrameContent, background: Background) -> np.ndarray:
        """(h, w) float64, least light S of the emitter at full power that a phase needs, in the background's unit.

        With a modulation of `visibility` times S, sigma = sqrt(2 / steps) noise / (visibility S), see `phase_sigma`.

        Parameters
        ----------
        steps : int, number of frames. visibility : float, modulation as a fraction of S.
        content : FrameContent of one of the frames.
        """
        ambient = content.ambient * background.ambient
        if background.noise_variance is None:
            return np.asarray(self.relative_modulation * ambient / visibility)
        sigmas2 = 2.0 / (steps * (visibility * self.max_sigma_rad) ** 2)
        return least_signal_for(sigmas2, content.signal, ambient + background.noise_variance)


@dataclass(frozen=True, eq=False)
class Phase:
    """Phase of fringes or taps, I = mean + modulation cos(phase - shift).

    normalised : (h, w) float32 in [0, 1), the phase in turns, which is the phase in radians divided by 2 pi.
    modulation, mean : (h, w) float32, in the units of the capture.
    """

    normalised: np.ndarray
    modulation: np.ndarray
    mean: np.ndarray


def phase_of(frames: np.ndarray) -> Phase:
    """Least-squares phase phi of frames I_s = mean + modulation cos(phi - 2 pi s / N).

    Parameters
    ----------
    frames : (N, ...) of any number type, N >= 3, in any unit.

    Examples
    --------
    >>> import numpy as np
    >>> shifts = 2 * np.pi * np.arange(3) / 3
    >>> phase = phase_of(5 + 2 * np.cos(2 * np.pi * 0.25 - shifts)[:, None, None])
    >>> round(float(phase.normalised[0, 0]), 4), round(float(phase.modulation[0, 0]), 4)
    (0.25, 2.0)

    References
    ----------
    Bruning et al.: "Digital wavefront measuring interferometer for testing optical surfaces and lenses",
    Applied Optics 13 (1974); their least-squares solution for equal steps.
    """
    n = len(frames)
    cosine = np.zeros(frames.shape[1:], dtype=np.float32)
    sine, total = np.zeros_like(cosine), np.zeros_like(cosine)
    for s, frame in enumerate(frames):
        value = frame.astype(np.float32)
        cosine += np.float32(np.cos(2 * np.pi * s / n)) * value
        sine += np.float32(np.sin(2 * np.pi * s / n)) * value
        total += value
    normalised = np.arctan2(sine, cosine) * np.float32(1 / (2 * np.pi))
    modulation = np.sqrt(cosine * cosine + sine * sine) * np.float32(2 / n)
    return Phase(normalised - np.floor(normalised), modulation, total / n)


def phase_sigma(capture: Capture, phase: Phase, steps: int, slope: np.ndarray | float = 1.0) -> np.ndarray | None:
    """(h, w) float32, radians, standard deviation of the phase, sqrt(2 / N) sigma_I / B; None if it is not known.

    It is not known for unknown detectors and noise-free captures.

    Parameters
    ----------
    capture : Capture that the frames of `phase` belong to. steps : int, N, number of frames.
    slope : change of the phase over that of the one that was measured, if it was corrected since.
    """
    noise = capture.noise(phase.mean)
    if noise is None:
        return None
    return np.asarray(np.sqrt(2 / steps) * slope * noise / np.maximum(phase.modulation, MIN_MODULATION))


def tap_phase(taps: np.ndarray, exact_square: bool = False) -> Phase:
    """Phase phi of taps at theta = 0, 90, 180 and 270 degrees, mean + modulation cos(phi - theta).

    C = tap 0 - tap 180 and S = tap 90 - tap 270 give phi = atan2(S, C), modulation = hypot(C, S) / 2. For a triangle
    correlation |C| + |S| is constant, and the phase is piecewise linear in S / (|C| + |S|).

    Parameters
    ----------
    taps : (4, h, w) of any number type, in any unit. exact_square : whether the correlation is a triangle, as of a
        square source and a square reference.

    Examples
    --------
    >>> import numpy as np
    >>> theta = np.deg2rad([0, 90, 180, 270])[:, None, None]
    >>> round(float(tap_phase(5 + 2 * np.cos(2 * np.pi * 0.7 - theta)).normalised[0, 0]), 4)
    0.7

    References
    ----------
    Lange: "3D time-of-flight distance measurement with custom solid-state image sensors in CMOS/CCD technology",
    thesis, Siegen (2000): phase, amplitude and offset of four taps, and their shot noise.
    """
    tap = taps.astype(np.float32)
    cosine, sine = tap[0] - tap[2], tap[1] - tap[3]
    if exact_square:
        diagonal = np.maximum(np.abs(cosine) + np.abs(sine), np.finfo(np.float32).tiny)
        quarter = sine / diagonal
        normalised = 0.25 * np.where(cosine >= 0, quarter, 2 - quarter)
    else:
        normalised = np.arctan2(sine, cosine) * np.float32(1 / (2 * np.pi))
    return Phase(normalised - np.floor(normalised), 0.5 * np.hypot(cosine, sine), tap.mean(axis=0))


def modulation_is_weak(
    capture: Capture, phase: Phase, sigma: np.ndarray | None, thresholds: PhaseThresholds
) -> np.ndarray:
    """(h, w) bool, where the modulation is too weak for a phase.

    Parameters
    ----------
    capture : Capture that the frames of `phase` belong to. sigma : as `phase_sigma` returns it.
    """
    if sigma is not None:
        return np.asarray(sigma > thresholds.max_sigma_rad)
    if capture.is_digital:
        return np.asarray(phase.modulation < thresholds.modulation_of_scale * capture.full_scale)
    return np.asarray(~(phase.modulation > thresholds.relative_modulation * np.maximum(phase.mean, 0)))  # NaN is weak
