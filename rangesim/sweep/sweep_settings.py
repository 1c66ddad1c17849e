# SPDX-License-Identifier: Apache-2.0
"""The settings of a sweep: a scene, sensors, and values for any settings by their paths."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rangesim.electronics.ambient import Ambient
from rangesim.errors import FileFormatError
from rangesim.evaluation.comparison import TOLERANCE_M
from rangesim.experiment import Experiment
from rangesim.files.text_files import read_toml
from rangesim.instrument.instrument import Instrument
from rangesim.instrument.instrument import instrument_from_dict as instrument_of_table
from rangesim.presets import instrument_from_dict
from rangesim.settings import limits
from rangesim.settings.bounds import SECONDS, Bounds, Metres, check_fields, check_number, whole
from rangesim.settings.config import from_dict, nearest, shown, to_dict
from rangesim.settings.seeds import check_seed
from rangesim.sweep.scene_sources import SceneSource, scene_source

if TYPE_CHECKING:
    from rangesim.light_transport.transport_settings import TransportSettings

OF_TRANSPORT = ("spp", "max_spp", "max_depth", "caustics", "glint", "width", "height")
"""Settings of an experiment that a sweep may vary besides the scene, the seed and the ambient light."""
MAX_POINTS = 10_000
"""Largest number of points of a sweep. All lie in memory: with two sensors, one takes 8 kB, and 4 ms before the first
pass begins."""
DARKNESS = {"illuminant": "sun", "illuminance_lux": 0.0}
"""The ambient light of a sweep whose scene is a function of the package, unless the file states another."""


@dataclass(frozen=True)
class Sweep:
    """A grid of measurements: all sensors, at all combinations of the values of `vary`, with noise of several seeds.

    Settings have paths. `scene.distance_m` is a parameter of the scene; `ambient.illuminance_lux` and `max_depth` are
    those of an `Experiment`; `power_w`, `exposure_s`, `noise`, `detector.read_noise_e` or `sensor.modulation_hz` are
    those of every `Instrument` that has them; `kinect-v2.power_w` is that of one sensor.

    Parameters
    ----------
    scene : name of a scene function of the package ("wall", "step", "part_on_table"), FILE.py:NAME of a function of
        your own, or what `Experiment.scene` accepts; or a table with `name` and the parameters of the function.
    sensors : names, or tables as those of the instruments of an experiment.
    vary : path -> values. The grid has all combinations, the last path varying fastest.
    settings : path -> value, settings of all points.
    seeds : number of captures of each point, with independent noise.
    exposure : "fixed": where a sensor states no exposure, all points have the one that saturates at none of them;
        "auto": each capture chooses its own; or seconds.
    tolerance_m : error above which a reading is wrong, metres.
    window_px : pixels across of the middle of the image that is measured, three quarters as many down; None: the whole
        image. Pixels stay as large as they are. Stereo sensors keep whole rows, in which they search.
    title : heading of the page.
    folder : folder that relative paths of files count from; None: the current one.

    Raises
    ------
    ValueError
        An unknown path, with the nearest valid one; a value that is refused; no sensor; two of one name.

    Examples
    --------
    >>> sweep = Sweep(scene="wall", sensors=("amcw", "gray-phase"), vary={"scene.distance_m": (0.5, 1.0)}, seeds=3)
    >>> len(sweep.points), sweep.sensor_names
    (2, ('amcw', 'gray-phase'))
    >>> Sweep(scene="wall", sensors=("amcw",), vary={"scene.distance": (1.0,)})
    Traceback (most recent call last):
    ValueError: vary: unknown path 'scene.distance' (did you mean 'scene.distance_m'?); ...
    """

    scene: object
    sensors: Sequence[Any]
    vary: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    seeds: Annotated[int, Bounds("a number of seeds", 1, 10_000)] = 5
    seed: int = 0
    exposure: Literal["fixed", "auto"] | float = "fixed"
    tolerance_m: Metres = TOLERANCE_M
    window_px: Annotated[int, whole(1, "pixels")] | None = None
    title: str = "Sweep"
    folder: Path | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "seed", check_seed(self.seed))
        object.__setattr__(self, "sensors", _several("sensors", self.sensors))
        object.__setattr__(self, "vary", {p: _several(f"vary.{p}", v) for p, v in self.vary.items()})
        if not isinstance(self.exposure, str):
            check_number("exposure", self.exposure, SECONDS)
        elif self.exposure not in ("fixed", "auto"):
            raise ValueError(f"expected exposure as 'fixed', 'auto' or seconds, got {shown(self.exposure)}.")
        for place, paths in (("vary", self.vary), ("sweep", self.settings)):
            for path in paths:
                self._check_path(path, place)
        limits.check("instruments", len(self.sensors), "sensors")
        if (count := math.prod(map(len, self.vary.values()))) > MAX_POINTS:
            raise ValueError(f"expected at most {MAX_POINTS} combinations of the values of vary, got {count}.")
        self._check_contradictions()
        for point in self.points:
            _ = point.scene, point.ambient, point.experiment_settings  # refused here, not in the middle of the work
            for name in self.sensor_names:
                point.instrument(name)

    @cached_property
    def given(self) -> dict[str, Instrument]:
        """The sensors as they are without the settings of the sweep, by name."""
        made = [instrument_given(one, f"sensors[{i}]", self.folder) for i, one in enumerate(self.sensors)]
        names = [one.name for one in made]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"expected sensors of different names, got {twice[0]!r} twice; state a name for each.")
        return dict(zip(names, made, strict=True))

    @cached_property
    def sensor_paths(self) -> dict[str, list[str]]:
        """Paths of the settings of each sensor, by its name."""
        return {name: _paths_of(one) for name, one in self.given.items()}

    @cached_property
    def instruments(self) -> dict[str, Instrument]:
        """The instruments of the points so far, by name and settings: many points share one."""
        return {}

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(self.given)

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """All points of the grid, in the order of their numbers."""
        combinations = itertools.product(*self.vary.values())
        return tuple(Point(self, i, dict(zip(self.vary, values, strict=True))) for i, values in enumerate(combinations))

    def paths(self) -> list[str]:
        """All paths that the file may set or vary."""
        scene = scene_source(self.settings.get("scene", self.scene), self.folder)
        of_scene = [f"scene.{name}" for name in scene.parameters]
        of_sensors = dict.fromkeys(p for paths in self.sensor_paths.values() for p in paths)
        one_each = [f"{name}.{path}" for name, paths in self.sensor_paths.items() for path in paths]
        ambient = [f"ambient.{f.name}" for f in fields(Ambient)]
        return ["scene", *of_scene, *OF_TRANSPORT, "seed", "ambient", *ambient, *of_sensors, *one_each]

    def _check_contradictions(self) -> None:
        """Raise ValueError if something is stated twice."""
        for path, values in self.vary.items():
            if path in self.settings:
                raise ValueError(f"expected {path} as one value or in vary, got both.")
            if twice := [value for i, value in enumerate(values) if value in values[:i]]:
                raise ValueError(f"expected different values of vary.{path}, got {shown(twice[0])} twice.")
        if self.exposure != "fixed" and "exposure_s" in {*self.vary, *self.settings}:
            raise ValueError("expected exposure or exposure_s, got both.")

    def _check_path(self, path: str, place: str) -> None:
        valid = self.paths()
        if path not in valid:
            short = [p for p in valid if p.count(".") < 2]
            hint = nearest(path, [*valid, *(f.name for f in fields(Sweep))] if place == "sweep" else valid)
            raise ValueError(
                f"{place}: unknown path {shown(path)}{hint}; settings have paths such as {', '.join(short[:12])}."
            )


@dataclass(frozen=True, eq=False)
class Point:
    """A combination of the values that a sweep varies.

    number : its number in the grid, from 0. values : path -> value.
    """

    sweep: Sweep
    number: int
    values: Mapping[str, Any]

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All settings of this point that are stated, by path."""
        return {**self.sweep.settings, **self.values}

    @cached_property
    def scene(self) -> SceneSource:
        """The scene with its parameters."""
        scene = scene_source(self.settings.get("scene", self.sweep.scene), self.sweep.folder)
        given = {p.partition(".")[2]: v for p, v in self.settings.items() if p.startswith("scene.")}
        return scene.with_parameters(given)

    @cached_property
    def ambient(self) -> Ambient | None:
        """The ambient light; None: not stated."""
        base: dict[str, Any] | None = dict(DARKNESS) if self.scene.is_of_package else None
        for path, value in self.settings.items():
            if path == "ambient":
                stated = to_dict(value)
                if not isinstance(stated, Mapping | None):
                    raise ValueError(f"expected ambient as a table of settings, got {shown(value)}.")
                base = None if stated is None else {"illuminant": "sun", **stated}
            elif path.startswith("ambient."):
                base = {"illuminant": "sun"} if base is None else base
                if path == "ambient.irradiance_w_m2":
                    base.pop("illuminance_lux", None)
                base[path.partition(".")[2]] = value
        return None if base is None else from_dict(Ambient, base, "ambient")

    @cached_property
    def experiment_settings(self) -> Experiment:
        """The settings of the light transport, as an experiment without a scene of its own."""
        given = {p: self.settings[p] for p in OF_TRANSPORT if p in self.settings}
        given["seed"] = self.settings.get("seed", self.sweep.seed)
        return from_dict(Experiment, {"scene": "-", **given})

    def transport(self, instruments: Sequence[Instrument]) -> TransportSettings:
        """Settings of a light-transport pass for these instruments."""
        return replace(self.experiment_settings, ambient=self.ambient).transport_settings(instruments)

    def instrument_settings(self, name: str) -> dict[str, Any]:
        """Settings of this point that concern one sensor, by the path within its `Instrument`."""
        instrument, found = self.sweep.given[name], {}
        valid = self.sweep.sensor_paths[name]
        for path, value in self.settings.items():
            if path in valid:
                found[path] = value
        for path, value in self.settings.items():
            if path.startswith(f"{name}.") and path.removeprefix(f"{name}.") in valid:
                found[path.removeprefix(f"{name}.")] = value
        if not isinstance(self.sweep.exposure, str) and not instrument.sensor.is_ideal:
            found.setdefault("exposure_s", self.sweep.exposure)
        return found

    def instrument(self, name: str) -> Instrument:
        """A sensor with the settings of this point."""
        settings, made = self.instrument_settings(name), self.sweep.instruments
        key = f"{name} {json.dumps(to_dict(settings), sort_keys=True)}"
        if key not in made:
            made[key] = with_settings(self.sweep.given[name], settings, self.sweep.folder)
        return made[key]


