# SPDX-License-Identifier: Apache-2.0
"""What to measure and with what: a scene, the settings of the light transport, and the instruments to compare."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesim.ambient import Ambient
from rangesim.config import check_keys, from_dict, nearest, to_dict
from rangesim.detector import Detector, PhotoDetector
from rangesim.errors import FileFormatError
from rangesim.motion import Motion, Timing
from rangesim.motion.settings import motion_from_dict
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight
from rangesim.spad import SpadDetector

if TYPE_CHECKING:
    from rangesim.rig import Rig
    from rangesim.scene import Scene

TOF_BASELINE_M = 0.03
"""Metres from the camera's lens to the lamp beside it, of a time-of-flight camera."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


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
    timing : when its frames are taken, in an experiment in which something moves.
    """

    name: str
    sensor: Sensor
    detector: PhotoDetector | None = None
    noise: bool = True
    baseline_m: float | None = None
    power_w: float = 1.0
    exposure_s: float | None = None
    timing: Timing = field(default_factory=Timing)

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"expected a name of letters, digits, - and _, got {self.name!r}.")
        for name in ("baseline_m", "power_w", "exposure_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"expected a positive {name}, got {value}.")
        usual = self.detector or default_detector(self.sensor)
        object.__setattr__(self, "detector", usual if self.noise else None)

    def rig(self, scene: Scene, width: int | None = None, height: int | None = None) -> Rig:
        """The scene's camera, `width` x `height` pixels, and this instrument's emitter, which covers its view."""
        if isinstance(self.sensor, StructuredLight):
            size = (self.sensor.projector_width, self.sensor.projector_height)
            return scene.rig(self.baseline_m, size, self.power_w, width, height)
        baseline = TOF_BASELINE_M if self.baseline_m is None else self.baseline_m
        return scene.rig(baseline, power_w=self.power_w, width=width, height=height)


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
    return f"expected a sensor out of {', '.join(SENSORS)}, got {name!r}{nearest(name, SENSORS)}."


@dataclass(frozen=True)
class Experiment:
    """A scene, seen by one or more instruments.

    Parameters
    ----------
    scene : path of a Mitsuba 3 XML scene or of a mesh (PLY, OBJ, GLB ...).
    material : material class of a bare mesh (None: matte); refused for a scene, which names its own.
    unit_m : metres per unit of a bare mesh, 0.001 for millimetres (None: 1); refused for a scene.
    width, height : pixels of the camera; None: as in the scene. The field of view is kept.
    spp : light paths per pixel.
    max_depth : longest path in segments up to the light; 2 is direct light alone.
    seed : of transport and noise; the same seed gives the same bytes.
    ambient : what kind of light the scene's own emitters give, and how strong; None: not stated, see `expose`.
    instruments : those whose emitters stand in the same place share one light-transport pass, if nothing moves.
    motion : what moves; None: nothing.
    """

    scene: str
    material: str | None = None
    unit_m: float | None = None
    width: int | None = None
    height: int | None = None
    spp: int = 64
    max_depth: int = 5
    seed: int = 0
    ambient: Ambient | None = None
    instruments: tuple[Instrument, ...] = tuple(instrument(name) for name in DEFAULT_SENSORS)
    motion: Motion | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height", "spp", "max_depth"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"expected {name} to be a whole number of at least 1, got {value}.")
        if self.seed < 0:
            raise ValueError(f"expected a seed of at least 0, got {self.seed}.")
        names = [i.name for i in self.instruments]
        if not names:
            raise ValueError("expected at least one instrument, got none.")
        twice = [n for n in names if names.count(n) > 1]
        if twice:
            raise ValueError(f"expected instruments of different names, got {twice[0]!r} twice.")


def load_experiment(path: str | Path) -> Experiment:
    """The experiment of a TOML file; a relative scene path counts from the file's directory.

    Raises
    ------
    FileFormatError
        The file is missing or no valid TOML, or holds an unknown key or a bad value; the message names the place.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected an experiment (.toml).")
    try:
        experiment = experiment_from_dict(tomllib.loads(path.read_text(encoding="utf-8")))
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is no text file.") from error
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(f"{path} is no valid TOML: {error}.") from error
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error
    return replace(experiment, scene=str(path.parent / experiment.scene))


def experiment_from_dict(data: Mapping[str, Any]) -> Experiment:
    """The experiment of plain data; each table under `instrument` is one instrument. ValueError as `from_dict`."""
    check_keys(data, ["instrument" if f.name == "instruments" else f.name for f in fields(Experiment)], "experiment")
    rest = {key: value for key, value in data.items() if key not in ("instrument", "motion")}
    experiment = from_dict(Experiment, rest)
    if data.get("motion") is not None:
        experiment = replace(experiment, motion=motion_from_dict(data["motion"]))
    tables = data.get("instrument")
    if tables is None:
        return experiment
    if not isinstance(tables, list):
        raise ValueError("expected instruments as tables headed [[instrument]], with two brackets.")
    return replace(experiment, instruments=tuple(_instrument(t, f"instrument[{i}]") for i, t in enumerate(tables)))


def experiment_to_dict(experiment: Experiment) -> dict[str, Any]:
    """Plain data that `experiment_from_dict` reads back equal."""
    data = to_dict(experiment)
    data["instrument"] = data.pop("instruments")
    return dict(data)


def _instrument(table: Any, place: str) -> Instrument:
    """An instrument; its sensor is a table with a `type`, or a short name out of `SENSORS`."""
    if not isinstance(table, Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {table!r}.")
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
        values["detector"] = from_dict(PhotoDetector, values["detector"], f"{place}.detector")  # type: ignore[type-abstract]
    return from_dict(Instrument, values, place)
