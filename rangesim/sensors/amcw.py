# SPDX-License-Identifier: Apache-2.0
"""AMCW (indirect) time of flight: a camera with several taps per modulation frequency, and its decoder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.path_length import PathLengths
from rangesim.decoding.phase_shift import Phase, PhaseThresholds, modulation_is_weak, phase_of, phase_sigma, tap_phase
from rangesim.decoding.phase_unwrapping import unwrap
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.decoding.working_range import WorkingRange
from rangesim.electronics.detector import Detector
from rangesim.response import SPEED_OF_LIGHT, Phasor, Response
from rangesim.sensor import TOF_BASELINE_M, Background, Decoder, Emitter, FrameContent, Sensor, of_type
from rangesim.settings import limits
from rangesim.settings.bounds import HERTZ, Bounds, Hertz, check_fields, check_number

MAX_RANGE_M = 100.0
"""Largest range, metres, that phase unwrapping searches, even if the frequencies are unambiguous farther out, because
the time of the search grows with this range, and the emitter of such a camera does not reach as far."""

TAPS_DEG = (0, 90, 180, 270)
"""Delays of four taps, in degrees of the phase: quarter turns, as in nearly all such cameras. `tap_phase` and a
branch of `tap_correlations` are written for them."""

MAX_TAPS = 16
"""Largest number of taps of a frequency: real cameras have 2 to 8 samples of the phase; more only costs memory."""

WEIGHT_HZ = 1e8
"""Modulation frequency, hertz, that sets the unit of the weights of phase unwrapping. It is a typical frequency, so a
phase with a standard deviation of one radian has a weight near 1. Any other value scales all weights alike."""

RADIAN_M = SPEED_OF_LIGHT / (2 * math.pi * WEIGHT_HZ)
"""Path length, metres, over which the phase of `WEIGHT_HZ` grows by one radian; the speed of light determines it."""

RELATIVE_SIGNAL = 1e-4
"""Light of noise-free captures that counts as none, as a fraction of that of the bright pixels: it is far below what
any detector distinguishes from noise. With a larger value, the causes would say "low signal" at pixels where a
noise-free capture has a reading."""


@dataclass(frozen=True)
class AmcwToF(Sensor):
    """Amplitude-modulated continuous wave camera with evenly spaced taps, by default four (0, 90, 180, 270 degrees).

    The N taps of a pixel share the light of one exposure. The mean of tap theta is (A + contrast * B cos(phi -
    theta)) / N with phi = 2 pi f l / c over the path length l (there and back); A is the white and the ambient light.
    So the taps add up to A. A pixel with two taps, which takes two exposures, collects as much in each tap as this one
    with twice the `exposure_s`. Frames: frequency by frequency, `taps` each.

    A pixel of a Kinect v2 takes N exposures, and delivers the difference of two opposite taps for each. Such a
    difference has the modulation and the shot noise of one of N taps that share an exposure as long as all N together.

    Parameters
    ----------
    modulation_hz : tuple of floats, hertz; or one float.
    contrast : float in (0, 1], demodulation contrast.
    waveform : "sine", or "square" for a square source against a square reference. The correlation is then a triangle,
        and a decoder that takes it for a sine has a periodic error, the "wiggling". It needs four taps.
    taps : number of taps of each frequency, at 0, 360 / taps, ... degrees of its phase. Kinect v2 has 3.

    Examples
    --------
    >>> camera = AmcwToF((20e6, 80e6))
    >>> round(camera.shortest_period_m, 2), round(camera.unambiguous_range_m, 2)  # of 80 MHz, and of both together
    (1.87, 7.49)
    >>> AmcwToF(50e6, waveform="square").details
    '50 MHz, 4 taps, square wave'
    """

    modulation_hz: tuple[Hertz, ...] = (20e6, 80e6, 100e6)
    contrast: Annotated[float, Bounds("a positive fraction", 1e-3, 1)] = 0.8
    waveform: Literal["sine", "square"] = "sine"
    taps: Annotated[int, Bounds("a number of taps", 3, MAX_TAPS)] = len(TAPS_DEG)

    type_name: ClassVar[str] = "amcw-tof"

    def __post_init__(self) -> None:
        if isinstance(self.modulation_hz, (int, float)):
            check_number("modulation_hz", self.modulation_hz, HERTZ)
            object.__setattr__(self, "modulation_hz", (float(self.modulation_hz),))
        check_fields(self)
        if not self.modulation_hz:
            raise ValueError("expected modulation_hz to hold at least one frequency in hertz, got none.")
        if self.waveform == "square" and self.taps != len(TAPS_DEG):
            raise ValueError(f"expected {len(TAPS_DEG)} taps for a square waveform, got {self.taps}.")
        limits.check("frequencies", len(self.modulation_hz), "frequencies in modulation_hz")
        limits.check("wraps", self.wraps, "wraps of the highest frequency before all frequencies repeat")

    @property
    def shortest_period_m(self) -> float:
        """Metres of range after which the phase of the highest frequency repeats."""
        return SPEED_OF_LIGHT / (2 * max(self.modulation_hz))

    @property
    def unambiguous_range_m(self) -> float:
        """Range in metres beyond which all frequencies together repeat, c / (2 gcd f), frequencies rounded to 1 kHz."""
        common = int(np.gcd.reduce([round(f / 1e3) for f in self.modulation_hz])) * 1e3
        return SPEED_OF_LIGHT / (2 * max(common, 1e3))

    @property
    def searched_m(self) -> float:
        """Path length in metres up to which decoding tells the wraps of the highest frequency apart."""
        return min(2 * self.unambiguous_range_m, 2 * MAX_RANGE_M)

    @property
    def wraps(self) -> int:
        """Number of wraps of the highest frequency within `searched_m`: the candidates of phase unwrapping."""
        return max(1, int(np.ceil(self.searched_m * max(self.modulation_hz) / SPEED_OF_LIGHT - 1e-6)))

    def responses(self) -> tuple[Response, ...]:
        return tuple(Phasor(f, self.waveform == "square") for f in self.modulation_hz)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        offset = white + ambient
        result = np.empty((self.n_frames, *offset.shape), dtype=np.float32)
        correlations = (tap for phasor in channels for tap in tap_correlations(phasor, self.contrast, self.taps))
        for frame, correlation in zip(result, correlations, strict=True):
            np.multiply(self.tap_fraction, offset + correlation, out=frame, casting="same_kind")
        return result

    @property
    def tap_fraction(self) -> float:
        """Fraction of an exposure's light that each tap collects on average.

        All are equal, because the taps divide the light and lose none.
        """
        return 1 / self.taps

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return 1 if single_tap else self.taps

    def frame_names(self) -> list[str]:
        return [f"{f / 1e6:g}MHz_{360 * k / self.taps:.4g}deg" for f in self.modulation_hz for k in range(self.taps)]

    @property
    def default_emitter(self) -> Emitter:
        return Emitter(baseline_m=TOF_BASELINE_M)

    @property
    def default_decoder(self) -> AmcwDecoder:
        return AmcwDecoder()

    @property
    def default_detector(self) -> Detector:
        """A detector of lock-in pixels."""
        return Detector.time_of_flight()

    @classmethod
    def presets(cls) -> dict[str, Sensor]:
        return {"amcw": cls()}

    def is_beyond_range(self, path_length_m: np.ndarray) -> np.ndarray:
        """(...) bool, whether a path ends beyond the last wrap that is searched, at `searched_m` or later."""
        longest_m = min(self.wraps * SPEED_OF_LIGHT / max(self.modulation_hz), 2 * self.unambiguous_range_m)
        return np.asarray(path_length_m > longest_m)

    @property
    def title(self) -> str:
        return "Time of flight (AMCW)"

    @property
    def details(self) -> str:
        megahertz = ", ".join(f"{f / 1e6:g}" for f in self.modulation_hz)
        return f"{megahertz} MHz, {self.taps} taps, {self.waveform} wave"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        """Indices of a tap of the first frequency, and of two taps of the last one."""
        last = self.taps * (len(self.modulation_hz) - 1)
        return sorted({0, last, last + 1})


@dataclass(frozen=True)
class AmcwDecoder(Decoder):
    """Decodes phase and amplitude of each frequency, and the one path length on which the phases agree.

    Parameters
    ----------
    phase : PhaseThresholds.
    correct_wiggling : bool; for a square waveform, True inverts the triangle correlation exactly (what a calibrated
        camera does with a look-up table), False uses the sine formula and shows the raw wiggling error, up to 0.011
        periods. Multipath adds triangles of different phase, for which neither is exact.
    max_residual : float, turns; a phase that is farther from the phase of the common path length contradicts it.
    max_ambiguity : float, largest misfit of the best wrap counts as a fraction of that of the second best. Above it,
        the choice between the two is a guess.
    working_range : WorkingRange, outside which readings are refused; None: all are kept.

    Examples
    --------
    >>> AmcwDecoder(correct_wiggling=False).correct_wiggling
    False
    """

    phase: PhaseThresholds = field(default_factory=PhaseThresholds)
    correct_wiggling: bool = True
    max_residual: Annotated[float, Bounds("0 or positive", 0, 1)] = 0.1
    max_ambiguity: Annotated[float, Bounds("0 or positive", 0, 1)] = 0.5
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "amcw-tof"
    reads: ClassVar[type[Sensor]] = AmcwToF

    def __post_init__(self) -> None:
        check_fields(self)

    def coordinates(self, capture: Capture) -> PathLengths:
        """Path lengths of an `AmcwToF` capture; their standard deviations are those of sine waves."""
        sensor = of_type(capture.sensor, AmcwToF)
        exact_square = sensor.waveform == "square" and self.correct_wiggling
        groups = np.split(capture.frames, len(sensor.modulation_hz))
        shape = capture.frames.shape[1:]
        status, length = np.zeros(shape, dtype=np.uint8), np.empty(shape)
        amplitude, mean = np.empty((2, *shape), dtype=np.float32)
        sigma_m = None if capture.noise(capture.frames[0, :1]) is None else np.empty(shape, dtype=np.float32)
        for rows in bands(len(status)):
            if sensor.taps == len(TAPS_DEG):
                phases = [tap_phase(taps[:, rows], exact_square) for taps in groups]
            else:
                phases = [phase_of(taps[:, rows]) for taps in groups]
            sigmas = [phase_sigma(capture, phase, sensor.taps) for phase in phases]
            weights = [_weight(*read) for read in zip(phases, sigmas, sensor.modulation_hz, strict=True)]
            unwrapped = unwrap([p.normalised for p in phases], sensor.modulation_hz, weights, sensor.searched_m)
            contradiction = unwrapped.residual > self.max_residual
            status[rows][contradiction | (unwrapped.ambiguity > self.max_ambiguity)] = Status.UNWRAPPING_FAILED
            for phase, sigma in zip(phases, sigmas, strict=True):
                status[rows][modulation_is_weak(capture, phase, sigma, self.phase)] = Status.LOW_SIGNAL
            status[rows][capture.saturated(capture.frames[:, rows])] = Status.SATURATED
            length[rows] = unwrapped.length_m
            if sigma_m is not None:
                sigma_m[rows] = RADIAN_M / np.sqrt(unwrapped.weight)
            amplitude[rows] = np.mean([p.modulation for p in phases], axis=0)
            mean[rows] = np.mean([p.mean for p in phases], axis=0)
        return PathLengths(
            length_m=length,
            sigma_m=sigma_m,
            status=status,
            confidence=2 * amplitude / capture.full_scale,
            intensity=mean - capture.black_level,
        )

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        visibility = of_type(sensor, AmcwToF).contrast * of_type(sensor, AmcwToF).tap_fraction
        least = self.phase.least_signal(of_type(sensor, AmcwToF).taps, visibility, self.content(sensor), background)
        if background.noise_variance is None:
            least = np.maximum(least, background.floor(RELATIVE_SIGNAL))
        return least

    def content(self, sensor: Sensor) -> FrameContent:
        fraction = of_type(sensor, AmcwToF).tap_fraction
        return FrameContent(signal=fraction, ambient=fraction)


def tap_correlations(phasor: np.ndarray, contrast: float, taps: int) -> Iterator[np.ndarray]:
    """Correlations (h, w) of `taps` evenly spaced taps: `contrast` times cos(phase of the light - phase of the tap).

    phasor : (2, h, w), the channel of a `Phasor`. Four taps take its triangles as well as its sines.

    Examples
    --------
    >>> import numpy as np
    >>> third = np.array([np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)])  # the phase is a third of a turn
    >>> [round(float(tap), 3) for tap in tap_correlations(third, contrast=0.5, taps=3)]
    [-0.25, 0.5, -0.25]
    """
    if taps == len(TAPS_DEG):
        for tap in TAPS_DEG:
            axis, sign = tap // 90 % 2, 1 - tap // 180 * 2  # cos or sin of the phase, and its sign
            yield sign * contrast * phasor[axis]
        return
    for k in range(taps):
        theta = 2 * math.pi * k / taps
        yield np.float32(contrast * math.cos(theta)) * phasor[0] + np.float32(contrast * math.sin(theta)) * phasor[1]


def _weight(phase: Phase, sigma: np.ndarray | None, modulation_hz: float) -> np.ndarray:
    """(h, w) float64, inverse variance of the path length by this frequency, in `RADIAN_M`^-2.

    Parameters
    ----------
    sigma : (h, w) radians, standard deviation of the phase; None: not known. Then it counts as the inverse of the
        modulation, and the weights are relative.
    """
    precision = phase.modulation if sigma is None else 1 / np.maximum(sigma, 1e-9)
    scale = np.float64(modulation_hz / WEIGHT_HZ)
    return np.asarray((scale * precision.astype(np.float64)) ** 2 + 1e-30)
