# SPDX-License-Identifier: Apache-2.0
"""Scenes from Mitsuba XML, dictionaries and bare meshes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.environment.backend import images_can_be_read, select_variant
from rangesim.errors import FileFormatError, warn
from rangesim.files.bundled_scenes import CATALOGUE, scene_file
from rangesim.files.text_files import check_xml
from rangesim.files.utf8_names import Utf8Names, is_utf8, utf8_names
from rangesim.rig import Intrinsics, translation
from rangesim.scene import retroreflector
from rangesim.scene.camera import camera_of, warn_of_aperture, warn_of_clipping
from rangesim.scene.materials import has_texture, is_cutout, is_matte, material_class
from rangesim.scene.media import is_boundary, why_not_traced
from rangesim.scene.mesh import MESH_SUFFIXES, scene_around_mesh
from rangesim.scene.nodes import (
    OF_MITSUBA,
    check_camera,
    check_types,
    forget_reading,
    ids_of_shapes,
    replace_ignored_plugins,
    take_material_classes,
)
from rangesim.scene.normals import repeat_normals
from rangesim.scene.origin import (
    AS_FAR,
    camera_node,
    camera_place,
    coarsest_mesh,
    coarsest_transform,
    is_far,
    move_to_origin,
    warn_of_coarse_mesh,
    warn_of_coarse_transform,
    warn_of_loaded_camera,
)
from rangesim.scene.properties import (
    check_depth,
    check_dictionary,
    check_evaluable,
    check_properties,
    check_vertices,
)
from rangesim.scene.scene import Instance, Scene
from rangesim.scene.spectral_reflectance import (
    coloured_materials,
    take_sensor_reflectances,
    warn_of_colours,
    warn_of_lamps_behind_glass,
)
from rangesim.settings.bounds import Bounds, check_number

IGNORED_ELEMENTS = ("integrator", "sampler", "rfilter")
"""Elements of a scene file that do not matter, so that a parameter without a value there needs none."""
Source = str | Path | Mapping[str, Any]


def load_scene(
    source: Source,
    *,
    material: str | None = None,
    unit_m: float | None = None,
    sensor: int | None = None,
    variant: str | None = None,
) -> Scene:
    """A scene to measure.

    Parameters
    ----------
    source : path of a Mitsuba 3 XML file or of a mesh (PLY, OBJ, GLB, STL), the name of a scene that comes with the
        package (`rangesim.files.bundled_scenes.scene_names`; a file of that name goes first), or a Mitsuba scene
        dictionary. XML and dictionary must hold a perspective sensor, which becomes the camera; integrator, film filter
        and sampler are ignored. Projectors in it count as ambient light. A mesh is put on a matte table before a
        camera. A shape or BSDF may set `<string name="material_class" value="..."/>` to override its derived class.
        `<include filename="materials/silver.xml"/>` finds the material catalogue from anywhere (docs/materials.md);
        files beside the scene come first. BSDFs of type `retroreflector` are known (`rangesim.scene.retroreflector`).
    material : material class of a bare mesh, one of matte (default), glossy, mirror, transparent.
    unit_m : metres per unit of length of a bare mesh, 0.001 for one in millimetres; default 1.
    sensor : which of the scene's sensors becomes the camera; default the first, with a warning if there are several.
    variant : Mitsuba variant; default CUDA where there is a GPU, else LLVM.

    Raises
    ------
    FileFormatError
        Missing, broken or empty file, a scene without a perspective sensor, or with shapes that cannot be traced
        (instances; participating media other than homogeneous ones: those that scatter inside closed shapes with a
        `null` BSDF, those that absorb alone also inside and around bodies that refract).
    ValueError
        Unknown material class, or one for a scene that names its own; no such sensor.
    """
    if not isinstance(source, (str, Path, Mapping)):
        raise ValueError(f"expected a path or a scene dictionary, got {type(source).__name__} {source!r}.")
    label = "the scene dictionary" if isinstance(source, Mapping) else str(source)
    if not _is_mesh(source):
        if material is not None:
            raise ValueError(f"a material can be chosen for a bare mesh alone, but {label} names its own materials.")
        if unit_m is not None:
            raise ValueError(
                f"a unit can be chosen for a bare mesh alone; scale the shapes of {label} to metres instead."
            )
    if unit_m is not None:
        check_number("unit_m", unit_m, Bounds("positive and finite metres per unit", 1e-9, 1e6))
    select_variant(variant)
    retroreflector.register()
    chosen, sensor = sensor, sensor or 0
    instantiate = partial(_instantiate, source, material or "matte", unit_m or 1.0, sensor, label)
    loaded, ids, classes, origin_m = instantiate(advises=True)
    _check(loaded, ids, sensor, label)
    if chosen is None and (n := len(loaded.sensors())) > 1:
        warn(f"{label} has {n} sensors, and the first becomes the camera; Python's load_scene(sensor=) takes another.")
    warn_of_lamps_behind_glass(loaded, label)
    repeat_normals(loaded)
    camera, T_camera = camera_of(loaded.sensors()[sensor], label)
    working_distance_m = _median_depth(loaded, camera, T_camera)
    warn_of_aperture(loaded.sensors()[sensor], camera, working_distance_m, label)
    warn_of_clipping(loaded.sensors()[sensor], _depths(loaded, camera, T_camera), label)
    return Scene(
        name="scene" if isinstance(source, Mapping) else Path(source).stem,
        mitsuba=loaded,
        instances=tuple(Instance(s.id(), classes.get(s.id()) or _class_of(s)) for s in loaded.shapes()),
        camera=camera,
        T_world_camera=translation(*origin_m) @ T_camera,
        working_distance_m=working_distance_m,
        has_cutouts=any(is_cutout(s.bsdf()) for s in loaded.shapes()),
        has_matte_textures=any(map(has_texture, {s.bsdf() for s in loaded.shapes() if is_matte(s)})),
        source=None if isinstance(source, Mapping) else scene_file(source),
        reload=lambda: repeat_normals(instantiate()[0]),
        origin_m=origin_m,
    )


@images_can_be_read()
def _instantiate(
    source: Source, material: str, unit_m: float, sensor: int, label: str, advises: bool = False
) -> tuple[Any, set[str], dict[str, str], np.ndarray]:
    """The Mitsuba scene, the ids of its shapes, the material classes that the file states, and the scene's origin."""
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = config.merge_equivalent = False  # merged shapes would lose their instance ids

    def parsed(names: Utf8Names, advises: bool) -> tuple[Any, set[str], dict[str, str]]:
        state = _parse(config, source, material, unit_m, names, advises)
        mi.file_resolver().prepend(str(OF_MITSUBA))  # type: ignore[attr-defined]  # again: a scene adds paths
        check_types(state, label)
        check_depth(state, label)
        mi.parser.transform_all(config, state)
        ids, classes = ids_of_shapes(state, label), take_material_classes(state, label)
        take_sensor_reflectances(state, label)
        check_properties(state, label)
        check_evaluable(state, label)
        replace_ignored_plugins(state)
        if (camera := camera_node(state, sensor)) is not None:
            check_camera(state, camera, label)
        return state, ids, classes

    def made_of(state: Any) -> Any:
        forget_reading(state)
        loaded = mi.parser.instantiate(config, state)
        return loaded[0] if isinstance(loaded, list) else loaded

    with utf8_names() as names:
        try:
            with _own_file_resolver(names):
                state, ids, classes = parsed(names, advises)
                place, transform = camera_place(state, sensor), coarsest_transform(state) if advises else None
                coloured = coloured_materials(state) if advises else []
                loaded, origin_m = made_of(state), np.zeros(3)
                if is_far(place) and isinstance(loaded, mi.Scene) and _looks_elsewhere(loaded, sensor, place, label):
                    state, origin_m = parsed(names, False)[0], place
                    move_to_origin(state, origin_m, label)
                    loaded = made_of(state)
                mesh = coarsest_mesh(state, loaded) if advises else None
        except MemoryError:
            raise FileFormatError(f"{label} does not fit into memory; use smaller meshes and images.") from None
        except (RuntimeError, TypeError, OverflowError, UnicodeDecodeError) as error:
            reason = re.sub(r"\[\w+\.cpp:\d+\] ", "", " ".join(str(error).split()))
            # a traceback is of a BSDF in Python
            reason = re.sub(r"Traceback \(most recent call last\): .* (?=\w+Error: )", "", reason)
            raise FileFormatError(f"{label} is no scene Mitsuba can load: {reason}") from error
    warn_of_colours(coloured, label)
    warn_of_coarse_transform(transform, label)
    warn_of_coarse_mesh(mesh, label)
    if advises and isinstance(loaded, mi.Scene):
        warn_of_loaded_camera(loaded.sensors(), sensor, place, label)
    return loaded, ids, classes, origin_m