def load_sweep(path: str | Path) -> Sweep:
    """The sweep that a TOML file describes; `examples/sweep_distance.toml` shows the keys.

    Raises
    ------
    FileFormatError
        The file is missing, is no valid TOML, or has an unknown key or a bad value. The message names the place.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected a sweep (.toml).")
    try:
        return sweep_from_dict(read_toml(path), path.parent)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def sweep_from_dict(data: Mapping[str, Any], folder: Path | None = None) -> Sweep:
    """The sweep that plain data describes. Keys that are no fields of `Sweep` are settings of all points by their path.

    Raises
    ------
    ValueError
        As `Sweep`.

    Examples
    --------
    >>> table = {"scene": "wall", "sensors": ["amcw"], "vary": {"scene": {"distance_m": [1.0, 2.0]}}, "power_w": 2.0}
    >>> sweep_from_dict(table).points[1].settings
    {'power_w': 2.0, 'scene.distance_m': 2.0}
    """
    own = {f.name for f in fields(Sweep)} - {"settings", "folder"}
    values = {key: value for key, value in data.items() if key in own}
    for key in ("scene", "sensors"):
        if key not in values:
            raise ValueError(f"sweep: missing {key!r}.")
    vary = values.get("vary", {})
    if not isinstance(vary, Mapping):
        raise ValueError(f"expected vary as a table of paths, [vary], got {shown(vary)}.")
    rest = {key: value for key, value in data.items() if key not in own}
    values |= {"vary": dict(_flat(vary)), "settings": dict(_flat(rest)), "folder": folder}
    return Sweep(**values)


def sweep_to_dict(sweep: Sweep) -> dict[str, Any]:
    """The sweep as plain data, with which the results say what was asked."""
    data = {f.name: to_dict(getattr(sweep, f.name)) for f in fields(Sweep) if f.name not in ("settings", "folder")}
    return {**data, **{path: to_dict(value) for path, value in sweep.settings.items()}}


def with_settings(instrument: Instrument, settings: Mapping[str, Any], folder: Path | None = None) -> Instrument:
    """An instrument with other values of some settings.

    Parameters
    ----------
    settings : path within the instrument -> value, for example "detector.read_noise_e".
    """
    if not settings:
        return instrument
    plain = to_dict(instrument)
    for path, value in settings.items():
        plain = _changed(plain, path, to_dict(value))
    return instrument_of_table(plain, instrument.name, folder)


def _changed(table: Any, path: str, value: Any) -> Any:
    """Plain data with another value at a path."""
    if not path:
        return value
    first, _, rest = path.partition(".")
    table = table if isinstance(table, Mapping) else {}
    return {**table, first: _changed(table.get(first), rest, value)}


def _paths_of(instrument: Instrument) -> list[str]:
    """Paths of all settings of an instrument, and of the tables that hold them, except its name."""
    return [p for p in _walk(to_dict(instrument)) if p not in ("name", "sensor") and not p.endswith(".type")]


def _walk(table: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in table.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _walk(value, f"{prefix}{key}.")


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Path and value of each entry of nested tables."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def instrument_given(given: Any, place: str, folder: Path | None) -> Instrument:
    """The instrument that an entry of `Sweep.sensors` names or describes, with its decoder."""
    table = {"sensor": given} if isinstance(given, str) else given
    made = instrument_from_dict(table, place, folder or Path())
    if made.decoder is None:  # so that its settings have paths
        made = replace(made, decoder=made.sensor.default_decoder)
    return made


def _several(name: str, values: Any) -> tuple[Any, ...]:
    if isinstance(values, (str, Mapping)) or not isinstance(values, Sequence) or not values:
        raise ValueError(f"expected {name} as a list of one value or more, got {shown(values)}.")
    return tuple(values)
