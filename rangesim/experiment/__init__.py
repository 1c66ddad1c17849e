# SPDX-License-Identifier: Apache-2.0
"""Settings of experiments and scans: what is measured, with which instruments, and along which camera path.

They are frozen dataclasses that can be written to and read from TOML and JSON. This package carries nothing out;
`rangesim.pipeline` does that. The settings of a sweep over experiments would be a further module here.
"""

from rangesim.experiment.camera_paths import CameraPath, Dome, HandHeld, PoseList, Turntable, Viewpoint
from rangesim.experiment.experiment import Experiment, experiment_from_dict, experiment_to_dict, load_experiment
from rangesim.experiment.scan_settings import (
    ScanSettings,
    load_scan_settings,
    scan_settings_from_dict,
    scan_settings_to_dict,
)

__all__ = [
    "CameraPath",
    "Dome",
    "Experiment",
    "HandHeld",
    "PoseList",
    "ScanSettings",
    "Turntable",
    "Viewpoint",
    "experiment_from_dict",
    "experiment_to_dict",
    "load_experiment",
    "load_scan_settings",
    "scan_settings_from_dict",
    "scan_settings_to_dict",
]
