# SPDX-License-Identifier: Apache-2.0
"""Distances that a time-of-flight sensor takes for others."""

from __future__ import annotations

import numpy as np

from rangesim.range_image import RangeImage
from rangesim.response import SPEED_OF_LIGHT
from rangesim.sensors import AmcwToF, DirectToF, Sensor
from rangesim.signals import GroundTruth
from rangesim.status import Status


def is_beyond_range(sensor: Sensor, path_length_m: np.ndarray) -> np.ndarray:
    """(...) bool: path lengths beyond twice the unambiguous range, or outside the histogram; else False."""
    if isinstance(sensor, AmcwToF):
        return np.asarray(path_length_m > sensor.searched_m)
    if isinstance(sensor, DirectToF):
        start_m, bins_m = sensor.start_s * SPEED_OF_LIGHT, sensor.bins * sensor.bin_s * SPEED_OF_LIGHT
        return np.asarray((path_length_m < start_m) | (path_length_m > start_m + bins_m))
    return np.zeros(path_length_m.shape, dtype=bool)


def is_wrong_period(sensor: Sensor, image: RangeImage, truth: GroundTruth) -> np.ndarray:
    """(h, w) bool: phases that agree on no distance, or on one off by half of the shortest period; of AMCW sensors."""
    if not isinstance(sensor, AmcwToF):
        return np.zeros(image.z.shape, dtype=bool)
    half_period_m = SPEED_OF_LIGHT / (4 * max(sensor.modulation_hz))
    refused = np.isin(image.status, [Status.WRAPPED, Status.OUT_OF_RANGE])
    return np.asarray(refused | (np.abs(image.range_m - truth.range_m) > half_period_m))
