# SPDX-License-Identifier: Apache-2.0
"""Sensors that come with the package, each with its decoder. Their interface is in `rangesim.sensor`."""

from rangesim.sensor import Decoder, Emitter, Sensor
from rangesim.sensors.active_stereo import ActiveStereo, StereoDecoder
from rangesim.sensors.amcw import AmcwDecoder, AmcwToF
from rangesim.sensors.direct_tof import DirectToF, DirectToFDecoder
from rangesim.sensors.ideal_tof import IdealToF, IdealToFDecoder
from rangesim.sensors.reference_pattern import ReferencePatternDecoder, ReferencePatternStereo
from rangesim.sensors.registry import check_sensor, is_file_name, presets, sensor_from_dict, sensor_of
from rangesim.sensors.structured_light import StructuredLight, StructuredLightDecoder
from rangesim.sensors.zncc import ZnccDecoder

__all__ = [
    "ActiveStereo",
    "AmcwDecoder",
    "AmcwToF",
    "Decoder",
    "DirectToF",
    "DirectToFDecoder",
    "Emitter",
    "IdealToF",
    "IdealToFDecoder",
    "ReferencePatternDecoder",
    "ReferencePatternStereo",
    "Sensor",
    "StereoDecoder",
    "StructuredLight",
    "StructuredLightDecoder",
    "ZnccDecoder",
    "check_sensor",
    "is_file_name",
    "presets",
    "sensor_from_dict",
    "sensor_of",
]
