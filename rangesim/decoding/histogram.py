# SPDX-License-Identifier: Apache-2.0
"""Photon histograms: the peak, and what pile-up hides."""

from __future__ import annotations

import numpy as np


def find_peak(
    histogram: np.ndarray, sigma_bins: float, is_cyclic: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strongest peak of histograms (k, n): its place, its height and the background under it, each (n,).

    Place in bins from the start of the first bin (the centre of bin b is b + 0.5); height is the sum over the
    peak's window less the background, background the sum under that window. `is_cyclic`: a window goes on at the
    other end.
    """
    from rangesim.decoding.histogram_kernels import measure_peaks
    from rangesim.decoding.matched_filter import gaussian_filter

    filtered = gaussian_filter(histogram, sigma_bins, "wrap" if is_cyclic else "edge") if sigma_bins > 0 else histogram
    place, height, background = np.empty((3, histogram.shape[1]))
    reach = window_reach(len(histogram), sigma_bins, is_cyclic)
    measure_peaks(histogram, filtered, reach, is_cyclic, place, height, background)
    return place, height, background


def window_reach(bins: int, sigma_bins: float, is_cyclic: bool) -> int:
    """Bins on either side of a peak that its window holds."""
    reach = max(1, int(np.ceil(2 * sigma_bins + 0.5)))
    return min(reach, (bins - 1) // 2) if is_cyclic else reach


def coates(counts: np.ndarray, pulses: int) -> np.ndarray:
    """(k, ...) counts without pile-up, from histograms of the first photon of each of `pulses` pulses.

    References
    ----------
    Coates: "The correction for photon 'pile-up' in the measurement of radiative lifetimes", J. Phys. E 1 (1968).
    """
    from rangesim.decoding.histogram_kernels import detected_fraction

    fraction = np.empty((len(counts), counts[0].size))
    detected_fraction(counts.reshape(fraction.shape), pulses, fraction)
    return np.asarray(-pulses * np.log1p(-fraction)).reshape(counts.shape)
