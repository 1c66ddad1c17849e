# SPDX-License-Identifier: Apache-2.0
"""The light-transport passes that a sweep needs: as few as can be.

Scene, camera, emitter and the settings of the transport decide a pass. Noise, exposure, power, ambient
light, detector, decoder and code need none of their own: they are measured on the light of a pass that is there. Light
is linear, so a pass is traced with the largest power of its measurements.
"""

from __future__ import annotations

import hashlib
import json
import statistics
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.cost import Cost, CostBesideTracing, estimate_cost
from rangesim.pipeline.shared_passes import first_that_agrees, rig_of_pass
from rangesim.rig import Rig
from rangesim.settings.config import to_dict
from rangesim.settings.seeds import derived_seed
from rangesim.sweep.image_windows import windowed
from rangesim.sweep.sweep_settings import OF_TRANSPORT, Point, Sweep

if TYPE_CHECKING:
    from rangesim.scene import Scene

VERSION = 2
"""Version of the results of a pass. An item of another version is computed again."""
SEED_S = 2e-5
"""Seconds per pixel of each capture beside the light: exposure, decoding, causes and rows. Measured at 1.2e-5 to 3e-5
for AMCW and structured light, 64 x 48 pixels."""


@dataclass(frozen=True)
class Cell:
    """A sensor at a point, and where its results are: measurement `job` of pass `light_pass`, both from 0."""

    point: int
    sensor: str
    light_pass: int
    job: int


@dataclass
class PlannedPass:
    """A pass with all its measurements.

    point : a point with its scene and its settings of the transport. rig : Rig at 1 W. instruments : one for each
    measurement. jobs : plain data of each measurement. points : number of the first point of each measurement.
    numbers : number of each measurement, by its plain data as text.
    """

    point: Point
    rig: Rig
    instruments: list[Instrument] = field(default_factory=list)
    jobs: list[dict[str, Any]] = field(default_factory=list)
    points: list[int] = field(default_factory=list)
    numbers: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Plan:
    """The work of a sweep: its passes, and where the results of each point will be.

    working_distance_m : distance, metres, for which sensors without places of their own are set up: the median over the
        scenes of the sweep. So a rig does not change along with the scene.
    cells : one for each point and sensor.
    cost : estimated cost of all passes.
    """

    sweep: Sweep
    working_distance_m: float
    passes: tuple[PlannedPass, ...]
    cells: tuple[Cell, ...]
    cost: Cost

    @property
    def automatic(self) -> tuple[str, ...]:
        """Names of the sensors whose exposure has to be chosen for the sweep."""
        if self.sweep.exposure != "fixed":
            return ()
        found = [i for p in self.passes for i in p.instruments if _chooses_exposure(i)]
        return tuple(dict.fromkeys(one.name for one in found))

    @cached_property
    def probed(self) -> dict[str, PlannedPass]:
        """The passes before which a small one finds the exposures, by the key of its item."""
        found = [one for one in self.passes if self.automatic and any(map(_chooses_exposure, one.instruments))]
        return {_key("probe", self._item("probe", one, {})): one for one in found}

    def probes(self) -> dict[str, dict[str, Any]]:
        """Items that find the automatic exposure of each measurement: none if no sensor chooses it."""
        return {key: self._item("probe", one, {}) for key, one in self.probed.items()}

    def items(self, exposures_s: Mapping[str, float]) -> list[tuple[str, dict[str, Any]]]:
        """Key and argument of the item of each pass.

        Parameters
        ----------
        exposures_s : exposure of the sensors in `automatic`, seconds, by name.
        """
        made = [self._item("pass", one, exposures_s) for one in self.passes]
        return [(_key("pass", item), item) for item in made]

    def _item(self, kind: str, one: PlannedPass, exposures_s: Mapping[str, float]) -> dict[str, Any]:
        """Plain data of a pass, from which a worker carries it out without the sweep."""
        sweep, jobs = self.sweep, []
        for job, instrument in zip(one.jobs, one.instruments, strict=True):
            settings = dict(job["settings"])
            if instrument.name in exposures_s and _chooses_exposure(instrument):
                settings["exposure_s"] = exposures_s[instrument.name]
            jobs.append({**job, "settings": settings})
        return {
            "kind": kind,
            "version": VERSION,
            "scene": one.point.scene.to_dict(),
            "working_distance_m": self.working_distance_m,
            "transport": _transport_key(one.point),
            "window_px": sweep.window_px,
            "tolerance_m": sweep.tolerance_m,
            "folder": None if sweep.folder is None else str(sweep.folder),
            "jobs": jobs,
        }

    def __str__(self) -> str:
        sweep, n = self.sweep, len(self.passes)
        probes = len(self.probed)
        text = f"{len(sweep.points)} points x {len(sweep.given)} sensors x {sweep.seeds} seeds in {n} passes"
        if probes:
            text += f" ({probes} small ones before them, for the exposure)"
        return f"{text}: {self.cost}"


