# SPDX-License-Identifier: Apache-2.0
"""The sparse contingency table that the metrics of two labellings are computed from."""

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
        The shapes differ, labels are not whole numbers, or no point is left.
    """
    found, true = labelled(labels, truth)
    row, n_rows = ranked(found)
    column, n_columns = ranked(true)
    return count_pairs(row, column, (n_rows, n_columns))


def labelled(labels: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Label and true label, (m,) int64 each, of the points that have both; raises as `contingency` does."""
    found, true = whole_numbers(labels), whole_numbers(truth)
    if found.shape != true.shape:
        raise ValueError(f"expected labels and truth of one shape, got {found.shape} and {true.shape}")
    both = (found >= 0) & (true >= 0)
    if not both.any():
        raise ValueError("expected at least one point with a label and a true label, got none")
    return found[both], true[both]


def whole_numbers(labels: ArrayLike) -> NDArray[np.int64]:
    """The labels as int64, -1 where they are masked.

    Raises
    ------
    ValueError
        Labels are not whole numbers, or one is 2**63 or more.
    """
    array = labels if isinstance(labels, np.ma.MaskedArray) else np.asarray(labels)
    if array.dtype.kind not in "iub":
        raise ValueError(f"expected labels that are whole numbers, got {array.dtype}; convert them first")
    if array.dtype == np.uint64 and array.size and array.max() > np.iinfo(np.int64).max:
        raise ValueError(f"expected labels below 2**63, got {array.max()}; number them from 0")
    numbers = array.astype(np.int64, copy=False)
    return np.ma.filled(numbers, -1) if isinstance(numbers, np.ma.MaskedArray) else numbers


def decimals(values: ArrayLike) -> NDArray[np.float64]:
    """The values as float64, NaN where they are masked."""
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.float64), np.nan)
    return np.asarray(values, np.float64)


def ranked(labels: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """The labels as 0..s-1 in ascending order, and s."""
    if labels.max() > 4 * len(labels) + 1024:  # too far spread for a table of all of them
        values, rank = np.unique(labels, return_inverse=True)
        return rank.astype(np.int64), len(values)
    present = np.bincount(labels) > 0
    return (np.cumsum(present) - 1)[labels], int(np.count_nonzero(present))


def count_pairs(row: NDArray[np.int64], column: NDArray[np.int64], shape: tuple[int, int]) -> coo_array:
    """How often each pair of row and column occurs, int64, sorted by row, then column."""
    table = coo_array((np.ones(len(row), np.int64), (row, column)), shape=shape).tocsr()
    table.sum_duplicates()
    return table.tocoo()


def sizes(table: coo_array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points per segment (s,) and per true segment (g,), int64."""
    rows, columns = table.shape
    found = np.bincount(table.row, table.data, rows)
    return found.astype(np.int64), np.bincount(table.col, table.data, columns).astype(np.int64)


def overlaps(table: coo_array) -> NDArray[np.float64]:
    """Intersection over union of each pair in the table, (nnz,), 0..1."""
    found, true = sizes(table)
    return table.data / (found[table.row] + true[table.col] - table.data)


def largest(values: NDArray[np.float64], groups: NDArray[np.int32], n_groups: int) -> NDArray[np.float64]:
    """Largest of the non-negative values of each group, (n_groups,); 0 for groups without any."""
    best = np.zeros(n_groups)
    np.maximum.at(best, groups, values)
    return best
