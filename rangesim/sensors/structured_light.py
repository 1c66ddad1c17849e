# SPDX-License-Identifier: Apache-2.0
"""Temporally coded structured light: Gray code, alone or with N-step phase shift."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np

from rangesim import limits
from rangesim.bounds import Bounds, check_fields, whole
from rangesim.response import DenseResponse, Fringes, GrayBits, LightPath, NumpyMath
from rangesim.sensors.base import Sensor

CODES = ("gray", "gray-phase")
AXES = ("columns", "rows")


@dataclass(frozen=True)
class StructuredLight(Sensor):
    """A projector that shows a stack of patterns, and a camera that takes one frame of each.

    Frames, in OpenCV's order [1]_: for each axis the Gray bits, most significant first, each followed by
    its inverse; then, with `code="gray-phase"`, the `steps` fringe patterns of that axis; at the end white
    and black.

    Parameters
    ----------
    projector_width, projector_height : int, pixels of the projector.
    code : "gray" decodes to whole projector pixels; "gray-phase" [2]_ to fractions of a pixel: N-step phase
        shift finds the place within a period, Gray code the period. The Gray bits go to half a period or finer,
        so that a bit error at a stripe edge cannot become a period error.
    axes : "columns" suffices to triangulate; "rows" as well gives full correspondence (calibration, checks).
    period_px : float, period of the fringes in projector pixels.
    steps : int >= 3, number of phase shifts.

    References
    ----------
    .. [1] OpenCV, structured_light module, GrayCodePattern.
    .. [2] Sansoni, Carocci, Rodella: "Three-dimensional vision based on a combination of gray-code and
       phase-shift light projection", Applied Optics 38 (1999).
    """

    projector_width: Annotated[int, whole(2, "projector")] = 1280
    projector_height: Annotated[int, whole(2, "projector")] = 800
    code: Literal["gray", "gray-phase"] = "gray-phase"
    axes: tuple[Literal["columns", "rows"], ...] = ("columns",)
    period_px: Annotated[float, Bounds("projector pixels", 2, 1e6)] = 16.0
    steps: Annotated[int, whole(3, "steps")] = 4

    type_name: ClassVar[str] = "structured-light"

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.axes or list(self.axes) != sorted(set(self.axes)):
            raise ValueError(f"expected axes to be columns, rows or both in that order, got {self.axes!r}.")
        limits.check("pixels", self.projector_width * self.projector_height, "pixels of a projector")

    def size(self, axis: str) -> int:
        """Projector pixels along `axis`."""
        return self.projector_width if axis == "columns" else self.projector_height

    def gray_response(self, axis: str) -> GrayBits:
        """Gray bits shown along `axis`."""
        bits = int(np.ceil(np.log2(self.size(axis))))
        shift = 0 if self.code == "gray" else max(0, min(bits - 1, int(np.floor(np.log2(self.period_px / 2)))))
        return GrayBits(AXES.index(axis), bits, shift)

    def responses(self) -> tuple[DenseResponse, ...]:
        return tuple(response for _, response in self._coded())

    def frames(self, channels: Sequence[np.ndarray], steady: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        result = np.empty((self.n_frames, *steady.shape), dtype=np.float32)
        for frame, lit in zip(result, self._lit(channels, steady), strict=True):
            np.add(lit, ambient, out=frame, casting="same_kind")
        return result

    def _lit(self, channels: Sequence[np.ndarray], steady: np.ndarray) -> Iterator[np.ndarray]:
        """The frames one after another, without ambient light."""
        for (_, response), values in zip(self._coded(), channels, strict=True):
            if isinstance(response, GrayBits):
                for bit in values:
                    yield bit
                    yield steady - bit
            else:
                for shift in (2 * math.pi * s / self.steps for s in range(self.steps)):
                    yield 0.5 * (steady + math.cos(shift) * values[0] + math.sin(shift) * values[1])
        yield steady
        yield np.zeros_like(steady)

    def check(self, width: int, height: int) -> None:
        if (width, height) != (self.projector_width, self.projector_height):
            raise ValueError(
                f"expected a projector of {self.projector_width} x {self.projector_height} pixels as the sensor codes, "
                f"got a rig whose projector has {width} x {height}."
            )

    def frame_names(self) -> list[str]:
        names: list[str] = []
        for axis, response in self._coded():
            if isinstance(response, GrayBits):
                bits = range(response.shift, response.bits)
                names += [f"{axis}_bit{b}{suffix}" for b in reversed(bits) for suffix in ("", "_inverse")]
            else:
                names += [f"{axis}_phase{s}" for s in range(self.steps)]
        return [*names, "white", "black"]

    def patterns(self) -> np.ndarray:
        """(k, projector_height, projector_width) float32 in 0..1: the patterns as shown, at pixel centres."""
        size = 4 * self.n_frames * self.projector_width * self.projector_height
        limits.check("bytes", size, f"bytes of {self.n_frames} patterns")
        x, y = np.meshgrid(np.arange(self.projector_width) + 0.5, np.arange(self.projector_height) + 0.5)
        path = LightPath(x, y, 0 * x, True)
        weights = [np.stack(r.weights(path, NumpyMath())) for r in self.responses()]  # type: ignore[arg-type]
        return self.frames(weights, np.ones_like(x), np.zeros_like(x))

    def _coded(self) -> Iterator[tuple[str, GrayBits | Fringes]]:
        """Axis and response of each run of frames before white and black."""
        for axis in self.axes:
            yield axis, self.gray_response(axis)
            if self.code == "gray-phase":
                yield axis, Fringes(AXES.index(axis), self.period_px)
