# SPDX-License-Identifier: Apache-2.0
"""AMCW (indirect) time of flight: four taps per modulation frequency, and the decoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.path_length import range_image_from_path_length
from rangesim.decoding.phase_shift import Phase, PhaseThresholds, modulation_is_weak, phase_sigma, tap_phase
from rangesim.decoding.phase_unwrapping import unwrap
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.response import SPEED_OF_LIGHT, Phasor, Response
from rangesim.sensor import TOF_BASELINE_M, Background, Decoder, Emitter, FrameContent, Sensor, of_type
from rangesim.settings import limits
from rangesim.settings.bounds import HERTZ, Bounds, Hertz, check_fields, check_number

MAX_RANGE_M = 100.0
"""Ranges beyond are not searched by phase unwrapping, even if the frequencies were unambiguous farther out."""
TAPS_DEG = (0, 90, 180, 270)
"""Delays of the taps of each frequency, in degrees of its phase; `frames` and `tap_phase` are for quarter turns."""
TAP_FRACTION = 1 / len(TAPS_DEG)
"""Fraction of an exposure's light that each tap collects on average: the taps divide it, and none is lost."""
RELATIVE_SIGNAL = 1e-4
"""Light of noise-free captures that counts as none, as a fraction of that of the bright pixels."""


@dataclass(frozen=True)
class AmcwToF(Sensor):
    """Amplitude-modulated continuous wave camera with four taps per frequency (0, 90, 180, 270 degrees).

    The four taps of a pixel share the light of one exposure: the mean of tap theta is (A + contrast * B cos(phi -
    theta)) / 4 with phi = 2 pi f l / c over the path length l (there and back); A holds white and ambient light. So the
    taps add up to A. A pixel of two taps that takes two exposures has as much in each as this one with twice the
    `exposure_s`. Frames: frequency by frequency, four taps each.

    Parameters
    ----------
    modulation_hz : tuple of floats, hertz; or one float.
    contrast : float in (0, 1], demodulation contrast.
    waveform : "sine", or "square" for a square source against a square reference (triangle correlation, "wiggling").
    """

    modulation_hz: tuple[Hertz, ...] = (20e6, 80e6, 100e6)
    contrast: Annotated[float, Bounds("a positive fraction", 1e-3, 1)] = 0.8
    waveform: Literal["sine", "square"] = "sine"

    type_name: ClassVar[str] = "amcw-tof"

    def __post_init__(self) -> None:
        if isinstance(self.modulation_hz, (int, float)):
            check_number("modulation_hz", self.modulation_hz, HERTZ)
            object.__setattr__(self, "modulation_hz", (float(self.modulation_hz),))
        check_fields(self)
        if not self.modulation_hz:
            raise ValueError("expected modulation_hz to hold at least one frequency in hertz, got none.")
        limits.check("frequencies", len(self.modulation_hz), "frequencies in modulation_hz")
        limits.check("wraps", self.wraps, "wraps of the highest frequency before all frequencies repeat")

    @property
    def shortest_period_m(self) -> float:
        """Metres of range after which the phase of the highest frequency repeats."""
        return SPEED_OF_LIGHT / (2 * max(self.modulation_hz))

    @property
    def unambiguous_range_m(self) -> float:
        """Range beyond which all frequencies together wrap, c / (2 gcd f); frequencies are taken to 1 kHz."""
        common = int(np.gcd.reduce([round(f / 1e3) for f in self.modulation_hz])) * 1e3
        return SPEED_OF_LIGHT / (2 * max(common, 1e3))

    @property
    def searched_m(self) -> float:
        """Path length up to which decoding tells the wraps of the highest frequency apart."""
        return min(2 * self.unambiguous_range_m, 2 * MAX_RANGE_M)

    @property
    def wraps(self) -> int:
        """How often the highest frequency wraps within `searched_m`: the candidates of phase unwrapping."""
        return max(1, int(np.ceil(self.searched_m * max(self.modulation_hz) / SPEED_OF_LIGHT - 1e-6)))

    def responses(self) -> tuple[Response, ...]:
        return tuple(Phasor(f, self.waveform == "square") for f in self.modulation_hz)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        offset = white + ambient
        result = np.empty((self.n_frames, *offset.shape), dtype=np.float32)
        taps = ((phasor, tap) for phasor in channels for tap in TAPS_DEG)
        for frame, (phasor, tap) in zip(result, taps, strict=True):
            axis, sign = tap // 90 % 2, 1 - tap // 180 * 2  # cos or sin of the phase, and its sign
            np.multiply(TAP_FRACTION, offset + sign * self.contrast * phasor[axis], out=frame, casting="same_kind")
        return result

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return 1 if single_tap else len(TAPS_DEG)

    def frame_names(self) -> list[str]:
        return [f"{f / 1e6:g}MHz_{tap}deg" for f in self.modulation_hz for tap in TAPS_DEG]

    @property
    def emitter(self) -> Emitter:
        return Emitter(baseline_m=TOF_BASELINE_M)

    @property
    def default_decoder(self) -> AmcwDecoder:
        return AmcwDecoder()

    @property
    def default_detector(self) -> Detector:
        """A lock-in pixel."""
        return Detector.time_of_flight()

    @classmethod
    def presets(cls) -> dict[str, Sensor]:
        return {"amcw": cls()}

    def is_beyond_range(self, path_length_m: np.ndarray) -> np.ndarray:
        """Path lengths beyond the last of the wraps that are searched, which ends at `searched_m` or after it."""
        longest_m = min(self.wraps * SPEED_OF_LIGHT / max(self.modulation_hz), 2 * self.unambiguous_range_m)
        return np.asarray(path_length_m > longest_m)

    @property
    def title(self) -> str:
        return "Time of flight (AMCW)"

    @property
    def details(self) -> str:
        megahertz = ", ".join(f"{f / 1e6:g}" for f in self.modulation_hz)
        return f"{megahertz} MHz, {len(TAPS_DEG)} taps, {self.waveform} wave"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        """A tap of the first frequency, and two of the last one."""
        last = len(TAPS_DEG) * (len(self.modulation_hz) - 1)
        return sorted({0, last, last + 1})


