# SPDX-License-Identifier: Apache-2.0
"""Columns of numbers beside the points, such as intensity: their scale, and their means over groups of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.plumbing.short_repr import ShortRepr

CLIP = 4.0
"""Spreads from the median, at most, of a scaled value: 1 in 16 000 normally distributed values lies farther off, so
that only outliers are clipped. Chosen by eye; not varied."""
_STEPS = 4096.0
"""Steps per spread of a scaled value: 2^12, so that sums over 10^11 points are exact in float64, and do not depend on
the points' order."""
_RANGES = ((0.25, 0.75, 1.349), (0.05, 0.95, 3.290), (0.01, 0.99, 4.653), (0.0, 1.0, 2.0 * CLIP))
"""Two quantiles, fractions, and their distance in standard deviations: that of a normal distribution, or of clipped
values for the whole range. The first range that is not 0 gives the spread, so that a column of mostly equal values has
one."""


@dataclass(frozen=True, eq=False)
class RobustScaling(ShortRepr):
    """Scaling of d columns to a common range, whatever their unit: (value - center) / spread.

    Attributes
    ----------
    centers : (d,) float64, each column's unit
        Medians.
    spreads : (d,) float64, each column's unit
        Inter-quartile ranges over 1.349, which are standard deviations of normally distributed values. If half of the
        values are equal, it is the range of the middle 90 % over 3.290, else that of the middle 98 % over 4.653, else
        that of all values over 8. It is 0 if all values are equal.
    """

    centers: NDArray[np.float64]
    spreads: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of columns."""
        return len(self.centers)

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> RobustScaling:
        """Scaling of the columns of a table, (n, d); NaN do not count."""
        centers, spreads = np.zeros(values.shape[1]), np.zeros(values.shape[1])
        for column in range(values.shape[1]):
            known = 0.5 * values[~np.isnan(values[:, column]), column]  # halves, whose differences do not overflow
            if len(known):
                centers[column] = 2.0 * np.median(known)
                spreads[column] = _spread(known)
        return cls(centers, spreads)

    def scaled(self, values: NDArray[np.float64]) -> NDArray[np.float32]:
        """Columns in spreads from the median, (n, d), -4..4, in whole 4096ths; 0 where NaN and where all are equal."""
        halves = np.where(self.spreads > 0.0, 0.5 * self.spreads, np.inf)
        with np.errstate(over="ignore"):
            places = (0.5 * values - 0.5 * self.centers) / halves
        return (np.rint(np.clip(np.nan_to_num(places), -CLIP, CLIP) * _STEPS) / _STEPS).astype(np.float32)


def _spread(halves: NDArray[np.float64]) -> float:
    """Spread of a column, given halves of its values."""
    for low, high, deviations in _RANGES:
        width = float(np.subtract(*np.quantile(halves, (high, low))))
        if width > 0.0:
            return min(width / deviations, 0.25 * np.finfo(np.float64).max) * 2.0
    return 0.0


def group_means(values: NDArray[np.float32], groups: NDArray[np.int32], n_groups: int) -> NDArray[np.float64]:
    """Means over groups of points, (n_groups, d), of scaled columns, (n, d); they do not depend on the points' order.

    Parameters
    ----------
    values : (n, d) float32, of `RobustScaling.scaled`
    groups : (n,) int32, 0..n_groups - 1
    n_groups : int
    """
    counts = np.maximum(np.bincount(groups, minlength=n_groups), 1)
    sums = [np.bincount(groups, column, n_groups) for column in values.T]
    return np.stack(sums, axis=1) / counts[:, None] if sums else np.zeros((n_groups, 0))
