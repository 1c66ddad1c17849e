# SPDX-License-Identifier: Apache-2.0
"""Responses to the length of light paths: modulated light, first return, histograms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from rangesim.response.response import KINDS, DenseResponse, LightPath, Math, SparseResponse
from rangesim.settings.bounds import Bounds, Hertz, check_fields, whole

SPEED_OF_LIGHT = 299_792_458.0
"""Speed of light in vacuum, metres per second; exact since 1983, because it defines the metre."""
StartLength = Annotated[float, Bounds("a length in metres", -1e6, 1e6)]
"""Path length at which the first bin begins, metres; negative where bins begin before the pulse."""
BinLength = Annotated[float, Bounds("positive and finite", 1e-8, 1e6)]
"""Width of a bin, metres of path length: 1e-8 m is light's way in 0.03 fs, shorter than one period of the light."""
Period = Annotated[float, Bounds("positive and finite", 1e-8, 1e9)]
"""Path length between two pulses, metres; 1e9 m is 3 s."""


@dataclass(frozen=True)
class Phasor(DenseResponse):
    """Correlation of modulated light with a reference in phase and one in quadrature (AMCW).

    The weights of a path of length l are cos and sin of the phase 2 pi f l / c. With a square source and a square
    reference they are triangle waves of the same period instead; their odd harmonics cause the "wiggling" error of AMCW
    cameras.

    Parameters
    ----------
    modulation_hz : frequency f of the modulation, hertz.
    square : whether source and reference are square waves instead of sines.

    Examples
    --------
    >>> from rangesim.response import LightPath, NumpyMath
    >>> path = LightPath(u=0.0, v=0.0, path_length_m=SPEED_OF_LIGHT / 20e6 / 8, is_first=True)  # an eighth of a period
    >>> [round(float(weight), 3) for weight in Phasor(20e6).weights(path, NumpyMath())]
    [0.707, 0.707]
    """

    modulation_hz: Hertz
    square: bool = False
    channels: ClassVar[int] = 2  # type: ignore[misc]
    type_name: ClassVar[str] = "Phasor"

    def __post_init__(self) -> None:
        check_fields(self)

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        phase = path.path_length_m * (self.modulation_hz / SPEED_OF_LIGHT)
        if self.square:
            return [_triangle(phase, m), _triangle(phase - 0.25, m)]
        return [m.cos(2 * np.pi * phase), m.sin(2 * np.pi * phase)]


def _triangle(phase: Any, m: Math) -> Any:
    """Triangle wave of period 1 whose value is 1 at 0 and -1 at 1/2."""
    return 4 * m.abs(phase - m.floor(phase) - 0.5) - 1


@dataclass(frozen=True)
class FirstReturn(DenseResponse):
    """Radiance, and radiance times path length, of the first return: light from the point that the camera sees.

    The quotient of the two channels is the mean path length of that light, in metres.

    Examples
    --------
    >>> from rangesim.response import LightPath, NumpyMath
    >>> paths = LightPath(0.0, 0.0, np.array([1.5, 2.0]), is_first=np.array([True, False]))
    >>> FirstReturn().weights(paths, NumpyMath())
    [array([1., 0.]), array([1.5, 0. ])]
    """

    channels: ClassVar[int] = 2  # type: ignore[misc]
    type_name: ClassVar[str] = "FirstReturn"

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        first = m.select(path.is_first, 1.0, 0.0)
        return [first, first * path.path_length_m]


