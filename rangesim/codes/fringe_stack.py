# SPDX-License-Identifier: Apache-2.0
"""Stacks of fringes of one or several periods: their patterns, and the place on which all their phases agree.

References
----------
- Huntley, Saldner: "Temporal phase-unwrapping algorithm for automated interferogram analysis", Applied Optics 32
  (1993): the coarsest period covers all, and each finer one is unwrapped by those before.
- Reich, Ritter, Thesing: "White light heterodyne principle for 3D-measurement", Proc. SPIE 3100 (1997): the beat of
  similar periods covers all.
- Gushov, Solodkin: "Automatic processing of fringe patterns in integer interferometers", Optics and Lasers in
  Engineering 14 (1991): periods without a common divisor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rangesim.capture import Capture
from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.fringe_gamma import FringeGamma, gamma_of
from rangesim.codes.fringe_kernels import Agreement, agree, mean_place
from rangesim.codes.fringes import VISIBILITY, FringeConvention
from rangesim.decoding.phase_shift import PhaseThresholds, modulation_is_weak, phase_of, phase_sigma
from rangesim.decoding.pixel_samples import MIN_PIXELS, evenly_spread
from rangesim.decoding.row_bands import in_bands
from rangesim.decoding.status import Status
from rangesim.response import Fringes
from rangesim.robust_scale import sigma_from_median
from rangesim.sensor import ReceivedLight

LIMITS = Agreement(widest=1 / 4, misfit=1 / 8, ambiguity=1 / 4)
"""Limits of the agreement of phases.