def _parse(config: Any, source: Source, material: str, unit_m: float, names: Utf8Names, advises: bool) -> Any:
    if isinstance(source, Mapping):
        check_dictionary(source, "the scene dictionary")
        return mi.parser.parse_dict(config, dict(source))
    path = scene_file(source)
    if _is_mesh(path):
        return mi.parser.parse_dict(config, scene_around_mesh(path, material, unit_m, names.folder, advises))
    if path.suffix.lower() != ".xml":
        raise FileFormatError(f"expected a scene (.xml) or a mesh ({', '.join(MESH_SUFFIXES)}), got {path}.")
    resolver = mi.file_resolver()
    resolver.prepend(str(names.of(path.resolve().parent)))  # type: ignore[attr-defined]
    resolver.append(str(names.of(CATALOGUE)))  # type: ignore[attr-defined]
    try:
        fillers = check_xml(path, _SearchPaths(resolver), IGNORED_ELEMENTS)
    except FileFormatError as error:
        raise FileFormatError(f"{path} is no scene Mitsuba can load: {error}") from error
    try:
        return mi.parser.parse_file(config, str(names.of(path)), **fillers)
    except RuntimeError as error:
        if (missing := re.search(r"undefined parameter: \$(\w+)", str(error))) is None:
            raise
        raise FileFormatError(
            f"{path}: the parameter ${missing[1]} has no value; put "
            f'<default name="{missing[1]}" value="..."/> before it in the scene.'
        ) from error


