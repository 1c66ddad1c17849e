# SPDX-License-Identifier: Apache-2.0
"""Responses to the projector pixel that light left: Gray code, fringes, stripes, dots, images."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
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


MIN_INSIDE = 0.1
"""Least fraction of the blur inside the projector that stripes are divided by. It is a half at the ends of a projector
that is wider than the blur; points with less are not lit."""


@dataclass(frozen=True)
class GrayBits(DenseResponse):
    """Bits of the Gray code of the projector column or row, one channel per bit, the most significant first.

    In focus, a pixel is a uniform square. Out of focus, the edges of the stripes are error functions.

    Parameters
    ----------
    axis : 0 for columns (u), 1 for rows (v).
    bits : number of bits of the code.
    cell_px : projector pixels per cell of the code.

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
    cell_px: Annotated[int, whole(1, "projector")] = 1

    type_name: ClassVar[str] = "GrayBits"

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.bits

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        bits = reversed(range(self.bits))
        if path.blur_px is not None:
            return [blurred_stripes(path[self.axis], 4.0 * self.cell_px * 2**b, path.blur_px, m) for b in bits]
        cell = m.unsigned(path[self.axis] * (1 / self.cell_px))
        gray = cell ^ (cell >> 1)
        return [m.select((gray >> b) & 1 == 1, 1.0, 0.0) for b in bits]


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


class _Tabulated(DenseResponse):
    """A response with tables of weights. Two with the same pixels are equal, also after pickling, so sensors that show
    them share their channels."""

    patterns: np.ndarray

    def _keep(self, n_dims: int, shape: str) -> None:
        """Copy the patterns, read-only; ValueError if they are no array of finite numbers with these dimensions."""
        values = self.patterns
        is_array = isinstance(values, np.ndarray) and values.dtype.kind in "fiub"
        if not is_array or values.ndim != n_dims or not values.size:
            raise ValueError(f"expected patterns to be an array {shape} of numbers, got {shown(values)}.")
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

    def __reduce__(self) -> tuple[type[_Tabulated], tuple[Any, ...]]:
        """The class and its fields, for pickle: the blurred copies are made anew instead of stored."""
        return type(self), tuple(getattr(self, field.name) for field in fields(self))  # type: ignore[arg-type]

    @cached_property
    def _digest(self) -> str:
        """SHA-256 of the shape, the pixels and all else. It is the same in every process; `hash` of bytes is not."""
        others = [getattr(self, field.name) for field in fields(self) if field.name != "patterns"]  # type: ignore[arg-type]
        digest = hashlib.sha256(repr((self.patterns.shape, *others)).encode())
        digest.update(self.patterns.data)
        return digest.hexdigest()

    @property
    def channels(self) -> int:  # type: ignore[override]
        return len(self.patterns)

    @cached_property
    def _blurred(self) -> list[BlurredImage]:
        return [BlurredImage(pattern) for pattern in self.patterns]


@dataclass(frozen=True, eq=False)
class Stripes(_Tabulated):
    """Arbitrary stripes along the projector's columns or rows, one channel per pattern.

    Two stacks with the same pixels are equal. If the projector is out of focus, they are read from blurred copies, as
    fractions of white with the same blur: near the projector's ends, where a part of the blur lies outside, patterns
    and their inverses then still add up to white.

    Parameters
    ----------
    axis : 0 for columns (u), 1 for rows (v).
    patterns : (k, size) float32, fraction of full power for each of the `size` pixels along the axis, each uniform. The
        array is copied, and the copy is read-only.

    Raises
    ------
    ValueError
        `patterns` is no such array, has no pixels, or has pixels that are not finite.

    Examples
    --------
    >>> from rangesim.response import LightPath, NumpyMath
    >>> ramp = Stripes(0, np.array([[0.0, 0.5, 1.0]]))
    >>> path = LightPath(u=np.array([0.2, 1.5, 3.0]), v=0.0, path_length_m=1.0, is_first=True)
    >>> ramp.weights(path, NumpyMath())
    [array([0. , 0.5, 1. ], dtype=float32)]
    """

    axis: Axis
    patterns: np.ndarray

    type_name: ClassVar[str] = "Stripes"

    @cached_property
    def _blurred_white(self) -> BlurredImage:
        return BlurredImage(np.ones(self.patterns.shape[1], dtype=np.float32))

    def __post_init__(self) -> None:
        check_fields(self)
        self._keep(2, "(k, size)")

    def check(self, width: int, height: int) -> None:
        size = (width, height)[self.axis]
        if self.patterns.shape[1] != size:
            raise ValueError(f"expected patterns of {size} pixels for the projector, got {self.patterns.shape[1]}.")

    def weights(self, path: LightPath, m: Math) -> list[Any]:
        x, size = path[self.axis], self.patterns.shape[1]
        if path.blur_px is not None:
            white = self._blurred_white.along(x, path.blur_px, m)
            inside = m.select(white > MIN_INSIDE, white, 1.0)
            return [image.along(x, path.blur_px, m) / inside for image in self._blurred]
        index = m.unsigned(m.select(x < size, x, size - 1.0))
        return [m.lookup(pattern, index) for pattern in self.patterns]


@dataclass(frozen=True, eq=False)
class Images(_Tabulated):
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
        self._keep(3, "(k, height, width)")

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