The misfit, 1/8 of a turn, is four standard deviations of the noisiest phase that is accepted
(`PhaseThresholds.max_sigma_rad`, 0.2). The widest distance is twice that, so that the second best is known where the
best is accepted. At an ambiguity of 1/4 the best place is half as far from the phases as the second; noise would have
to move the phases by two thirds of the way between both to deceive, and at half of it the pixel counts as ambiguous."""

MIN_EVIDENCE = 10.0
"""Least difference between the costs of the second best place and of the best one, in variances of the noise, where the
noise is known. The likelihoods of two places then differ by the factor exp(10 / 2) = 150. With noise of 0.14 radians,
heterodyne fringes on 1280 pixels have 0.5 % of their readings wrong instead of 2 %, number-theoretic ones 1.5 % instead
of 10 %; at 0.05 radians no code loses a pixel. At 20, fringes of 0.1 radians lose half of the right readings."""

SEEN_FRACTION = 0.9
"""Distance of two places, as a fraction of the axis, beyond which it does not count that they look alike: few pixels,
at the ends of the axis, have such a rival."""

NOISE_SAMPLES = 10_000
"""Largest number of pixels among which those with little modulation are looked for. 1000 tell the noise to 4 %."""

MAX_WEAK = 6.0
"""Largest modulation of pixels that tell the noise, as a multiple of the least one that is accepted. Brighter pixels
have more shot noise, and none of them is refused for noise."""

MIN_APART_TURNS = 0.005
"""Least distance of any two places of the axis in the space of the phases, in turns. A camera of 8 bits tells a phase
of full contrast to 0.0004 turns; closer places could not be told apart even then."""

MIN_AGREEING = 0.8
"""Least fraction of the pixels on whose places all phases agree, at which fringes count as read as they were shown.
Interreflection, noise and edges make up to a fifth disagree."""

MIN_PRECISION = 0.1
"""Least precision (inverse variance) of a period, as a fraction of the finest one's, at which its phase is averaged
into the place. What is less would gain less than 5 % of the standard deviation, and brings the errors of a coarse
phase in."""


@dataclass(frozen=True)
class FringeStack:
    """Fringes of one or several periods, shown one period after the other.

    periods_px : (K,) float, projector pixels, in the order in which they are shown. steps : (K,) int, phase shifts of
        each period. convention : FringeConvention of all of them.
    """

    periods_px: tuple[float, ...]
    steps: tuple[int, ...]
    convention: FringeConvention

    def names(self) -> list[str]:
        """One name per frame: phase0, ... of a single period, period0_phase0, ... of several."""
        if len(self.steps) == 1:
            return [f"phase{s}" for s in range(self.steps[0])]
        return [f"period{i}_phase{s}" for i, steps in enumerate(self.steps) for s in range(steps)]

    def patterns(self, size: int) -> np.ndarray:
        """(n, size) float32, at the centres of the projector's pixels."""
        x, pairs = np.arange(size) + 0.5, zip(self.periods_px, self.steps, strict=True)
        shown = [self.convention.pattern(x, period, s, steps) for period, steps in pairs for s in range(steps)]
        return np.array(shown, dtype=np.float32)

    def responses(self, axis: int) -> tuple[Fringes, ...]:
        """One per period, with the channels cosine and sine."""
        return tuple(Fringes(axis, period) for period in self.periods_px)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        """Radiance (h, w) of each frame, from the channels (2, h, w) of each period."""
        for period, steps, (cosine, sine) in zip(self.periods_px, self.steps, channels, strict=True):
            for step in range(steps):
                shift = 2 * math.pi * self.convention.shift_turns(step, steps, period)
                yield 0.5 * (white + math.cos(shift) * cosine + math.sin(shift) * sine)

    def place_sigma_px(self, light: ReceivedLight, axis: int) -> np.ndarray:
        """(h, w) float64, projector pixels, standard deviation of a place: of each period P / (2 pi) sqrt(2 / N) sigma
        / B, and the places of precise periods are averaged.

        The modulation B is half of the emitter's light, less what a camera's pixel averages over the fringe. A phase of
        the standard deviation s by the linear law has the variance s^2 + s^4, because an arc tangent is no line.

        Parameters
        ----------
        axis : 0 for columns, 1 for rows.

        References
        ----------
        Surrel: "Additive noise effect in digital phase detection", Applied Optics 36 (1997).
        """
        noise = np.sqrt(light.emitter / 2 + light.ambient + light.own_variance)
        across_px = (light.pixel_columns, light.pixel_rows)[axis]
        rates = 2 * np.pi / np.array(self.periods_px)[:, None, None]  # radians per pixel
        precisions = np.array(
            [
                steps / 2 * (rate * VISIBILITY * light.emitter * np.sinc(across_px / period) / noise) ** 2
                for rate, period, steps in zip(rates, self.periods_px, self.steps, strict=True)
            ]
        )
        precise = precisions >= MIN_PRECISION * precisions.max(axis=0)
        with np.errstate(divide="ignore"):
            return np.asarray(
                np.sqrt((precise * (precisions + rates**2)).sum(axis=0)) / (precisions * precise).sum(axis=0)
            )

    def of_period(self, frames: np.ndarray, i: int) -> np.ndarray:
        """The frames (N, ...) of period i, a view."""
        start = sum(self.steps[:i])
        return frames[start : start + self.steps[i]]

    def frames_of(self, seen: AxisFrames, i: int) -> AxisFrames:
        """The frames of period i of those that `names` lists."""
        start = sum(self.steps[:i])
        run = slice(start, start + self.steps[i])
        return seen._replace(names=seen.names[run], frames=seen.frames[run])

    def gammas(self, seen: AxisFrames, usable: np.ndarray, has_bits: bool) -> tuple[FringeGamma, ...]:
        """Response of projector and camera as the fringes of each period show it at the pixels `usable` (h, w) bool.

        Blurred fringes have a smaller gamma, so each period has its own. One that does not tell has that of the others,
        because projector and camera are the same. `has_bits` tells whether the capture has other frames of the axis,
        from which white - black is estimated well.
        """
        found = [self._gamma(seen, i, usable, has_bits) for i in range(len(self.steps))]
        told = [one.gamma for one in found if one.is_told]
        common = FringeGamma(float(np.median(told))) if told else None
        return tuple(one if one.is_told else common or one for one in found)

    def _gamma(self, seen: AxisFrames, i: int, usable: np.ndarray, has_bits: bool) -> FringeGamma:
        """Response of projector and camera as the fringes of period i alone show it at the pixels `usable`."""
        scale: np.ndarray | None = None
        if seen.contrast.is_measured or has_bits:
            scale = seen.contrast.values
        elif len(self.steps) > 1:  # the means of the other periods change with other phases
            others = [k for k in range(len(self.steps)) if k != i]
            scale = np.mean([self.of_period(seen.frames, k).mean(axis=0, dtype=np.float32) for k in others], axis=0)
        return gamma_of(self.of_period(seen.frames, i), usable, scale)

    def _weak_noise(
        self, capture: Capture, frames: np.ndarray, usable: np.ndarray, thresholds: PhaseThresholds
    ) -> float:
        """Noise of pixels with little modulation, in digital numbers of an unknown detector; 0 if nothing tells it.

        All periods have the same mean, (white + black) / 2, at any blur and interreflection, so that their means differ
        by noise alone. A gamma adds what is proportional to the modulation, so little at these pixels. The median is
        taken out, because light that drifts slowly moves all of them alike and the phases hardly.

        Parameters
        ----------
        frames : (n, h, w), those of the stack. usable : (h, w) bool, pixels that may tell.
        """
        if capture.detector is not None or not capture.is_digital or len(self.steps) < 2:
            return 0.0
        values = frames.reshape(len(frames), -1)[:, evenly_spread(np.flatnonzero(usable), NOISE_SAMPLES)]
        periods = [phase_of(self.of_period(values, i)) for i in range(len(self.steps))]
        least = thresholds.modulation_of_scale * capture.full_scale
        modulation = np.min([phase.modulation for phase in periods], axis=0)
        weak = (modulation > least) & (modulation < MAX_WEAK * least)
        if np.count_nonzero(weak) < MIN_PIXELS:
            return 0.0
        off = [b.mean[weak] - a.mean[weak] for a, b in pairwise(periods)]
        spread = [math.sqrt(1 / a + 1 / b) for a, b in pairwise(self.steps)]
        return max(sigma_from_median(o, float(np.median(o))) / s for o, s in zip(off, spread, strict=True))

    def apart(self, size: float) -> tuple[float, float]:
        """Least distance of two places in the space of the phases, in turns, and their distance in projector pixels.

        Only places that lie more than half of the finest period apart count; those nearer are told by its phase.
        """
        periods = np.array(self.periods_px)
        base = float(periods.min())
        cycles = np.arange(1, math.floor(size / base + 1e-9) + 1)
        steps = np.concatenate([cycles * base + shift for shift in np.linspace(-0.25, 0.25, 51) * base])
        steps = steps[(steps > base / 2) & (steps < size * (1 - 1e-6))]
        if not len(steps):
            return 0.5, float(size)
        turns = steps[:, None] / periods
        distance = np.sqrt(((turns - np.rint(turns)) ** 2).sum(axis=1))
        nearest = int(np.argmin(distance))
        return float(distance[nearest]), float(steps[nearest])

    def max_sigma_rad(self, size: int) -> float:
        """Largest standard deviation of a phase, radians, at which most pixels have `MIN_EVIDENCE` for their place."""
        return 2 * math.pi * self.apart(SEEN_FRACTION * size)[0] / math.sqrt(MIN_EVIDENCE)

    def check(self, size: int) -> None:
        """Raise ValueError if the phases do not tell `size` projector pixels apart.

        The first and the last pixel may look alike, as of programs whose coarsest fringe is of size - 1 pixels.
        """
        distance, repeat = self.apart(size - 1)
        if distance < MIN_APART_TURNS:
            periods = ", ".join(f"{p:g}" for p in self.periods_px)
            what = "a period" if len(self.periods_px) == 1 else "periods"
            raise ValueError(
                f"expected {what} that tell{'s' if len(self.periods_px) == 1 else ''} {size} projector pixels apart, "
                f"got {periods}, whose phases repeat after {repeat:.4g} pixels: add a period of at least {size} "
                "(multi-frequency), or Gray code (gray-phase)."
            )

    def agrees(self, places: list[np.ndarray], size: int) -> np.ndarray:
        """(n,) bool, where the places within the periods, K of (n,) turns in the order of the stack, agree on one."""
        return self._agreed(places, size)[1]

    def bias_turns(self, places: list[np.ndarray], size: int) -> float:
        """Mean distance of the phases of the periods from the places on which they agree, in turns.

        It is the root mean square over the periods, 1 if the phases agree at few pixels. It is near 0 if all fringes
        start where they should: noise lies on both sides.

        Parameters
        ----------
        places : K of (n,) turns, the place within each period in the order of the stack. size : int, projector pixels.
        """
        place, ok = self._agreed(places, size)
        if ok.mean() <= MIN_AGREEING:
            return 1.0
        off = [turns[ok] - place[ok] / period for turns, period in zip(places, self.periods_px, strict=True)]
        return float(np.sqrt(np.mean([float((o - np.rint(o)).mean()) ** 2 for o in off])))

    def _agreed(self, places: list[np.ndarray], size: int) -> tuple[np.ndarray, np.ndarray]:
        """(n,) float32, projector pixels on which the places within the periods agree best, and where they agree."""
        order = np.argsort(self.periods_px, kind="stable")
        periods = np.array(self.periods_px)[order]
        turns = np.stack([places[i] for i in order]).astype(np.float32)
        weights = np.broadcast_to((1 / periods**2)[:, None], turns.shape).astype(np.float32)
        low, high = np.zeros_like(turns[0]), np.full_like(turns[0], size)
        place, agrees = np.empty(turns.shape[1], dtype=np.float32), np.empty(turns.shape[1], dtype=bool)
        agree(turns, weights, periods, low, high, np.zeros_like(low), LIMITS, place, agrees, np.empty_like(agrees))
        return place, agrees

    def decode(
        self,
        seen: AxisFrames,
        low: np.ndarray | float,
        high: np.ndarray | float,
        least_swing: np.ndarray | float,
        thresholds: PhaseThresholds,
        coarse: AxisCode | None = None,
    ) -> AxisCode:
        """The place between `low` and `high` on which all phases agree; `CODE_ERROR` where they do not, or on several.

        Parameters
        ----------
        seen : frames (n, h, w), those of `names`. low, high : (h, w) or float, projector pixels.
        least_swing : (h, w) or float, least difference between the brightest and the darkest fringe, in the capture's
            units. coarse : AxisCode that tells `low` and `high`; pixels that it refuses stay refused.
        """
        capture, frames = seen.capture, seen.frames
        shape = frames.shape[1:]
        status = np.zeros(shape, dtype=np.uint8) if coarse is None else coarse.status.copy()
        coordinate = np.empty(shape, dtype=np.float32)
        sigma_px = None if capture.noise(frames[0, :1]) is None else np.empty(shape, dtype=np.float32)
        saturated = capture.saturated(frames)
        usable = (status == Status.OK) & ~saturated
        gammas = self.gammas(seen, usable & seen.contrast.is_enough, coarse is not None)
        noise = self._weak_noise(capture, frames, usable, thresholds)
        order = np.argsort(self.periods_px, kind="stable")
        periods = np.array(self.periods_px)[order]
        precision = np.array(self.steps)[order] / periods**2
        kept = np.flatnonzero(precision >= MIN_PRECISION * precision[0])
        lows, highs, swings = (np.broadcast_to(np.float32(x), shape) for x in (low, high, least_swing))

        def decode_rows(rows: slice) -> None:
            refused = status[rows]
            places, weights = np.empty((2, len(order), *refused.shape), dtype=np.float32)
            variance = np.zeros(refused.shape, dtype=np.float32)
            weak = np.zeros(refused.shape, dtype=bool)
            noise_variance = np.full(refused.shape, noise**2, dtype=np.float32)
            for k, i in enumerate(order):
                steps, period = self.steps[i], self.periods_px[i]
                measured = phase_of(self.of_period(frames, i)[:, rows])
                phase, slope = gammas[i].corrected(measured, steps), gammas[i].slope(measured, steps)
                sigma = phase_sigma(capture, phase, steps, slope)
                weak |= modulation_is_weak(capture, phase, sigma, thresholds)
                weak |= 2 * phase.modulation < swings[rows]
                weak |= math.sqrt(2 / steps) * noise > thresholds.max_sigma_rad * phase.modulation
                places[k] = self.convention.place_turns(phase.normalised, period)
                weights[k] = steps * (phase.modulation / (period * slope)) ** 2
                if sigma is not None and k == 0:
                    noise_variance = (sigma * phase.modulation / slope) ** 2 * np.float32(steps / 2)
                    variance = (sigma * np.float32(period / (2 * math.pi))) ** 2
            flat, inverse = places.reshape(len(order), -1), weights.reshape(len(order), -1)
            margin = np.minimum(3 * np.sqrt(variance).ravel(), np.float32(periods[0]))  # infinite without any swing
            place = np.empty(refused.size, dtype=np.float32)
            agrees, is_clear = np.empty((2, refused.size), dtype=bool)
            # The noise may put a place beyond an end of the axis: then the other end is as likely.
            start, end = lows[rows].ravel() - margin, highs[rows].ravel() + margin
            # In units of the costs, which `inverse` weights.
            gap = noise_variance.ravel() * np.float32(MIN_EVIDENCE / (2 * math.pi**2))
            agree(flat, inverse, periods, start, end, gap, LIMITS, place, agrees, is_clear)
            precise = inverse[0] > 0
            if len(kept) > 1:
                mean_place(flat[kept], inverse[kept], periods[kept], place)
            coordinate[rows] = place.reshape(refused.shape)
            disagrees = ~(agrees & precise)
            ok = refused == Status.OK
            refused[ok & disagrees.reshape(refused.shape)] = Status.CODE_ERROR
            refused[ok & (weak | ~is_clear.reshape(refused.shape))] = Status.LOW_SIGNAL
            refused[ok & saturated[rows]] = Status.SATURATED
            if sigma_px is not None:
                gain = inverse[0] / np.maximum(inverse[kept].sum(axis=0), np.float32(1e-30))
                sigma_px[rows] = np.sqrt(variance * gain.reshape(refused.shape))

        in_bands(decode_rows, shape[0])
        cell_px = 1.0 if coarse is None else coarse.cell_px
        return AxisCode(coordinate, status, cell_px, sigma_px, coarse, gammas)
