# SPDX-License-Identifier: Apache-2.0
"""Responses to the projector pixel that light left: Gray code, fringes, dots, images."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np

from rangesim.response.defocus import BlurredImage, blurred_stripes, fringe_contrast
from rangesim.response.response import DenseResponse, LightPath, Math, NumpyMath
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields, whole
from rangesim.settings.config import shown
from rangesim.settings.seeds import SEEDS

MAX_DOT = 1 / 3
"""Largest standard deviation of a dot as a fraction of the spacing. A place sees the dots of nine cells; of a wider dot
more than 1 % of its height would be left out."""
MAX_BLURRED_DOT = 0.5
"""Largest standard deviation of a dot out of focus as a fraction of the spacing. A wider one would reach beyond the
nine cells; its contrast is then below a tenth of that in focus, so more blur changes little."""

Axis = Annotated[int, Bounds("0 (columns) or 1 (rows)", 0, 1)]
"""Axis along which a pattern varies: 0 for columns (u), 1 for rows (v). It is the index of u or v in `LightPath`."""


@dataclass(frozen=True)
class GrayBits(DenseResponse):
    """Bits of the Gray code of the projector column or row, one channel per bit, the most significant first.

    In focus, a pixel is a uniform square. Out of focus, the edges of the stripes are error functions.

    Parameters
    ----------
    axis : 0 for columns (u), 1 for rows (v).
    bits : number of bits of the code.
    shift : number of the finest bits to leave out.

    Raises
    ------
    ValueError
        A value out of its bounds, or no bit left.

    Examples
    --------
    Column 5 has the Gray code 5 ^ (5 >> 1) = 0b111:

    >>> from rangesim.response import LightPath, NumpyMath
    >>> path = LightPath(u=np.array([5.5]), v=np.array([0.5]), path_length_m=1.0, is_first=True)
    >>> [int(bit[0]) for bit in GrayBits(axis=0, bits=4).weights(path, NumpyMath())]
    [0, 1, 1, 1]
    """

    axis: Axis
    bits: Annotated[int, Bounds("a number of bits", 1, 32)]
    shift: Annotated[int, Bounds("a number of bits", 0, 31)] = 0

    type_name: ClassVar[str] = "GrayBits"

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
    """Sinusoidal fringes: cos and sin of the phase 2 pi x / period along the projector's columns or rows.

    The coordinate x is continuous. Out of focus, the blur and the width of the projector's pixels lower the contrast.

    Parameters
    ----------
    axis : 0 for columns (u), 1 for rows (v).
    period_px : period of the fringes, projector pixels.

    Examples
    --------
    >>> from rangesim.response import LightPath, NumpyMath
    >>> path = LightPath(u=4.0, v=0.0, path_length_m=1.0, is_first=True)
    >>> [round(float(weight), 9) for weight in Fringes(axis=0, period_px=16.0).weights(path, NumpyMath())]
    [0.0, 1.0]
    """

    axis: Axis
    period_px: Annotated[float, Bounds("positive and finite", 1e-3, 1e6)]
    channels: ClassVar[int] = 2  # type: ignore[misc]
    type_name: ClassVar[str] = "Fringes"

    def __post_init__(self) -> None:
        check_fields(self)

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        phase = path[self.axis] * (2 * np.pi / self.period_px)
        if path.blur_px is None:
            return [m.cos(phase), m.sin(phase)]
        contrast = fringe_contrast(self.period_px, path.blur_px, m)
        return [contrast * m.cos(phase), contrast * m.sin(phase)]


@dataclass(frozen=True)
class Dots(DenseResponse):
    """A pattern of random dots, as a laser behind a diffractive element projects it: all of its light is in the dots.

    The projector's image is divided into cells, and each cell has one dot at a random place. A dot is a Gaussian. The
    mean of the pattern over the image is 1, so its dots are brighter than white light of the same power. Out of focus
    the dots are wider and fainter.

    Parameters
    ----------
    width, height : pixels of the projector that shows the pattern.
    spacing_px : edge of the cells, projector pixels; it is rounded so that whole cells fill the image.
    dot_px : standard deviation of a dot, projector pixels; at most a third of the spacing.
    seed : seed of the places.

    Raises
    ------
    ValueError
        A value out of its bounds, or dots that are wider than a third of their spacing.

    Examples
    --------
    >>> dots = Dots(64, 48, spacing_px=8.0)
    >>> dots.number
    48
    >>> round(float(dots.image().mean()), 1)
    1.0
    """

    width: Annotated[int, whole(1, "projector")]
    height: Annotated[int, whole(1, "projector")]
    spacing_px: Annotated[float, Bounds("projector pixels", 0.1, 1e6)] = 6.0
    dot_px: Annotated[float, Bounds("projector pixels", 1e-3, 1e6)] = 0.8
    seed: Annotated[int, Bounds("a seed", 0, SEEDS - 1)] = 0
    channels: ClassVar[int] = 1  # type: ignore[misc]
    type_name: ClassVar[str] = "Dots"

    def __post_init__(self) -> None:
        check_fields(self)
        if self.dot_px > MAX_DOT * self.spacing_px:
            raise ValueError(
                f"expected dot_px to be at most a third of spacing_px, got {self.dot_px:g} and {self.spacing_px:g}."
            )
        limits.check("pixels", self.number, "dots")

    @property
    def cells(self) -> tuple[int, int]:
        """Number of cells along the width and along the height."""
        return max(1, round(self.width / self.spacing_px)), max(1, round(self.height / self.spacing_px))

    @property
    def number(self) -> int:
        """Number of dots."""
        columns, rows = self.cells
        return columns * rows

    def check(self, width: int, height: int) -> None:
        if (width, height) != (self.width, self.height):
            raise ValueError(
                f"expected a projector of {self.width} x {self.height} pixels, as the pattern of dots, "
                f"got {width} x {height}."
            )

    @cached_property
    def _places(self) -> np.ndarray:
        """(2, number) float32, projector pixels, u and v of the dot of each cell, row by row."""
        columns, rows = self.cells
        within = np.random.default_rng(self.seed).random((2, rows, columns))
        row, column = np.mgrid[:rows, :columns]
        u, v = (column + within[0]) * (self.width / columns), (row + within[1]) * (self.height / rows)
        return np.stack([u.ravel(), v.ravel()]).astype(np.float32)

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        columns, rows = self.cells
        wide, high = self.width / columns, self.height / rows
        variance: Any = self.dot_px**2
        if path.blur_px is not None:
            widest = max(variance, (MAX_BLURRED_DOT * min(wide, high)) ** 2)
            blurred = variance + path.blur_px * path.blur_px
            variance = m.select(blurred < widest, blurred, widest)
        all_u, all_v = (m.array(places) for places in self._places)
        column, row = m.floor(path.u / wide), m.floor(path.v / high)
        light: Any = 0.0
        for down in (-1, 0, 1):
            for across in (-1, 0, 1):
                i, j = column + across, row + down
                exists = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
                index = m.unsigned(m.select(exists, j * columns + i, 0.0))
                x, y = path.u - m.lookup(all_u, index), path.v - m.lookup(all_v, index)
                light = light + m.select(exists, m.exp((x * x + y * y) * (-0.5 / variance)), 0.0)
        return [light * (wide * high / (2 * np.pi)) / variance]

    def image(self) -> np.ndarray:
        """(height, width) float32, the pattern at the centres of the projector's pixels; its mean is about 1."""
        return image_of(self, self.width, self.height)[0]


