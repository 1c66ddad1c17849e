# SPDX-License-Identifier: Apache-2.0
"""Simulation of range sensors: light transport, captures, decoders, and comparison with the ground truth.

The names in `__all__` are the public interface. Each is imported when it is first used, so that a program that decodes
a real capture loads no renderer.

Examples
--------
>>> import rangesim
>>> sensor = rangesim.StructuredLight(code="gray-phase")
>>> sensor.n_frames
22
>>> scene = rangesim.load_scene("tabletop")  # doctest: +SKIP
>>> signals = rangesim.transport(scene, scene.rig(baseline_m=0.2), [sensor])  # doctest: +SKIP
>>> image = rangesim.decode(rangesim.expose(signals, sensor, sensor.default_detector))  # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # not imported from typing, because typing would double the time of this import
if TYPE_CHECKING:  # the names of `_HOME`, for editors and type checkers
    from typing import Any

    from rangesim.capture import Capture as Capture
    from rangesim.capture import CaptureSet as CaptureSet
    from rangesim.capture.exposure import expose as expose
    from rangesim.causes import explain as explain
    from rangesim.decoding import decode as decode
    from rangesim.decoding.range_image import RangeImage as RangeImage
    from rangesim.decoding.returns import Returns as Returns
    from rangesim.decoding.status import Status as Status
    from rangesim.electronics.ambient import Ambient as Ambient
    from rangesim.electronics.detector import Detector as Detector
    from rangesim.electronics.spad import SpadDetector as SpadDetector
    from rangesim.evaluation.comparison import compare as compare
    from rangesim.instrument.transport import transport as transport
    from rangesim.light_transport.transport_settings import TransportSettings as TransportSettings
    from rangesim.pipeline.views import scan as scan
    from rangesim.point_cloud import PointCloud as PointCloud
    from rangesim.report import errors_markdown as errors_markdown
    from rangesim.report import failures_markdown as failures_markdown
    from rangesim.response import Pulse as Pulse
    from rangesim.results.captures import import_capture as import_capture
    from rangesim.results.captures import load_capture as load_capture
    from rangesim.results.captures import save_capture as save_capture
    from rangesim.results.range_images import load_range_image as load_range_image
    from rangesim.results.range_images import save_range_image as save_range_image
    from rangesim.results.saved_signals import load_signals as load_signals
    from rangesim.results.saved_signals import save_signals as save_signals
    from rangesim.rig import Beam as Beam
    from rangesim.rig import Camera as Camera
    from rangesim.rig import CoverGlass as CoverGlass
    from rangesim.rig import Fisheye as Fisheye
    from rangesim.rig import Intrinsics as Intrinsics
    from rangesim.rig import Lens as Lens
    from rangesim.rig import Lissajous as Lissajous
    from rangesim.rig import Orthographic as Orthographic
    from rangesim.rig import RayTable as RayTable
    from rangesim.rig import Rig as Rig
    from rangesim.rig import Risley as Risley
    from rangesim.rig import Spinning as Spinning
    from rangesim.rig import Zones as Zones
    from rangesim.rig import look_at as look_at
    from rangesim.rig.calibration_files import load_calibration as load_calibration
    from rangesim.scene import Scene as Scene
    from rangesim.scene import load_scene as load_scene
    from rangesim.sensors import ActiveStereo as ActiveStereo
    from rangesim.sensors import AmcwToF as AmcwToF
    from rangesim.sensors import Decoder as Decoder
    from rangesim.sensors import DirectToF as DirectToF
    from rangesim.sensors import IdealToF as IdealToF
    from rangesim.sensors import Sensor as Sensor
    from rangesim.sensors import StructuredLight as StructuredLight
    from rangesim.signals import Signals as Signals
    from rangesim.signals import StillSignals as StillSignals

_HOME = {
    "ActiveStereo": "rangesim.sensors",
    "Ambient": "rangesim.electronics.ambient",
    "AmcwToF": "rangesim.sensors",
    "Beam": "rangesim.rig",
    "Camera": "rangesim.rig",
    "Capture": "rangesim.capture",
    "CaptureSet": "rangesim.capture",
    "CoverGlass": "rangesim.rig",
    "Decoder": "rangesim.sensors",
    "Detector": "rangesim.electronics.detector",
    "DirectToF": "rangesim.sensors",
    "Fisheye": "rangesim.rig",
    "IdealToF": "rangesim.sensors",
    "Intrinsics": "rangesim.rig",
    "Lens": "rangesim.rig",
    "Lissajous": "rangesim.rig",
    "Orthographic": "rangesim.rig",
    "PointCloud": "rangesim.point_cloud",
    "Pulse": "rangesim.response",
    "RangeImage": "rangesim.decoding.range_image",
    "RayTable": "rangesim.rig",
    "Returns": "rangesim.decoding.returns",
    "Rig": "rangesim.rig",
    "Risley": "rangesim.rig",
    "Scene": "rangesim.scene",
    "Sensor": "rangesim.sensors",
    "Signals": "rangesim.signals",
    "SpadDetector": "rangesim.electronics.spad",
    "Spinning": "rangesim.rig",
    "Status": "rangesim.decoding.status",
    "StillSignals": "rangesim.signals",
    "StructuredLight": "rangesim.sensors",
    "TransportSettings": "rangesim.light_transport.transport_settings",
    "Zones": "rangesim.rig",
    "compare": "rangesim.evaluation.comparison",
    "decode": "rangesim.decoding",
    "errors_markdown": "rangesim.report",
    "explain": "rangesim.causes",
    "expose": "rangesim.capture.exposure",
    "failures_markdown": "rangesim.report",
    "import_capture": "rangesim.results.captures",
    "load_calibration": "rangesim.rig.calibration_files",
    "load_capture": "rangesim.results.captures",
    "load_range_image": "rangesim.results.range_images",
    "load_scene": "rangesim.scene",
    "load_signals": "rangesim.results.saved_signals",
    "look_at": "rangesim.rig",
    "save_capture": "rangesim.results.captures",
    "save_range_image": "rangesim.results.range_images",
    "save_signals": "rangesim.results.saved_signals",
    "scan": "rangesim.pipeline.views",
    "transport": "rangesim.instrument.transport",
}
"""The module that defines each public name."""

__all__ = sorted(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'rangesim' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
