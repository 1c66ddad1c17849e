# SPDX-License-Identifier: Apache-2.0
"""Pairs of nodes as sorted keys: distinct pairs, and pairs that are not among others."""

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
