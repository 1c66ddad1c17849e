# SPDX-License-Identifier: Apache-2.0
"""Instruments: a sensor with its electronics, its optics and its place."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

from rangesim.bounds import Exponent, Metres, Seconds, Watts, check_fields
from rangesim.config import check_keys, from_dict, nearest, shown, to_dict
from rangesim.detector import Detector, PhotoDetector
from rangesim.motion import Timing
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight
from rangesim.spad import SpadDetector

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

TOF_BASELINE_M = 0.03
"""Metres from the camera's lens to the lamp beside it, of a time-of-flight camera."""
LONGEST_NAME = 100
"""Characters; the name becomes that of a directory."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@dataclass(frozen=True)
class Optics:
    """Lenses of an instrument; see `rangesim.rig.Rig` for the parameters. The default is a sharp, even pinhole."""

    camera_aperture_radius_m: Metres = 0.75e-3
    projector_aperture_radius_m: Metres = 2e-3
    camera_focus_m: Metres | None = None
    projector_focus_m: Metres | None = None
    camera_vignetting: Exponent = 0.0
    projector_vignetting: Exponent = 0.0

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Instrument:
    """A sensor with its electronics and its place in the scene.

    Parameters
    ----------
    name : names its directory in the results: letters, digits, hyphens and underscores.
    sensor : Sensor, the measuring principle.
    detector : PhotoDetector; None: the usual one of the sensor, see `default_detector`.
    noise : bool; False: noise-free float frames, no detector at all.
    baseline_m : metres between camera and emitter; None: a fifth of the working distance for structured light,
        0.03 m for time of flight.
    power_w : watts, mean radiant power of the emitter when it is fully on.
    exposure_s : seconds per frame; None: automatic.
    optics : Optics, aperture, focus and vignetting of camera and projector.
    timing : when its frames are taken, in an experiment in which something moves.
    """

    name: str
    sensor: Sensor
    detector: PhotoDetector | None = None
    noise: bool = True
    baseline_m: Metres | None = None
    power_w: Watts = 1.0
    exposure_s: Seconds | None = None
    optics: Optics = field(default_factory=Optics)
    timing: Timing = field(default_factory=Timing)

    def __post_init__(self) -> None:
        check_fields(self)
        if not _NAME.fullmatch(self.name) or len(self.name) > LONGEST_NAME:
            raise ValueError(
                f"expected a name of letters, digits, - and _, at most {LONGEST_NAME}, got {shown(self.name)}."
            )
        usual = self.detector or default_detector(self.sensor)
        object.__setattr__(self, "detector", usual if self.noise else None)

    def rig(self, scene: Scene, width: int | None = None, height: int | None = None) -> Rig:
        """The scene's camera, `width` x `height` pixels, and this instrument's emitter, which covers its view."""
        if isinstance(self.sensor, StructuredLight):
            size = (self.sensor.projector_width, self.sensor.projector_height)
            rig = scene.rig(self.baseline_m, size, self.power_w, width, height)
        else:
            baseline = TOF_BASELINE_M if self.baseline_m is None else self.baseline_m
            rig = scene.rig(baseline, power_w=self.power_w, width=width, height=height)
        return replace(rig, **vars(self.optics))


def default_detector(sensor: Sensor) -> PhotoDetector | None:
    """An industrial camera for structured light, a lock-in pixel for AMCW, a SPAD for direct time of flight."""
    if isinstance(sensor, StructuredLight):
        return Detector()
    if isinstance(sensor, AmcwToF):
        return Detector.time_of_flight()
    return SpadDetector() if isinstance(sensor, DirectToF) else None


SENSORS: dict[str, Sensor] = {
    "gray": StructuredLight(code="gray"),
    "gray-phase": StructuredLight(code="gray-phase"),
    "amcw": AmcwToF(),
    "direct-tof": DirectToF(),
    "ideal-tof": IdealToF(),
}
"""Short names of sensors with their usual settings, as on the command line."""

DEFAULT_SENSORS = ("gray-phase", "amcw", "ideal-tof")
"""Structured light against time of flight, and the reference that says what no time-of-flight camera can better."""


def instrument(name: str, **settings: Any) -> Instrument:
    """The instrument of a short name in `SENSORS`; ValueError with the nearest valid name if there is none."""
    if name not in SENSORS:
        raise ValueError(_unknown(name))
    return Instrument(name, SENSORS[name], **settings)


def _unknown(name: str) -> str:
    return f"expected a sensor out of {', '.join(SENSORS)}, got {shown(name)}{nearest(name, SENSORS)}."


def instrument_from_dict(table: Any, place: str) -> Instrument:
    """An instrument; its sensor is a table with a `type`, or a short name out of `SENSORS`."""
    if not isinstance(table, Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {shown(table)}.")
    values = dict(table)
    check_keys(values, [f.name for f in fields(Instrument)], place)
    sensor = values.get("sensor")
    if isinstance(sensor, str):
        if sensor not in SENSORS:
            raise ValueError(f"{place}: {_unknown(sensor)}")
        values = {"name": sensor, **values, "sensor": SENSORS[sensor]}
    elif sensor is not None:
        values["sensor"] = from_dict(Sensor, sensor, f"{place}.sensor")  # type: ignore[type-abstract]
    if values.get("detector") is not None:
        values["detector"] = _detector(values["detector"], values.get("sensor"), f"{place}.detector")
    return from_dict(Instrument, values, place)


def _detector(table: Any, sensor: Any, place: str) -> PhotoDetector:
    """The detector of a table: the usual one of the sensor, but for what the table says."""
    usual = default_detector(sensor) if isinstance(sensor, Sensor) else None
    if isinstance(table, Mapping) and usual is not None and table.get("type", usual.type_name) == usual.type_name:
        table = {**to_dict(usual), **table}
    return from_dict(PhotoDetector, table, place)  # type: ignore[type-abstract]
