# SPDX-License-Identifier: Apache-2.0
"""Time of flight: ideal path length, AMCW (indirect) and histogram (direct)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim import limits
from rangesim.bounds import HERTZ, Bounds, Hertz, check_fields, check_number, whole
from rangesim.response import SPEED_OF_LIGHT, FirstReturn, LengthBins, Phasor, Response
from rangesim.sensors.base import Sensor

OVERSAMPLING = (1, 2, 4)
"""Bins of the transport pass per bin of a sensor with a pulse: so many that its sigma is at least one of them."""
SHARED_VARIANCE = 1 / 6
"""Mean variance in bins squared of light that is shared by two bins, which the blur leaves out."""
MAX_RANGE_M = 100.0
"""Ranges beyond are not searched by phase unwrapping, even if the frequencies were unambiguous farther out."""
TAPS = 4
"""Frames of an AMCW camera per frequency."""


@dataclass(frozen=True)
class IdealToF(Sensor):
    """Range from the path length of the first return alone: the best any time of flight sensor could do.

    Frames: `radiance` of the first return, and `radiance_x_length`, the same times its path length in metres.
    """

    type_name: ClassVar[str] = "ideal-tof"

    def responses(self) -> tuple[Response, ...]:
        return (FirstReturn(),)

    def frames(self, channels: Sequence[np.ndarray], steady: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        return np.asarray(channels[0], dtype=np.float32)

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return self.n_frames

    def frame_names(self) -> list[str]:
        return ["radiance", "radiance_x_length"]


@dataclass(frozen=True)
class AmcwToF(Sensor):
    """Amplitude-modulated continuous wave camera with four taps per frequency (0, 90, 180, 270 degrees).

    The mean of tap theta is (A + contrast * B cos(phi - theta)) / 2 with phi = 2 pi f l / c over the path length
    l (there and back); A holds steady and ambient light. Frames: frequency by frequency, four taps each.

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

    def frames(self, channels: Sequence[np.ndarray], steady: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        offset = steady + ambient
        taps = ((s * self.contrast, c[i]) for c in channels for s, i in ((1, 0), (1, 1), (-1, 0), (-1, 1)))
        result = np.empty((self.n_frames, *offset.shape), dtype=np.float32)
        for frame, (factor, phasor) in zip(result, taps, strict=True):
            np.multiply(0.5, offset + factor * phasor, out=frame, casting="same_kind")
        return result

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return 1 if single_tap else TAPS

    def frame_names(self) -> list[str]:
        return [f"{f / 1e6:g}MHz_{tap}deg" for f in self.modulation_hz for tap in (0, 90, 180, 270)]


@dataclass(frozen=True)
class DirectToF(Sensor):
    """Pulsed time of flight with a photon histogram per pixel (SPAD and TDC). Frames: the bins.

    The laser fires again as soon as the histogram is full, every `period_s`. So light that comes back later is counted
    with that of a later pulse: a wall at 1.2 times the range is a ghost at 0.2 times. Ambient light spreads evenly over
    the bins.

    Parameters
    ----------
    bins : int, number of time bins.
    bin_s : float, seconds, width of a bin.
    start_s : float, seconds, delay of the first bin after the pulse.
    pulse_fwhm_s : float, seconds, full width at half maximum of the Gaussian instrument response; 0 for none. With a
        pulse, a path is shared by the two bins next to it, so that its place within a bin is kept; bins of the pass are
        up to four times as fine where the pulse is narrow (`OVERSAMPLING`).
    laser : "periodic", or "single-shot": light that comes back after the histogram is full is lost.
    """

    bins: Annotated[int, whole(2, "bins")] = 256
    bin_s: Annotated[float, Bounds("positive and finite", 1e-15, 1e-3)] = 100e-12
    start_s: Annotated[float, Bounds("0 or positive", 1e-15, 1e-3, or_zero=True)] = 0.0
    pulse_fwhm_s: Annotated[float, Bounds("0 or positive", 1e-15, 1e-3, or_zero=True)] = 1e-9
    laser: Literal["periodic", "single-shot"] = "periodic"

    type_name: ClassVar[str] = "direct-tof"

    def __post_init__(self) -> None:
        check_fields(self)
        limits.check("bins", self.bins * self._fine, f"bins, {self._fine} of the pass for each of the sensor")
        if self.pulse_fwhm_s > self.bins * self.bin_s:
            raise ValueError(
                f"expected pulse_fwhm_s to be within the histogram of {self.bins * self.bin_s:g} s, "
                f"got {self.pulse_fwhm_s:g}."
            )

    @property
    def period_s(self) -> float:
        """Seconds from pulse to pulse."""
        return self.start_s + self.bins * self.bin_s

    @property
    def is_cyclic(self) -> bool:
        """Whether the first bin follows on the last one."""
        return self.laser == "periodic" and self.start_s == 0

    def responses(self) -> tuple[Response, ...]:
        fine, c = self._fine, SPEED_OF_LIGHT
        period_m = self.period_s * c if self.laser == "periodic" else None
        width_m, has_pulse = self.bin_s * c / fine, self.pulse_fwhm_s > 0
        return (LengthBins(self.start_s * c, width_m, self.bins * fine, period_m, is_shared=has_pulse),)

    def frames(self, channels: Sequence[np.ndarray], steady: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        from pcgraph.parallel import SMALLEST_ROWS, in_blocks
        from rangesim.histogram_filter import gaussian_filter

        variance = (self._fine * self.sigma_bins) ** 2 - SHARED_VARIANCE
        beyond: Literal["wrap", "constant"] = "wrap" if self.is_cyclic else "constant"
        fine = np.asarray(channels[0], dtype=np.float32)
        evenly = (ambient / self.bins).astype(np.float32)
        result = np.empty((self.bins, *fine.shape[1:]), dtype=np.float32)

        def of_rows(start: int, stop: int) -> None:
            for row in range(start, stop):
                histogram = fine[:, row]
                if variance > 0:
                    histogram = gaussian_filter(histogram, np.sqrt(variance), beyond)
                if self._fine > 1:
                    histogram = histogram.reshape(self.bins, self._fine, -1).sum(axis=1)
                np.add(histogram, evenly[row], out=result[:, row])

        in_blocks(of_rows, fine.shape[1], smallest=SMALLEST_ROWS)
        return result

    @property
    def sigma_bins(self) -> float:
        """Standard deviation of the pulse, in bins."""
        return float(self.pulse_fwhm_s / self.bin_s / np.sqrt(8 * np.log(2)))

    @property
    def _fine(self) -> int:
        if self.pulse_fwhm_s == 0:
            return 1
        return next((n for n in OVERSAMPLING if n * self.sigma_bins >= 1), OVERSAMPLING[-1])

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return self.n_frames

    def frame_names(self) -> list[str]:
        return [f"bin{b:04d}" for b in range(self.bins)]
