# SPDX-License-Identifier: Apache-2.0
"""Direct time of flight: a camera with a photon histogram per pixel, and the decoder that finds its strongest peak."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.histogram import coates, find_peak, place_sigma, pulses_left, runs_out, window_reach
from rangesim.decoding.path_length import PathLengths
from rangesim.decoding.status import Status
from rangesim.decoding.working_range import WorkingRange
from rangesim.electronics.detector import Gate
from rangesim.electronics.spad import SpadDetector
from rangesim.response import SPEED_OF_LIGHT, Response, TransientHistogram
from rangesim.sensor import TOF_BASELINE_M, Background, Decoder, Emitter, FrameContent, Sensor, Threshold, of_type
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields, whole

OVERSAMPLING = (1, 2, 4)
"""Numbers of bins of the transport pass per bin of a sensor with a pulse. The sensor takes the first number with which
the standard deviation of the pulse is at least one bin of the pass, or else the last number. Narrower bins would only
cost memory."""

SHARED_VARIANCE = 1 / 6
"""Mean variance, in bins squared, of light that two bins share. A path at the fraction t of the way between their
centres has the variance t (1 - t); this is the mean over t. The variance of the blur is made smaller by this value, so
that the sum is the variance of the pulse."""


@dataclass(frozen=True)
class DirectToF(Sensor):
    """Pulsed time of flight with a photon histogram per pixel (SPAD and TDC). Frames: the bins.

    The laser fires again as soon as the histogram is full, every `period_s`. So light that comes back later is counted
    with the light of a later pulse: a wall at 1.2 times the range is a ghost at 0.2 times the range. Ambient light
    spreads evenly over the bins.

    Parameters
    ----------
    bins : int, number of time bins.
    bin_s : float, seconds, width of a bin.
    start_s : float, seconds, delay of the first bin after the pulse.
    pulse_fwhm_s : float, seconds, full width at half maximum of the Gaussian instrument response, at most half of the
        histogram; 0 for none. With a pulse, a path is shared by the two bins next to it, so that its place within a bin
        is kept. The bins of the pass are up to four times as fine where the pulse is narrow (`OVERSAMPLING`).
    laser : "periodic", as described above; or "single-shot", which loses light that comes back after the last bin.

    Examples
    --------
    >>> camera = DirectToF(bins=128, bin_s=200e-12)
    >>> camera.n_frames, camera.details
    (128, '128 bins of 200 ps')
    >>> camera.is_beyond_range(np.array([7.0, 8.0]))  # metres there and back; the histogram ends at 7.67 m
    array([False,  True])
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
        if self.pulse_fwhm_s > self.bins * self.bin_s / 2:
            raise ValueError(
                f"expected pulse_fwhm_s to be at most half of the histogram of {self.bins * self.bin_s:g} s, which a "
                f"longer pulse fills evenly, got {self.pulse_fwhm_s:g}."
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
        return (TransientHistogram(self.start_s * c, width_m, self.bins * fine, period_m, is_shared=has_pulse),)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        from pcgraph.parallel import MIN_ROWS, in_blocks
        from rangesim.decoding.matched_filter import gaussian_filter

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

        in_blocks(of_rows, fine.shape[1], smallest=MIN_ROWS)
        return result

    @property
    def sigma_bins(self) -> float:
        """Standard deviation of the pulse, in bins."""
        return float(self.pulse_fwhm_s / self.bin_s / np.sqrt(8 * np.log(2)))

    @property
    def _fine(self) -> int:
        """Number of bins of the pass per bin of the sensor."""
        if self.pulse_fwhm_s == 0:
            return 1
        return next((n for n in OVERSAMPLING if n * self.sigma_bins >= 1), OVERSAMPLING[-1])

    @property
    def gate(self) -> Gate:
        return Gate(self.period_s, self.bins * self.bin_s, self.bins)

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        return self.n_frames

    def frame_names(self) -> list[str]:
        return [f"bin{b:04d}" for b in range(self.bins)]

    @property
    def default_emitter(self) -> Emitter:
        return Emitter(baseline_m=TOF_BASELINE_M)

    @property
    def default_decoder(self) -> DirectToFDecoder:
        return DirectToFDecoder()

    @property
    def default_detector(self) -> SpadDetector:
        return SpadDetector()

    def is_beyond_range(self, path_length_m: np.ndarray) -> np.ndarray:
        start_m, bins_m = self.start_s * SPEED_OF_LIGHT, self.bins * self.bin_s * SPEED_OF_LIGHT
        return np.asarray((path_length_m < start_m) | (path_length_m > start_m + bins_m))

    @property
    def title(self) -> str:
        return "Time of flight (direct)"

    @property
    def details(self) -> str:
        return f"{self.bins} bins of {self.bin_s * 1e12:g} ps"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        """Indices of the bins at the quartiles of the light."""
        energy = np.cumsum(frames.reshape(len(frames), -1).sum(axis=1, dtype=np.float64))
        return sorted({int(np.searchsorted(energy, fraction * energy[-1])) for fraction in (0.25, 0.5, 0.75)})


@dataclass(frozen=True)
class DirectToFDecoder(Decoder):
    """Decodes the path length of the strongest return of each histogram.

    Pile-up is undone if the detector has it (Coates 1968, see `coates`). A filter matched to the instrument response
    finds the peak. The centroid of the counts above the background, in a window around the peak, gives the place within
    a bin; the window is centred on the centroid once. If the end of the histogram cuts a peak off, the decoder
    completes it to a Gaussian. If the middle of that Gaussian lies outside, the reading is out of range. If the pulses
    run out within the window of the peak, the reading is saturated (see `runs_out`); less light helps.

    Parameters
    ----------
    peak_sigmas, min_counts : float, least height of a peak over the background, in standard deviations of the counts in
        its window, and in counts.
    relative_peak : float, least peak as a fraction of the bright peaks of the image, for noise-free captures.
    working_range : WorkingRange, outside which readings are refused; None: all are kept.

    Examples
    --------
    >>> DirectToFDecoder(peak_sigmas=8.0)
    DirectToFDecoder(peak_sigmas=8.0, min_counts=5.0, relative_peak=0.0001, working_range=None)
    """

    peak_sigmas: Threshold = 5.0
    min_counts: Threshold = 5.0
    relative_peak: Threshold = 1e-4
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "direct-tof"
    reads: ClassVar[type[Sensor]] = DirectToF

    def __post_init__(self) -> None:
        check_fields(self)

    def coordinates(self, capture: Capture) -> PathLengths:
        """Path lengths of a `DirectToF` capture, with standard deviations of the photons' shot noise."""
        from pcgraph.parallel import MIN_ROWS, in_blocks

        sensor = of_type(capture.sensor, DirectToF)
        height, width = capture.frames.shape[1:]
        position, peak, background, intensity = np.empty((4, height, width))
        left, pulses = np.empty((height, width), dtype=np.int64), _pulses(capture)

        def measure(start: int, stop: int) -> None:
            for row in range(start, stop):
                frames = capture.frames[:, row]
                histogram = frames.astype(np.float64) if pulses is None else coates(frames, pulses)
                found = find_peak(histogram, sensor.sigma_bins, sensor.is_cyclic)
                position[row], peak[row], background[row] = found
                if pulses is not None:
                    left[row] = pulses_left(frames, found[0], pulses, sensor.sigma_bins, sensor.is_cyclic)
                intensity[row] = frames.sum(axis=0, dtype=np.float64)

        in_blocks(measure, height, smallest=MIN_ROWS)
        length = (sensor.start_s + position * sensor.bin_s) * SPEED_OF_LIGHT
        bright = bright_level(peak)
        is_strong = peak >= self._least_counts(background) if capture.is_digital else peak > self.relative_peak * bright
        status = np.where(is_strong, Status.OK, Status.LOW_SIGNAL)
        status[is_strong & ((position < 0) | (position > sensor.bins))] = Status.OUT_OF_RANGE
        status[capture.saturated(capture.frames)] = Status.SATURATED
        sigma_m = None
        if capture.detector is not None:
            sigma_bins = place_sigma(peak, background, sensor.bins, sensor.sigma_bins, sensor.is_cyclic)
            if pulses is not None:
                status[runs_out(left, pulses)] = Status.SATURATED
                sigma_bins *= np.sqrt(pulses / np.maximum(left, 1))  # Coates' correction adds to the variance of counts
            sigma_m = sigma_bins * sensor.bin_s * SPEED_OF_LIGHT
        return PathLengths(
            length_m=length,
            sigma_m=sigma_m,
            status=status,
            confidence=peak / (bright or 1.0),
            intensity=intensity,
        )

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        if background.noise_variance is None:
            return background.floor(self.relative_peak)
        window, bins = _window_bins(of_type(sensor, DirectToF)), of_type(sensor, DirectToF).bins
        return self._least_counts(window * (background.dark + background.ambient / bins))

    def _least_counts(self, background: np.ndarray) -> np.ndarray:
        """(...) float64, counts, least height of a peak over the counts (...) of background in its window."""
        return np.asarray(np.maximum(self.min_counts, self.peak_sigmas * np.sqrt(background)))

    def content(self, sensor: Sensor) -> FrameContent:
        """Light and dark counts in the window of a peak."""
        window = _window_bins(of_type(sensor, DirectToF))
        return FrameContent(signal=1.0, ambient=window / of_type(sensor, DirectToF).bins, dark=window)


def _window_bins(sensor: DirectToF) -> int:
    """Number of bins in the window of a peak."""
    return 2 * window_reach(sensor.bins, sensor.sigma_bins, sensor.is_cyclic) + 1


def _pulses(capture: Capture) -> int | None:
    """Number of pulses in the exposure, if only the first photon of each was counted; None without pile-up."""
    if isinstance(capture.detector, SpadDetector) and capture.detector.pile_up:
        return capture.detector.pulses(capture.sensor.gate, capture.exposure_s)
    return None
