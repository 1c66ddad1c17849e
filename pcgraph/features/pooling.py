# SPDX-License-Identifier: Apache-2.0
"""Pooling of moments, means and sums from children to parents."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def pool_moments(
    parents: NDArray[np.int32],
    counts: NDArray[np.int64],
    means: NDArray[np.float64],
    scatters: NDArray[np.float64],
) -> None:
    """Nothing; the rows of inner nodes, zero at first, become the moments of all their leaves.

    Parameters
    ----------
    parents : (k,) int32
        Larger than the node's own number, so one pass in ascending order meets children before parents.
    counts, means, scatters : (k,), (k, 3), (k, 3, 3)
        As in `pcgraph.Moments`, of positions or of colours; overwritten.

    Notes
    -----
    Source: Chan, Golub and LeVeque 1979, pairwise update of sums of squares.
    """
    for node in range(len(parents)):
        up = parents[node]
        if up == node:
            continue
        n_up, n_node = counts[up], counts[node]
        total = n_up + n_node
        share = n_node / total
        spread = n_up * share
        for i in range(3):
            for j in range(3):
                shift = (means[node, i] - means[up, i]) * (means[node, j] - means[up, j])
                scatters[up, i, j] += scatters[node, i, j] + spread * shift
        for i in range(3):
            if n_up == 0:  # exact copies: a mean must not move by rounding where there is one child only
                means[up, i] = means[node, i]
            else:
                means[up, i] += share * (means[node, i] - means[up, i])
        counts[up] = total


@njit(cache=True, nogil=True)
def pool_means(
    parents: NDArray[np.int32], counts: NDArray[np.int64], n_leaves: int, means: NDArray[np.float64]
) -> None:
    """Nothing; the rows of inner nodes, zero at first, become the means over all their points.

    Parameters
    ----------
    parents : (k,) int32
        Larger than the node's own number.
    counts : (k,) int64
        Points of every node.
    n_leaves : int
        The first rows, which are given.
    means : (k, c) float64
        Overwritten.
    """
    for node in range(len(parents)):
        up = parents[node]
        for column in range(means.shape[1]):
            if node >= n_leaves:
                means[node, column] /= counts[node]
            if up != node:
                means[up, column] += counts[node] * means[node, column]


@njit(cache=True, nogil=True)
def pool_sums(parents: NDArray[np.int32], values: NDArray[Any]) -> None:
    """Nothing; every node's row becomes the sum of the rows at and below it.

    Parameters
    ----------
    parents : (k,) int32
        Larger than the node's own number.
    values : (k, c) numbers
        Overwritten.
    """
    for node in range(len(parents)):
        up = parents[node]
        if up != node:
            for column in range(values.shape[1]):
                values[up, column] += values[node, column]
