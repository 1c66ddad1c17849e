# SPDX-License-Identifier: Apache-2.0
"""Depth edges: places where neighbouring pixels see two surfaces, one in front of the other."""

from __future__ import annotations

import numpy as np

from rangesim.evaluation.neighbourhood import IMAGE, Neighbourhood

EDGE_FRACTION = 0.02
"""Least difference of the true depths of neighbouring pixels across a depth edge, as a fraction of the nearer depth.

The difference must also exceed a tolerance in metres. A smaller fraction takes inclined surfaces for edges; a larger
one misses objects that stand close in front of a wall. Other values were not measured.
"""


def depth_edges(z: np.ndarray, tolerance_m: float, pixels: Neighbourhood = IMAGE) -> np.ndarray:
    """(h, w) bool, whether a depth edge lies between a pixel and one of its neighbours, eight in an image.

    Parameters
    ----------
    z : (h, w) float, metres, true depth; NaN, where there is no surface, counts as infinitely far.
    tolerance_m : float, metres; smaller differences of depth are no edge.
    pixels : which pixels are neighbours.
    """
    depth = np.where(np.isfinite(z), z, np.inf)
    around = pixels.shifted(depth, 1)
    near, far = np.minimum.reduce(around), np.maximum.reduce(around)
    return np.asarray((depth > across(near, tolerance_m)) | (far > across(depth, tolerance_m)))


def across(z: np.ndarray, tolerance_m: float) -> np.ndarray:
    """Smallest depth, in metres, that a surface behind one at depth z has if a depth edge separates the two."""
    return np.asarray(np.maximum(z * (1 + EDGE_FRACTION), z + tolerance_m))
