# SPDX-License-Identifier: Apache-2.0
"""Photon histograms: the place of the peak with its standard deviation, and the correction of pile-up."""

from __future__ import annotations

import numpy as np

from rangesim.electronics.detector import Blindness

MIN_PULSES_LEFT = 10
"""Least number of pulses that have met no photon by the end of a peak's window. With m left, a bin that Coates' formula
corrects is too large by 1 / (2 m) on average, so by 5 % here, and its noise grows as 1 / sqrt(m)."""


def find_peak(
    histogram: np.ndarray, sigma_bins: float, is_cyclic: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place, height and background of the strongest peak of each histogram, each (n,) float64.

    The place is in bins from the start of the first bin (the centre of bin b is b + 0.5). Of the counts in the window
    of the peak, the height is the sum of those that belong to the peak, the background the sum of the others. If the
    first or the last bin cuts the peak off, the place is that of the whole Gaussian, which may lie outside the
    histogram.

    Parameters
    ----------
    histogram : (k, n) float32 or float64, counts, one histogram per column.
    sigma_bins : float, bins, standard deviation of the pulse.
    is_cyclic : whether a window that passes one end of the histogram goes on at the other end.

    Examples
    --------
    >>> import numpy as np
    >>> counts = np.ones((12, 1))
    >>> counts[4:7, 0] = 2.0, 9.0, 2.0
    >>> [float(x[0]) for x in find_peak(counts, sigma_bins=0.0)]  # the centre of bin 5, and what is above 1 per bin
    [5.5, 10.0, 3.0]
    """
    from rangesim.decoding.histogram_kernels import measure_peaks
    from rangesim.decoding.matched_filter import gaussian_filter

    filtered = histogram.astype(np.float32, copy=False)  # which tells where the peak is, and no more
    if sigma_bins > 0:
        filtered = gaussian_filter(filtered, sigma_bins, "wrap" if is_cyclic else "edge")
    place, height, background = np.empty((3, histogram.shape[1]))
    reach = window_reach(len(histogram), sigma_bins, is_cyclic)
    measure_peaks(histogram, filtered, reach, float(sigma_bins), is_cyclic, place, height, background)
    return place, height, background


def window_reach(bins: int, sigma_bins: float, is_cyclic: bool) -> int:
    """Number of bins on either side of a peak that its window holds: two standard deviations, and one bin at least.

    Examples
    --------
    >>> window_reach(256, sigma_bins=4.2, is_cyclic=True)
    9
    """
    reach = max(1, int(np.ceil(2 * sigma_bins + 0.5)))
    return min(reach, (bins - 1) // 2) if is_cyclic else reach


def coates(counts: np.ndarray, pulses: int) -> np.ndarray:
    """(k, ...) float64, counts without pile-up, from histograms of the first photon of each of `pulses` pulses.

    A bin that leaves m pulses without a photon is too large by the fraction 1 / (2 m) at most, on average. Its variance
    is pulses^2 f / m, where f is the fraction that the bin took of the pulses that were left before it. The count of a
    bin that leaves no pulse is a lower bound.

    Parameters
    ----------
    counts : (k, ...) int, histograms along the first axis.

    Examples
    --------
    >>> import numpy as np
    >>> coates(np.array([500, 250]), pulses=1000).round(1)  # each bin took half of the pulses that were left
    array([693.1, 693.1])

    References
    ----------
    Coates: "The correction for photon 'pile-up' in the measurement of radiative lifetimes", J. Phys. E 1 (1968).
    """
    from rangesim.decoding.histogram_kernels import all_photons

    photons = np.empty((len(counts), counts[0].size))
    all_photons(counts.reshape(photons.shape), pulses, photons)
    return photons.reshape(counts.shape)


def armed(counts: np.ndarray, blind: Blindness) -> np.ndarray:
    """(k, n) float64, number of trials in which a SPAD is armed when a bin begins, on average over the bin.

    A SPAD fires at most once within its dead time. So of all trials, those are blind that counted a photon within the
    dead time before, which may have been after an earlier pulse.

    Parameters
    ----------
    counts : (k, n) int, histograms as the detector counted them.

    Examples
    --------
    Of 1000 pulses, 400 fired in bin 1; with a dead time of two and a half bins, these are blind in bins 2 and 3:

    >>> import numpy as np
    >>> armed(np.array([[0], [400], [0], [0], [0]]), Blindness(1000, False, dead=2.5, period=5)).ravel()
    array([1000., 1000.,  600.,  600., 1000.])

    References
    ----------
    Isbaner et al.: "Dead-time correction of fluorescence lifetime measurements and fluorescence lifetime imaging",
    Optics Express 24 (2016).
    """
    bins, total = len(counts), np.asarray(counts.sum(axis=0, dtype=np.float64))
    before = np.concatenate([np.zeros((1, counts.shape[1])), np.cumsum(counts, axis=0, dtype=np.float64)])
    ends = np.arange(bins)
    begins = ends - max(blind.dead - 0.5, 0.0)  # on average, a SPAD fires in the middle of its bin
    if blind.until_next_pulse:
        begins = np.minimum(begins, 0.0)
    periods = np.floor(begins / blind.period)
    within = np.minimum(begins - periods * blind.period, bins)
    low = np.minimum(within.astype(np.int64), bins - 1)
    part = (within - low)[:, None]
    begun = (1 - part) * before[low] + part * before[low + 1] + periods[:, None] * total
    return np.asarray(np.maximum(blind.trials - (before[ends] - begun), 0.0))


def undo_pile_up(counts: np.ndarray, blind: Blindness) -> np.ndarray:
    """(k, n) float64, counts without pile-up.

    Without dead time it is `coates`; with it, the pulses that were left are those that `armed` says.

    Parameters
    ----------
    counts : (k, n) int, histograms as the detector counted them.
    """
    from rangesim.decoding.histogram_kernels import MAX_FRACTION

    if blind.dead == 0:
        return coates(counts, blind.trials)
    able = np.maximum(armed(counts, blind), 1.0)
    return np.asarray(-blind.trials * np.log1p(-np.minimum(counts / able, MAX_FRACTION)))


def pile_up_excess(counts: np.ndarray, blind: Blindness) -> np.ndarray:
    """(k, n) float64, variance of the counts that `undo_pile_up` returns over their means: all trials by those armed.

    Parameters
    ----------
    counts : (k, n) int, histograms as the detector counted them.

    Examples
    --------
    >>> import numpy as np
    >>> pile_up_excess(np.array([[500], [250], [0]]), Blindness(1000, True, dead=0.0, period=3.0)).ravel()
    array([1., 2., 4.])
    """
    return np.asarray(blind.trials / np.maximum(armed(counts, blind), 1.0))


def trials_left(
    counts: np.ndarray, place: np.ndarray, blind: Blindness, sigma_bins: float, is_cyclic: bool
) -> np.ndarray:
    """(..., n) int64, least number of armed trials that a bin in the window of each peak leaves without a photon.

    Without dead time it is `pulses_left`, whose parameters it has.
    """
    if blind.dead == 0:
        return pulses_left(counts, place, blind.trials, sigma_bins, is_cyclic)
    bins, reach = len(counts), window_reach(len(counts), sigma_bins, is_cyclic)
    at = np.floor(place).astype(np.int64) + np.arange(-reach, reach + 1).reshape(-1, *[1] * place.ndim)
    at = at % bins if is_cyclic else np.clip(at, 0, bins - 1)
    left = armed(counts, blind) - counts
    return np.asarray(left[at, np.arange(counts.shape[1])].min(axis=0).astype(np.int64))


def pulses_left(counts: np.ndarray, place: np.ndarray, pulses: int, sigma_bins: float, is_cyclic: bool) -> np.ndarray:
    """(..., n) int64, number of pulses that have met no photon by the end of the window of each peak.

    Parameters
    ----------
    counts : (k, n) int, histograms of the first photon of each of `pulses` pulses, as the detector counted them.
    place : (..., n) float, bins, places of the peaks that `find_peak` or `find_returns` found in `coates` of them with
        the same `sigma_bins` and `is_cyclic`.

    Examples
    --------
    >>> import numpy as np
    >>> pulses_left(np.array([[0], [5], [20], [5], [0], [0]]), np.array([2.5]), 100, sigma_bins=0.5, is_cyclic=False)
    array([70])
    """
    from rangesim.decoding.histogram_kernels import counts_until

    bins = len(counts)
    first = np.clip(np.floor(place).astype(np.int64), 0, bins - 1)
    reach = window_reach(bins, sigma_bins, is_cyclic)
    last = np.minimum(first + reach, bins - 1)
    if is_cyclic:
        last[first < reach] = bins - 1  # the window begins at the other end, where fewest are left
    used = np.empty(last.shape, np.int64)
    counts_until(counts, last.reshape(-1, counts.shape[1]), used.reshape(-1, counts.shape[1]))
    return np.asarray(pulses - used)


def runs_out(left: np.ndarray, pulses: int) -> np.ndarray:
    """(n,) bool, where so few of the pulses are left by the end of a peak's window that its place is not known.

    Too few means fewer than `MIN_PULSES_LEFT`. If there are fewer than 2 `MIN_PULSES_LEFT` pulses in all, it means
    fewer than half of them. With `MIN_PULSES_LEFT` pulses left, a bin of the window is 5 % too large at most, on
    average.

    Parameters
    ----------
    left : (n,) int, as `pulses_left` returns them.

    Examples
    --------
    >>> import numpy as np
    >>> runs_out(np.array([9, 10]), pulses=1000)
    array([ True, False])
    """
    return np.asarray(left < min(MIN_PULSES_LEFT, pulses / 2))


def place_sigma(peak: np.ndarray, background: np.ndarray, bins: int, sigma_bins: float, is_cyclic: bool) -> np.ndarray:
    """(...) float64, bins, standard deviation of the place of a peak by the shot noise of the counts, without pile-up.

    The place is the centroid of the window. The counts of the pulse scatter the place by the spread of the pulse, the
    counts of the background by the spread of an even distribution over the window. The standard deviation is infinite
    where there is no peak.

    Parameters
    ----------
    peak, background : (...) float, counts of the peak and of the background under it, as `find_peak` returns them.
    bins : int, number of bins in a histogram. sigma_bins : float, bins, standard deviation of the pulse.

    Examples
    --------
    >>> import numpy as np
    >>> place_sigma(np.array([100.0, 10_000.0]), np.zeros(2), bins=256, sigma_bins=4.0, is_cyclic=True).round(3)
    array([0.401, 0.04 ])
    """
    window = 2 * window_reach(bins, sigma_bins, is_cyclic) + 1
    counts = np.maximum(peak, np.finfo(np.float64).tiny)
    of_pulse, of_background = sigma_bins**2 + 1 / 12, background * window**2 / 12
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt((of_pulse + of_background / counts) / counts))
