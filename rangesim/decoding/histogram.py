# SPDX-License-Identifier: Apache-2.0
"""Direct time of flight: photon histograms to path lengths."""

from __future__ import annotations

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
    from pcgraph.parallel import SMALLEST_ROWS, in_blocks

    sensor = capture.sensor
    if not isinstance(sensor, DirectToF):
        raise ValueError(f"expected a direct-tof capture, got {sensor.type_name}.")
    height, width = capture.frames.shape[1:]
    position, peak, background, intensity = np.empty((4, height, width))

    def measure(start: int, stop: int) -> None:
        for row in range(start, stop):
            frames = capture.frames[:, row]
            found = find_peak(_histogram(capture, frames), sensor.sigma_bins, sensor.is_cyclic)
            position[row], peak[row], background[row] = found
            intensity[row] = frames.sum(axis=0, dtype=np.float64)

    in_blocks(measure, height, smallest=SMALLEST_ROWS)
    length = (sensor.start_s + position * sensor.bin_s) * SPEED_OF_LIGHT

    status = np.where(_is_weak(capture, peak, background), Status.LOW_SIGNAL, Status.OK)
    status[capture.saturated(capture.frames)] = Status.SATURATED
    return range_image_from_path_length(capture, length, status, peak / (bright_level(peak) or 1.0), intensity)


def find_peak(
    histogram: np.ndarray, sigma_bins: float, is_cyclic: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strongest peak of histograms (k, n): its place, its height and the background under it, each (n,).

    Place in bins from the start of the first bin (the centre of bin b is b + 0.5); height is the sum over the
    peak's window less the background, background the sum under that window. `is_cyclic`: a window goes on at the
    other end.
    """
    from rangesim.decoding.peaks import measure_peaks
    from rangesim.histogram_filter import gaussian_filter

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
    """(k, ...) counts without pile-up, from histograms of the first photon of each of `pulses` pulses."""
    from rangesim.decoding.peaks import detected_share

    share = np.empty((len(counts), counts[0].size))
    detected_share(counts.reshape(share.shape), pulses, share)
    return np.asarray(-pulses * np.log1p(-share)).reshape(counts.shape)


def _histogram(capture: Capture, frames: np.ndarray) -> np.ndarray:
    if isinstance(capture.detector, SpadDetector) and capture.detector.pile_up:
        return coates(frames, capture.detector.pulses(capture.sensor, capture.exposure_s))
    return frames.astype(np.float64)


def _is_weak(capture: Capture, peak: np.ndarray, background: np.ndarray) -> np.ndarray:
    if not capture.is_digital:
        return np.asarray(~(peak > RELATIVE_PEAK * bright_level(peak)))
    return np.asarray(peak < np.maximum(MIN_COUNTS, PEAK_SIGMAS * np.sqrt(background)))
