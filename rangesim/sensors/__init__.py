# SPDX-License-Identifier: Apache-2.0
"""Range sensors as measuring principles."""

from rangesim.sensors.base import Sensor
from rangesim.sensors.structured_light import StructuredLight
from rangesim.sensors.time_of_flight import AmcwToF, DirectToF, IdealToF

__all__ = ["AmcwToF", "DirectToF", "IdealToF", "Sensor", "StructuredLight"]
