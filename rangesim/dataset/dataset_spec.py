# SPDX-License-Identifier: Apache-2.0
"""The specification of a data set of random scenes, as a frozen dataclass and as a TOML file.

Numbers and names may be constants or distributions, see `rangesim.settings.draws`. docs/datasets.md explains all keys.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import numpy as np

from rangesim.dataset.model_files import category_of, model_files
from rangesim.dataset.random_primitives import PRIMITIVES
from rangesim.dataset.supports import Support, Table
from rangesim.dataset.view_poses import Shell, View
from rangesim.electronics.ambient import Strength
from rangesim.errors import FileFormatError
from rangesim.evaluation.comparison import TOLERANCE_M
from rangesim.files.text_files import read_toml
from rangesim.instrument.instrument import Instrument
from rangesim.presets import DEFAULT_SENSORS, instrument_from_dict, is_device_file
from rangesim.scene.catalogue_materials import check_material, surface
from rangesim.sensors import is_file_name
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, Fraction, Metres, check_fields, whole
from rangesim.settings.config import check_keys, from_dict, nearest, shown, to_dict
from rangesim.settings.draws import Draw, Of, check_draws, draw_table
from rangesim.settings.seeds import check_seed

COUNT = Bounds("a whole number of objects", 0, 1000, kind=int)
"""Bounds of the number of objects of a group. A thousand fill a large bin; physics takes minutes for as many."""
SIZE = Bounds("a size in metres", 1e-4, 100)
"""Bounds of the size of an object, metres."""
SCALE = Bounds("a positive scale", 1e-3, 1e3)
"""Bounds of the scale of an object, dimensionless."""
PRIMITIVE_SIZE_M = Draw.of({"uniform": [0.03, 0.08]})
"""Size of a primitive if none is stated, metres: what a hand holds and a small bin takes."""
MAX_CATEGORY = 200
"""Largest number of characters of a category: more than a line of text."""
MAX_SENSOR_NAME = 79
"""Largest number of characters of an instrument's name. The name of a file in a tar file has at most 100; the number of
the scene, the kind and the suffix take up to 21."""
CHECKED_DRAWS = 8
"""Number of random draws of each instrument that are tried when a specification is made, besides the ends of all
distributions, so that a wrong key or value is refused before the first scene."""


@dataclass(frozen=True)
class ObjectGroup:
    """Objects that are drawn in the same way.

    Parameters
    ----------
    model : name of a primitive (`rangesim.dataset.random_primitives.PRIMITIVES`), file of a mesh, or folder of such
        files, of which each is as likely. In a TOML file, paths are relative to its folder.
    count : number of objects in a scene.
    size_m : longest side of the box around the object, metres. None: primitives by `PRIMITIVE_SIZE_M`, meshes as in
        their file.
    scale : factor on the size.
    material : material of the catalogue, or of the specification's `materials`.
    category : category of the objects. None: the name of the primitive, or as `model_files.category_of` says.
    unit_m : metres per unit of the mesh files, 0.001 for millimetres.

    Raises
    ------
    ValueError, FileFormatError
        A value out of its bounds, an unknown model or an empty folder.
    """

    model: Annotated[Draw, Of(str)]
    count: Annotated[Draw, Of(int, COUNT)] = Draw.of(1)
    size_m: Annotated[Draw, Of(float, SIZE)] | None = None
    scale: Annotated[Draw, Of(float, SCALE)] = Draw.of(1.0)
    material: Annotated[Draw, Of(str)] = Draw.of("white_paper")
    category: str | None = None
    unit_m: Metres = 1.0

    def __post_init__(self) -> None:
        check_draws(self)
        check_fields(self)
        if self.category is not None and not 0 < len(self.category) <= MAX_CATEGORY:
            raise ValueError(
                f"expected category as a name of 1 to {MAX_CATEGORY} characters, got {shown(self.category)}."
            )
        object.__setattr__(self, "model", _with_files(self.model))

    def category_of(self, model: str) -> str:
        """Category of an object of this model, the name of a primitive or the path of a file."""
        if self.category is not None or model in PRIMITIVES:
            return self.category or model
        names = (leaf.values[0] for leaf in self.model.leaves())
        return category_of(Path(model), [Path(name) for name in names if name not in PRIMITIVES])


def _with_files(model: Draw) -> Draw:
    """The draw of models in which each folder is replaced by a choice of its files."""
    if model.kind == "choice":
        return Draw("choice", tuple(_with_files(entry) for entry in model.values))
    name = model.values[0]
    if name in PRIMITIVES:
        return model
    path = Path(name)
    if not name or not os.path.exists(name):  # False for impossible names too
        raise ValueError(
            f"expected a model out of {', '.join(PRIMITIVES)}, a mesh file or a folder of them, got "
            f"{shown(name)}{nearest(name, PRIMITIVES)}."
        )
    files = [Draw.of(str(file)) for file in model_files(path)]
    return files[0] if path.is_file() else Draw("choice", tuple(files))


@dataclass(frozen=True)
class RoomLight:
    """Ambient light of a scene: even light from everywhere, and the part of it that comes from the sun or a lamp.

    Parameters
    ----------
    illuminant : "sun", "tungsten" or "led", see `rangesim.Ambient`.
    illuminance_lux : on a horizontal surface in the open; 0: darkness.
    directional : fraction of the illuminance that comes from one direction.
    elevation_deg : of that direction above the horizon, degrees; its azimuth is uniform.
    """

    illuminant: Annotated[Draw, Of(str)] = Draw.of("led")
    illuminance_lux: Annotated[Draw, Of(float, Strength.__metadata__[0])] = Draw.of({"log_uniform": [50.0, 1000.0]})
    directional: Annotated[Draw, Of(float, Fraction.__metadata__[0])] = Draw.of(0.0)
    elevation_deg: Annotated[Draw, Of(float, Bounds("degrees above the horizon", 1, 90))] = Draw.of(
        {"uniform": [20.0, 80.0]}
    )

    def __post_init__(self) -> None:
        check_draws(self)
        for leaf in self.illuminant.leaves():
            if leaf.values[0] not in ("sun", "tungsten", "led"):
                raise ValueError(f"expected illuminant to be sun, tungsten or led, got {shown(leaf.values[0])}.")


@dataclass(frozen=True)
class DatasetSpec:
    """A data set of random scenes, each measured with the same kinds of instruments.

    The specification and the number of a scene decide everything that is drawn, see
    `rangesim.dataset.random_scene.random_scene`.

    Parameters
    ----------
    scenes : number of scenes.
    seed : 0 to 2^64 - 1.
    width, height : pixels of the camera of instruments that have none of their own.
    fov_deg : horizontal field of view of that camera, degrees.
    objects : groups of objects.
    materials : random parameters of materials, by name. Each table holds parameters of the BSDF or the medium as draws,
        and `base`, the material of the catalogue, unless the name is itself in the catalogue.
    support : Support, what the objects lie on.
    arrangement : "scattered": each object lies on the support for itself; "pile": they fall, and come to rest in a
        physics simulation (needs the extra `piles`).
    view : View, pose of the camera.
    light : RoomLight.
    instruments : tables as in an experiment's file, whose values may be distributions; `{choice = [...]}` is one of
        several values. A list is a choice too where an instrument holds a single value.
    tolerance_m : largest error of a right reading, metres.
    frames : whether the sensors' frames are kept, too; they take more space than all else together.
    spp, max_spp, max_depth, caustics, glint : as of `rangesim.experiment.Experiment`.

    Raises
    ------
    ValueError, FileFormatError
        A value out of its bounds, or a material, a model or an instrument that does not exist.

    Examples
    --------
    >>> spec = spec_from_dict({"objects": [{"model": ["box", "torus"], "count": {"uniform": [3, 6]}}]})
    >>> spec_from_dict(spec_to_dict(spec)) == spec
    True
    """

    objects: tuple[ObjectGroup, ...]
    scenes: Annotated[int, Bounds("a whole number of scenes", 1, 10**9)] = 100
    seed: int = 0
    width: Annotated[int, whole(1, "pixels")] = 320
    height: Annotated[int, whole(1, "pixels")] = 240
    fov_deg: Annotated[Draw, Of(float, Bounds("degrees between 0 and 180", 1, 170))] = Draw.of(50.0)
    materials: Mapping[str, Any] = dataclass_field(default_factory=dict)
    support: Support = Table()
    arrangement: Literal["scattered", "pile"] = "scattered"
    view: View = Shell()
    light: RoomLight = RoomLight()
    instruments: tuple[Mapping[str, Any], ...] = tuple({"sensor": name} for name in DEFAULT_SENSORS)
    tolerance_m: Metres = TOLERANCE_M
    frames: bool = False
    spp: Annotated[int, whole(1, "spp")] | None = None
    max_spp: Annotated[int, whole(1, "spp")] = 64
    max_depth: Annotated[int, whole(1, "depth")] = 5
    caustics: bool = True
    glint: bool = True

    def __post_init__(self) -> None:
        check_draws(self)
        check_fields(self)
        object.__setattr__(self, "seed", check_seed(self.seed))
        if not isinstance(self.materials, Mapping):
            raise ValueError(f"expected materials as tables by name, got {shown(self.materials)}.")
        limits.check("pixels", self.width * self.height, f"pixels, not {self.width} x {self.height}")
        limits.check("instruments", len(self.instruments), "instruments")
        if not self.objects or not self.instruments:
            raise ValueError("expected at least one group of objects and one instrument.")
        self._check_materials()
        for number, table in enumerate(self.instruments):
            _check_instrument(table, f"instrument[{number}]")

    def _check_materials(self) -> None:
        for name, table in self.materials.items():
            if not isinstance(table, Mapping):
                raise ValueError(f"expected material {shown(name)} as a table of parameters, got {shown(table)}.")
            self.material_entries(name, np.random.default_rng(0))
        draws = [(f"objects[{i}].material", group.material) for i, group in enumerate(self.objects)]
        draws += [
            (f"support.{f.name}", getattr(self.support, f.name))
            for f in fields(self.support)  # type: ignore[arg-type]
            if f.name.endswith("material")
        ]
        for place, draw in draws:
            for leaf in draw.leaves():
                if leaf.values[0] not in self.materials:
                    check_material(leaf.values[0], place)

    def material_entries(self, name: str, random: np.random.Generator) -> tuple[dict[str, Any], dict[str, Any]]:
        """Entries of a shape of this material, as of `surface`, and the parameters that were drawn."""
        table = dict(self.materials.get(name, {}))
        base = table.pop("base", name)
        values = {}
        for key, value in table.items():
            draw = Draw.of(value, f"materials.{name}.{key}")
            draw.check(f"materials.{name}.{key}", Of(float))
            values[key] = float(draw.value(random))
        return surface(base, values), values


def _check_instrument(table: Any, place: str) -> None:
    """Raise ValueError if an instrument cannot be made of some values of a table's distributions."""
    if not isinstance(table, Mapping):
        raise ValueError(f"expected {place} to be a table of settings, got {shown(table)}.")
    for seed in range(CHECKED_DRAWS):
        name = drawn_instrument(table, np.random.default_rng(seed), place).name
        if len(name) > MAX_SENSOR_NAME:
            raise ValueError(f"expected a name of {place} of at most {MAX_SENSOR_NAME} characters, got {shown(name)}.")


