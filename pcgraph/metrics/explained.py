# SPDX-License-Identifier: Apache-2.0
"""Explained variation: how much of the values is kept if each segment takes its mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.metrics.table import decimals, ranked, whole_numbers


def explained_variation(labels: ArrayLike, values: ArrayLike) -> float:
    """EV, 0..1: share of the variance of the values that lies between segments (Moore et al. 2008).

    Parameters
    ----------
    labels : (n,) or (h, w) int
        Points negative are left out.
    values : (n,), (n, c), (h, w) or (h, w, c) float
        Colours, normals or positions; the unit drops out if all channels share it.

    Returns
    -------
    float
        1 if the values do not vary.

    Raises
    ------
    ValueError
        Shapes do not fit, labels are not whole numbers, no point has one, or a labelled point's value is not finite.
    """
    segments, given = whole_numbers(labels), decimals(values)
    if given.shape[: segments.ndim] != segments.shape or given.ndim > segments.ndim + 1:
        raise ValueError(f"expected values for labels {segments.shape}, got {given.shape}")
    inside = segments >= 0
    if not inside.any():
        raise ValueError("expected at least one point with a label, got none")
    chosen = given[inside].reshape(np.count_nonzero(inside), -1)
    if not np.isfinite(chosen).all():
        raise ValueError("expected finite values, got NaN or infinity at a labelled point; give it the label -1")
    chosen = chosen - chosen.mean(axis=0)
    segment, n = ranked(segments[inside])
    counts = np.bincount(segment, minlength=n)
    sums = np.stack([np.bincount(segment, channel, n) for channel in chosen.T])
    total = float((chosen**2).sum())
    return min(1.0, float((sums**2 / counts).sum()) / total) if total > 0 else 1.0
