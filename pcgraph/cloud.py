# SPDX-License-Identifier: Apache-2.0
"""The point cloud as files hold it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with what a file says about each of them.

    Attributes
    ----------
    points : (n, 3) or (h, w, 3) float32 or float64, metres, the file's frame
        Organised when the file is (PCD with HEIGHT > 1). NaN where the sensor saw nothing.
    colors : same leading shape + (3,), uint8, 0..255, or None
        Red, green, blue.
    normals : same leading shape + (3,), float32 or float64, or None
        As stored; not checked for unit length.
    labels : same leading shape, int32, or None
        The file's own ``label`` or ``labels`` field, for example ground truth.
    viewpoint : (3,) float64, metres, or None
        Where the sensor stood, from the PCD header; None if the format does not say.
    """

    points: NDArray[np.floating]
    colors: NDArray[np.uint8] | None = None
    normals: NDArray[np.floating] | None = None
    labels: NDArray[np.int32] | None = None
    viewpoint: NDArray[np.float64] | None = None

    @property
    def organised(self) -> bool:
        """Whether the points lie on an image lattice."""
        return self.points.ndim == 3
