# SPDX-License-Identifier: Apache-2.0
"""Responses to how far light went: modulation, first return, time bins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from rangesim.response.base import KINDS, DenseResponse, LightPath, Math, SparseResponse
from rangesim.settings.bounds import Bounds, Hertz, check_fields, whole

SPEED_OF_LIGHT = 299_792_458.0
"""Metres per second in vacuum, exact."""


StartLength = Annotated[float, Bounds("a length in metres", -1e6, 1e6)]
BinLength = Annotated[float, Bounds("positive and finite", 1e-8, 1e6)]
Period = Annotated[float, Bounds("positive and finite", 1e-8, 1e9)]


@dataclass(frozen=True)
class Phasor(DenseResponse):
    """Correlation of the returned modulation with a reference in phase and in quadrature, over 2 pi f l / c.

    A sine source gives cos and sin; a square source and a square reference give triangle waves of the same
    period, which hold odd harmonics (the "wiggling" error of AMCW cameras).
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
    """Triangle wave of period 1 with value 1 at 0 and -1 at 1/2."""
    return 4 * m.abs(phase - m.floor(phase) - 0.5) - 1


@dataclass(frozen=True)
class FirstReturn(DenseResponse):
    """Radiance, and radiance times path length, of the paths that are lit where the camera looks."""

    channels: ClassVar[int] = 2  # type: ignore[misc]
    type_name: ClassVar[str] = "FirstReturn"

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        first = m.select(path.is_first, 1.0, 0.0)
        return [first, first * path.path_length_m]


@dataclass(frozen=True)
class TransientHistogram(SparseResponse):
    """Histogram over the path length (round trip), `channels` bins from `start_m`, `width_m` each.

    With a `period_m`, lengths that differ by a multiple of it are one: those of light that is sent out again and again.
    `is_shared`: a path counts in the two bins whose centres are next to it, in proportion to how near they are (linear
    binning), so that the mean length is kept, whatever the width.
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
        start_m = self.start_m - self.width_m / 2  # so that whole numbers are the centres, of the bin before
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
    """The energy split per path length: `bins` bins from `start_m`, `width_m` each, for every one of `KINDS`.

    Channels are kind-major: channel kind * bins + bin. Their sum over the kinds is that of `TransientHistogram`,
    their sum over the bins the `rangesim.signals.EnergySplit` of what lies within them. `period_m` as there.
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
    """Place of a path length in bins, and whether it is in any of them."""
    place = _place(path, m, start_m, width_m, bins, period_m)
    return place, (place >= 0) & (place < bins)


def _place(path: LightPath, m: Math, start_m: float, width_m: float, bins: int, period_m: float | None) -> Any:
    """Place of a path length in bins; in 0 .. period, if there is one."""
    place = (path.path_length_m - start_m) * (1 / width_m)
    if period_m is None:
        return place
    period = float(bins) if _fills(period_m, width_m, bins) else period_m / width_m
    place = place - period * m.floor(place * (1 / period))
    return m.select((place < 0) | (place >= period), 0.0, place)  # rounded there


def _fills(period_m: float, width_m: float, bins: int) -> bool:
    """Whether the bins leave no gap in the period but for rounding."""
    return abs(period_m / width_m - bins) < 1e-6 * bins
