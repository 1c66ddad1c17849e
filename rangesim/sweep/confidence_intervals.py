# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals over the seeds of a point: of means by Student's t, of fractions by Wilson's score."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

LEVEL = 0.95
"""Probability that an interval holds the true value, as is usual in tables of measurements."""


class Interval(NamedTuple):
    """A mean with the ends of its confidence interval; NaN where they are not known."""

    mean: float
    low: float
    high: float


def of_mean(values: Sequence[float | None]) -> Interval:
    """Interval of the mean of independent values, by Student's t; None is left out.

    It is exact for normal values. Values here are statistics over many pixels, which are nearly normal.

    Examples
    --------
    >>> [round(x, 3) for x in of_mean([1.0, 2.0, 3.0])]
    [2.0, -0.484, 4.484]
    >>> of_mean([1.0])
    Interval(mean=1.0, low=nan, high=nan)
    """
    known = np.array([v for v in values if v is not None and math.isfinite(v)])
    if not known.size:
        return Interval(math.nan, math.nan, math.nan)
    mean = float(known.mean())
    if known.size == 1:
        return Interval(mean, math.nan, math.nan)
    half = float(stdtrit(known.size - 1, 0.5 + LEVEL / 2) * known.std(ddof=1) / math.sqrt(known.size))
    return Interval(mean, mean - half, mean + half)


def of_fraction(count: float, total: float) -> Interval:
    """Interval of a fraction by Wilson's score, as if every pixel of every seed failed independently.

    Where pixels fail in every seed alike, the interval is wider than it need be. Where whole images fail together, it
    is narrower.

    Examples
    --------
    >>> [round(x, 3) for x in of_fraction(0, 10)]
    [0.0, 0.0, 0.278]

    References
    ----------
    Wilson: "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
    """
    if total <= 0:
        return Interval(math.nan, math.nan, math.nan)
    z = float(ndtri(0.5 + LEVEL / 2))
    fraction = count / total
    middle = (fraction + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z * math.sqrt(fraction * (1 - fraction) / total + z**2 / (4 * total**2)) / (1 + z**2 / total)
    return Interval(fraction, max(0.0, middle - half), min(1.0, middle + half))