def drawn_instrument(table: Mapping[str, Any], random: np.random.Generator, place: str) -> Instrument:
    """An instrument of random settings.

    Raises
    ------
    ValueError
        An unknown key or a bad value. The message names the place.
    """
    hints = get_type_hints(Instrument)
    values = {}
    for key, value in table.items():
        holds_one = key == "sensor" or any(
            part in (int, float, str, bool) for part in (hints.get(key), *get_args(hints.get(key)))
        )
        values[key] = draw_table({"choice": value} if holds_one and isinstance(value, list) else value, random)
    return instrument_from_dict(values, place, Path())


def load_spec(path: str | Path) -> DatasetSpec:
    """The specification in a TOML file.

    Raises
    ------
    FileFormatError
        The file is missing, no valid TOML, or has an unknown key or a bad value. The message names the place.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist; expected the specification of a data set (.toml).")
    try:
        return spec_from_dict(read_toml(path), path.parent)
    except (ValueError, FileFormatError) as error:
        raise FileFormatError(f"{path}: {error}") from error


def spec_from_dict(data: Mapping[str, Any], files_in: Path = Path()) -> DatasetSpec:
    """The specification that plain data describe; each table under `instrument` is an instrument.

    files_in : folder that the relative paths of models count from.

    Raises
    ------
    ValueError, FileFormatError
        As of `DatasetSpec`, or an unknown key.
    """
    values = dict(data)
    check_keys(values, ["instrument" if f.name == "instruments" else f.name for f in fields(DatasetSpec)], "data set")
    if "instrument" in values:
        tables = values.pop("instrument")
        if not isinstance(tables, list):
            raise ValueError("expected instruments as tables with the header [[instrument]], with two brackets.")
        values["instruments"] = [
            {**table, "sensor": _sensor_with_path(table["sensor"], files_in)}
            if isinstance(table, Mapping) and "sensor" in table
            else table
            for table in tables
        ]
    groups = values.get("objects")
    if not isinstance(groups, list):
        raise ValueError("expected groups of objects as tables with the header [[objects]], with two brackets.")
    values["objects"] = [_with_paths(group, files_in) for group in groups]
    return from_dict(DatasetSpec, values)


def spec_to_dict(spec: DatasetSpec) -> dict[str, Any]:
    """The specification as plain data, from which `spec_from_dict` makes an equal one.

    A folder of models is replaced by the files that were in it.
    """
    data = to_dict(spec)
    data["instrument"] = data.pop("instruments")
    return dict(data)


def _sensor_with_path(sensor: Any, folder: Path) -> Any:
    """The sensor of a table in which files of sensors and devices, or a choice of them, have absolute paths."""
    if isinstance(sensor, list):
        return [_sensor_with_path(entry, folder) for entry in sensor]
    if isinstance(sensor, Mapping) and "choice" in sensor:
        return {"choice": _sensor_with_path(sensor["choice"], folder)}
    is_file = isinstance(sensor, str) and (is_device_file(sensor) or is_file_name(sensor))
    return str(folder.resolve() / sensor) if is_file else sensor


def _with_paths(group: Any, folder: Path) -> Any:
    """A table of objects whose models are names of primitives or absolute paths."""

    def resolved(model: Any) -> Any:
        if isinstance(model, list):
            return [resolved(entry) for entry in model]
        if isinstance(model, Mapping):
            return {key: resolved(value) for key, value in model.items()}
        if not isinstance(model, str) or not model or model in PRIMITIVES:
            return model
        path = os.path.abspath(folder / model)
        return path if os.path.exists(path) else model

    return {**group, "model": resolved(group["model"])} if isinstance(group, Mapping) and "model" in group else group
