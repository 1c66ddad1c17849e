# SPDX-License-Identifier: Apache-2.0
"""Direct time of flight: photon histograms to path lengths."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.decoding.path_length import range_image_from_path_length
from rangesim.range_image import RangeImage
from rangesim.response import SPEED_OF_LIGHT
from rangesim.sensors import DirectToF
from rangesim.spad import SpadDetector
from rangesim.status import Status

PEAK_SIGMAS = 5.0
MIN_COUNTS = 5.0
"""Least height of a peak over the background: standard deviations of the counts in its window, and counts."""
RELATIVE_PEAK = 1e-4
"""Least peak as a share of the bright ones of the image, for noise-free captures."""
_CHUNK_VALUES = 8_000_000


def decode_direct(capture: Capture) -> RangeImage:
    """Range image of a `DirectToF` capture: the strongest return of each pixel.

    Pile-up is undone if the detector has it (Coates). A filter matched to the instrument response finds the
    peak; the centroid of the counts above the background around it, re-centred once, gives the place within a
    bin.

    References
    ----------
    Coates: "The correction for photon 'pile-up' in the measurement of radiative lifetimes", J. Phys. E 1
    (1968).

    Raises
    ------
    ValueError
        The capture is of another sensor.
    """
    sensor = capture.sensor
    if not isinstance(sensor, DirectToF):
        raise ValueError(f"expected a direct-tof capture, got {sensor.type_name}.")
    position, peak, background = (np.empty(capture.frames.shape[1:]) for _ in range(3))
    for rows in _row_chunks(capture.frames.shape):
        histogram = _histogram(capture, capture.frames[:, rows])
        found = find_peak(histogram, sensor.sigma_bins, sensor.is_cyclic)
        position[rows], peak[rows], background[rows] = found
    length = (sensor.start_s + position * sensor.bin_s) * SPEED_OF_LIGHT

    status = np.where(_is_weak(capture, peak, background), Status.LOW_SIGNAL, Status.OK)
    status[capture.saturated(capture.frames)] = Status.SATURATED
    intensity = capture.frames.sum(axis=0, dtype=np.float64)
    return range_image_from_path_length(capture, length, status, peak / (bright_level(peak) or 1.0), intensity)


def find_peak(
    histogram: np.ndarray, sigma_bins: float, is_cyclic: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strongest peak of histograms (k, h, w): its place, its height and the background under it, each (h, w).

    Place in bins from the start of the first bin (the centre of bin b is b + 0.5); height is the sum over the
    peak's window less the background, background the sum under that window. `is_cyclic`: a window goes on at the
    other end.
    """
    bins = len(histogram)
    reach = window_reach(bins, sigma_bins, is_cyclic)
    highest = _matched(histogram, sigma_bins, is_cyclic).argmax(axis=0)
    width: np.ndarray | int = 2 * reach + 1
    if not is_cyclic:
        width = np.minimum(highest + reach, bins - 1) - np.maximum(highest - reach, 0) + 1
    inside = _window(histogram, highest, reach, is_cyclic)
    outside = histogram.sum(axis=0) - np.sum([c for _, c in inside], axis=0)
    level = np.maximum(outside, 0) / np.maximum(bins - width, 1)  # a difference: rounding may leave less than nothing
    place = np.floor(_centroid(inside, level, highest))
    recentred = (place % bins if is_cyclic else np.clip(place, 0, bins - 1)).astype(np.intp)
    inside = _window(histogram, recentred, reach, is_cyclic)
    counts = np.sum([c for _, c in inside], axis=0)
    background = level * width
    centroid = _centroid(inside, level, recentred)
    return centroid % bins if is_cyclic else centroid, counts - background, background


def window_reach(bins: int, sigma_bins: float, is_cyclic: bool) -> int:
    """Bins on either side of a peak that its window holds."""
    reach = max(1, int(np.ceil(2 * sigma_bins + 0.5)))
    return min(reach, (bins - 1) // 2) if is_cyclic else reach


def coates(counts: np.ndarray, pulses: int) -> np.ndarray:
    """(k, h, w) counts without pile-up, from histograms of the first photon of each of `pulses` pulses."""
    before = np.cumsum(counts, axis=0) - counts
    left = np.maximum(pulses - before, 1.0)
    return np.asarray(-pulses * np.log1p(-np.minimum(counts / left, 1 - 1e-6)))


def _histogram(capture: Capture, frames: np.ndarray) -> np.ndarray:
    counts = frames.astype(np.float64)
    if isinstance(capture.detector, SpadDetector) and capture.detector.pile_up:
        return coates(counts, capture.detector.pulses(capture.sensor, capture.exposure_s))
    return counts


def _matched(histogram: np.ndarray, sigma_bins: float, is_cyclic: bool) -> np.ndarray:
    if sigma_bins <= 0:
        return histogram
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(histogram, sigma_bins, axis=0, mode="wrap" if is_cyclic else "nearest"))


def _window(
    histogram: np.ndarray, centre: np.ndarray, reach: int, is_cyclic: bool
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Bin index and counts, each (h, w), of the bins `reach` around `centre`; beyond the ends zero, or the other end.

    Indices go on beyond the ends, so that their mean is a place.
    """
    result, bins = [], len(histogram)
    for offset in range(-reach, reach + 1):
        index = centre + offset
        valid = is_cyclic | ((index >= 0) & (index < bins))
        at = index % bins if is_cyclic else np.clip(index, 0, bins - 1)
        counts = np.take_along_axis(histogram, at[None], axis=0)[0]
        result.append((index, np.where(valid, counts, 0.0)))
    return result


def _centroid(inside: list[tuple[np.ndarray, np.ndarray]], level: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    above = [(index, np.maximum(counts - level, 0)) for index, counts in inside]
    total = np.sum([c for _, c in above], axis=0)
    moment = np.sum([(index + 0.5) * c for index, c in above], axis=0)
    return np.asarray(np.where(total > 0, moment / np.where(total > 0, total, 1.0), fallback + 0.5))


def _is_weak(capture: Capture, peak: np.ndarray, background: np.ndarray) -> np.ndarray:
    if not capture.is_digital:
        return np.asarray(~(peak > RELATIVE_PEAK * bright_level(peak)))
    return np.asarray(peak < np.maximum(MIN_COUNTS, PEAK_SIGMAS * np.sqrt(background)))


def _row_chunks(shape: tuple[int, ...]) -> Iterator[slice]:
    """Runs of image rows small enough to convert at once."""
    bins, height, width = shape
    step = max(1, _CHUNK_VALUES // (bins * width))
    for start in range(0, height, step):
        yield slice(start, start + step)
