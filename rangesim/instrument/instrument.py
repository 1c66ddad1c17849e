# SPDX-License-Identifier: Apache-2.0
"""Instruments: a sensor with its electronics, its optics and its place."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesim.electronics.detector import PhotoDetector
from rangesim.motion import Timing
from rangesim.rig import CAMERA_LENS, PROJECTOR_LENS, Lens
from rangesim.sensors import Decoder, Sensor, check_sensor, is_file_name, sensor_from_dict, sensor_of
from rangesim.settings.bounds import Metres, Seconds, Watts, check_fields
from rangesim.settings.config import check_keys, from_dict, on_top_of, shown

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

MAX_NAME = 100
"""Characters; the name becomes that of a directory."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@dataclass(frozen=True)
class Instrument:
    """A sensor with its electronics and its place in the scene.

    Parameters
    ----------
    name : names its directory in the results: letters, digits, hyphens and underscores.
    sensor : Sensor, the measuring principle.
    detector : PhotoDetector; None: `Sensor.default_detector`.
    noise : bool; False: noise-free float frames, no detector at all.
    decoder : Decoder, with its thresholds; None: `Sensor.default_decoder`.
    baseline_m : metres between camera and emitter; None: as the sensor comes, a fifth of the working distance for
        structured light, 0.03 m for time of flight.
    power_w : watts, mean radiant power of the emitter when it is fully on.
    exposure_s : seconds per frame; None: automatic.
    camera_lens, projector_lens : Lens, aperture, focus and vignetting.
    timing : when its frames are taken, in an experiment in which something moves.
    """

    name: str
    sensor: Sensor
    detector: PhotoDetector | None = None
    noise: bool = True
    decoder: Decoder | None = None
    baseline_m: Metres | None = None
    power_w: Watts = 1.0
    exposure_s: Seconds | None = None
    camera_lens: Lens = CAMERA_LENS
    projector_lens: Lens = PROJECTOR_LENS
    timing: Timing = field(default_factory=Timing)

    def __post_init__(self) -> None:
        check_fields(self)
        if not _NAME.fullmatch(self.name) or len(self.name) > MAX_NAME:
            raise ValueError(
                f"expected a name of letters, digits, - and _, at most {MAX_NAME}, got {shown(self.name)}."
            )
        check_sensor(self.sensor)
        if self.decoder is not None:
            self.decoder.check(self.sensor)
        detector = self.detector or self.sensor.default_detector
        if detector is not None and not self.sensor.is_ideal:
            detector.check(self.sensor.gate)
        object.__setattr__(self, "detector", detector if self.noise else None)

    def rig(self, scene: Scene, width: int | None = None, height: int | None = None) -> Rig:
        """The scene's camera, `width` x `height` pixels, and this instrument's emitter, which covers its view."""
        size, baseline_m = self.sensor.emitter
        if self.baseline_m is not None:
            baseline_m = self.baseline_m
        rig = scene.rig(baseline_m, size, self.power_w, width, height)
        return replace(rig, camera_lens=self.camera_lens, projector_lens=self.projector_lens)


DEFAULT_SENSORS = ("gray-phase", "amcw", "ideal-tof")
"""Structured light against time of flight, and the reference that says what no time-of-flight camera can better."""


def instrument(name: str, **settings: Any) -> Instrument:
    """The instrument with the sensor of a name, see `rangesim.sensors.sensor_of`; errors as there."""
    sensor = sensor_of(name)
    return Instrument(_name_of(name, sensor), sensor, **settings)


def _name_of(given: str, sensor: Sensor) -> str:
    """The name of an instrument given by its sensor alone: of the preset, or the type of a sensor from a file."""
    return sensor.type_name if is_file_name(given) else given


def instrument_from_dict(table: Any, place: str, files_in: Path | None = None) -> Instrument:
    """An instrument; its sensor is the name of a preset, or a table with a `type`.

    Parameters
    ----------
    files_in : folder from which a sensor named as FILE.py:NAME is loaded, see `rangesim.sensors.sensor_of`; None:
        no file is, as in what is read back of results.
    """
    if not isinstance(table, Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {shown(table)}.")
    values = dict(table)
    if "optics" in values:
        raise ValueError(
            f"{place}: expected tables camera_lens and projector_lens in place of optics, see docs/optics.md."
        )
    check_keys(values, [f.name for f in fields(Instrument)], place)
    given, sensor = values.get("sensor"), None
    if given is not None:
        values["sensor"] = sensor = sensor_from_dict(given, f"{place}.sensor", files_in)
        if isinstance(given, str):
            values.setdefault("name", _name_of(given, sensor))
    for key, kind, default in (
        ("detector", PhotoDetector, getattr(sensor, "default_detector", None)),
        ("decoder", Decoder, getattr(sensor, "default_decoder", None)),
    ):
        if values.get(key) is not None:
            values[key] = from_dict(kind, on_top_of(default, values[key]), f"{place}.{key}")
    return from_dict(Instrument, values, place)
