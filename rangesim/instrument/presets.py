# SPDX-License-Identifier: Apache-2.0
"""Instruments by name. An instrument with the numbers of a real device that people can buy belongs here."""

from __future__ import annotations

from typing import Any

from rangesim.instrument.instrument import Instrument, name_of
from rangesim.sensors import sensor_of

DEFAULT_SENSORS = ("gray-phase", "amcw", "ideal-tof")
"""Presets that an experiment compares if none are given: structured light, time of flight, and the ideal ranger, which
no time-of-flight camera can surpass."""


def instrument(name: str, **settings: Any) -> Instrument:
    """The instrument whose sensor has this name.

    Parameters
    ----------
    name : a preset such as "amcw", or FILE.py:NAME, see `rangesim.sensors.sensor_of`.
    settings : fields of `Instrument` besides name and sensor.

    Raises
    ------
    ValueError, FileFormatError
        As `rangesim.sensors.sensor_of` and `Instrument`.

    Examples
    --------
    >>> from rangesim.instrument.presets import instrument
    >>> instrument("direct-tof", power_w=0.5).power_w
    0.5
    """
    sensor = sensor_of(name)
    return Instrument(name_of(name, sensor), sensor, **settings)