class _SearchPaths:
    """Mitsuba's search paths while a file is checked, with those that the file itself adds."""

    def __init__(self, paths: Any) -> None:
        self.paths = paths

    def resolve(self, name: str) -> Path:
        """Path of the file of a name, which may be missing."""
        return Path(str(self.paths.resolve(name)))

    def within(self, folder: str, beside: Path) -> _SearchPaths:
        """Paths with a folder before those so far: one beside the file, else one in these."""
        near, paths = beside.parent / folder, mi.FileResolver(self.paths)
        paths.prepend(str(near if os.path.exists(near) else self.resolve(folder)))
        return _SearchPaths(paths)


@contextmanager
def _own_file_resolver(names: Utf8Names) -> Iterator[None]:
    """Search paths of this scene, forgotten afterwards, so that no scene finds another's files."""
    before = mi.file_resolver()
    mi.set_file_resolver(mi.FileResolver(before))
    resolver = mi.file_resolver()
    here = os.path.realpath(os.curdir)
    if not is_utf8(here):  # Mitsuba has it among its paths, and can find files there, but not say where they are
        resolver.prepend(str(names.of(Path(here))))  # type: ignore[attr-defined]
    resolver.prepend(str(OF_MITSUBA))  # type: ignore[attr-defined]
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def _check(scene: Any, ids: set[str], sensor: int, label: str) -> None:
    if not isinstance(scene, mi.Scene):
        raise FileFormatError(f"expected {label} to hold a scene, got a {type(scene).__name__}.")
    if not scene.shapes():
        raise FileFormatError(f"expected {label} to hold at least one shape, got an empty scene.")
    if not scene.sensors():
        raise FileFormatError(
            f'expected {label} to hold a perspective sensor, got none; add <sensor type="perspective">.'
        )
    if not 0 <= sensor < len(scene.sensors()):
        raise ValueError(f"expected a sensor from 0 to {len(scene.sensors()) - 1} of {label}, got {sensor}.")
    check_vertices(scene, label)
    for shape in scene.shapes():
        if shape.id() not in ids:
            raise FileFormatError(
                f"expected shapes of {label} as dictionaries, got a loaded object; give its dictionary."
            )
        problem = why_not_traced(shape)
        if problem is not None:
            raise FileFormatError(f"{label}: shape {shape.id()!r} {problem}.")


def _class_of(shape: Any) -> str:
    return "translucent" if is_boundary(shape) else material_class(shape.bsdf())


def _is_mesh(source: Source) -> bool:
    return not isinstance(source, Mapping) and Path(source).suffix.lower() in MESH_SUFFIXES


def _looks_elsewhere(scene: Any, sensor: int, place: np.ndarray, label: str) -> bool:
    """Whether a camera is farther from the origin than from what it sees: that is far from the origin then, too."""
    camera, T_camera = camera_of(scene.sensors()[sensor], label)
    return bool(np.linalg.norm(place) > AS_FAR * _median_depth(scene, camera, T_camera))


def _median_depth(scene: Any, camera: Intrinsics, T_camera: np.ndarray) -> float:
    """Median z over a coarse grid of camera rays; 1 where the camera sees nothing. `T_camera` is to the renderer."""
    z = _depths(scene, camera, T_camera)
    return float(np.nanmedian(z)) if np.isfinite(z).any() else 1.0


def _depths(scene: Any, camera: Intrinsics, T_camera: np.ndarray, columns: int = 64) -> np.ndarray:
    """(n,) float32, z in metres over a coarse grid of camera rays, NaN where they meet nothing."""
    grid = camera.resized(columns, max(1, round(columns * camera.height / camera.width)))
    directions = grid.directions(grid.pixel_centres()).reshape(-1, 3) @ T_camera[:3, :3].T
    ray = mi.Ray3f(o=mi.Point3f(*map(float, T_camera[:3, 3])), d=mi.Vector3f(directions.T.astype(np.float32)))
    si = scene.ray_intersect_preliminary(ray, coherent=True)
    return np.array(dr.select(si.is_valid(), si.t, dr.nan))  # directions have z = 1, so t is depth
