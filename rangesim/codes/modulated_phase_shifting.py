# SPDX-License-Identifier: Apache-2.0
"""Modulated phase shifting: long fringes on a short carrier, which separates direct light from all other light."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.fringes import FringeConvention
from rangesim.codes.modulated_phase_checks import modulation_contradiction
from rangesim.decoding.phase_shift import Phase, modulation_is_weak, phase_of
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.response import DenseResponse, Fringes
from rangesim.sensor import Background, FrameContent, least_signal_for
from rangesim.settings.bounds import Bounds, check_fields, whole

CARRIER_VISIBILITY = 0.5
"""Amplitude of the carrier where the long fringes are brightest, as a fraction of the light at full power: half of it,
because the values of a pattern go from 0 to 1."""

MEAN_SQUARE = 3 / 8
"""Mean square of a long fringe, 1/2 + 1/2 cos, which is 1/4 + 1/8: the fraction of the images' information on the
carrier that is left."""

MAX_OFF_PERIODS = 0.2
"""Largest distance of the place that longer fringes tell from the nearest place of the next shorter ones, in periods of
these. A place is wrong by a whole period only if the longer fringes err by 0.8, four times as much. A wrong start of
the fringes, by a quarter or half of a turn, makes it 0.25 or 0.5."""

MAX_SIGMA_PERIODS = 1 / 6
"""Largest standard deviation of the place that longer fringes tell, in periods of the next shorter ones. An error of
0.8 periods is then one of 4.8 standard deviations: fewer than one pixel of 100 000 is wrong by a period."""


class Demodulated(NamedTuple):
    """Phases of the carrier and of the long fringes at each pixel.

    carrier : Phase of the carrier; its modulation is the amplitude where the long fringes are brightest.
    long : phases of the long fringes, the longest first, in the amplitude of the carrier.
    """

    carrier: Phase
    long: list[Phase]


@dataclass(frozen=True)
class ModulatedPhaseShifting(Code):
    """Long fringes that modulate the amplitude of a carrier of a short period; both are shifted.

    Each image is 1/2 + 1/2 a cos(carrier), and a is a long fringe from 0 to 1. Light from other surfaces, or from below
    the surface, blurs the carrier away, so its amplitude is that of the direct light alone. The long fringes tell the
    period of the carrier. The carrier's phase tells the place within it, so the noise is that of the short period:
    period_px / (2 pi) sqrt(2 / n) s / B projector pixels, with n = 3/8 of the number of images, noise s, and amplitude
    B, half the difference of white and black.

    Its authors modulate along both axes. Here the carrier runs along the coded axis, so that its phase tells a place.

    Parameters
    ----------
    period_px : float, period of the carrier in projector pixels.
    carrier_steps : int >= 3, number of shifts of the carrier.
    steps : int >= 3, number of shifts of the long fringes.
    levels : int >= 1, number of periods of long fringes. The longest is a little longer than the projector's axis; the
        others lie between it and the carrier, each shorter by the same factor. With one level, little noise suffices
        to confuse the periods of the carrier.
    convention : FringeConvention of the carrier and of the long fringes.

    References
    ----------
    Chen, Seidel, Lensch: "Modulated phase-shifting for 3D scanning", CVPR (2008).

    Examples
    --------
    >>> code = ModulatedPhaseShifting(period_px=8.0)
    >>> code.names(64)[:4]
    ['long0_phase0_carrier0', 'long0_phase0_carrier1', 'long0_phase0_carrier2', 'long0_phase1_carrier0']
    >>> code.patterns(64).shape
    (18, 64)
    """

    period_px: Annotated[float, Bounds("projector pixels", 2, 1e6)] = 16.0
    carrier_steps: Annotated[int, whole(3, "steps")] = 3
    steps: Annotated[int, whole(3, "steps")] = 3
    levels: Annotated[int, whole(1, "steps")] = 2
    convention: FringeConvention = field(default_factory=FringeConvention)

    type_name: ClassVar[str] = "modulated-phase-shifting"
    title: ClassVar[str] = "Structured light (modulated phase shifting)"

    def __post_init__(self) -> None:
        check_fields(self)

    def factor(self, size: int) -> int:
        """Ratio of the period of each long fringe to the next shorter one, and of the shortest to the carrier.

        It is even. With an odd one, all fringes that start half a turn late would look like those of another place.
        """
        return 2 * math.ceil((size / self.period_px + 2) ** (1 / self.levels) / 2)

    def long_periods(self, size: int) -> list[float]:
        """Periods of the long fringes in projector pixels, the longest first.

        The longest reaches a period of the carrier beyond both ends of the axis, so that noise cannot confuse these.
        """
        return [self.period_px * self.factor(size) ** (self.levels - level) for level in range(self.levels)]

    def _steps(self, size: int) -> Iterator[tuple[int, float, int, int]]:
        """Level, period of the long fringes, shift of the long fringes and shift of the carrier of each image."""
        for level, period in enumerate(self.long_periods(size)):
            for step in range(self.steps):
                for carrier_step in range(self.carrier_steps):
                    yield level, period, step, carrier_step

    def names(self, size: int) -> list[str]:
        return [f"long{level}_phase{step}_carrier{carrier}" for level, _, step, carrier in self._steps(size)]

    def patterns(self, size: int) -> np.ndarray:
        x = np.arange(size) + 0.5
        return self.patterns_at(x, size).astype(np.float32)

    def patterns_at(self, x: np.ndarray, size: int) -> np.ndarray:
        """(k, n) values of the images, 0 to 1, at projector coordinates x (n,)."""
        long = {
            (period, step): self.convention.pattern(x, period, step, self.steps)
            for _, period, step, carrier in self._steps(size)
            if carrier == 0
        }
        steps = self.carrier_steps
        wave = [self.convention.pattern(x, self.period_px, step, steps) - 0.5 for step in range(steps)]
        return np.stack([0.5 + long[period, step] * wave[carrier] for _, period, step, carrier in self._steps(size)])

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        """The carrier, and for each long period the two fringes whose beat it is."""
        carrier = 1 / self.period_px
        beats = [1 / (carrier + sign / long) for long in self.long_periods(size) for sign in (1, -1)]
        return tuple(Fringes(axis, period) for period in (self.period_px, *beats))

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        for level, period, step, carrier_step in self._steps(size):
            carrier = 2 * math.pi * self.convention.shift_turns(carrier_step, self.carrier_steps, self.period_px)
            long = 2 * math.pi * self.convention.shift_turns(step, self.steps, period)
            faster, slower = channels[1 + 2 * level], channels[2 + 2 * level]
            radiance = 0.5 * white + 0.25 * _shifted(channels[0], carrier)
            yield radiance + 0.125 * (_shifted(faster, carrier + long) + _shifted(slower, carrier - long))

    def white_and_black(self, size: int, names: list[str], frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        carrier = self.demodulated(frames).carrier
        return carrier.mean + carrier.modulation, carrier.mean - carrier.modulation

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        """The light that the phase of the carrier needs, or that its period needs, if that is more.

        The period can be told if the noise is at most `_max_relative_noise` of the carrier's amplitude, which is
        `CARRIER_VISIBILITY` times the light.
        """
        steps = max(1, round(MEAN_SQUARE * len(self.names(size))))
        least = thresholds.phase.least_signal(steps, CARRIER_VISIBILITY, FrameContent(), background)
        if background.noise_variance is None:
            return least
        sigmas2 = (CARRIER_VISIBILITY * self._max_relative_noise(size)) ** -2
        noise_variance = background.ambient + background.noise_variance
        return np.maximum(least, least_signal_for(sigmas2, FrameContent().signal, noise_variance))

    @property
    def details(self) -> str:
        return f"fringes of {self.levels} long periods on a carrier of {self.period_px:g} px"

    def representative(self, size: int) -> list[str]:
        return [self.names(size)[0], self.names(size)[-1]]

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        capture, frames, size = seen.capture, seen.frames, seen.size
        coordinate = np.empty(frames.shape[1:], dtype=np.float32)
        status = np.zeros(coordinate.shape, dtype=np.uint8)
        sigma_px = None if capture.noise(frames[0, :1]) is None else np.empty_like(coordinate)
        for rows in bands(len(status)):
            band, refused = frames[:, rows], status[rows]
            seen_here = self.demodulated(band)
            carrier, noise = seen_here.carrier, capture.noise(seen_here.carrier.mean)
            coordinate[rows], agree = self.places(seen_here, size)
            unexplained = self.unexplained(band, coordinate[rows], size)
            refused[~(agree & (unexplained <= self.max_unexplained(size)))] = Status.CODE_ERROR
            sigma = None
            if noise is not None and sigma_px is not None:
                relative = noise / np.maximum(carrier.modulation, np.finfo(np.float32).tiny)
                sigma = relative * np.float32(math.sqrt(2 / (MEAN_SQUARE * len(frames))))
                np.multiply(sigma, self.period_px / (2 * math.pi), out=sigma_px[rows], casting="same_kind")
                refused[self._sigma_periods(relative, size) > MAX_SIGMA_PERIODS] = Status.LOW_SIGNAL
            washed_out = 2 * carrier.modulation < thresholds.gray.relative_bit * seen.contrast.values[rows]
            refused[modulation_is_weak(capture, carrier, sigma, thresholds.phase) | washed_out] = Status.LOW_SIGNAL
            refused[capture.saturated(band)] = Status.SATURATED
        return AxisCode(coordinate, status, self.period_px, sigma_px)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return modulation_contradiction(seen, self)

    def demodulated(self, frames: np.ndarray) -> Demodulated:
        """Phases of the carrier and of the long fringes in images (k, h, w)."""
        shape = frames.shape[1:]
        groups = frames.reshape(self.levels * self.steps, self.carrier_steps, *shape)
        turns = np.exp(2j * np.pi * np.arange(self.carrier_steps) / self.carrier_steps) * (2 / self.carrier_steps)
        cosine, sine = np.empty((2, len(groups), *shape), dtype=np.float32)
        mean = np.zeros(shape, dtype=np.float32)
        for group, c, s in zip(groups, cosine, sine, strict=True):
            values = group.astype(np.float32)
            c[:] = np.tensordot(turns.real.astype(np.float32), values, axes=1)
            s[:] = np.tensordot(turns.imag.astype(np.float32), values, axes=1)
            mean += values.mean(axis=0)
        amplitude = _along(cosine, sine, cosine.sum(axis=0), sine.sum(axis=0))
        # Where a long fringe is dark the carrier is noise alone, so each phase counts by its amplitude.
        x, y = (amplitude * cosine).sum(axis=0), (amplitude * sine).sum(axis=0)
        amplitude = _along(cosine, sine, x, y)
        normalised = np.arctan2(y, x) * np.float32(1 / (2 * np.pi))
        carrier = Phase(normalised - np.floor(normalised), 2 * amplitude.mean(axis=0), mean / len(groups))
        return Demodulated(carrier, [phase_of(level) for level in amplitude.reshape(self.levels, self.steps, *shape)])

    def places(self, seen: Demodulated, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Coordinate (h, w) in projector pixels, and (h, w) bool, whether long and short fringes agree on it."""
        periods = self.long_periods(size)
        place = self.convention.place_turns(seen.long[0].normalised, periods[0]) * np.float32(periods[0])
        place = np.where(place > (size + periods[0]) / 2, place - np.float32(periods[0]), place)
        agree = np.ones(place.shape, dtype=bool)
        for phase, period in [*zip(seen.long[1:], periods[1:], strict=True), (seen.carrier, self.period_px)]:
            within = self.convention.place_turns(phase.normalised, period)
            off = place / np.float32(period) - within
            agree &= np.abs(off - np.rint(off)) <= MAX_OFF_PERIODS
            place = (np.rint(off) + within) * np.float32(period)
        return place.astype(np.float32), agree

    def unexplained(self, frames: np.ndarray, coordinate: np.ndarray, size: int, gamma: float = 1.0) -> np.ndarray:
        """(h, w) float32, sum of the squares of what no offset and amplitude of the patterns at a place explain, as a
        fraction of that of the images about their mean."""
        expected = self.patterns_at(coordinate.ravel(), size).astype(np.float32).reshape(frames.shape) ** gamma
        expected = expected - expected.mean(axis=0)
        values = frames - frames.mean(axis=0, dtype=np.float32)
        common, own = (values * expected).sum(axis=0), (expected**2).sum(axis=0)
        whole_sum = (values**2).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(1 - common * np.abs(common) / (own * whole_sum))

    def max_unexplained(self, size: int) -> float:
        """Largest fraction of the images that a place may leave unexplained.

        It is that of the noise s at which long fringes tell the next shorter period with `MAX_SIGMA_PERIODS`. Images of
        the amplitude B vary by MEAN_SQUARE B^2 / 2 about their mean, so the fraction is 2 s^2 / (MEAN_SQUARE B^2).
        """
        return min(0.5, 2 * self._max_relative_noise(size) ** 2 / MEAN_SQUARE)

    def _max_relative_noise(self, size: int) -> float:
        """Noise, as a fraction of the carrier's amplitude, at which `_sigma_periods` is `MAX_SIGMA_PERIODS`."""
        return MAX_SIGMA_PERIODS / float(self._sigma_periods(np.ones(1), size)[0])

    def _sigma_periods(self, relative_noise: np.ndarray, size: int) -> np.ndarray:
        """Standard deviation of the place that long fringes tell, in periods of the next shorter ones, for noise as a
        fraction of the carrier's amplitude.

        The amplitude of the carrier in one image has the noise sqrt(2 / carrier_steps), and the long fringes have half
        the amplitude of the carrier.
        """
        radians = 2 * math.sqrt(2 / self.steps) * math.sqrt(2 / self.carrier_steps)
        return np.asarray(relative_noise * (radians / (2 * math.pi) * self.factor(size)))


def _shifted(channels: np.ndarray, shift: float) -> np.ndarray:
    """cos(phase - shift) of the cosine and the sine (2, h, w) of a phase."""
    return np.asarray(math.cos(shift) * channels[0] + math.sin(shift) * channels[1])


def _along(cosine: np.ndarray, sine: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Components (n, h, w) of vectors (n, h, w) along the direction (x, y) of (h, w) each."""
    length = np.maximum(np.hypot(x, y), np.finfo(np.float32).tiny)
    return np.asarray(cosine * (x / length) + sine * (y / length))
