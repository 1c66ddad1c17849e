# SPDX-License-Identifier: Apache-2.0
"""Pairs of nodes as sorted keys, distinct ones and those that are not among others; and pairs of near places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def pair_keys(first: NDArray[np.int32], second: NDArray[np.int32]) -> NDArray[np.int64]:
    """Key of each of r pairs, (r,) int64; keys are in the order of the pairs."""
    return (first.astype(np.int64) << 32) + second


def distinct_pairs(first: NDArray[np.int32], second: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Distinct pairs in ascending order, (q, 2) int32, and the number of each row's pair, (r,) int64."""
    keys, inverse = np.unique(pair_keys(first, second), return_inverse=True)
    return np.stack((keys >> 32, keys & 0xFFFFFFFF), axis=1).astype(np.int32), inverse


def not_among(pairs: NDArray[np.int32], others: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Whether each of r pairs, (r, 2), is not among others, (m, 2), which are in ascending order; (r,) bool."""
    keys, known = pair_keys(*pairs.T), pair_keys(*others.T)
    return np.searchsorted(known, keys, "left") == np.searchsorted(known, keys, "right")


_FEW_DISTANCES = 1 << 18
"""Largest count of distances that are computed one by one, because that takes 4 ms, and the import of SciPy's trees
takes a quarter of a second."""


def nearest(
    places: NDArray[np.float64], sought: NDArray[np.float64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Distances to the n nearest of k places and their numbers, (q, n) each, from q other places, the nearest first.

    Parameters
    ----------
    places, sought : (k, d), (q, d) float64
    n : int, 1..k
    """
    if len(places) * len(sought) > _FEW_DISTANCES:
        from scipy.spatial import cKDTree

        distances, numbers = cKDTree(places).query(sought, np.arange(1, n + 1))
        return distances, np.asarray(numbers, np.int64)
    squares = sum(np.square(sought[:, axis, None] - places[:, axis]) for axis in range(places.shape[1]))
    numbers = np.argpartition(squares, n - 1, axis=1)[:, :n]
    squares = np.take_along_axis(squares, numbers, axis=1)
    order = np.argsort(squares, axis=1)
    return np.sqrt(np.take_along_axis(squares, order, axis=1)), np.take_along_axis(numbers, order, axis=1)
