# SPDX-License-Identifier: Apache-2.0
"""Adjusted Rand index: agreement on pairs of points, chance taken off."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.metrics.table import contingency, sizes


def adjusted_rand_index(labels: ArrayLike, truth: ArrayLike) -> float:
    """ARI, -0.5..1: pairs of points in one segment of both, above what chance would give (Hubert, Arabie 1985).

    Points negative in either are left out; 0 on average for random labels. Raises as `contingency`.
    """
    table = contingency(labels, truth)
    found, true = sizes(table)
    together, n = _pairs(table.data).sum(), float(true.sum())
    return float(rand_from_pairs(np.array(together), _pairs(found).sum(), _pairs(true).sum(), n))


def rand_from_pairs(
    together: NDArray[np.float64], found: NDArray[np.float64] | float, true: float, n_points: float
) -> NDArray[np.float64]:
    """ARI from numbers of pairs of points: in one segment of both, of the labels, of the truth."""
    everything = max(n_points * (n_points - 1) / 2, 1.0)
    chance = np.asarray(found * true / everything)
    best = np.asarray((found + true) / 2)
    trivial = best == chance  # all in one segment, or each on its own, in both: they agree
    return np.where(trivial, 1.0, (together - chance) / np.where(trivial, 1.0, best - chance))


def _pairs(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    return counts * (counts - 1.0) / 2
