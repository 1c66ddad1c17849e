# SPDX-License-Identifier: Apache-2.0
"""Direct time of flight: a camera with a photon histogram per pixel, and the decoder that finds its returns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.centroid_error import PulseCounts, centroid_error
from rangesim.decoding.histogram import (
    find_peak,
    pile_up_excess,
    place_sigma,
    runs_out,
    trials_left,
    undo_pile_up,
    window_reach,
)
from rangesim.decoding.path_length import LengthReturns, PathLengths
from rangesim.decoding.returns import PulseShape, ReturnRules, find_returns
from rangesim.decoding.status import Status
from rangesim.decoding.working_range import WorkingRange
from rangesim.electronics.detector import Gate
from rangesim.electronics.spad import SpadDetector
from rangesim.response import SPEED_OF_LIGHT, Pulse, Response, TransientHistogram
from rangesim.sensor import (
    TOF_BASELINE_M,
    Background,
    Decoder,
    Emitter,
    FrameContent,
    ReceivedLight,
    Sensor,
    Threshold,
    of_type,
)
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, Fraction, check_fields, whole

OVERSAMPLING = (1, 2, 4)
"""Numbers of bins of the transport pass per bin of a sensor with a pulse. The sensor takes the first number with which
the standard deviation of the pulse is at least one bin of the pass, or else the last number. Narrower bins would only
cost memory."""

TOGETHER = 1024
"""Number of pixels whose histograms are worked on together: with 256 bins, 1 MB in single precision, which stays in a
core's cache. With 160 pixels, filtering takes twice as long, because fewer pixels fill the filter's tiles less well."""

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
    start_s : float, seconds, delay of the first bin after the pulse. It is negative where bins begin before the pulse
        leaves, as in devices whose histogram also shows their cover glass; `zeroed` measures it.
    pulse_fwhm_s : float, seconds, full width at half maximum of the Gaussian instrument response, at most half of the
        histogram; 0 for none. With a pulse, a path is shared by the two bins next to it, so that its place within a bin
        is kept. The bins of the pass are up to four times as fine where the pulse is narrow (`OVERSAMPLING`).
    pulse : Pulse, a measured instrument response, which takes the place of the Gaussian (`pulse_fwhm_s` is then not
        used); None: the Gaussian.
    laser : "periodic", as described above; or "single-shot", which loses light that comes back after the last bin.

    Examples
    --------
    >>> camera = DirectToF(bins=128, bin_s=200e-12)
    >>> camera.n_frames, camera.details
    (128, '128 bins of 200 ps')
    >>> camera.is_beyond_range(np.array([7.0, 8.0]))  # metres there and back; the histogram ends at 7.67 m
    array([False,  True])

    A pulse with a tail, as a SPAD's, measured in samples of 91 ps:

    >>> from rangesim.response import Pulse
    >>> tail = DirectToF(bins=128, bin_s=91e-12, pulse=Pulse((2.0, 230.0, 212.0, 81.0, 28.0, 11.0, 6.0), 91e-12))
    >>> round(tail.sigma_bins, 2)
    0.87
    """

    bins: Annotated[int, whole(2, "bins")] = 256
    bin_s: Annotated[float, Bounds("positive and finite", 1e-15, 1e-3)] = 100e-12
    start_s: Annotated[float, Bounds("a time in seconds", -1e-3, 1e-3)] = 0.0
    pulse_fwhm_s: Annotated[float, Bounds("0 or positive", 1e-15, 1e-3, or_zero=True)] = 1e-9
    laser: Literal["periodic", "single-shot"] = "periodic"
    pulse: Pulse | None = None

    type_name: ClassVar[str] = "direct-tof"

    def __post_init__(self) -> None:
        check_fields(self)
        limits.check("bins", self.bins * self._fine, f"bins, {self._fine} of the pass for each of the sensor")
        open_s = self.bins * self.bin_s
        if self.pulse is None and self.pulse_fwhm_s > open_s / 2:
            raise ValueError(
                f"expected pulse_fwhm_s to be at most half of the histogram of {open_s:g} s, which a "
                f"longer pulse fills evenly, got {self.pulse_fwhm_s:g}."
            )
        if self.pulse is not None and self.pulse.stop_s - self.pulse.start_s > open_s * (1 + 1e-9):
            raise ValueError(
                f"expected a pulse of at most {open_s:g} s, the length of the histogram, "
                f"got one of {self.pulse.stop_s - self.pulse.start_s:g} s."
            )
        if self.start_s < -open_s:
            raise ValueError(
                f"expected start_s of at least {-open_s:g}, with the pulse in the histogram, got {self.start_s:g}."
            )

    @property
    def period_s(self) -> float:
        """Seconds from pulse to pulse."""
        return max(self.start_s, 0.0) + self.bins * self.bin_s

    @property
    def is_cyclic(self) -> bool:
        """Whether the first bin follows on the last one."""
        return self.laser == "periodic" and self.start_s <= 0

    def responses(self) -> tuple[Response, ...]:
        fine, c = self._fine, SPEED_OF_LIGHT
        period_m = self.period_s * c if self.laser == "periodic" else None
        width_m, has_pulse = self.bin_s * c / fine, self.pulse is not None or self.pulse_fwhm_s > 0
        return (TransientHistogram(self.start_s * c, width_m, self.bins * fine, period_m, is_shared=has_pulse),)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        from pcgraph.parallel import in_blocks
        from rangesim.decoding.matched_filter import gaussian_filter

        sigma_bins = 0.0 if self.pulse is not None else self._fine * self.sigma_bins
        variance, measured = sigma_bins**2 - SHARED_VARIANCE, self._blur()
        beyond: Literal["wrap", "constant"] = "wrap" if self.is_cyclic else "constant"
        fine = np.asarray(channels[0], dtype=np.float32).reshape(len(channels[0]), -1)
        evenly = (ambient / self.bins).astype(np.float32).ravel()
        if measured is None and self._fine == 1:
            result = gaussian_filter(fine, np.sqrt(variance), beyond) if variance > 0 else fine.copy()
            if evenly.any():
                result += evenly
            return result.reshape(self.bins, *ambient.shape)
        result = np.empty((self.bins, len(evenly)), dtype=np.float32)

        def of_pixels(start: int, stop: int) -> None:
            for some in _together(start, stop):
                histogram = fine[:, some]
                if measured is not None:
                    histogram = measured(histogram)
                elif variance > 0:
                    histogram = gaussian_filter(histogram, np.sqrt(variance), beyond)
                histogram = histogram.reshape(self.bins, self._fine, -1).sum(axis=1)
                np.add(histogram, evenly[some], out=result[:, some])

        in_blocks(of_pixels, len(evenly))
        return result.reshape(self.bins, *ambient.shape)

    def _blur(self) -> Callable[[np.ndarray], np.ndarray] | None:
        """Convolution of histograms (k, n) of the pass with the measured pulse; None without one.

        A kernel's value is the pulse's light within a bin of the pass, so what a path at the middle of such a bin
        brings to each bin is exact. The light of other paths is shared by two bins, which interpolates linearly.
        """
        if self.pulse is None:
            return None
        width_s, bins = self.bin_s / self._fine, self.bins * self._fine
        first, last = int(np.floor(self.pulse.start_s / width_s)), int(np.ceil(self.pulse.stop_s / width_s))
        edges = np.arange(first, last + 2) - 0.5
        kernel, at = np.diff(self.pulse.arrived(edges * width_s)), np.arange(first, last + 1)
        size = bins if self.is_cyclic else 1 << int(np.ceil(np.log2(2 * bins + len(kernel))))
        wrapped = np.zeros(size)
        np.add.at(wrapped, at % size, kernel)
        spectrum = np.fft.rfft(wrapped)[:, None]

        def blurred(histogram: np.ndarray) -> np.ndarray:
            result = np.fft.irfft(np.fft.rfft(histogram.astype(np.float64), size, axis=0) * spectrum, size, axis=0)
            return np.maximum(result[:bins], 0.0)  # rounding may make an empty bin negative

        return blurred

    @property
    def sigma_bins(self) -> float:
        """Standard deviation of the Gaussian pulse, in bins; for a measured pulse, `PulseShape.sigma`."""
        if self.pulse is not None:
            return self.shape.sigma
        return float(self.pulse_fwhm_s / self.bin_s / np.sqrt(8 * np.log(2)))

    @cached_property
    def shape(self) -> PulseShape:
        """The pulse's shape in bins, as decoders use it."""
        return (
            PulseShape.gaussian(self.sigma_bins) if self.pulse is None else PulseShape.measured(self.pulse, self.bin_s)
        )

    def zeroed(self, reference: np.ndarray, path_m: float = 0.0) -> DirectToF:
        """This sensor with the `start_s` that the histogram of a reference SPAD tells.

        A reference SPAD stands beside the emitter, behind the cover glass, and is timed like the pixels. Its pulse
        tells when the emitter fired, so that delays in the electronics, and their drift, drop out.

        Parameters
        ----------
        reference : (bins,) counts of the reference SPAD.
        path_m : float, metres, optical length from the emitter to the reference SPAD.

        Raises
        ------
        ValueError
            Another number of counts, or no pulse in them.

        Examples
        --------
        >>> sensor = DirectToF(bins=64, pulse_fwhm_s=250e-12)
        >>> edges = np.arange(65) - 14.0  # the emitter fires at the end of bin 13
        >>> reference = 1e4 * np.diff(PulseShape.gaussian(sensor.sigma_bins).arrived_at(edges))
        >>> round(sensor.zeroed(reference).start_s * 1e12)
        -1400
        """
        counts = np.asarray(reference, dtype=np.float64)
        if counts.shape != (self.bins,):
            raise ValueError(f"expected a reference of {self.bins} counts, one for each bin, got shape {counts.shape}.")
        found = find_returns(counts[:, None], self.shape, ReturnRules(1, 5.0, 1.0, 0.0))
        place = float(found.place[0, 0])
        if not 0 <= place <= self.bins:
            raise ValueError("expected a pulse in the histogram of the reference SPAD, found none.")
        return replace(self, start_s=path_m / SPEED_OF_LIGHT - place * self.bin_s)

    @property
    def _fine(self) -> int:
        """Number of bins of the pass per bin of the sensor."""
        if self.pulse is not None:
            return OVERSAMPLING[-1]
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
    """Decodes the path length of one return of each histogram, by default the strongest, and further returns if asked.

    Pile-up is undone if the detector has it (Coates 1968, see `coates`). A filter matched to the instrument response
    finds the peak.

    By default one peak is looked for. The centroid of the counts above the background, in a window around the peak,
    gives the place within a bin; the window is centred on the centroid once. If the end of the histogram cuts a peak
    off, the decoder completes it to a Gaussian. If the middle of that Gaussian lies outside, the reading is out of
    range.

    If the sensor has a measured pulse, or if `max_returns` or `min_range_m` asks for more, pulses of the sensor's shape
    are fitted instead (maximum likelihood, see `find_returns`), and `RangeImage.returns` holds all of them.

    If the pulses of the laser run out within the window of a peak, the reading is saturated (see `runs_out`); less
    light helps.

    Parameters
    ----------
    peak_sigmas, min_counts : float, least height of a peak over the background: s standard deviations of the counts in
        its window and s^2 / 4 counts, because small counts stray farther upwards, and so many counts.
    relative_peak : float, least peak as a fraction of the bright peaks of the image, for noise-free captures.
    reading : return that the range image holds: "strongest", "first" (nearest) or "last" (farthest).
    max_returns : int from 1 to 16, largest number of returns of a pixel; the strongest ones are found. "first" and
        "last" need at least 2.
    pulse_tolerance : float in 0..1, least strength of a return as a fraction of the light that other returns bring to
        its place, because the shape of a pulse is not known better. A larger value takes weak returns close behind
        strong ones for errors of the pulse's shape.
    min_range_m : float, metres, distance (half of the path length) up to which returns belong to the device's cover
        glass: they are kept among the returns, as OUT_OF_RANGE, but no reading is made of them. 0: no cover glass.
    cover_glass_counts : float, strength of the cover glass's return, in counts, as a capture without a target shows it.
        A pixel without a target is OUT_OF_RANGE if its return within `min_range_m` is stronger than that by
        `peak_sigmas`, because a target must be in there; otherwise it is LOW_SIGNAL. With 0, every such pixel is
        OUT_OF_RANGE.
    working_range : WorkingRange, outside which readings are refused; None: all are kept. It does not change the list of
        returns.

    Examples
    --------
    >>> DirectToFDecoder(peak_sigmas=8.0).reading
    'strongest'
    >>> dual = DirectToFDecoder(reading="last", max_returns=2)  # strongest and last, as LiDARs with two returns do
    >>> DirectToFDecoder(reading="last")
    Traceback (most recent call last):
    ValueError: expected max_returns of at least 2 for the last return, got 1.
    """

    peak_sigmas: Threshold = 5.0
    min_counts: Threshold = 5.0
    relative_peak: Threshold = 1e-4
    reading: Literal["strongest", "first", "last"] = "strongest"
    max_returns: Annotated[int, Bounds("a number of returns", 1, 16)] = 1
    pulse_tolerance: Fraction = 0.1
    min_range_m: Annotated[float, Bounds("0 or positive", 0, 1e6)] = 0.0
    cover_glass_counts: Annotated[float, Bounds("0 or positive", 0, 1e15)] = 0.0
    working_range: WorkingRange | None = None

    type_name: ClassVar[str] = "direct-tof"
    reads: ClassVar[type[Sensor]] = DirectToF

    def __post_init__(self) -> None:
        check_fields(self)
        if self.reading != "strongest" and self.max_returns < 2:
            raise ValueError(
                f"expected max_returns of at least 2 for the {self.reading} return, got {self.max_returns}."
            )

    def coordinates(self, capture: Capture) -> PathLengths:
        """Path lengths of a `DirectToF` capture, with standard deviations of the photons' shot noise."""
        sensor = of_type(capture.sensor, DirectToF)
        if self._fits_pulses(sensor):
            return self._of_returns(capture, sensor)
        return self._of_peaks(capture, sensor)

    def pixel_reader(self, sensor: Sensor) -> Callable[[Capture], PathLengths]:
        return self.coordinates  # which checks nothing of the capture as a whole

    def _fits_pulses(self, sensor: DirectToF) -> bool:
        """Whether pulses are fitted, instead of taking the centroid of the highest peak."""
        return sensor.pulse is not None or self.max_returns > 1 or self.min_range_m > 0

    def depth_error_m(self, sensor: Sensor, light: ReceivedLight) -> np.ndarray | None:
        """The error of the centroid of a window around the peak, from the photons of a Gaussian pulse and an even
        background, see `centroid_error`; None where pulses are fitted."""
        tof = of_type(sensor, DirectToF)
        if self._fits_pulses(tof) or tof.sigma_bins == 0:
            return None
        place = (light.path_length_m / SPEED_OF_LIGHT - tof.start_s) / tof.bin_s
        background = light.ambient / tof.bins + light.own_variance
        counts = PulseCounts(place, light.emitter, background, light.trials)
        error = centroid_error(counts, tof.bins, tof.sigma_bins, tof.is_cyclic)
        return np.asarray(error * tof.bin_s * SPEED_OF_LIGHT * np.abs(light.per_length))

    def _of_peaks(self, capture: Capture, sensor: DirectToF) -> PathLengths:
        """Path lengths of the highest peaks, by their centroids."""
        from pcgraph.parallel import in_blocks
        from rangesim.decoding.histogram_kernels import total_counts

        shape, histograms = capture.frames.shape[1:], capture.frames.reshape(len(capture.frames), -1)
        position, peak, background, intensity = np.empty((4, *shape))
        left, blind = np.empty(shape, dtype=np.int64), capture.blindness
        flat = [x.ravel() for x in (position, peak, background, intensity, left)]

        def measure(start: int, stop: int) -> None:
            for some in _together(start, stop):
                counts, of_pixels = np.ascontiguousarray(histograms[:, some]), [x[some] for x in flat]
                histogram = counts if blind is None else undo_pile_up(counts, blind)
                of_pixels[0][:], of_pixels[1][:], of_pixels[2][:] = find_peak(
                    histogram, sensor.sigma_bins, sensor.is_cyclic
                )
                total_counts(counts, of_pixels[3])
                if blind is not None:
                    of_pixels[4][:] = trials_left(counts, of_pixels[0], blind, sensor.sigma_bins, sensor.is_cyclic)

        in_blocks(measure, histograms.shape[1])
        length = (sensor.start_s + position * sensor.bin_s) * SPEED_OF_LIGHT
        bright = bright_level(peak)
        is_strong = peak >= self._least_counts(background) if capture.is_digital else peak > self.relative_peak * bright
        status = np.where(is_strong, Status.OK, Status.LOW_SIGNAL)
        status[is_strong & ((position < 0) | (position > sensor.bins))] = Status.OUT_OF_RANGE
        status[capture.saturated(capture.frames)] = Status.SATURATED
        sigma_m = None
        if capture.detector is not None:
            sigma_bins = place_sigma(peak, background, sensor.bins, sensor.sigma_bins, sensor.is_cyclic)
            if blind is not None:
                status[runs_out(left, blind.trials)] = Status.SATURATED
                sigma_bins *= np.sqrt(blind.trials / np.maximum(left, 1))  # the correction adds to the counts' variance
            sigma_m = sigma_bins * sensor.bin_s * SPEED_OF_LIGHT
        return PathLengths(
            length_m=length,
            sigma_m=sigma_m,
            status=status,
            confidence=peak / (bright or 1.0),
            intensity=intensity,
        )

    def _of_returns(self, capture: Capture, sensor: DirectToF) -> PathLengths:
        """Path lengths of pulses that are fitted to the histograms."""
        from pcgraph.parallel import MIN_ROWS, in_blocks

        height, width = capture.frames.shape[1:]
        most, blind = self.max_returns + (self.min_range_m > 0), capture.blindness  # the cover glass is one more
        place, strength, sigma, kept = np.empty((4, most, height, width))
        intensity = np.empty((height, width))

        def measure(start: int, stop: int, rules: ReturnRules) -> None:
            for row in range(start, stop):
                frames = capture.frames[:, row]
                histogram, excess = frames.astype(np.float64), None
                if blind is not None:
                    histogram, excess = undo_pile_up(frames, blind), pile_up_excess(frames, blind)
                found = find_returns(np.nan_to_num(histogram), sensor.shape, rules, sensor.is_cyclic, excess)
                place[:, row], strength[:, row], sigma[:, row] = found
                intensity[row] = frames.sum(axis=0, dtype=np.float64)
                if blind is not None:
                    at = np.nan_to_num(found.place)
                    kept[:, row] = trials_left(frames, at, blind, sensor.sigma_bins, sensor.is_cyclic)

        rules = ReturnRules(most, self.peak_sigmas, self.min_counts, self.pulse_tolerance)
        if not capture.is_digital:  # radiances have no noise; how strong is strong, the image tells
            in_blocks(measure, height, ReturnRules(1, 0.0, 0.0, 0.0), smallest=MIN_ROWS)
            rules = rules._replace(sigmas=0.0, counts=self.relative_peak * bright_level(strength[0]))
        in_blocks(measure, height, rules, smallest=MIN_ROWS)
        length = (sensor.start_s + place * sensor.bin_s) * SPEED_OF_LIGHT
        status = np.where(np.isfinite(place), Status.OK, Status.LOW_SIGNAL)
        ran_out = np.zeros(place.shape, dtype=bool)
        if blind is not None:
            ran_out = runs_out(kept, blind.trials) & np.isfinite(place)
        status[(ran_out | capture.saturated(capture.frames)) & np.isfinite(place)] = Status.SATURATED
        is_outside = (place < 0) | (place > sensor.bins) | (length < 2 * self.min_range_m)
        status[is_outside] = Status.OUT_OF_RANGE
        if capture.detector is None:
            sigma[:] = np.nan
        returns = LengthReturns(length, sigma * sensor.bin_s * SPEED_OF_LIGHT, strength, status.astype(np.uint8))
        return self._read(returns, np.asarray(ran_out.any(axis=0)), intensity, capture)

    def _read(
        self, returns: LengthReturns, ran_out: np.ndarray, intensity: np.ndarray, capture: Capture
    ) -> PathLengths:
        """The reading of each pixel: the first, the strongest or the last of the returns that are targets.

        ran_out : (h, w) bool, where the pulses ran out within a return, be it that of the cover glass.
        """
        is_target = (returns.status == Status.OK) | (returns.status == Status.SATURATED)
        number = np.arange(len(is_target), dtype=np.float64)[:, None, None]
        merit = {"strongest": returns.strength, "first": -number, "last": number}[self.reading]
        chosen = np.where(is_target, merit, -np.inf).argmax(axis=0)[None]
        length, sigma, strength, status = (np.take_along_axis(x, chosen, axis=0)[0] for x in returns)
        has_target = is_target.any(axis=0)
        near = np.where(returns.status == Status.OUT_OF_RANGE, returns.strength, 0.0).sum(axis=0)
        least = self.cover_glass_counts + self.peak_sigmas * np.sqrt(self.cover_glass_counts)
        without = np.where(near > least, Status.OUT_OF_RANGE, Status.LOW_SIGNAL)
        status = np.where(has_target, status, np.where(ran_out, Status.SATURATED, without))
        status[capture.saturated(capture.frames)] = Status.SATURATED
        strength = np.where(has_target, strength, 0.0)
        is_one = self.max_returns == 1 and self.min_range_m == 0
        return PathLengths(
            length_m=length,
            sigma_m=None if capture.detector is None else sigma,
            status=status,
            confidence=strength / (bright_level(strength) or 1.0),
            intensity=intensity,
            returns=None if is_one else returns,
        )

    def undetectable(self, sensor: Sensor) -> str | None:
        direct = of_type(sensor, DirectToF)
        if direct.laser != "periodic":
            return None
        range_m = direct.period_s * SPEED_OF_LIGHT / 2
        return f"surfaces beyond {range_m:.4g} m would be read too near by that or a multiple of it, and no frame tells"

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        if background.noise_variance is None:
            return background.floor(self.relative_peak)
        window, bins = _window_bins(of_type(sensor, DirectToF)), of_type(sensor, DirectToF).bins
        return self._least_counts(window * (background.dark + background.ambient / bins))

    def _least_counts(self, background: np.ndarray) -> np.ndarray:
        """(...) float64, counts, least height of a peak over the counts (...) of background in its window.

        A quarter of the square of the standard deviations is added to them, see `ReturnRules`.
        """
        sigmas = self.peak_sigmas
        return np.asarray(np.maximum(self.min_counts, sigmas * np.sqrt(background) + 0.25 * sigmas**2))

    def content(self, sensor: Sensor) -> FrameContent:
        """Light and dark counts in the window of a peak."""
        window = _window_bins(of_type(sensor, DirectToF))
        return FrameContent(signal=1.0, ambient=window / of_type(sensor, DirectToF).bins, dark=window)


def _together(start: int, stop: int) -> Iterator[slice]:
    """Slices of at most `TOGETHER` pixels that make up the range from `start` to `stop`."""
    for begin in range(start, stop, TOGETHER):
        yield slice(begin, min(begin + TOGETHER, stop))


def _window_bins(sensor: DirectToF) -> int:
    """Number of bins in the window of a peak."""
    return 2 * window_reach(sensor.bins, sensor.sigma_bins, sensor.is_cyclic) + 1
