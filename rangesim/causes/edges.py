# SPDX-License-Identifier: Apache-2.0
"""Depth edges, and how a surface fares beside them."""

from __future__ import annotations

import warnings

import numpy as np

from rangesim.evaluation.comparison import EDGE_FRACTION

NEAR = 2
"""Pixels around an edge pixel, in both directions, that show how its surface fares off the edge."""


def depth_edges(z: np.ndarray, tolerance_m: float) -> np.ndarray:
    """(h, w) bool: of the depths z (h, w) of a pixel and its eight neighbours, some lie across a depth edge.

    NaN, where there is nothing, counts as infinitely far.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    depth = np.where(np.isfinite(z), z, np.inf)
    near, far = minimum_filter(depth, 3, mode="nearest"), maximum_filter(depth, 3, mode="nearest")
    return np.asarray((depth > across(near, tolerance_m)) | (far > across(depth, tolerance_m)))


def across(z: np.ndarray, tolerance_m: float) -> np.ndarray:
    """Depth beyond which a surface lies across a depth edge from one at z, as in `rangesim.evaluation.comparison`."""
    return np.asarray(np.maximum(z * (1 + EDGE_FRACTION), z + tolerance_m))


def error_off_edge(
    where: np.ndarray, error: np.ndarray, edge: np.ndarray, z: np.ndarray, instance: np.ndarray, tolerance_m: float
) -> np.ndarray:
    """(n,) float: median error of the same surface off the edge, around each of the n pixels `where`; NaN for none.

    Parameters
    ----------
    where, edge : (h, w) bool. error : (h, w) float, metres, not negative; infinity without a reading.
    z : (h, w) float, metres, true depth. instance : (h, w) int, of the surface.
    """
    rows, columns = np.nonzero(where)
    steps = np.arange(-NEAR, NEAR + 1)
    y = np.clip(rows[:, None, None] + steps[:, None], 0, z.shape[0] - 1)
    x = np.clip(columns[:, None, None] + steps, 0, z.shape[1] - 1)
    own_z, own = z[where][:, None, None], instance[where][:, None, None]
    same = (instance[y, x] == own) & ~edge[y, x] & (z[y, x] <= across(own_z, tolerance_m))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # windows without any such pixel: NaN
        return np.asarray(np.nanmedian(np.where(same, error[y, x], np.nan), axis=(1, 2)))