def plan(sweep: Sweep) -> Plan:
    """The plan of a sweep. Each of its scenes is loaded once.

    Raises
    ------
    ValueError, FileFormatError, EnvironmentProblem
        A scene cannot be loaded, ambient light is stated for a scene without any, or there is no suitable LLVM.
    """
    scenes: dict[str, Scene] = {}
    first: Scene | None = None
    for point in sweep.points:
        key = _text(point.scene.to_dict())
        if key not in scenes:
            scene = point.scene.load()
            first = first or scene
            scenes[key] = replace(scene, reload=None) if scene is first else replace(scene, mitsuba=None, reload=None)
            if point.ambient is not None:
                point.ambient.check_emitters(scene.has_ambient)
    assert first is not None
    working_distance_m = float(statistics.median(s.working_distance_m for s in scenes.values()))
    passes: list[PlannedPass] = []
    cells: list[Cell] = []
    groups: dict[str, list[tuple[Rig, list[Instrument]]]] = {}
    numbers: dict[tuple[str, int], int] = {}
    for point in sweep.points:
        scene_key = _text(point.scene.to_dict())
        scene = replace(scenes[scene_key], working_distance_m=working_distance_m)
        place = f"{scene_key}{_text(_transport_key(point))}"
        of_place = groups.setdefault(place, [])
        settings = point.experiment_settings
        for name in sweep.given:
            instrument = point.instrument(name)
            rig = rig_of_pass(replace(instrument, power_w=1.0), scene, settings.width, settings.height)
            index = first_that_agrees(of_place, rig, instrument)
            if index is None:
                index = len(of_place)
                of_place.append((rig, [instrument]))
                numbers[place, index] = len(passes)
                passes.append(PlannedPass(point, rig))
            number = numbers[place, index]
            cells.append(Cell(point.number, name, number, _job(passes[number], point, instrument, scene_key)))
    cost = _cost(sweep, first, passes)
    return Plan(sweep, working_distance_m, tuple(passes), tuple(cells), cost)


def _job(one: PlannedPass, point: Point, instrument: Instrument, scene_key: str) -> int:
    """Number of the measurement of an instrument in a pass, which is added unless the pass has an equal one.

    Its noise depends on the seed, the scene and the instrument, and not on the other settings of the light transport:
    points that differ in these alone have the same noise, so that their difference is the transport's.
    """
    sweep = point.sweep
    job = {
        "sensor": to_dict(sweep.sensors[list(sweep.given).index(instrument.name)]),
        "settings": {path: to_dict(value) for path, value in point.instrument_settings(instrument.name).items()},
        "ambient": to_dict(point.ambient),
    }
    key = _text(job)
    if key not in one.numbers:
        has_noise = instrument.noise and not instrument.sensor.is_ideal
        stream = zlib.crc32(f"{scene_key}{key}".encode())
        seed = point.experiment_settings.seed
        seeds = [derived_seed(seed, stream, k) for k in range(sweep.seeds * has_noise or 1)]
        one.numbers[key] = len(one.jobs)
        one.jobs.append({**job, "seeds": seeds})
        one.instruments.append(instrument)
        one.points.append(point.number)
    return one.numbers[key]


def _transport_key(point: Point) -> dict[str, Any]:
    """The settings of the light transport of a point, plain data."""
    settings = to_dict(point.experiment_settings)
    return {key: settings[key] for key in (*OF_TRANSPORT, "seed")}


def _chooses_exposure(instrument: Instrument) -> bool:
    """Whether an instrument has no exposure of its own, and noise."""
    return instrument.exposure_s is None and instrument.noise and not instrument.sensor.is_ideal


def _cost(sweep: Sweep, scene: Scene, passes: list[PlannedPass]) -> Cost:
    """Estimated cost of all passes of a sweep. No pass is traced for it."""
    traced = [(windowed(p.rig, p.instruments[0].sensor, sweep.window_px), p.instruments) for p in passes]
    captures = [
        rig.camera.width * rig.camera.height * i.sensor.n_cameras * len(job["seeds"])
        for (rig, _), p in zip(traced, passes, strict=True)
        for i, job in zip(p.instruments, p.jobs, strict=True)
    ]
    beside = CostBesideTracing(SEED_S * sum(captures), 0, 0, 0)
    return estimate_cost(passes[0].point.experiment_settings, scene, traced, trial=False, beside=beside)


def _key(kind: str, item: Mapping[str, Any]) -> str:
    """Name of an item, which depends on everything that its result depends on."""
    return f"{kind}-{hashlib.sha256(_text(item).encode()).hexdigest()[:20]}"


def _text(data: Any) -> str:
    return json.dumps(data, sort_keys=True, separators=(",", ":"))
