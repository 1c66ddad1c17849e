# SPDX-License-Identifier: Apache-2.0
"""Warns of surfaces that lie outside the range of a time-of-flight sensor, by the true depth of the surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesim.causes.reference_frames import points_in_projector
from rangesim.errors import warn
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.signals import GroundTruth

ENOUGH = 0.01
"""Fraction of the lit pixels whose surface is outside the range, from which a warning is given.

With a smaller fraction, single pixels at the far end of a scene would give a warning, though they spoil no statistics.
"""


def fraction_beyond_range(sensor: Sensor, rig: Rig, truth: GroundTruth) -> tuple[float, float]:
    """Fraction of the lit pixels whose surface is outside the range of a sensor, and the distance of these surfaces.

    Returns
    -------
    fraction : fraction of the lit pixels whose surface is beyond the range, by `Sensor.is_beyond_range`.
    range_m : float, metres, median distance of the surfaces outside the range from the camera; NaN if there are none.
    """
    lit = np.isfinite(truth.z) & truth.projector_visible
    range_m = truth.range_m[lit].astype(np.float64)
    length = range_m + np.linalg.norm(points_in_projector(rig, rig.camera.reading(truth), lit), axis=-1)
    beyond = sensor.is_beyond_range(length)
    if not beyond.any():
        return 0.0, float("nan")
    return float(beyond.mean()), float(np.median(range_m[beyond]))


def warn_of_range(found: Sequence[tuple[str, float, float]]) -> None:
    """Warn of instruments for which a noticeable part of the scene is out of range.

    Parameters
    ----------
    found : name of each instrument, with the two values of `fraction_beyond_range`.

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
