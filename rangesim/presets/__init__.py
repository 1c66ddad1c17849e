# SPDX-License-Identifier: Apache-2.0
"""Devices that people have, as instruments by name, with a source for every number; and sensors by name.

Each device is a TOML file in `devices/`: its data sheet, its settings, and where each number comes from. A file of your
own works in the same way. docs/presets.md says how to make one from a data sheet.

Examples
--------
>>> from rangesim import presets
>>> camera = presets.load("azure-kinect-nfov")
>>> camera.power_w, camera.exposure_s is None  # of the device, not automatic
(..., False)
>>> presets.describe("azure-kinect-nfov").sources["instrument.exposure_s"][:10]
'microsoft:'
"""

from rangesim.presets.catalogue import (
    DEFAULT_SENSORS,
    describe,
    instrument,
    instrument_from_dict,
    is_device_file,
    load,
    names,
)
from rangesim.presets.data_sheet import DataSheet, PublishedNoise
from rangesim.presets.preset import Preset, read_preset

__all__ = [
    "DEFAULT_SENSORS",
    "DataSheet",
    "Preset",
    "PublishedNoise",
    "describe",
    "instrument",
    "instrument_from_dict",
    "is_device_file",
    "load",
    "names",
    "read_preset",
]
