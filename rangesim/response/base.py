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
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from rangesim.settings.config import Named

KINDS = ("direct", "multipath", "specular", "caustic", "glint")
"""Kinds of projector light, in the order of `rangesim.signals.EnergySplit`; a path's `kind` is an index."""
DIRECT, MULTIPATH, SPECULAR, CAUSTIC, GLINT = range(len(KINDS))


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


class Response(Named, ABC):
    """A linear functional of light paths. Subclasses are frozen dataclasses.

    A response with a `type_name` can be written to files of signals and read back, also one from outside the package.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name in files of signals; a response without one can be used, but not saved."""

    channels: int
    """Number of channels (dense) or bins (sparse)."""

    def check(self, width: int, height: int) -> None:
        """Raise ValueError if a projector of that many pixels cannot show this response."""


class DenseResponse(Response):
    """Every path counts in every channel, with a weight."""

    @abstractmethod
    def weights(self, path: LightPath, m: Math) -> list[Any]:
        """One real weight per channel."""


class SparseResponse(Response):
    """A path counts in one bin, with weight one, or in none; or in the few that `bin_weights` names."""

    @abstractmethod
    def bin(self, path: LightPath, m: Math) -> Any:
        """Unsigned bin index; an index >= `channels` means none."""

    def bin_weights(self, path: LightPath, m: Math) -> list[tuple[Any, Any]]:
        """Unsigned bin indices, each with the weight that the path has there."""
        return [(self.bin(path, m), 1.0)]
