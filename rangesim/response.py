# SPDX-License-Identifier: Apache-2.0
"""What a sensor reads of one light path: a weight that depends on (u, v) and the path length.

A range sensor is a linear functional of light paths. A path leaves the projector at (u, v), has the
optical length l, and brings the radiance w to a pixel. A `DenseResponse` adds w * r_c(u, v, l) to
each of its channels c; a `SparseResponse` adds w to one of many bins. Frames that a sensor can
compute from other frames (an inverse pattern is white minus the pattern; four taps are two phasor
components and the mean) are no channels: sensors declare the smallest basis, and build their frames
from it.

The formulas are written once, over `Math`: NumPy evaluates them for tests and pattern images,
the renderer evaluates them per light path.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from rangesim.defocus import BlurredImage, blurred_stripes, fringe_contrast

SPEED_OF_LIGHT = 299_792_458.0
"""Metres per second in vacuum, exact."""


KINDS = ("direct", "multipath", "via_delta", "caustic", "glint")
"""Kinds of projector light, in the order of `rangesim.signals.EnergySplit`; a path's `kind` is an index."""
DIRECT, MULTIPATH, VIA_DELTA, CAUSTIC, GLINT = range(len(KINDS))


class LightPath(NamedTuple):
    """One light path, or arrays of them.

    u, v : projector pixel coordinates, 0 <= u <= width, 0 <= v <= height.
    path_length_m : optical length from projector to camera, metres (refractive index included).
    is_first : whether the camera sees the lit point directly or through delta surfaces only.
    kind : unsigned, index into `KINDS`.
    blur_px : standard deviation of the light's spread over the projector's image plane (defocus), projector pixels;
        None: sharp.
    """

    u: Any
    v: Any
    path_length_m: Any
    is_first: Any
    kind: Any = DIRECT
    blur_px: Any = None


class Math(Protocol):
    """The array functions a response may use."""

    def cos(self, x: Any) -> Any: ...
    def sin(self, x: Any) -> Any: ...
    def floor(self, x: Any) -> Any: ...
    def abs(self, x: Any) -> Any: ...
    def exp(self, x: Any) -> Any: ...
    def erf(self, x: Any) -> Any: ...
    def select(self, condition: Any, a: Any, b: Any) -> Any: ...
    def unsigned(self, x: Any) -> Any:
        """`x` (>= 0) truncated to a 32-bit unsigned integer."""

    def array(self, table: np.ndarray) -> Any:
        """A flat float32 table that is read more than once."""

    def lookup(self, table: Any, index: Any) -> Any:
        """table[index] for a flat float32 table, from `array` or not."""


class NumpyMath:
    """`Math` on NumPy arrays."""

    cos, sin, floor, abs, exp = np.cos, np.sin, np.floor, np.abs, np.exp
    select = staticmethod(np.where)

    @staticmethod
    def erf(x: Any) -> Any:
        from scipy.special import erf

        return erf(x)

    @staticmethod
    def unsigned(x: Any) -> Any:
        return np.asarray(x).astype(np.uint32)

    array = staticmethod(np.asarray)

    @staticmethod
    def lookup(table: Any, index: Any) -> Any:
        return table[index]


class Response(ABC):
    """A linear functional of light paths."""

    channels: int
    """Number of channels (dense) or bins (sparse)."""

    def check(self, width: int, height: int) -> None:  # noqa: B027 (most responses fit any projector)
        """Raise ValueError if a projector of that many pixels cannot show this response."""


class DenseResponse(Response):
    """Every path counts in every channel, with a weight."""

    @abstractmethod
    def weights(self, path: LightPath, m: Math) -> list[Any]:
        """One real weight per channel."""


class SparseResponse(Response):
    """A path counts in one bin, with weight one, or in none."""

    @abstractmethod
    def bin(self, path: LightPath, m: Math) -> Any:
        """Unsigned bin index; an index >= `channels` means none."""


@dataclass(frozen=True)
class GrayBits(DenseResponse):
    """Bits of the Gray code of the projector column or row, most significant first; pixels are squares.

    Out of focus, the edges of the stripes become error functions.
    """

    axis: int
    """0: columns (u), 1: rows (v)."""
    bits: int
    shift: int = 0
    """Finest bits left out."""

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.bits - self.shift

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        if path.blur_px is not None:
            bits = reversed(range(self.shift, self.bits))
            return [blurred_stripes(path[self.axis], 4.0 * 2**b, path.blur_px, m) for b in bits]
        coordinate = m.unsigned(path[self.axis])
        gray = coordinate ^ (coordinate >> 1)
        return [m.select((gray >> b) & 1 == 1, 1.0, 0.0) for b in reversed(range(self.shift, self.bits))]


