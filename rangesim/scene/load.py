# SPDX-License-Identifier: Apache-2.0
"""Loading of scenes from Mitsuba XML, from scene dictionaries and from bare meshes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

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
from rangesim.scene.mesh import MESH_SUFFIXES, scene_around_mesh, with_plain_data
from rangesim.scene.nodes import (
    OF_MITSUBA,
    check_camera,
    check_types,
    forget_reading,
    ids_of_shapes,
    replace_ignored_plugins,
    take_material_classes,
    take_objects,
)
from rangesim.scene.normals import repeat_normals
from rangesim.scene.objects import objects_of
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
)
from rangesim.settings.bounds import Bounds, check_number

IGNORED_ELEMENTS = ("integrator", "sampler", "rfilter")
"""Elements of a scene file that are ignored. A parameter that stands in one of them therefore needs no value."""
Source = str | Path | Mapping[str, Any]
"""Anything that `load_scene` accepts: a path, the name of a bundled scene, or a scene dictionary."""


def load_scene(
    source: Source,
    *,
    material: str | None = None,
    unit_m: float | None = None,
    sensor: int | None = None,
    variant: str | None = None,
) -> Scene:
    """Load a scene to measure.

    Parameters
    ----------
    source : one of

        - the path of a Mitsuba 3 XML file;
        - the path of a mesh (PLY, OBJ, GLB, STL, OFF), which is put on a matte table in front of a camera;
        - the name of a scene that comes with the package (`rangesim.files.bundled_scenes.scene_names`), unless a file
          of that name exists;
        - a Mitsuba scene dictionary.

        An XML file or a dictionary must hold a perspective sensor, which becomes the camera. Its integrator, film
        filter and sampler are ignored. A `projector` emitter in it is ambient light. The material class of a shape is
        derived from its BSDF, unless shape or BSDF state `<string name="material_class" value="..."/>`. Which shapes
        are objects follows from the geometry (`rangesim.scene.objects`), unless a shape states
        `<boolean name="is_object" value="..."/>`. Shapes with the same `<string name="part_of" value="..."/>` are one
        thing.
        `<include filename="materials/silver.xml"/>` finds the material catalogue from everywhere (docs/materials.md),
        but a file beside the scene comes first. BSDFs may be of type `retroreflector`
        (`rangesim.scene.retroreflector`). A shape of a dictionary may be ``{"type": "ply", "mesh": mesh, ...}`` with a
        `rangesim.triangle_mesh.TriangleMesh` instead of a file, and `to_world` may be an array (4, 4).
    material : material class of a bare mesh: matte (default), glossy, mirror or transparent.
    unit_m : metres per unit of length of a bare mesh, for example 0.001 for millimetres; default 1.
    sensor : index of the sensor of the scene that becomes the camera. By default it is the first, with a warning if the
        scene has several.
    variant : Mitsuba variant; by default CUDA if there is a GPU, else LLVM.

    Raises
    ------
    FileFormatError
        The file is missing, broken or empty; the scene has no perspective sensor; or it has shapes that cannot be
        traced. These are instances, and participating media that are not homogeneous. A medium that scatters must fill
        a closed shape with a `null` BSDF; one that only absorbs may also fill a body that refracts, or surround one.
    ValueError
        The material class is unknown, or given for a scene that has materials of its own; or there is no such sensor.

    Examples
    --------
    >>> load_scene("tabletop")  # doctest: +SKIP
    Scene('tabletop', 12 shapes, camera 640 x 480)
    """
    if not isinstance(source, (str, Path, Mapping)):
        raise ValueError(f"expected a path or a scene dictionary, got {type(source).__name__} {source!r}.")
    label = "the scene dictionary" if isinstance(source, Mapping) else str(source)
    if not _is_mesh(source):
        if material is not None:
            raise ValueError(f"only a bare mesh can be given a material, but {label} names its own materials.")
        if unit_m is not None:
            raise ValueError(f"only a bare mesh can be given a unit; scale the shapes of {label} to metres instead.")
    if unit_m is not None:
        check_number("unit_m", unit_m, Bounds("positive and finite metres per unit", 1e-9, 1e6))
    select_variant(variant)
    retroreflector.register()
    chosen, sensor = sensor, sensor or 0
    instantiate = partial(_instantiate, source, material or "matte", unit_m or 1.0, sensor, label)
    loaded, stated, origin_m = instantiate(advises=True)
    _check(loaded, stated.ids, sensor, label)
    if chosen is None and (n := len(loaded.sensors())) > 1:
        warn(f"{label} has {n} sensors, and the first becomes the camera; load_scene(sensor=N) takes another.")
    repeat_normals(loaded)
    camera, T_camera = camera_of(loaded.sensors()[sensor], label)
    working_distance_m = _median_depth(loaded, camera, T_camera)
    warn_of_aperture(loaded.sensors()[sensor], camera, working_distance_m, label)
    warn_of_clipping(loaded.sensors()[sensor], _depths(loaded, camera, T_camera), label)
    return Scene(
        name="scene" if isinstance(source, Mapping) else Path(source).stem,
        mitsuba=loaded,
        instances=objects_of(loaded, stated.instances(loaded), stated.objects, T_camera[:3, 3]),
        camera=camera,
        T_world_camera=translation(*origin_m) @ T_camera,
        working_distance_m=working_distance_m,
        has_cutouts=any(is_cutout(s.bsdf()) for s in loaded.shapes()),
        has_matte_textures=any(map(has_texture, {s.bsdf() for s in loaded.shapes() if is_matte(s)})),
        source=None if isinstance(source, Mapping) else scene_file(source),
        reload=lambda: repeat_normals(instantiate()[0]),
        origin_m=origin_m,
    )


class _Stated(NamedTuple):
    """Statements of a scene about its shapes, by their ids.

    ids : ids of all shapes. classes : material classes. things : names of the things that shapes are parts of.
    objects : whether shapes are objects.
    """

    ids: set[str]
    classes: dict[str, str]
    things: dict[str, str]
    objects: dict[str, bool]

    def instances(self, scene: Any) -> tuple[Instance, ...]:
        """The instances of a mitsuba.Scene, one per shape, all objects."""
        names = {s.id(): self.classes.get(s.id()) or _class_of(s) for s in scene.shapes()}
        return tuple(Instance(name, material, self.things.get(name, name)) for name, material in names.items())


@images_can_be_read()
def _instantiate(
    source: Source, material: str, unit_m: float, sensor: int, label: str, advises: bool = False
) -> tuple[Any, _Stated, np.ndarray]:
    """The Mitsuba scene, what the file states of its shapes, and the origin (3,), metres.

    advises : whether to warn of settings that probably are mistakes.
    """
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = False  # merged shapes would lose their ids; equal materials are made once

    def parsed(names: Utf8Names, advises: bool) -> tuple[Any, _Stated]:
        state = _parse(config, source, material, unit_m, names, advises)
        mi.file_resolver().prepend(str(OF_MITSUBA))  # type: ignore[attr-defined]  # again: a scene adds paths
        check_types(state, label)
        check_depth(state, label)
        mi.parser.transform_all(config, state)
        ids, classes = ids_of_shapes(state, label), take_material_classes(state, label)
        stated = _Stated(ids, classes, *take_objects(state, label))
        take_sensor_reflectances(state, label)
        check_properties(state, label)
        check_evaluable(state, label)
        replace_ignored_plugins(state)
        if (camera := camera_node(state, sensor)) is not None:
            check_camera(state, camera, label)
        return state, stated

    def made_of(state: Any) -> Any:
        forget_reading(state)
        loaded = mi.parser.instantiate(config, state)
        return loaded[0] if isinstance(loaded, list) else loaded

    with utf8_names() as names:
        try:
            with _own_file_resolver(names):
                state, stated = parsed(names, advises)
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
            # A BSDF written in Python, such as the retroreflector, adds its traceback
            reason = re.sub(r"Traceback \(most recent call last\): .* (?=\w+Error: )", "", reason)
            raise FileFormatError(f"{label} is no scene that Mitsuba can load: {reason}") from error
    warn_of_colours(coloured, label)
    warn_of_coarse_transform(transform, label)
    warn_of_coarse_mesh(mesh, label)
    if advises and isinstance(loaded, mi.Scene):
        warn_of_loaded_camera(loaded.sensors(), sensor, place, label)
    return loaded, stated, origin_m


def _parse(config: Any, source: Source, material: str, unit_m: float, names: Utf8Names, advises: bool) -> Any:
    if isinstance(source, Mapping):
        check_dictionary(source, "the scene dictionary")
        return mi.parser.parse_dict(config, with_plain_data(source, names.folder))
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
        raise FileFormatError(f"{path} is no scene that Mitsuba can load: {error}") from error
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
    """Search paths of Mitsuba while a file is checked, including those that the file itself adds."""

    def __init__(self, paths: Any) -> None:
        self.paths = paths

    def resolve(self, name: str) -> Path:
        """Path of the file with a name; it need not exist."""
        return Path(str(self.paths.resolve(name)))

    def within(self, folder: str, beside: Path) -> _SearchPaths:
        """The same search paths with a folder in front: the one beside the file, or else the one that they find."""
        near, paths = beside.parent / folder, mi.FileResolver(self.paths)
        paths.prepend(str(near if os.path.exists(near) else self.resolve(folder)))
        return _SearchPaths(paths)


@contextmanager
def _own_file_resolver(names: Utf8Names) -> Iterator[None]:
    """Search paths for one scene. They are restored afterwards, so that no scene finds files of another."""
    before = mi.file_resolver()
    mi.set_file_resolver(mi.FileResolver(before))
    resolver = mi.file_resolver()
    here = os.path.realpath(os.curdir)
    if not is_utf8(here):  # Mitsuba finds files there too, but cannot return their paths
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
    """Whether a camera is much farther from the origin than from what it sees, so that both are far from the origin."""
    camera, T_camera = camera_of(scene.sensors()[sensor], label)
    return bool(np.linalg.norm(place) > AS_FAR * _median_depth(scene, camera, T_camera))


def _median_depth(scene: Any, camera: Intrinsics, T_camera: np.ndarray) -> float:
    """Median depth in metres over a coarse grid of camera rays; 1 if the camera sees nothing.

    T_camera : (4, 4) maps camera coordinates to the renderer's coordinates.
    """
    z = _depths(scene, camera, T_camera)
    return float(np.nanmedian(z)) if np.isfinite(z).any() else 1.0


def _depths(scene: Any, camera: Intrinsics, T_camera: np.ndarray, columns: int = 64) -> np.ndarray:
    """(n,) float32, depth z in metres along a coarse grid of camera rays; NaN where a ray meets no surface."""
    grid = camera.resized(columns, max(1, round(columns * camera.height / camera.width)))
    directions = grid.directions(grid.pixel_centres()).reshape(-1, 3) @ T_camera[:3, :3].T
    ray = mi.Ray3f(o=mi.Point3f(*map(float, T_camera[:3, 3])), d=mi.Vector3f(directions.T.astype(np.float32)))
    si = scene.ray_intersect_preliminary(ray, coherent=True)
    return np.array(dr.select(si.is_valid(), si.t, dr.nan))  # directions have z = 1, so t is depth
