# SPDX-License-Identifier: Apache-2.0
"""Depth edges: where the true depths of neighbouring pixels are those of two surfaces."""

from __future__ import annotations

import numpy as np

EDGE_FRACTION = 0.02
"""A depth edge is where neighbours' true depths differ by more than this fraction of the nearer, and a tolerance."""


def depth_edges(z: np.ndarray, tolerance_m: float) -> np.ndarray:
    """(h, w) bool: of the depths z (h, w) of a pixel and its eight neighbours, some lie across a depth edge.

    NaN, where there is nothing, counts as infinitely far.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    depth = np.where(np.isfinite(z), z, np.inf)
    near, far = minimum_filter(depth, 3, mode="nearest"), maximum_filter(depth, 3, mode="nearest")
    return np.asarray((depth > across(near, tolerance_m)) | (far > across(depth, tolerance_m)))


def across(z: np.ndarray, tolerance_m: float) -> np.ndarray:
    """Depth beyond which a surface lies across a depth edge from one at z."""
    return np.asarray(np.maximum(z * (1 + EDGE_FRACTION), z + tolerance_m))
