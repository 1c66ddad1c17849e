# SPDX-License-Identifier: Apache-2.0
"""Frames of one projector axis, and what they decode to: the types that all codes share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rangesim.capture import Capture
from rangesim.codes.fringe_gamma import FringeGamma


class Contrast(NamedTuple):
    """The white and the black image of a capture, and where their difference suffices to decode.

    white, black : (h, w), in the type and the units of the capture. values : (h, w) float32, white - black.
    is_enough : (h, w) bool, where `values` is above the threshold.
    has_white, has_black : whether the capture has such a frame. If not, it is estimated from the code's frames.
    """

    white: np.ndarray
    black: np.ndarray
    values: np.ndarray
    is_enough: np.ndarray
    has_white: bool = True
    has_black: bool = True

    @property
    def is_measured(self) -> bool:
        """Whether both were captured. If not, they cannot contradict the code's frames."""
        return self.has_white and self.has_black


class AxisFrames(NamedTuple):
    """The frames of a capture that code one axis of the projector.

    capture : Capture that they belong to. axis : "columns" or "rows". size : projector pixels along the axis.
    names : (n,) one name per frame, as the code names them: without the axis, in the order of the code. Frames that
        were not shown are missing.
    frames : (n, h, w), in the type and the units of the capture. contrast : Contrast of the same capture.
    prefix : what the names of these frames start with in the capture, between the axis and the name.
    """

    capture: Capture
    axis: str
    size: int
    names: list[str]
    frames: np.ndarray
    contrast: Contrast
    prefix: str = ""

    def starting_with(self, prefix: str) -> AxisFrames:
        """Only the frames whose names start with `prefix`."""
        kept = [i for i, name in enumerate(self.names) if name.startswith(prefix)]
        run = slice(kept[0], kept[-1] + 1) if kept else slice(0)
        is_run = len(kept) == run.stop - (run.start or 0)  # a slice is a view, and copies nothing
        return self._replace(names=[self.names[i] for i in kept], frames=self.frames[run if is_run else kept])

    def of_member(self, prefix: str) -> AxisFrames:
        """Frames of one of several codes, whose names start with `prefix`, with the names that this code gives."""
        own = self.starting_with(prefix)
        return own._replace(names=[name.removeprefix(prefix) for name in own.names], prefix=self.prefix + prefix)

    def shown_name(self, name: str) -> str:
        """Name of a frame in the capture, with the axis: as in messages and in names of files."""
        return f"{self.axis}_{self.prefix}{name}"


@dataclass(frozen=True, eq=False)
class AxisCode:
    """Decoded projector coordinate along one axis.

    coordinate : (h, w) float32, projector pixels. With Gray code alone it is the centre of a cell; where the camera
        pixel lies on the edge between two cells, it is the edge.
    status : (h, w) uint8, `Status`.
    cell_px : float, projector pixels: size of the cell to which the frames tell a place that is not sub-pixel.
    sigma_px : (h, w) float32, standard deviation of `coordinate`, projector pixels; None: not known.
    coarse : AxisCode that was refined to this one, such as Gray code by fringes; None: there is none.
    gammas : what the fringes of each period tell of the response, for which their phases were corrected; empty: the
        code has no fringes that are corrected.
    """

    coordinate: np.ndarray
    status: np.ndarray
    cell_px: float
    sigma_px: np.ndarray | None = None
    coarse: AxisCode | None = None
    gammas: tuple[FringeGamma, ...] = ()

    @property
    def gamma(self) -> float:
        """Exponent of the response for which the fringes were corrected, the median of their periods; 1: linear."""
        return float(np.median([one.gamma for one in self.gammas])) if self.gammas else 1.0