@dataclass(frozen=True)
class TransientHistogram(SparseResponse):
    """Histogram of the path length from projector to camera (the round trip).

    Parameters
    ----------
    start_m : path length at which the first bin begins, metres.
    width_m : width of a bin, metres of path length.
    channels : number of bins.
    period_m : path length between two pulses, metres, at least that of all bins. Lengths that differ by a multiple of
        it fall into the same bin, as light of successive pulses does. None: one single pulse.
    is_shared : whether a path is shared between the two bins whose centres are nearest, in proportion to how near they
        are (linear binning). This keeps the mean length, whatever the width of the bins.

    Raises
    ------
    ValueError
        A value out of its bounds, or a period shorter than all bins together.

    Examples
    --------
    >>> from rangesim.response import LightPath, NumpyMath
    >>> histogram = TransientHistogram(start_m=1.0, width_m=0.5, channels=4)
    >>> paths = LightPath(0.0, 0.0, np.array([1.1, 2.7, 9.0]), is_first=True)
    >>> histogram.bin(paths, NumpyMath())  # 4: the last path counts in none of the bins 0 to 3
    array([0, 3, 4], dtype=uint32)
    """

    start_m: StartLength
    width_m: BinLength
    channels: Annotated[int, whole(1, "bins")]  # type: ignore[misc]
    period_m: Period | None = None
    is_shared: bool = False

    type_name: ClassVar[str] = "TransientHistogram"

    def __post_init__(self) -> None:
        check_fields(self)
        _check_period(self.period_m, self.width_m, self.channels)

    def bin(self, path: LightPath, m: Math) -> Any:
        index, inside = _length_bin(path, m, self.start_m, self.width_m, self.channels, self.period_m)
        return m.unsigned(m.select(inside, index, float(self.channels)))

    def bin_weights(self, path: LightPath, m: Math) -> list[tuple[Any, Any]]:
        if not self.is_shared:
            return super().bin_weights(path, m)
        start_m = self.start_m - self.width_m / 2  # whole numbers are then bin centres: n is the centre of bin n - 1
        place = _place(path, m, start_m, self.width_m, self.channels, self.period_m)
        upper = m.floor(place)
        lower, weight = upper - 1, place - upper
        if self.period_m is not None and _fills(self.period_m, self.width_m, self.channels):
            lower = m.select(lower < 0, float(self.channels - 1), lower)
        return [(self._index(lower, m), 1 - weight), (self._index(upper, m), weight)]

    def _index(self, place: Any, m: Math) -> Any:
        return m.unsigned(m.select((place >= 0) & (place < self.channels), place, float(self.channels)))


@dataclass(frozen=True)
class LengthSplit(SparseResponse):
    """A `TransientHistogram` for each kind of light: the energy split by path length.

    Channel kind * bins + bin holds the light of `KINDS[kind]` in a bin. The sum over kinds is the `TransientHistogram`
    with the same bins; the sum over bins is the `rangesim.signals.EnergySplit` of the light within them.

    Parameters
    ----------
    start_m, width_m, period_m : see `TransientHistogram`.
    bins : number of bins for each kind.

    Examples
    --------
    >>> LengthSplit(start_m=0.0, width_m=0.1, bins=100).channels
    500
    """

    start_m: StartLength
    width_m: BinLength
    bins: Annotated[int, whole(1, "bins")]
    period_m: Period | None = None

    type_name: ClassVar[str] = "LengthSplit"

    def __post_init__(self) -> None:
        check_fields(self)
        _check_period(self.period_m, self.width_m, self.bins)

    @property
    def channels(self) -> int:  # type: ignore[override]
        return len(KINDS) * self.bins

    def bin(self, path: LightPath, m: Math) -> Any:
        index, inside = _length_bin(path, m, self.start_m, self.width_m, self.bins, self.period_m)
        place = path.kind * self.bins + m.unsigned(m.select(inside, index, 0.0))
        return m.select(inside, place, self.channels)


def _check_period(period_m: float | None, width_m: float, bins: int) -> None:
    if period_m is not None and period_m < width_m * bins * (1 - 1e-9):
        raise ValueError(f"expected a period_m of at least the {width_m * bins:g} m of all bins, got {period_m:g}.")


def _length_bin(
    path: LightPath, m: Math, start_m: float, width_m: float, bins: int, period_m: float | None
) -> tuple[Any, Any]:
    """Position of the path length on the axis of the bins, in bin widths, and whether it lies in one of them."""
    place = _place(path, m, start_m, width_m, bins, period_m)
    return place, (place >= 0) & (place < bins)


def _place(path: LightPath, m: Math, start_m: float, width_m: float, bins: int, period_m: float | None) -> Any:
    """Position of the path length on the axis of the bins, in bin widths from the start of the first.

    With a period the position is reduced to 0 <= position < period.
    """
    place = (path.path_length_m - start_m) * (1 / width_m)
    if period_m is None:
        return place
    period = float(bins) if _fills(period_m, width_m, bins) else period_m / width_m
    place = place - period * m.floor(place * (1 / period))
    return m.select((place < 0) | (place >= period), 0.0, place)  # rounding can leave it just outside


def _fills(period_m: float, width_m: float, bins: int) -> bool:
    """Whether the bins fill the period, up to rounding."""
    return abs(period_m / width_m - bins) < 1e-6 * bins
