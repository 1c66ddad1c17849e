# SPDX-License-Identifier: Apache-2.0
"""AMCW (indirect) time of flight: a camera with several taps per modulation frequency, and its decoder."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding.path_length import PathLengths
from rangesim.decoding.phase_shift import Phase, PhaseThresholds, modulation_is_weak, phase_of, phase_sigma, tap_phase
from rangesim.decoding.phase_unwrapping import unwrap
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.decoding.tap_checks import (
    chosen,
    clipping_level,
    direction_contradiction,
    frame_contradiction,
    frequency_contradiction,
    order_contradiction,
    signed_readings,
)
from rangesim.decoding.two_paths import nearest_length, order_of_ratios, separate, turns_sigma
from rangesim.decoding.working_range import WorkingRange
from rangesim.electronics.detector import Detector
from rangesim.errors import DoubtWarning, warn
from rangesim.response import SPEED_OF_LIGHT, Correlation, Phasor, Response
from rangesim.sensor import TOF_BASELINE_M, Background, Decoder, Emitter, FrameContent, ReceivedLight, Sensor, of_type
from rangesim.settings import limits
from rangesim.settings.bounds import HERTZ, Bounds, Hertz, Pause, check_fields, check_number

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


END_SIGMAS = 3.0
"""Distance of a path length from the ends of the unambiguous range, in standard deviations, below which the reading is
refused, because the other end is as likely. Noise reaches it in one of 700 pixels whose surface lies at an end."""

Contrast = Annotated[float, Bounds("a positive fraction", 1e-3, 1)]
"""Demodulation contrast: modulation of the taps as a fraction of their mean, for light of one path."""


@dataclass(frozen=True)
class AmcwToF(Sensor):
    """Amplitude-modulated continuous wave camera with evenly spaced taps, by default four (0, 90, 180, 270 degrees).

    By default the N taps of a pixel share the light of one exposure. The mean of tap theta is (A + contrast * B cos(phi
    - theta)) / N with phi = 2 pi f l / c over the path length l (there and back); A is the white and the ambient light.
    So the taps add up to A. Frames: frequency by frequency, `taps` each, by their phase.

    A pixel with fewer charge stores takes several exposures, see `taps_per_exposure`. Then each tap collects 1 / (taps
    of an exposure) of A, and the standard deviation of the phase by shot noise is sqrt(2 / (exposures A)) / contrast,
    with A in electrons of one exposure: light that is collected for as long gives the same noise with any pixel, but
    for the read noise.

    Parameters
    ----------
    modulation_hz : tuple of floats, hertz; or one float.
    contrast : float in (0, 1], demodulation contrast.
    waveform : "sine", or "square" for a square source against a square reference. The correlation is then a triangle,
        and a decoder that takes it for a sine has a periodic error, the "wiggling". It needs four taps.
    taps : number of taps of each frequency, at 0, 360 / taps, ... degrees of its phase. Kinect v2 has 3.
    taps_per_exposure : number of taps that share the light of one exposure; it divides `taps`. The taps of an exposure
        are evenly spaced, for example 0 and 180 degrees of the two-tap pixels of Melexis and EPC. None: all of them
        share it. 1: a pixel that stores the charge of one half of the period and drains that of the other.
    contrasts : demodulation contrast of each frequency, which takes the place of `contrast`; (): the same for all. It
        falls with the frequency, for example from 0.87 at 200 MHz to 0.78 at 320 MHz (Bamji et al., ISSCC 2018).
    correlation : Correlation, the measured one of source and reference; None: a sine, or what `waveform` says. Of the
        harmonics whose order is a multiple of `taps_per_exposure`, nothing is left, because the taps divide the light.
    pixel_delay_s : seconds, standard deviation of the delay of a pixel's reference, a fixed pattern. A pixel reads
        surfaces too far by delay * c / 2, at all frequencies.
    pixel_seed : seed of that pattern, the number of the device.

    Examples
    --------
    >>> camera = AmcwToF((20e6, 80e6))
    >>> round(camera.shortest_period_m, 2), round(camera.unambiguous_range_m, 2)  # of 80 MHz, and of both together
    (1.87, 7.49)
    >>> AmcwToF(50e6, waveform="square").details
    '50 MHz, 4 taps, square wave'
    """

    modulation_hz: tuple[Hertz, ...] = (20e6, 80e6, 100e6)
    contrast: Contrast = 0.8
    waveform: Literal["sine", "square"] = "sine"
    taps: Annotated[int, Bounds("a number of taps", 3, MAX_TAPS)] = len(TAPS_DEG)
    taps_per_exposure: Annotated[int, Bounds("a number of taps", 1, MAX_TAPS)] | None = None
    contrasts: tuple[Contrast, ...] = ()
    correlation: Correlation | None = None
    pixel_delay_s: Pause = 0.0
    pixel_seed: Annotated[int, Bounds("a seed", 0, 2**32 - 1)] = 0

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
        if self.taps % self.sharing:
            raise ValueError(
                f"expected taps_per_exposure to divide the {self.taps} taps evenly, got {self.taps_per_exposure}."
            )
        if self.contrasts and len(self.contrasts) != len(self.modulation_hz):
            raise ValueError(
                f"expected contrasts of {len(self.modulation_hz)} frequencies as modulation_hz, or none, "
                f"got {len(self.contrasts)}."
            )
        if self.waveform == "square" and (self.correlation is not None or self.pixel_delay_s):
            raise ValueError("expected a sine waveform with a correlation or a pixel_delay_s, got a square one.")
        self._check_correlation()
        limits.check("frequencies", len(self.modulation_hz), "frequencies in modulation_hz")
        limits.check("wraps", self.wraps, "wraps of the highest frequency before all frequencies repeat")

    def _check_correlation(self) -> None:
        """Raise ValueError if a tap would collect less than no light, or if phases would not grow with the range."""
        if self.correlation is None:
            return
        turns = np.arange(1024) / 1024
        most = float(np.abs(self.correlation.values(turns)).max() * max(self.contrast_of_each))
        if most > 1 + 1e-9:
            raise ValueError(
                f"expected a contrast times correlation of at most 1, because taps collect no negative light, "
                f"got {most:g}."
            )
        if not (np.diff(self.correlation.read_by(self.taps, turns)) > 0).all():
            raise ValueError(
                f"expected a correlation whose phase, read by {self.taps} taps, grows with the path length; the "
                "amplitudes of its harmonics are too large."
            )

    @property
    def sharing(self) -> int:
        """Number of taps that share the light of an exposure."""
        return self.taps if self.taps_per_exposure is None else self.taps_per_exposure

    @property
    def contrast_of_each(self) -> tuple[float, ...]:
        """Demodulation contrast of each frequency."""
        return self.contrasts or (self.contrast,) * len(self.modulation_hz)

    @property
    def _orders(self) -> tuple[int, ...]:
        """Orders of the harmonics that reach the taps, the first one included."""
        others = self.correlation.orders if self.correlation is not None else ()
        return (1, *(k for k in others if self.sharing == 1 or k % self.sharing))

    def harmonics(self, turns: np.ndarray) -> np.ndarray:
        """(taps, n) float64, what the correlation's harmonics add to taps at phases (n,) in turns, as fractions of the
        amplitude of the first one."""
        delays = turns - np.arange(self.taps)[:, None] / self.taps
        added = np.zeros(delays.shape)
        for order in self._orders[1:]:
            assert self.correlation is not None  # the only one with more orders
            added += (self.correlation.coefficient(order) * np.exp(2j * np.pi * order * delays)).real
        return added

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
        return tuple(Phasor(f * k, self.waveform == "square") for f in self.modulation_hz for k in self._orders)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        offset = white + ambient
        result = np.empty((self.n_frames, *offset.shape), dtype=np.float32)
        for frame, correlation in zip(result, self._correlations(channels), strict=True):
            np.multiply(self.tap_fraction, offset + correlation, out=frame, casting="same_kind")
        return result

    def _correlations(self, channels: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
        """Correlations (h, w) of all frames, W/m2/sr."""
        n = len(self._orders)
        for i, contrast in enumerate(self.contrast_of_each):
            phasors = channels[n * i : n * (i + 1)]
            if self.correlation is None or n == 1:
                yield from tap_correlations(phasors[0], contrast, self.taps)
                continue
            for k in range(self.taps):
                yield sum(
                    _projected(phasor, contrast * self.correlation.coefficient(order), order * k / self.taps)
                    for phasor, order in zip(phasors, self._orders, strict=True)
                )  # type: ignore[misc]

    def at_pixels(self, frames: np.ndarray) -> np.ndarray:
        if not self.pixel_delay_s:
            return frames
        rng = np.random.default_rng(self.pixel_seed)
        delay_s = self.pixel_delay_s * rng.standard_normal(frames.shape[1:])
        result = np.empty_like(frames)
        for group, out, f in zip(
            np.split(frames, len(self.modulation_hz)),
            np.split(result, len(self.modulation_hz)),
            self.modulation_hz,
            strict=True,
        ):
            delay_taps(group, 2 * np.pi * f * delay_s, out)
        return result

    @property
    def tap_fraction(self) -> float:
        """Fraction of an exposure's light that each tap collects on average.

        The taps of an exposure divide its light and lose none. A pixel with a single tap drains the other half.
        """
        return 1 / max(self.sharing, 2)

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return 1 if single_tap else self.sharing

    def exposure_of_frames(self, single_tap: bool = False) -> np.ndarray:
        frame = np.arange(self.n_frames)
        if single_tap:
            return frame
        exposures = self.taps // self.sharing
        return np.asarray(frame // self.taps * exposures + frame % self.taps % exposures)

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
        wave = f"{self.waveform} wave" if self.correlation is None else "measured correlation"
        exposures = self.taps // self.sharing
        return f"{megahertz} MHz, {self.taps} taps{f' in {exposures} exposures' * (exposures > 1)}, {wave}"

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
    correct_wiggling : bool; for a square waveform or a measured correlation, True inverts it exactly (what a calibrated
        camera does with a look-up table), False uses the sine formula and shows the raw wiggling error, of a square
        waveform up to 0.011 periods. Multipath adds light of different phase, for which neither is exact.
    max_residual : float, turns; a phase that is farther from the phase of the common path length contradicts it.
    max_ambiguity : float, largest misfit of the best wrap counts as a fraction of that of the second best. Above it,
        the choice between the two is a guess.
    two_paths : bool, whether light of a second path is separated from that of the stronger one, see
        `rangesim.decoding.two_paths`. It needs the frequencies f, 2 f and 3 f, and pays in noise where it finds a
        second path; elsewhere the reading stays as it is.
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
    two_paths: bool = False
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "amcw-tof"
    reads: ClassVar[type[Sensor]] = AmcwToF

    def __post_init__(self) -> None:
        check_fields(self)

    def check(self, sensor: Sensor) -> None:
        super().check(sensor)
        amcw = of_type(sensor, AmcwToF)
        if self.two_paths and (amcw.waveform != "sine" or order_of_ratios(amcw.modulation_hz) is None):
            raise ValueError(
                f"expected sine waves of three frequencies f, 2 f and 3 f to separate two paths, got {amcw.details}."
            )

    def coordinates(self, capture: Capture) -> PathLengths:
        """Path lengths of an `AmcwToF` capture; their standard deviations are those of sine waves.

        `RangesimWarning` if the taps contradict each other as a whole.
        """
        lengths, amplitude = self._lengths(capture)
        sensor = of_type(capture.sensor, AmcwToF)
        doubt = self._contradiction(sensor, capture, lengths.status, lengths.length_m, amplitude)
        if doubt:
            warn(doubt, DoubtWarning)
        return replace(lengths, doubts=(doubt,) if doubt else ())

    def pixel_reader(self, sensor: Sensor) -> Callable[[Capture], PathLengths] | None:
        """A reader of pixels, see `Decoder.pixel_reader`; None if delays depend on the place of a pixel."""
        return None if of_type(sensor, AmcwToF).pixel_delay_s else lambda capture: self._lengths(capture)[0]

    def _lengths(self, capture: Capture) -> tuple[PathLengths, np.ndarray]:
        """The path lengths, and the modulation (h, w) float32 averaged over the frequencies."""
        self.check(capture.sensor)
        sensor = of_type(capture.sensor, AmcwToF)
        groups = np.split(capture.frames, len(sensor.modulation_hz))
        shape = capture.frames.shape[1:]
        status, length = np.zeros(shape, dtype=np.uint8), np.empty(shape)
        amplitude, mean = np.empty((2, *shape), dtype=np.float32)
        sigma_m = None if capture.noise(capture.frames[0, :1]) is None else np.empty(shape, dtype=np.float32)
        level = clipping_level(capture.frames) if capture.is_digital and capture.detector is None else None
        for rows in bands(len(status)):
            phases = [self._phase(sensor, taps[:, rows]) for taps in groups]
            sigmas = [phase_sigma(capture, phase, sensor.taps) for phase in phases]
            weights = [_weight(*read) for read in zip(phases, sigmas, sensor.modulation_hz, strict=True)]
            unwrapped = unwrap([p.normalised for p in phases], sensor.modulation_hz, weights, sensor.searched_m)
            contradiction = unwrapped.residual > self.max_residual
            status[rows][contradiction | (unwrapped.ambiguity > self.max_ambiguity)] = Status.UNWRAPPING_FAILED
            for phase, sigma in zip(phases, sigmas, strict=True):
                status[rows][modulation_is_weak(capture, phase, sigma, self.phase)] = Status.LOW_SIGNAL
            status[rows][capture.saturated(capture.frames[:, rows])] = Status.SATURATED
            if level is not None:
                status[rows][capture.frames[:, rows].max(axis=0) >= level] = Status.SATURATED
            length[rows] = unwrapped.length_m
            if sigma_m is not None:
                sigma_m[rows] = RADIAN_M / np.sqrt(unwrapped.weight)
                at_end = _is_at_end(length[rows], sigma_m[rows], sensor) & (status[rows] == Status.OK)
                status[rows][at_end] = Status.UNWRAPPING_FAILED
            if self.two_paths:
                _separate(sensor, phases, sigmas, length[rows], None if sigma_m is None else sigma_m[rows])
            amplitude[rows] = np.mean([p.modulation for p in phases], axis=0)
            mean[rows] = np.mean([p.mean for p in phases], axis=0)
        lengths = PathLengths(
            length_m=length,
            sigma_m=sigma_m,
            status=status,
            confidence=2 * amplitude / capture.full_scale,
            intensity=mean - capture.black_level,
        )
        return lengths, amplitude

    def depth_error_m(self, sensor: Sensor, light: ReceivedLight) -> np.ndarray | None:
        """The noise of the phases by shot noise and read noise, averaged over the frequencies by their precision, and
        the delays of the pixels; None for correlations that are no sine, and for two paths.

        Of N taps with mean q A and amplitude B = q C S, where q is the fraction of an exposure's light that a tap gets,
        a phase has the standard deviation sqrt(2 / N) sigma / B. The shot noise of three taps depends on the phase too:
        sigma^2 has a term -B / 2 cos(3 phase), which the decoder, who averages by precision, does not know.

        References
        ----------
        Lange: "3D time-of-flight distance measurement with custom solid-state image sensors in CMOS/CCD technology",
        thesis, Siegen (2000).
        """
        amcw = of_type(sensor, AmcwToF)
        if amcw.waveform != "sine" or amcw.correlation is not None or self.two_paths:
            return None
        q = amcw.tap_fraction
        even_e2 = q * (light.emitter + light.ambient) + light.own_variance
        precision, weighted = np.zeros((2, *light.emitter.shape))
        for hertz, contrast in zip(amcw.modulation_hz, amcw.contrast_of_each, strict=True):
            radians_per_m = 2 * np.pi * hertz / SPEED_OF_LIGHT
            amplitude_e = q * contrast * light.emitter
            third = amplitude_e / 2 * np.cos(3 * radians_per_m * light.path_length_m) if amcw.taps == 3 else 0.0
            of_one = amcw.taps / 2 * (radians_per_m * amplitude_e) ** 2 / even_e2
            precision += of_one
            weighted += of_one * (even_e2 - third) / even_e2
        with np.errstate(divide="ignore", invalid="ignore"):
            variance_m2 = weighted / precision**2 + (amcw.pixel_delay_s * SPEED_OF_LIGHT) ** 2
        return np.asarray(np.sqrt(variance_m2) * np.abs(light.per_length))

    def _contradiction(
        self, sensor: AmcwToF, capture: Capture, status: np.ndarray, length_m: np.ndarray, modulation: np.ndarray
    ) -> str | None:
        """A sentence if the taps contradict each other as a whole, see `rangesim.decoding.tap_checks`."""
        frames = capture.frames
        if capture.is_digital and (found := frame_contradiction(frames, sensor.frame_names())):
            return found
        at = chosen(np.isin(status, [Status.OK, Status.UNWRAPPING_FAILED]))
        if at is None:
            return None
        taps = frames.reshape(len(frames), -1)[:, at]
        if found := self._disagreement(sensor, taps.astype(np.float32)):
            largest = int(np.iinfo(frames.dtype).max) if capture.is_digital else 0
            if largest and any(self._disagreement(sensor, t) is None for t in signed_readings(taps, largest)):
                return (
                    "the taps agree with each other if their numbers are read with a sign, in two's complement, and "
                    "not as they were: the ranges are wrong; give --bits with an s, such as s16."
                )
            return found
        at = at[status.ravel()[at] == Status.OK]
        # Of several frequencies, the phases would disagree.
        starts = sensor.taps if len(sensor.modulation_hz) == 1 else 1
        period_m = 2 * sensor.unambiguous_range_m
        return direction_contradiction(length_m.ravel()[at], modulation.ravel()[at], period_m, starts)

    def _disagreement(self, sensor: AmcwToF, taps: np.ndarray) -> str | None:
        """A sentence if taps (k, n) lie on no cosines, or the phases of the frequencies on no length; None if not."""
        groups = np.split(taps, len(sensor.modulation_hz))
        phases = [self._phase(sensor, group) for group in groups]
        read = zip(groups, phases, strict=True)
        if found := order_contradiction([g - p.modulation * sensor.harmonics(p.normalised) for g, p in read]):
            return found
        weights = [_weight(*read) for read in zip(phases, [None] * len(phases), sensor.modulation_hz, strict=True)]
        return frequency_contradiction(phases, sensor.modulation_hz, weights, sensor.searched_m, sensor.taps)

    def _phase(self, sensor: AmcwToF, taps: np.ndarray) -> Phase:
        """Phase of the taps (N, h, w) of one frequency."""
        if sensor.taps == len(TAPS_DEG):
            phase = tap_phase(taps, sensor.waveform == "square" and self.correct_wiggling)
        else:
            phase = phase_of(taps)
        if sensor.correlation is None or not self.correct_wiggling:
            return phase
        return replace(phase, normalised=sensor.correlation.corrected(sensor.taps, phase.normalised))

    def undetectable(self, sensor: Sensor) -> str | None:
        range_m = of_type(sensor, AmcwToF).unambiguous_range_m
        return f"surfaces beyond {range_m:.4g} m would be read too near by that or a multiple of it, and no frame tells"

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        visibility = min(of_type(sensor, AmcwToF).contrast_of_each) * of_type(sensor, AmcwToF).tap_fraction
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


def _projected(phasor: np.ndarray, coefficient: complex, turns: float) -> np.ndarray:
    """(h, w) float32, the real part of `coefficient` times a phasor (2, h, w) that is turned back by `turns`."""
    c = coefficient * np.exp(-2j * math.pi * turns)
    return np.asarray(np.float32(c.real) * phasor[0] - np.float32(c.imag) * phasor[1])


def delay_taps(taps: np.ndarray, angle: np.ndarray, out: np.ndarray) -> None:
    """Write taps whose phase is later by an angle to `out`.

    It turns the first harmonic of the taps, which is all of a sine; of other harmonics, it also turns the part that the
    taps cannot tell from the first one.

    Parameters
    ----------
    taps : (N, h, w) float, evenly spaced. angle : (h, w) float, radians. out : (N, h, w) float32.

    Examples
    --------
    >>> theta = np.deg2rad([0, 90, 180, 270])[:, None, None]
    >>> out = np.empty((4, 1, 1), np.float32)
    >>> delay_taps(5 + 2 * np.cos(0.3 - theta), np.full((1, 1), 0.2), out)
    >>> bool(np.abs(out - (5 + 2 * np.cos(0.5 - theta))).max() < 1e-6)
    True
    """
    n = len(taps)
    theta = 2 * math.pi * np.arange(n) / n
    cosine = np.tensordot(np.cos(theta), taps, axes=1) * (2 / n)
    sine = np.tensordot(np.sin(theta), taps, axes=1) * (2 / n)
    turned = np.cos(angle) - 1, np.sin(angle)
    more_cosine, more_sine = cosine * turned[0] - sine * turned[1], sine * turned[0] + cosine * turned[1]
    for tap, result, t in zip(taps, out, theta, strict=True):
        result[:] = tap + math.cos(t) * more_cosine + math.sin(t) * more_sine


def _is_at_end(length_m: np.ndarray, sigma_m: np.ndarray, sensor: AmcwToF) -> np.ndarray:
    """(h, w) bool, where noise may have moved a path length (h, w), metres, across the end of the range to its start,
    or back: it is nearer to one of them than `END_SIGMAS`."""
    period_m = 2 * sensor.unambiguous_range_m
    if period_m > sensor.searched_m:
        return np.zeros(length_m.shape, dtype=bool)
    return np.asarray(np.minimum(length_m, period_m - length_m) < END_SIGMAS * sigma_m)


def _separate(
    sensor: AmcwToF,
    phases: list[Phase],
    sigmas: list[np.ndarray | None],
    length_m: np.ndarray,
    sigma_m: np.ndarray | None,
) -> None:
    """Replace path lengths (h, w), metres, and their standard deviations where light of two paths is found."""
    order = order_of_ratios(sensor.modulation_hz)
    assert order is not None  # `AmcwDecoder.check`
    phasors, noise = [], []
    for i in order:
        phase, sigma, contrast = phases[i], sigmas[i], sensor.contrast_of_each[i]
        light = phase.modulation.astype(np.float64) / contrast
        phasors.append(light * np.exp(2j * np.pi * phase.normalised.astype(np.float64)))
        noise.append(light * sigma if sigma is not None else np.zeros(light.shape))
    found = separate(phasors, None if sigma_m is None else noise)
    slowest_hz = sensor.modulation_hz[order[0]]
    length_m[found.found] = nearest_length(found.turns, length_m, slowest_hz)[found.found]
    if sigma_m is not None:
        turns = turns_sigma(phasors, noise, found.turns)
        sigma_m[found.found] = (SPEED_OF_LIGHT / slowest_hz * turns)[found.found]


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
