# SPDX-License-Identifier: Apache-2.0
"""The interface of a response: the weight with which a sensor counts one light path.

A range sensor adds up light paths, each with a weight (a linear functional). A path leaves the projector at (u, v), has
the optical length l, and brings the radiance w to a pixel. A `DenseResponse` adds w * r_c(u, v, l) to each of its
channels c; a `SparseResponse` adds w to one of many bins. A frame that a sensor can compute from other frames needs no
channel of its own: an inverse pattern is the white image minus the pattern, and four taps are made of two phasor
components and the mean. A sensor therefore declares as few channels as possible, and computes its frames from them.

Each formula is written once, with the functions of `Math`. NumPy evaluates it for tests and pattern images, the
renderer for every light path.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from rangesim.settings.config import Named

KINDS = ("direct", "multipath", "specular", "caustic", "glint")
"""Names of the kinds of projector light, in the order of `rangesim.signals.EnergySplit`, which explains them."""
DIRECT, MULTIPATH, SPECULAR, CAUSTIC, GLINT = range(len(KINDS))
"""Indices of these kinds, as `LightPath.kind` holds them."""


class LightPath(NamedTuple):
    """One light path, or many of them as arrays.

    u, v : projector pixel coordinates where the light leaves, 0 <= u <= width, 0 <= v <= height.
    path_length_m : optical length from projector to camera, metres: each part is multiplied by its refractive index.
    is_first : whether the camera sees the lit point directly or through mirrors and clear glass only.
    kind : unsigned integer, index into `KINDS`.
    blur_px : standard deviation of the projector's defocus blur at the lit point, projector pixels; None: in focus.
    """

    u: Any
    v: Any
    path_length_m: Any
    is_first: Any
    kind: Any = DIRECT
    blur_px: Any = None


class Math(Protocol):
    """The functions of arrays that a response may use."""

    def cos(self, x: Any) -> Any: ...
    def sin(self, x: Any) -> Any: ...
    def floor(self, x: Any) -> Any: ...
    def abs(self, x: Any) -> Any: ...
    def exp(self, x: Any) -> Any: ...
    def erf(self, x: Any) -> Any: ...
    def select(self, condition: Any, a: Any, b: Any) -> Any: ...
    def unsigned(self, x: Any) -> Any:
        """`x`, which is at least 0, truncated to a 32-bit unsigned integer."""

    def array(self, table: np.ndarray) -> Any:
        """A flat float32 table, made ready for several calls of `lookup`."""

    def lookup(self, table: Any, index: Any) -> Any:
        """table[index] of a flat float32 table: a NumPy array, or what `array` returned."""


class NumpyMath:
    """`Math` for NumPy arrays."""

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


class Response(Named, ABC):
    """A linear functional of light paths: `DenseResponse` or `SparseResponse`.

    Concrete subclasses are frozen dataclasses. One that has a `type_name` can be saved with signals and loaded again,
    also if it comes from outside the package.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in files of signals; a response without one can be used, but not saved."""

    channels: int
    """Number of channels of a dense response, or of bins of a sparse response."""

    def check(self, width: int, height: int) -> None:
        """Raise ValueError if a projector of width x height pixels cannot show this response; most can be shown."""


class DenseResponse(Response):
    """A response in which every path counts in every channel, with a weight.

    Examples
    --------
    A channel that counts only light that travelled less than 3 m:

    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Near(DenseResponse):
    ...     channels = 1
    ...     def weights(self, path, m):
    ...         return [m.select(path.path_length_m < 3.0, 1.0, 0.0)]
    >>> paths = LightPath(u=0.0, v=0.0, path_length_m=np.array([2.0, 4.0]), is_first=True)
    >>> Near().weights(paths, NumpyMath())
    [array([1., 0.])]
    """

    @abstractmethod
    def weights(self, path: LightPath, m: Math) -> list[Any]:
        """Real weights of the path, one per channel."""


class SparseResponse(Response):
    """A response in which a path counts in one bin with weight 1, or in none.

    A subclass that overrides `bin_weights` spreads the path over a few bins instead.
    """

    @abstractmethod
    def bin(self, path: LightPath, m: Math) -> Any:
        """Unsigned index of the path's bin; an index of `channels` or more means that the path counts nowhere."""

    def bin_weights(self, path: LightPath, m: Math) -> list[tuple[Any, Any]]:
        """Pairs of an unsigned bin index and the weight of the path in that bin."""
        return [(self.bin(path, m), 1.0)]