@dataclass(frozen=True)
class Fringes(DenseResponse):
    """cos and sin of the phase 2 pi x / period along the projector columns or rows, x continuous.

    Out of focus, and where the projector's pixels are finite, they lose contrast.
    """

    axis: int
    period_px: float
    channels: ClassVar[int] = 2  # type: ignore[misc]

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        phase = path[self.axis] * (2 * np.pi / self.period_px)
        if path.blur_px is None:
            return [m.cos(phase), m.sin(phase)]
        contrast = fringe_contrast(self.period_px, path.blur_px, m)
        return [contrast * m.cos(phase), contrast * m.sin(phase)]


@dataclass(frozen=True, eq=False)
class Images(DenseResponse):
    """Arbitrary patterns, (k, height, width) float32 in 0..1, each projector pixel a uniform square.

    Out of focus, they are read from blurred copies.
    """

    patterns: np.ndarray

    @property
    def channels(self) -> int:  # type: ignore[override]
        return len(self.patterns)

    def check(self, width: int, height: int) -> None:
        if self.patterns.ndim != 3 or self.patterns.shape[1:] != (height, width):
            raise ValueError(
                f"expected patterns of shape (k, {height}, {width}) for a projector of {width} x {height} pixels, "
                f"got {self.patterns.shape}."
            )

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        _, height, width = self.patterns.shape
        if path.blur_px is not None:
            return [image.at(path.u, path.v, path.blur_px, m) for image in self._blurred]
        column = m.unsigned(m.select(path.u < width, path.u, width - 1.0))
        row = m.unsigned(m.select(path.v < height, path.v, height - 1.0))
        index = row * width + column
        return [m.lookup(np.ascontiguousarray(p, dtype=np.float32).ravel(), index) for p in self.patterns]

    @cached_property
    def _blurred(self) -> list[BlurredImage]:
        return [BlurredImage(pattern) for pattern in self.patterns]


@dataclass(frozen=True)
class Phasor(DenseResponse):
    """Correlation of the returned modulation with a reference in phase and in quadrature, over 2 pi f l / c.

    A sine source gives cos and sin; a square source and a square reference give triangle waves of the same
    period, which hold odd harmonics (the "wiggling" error of AMCW cameras).
    """

    modulation_hz: float
    square: bool = False
    channels: ClassVar[int] = 2  # type: ignore[misc]

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        turns = path.path_length_m * (self.modulation_hz / SPEED_OF_LIGHT)
        if self.square:
            return [_triangle(turns, m), _triangle(turns - 0.25, m)]
        return [m.cos(2 * np.pi * turns), m.sin(2 * np.pi * turns)]


def _triangle(turns: Any, m: Math) -> Any:
    """Triangle wave of period 1 with value 1 at 0 and -1 at 1/2."""
    return 4 * m.abs(turns - m.floor(turns) - 0.5) - 1


@dataclass(frozen=True)
class FirstReturn(DenseResponse):
    """Radiance, and radiance times path length, of the paths that are lit where the camera looks."""

    channels: ClassVar[int] = 2  # type: ignore[misc]

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        first = m.select(path.is_first, 1.0, 0.0)
        return [first, first * path.path_length_m]


@dataclass(frozen=True)
class LengthBins(SparseResponse):
    """Histogram over the path length (round trip), `channels` bins from `start_m`, `width_m` each."""

    start_m: float
    width_m: float
    channels: int  # type: ignore[misc]

    def bin(self, path: LightPath, m: Math) -> Any:
        index, inside = _length_bin(path, m, self.start_m, self.width_m, self.channels)
        return m.unsigned(m.select(inside, index, float(self.channels)))


@dataclass(frozen=True)
class LengthSplit(SparseResponse):
    """The energy split per path length: `bins` bins from `start_m`, `width_m` each, for every one of `KINDS`.

    Channels are kind-major: channel kind * bins + bin. Their sum over the kinds is that of `LengthBins`, their sum over
    the bins the `rangesim.signals.EnergySplit` of what lies within them.
    """

    start_m: float
    width_m: float
    bins: int

    @property
    def channels(self) -> int:  # type: ignore[override]
        return len(KINDS) * self.bins

    def bin(self, path: LightPath, m: Math) -> Any:
        index, inside = _length_bin(path, m, self.start_m, self.width_m, self.bins)
        place = path.kind * self.bins + m.unsigned(m.select(inside, index, 0.0))
        return m.select(inside, place, self.channels)


def _length_bin(path: LightPath, m: Math, start_m: float, width_m: float, bins: int) -> tuple[Any, Any]:
    """Place of a path length in bins, and whether it is in any of them."""
    position = (path.path_length_m - start_m) * (1 / width_m)
    return position, (position >= 0) & (position < bins)
