# SPDX-License-Identifier: Apache-2.0
"""Micro phase shifting: fringes of several short periods, which light between surfaces does not disturb."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np

from pcgraph.parallel import in_blocks
from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.codes.fringes import FringeConvention
from rangesim.codes.micro_periods import micro_periods
from rangesim.codes.micro_phase_checks import period_contradiction
from rangesim.codes.micro_phase_kernels import PeriodTable, find_columns, fit_places
from rangesim.decoding.phase_shift import Phase, modulation_is_weak, phase_of, phase_sigma
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.response import DenseResponse, Fringes
from rangesim.sensor import Background, FrameContent
from rangesim.settings.bounds import Bounds, check_fields, whole

FRINGE_VISIBILITY = 0.5
"""Amplitude of a fringe as a fraction of the light at full power: fringes go from 0 to 1."""

MIN_PERIOD_PX = 6.0
"""Least period in projector pixels. The search looks at the centres of pixels; with shorter periods, places between
them fit to no centre."""

OUTSIDE_CURVATURE = 0.25
"""Largest distance of the first period's place from the best column at which it is kept, in projector pixels, as a
fraction of the square of the angle in radians by which the shortest fringe advances in a pixel. Near the edge between
two columns either may fit best, because a cosine is no straight line: without noise, the place is 0.03 pixels outside
with periods of about 16 pixels, half of this limit."""

SHIFTS = 3
"""Number of shifts of the first period, the least that tells offset, amplitude and phase."""

MAX_RESIDUAL_RATIO = 0.25
"""Largest sum of squared residuals at the best place, as a fraction of that in the best other period. In the authors'
captures, 99 % of the pixels are below 0.1. With wrong periods, half of them are above 0.7."""

MIN_EVIDENCE = 20.0
"""Least difference of the sums of squared residuals at the best other period and at the best place, in variances of a
frame. The likelihoods of two places differ by the factor exp(-20 / 2) = 5e-5, so that noise takes a pixel to one of the
80 other periods of 1280 px with a probability of 0.4 % at most. It matters with few periods, whose residual at a wrong
place may be small by chance: with five and white at 3 % of full scale, 0.04 % of the readings are wrong instead of 0.2
%, with three none instead of half of them. Eight periods lose no pixel."""

REACH_PERIODS = 1 / 8
"""Largest distance between the place that the first period tells and the one that all images tell, in periods. In the
authors' captures 99 % of the pixels are within a fiftieth; from a quarter on, a Gauss-Newton step is wrong."""

CONTRAST_PIXELS = 20_000
"""Largest number of pixels from which contrasts are measured; their standard error is then below 0.002."""

CONTRAST_ROUNDS = 3
"""Number of times that contrasts and places are found in turns; the third changes contrasts by less than 0.002."""

MIN_PERIOD_CONTRAST = 0.1
"""Least contrast of a further period as a fraction of the first, because a period without contrast tells nothing."""


class PeriodMatch(NamedTuple):
    """The places at which the images of all periods fit best to a pixel.

    phase : Phase of the first period. units : (n, F + 1) float32, images as in `PeriodTable.values`.
    place : (h, w) float32, projector pixels, of the first period's phase in the best of its periods.
    column : (h, w) int32, projector pixel at which all images fit best. residual, rival : (h, w) float32, sum of the
        squares of the differences at the best place, and in the best other period; fractions of the amplitude.
    """

    phase: Phase
    units: np.ndarray
    place: np.ndarray
    column: np.ndarray
    residual: np.ndarray
    rival: np.ndarray

    @property
    def fits(self) -> np.ndarray:
        """(h, w) bool, whether the best place fits much better than any other."""
        return np.asarray(self.residual < MAX_RESIDUAL_RATIO * self.rival)

    @property
    def evidence(self) -> np.ndarray:
        """(h, w) float32, how much more the best other period leaves unexplained, squared units of the frames; NaN
        where no place fits."""
        with np.errstate(invalid="ignore"):
            return np.asarray((self.rival - self.residual) * self.phase.modulation**2)


