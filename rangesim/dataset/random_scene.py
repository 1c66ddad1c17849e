# SPDX-License-Identifier: Apache-2.0
"""Random scenes: one for each number, decided by the specification and the number alone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rangesim.dataset.dataset_spec import PRIMITIVE_SIZE_M, SIZE, DatasetSpec, drawn_instrument
from rangesim.dataset.model_files import read_model
from rangesim.dataset.piles import settled
from rangesim.dataset.random_primitives import PRIMITIVES, primitive
from rangesim.dataset.side_by_side import scattered
from rangesim.dataset.solid_model import SolidModel
from rangesim.dataset.viewpoint_choice import chosen_view
from rangesim.electronics.ambient import Ambient
from rangesim.experiment.experiment import Experiment
from rangesim.settings.config import shown
from rangesim.settings.draws import Of, drawn
from rangesim.triangle_mesh import TriangleMesh

STREAMS = ("objects", "support", "arrangement", "materials", "view", "light", "instruments", "experiment")
"""What is drawn, each from random numbers of its own: another light leaves the objects where they are. New streams come
last, because their places in this list are part of the seeds."""
OF_EXPERIMENT = ("width", "height", "tolerance_m", "spp", "max_spp", "max_depth", "caustics", "glint")
"""Settings that the experiment of each scene takes over from the specification."""
MAX_OF_SUPPORT = 3.0
"""Largest size of an object from a file over the diagonal of its support. A longer one cannot lie there, and a part of
a tenth of the support is four times as long as it if inches are read as metres."""
MIN_OF_SUPPORT = 1e-4
"""Smallest size of an object from a file over the diagonal of its support: where a camera sees the whole support, a
smaller one is no tenth of a pixel wide."""
MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
"""(4, 4) transform from coordinates of a camera here (x right, y down) to those of Mitsuba (x left, y up)."""


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """An object of a random scene.

    Parameters
    ----------
    name : id of the shape in the scene.
    model : name of the primitive, or of the file without its suffix. category, material : names.
    T_world_part : (4, 4) float64, rigid, metres: world = T_world_part (scale * part).
    scale : factor on the mesh, dimensionless.
    mesh : TriangleMesh, metres, part coordinates (those of the file, at the unit of the specification).
    parameters : those of the material that were drawn.
    source_sha256 : digest of the file of the model; "" for a primitive.
    """

    name: str
    model: str
    category: str
    material: str
    T_world_part: np.ndarray
    scale: float
    mesh: TriangleMesh
    parameters: dict[str, float]
    source_sha256: str = ""

    @property
    def world_mesh(self) -> TriangleMesh:
        """The mesh where it lies, metres, world; single precision, as the renderer has it."""
        placed = TriangleMesh(self.scale * self.mesh.vertices, self.mesh.faces).moved(self.T_world_part)
        return TriangleMesh(placed.vertices.astype(np.float32), placed.faces)


@dataclass(frozen=True, eq=False)
class RandomScene:
    """A random scene with the instruments that measure it.

    Parameters
    ----------
    index : its number.
    scene : dictionary for `rangesim.load_scene`.
    experiment : Experiment, whose `scene` is a name such as "scene 12".
    objects : all objects, without the support.
    T_world_camera : (4, 4) float64, metres.
    left_out : number of objects that were drawn and are not in the scene, by the reason.
    redrawn_views : number of camera poses that were drawn again, by the reason.
    values : what was drawn of support, view, light and arrangement.
    """

    index: int
    scene: dict[str, Any]
    experiment: Experiment
    objects: tuple[PlacedObject, ...]
    T_world_camera: np.ndarray
    left_out: dict[str, int]
    redrawn_views: dict[str, int]
    values: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Plain data of all that was drawn, without the meshes and the experiment."""
        return {
            "index": self.index,
            "objects": [
                {
                    "name": one.name,
                    "model": one.model,
                    "category": one.category,
                    "material": one.material,
                    "parameters": one.parameters,
                    "scale": one.scale,
                    "size_m": np.ptp(one.mesh.vertices, axis=0).tolist(),
                    "T_world_part": one.T_world_part.tolist(),
                    "source_sha256": one.source_sha256,
                }
                for one in self.objects
            ],
            "T_world_camera": self.T_world_camera.tolist(),
            "left_out": self.left_out,
            "redrawn_views": self.redrawn_views,
            **self.values,
        }


class _Drawn(NamedTuple):
    """An object before it has a place."""

    solid: SolidModel
    scale: float
    category: str
    material: str


