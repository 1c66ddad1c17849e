# SPDX-License-Identifier: Apache-2.0
"""Simulated range sensors: light transport, captures, decoders, comparison.

Names are imported when they are first used, so that decoding a real capture starts no renderer.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # the module typing would double the time of this import
if TYPE_CHECKING:
    from typing import Any

_HOME = {
    "Ambient": "rangesim.electronics.ambient",
    "AmcwToF": "rangesim.sensors",
    "Capture": "rangesim.capture",
    "Decoder": "rangesim.sensors",
    "Detector": "rangesim.electronics.detector",
    "DirectToF": "rangesim.sensors",
    "IdealToF": "rangesim.sensors",
    "Intrinsics": "rangesim.rig",
    "PointCloud": "rangesim.point_cloud",
    "RangeImage": "rangesim.decoding.range_image",
    "Rig": "rangesim.rig",
    "Scene": "rangesim.scene",
    "Sensor": "rangesim.sensors",
    "Signals": "rangesim.signals",
    "SpadDetector": "rangesim.electronics.spad",
    "Status": "rangesim.decoding.status",
    "StructuredLight": "rangesim.sensors",
    "compare": "rangesim.evaluation.comparison",
    "decode": "rangesim.decoding",
    "explain": "rangesim.causes",
    "expose": "rangesim.capture.exposure",
    "import_capture": "rangesim.capture.capture_files",
    "load_calibration": "rangesim.rig.calibration_files",
    "load_capture": "rangesim.capture.capture_files",
    "load_scene": "rangesim.scene",
    "look_at": "rangesim.rig",
    "transport": "rangesim.light_transport.one_pass",
}

__all__ = sorted(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'rangesim' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
