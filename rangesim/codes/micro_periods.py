# SPDX-License-Identifier: Apache-2.0
"""Sets of periods for micro phase shifting that leave the fewest places to confuse."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

BAND = 1.25
"""Largest ratio of a chosen period to the first one, either way. All periods have to be about as short as the first,
because light between surfaces is the more disturbing the longer a period is. With 1280 pixels and eight periods of
about 16 pixels, a band of 1.1 confuses four times as many places, and one of 1.5 no fewer."""

CANDIDATES = 64
"""Number of steps of the band between the periods from which each is chosen; 128 steps lead to no better set for 1280
pixels."""

MAX_COLUMNS = 128
"""Largest number of columns at which confusions are counted, evenly spread. Together with `MAX_LAGS` it bounds the
time, to a tenth of a second for 1280 pixels."""

MAX_LAGS = 512
"""Largest number of distances, in fringes, at which confusions are counted, evenly spread; see `MAX_COLUMNS`."""

NOISE = 0.25
"""Standard deviation of the noise for which confusions are counted, as a fraction of the amplitude: with three shifts,
a phase then has 0.2 rad, the most that `PhaseThresholds` accepts."""


@lru_cache(maxsize=64)
def micro_periods(size: int, period_px: float, n_periods: int) -> tuple[float, ...]:
    """Periods, `period_px` first, such that noise confuses as few places as possible.

    The phase of the first period leaves places that are whole periods apart. Two of them are confused with a
    probability below exp(-d^2 / (8 s^2)) for images that differ by d in all, and noise s. Each further period is the
    one that lowers the sum over all pairs of places most.

    Parameters
    ----------
    size : int, projector pixels. period_px : float, projector pixels. n_periods : int >= 1.

    Examples
    --------
    >>> micro_periods(64, 16.0, 3)[0]
    16.0
    """
    columns = np.unique(np.linspace(0, size, min(size, MAX_COLUMNS), endpoint=False).astype(int))
    fringes = int((size - 1) / period_px)
    lags = (
        period_px * np.unique(np.linspace(1, fringes, min(fringes, MAX_LAGS)).astype(int)) if fringes else np.zeros(0)
    )
    x, lag = np.broadcast_arrays(columns[:, None], lags[None, :])
    inside = x + lag < size
    here, there = x[inside], (x + lag)[inside]
    candidates = period_px * np.geomspace(1 / BAND, BAND, CANDIDATES + 1)
    omega = (2 * np.pi / candidates)[:, None].astype(np.float32)
    apart = np.cos(omega * here.astype(np.float32)) - np.cos(omega * there.astype(np.float32))
    confused = np.exp(apart**2 / np.float32(-8 * NOISE**2))
    so_far = np.ones(len(here), dtype=np.float32)
    chosen = [float(period_px)]
    for _ in range(1, n_periods):
        best = int(np.argmin(confused @ so_far))
        so_far *= confused[best]
        chosen.append(round(float(candidates[best]), 3))
    return tuple(chosen)
