# SPDX-License-Identifier: Apache-2.0
"""Steps that the exports to BOP and to COCO share: chosen sensors, grey images, boxes around masks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesim.dataset.samples import Samples
from rangesim.settings.config import nearest

WHITE_PERCENTILE = 99.5
"""Percentile of the intensities that is white in grey images. The brightest 0.5 % are highlights."""


def sensors_of(samples: Samples, wanted: Sequence[str] | None) -> list[str]:
    """Names of the sensors to export: `wanted`, or all.

    Raises
    ------
    ValueError
        There is no scene, or no sensor of such a name.
    """
    if not len(samples):
        raise ValueError(f"expected a data set with scenes, but all of {samples.store.directory} failed.")
    there = [sensor.name for sensor in samples.record(0)[0].sensors]
    for name in wanted or ():
        if name not in there:
            raise ValueError(f"expected sensors out of {', '.join(there)}, got {name!r}{nearest(name, there)}.")
    return list(wanted or there)


def grey_of(intensity: np.ndarray) -> np.ndarray:
    """(h, w) uint8, an image of intensities (h, w)."""
    values = np.nan_to_num(intensity.astype(np.float64))
    white = np.percentile(values, WHITE_PERCENTILE)
    return np.rint(255 * np.clip(values / max(white, 1e-30), 0, 1)).astype(np.uint8)


def box_of(mask: np.ndarray) -> list[int] | None:
    """Left, top, width and height of the box around a mask, pixels; None if it is empty."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    left, top = int(columns[0]), int(rows[0])
    return [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1]