@dataclass(frozen=True)
class AmcwDecoder(Decoder):
    """Phase and amplitude of each frequency, and the one path length on which they agree.

    Parameters
    ----------
    phase : PhaseThresholds.
    correct_wiggling : bool; for a square waveform, True inverts the triangle correlation exactly (what a
        calibrated camera does with a look-up table), False uses the sine formula and shows the raw wiggling
        error, up to 0.011 periods. Multipath sums triangles of different phase, for which neither is exact.
    max_residual : a frequency whose phase is farther off that of the common path length contradicts it.
    max_ambiguity : misfit of the best wrap counts over that of the second best: above, the choice between them is a
        guess.
    """

    phase: PhaseThresholds = field(default_factory=PhaseThresholds)
    correct_wiggling: bool = True
    max_residual: Annotated[float, Bounds("0 or positive", 0, 1)] = 0.1
    max_ambiguity: Annotated[float, Bounds("0 or positive", 0, 1)] = 0.5

    type_name: ClassVar[str] = "amcw-tof"
    reads: ClassVar[type[Sensor]] = AmcwToF

    def __post_init__(self) -> None:
        check_fields(self)

    def decode(self, capture: Capture) -> RangeImage:
        sensor = of_type(capture.sensor, AmcwToF)
        exact_square = sensor.waveform == "square" and self.correct_wiggling
        groups = np.split(capture.frames, len(sensor.modulation_hz))
        shape = capture.frames.shape[1:]
        status, length = np.zeros(shape, dtype=np.uint8), np.empty(shape)
        amplitude, mean = np.empty((2, *shape), dtype=np.float32)
        for rows in bands(len(status)):
            phases = [tap_phase(taps[:, rows], exact_square) for taps in groups]
            weights = [_weight(capture, phase, f) for phase, f in zip(phases, sensor.modulation_hz, strict=True)]
            unwrapped = unwrap([p.normalised for p in phases], sensor.modulation_hz, weights, sensor.searched_m)
            contradiction = unwrapped.residual > self.max_residual
            status[rows][contradiction | (unwrapped.ambiguity > self.max_ambiguity)] = Status.UNWRAPPING_FAILED
            for phase in phases:
                status[rows][modulation_is_weak(capture, phase, len(TAPS_DEG), self.phase)] = Status.LOW_SIGNAL
            status[rows][capture.saturated(capture.frames[:, rows])] = Status.SATURATED
            length[rows] = unwrapped.length_m
            amplitude[rows] = np.mean([p.modulation for p in phases], axis=0)
            mean[rows] = np.mean([p.mean for p in phases], axis=0)
        return range_image_from_path_length(
            capture,
            length,
            status=status,
            confidence=2 * amplitude / capture.full_scale,
            intensity=mean - capture.black_level,
        )

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        visibility = of_type(sensor, AmcwToF).contrast * TAP_FRACTION
        least = self.phase.least_signal(len(TAPS_DEG), visibility, self.content(sensor), background)
        if background.noise_variance is None:
            least = np.maximum(least, background.floor(RELATIVE_SIGNAL))
        return least

    def content(self, sensor: Sensor) -> FrameContent:
        return FrameContent(signal=TAP_FRACTION, ambient=TAP_FRACTION)


def _weight(capture: Capture, phase: Phase, modulation_hz: float) -> np.ndarray:
    """(h, w) inverse variance of the path length by this frequency, in relative units."""
    sigma = phase_sigma(capture, phase, len(TAPS_DEG))
    precision = phase.modulation if sigma is None else 1 / np.maximum(sigma, 1e-9)
    scale = np.float64(modulation_hz / 1e8)
    return np.asarray((scale * precision.astype(np.float64)) ** 2 + 1e-30)
