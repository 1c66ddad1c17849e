# SPDX-License-Identifier: Apache-2.0
"""Frames of one projector axis, and the code that they decode to: what Gray code and fringes have in common.

Gray code and fringes also check whether the frames contradict their code. A single pixel may be wrong for many reasons,
so the checks look at many pixels at once: a capture that is read wrongly (another start or direction of the fringes,
another order of the frames) contradicts itself nearly everywhere. Each check returns one sentence with the likely
cause, or None.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rangesim.capture import Capture

MIN_PIXELS = 200
"""Least number of pixels from which a check draws a conclusion. A fraction of 200 pixels has a standard error of at
most 3.5 %, below what the checks compare."""

MAX_PIXELS = 200_000
"""Largest number of pixels that a check looks at, evenly spread over the image. It bounds the time for large images;
the standard error of a fraction of that many pixels is 0.1 % at most."""


class Contrast(NamedTuple):
    """The white and the black frame of a capture, and where their difference suffices to decode.

    white, black : (h, w), in the type and the units of the capture. values : (h, w) float32, white - black.
    is_enough : (h, w) bool, where `values` is above the threshold.
    """

    white: np.ndarray
    black: np.ndarray
    values: np.ndarray
    is_enough: np.ndarray


class AxisFrames(NamedTuple):
    """The frames of a capture that code one axis of the projector.

    capture : Capture that they belong to. axis : "columns" or "rows". names : (n,) one name per frame.
    frames : (n, h, w), in the type and the units of the capture. contrast : Contrast of the same capture.
    """

    capture: Capture
    axis: str
    names: list[str]
    frames: np.ndarray
    contrast: Contrast


@dataclass(frozen=True, eq=False)
class AxisCode:
    """Decoded projector coordinate along one axis.

    coordinate : (h, w) float32, projector pixels. With Gray code alone it is the centre of a cell; where the camera
        pixel lies on the edge between two cells, it is the edge.
    status : (h, w) uint8, `Status`.
    cell_px : int, size of a Gray cell, projector pixels (1, or more where fringes follow).
    sigma_px : (h, w) float32, standard deviation of `coordinate`, projector pixels; None: not known.
    """

    coordinate: np.ndarray
    status: np.ndarray
    cell_px: int
    sigma_px: np.ndarray | None = None


def evenly_spread(indices: np.ndarray) -> np.ndarray:
    """At most `MAX_PIXELS` of the indices (n,), evenly spread.

    Examples
    --------
    >>> import numpy as np
    >>> len(evenly_spread(np.arange(500_000)))
    166667
    """
    return indices[:: 1 + len(indices) // MAX_PIXELS]
