# SPDX-License-Identifier: Apache-2.0
"""The best scale of a data set and of each of its clouds: ODS and OIS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.metrics.levels import LevelCurve
from pcgraph.short_repr import ShortRepr

_LOWER_IS_BETTER = ("undersegmentation_error", "variation_of_information")


@dataclass(frozen=True, eq=False)
class BestScales(ShortRepr):
    """The best score with one altitude for all clouds (ODS) and with the best altitude for each (OIS).

    Attributes
    ----------
    ods, ois : float
        Means over the clouds, each cloud counting once.
    ods_altitude : float
        The common altitude, the lowest of equally good ones.
    ois_altitudes : (c,) float64
        The altitude of each cloud, likewise.
    ois_values : (c,) float64
        The score of each cloud there.
    """

    ods: float
    ods_altitude: float
    ois: float
    ois_altitudes: NDArray[np.float64]
    ois_values: NDArray[np.float64]


def best_scales(curves: Sequence[LevelCurve]) -> BestScales:
    """ODS and OIS (Arbelaez et al. 2011) of the curves of several clouds, over all distinct cuts.

    Raises
    ------
    ValueError
        There is no curve, or they are of different scores.
    """
    if not curves or len({curve.score for curve in curves}) != 1:
        raise ValueError(f"expected curves of one score, got {sorted({curve.score for curve in curves})}")
    sign = -1.0 if curves[0].score in _LOWER_IS_BETTER else 1.0
    every = np.unique(np.concatenate([curve.altitudes for curve in curves]))
    means = np.mean([curve.at(every) for curve in curves], axis=0)
    best = _first_best(sign * means)
    tops = [_first_best(sign * curve.values) for curve in curves]
    values = np.array([curve.values[top] for curve, top in zip(curves, tops, strict=True)])
    heights = np.array([curve.altitudes[top] for curve, top in zip(curves, tops, strict=True)])
    return BestScales(float(means[best]), float(every[best]), float(values.mean()), heights, values)


def _first_best(values: NDArray[np.float64]) -> int:
    """Place of the first value that is the largest, but for the rounding of sums."""
    return int(np.argmax(values >= values.max() - 1e-12))
