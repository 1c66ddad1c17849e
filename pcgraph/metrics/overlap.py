# SPDX-License-Identifier: Apache-2.0
"""Metrics that pair each true segment with the segment that fits it best, or the other way round."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array

from pcgraph.metrics.table import contingency, largest, overlaps, sizes


def weighted_overlap(labels: ArrayLike, truth: ArrayLike, *, matching: Literal["max", "one_to_one"] = "max") -> float:
    """WOv, 0..1: mean over the points of the IoU of their true segment with the segment matched to it.

    Parameters
    ----------
    labels, truth : same shape, int
        Points negative in either are left out.
    matching : {"max", "one_to_one"}
        "max": each true segment takes the segment of the best IoU, as in the covering of Arbelaez et al. 2011.
        "one_to_one": no segment is taken twice, and the assignment is the one with the largest sum.

    Raises
    ------
    ValueError
        As `contingency`; or the matching is unknown.
    """
    if matching not in ("max", "one_to_one"):
        raise ValueError(f"expected matching 'max' or 'one_to_one', got {matching!r}")
    table = contingency(labels, truth)
    _, true = sizes(table)
    if matching == "one_to_one":
        return _best_assignment(table, overlaps(table) * true[table.col]) / float(true.sum())
    return float(largest(overlaps(table), table.col, len(true)) @ true / true.sum())


def achievable_accuracy(labels: ArrayLike, truth: ArrayLike) -> float:
    """ASA, 0..1: share of points right if every segment took the true segment that it overlaps most.

    Liu et al. 2011. 1 - ASA is the undersegmentation error of Stutz et al. 2018. Raises as `contingency`.
    """
    table = contingency(labels, truth)
    return float(largest(table.data, table.row, table.shape[0]).sum() / table.data.sum())


def oversegmentation_rate(labels: ArrayLike, truth: ArrayLike) -> float:
    """Fos, 0..1: share of points outside the segment that overlaps their true segment most.

    Richtsfeld et al. 2012. Raises as `contingency`.
    """
    table = contingency(labels, truth)
    return float(1 - largest(table.data, table.col, table.shape[1]).sum() / table.data.sum())


def undersegmentation_rate(labels: ArrayLike, truth: ArrayLike) -> float:
    """Fus, >= 0: points that the segment overlapping a true segment most has outside of it, over all points.

    Richtsfeld et al. 2012. Of segments that overlap equally the smallest counts. Can exceed 1: one segment of
    everything is counted once per true segment. Raises as `contingency`.
    """
    table = contingency(labels, truth)
    found, true = sizes(table)
    outside = found[table.row] - table.data
    order = np.lexsort((outside, -table.data, table.col))
    _, first = np.unique(table.col[order], return_index=True)
    return float(outside[order[first]].sum() / true.sum())


def _best_assignment(table: coo_array, gains: NDArray[np.float64]) -> float:
    """Largest sum of the gains of pairs in which no row and no column occurs twice."""
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    rows, columns = table.shape
    # Each column (true segment) also gets a partner of its own that gains nothing, so that all can be matched; one
    # is added to every gain, which favours no pair, as SciPy takes a zero for a pair that does not exist.
    nobody = np.arange(columns)
    scale = gains.max()
    weights = np.concatenate([1 + gains / scale, np.ones(columns)])
    partners = np.concatenate([table.row, rows + nobody])
    choice = coo_array((weights, (np.concatenate([table.col, nobody]), partners)), shape=(columns, rows + columns))
    who, with_whom = min_weight_full_bipartite_matching(choice.tocsr(), maximize=True)
    return float((choice.tocsr()[who, with_whom] - 1).sum() * scale)