def random_scene(spec: DatasetSpec, index: int) -> RandomScene:
    """The random scene of a number.

    Specification and number decide everything; docs/datasets.md says how far this holds across machines.

    Raises
    ------
    ValueError
        The number is not one of the specification's scenes, the unit of a mesh file is wrong by the look of its size,
        or no camera pose sees an object.
    FileFormatError
        The mesh of a model is broken or open.

    Examples
    --------
    >>> from rangesim.dataset import spec_from_dict
    >>> spec = spec_from_dict({"objects": [{"model": "box", "count": 3}], "instrument": [{"sensor": "ideal-tof"}]})
    >>> [one.name for one in random_scene(spec, 0).objects]
    ['box_0', 'box_1', 'box_2']
    """
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < spec.scenes:
        raise ValueError(f"expected the number of a scene, 0 to {spec.scenes - 1}, got {shown(index)}.")
    streams = {name: _generator(spec.seed, index, place) for place, name in enumerate(STREAMS)}
    support = spec.support.draw(streams["support"])
    things = _draw_objects(spec, streams["objects"], float(np.linalg.norm(np.ptp(support.area_m, axis=0))))
    arrange = settled if spec.arrangement == "pile" else scattered
    arrangement = arrange([(one.solid, one.scale) for one in things], support, streams["arrangement"])
    objects: list[tuple[PlacedObject, bool, dict[str, Any]]] = []
    for thing, pose in zip(things, arrangement.poses, strict=True):
        entries, parameters = spec.material_entries(thing.material, streams["materials"])
        if pose is not None:
            name = f"{re.sub(r'[^A-Za-z0-9_-]', '_', thing.solid.name)}_{len(objects)}"  # Mitsuba refuses dots
            placed = PlacedObject(
                name, thing.solid.name, thing.category, thing.material, pose, thing.scale, thing.solid.mesh,
                parameters, thing.solid.source_sha256,
            )  # fmt: skip
            objects.append((placed, thing.solid.is_smooth, entries))
    placed_objects = tuple(one for one, _, _ in objects)
    scene = {one.name: _shape(one.world_mesh, is_smooth, entries) for one, is_smooth, entries in objects}
    scene |= {
        name: _shape(mesh, False, spec.material_entries(support.materials[name], streams["materials"])[0])
        for name, mesh in support.meshes.items()
    }
    view = chosen_view(spec, placed_objects, support, streams["view"])
    light, ambient, light_values = _light(spec, streams["light"])
    instruments = tuple(
        drawn_instrument(table, streams["instruments"], f"instrument[{number}]")
        for number, table in enumerate(spec.instruments)
    )
    seed = int(streams["experiment"].integers(1 << 64, dtype=np.uint64))
    settings = {key: getattr(spec, key) for key in OF_EXPERIMENT}
    experiment = Experiment(f"scene {index}", seed=seed, ambient=ambient, instruments=instruments, **settings)
    return RandomScene(
        index,
        {"type": "scene", "sensor": _camera(spec, view.T_world_camera, view.fov_deg), **light, **scene},
        experiment,
        placed_objects,
        view.T_world_camera,
        arrangement.left_out,
        view.redrawn,
        {
            "support": {"type": spec.support.type_name, **support.values},
            "view": {"type": spec.view.type_name, "fov_deg": view.fov_deg, **view.values},
            "light": light_values,
            "arrangement": arrangement.values,
        },
    )


def _generator(seed: int, index: int, stream: int) -> np.random.Generator:
    """The random numbers of one stream of one scene."""
    words = [seed & 0xFFFFFFFF, seed >> 32, index & 0xFFFFFFFF, index >> 32, stream]
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))


def _draw_objects(spec: DatasetSpec, random: np.random.Generator, support_m: float) -> list[_Drawn]:
    """Objects that are drawn for a support of this diagonal, metres."""
    things = []
    for group in spec.objects:
        for _ in range(drawn_count(group, random)):
            values = drawn(group, random)
            size_m, scale = values["size_m"], values["scale"]
            if values["model"] in PRIMITIVES:
                size_m = PRIMITIVE_SIZE_M.value(random, Of(float, SIZE)) if size_m is None else size_m
                solid = primitive(values["model"], size_m, random)
            else:
                solid = read_model(Path(values["model"]), group.unit_m)
                if size_m is None:
                    _check_unit(solid, scale, support_m)
                else:
                    scale *= size_m / solid.size_m
            things.append(_Drawn(solid, scale, group.category_of(values["model"]), values["material"]))
    return things


def _check_unit(solid: SolidModel, scale: float, support_m: float) -> None:
    """Raise ValueError if a mesh, as large as its file says, is far too large or too small for the support."""
    size_m = scale * solid.size_m
    if not MIN_OF_SUPPORT <= size_m / support_m <= MAX_OF_SUPPORT:
        raise ValueError(
            f"expected objects for a support of {support_m:.2g} m, got {solid.name} of {size_m:.3g} m: state unit_m, "
            "the metres per unit of its file (0.001 for millimetres), or size_m."
        )


def drawn_count(group: Any, random: np.random.Generator) -> int:
    """A random number of objects of a group."""
    return int(group.count.value(random, Of(int)))


def _shape(mesh: TriangleMesh, is_smooth: bool, entries: dict[str, Any]) -> dict[str, Any]:
    return {"type": "ply", "mesh": mesh, "face_normals": not is_smooth, **entries}


def _camera(spec: DatasetSpec, T_world_camera: np.ndarray, fov_deg: float) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": fov_deg,
        "to_world": T_world_camera @ MITSUBA_FROM_OPENCV,
        "film": {"type": "hdrfilm", "width": spec.width, "height": spec.height},
    }


def _light(spec: DatasetSpec, random: np.random.Generator) -> tuple[dict[str, Any], Ambient | None, dict[str, Any]]:
    """Emitters of the scene that give an irradiance of 1 on a horizontal surface, and what they stand for."""
    values = drawn(spec.light, random)
    azimuth = float(random.uniform(0, 2 * np.pi))
    if values["illuminance_lux"] == 0:
        return {}, None, values
    fraction, elevation = values["directional"], np.radians(values["elevation_deg"])
    emitters: dict[str, Any] = {"sky": {"type": "constant", "radiance": (1 - fraction) / np.pi}}
    if fraction > 0:
        towards = [-np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)]
        emitters["lamp"] = {
            "type": "directional",
            "direction": [float(x) for x in towards],
            "irradiance": float(fraction / np.sin(elevation)),
        }
    ambient = Ambient(values["illuminant"], illuminance_lux=values["illuminance_lux"])
    return emitters, ambient, {**values, "azimuth_deg": float(np.degrees(azimuth))}
