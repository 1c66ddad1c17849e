# SPDX-License-Identifier: Apache-2.0
"""How well a segmentation fits a true one; sparse contingency tables throughout."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array


def contingency(labels: ArrayLike, truth: ArrayLike) -> coo_array:
    """Number of points per pair of segment and true segment, sparse (s, g), in ascending order of labels.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.

    Raises
    ------
    ValueError
        The shapes differ, or no point is left.
    """
    found, true = np.asarray(labels), np.asarray(truth)
    if found.shape != true.shape:
        raise ValueError(f"expected labels and truth of one shape, got {found.shape} and {true.shape}")
    both = (found >= 0) & (true >= 0)
    if not both.any():
        raise ValueError("expected at least one point with a label and a true label, got none")
    rows, row = np.unique(found[both], return_inverse=True)
    columns, column = np.unique(true[both], return_inverse=True)
    keys, counts = np.unique(row.astype(np.int64) * len(columns) + column, return_counts=True)
    return coo_array((counts, (keys // len(columns), keys % len(columns))), shape=(len(rows), len(columns)))


def weighted_overlap(labels: ArrayLike, truth: ArrayLike) -> float:
    """WOv, 0..1: mean over the points of the best IoU of their true segment with any segment."""
    table = contingency(labels, truth)
    found, true = _sizes(table)
    overlap = table.data / (found[table.row] + true[table.col] - table.data)
    best = np.zeros(len(true))
    np.maximum.at(best, table.col, overlap)
    return float((best * true).sum() / true.sum())


def undersegmentation_error(labels: ArrayLike, truth: ArrayLike) -> float:
    """UE of Neubert and Protzel 2012: sum over pairs of min(|S and G|, |S without G|), over points."""
    table = contingency(labels, truth)
    found, _ = _sizes(table)
    leak = np.minimum(table.data, found[table.row] - table.data)
    return float(leak.sum() / table.data.sum())


def achievable_accuracy(labels: ArrayLike, truth: ArrayLike) -> float:
    """ASA, 0..1: share of points right if every segment took the true segment that it overlaps most."""
    table = contingency(labels, truth)
    best = np.zeros(table.shape[0])
    np.maximum.at(best, table.row, table.data)
    return float(best.sum() / table.data.sum())


def _sizes(table: coo_array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rows, columns = table.shape
    weights = table.data.astype(np.float64)
    found = np.bincount(table.row, weights, rows).astype(np.float64)
    return found, np.bincount(table.col, weights, columns).astype(np.float64)
