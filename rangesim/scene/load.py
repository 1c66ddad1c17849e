# SPDX-License-Identifier: Apache-2.0
"""Scenes from Mitsuba XML, dictionaries and bare meshes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.config import nearest
from rangesim.errors import FileFormatError
from rangesim.light_transport.backend import select_variant
from rangesim.rig import Intrinsics
from rangesim.scene.materials import MATERIAL_CLASSES, material_class
from rangesim.scene.mesh import MESH_SUFFIXES, scene_around_mesh
from rangesim.scene.scene import Instance, Scene

# Mitsuba's camera looks along +z with x to the left and y up; ours has x to the right and y down.
MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
_CLASS_KEY = "material_class"


def load_scene(
    source: str | Path | Mapping[str, Any], *, material: str | None = None, variant: str | None = None
) -> Scene:
    """A scene to measure.

    Parameters
    ----------
    source : path of a Mitsuba 3 XML file or of a mesh (PLY, OBJ, GLB, STL), or a Mitsuba scene dictionary. XML and
        dictionary must hold a perspective sensor, which becomes the camera; integrator, film filter and sampler are
        ignored. Projectors in it count as ambient light. A mesh is put on a matte table before a camera.
        A shape or BSDF may set `<string name="material_class" value="..."/>` to override its derived class.
    material : material class of a bare mesh, one of matte (default), glossy, mirror, transparent.
    variant : Mitsuba variant; default CUDA where there is a GPU, else LLVM.

    Raises
    ------
    FileFormatError
        Missing, broken or empty file, or a scene without a perspective sensor.
    ValueError
        Unknown material class, or one for a scene that names its own.
    """
    if material is not None and not _is_mesh(source):
        raise ValueError(
            f"a material can be chosen for a bare mesh alone, but {_label(source)} names its own materials."
        )
    select_variant(variant)
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = config.merge_equivalent = False  # merged shapes would lose their instance ids
    name = "scene" if isinstance(source, Mapping) else Path(source).stem
    try:
        with tempfile.TemporaryDirectory() as folder:
            state = _parse(config, source, material, Path(folder))
            mi.parser.transform_all(config, state)
            names = _name_shapes(state)
            classes = _take_classes(state)
            loaded = mi.parser.instantiate(config, state)
    except RuntimeError as error:
        raise FileFormatError(f"{_label(source)} is no scene Mitsuba can load: {_one_line(error)}") from error
    return _describe(name, loaded[0] if isinstance(loaded, list) else loaded, names, classes, _label(source))


def _parse(config: Any, source: str | Path | Mapping[str, Any], material: str | None, folder: Path) -> Any:
    if isinstance(source, Mapping):
        return mi.parser.parse_dict(config, dict(source))
    path = Path(source)
    if not path.is_file():
        raise FileFormatError(f"expected a scene or mesh file, but {path} does not exist.")
    if _is_mesh(path):
        return mi.parser.parse_dict(config, scene_around_mesh(path, material or "matte", folder))
    if path.suffix.lower() != ".xml":
        raise FileFormatError(f"expected a scene (.xml) or a mesh ({', '.join(MESH_SUFFIXES)}), got {path}.")
    mi.file_resolver().prepend(str(path.resolve().parent))  # type: ignore[attr-defined]
    return mi.parser.parse_file(config, str(path))


def _name_shapes(state: Any) -> list[str]:
    """Give every anonymous shape a unique id; ids of all shapes in file order."""
    taken = {node.props.id() for node in state.nodes}
    names = []
    for index, node in enumerate(state.nodes):
        if node.type != mi.ObjectType.Shape:
            continue
        name = node.props.id()
        if not name or name.startswith("_arg_"):
            name = f"{node.props.plugin_name()}_{index}"
            while name in taken:
                name += "_"
            node.props.set_id(name)
            taken.add(name)
        names.append(name)
    return names


def _take_classes(state: Any) -> dict[str, str]:
    """Material class per shape id; removes `material_class` entries, which Mitsuba does not know."""
    explicit: dict[int, str] = {}
    for index, node in enumerate(state.nodes):
        if _CLASS_KEY in node.props:
            value = node.props[_CLASS_KEY]
            if value not in MATERIAL_CLASSES:
                raise FileFormatError(
                    f"expected material_class to be one of {', '.join(MATERIAL_CLASSES)}, "
                    f"got {value!r}{nearest(str(value), MATERIAL_CLASSES)}."
                )
            explicit[index] = value
            del node.props[_CLASS_KEY]
    return {
        node.props.id(): explicit.get(index) or _class_of(state, _first_bsdf(state, index), explicit) or "matte"
        for index, node in enumerate(state.nodes)
        if node.type == mi.ObjectType.Shape
    }


def _children(state: Any, index: int) -> list[int]:
    references = [v for _, v in state.nodes[index].props.items() if isinstance(v, mi.Properties.ResolvedReference)]
    return [reference.index() for reference in references]


def _first_bsdf(state: Any, index: int) -> int | None:
    return next((c for c in _children(state, index) if state.nodes[c].type == mi.ObjectType.BSDF), None)


def _class_of(state: Any, index: int | None, explicit: dict[int, str]) -> str | None:
    if index is None:
        return None
    if index in explicit:
        return explicit[index]
    props = state.nodes[index].props
    nested = _class_of(state, _first_bsdf(state, index), explicit)
    scalars = {key: value for key, value in props.items() if isinstance(value, (int, float))}
    return material_class(props.plugin_name(), scalars, nested)


def _describe(name: str, scene: Any, names: list[str], classes: dict[str, str], label: str) -> Scene:
    if not isinstance(scene, mi.Scene):
        raise FileFormatError(f"expected {label} to hold a scene, got a {type(scene).__name__}.")
    if not scene.shapes():
        raise FileFormatError(f"expected {label} to hold at least one shape, got an empty scene.")
    if not scene.sensors():
        raise FileFormatError(
            f'expected {label} to hold a perspective sensor, got none; add <sensor type="perspective">.'
        )
    unknown = [shape.id() for shape in scene.shapes() if shape.id() not in names]
    if unknown:
        raise FileFormatError(
            f"{label}: shape {unknown[0]!r} is of a kind this package cannot name (instanced or merged)."
        )
    camera, T_world_camera = _camera(scene.sensors()[0], label)
    instances = tuple(Instance(shape.id(), classes[shape.id()]) for shape in scene.shapes())
    return Scene(name, scene, instances, camera, T_world_camera, _median_depth(scene, camera, T_world_camera))


def _camera(sensor: Any, label: str) -> tuple[Intrinsics, np.ndarray]:
    """Intrinsics and pose of a Mitsuba perspective (or thin lens) sensor."""
    params = mi.traverse(sensor)
    if "x_fov" not in params:
        raise FileFormatError(f"expected the sensor of {label} to be perspective, got {sensor.class_name()}.")
    width, height = (int(n) for n in sensor.film().size())
    f = float(0.5 * width / np.tan(np.radians(float(np.array(params["x_fov"]).item())) / 2))
    offset = [float(np.array(params[f"principal_point_offset_{a}"]).item()) for a in "xy"]
    camera = Intrinsics(width, height, f, f, width * (0.5 + offset[0]), height * (0.5 + offset[1]))
    matrix = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4) @ MITSUBA_FROM_OPENCV
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)  # a scaled to_world scales no camera
    return camera, matrix


def _median_depth(scene: Any, camera: Intrinsics, T_world_camera: np.ndarray, n: int = 64) -> float:
    """Median z over an n x n grid of camera rays; 1 where the camera sees nothing."""
    grid = camera.resized(n, n)
    directions = grid.directions(grid.pixel_centres()).reshape(-1, 3) @ T_world_camera[:3, :3].T
    ray = mi.Ray3f(o=mi.Point3f(*map(float, T_world_camera[:3, 3])), d=mi.Vector3f(directions.T.astype(np.float32)))
    si = scene.ray_intersect_preliminary(ray, coherent=True)
    z = np.array(dr.select(si.is_valid(), si.t, dr.nan))  # directions have z = 1, so t is depth
    return float(np.nanmedian(z)) if np.isfinite(z).any() else 1.0


def _is_mesh(source: str | Path | Mapping[str, Any]) -> bool:
    return not isinstance(source, Mapping) and Path(source).suffix.lower() in MESH_SUFFIXES


def _label(source: str | Path | Mapping[str, Any]) -> str:
    return "the scene dictionary" if isinstance(source, Mapping) else str(source)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:400]