@dataclass(frozen=True)
class MicroPhaseShifting(Code):
    """Fringes of several similar short periods: three shifts of the first period, one image of each further one.

    Light from other surfaces, or from below the surface, is blurred so much that fringes of a short period do not show
    in it: it is the same in all images, and moves no phase. One period cannot tell its fringes from each other; all
    periods together can. The offset and the amplitude of a pixel are those of the first period.

    Parameters
    ----------
    periods_px : periods in projector pixels, in the order of the images. None at all: `micro_periods` chooses
        `n_periods` of about `period_px` for the size of the projector.
    period_px : float, projector pixels, first of the periods that are chosen. Its authors advise about 16 against
        interreflection, and 32 to 64 against subsurface scattering and defocus.
    n_periods : int >= 2, number of periods that are chosen; the code has two images more.
    convention : FringeConvention; by default that of its authors' captures, whose cosine starts at the centre of the
        first pixel and moves backward.
    refinement : "first-period": the fraction of a pixel is that of the first period's phase, as published.
        "all-periods": it is that of a least-squares fit to all images, with the contrast of each period as measured.
        With the default periods the noise is a third less.

    References
    ----------
    Gupta, Nayar: "Micro phase shifting", CVPR (2012). Their omega_f is our 2 pi / periods_px[f].

    Examples
    --------
    >>> code = MicroPhaseShifting((16.0, 17.0, 14.5))
    >>> code.names(64)
    ['phase0', 'phase1', 'phase2', 'period1', 'period2']
    >>> code.patterns(64)[0, :16:8]  # the first period
    array([1., 0.], dtype=float32)
    """

    periods_px: tuple[Annotated[float, Bounds("projector pixels", MIN_PERIOD_PX, 1e6)], ...] = ()
    period_px: Annotated[float, Bounds("projector pixels", MIN_PERIOD_PX, 1e6)] = 16.0
    n_periods: Annotated[int, whole(2, "frames")] = 8
    convention: FringeConvention = field(default_factory=lambda: FringeConvention(direction="backward", origin_px=0.5))
    refinement: Literal["first-period", "all-periods"] = "first-period"

    type_name: ClassVar[str] = "micro-phase-shifting"
    title: ClassVar[str] = "Structured light (micro phase shifting)"

    def __post_init__(self) -> None:
        check_fields(self)
        if len(self.periods_px) == 1:
            raise ValueError("expected periods_px to be two or more periods, or none, got one.")

    def periods(self, size: int) -> tuple[float, ...]:
        """The periods for `size` projector pixels."""
        return self.periods_px or micro_periods(size, self.period_px, self.n_periods)

    def names(self, size: int) -> list[str]:
        further = len(self.periods_px) or self.n_periods
        return [*(f"phase{s}" for s in range(SHIFTS)), *(f"period{f}" for f in range(1, further))]

    def _shown(self, size: int) -> list[tuple[int, float, int]]:
        """Index of the period, period in pixels, and shift of each image."""
        periods = self.periods(size)
        return [*((0, periods[0], s) for s in range(SHIFTS)), *((f, periods[f], 0) for f in range(1, len(periods)))]

    def patterns(self, size: int) -> np.ndarray:
        x = np.arange(size) + 0.5
        shown = [self.convention.pattern(x, period, step, SHIFTS) for _, period, step in self._shown(size)]
        return np.array(shown, dtype=np.float32)

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        return tuple(Fringes(axis, period) for period in self.periods(size))

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        for f, period, step in self._shown(size):
            cosine, sine = channels[f]
            shift = 2 * math.pi * self.convention.shift_turns(step, SHIFTS, period)
            yield 0.5 * (white + math.cos(shift) * cosine + math.sin(shift) * sine)

    def white_and_black(self, size: int, names: list[str], frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        phase = phase_of(frames[:SHIFTS])
        return phase.mean + phase.modulation, phase.mean - phase.modulation

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        return thresholds.phase.least_signal(SHIFTS, FRINGE_VISIBILITY, FrameContent(), background)

    @property
    def details(self) -> str:
        return f"micro phase shifting, {len(self.periods_px) or self.n_periods} periods of about {self._first:g} px"

    @property
    def _first(self) -> float:
        return self.periods_px[0] if self.periods_px else self.period_px

    def representative(self, size: int) -> list[str]:
        return ["phase0", self.names(size)[-1]]

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        return period_contradiction(seen, self)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        capture, frames, periods = seen.capture, seen.frames, self.periods(seen.size)
        fits_all = self.refinement == "all-periods"
        contrast = self.contrasts(seen) if fits_all else np.ones(len(periods))
        coordinate = np.empty(frames.shape[1:], dtype=np.float32)
        status = np.zeros(coordinate.shape, dtype=np.uint8)
        sigma_px = None if capture.noise(frames[0, :1]) is None else np.empty_like(coordinate)
        table = period_table(periods, self.convention, seen.size, contrast)
        for rows in bands(len(status)):
            band, refused = frames[:, rows], status[rows]
            match = self.match(band, periods, table)
            sigma = phase_sigma(capture, match.phase, SHIFTS)
            if fits_all:
                coordinate[rows], spread = self._fitted(match, periods, contrast)
            else:
                coordinate[rows] = _within_column(match, OUTSIDE_CURVATURE * (2 * math.pi / min(periods)) ** 2)
                spread = np.array(periods[0] / (2 * math.pi) * math.sqrt(2 / SHIFTS), dtype=np.float32)
            noise = capture.noise(match.phase.mean)
            if noise is not None:
                refused[~(match.evidence >= MIN_EVIDENCE * noise**2)] = Status.CODE_ERROR
            refused[~match.fits] = Status.CODE_ERROR
            washed_out = 2 * match.phase.modulation < thresholds.gray.relative_bit * seen.contrast.values[rows]
            weak = modulation_is_weak(capture, match.phase, sigma, thresholds.phase)
            refused[weak | washed_out] = Status.LOW_SIGNAL
            refused[capture.saturated(band)] = Status.SATURATED
            if sigma_px is not None and sigma is not None:
                sigma_px[rows] = sigma * (spread / np.float32(math.sqrt(2 / SHIFTS)))
        return AxisCode(coordinate, status, periods[0], sigma_px)

    def match(self, frames: np.ndarray, periods: Sequence[float], table: PeriodTable) -> PeriodMatch:
        """The columns that fit best to frames (F + 2, h, w)."""
        phase, places, units = self._units(frames, periods)
        shape = phase.mean.shape
        period, reach = np.float32(periods[0]), np.float32(min(periods) * REACH_PERIODS)
        place, residual, rival = (np.empty(places.size, dtype=np.float32) for _ in range(3))
        column = np.empty(places.size, dtype=np.int32)
        found = (place, column, residual, rival)
        in_blocks(find_columns, len(places), units, places, table, period, reach, *found)
        return PeriodMatch(phase, units, *(x.reshape(shape) for x in found))

    def _units(self, frames: np.ndarray, periods: Sequence[float]) -> tuple[Phase, np.ndarray, np.ndarray]:
        """Phase of the first period, (n,) float32 place within it in turns, and (n, F + 1) float32 images as in
        `PeriodTable.values`."""
        phase = phase_of(frames[:SHIFTS])
        places = self.convention.place_turns(phase.normalised, periods[0]).astype(np.float32).ravel()
        units = np.empty((places.size, len(periods) + 1), dtype=np.float32)
        units[:, 0], units[:, 1] = np.cos(2 * np.pi * places), np.sin(2 * np.pi * places)
        with np.errstate(divide="ignore", invalid="ignore"):
            for f in range(1, len(periods)):
                units[:, f + 1] = ((frames[f + SHIFTS - 1] - phase.mean) / phase.modulation).ravel()
        return phase, places, units

    def table_of(self, size: int, gamma: float) -> PeriodTable:
        """Values of the images at each projector pixel if the projector has that gamma."""
        shown = self.patterns(size)[:, None] ** np.float32(gamma)
        values = self._units(shown, self.periods(size))[2]
        slopes = np.gradient(values, axis=0).astype(np.float32)
        return PeriodTable(values, slopes, (slopes**2).sum(axis=1))

    def _fitted(
        self, match: PeriodMatch, periods: Sequence[float], contrast: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coordinate (h, w) of the least residual of all images, and its standard deviation in projector pixels for
        noise of one amplitude."""
        place, spread = np.empty((2, match.column.size), dtype=np.float32)
        omega, start = (np.array(values, dtype=np.float32) for values in angles(periods, self.convention))
        reach = np.float32(min(periods) * REACH_PERIODS)
        scale = contrast.astype(np.float32)
        in_blocks(fit_places, place.size, match.units, match.column.ravel(), omega, start, scale, reach, place, spread)
        return place.reshape(match.column.shape), spread.reshape(match.column.shape)

    def contrasts(self, seen: AxisFrames) -> np.ndarray:
        """(F,) contrast of each period as a fraction of the first, measured from pixels all over the image.

        Defocus and scattering lower the contrast of shorter periods. The contrast is that of a least-squares fit of
        each period's images to the places that all images tell, in turns with these places.
        """
        periods, size = self.periods(seen.size), seen.size
        frames = brightest(seen, SHIFTS, CONTRAST_PIXELS)
        contrast = np.ones(len(periods))
        omega, start = angles(periods, self.convention)
        for _ in range(CONTRAST_ROUNDS):
            match = self.match(frames, periods, period_table(periods, self.convention, size, contrast))
            place = self._fitted(match, periods, contrast)[0].ravel()
            fits = match.fits.ravel()
            if not fits.any():
                break
            shown = np.cos(omega[:, None] * place[fits] - start[:, None])
            measured = (shown[1:] * match.units[fits, 2:].T).sum(axis=1) / (shown[1:] ** 2).sum(axis=1)
            contrast[1:] = np.clip(measured, MIN_PERIOD_CONTRAST, 1 / MIN_PERIOD_CONTRAST)
        return contrast


def _within_column(match: PeriodMatch, margin_px: float) -> np.ndarray:
    """(h, w) place of the first period's phase; where it lies outside the column that all images found, that column's
    nearer edge, because the phase tells a fraction of a column and never another column. A place that is less than
    `margin_px` outside is kept."""
    clipped = np.clip(match.place, match.column, match.column + 1)
    return np.where(np.abs(match.place - clipped) <= margin_px, match.place, clipped)


def angles(periods: Sequence[float], convention: FringeConvention) -> tuple[np.ndarray, np.ndarray]:
    """(F,) float64 each: omega, radians per projector pixel, and phase p, radians, of images cos(omega x - p)."""
    start = [2 * math.pi * convention.shift_turns(0, SHIFTS, period) for period in periods]
    return 2 * math.pi / np.asarray(periods, dtype=np.float64), np.array(start)


def period_table(
    periods: Sequence[float], convention: FringeConvention, size: int, contrast: np.ndarray
) -> PeriodTable:
    """Values of the images at each projector pixel, if periods have that contrast (F,) as a fraction of the first."""
    omega, start = angles(periods, convention)
    x = np.arange(size)[:, None] + 0.5
    first, further = omega[:1] * x, omega[1:] * x - start[1:]
    values = np.hstack([np.cos(first), np.sin(first), contrast[1:] * np.cos(further)])
    slopes = np.hstack(
        [-omega[0] * np.sin(first), omega[0] * np.cos(first), -contrast[1:] * omega[1:] * np.sin(further)]
    )
    return PeriodTable(*(table.astype(np.float32) for table in (values, slopes, (slopes**2).sum(axis=1))))


def brightest(seen: AxisFrames, steps: int, n: int) -> np.ndarray:
    """(k, 1, m) frames at no more than about `n` pixels, evenly spread over the half with more modulation.

    Parameters
    ----------
    steps : int, number of the first frames whose modulation it is.
    """
    modulation = phase_of(seen.frames[:steps]).modulation.ravel()
    with np.errstate(invalid="ignore"):
        usable = ~seen.capture.saturated(seen.frames).ravel() & (modulation > 0)
    if not usable.any():
        return seen.frames.reshape(len(seen.frames), 1, -1)[..., :0]
    strong = np.flatnonzero(usable & (modulation >= np.median(modulation[usable])))
    return seen.frames.reshape(len(seen.frames), 1, -1)[..., strong[:: 1 + len(strong) // n]]
