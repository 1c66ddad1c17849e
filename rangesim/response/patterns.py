# SPDX-License-Identifier: Apache-2.0
"""Responses to where light left the projector: Gray code, fringes, images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np

from rangesim.response.base import DenseResponse, LightPath, Math
from rangesim.response.defocus import BlurredImage, blurred_stripes, fringe_contrast
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields
from rangesim.settings.config import shown

Axis = Annotated[int, Bounds("0 (columns) or 1 (rows)", 0, 1)]


@dataclass(frozen=True)
class GrayBits(DenseResponse):
    """Bits of the Gray code of the projector column or row, most significant first; pixels are squares.

    Out of focus, the edges of the stripes become error functions.
    """

    axis: Axis
    """0: columns (u), 1: rows (v)."""
    bits: Annotated[int, Bounds("a number of bits", 1, 32)]
    shift: Annotated[int, Bounds("a number of bits", 0, 31)] = 0
    """Finest bits left out."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.shift >= self.bits:
            raise ValueError(f"expected shift to leave at least one of {self.bits} bits, got {self.shift}.")

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

    axis: Axis
    period_px: Annotated[float, Bounds("positive and finite", 1e-3, 1e6)]
    channels: ClassVar[int] = 2  # type: ignore[misc]

    def __post_init__(self) -> None:
        check_fields(self)

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

    def __post_init__(self) -> None:
        values = self.patterns
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub" or values.ndim != 3 or not values.size:
            raise ValueError(f"expected patterns to be an array (k, height, width) of numbers, got {shown(values)}.")
        limits.check("frames", len(values), "patterns")
        if not np.isfinite(values).all():
            raise ValueError("expected patterns to be finite, got NaN or infinite pixels.")

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