def image_of(response: DenseResponse, width: int, height: int) -> np.ndarray:
    """(c, height, width) float32, weights of a response to the projector pixel, at the centres of the pixels."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    weights = response.weights(LightPath(x, y, np.zeros_like(x), True), NumpyMath())
    return np.stack([np.broadcast_to(w, x.shape) for w in weights]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Images(DenseResponse):
    """Arbitrary patterns, read at the projector pixel that the light left.

    Two stacks with the same pixels are equal, also after pickling, so sensors that show them share their channels. If
    the projector is out of focus, the patterns are read from blurred copies.

    Parameters
    ----------
    patterns : (k, height, width) float32, fraction of full power per projector pixel, each a uniform square. The array
        is copied, and the copy is read-only.

    Raises
    ------
    ValueError
        `patterns` is no such array, has no pixels, or has pixels that are not finite.

    Examples
    --------
    >>> stripes = np.tile([[0.0, 1.0]], (2, 4, 4)).astype(np.float32)
    >>> images = Images(stripes)
    >>> images.channels
    2
    >>> images == Images(stripes.copy())
    True
    """

    patterns: np.ndarray

    type_name: ClassVar[str] = "Images"

    def __post_init__(self) -> None:
        values = self.patterns
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub" or values.ndim != 3 or not values.size:
            raise ValueError(f"expected patterns to be an array (k, height, width) of numbers, got {shown(values)}.")
        limits.check("frames", len(values), "patterns")
        with np.errstate(over="ignore"):
            kept = np.array(values, dtype=np.float32, order="C")
        if not np.isfinite(kept).all():
            raise ValueError("expected patterns to be finite, got NaN or infinite pixels.")
        kept.setflags(write=False)
        object.__setattr__(self, "patterns", kept)

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and self._digest == other._digest  # type: ignore[attr-defined]

    def __hash__(self) -> int:
        return hash(self._digest)

    def __reduce__(self) -> tuple[type[Images], tuple[np.ndarray]]:
        """The class and its patterns, for pickle: the blurred copies are made anew instead of stored."""
        return type(self), (self.patterns,)

    @cached_property
    def _digest(self) -> str:
        """SHA-256 of the shape and the pixels. It is the same in every process; `hash` of bytes is not."""
        digest = hashlib.sha256(repr(self.patterns.shape).encode())
        digest.update(self.patterns.data)
        return digest.hexdigest()

    @property
    def channels(self) -> int:  # type: ignore[override]
        return len(self.patterns)

    def check(self, width: int, height: int) -> None:
        if self.patterns.shape[1:] != (height, width):
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
        return [m.lookup(pattern.ravel(), index) for pattern in self.patterns]

    @cached_property
    def _blurred(self) -> list[BlurredImage]:
        return [BlurredImage(pattern) for pattern in self.patterns]
