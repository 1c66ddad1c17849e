# SPDX-License-Identifier: Apache-2.0
"""Surfaces that lie outside the range of a time-of-flight sensor: as the depth is known, it is said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesim.causes.reference_frames import points_in_projector
from rangesim.errors import warn
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.signals import GroundTruth

ENOUGH = 0.01
"""Fraction of the lit surface outside the range from which `warn_of_range` warns."""


def fraction_beyond_range(sensor: Sensor, rig: Rig, truth: GroundTruth) -> tuple[float, float]:
    """Fraction of the lit surface that `sensor` cannot place (`Sensor.is_beyond_range`), and the range of its middle.

    Returns
    -------
    fraction : of the pixels whose surface the projector sees; 0 without any.
    range_m : float, metres, median distance of those pixels from the camera; NaN without any.
    """
    lit = np.isfinite(truth.z) & truth.projector_visible
    range_m = truth.range_m[lit].astype(np.float64)
    length = range_m + np.linalg.norm(points_in_projector(rig, truth.z, lit), axis=-1)
    beyond = sensor.is_beyond_range(length)
    if not beyond.any():
        return 0.0, float("nan")
    return float(beyond.mean()), float(np.median(range_m[beyond]))


def warn_of_range(found: Sequence[tuple[str, float, float]]) -> None:
    """Warn of the instruments that a noticeable part of the scene is out of reach of.

    Parameters
    ----------
    found : name, and what `fraction_beyond_range` gives, of each instrument.

    Warns
    -----
    RangesimWarning
    """
    far = [
        f"{name}, {100 * fraction:.0f} % of the lit surface (around {range_m:.2f} m)"
        for name, fraction, range_m in found
        if fraction >= ENOUGH
    ]
    if far:
        warn(
            f"outside the sensor's range, so read at a wrong distance or not at all: {'; '.join(far)}; "
            "more or wider bins, or lower frequencies, reach further."
        )
